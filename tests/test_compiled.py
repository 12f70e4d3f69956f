"""Compiled code is cached, never outlives its sources, and no damaged file stops a program."""

from __future__ import annotations

import importlib.util
import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

import weather_aug
from weather_aug import _compiled
from weather_aug._compiled import CheckedFiles

TINY = """
from weather_aug._compiled import compiled

@compiled
def doubled(x):
    return x + x
"""
PROBE = """
import numpy as np
from weather_aug.edit.surface import Surface, depth_row
bytes_, halves = np.empty(0, np.uint8), np.empty(0, np.uint16)
depth = np.array([50000.0], np.float32)
surface = Surface(bytes_.reshape(0, 3), (0, 0, 1, 1), halves, depth, bytes_, 1)
out = np.empty(1, np.float32)
depth_row(surface, 0, 0, out.view(np.int32), out)
print(out[0], sum(depth_row.stats.cache_hits.values()))
"""
PACKAGE = Path(weather_aug.__file__).parent


def imported(folder: Path, source: str = TINY) -> Any:
    """The tiny kernel as a new process would import it."""
    path = folder / "tiny_kernel.py"
    path.write_text(source, encoding="utf-8")
    spec = importlib.util.spec_from_file_location("tiny_kernel", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.doubled


def hits(kernel: Any) -> int:
    """Signatures that came from the cache, after one right call."""
    assert kernel(21.0) == 42.0
    return sum(kernel.stats.cache_hits.values())


def only_file(folder: Path) -> Path:
    (path,) = (folder / "__pycache__").glob("*.nbc")
    return path


def damaged(path: Path, change: Callable[[bytes], bytes]) -> None:
    path.write_bytes(change(path.read_bytes()))


def flipped(place: float) -> Callable[[bytes], bytes]:
    """Flip one bit at a share of the file's length."""

    def change(data: bytes) -> bytes:
        k = int(place * (len(data) - 1))
        return data[:k] + bytes([data[k] ^ 4]) + data[k + 1 :]

    return change


DAMAGES = {
    "empty": lambda data: b"",
    "one byte": lambda data: data[:1],
    "digest only": lambda data: data[:32],
    "half": lambda data: data[: len(data) // 2],
    "a byte short": lambda data: data[:-1],
    "a byte long": lambda data: data + b"\0",
    "zeros": lambda data: bytes(len(data)),
    "text": lambda data: b"nothing of ours\n" * 100,
    **{f"flipped at {place}": flipped(place) for place in (0.0, 0.05, 0.3, 0.6, 0.9, 1.0)},
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_compiled_anew(tmp_path: Path, damage: str) -> None:
    assert hits(imported(tmp_path)) == 0
    assert hits(imported(tmp_path)) == 1
    damaged(only_file(tmp_path), DAMAGES[damage])
    assert hits(imported(tmp_path)) == 0
    assert hits(imported(tmp_path)) == 1


def test_numba_alone_would_stop_at_a_damaged_file(tmp_path: Path) -> None:
    """What the check above guards against, in the numba that is installed."""
    source = TINY.replace("weather_aug._compiled import compiled", "numba import njit")
    source = source.replace("@compiled", "@njit(cache=True)")
    assert hits(imported(tmp_path, source)) == 0
    damaged(only_file(tmp_path), DAMAGES["half"])
    with pytest.raises((pickle.UnpicklingError, EOFError)):
        hits(imported(tmp_path, source))


def test_a_flipped_bit_would_be_run_without_the_digest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file's pickle may still load: only the digest tells."""
    files = CheckedFiles(tmp_path / "kernel", "stamp")
    files.save("key", b"machine code" * 50)
    (path,) = tmp_path.iterdir()
    damaged(path, flipped(0.5))
    assert files.load("key") is None
    monkeypatch.setattr(CheckedFiles, "_digest", lambda self, data: path.read_bytes()[:32])
    assert files.load("key") not in (None, b"machine code" * 50)


def test_another_version_of_numba_is_compiled_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert hits(imported(tmp_path)) == 0
    with monkeypatch.context() as other:
        other.setattr(numba, "__version__", "0.1")
        assert hits(imported(tmp_path)) == 0
        assert hits(imported(tmp_path)) == 1
    assert hits(imported(tmp_path)) == 0


def test_a_folder_that_vanished_or_filled_up_is_no_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernel = imported(tmp_path)
    shutil.rmtree(tmp_path / "__pycache__")
    assert hits(kernel) == 0
    full = imported(tmp_path)
    monkeypatch.setattr(Path, "replace", no_space)
    only_file(tmp_path).unlink()
    assert hits(full) == 0
    # Nothing half-written is left either.
    assert list((tmp_path / "__pycache__").glob("*.nbc*")) == []


def no_space(*_: Any) -> None:
    raise OSError(28, "No space left on device")


def test_a_place_that_is_no_folder_is_no_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither the source's folder nor the user's can be written."""
    blocked = tmp_path / "file"
    blocked.touch()
    (tmp_path / "__pycache__").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    assert hits(imported(tmp_path)) == 0
    assert hits(imported(tmp_path)) == 0


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="this system has no owners of files")
def test_only_files_of_this_user_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cache file is a pickle: reading a stranger's would run it."""
    assert hits(imported(tmp_path)) == 0
    path = only_file(tmp_path)
    assert path.stat().st_mode & 0o777 == 0o600
    path.chmod(0o622)
    assert hits(imported(tmp_path)) == 0
    assert hits(imported(tmp_path)) == 1
    owner = path.stat()
    stranger = os.stat_result((owner.st_mode, 0, 0, 1, 4000, 4000, *owner[6:]))
    monkeypatch.setattr(os, "fstat", lambda handle: stranger)
    assert hits(imported(tmp_path)) == 0


def test_processes_that_save_at_once_keep_their_own_entries(tmp_path: Path) -> None:
    """Numba's index would be written over by the one that comes last."""
    one, other = (CheckedFiles(tmp_path / "kernel", "stamp") for _ in range(2))
    assert one.load("a") is None
    assert other.load("b") is None
    one.save("a", 1)
    other.save("b", 2)
    assert [one.load("a"), other.load("b"), one.load("b"), one.load("c")] == [1, 2, 2, None]
    one.flush()
    assert [one.load("a"), other.load("b")] == [None, None]


def test_a_file_under_another_key_is_not_taken_for_it(tmp_path: Path) -> None:
    files = CheckedFiles(tmp_path / "kernel", "stamp")
    files.save("a", 1)
    files._path("a").rename(files._path("b"))
    assert files.load("b") is None
    assert CheckedFiles(tmp_path / "kernel", "other").load("a") is None


def test_two_signatures_are_cached_side_by_side(tmp_path: Path) -> None:
    kernel = imported(tmp_path)
    assert hits(kernel) == 0
    assert kernel(np.float32(2)) == 4
    again = imported(tmp_path)
    assert hits(again) == 1
    assert again(np.float32(2)) == 4
    assert sum(again.stats.cache_hits.values()) == 2


def copied_package(folder: Path) -> Path:
    ignore = shutil.ignore_patterns("__pycache__")
    shutil.copytree(PACKAGE, folder / "weather_aug", ignore=ignore)
    return folder / "weather_aug"


def ran(folder: Path, *command: str, **environment: str) -> str:
    """Output of Python in a folder, where warnings are errors; "" unsets a variable."""
    state = {k: v for k, v in (os.environ | environment).items() if v}
    done = subprocess.run(
        [sys.executable, "-W", "error", *command],
        cwd=folder,
        env=state | {"PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout


def test_a_constant_changed_in_another_module_changes_the_result(tmp_path: Path) -> None:
    """Numba alone would look only at the file of the function and keep the old constant."""
    package = copied_package(tmp_path)
    assert ran(tmp_path, "-c", PROBE).split() == ["50000.0", "0"]
    assert ran(tmp_path, "-c", PROBE).split() == ["50000.0", "1"]
    types = package / "clip" / "types.py"
    source = types.read_text(encoding="utf-8")
    assert "FAR_DEPTH_M = 60000.0" in source
    types.write_text(source.replace("FAR_DEPTH_M = 60000.0", "FAR_DEPTH_M = 40000.0"))
    assert ran(tmp_path, "-c", PROBE).split() == ["inf", "0"]


def test_the_stamp_is_that_of_all_sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = copied_package(tmp_path)
    monkeypatch.setattr(_compiled, "__file__", str(package / "_compiled.py"))
    stamp = _compiled._package_stamp.__wrapped__
    before = stamp()
    assert before == _compiled._package_stamp()
    overcast = package / "edit" / "physical" / "overcast.py"
    overcast.write_text(overcast.read_text(encoding="utf-8") + "# changed\n", encoding="utf-8")
    assert stamp() != before


@pytest.mark.slow
def test_a_render_survives_a_broken_cache(tmp_path: Path) -> None:
    """Whole, truncated, gone, without HOME and without any folder: the same bytes, no warning."""
    package = copied_package(tmp_path)
    probe = (str(Path(__file__).with_name("bits_probe.py")), "--cases", "rain")
    bare = {"HOME": "", "XDG_CACHE_HOME": "", "NUMBA_CACHE_DIR": ""}
    first = ran(tmp_path, *probe, **bare)
    caches = sorted(package.rglob("__pycache__"))
    files = [path for folder in caches for path in folder.glob("*.nbc")]
    assert len(files) > 20
    for k, path in enumerate(files):
        damaged(path, list(DAMAGES.values())[k % len(DAMAGES)])
    assert ran(tmp_path, *probe, **bare) == first
    for folder in caches:
        shutil.rmtree(folder)
        folder.touch()
    blocked = {"HOME": "/dev/null", "XDG_CACHE_HOME": "/dev/null", "NUMBA_CACHE_DIR": "/dev/null/x"}
    assert ran(tmp_path, *probe, **blocked) == first
