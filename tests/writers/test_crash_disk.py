"""A disk that is really full, under the real command: exit code 6, one sentence, and on it goes."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from exporters import busy_s, environment, ray_folder
from planted_calls import assert_committed_verifies, assert_nothing_partial, committed_entries
from tiny_export import tree_of

from weather_aug.cli import main
from weather_aug.scene.scene import WeatherScene
from weather_aug.writers.verify import verify_export

COUNT = 40
"""Samples; each takes two pages of 4 KiB."""
TOO_SMALL, ENOUGH = "240k", "8m"


def mounted(*arguments: str) -> bool:
    """Whether the system did it."""
    try:
        return (
            subprocess.run(["mount", *arguments], capture_output=True, check=False).returncode == 0
        )
    except FileNotFoundError:
        return False


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of its own that is too small for the export."""
    disk = tmp_path / "disk"
    disk.mkdir()
    if not mounted("-t", "tmpfs", "-o", f"size={TOO_SMALL}", "tmpfs", str(disk)):
        pytest.skip("this process may not mount a disk (it takes root)")
    try:
        yield disk
    finally:
        subprocess.run(["umount", "--lazy", str(disk)], check=True)


@pytest.fixture
def ray_temporary() -> Iterator[Path]:
    with ray_folder() as folder:
        yield folder


@pytest.fixture(scope="module")
def tree(scene: WeatherScene, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    out = tmp_path_factory.mktemp("plain") / "data"
    main(["export", str(scene.path), "--out", str(out), "--count", str(COUNT), "--quiet"])
    return tree_of(out)


class Command:
    """`weather-aug export` to a disk that may be full."""

    def __init__(self, scene: WeatherScene, disk: Path, engine: list[str]) -> None:
        self.disk, self.out = disk, disk / "data"
        where = [str(scene.path), "--out", str(self.out), "--count", str(COUNT), "--quiet"]
        program = "from weather_aug.cli import main; main()"
        self._words = [sys.executable, "-c", program, "export", *where, *engine]

    def run(self) -> tuple[int, list[str], float]:
        """Exit code, lines on stderr, and seconds between the disk's being full and the end."""
        process = subprocess.Popen(
            self._words, env=environment(), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
        )
        full_s = None
        while process.poll() is None:
            if full_s is None and os.statvfs(self.disk).f_bavail == 0:
                full_s = time.monotonic()
            time.sleep(0.002)
        took_s = 0.0 if full_s is None else time.monotonic() - full_s
        _, errors = process.communicate(timeout=5)
        return process.returncode, errors.decode().splitlines(), took_s


def stamps(out: Path) -> dict[str, int]:
    """When the committed files were written, by path."""
    paths = [file["path"] for entry in committed_entries(out) for file in entry["files"].values()]
    return {path: (out / path).stat().st_mtime_ns for path in paths}


RAY = pytest.param(["--engine", "ray", "--workers", "2"], marks=pytest.mark.slow, id="ray-2")


@pytest.mark.parametrize(
    "engine",
    [
        pytest.param(["--engine", "inline"], id="inline"),
        pytest.param(["--workers", "2"], id="process-2"),
        RAY,
    ],
)
def test_a_full_disk_ends_the_command_and_it_continues(
    scene: WeatherScene,
    disk: Path,
    tree: dict[str, str],
    engine: list[str],
    ray_temporary: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if "ray" in engine:
        pytest.importorskip("ray", reason="ray is not installed")
    monkeypatch.setenv("RAY_TMPDIR", str(ray_temporary))
    command = Command(scene, disk, engine)
    # Once more on the disk that is still full.
    for _ in range(2):
        status, errors, took_s = command.run()
        assert status == 6, errors
        assert len(errors) == 1, errors
        (line,) = errors
        assert line.startswith(f"weather-aug: cannot write {command.out}")
        assert line.endswith(": No space left on device; free some space and run it again")
        assert took_s <= busy_s(5)
        assert_committed_verifies(command.out)
        assert_nothing_partial(command.out, tree)
    before = stamps(command.out)
    assert 5 < len(before) / 2 < COUNT
    assert mounted("-o", f"remount,size={ENOUGH}", str(disk))
    assert command.run()[:2] == (0, [])
    assert tree_of(command.out) == tree
    assert verify_export(command.out) == []
    assert before == {path: (command.out / path).stat().st_mtime_ns for path in before}


def test_a_disk_full_from_the_start_is_named(scene: WeatherScene, disk: Path) -> None:
    (disk / "theirs").write_bytes(bytes(10**6)[: os.statvfs(disk).f_bavail * 4096])
    status, errors, _ = Command(scene, disk, ["--engine", "inline"]).run()
    assert status == 6
    (line,) = errors
    assert "No space left on device" in line


def test_a_disk_that_may_only_be_read_is_refused_before_the_first_render(
    scene: WeatherScene, disk: Path
) -> None:
    assert mounted("-o", "remount,ro", str(disk))
    start_s = time.monotonic()
    status, errors, _ = Command(scene, disk, ["--engine", "inline"]).run()
    assert status == 6
    (line,) = errors
    assert line == f"weather-aug: cannot write {disk / 'data'}: Read-only file system"
    # Most of it is the start of Python.
    assert time.monotonic() - start_s < busy_s(5)
