"""verify_export finds every damage, with nothing but the export at hand."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import fsspec
import pytest
from fsspec.implementations.memory import MemoryFileSystem

from weather_aug.errors import OutputError
from weather_aug.writers import layout
from weather_aug.writers.export import export
from weather_aug.writers.plan import ExportPlan
from weather_aug.writers.verify import verify_export


@pytest.fixture(scope="module")
def whole(plan: ExportPlan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole") / "out"
    export(plan, out)
    return out


@pytest.fixture
def out(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "out"))


def test_a_whole_export_has_no_problems(out: Path) -> None:
    assert verify_export(out) == []


def test_every_file_of_the_export_is_watched(out: Path) -> None:
    files = sorted(path for path in out.rglob("*") if path.is_file())
    assert len(files) == 25
    for path in files:
        data = path.read_bytes()
        flipped = bytes([data[0] ^ 1]) + data[1:]
        for damage in (b"", data[:-1], data + b" ", flipped):
            path.write_bytes(damage)
            assert verify_export(out), f"{path} with {len(damage)} bytes passed"
        path.unlink()
        assert verify_export(out), f"without {path} it passed"
        path.write_bytes(data)
    assert verify_export(out) == []


@pytest.mark.parametrize("protocol", ["memory", "file"])
def test_every_file_at_a_url_is_watched(out: Path, protocol: str) -> None:
    url = f"{protocol}://{out}"
    fs = fsspec.filesystem(protocol)
    if protocol == "memory":
        fs.put(str(out), url, recursive=True)
    assert verify_export(url) == []
    files = [path for path in fs.find(str(out)) if not path.endswith(".png")]
    files += [path for path in fs.find(str(out)) if path.endswith(".png")][:2]
    for path in files:
        data = fs.cat_file(path)
        flipped = bytes([data[0] ^ 1]) + data[1:]
        for damage in (b"", data[:-1], data + b" ", flipped):
            fs.pipe_file(path, damage)
            assert verify_export(url), f"{path} with {len(damage)} bytes passed"
        fs.rm_file(path)
        assert verify_export(url), f"without {path} it passed"
        fs.pipe_file(path, data)
    fs.pipe_file(f"{out}/more.txt", b"x")
    assert verify_export(url) == ["more.txt is not part of the export"]


def test_at_a_url_paths_that_lead_outside_are_not_followed(out: Path) -> None:
    manifest = out / "manifest.jsonl"
    manifest.write_text(manifest.read_text().replace("leftImg8bit/train", "../../etc", 1))
    assert any("not a plain path" in problem for problem in verify_export(f"file://{out}"))


def test_a_url_that_does_not_answer_is_no_damage(out: Path) -> None:
    class Silent(MemoryFileSystem):
        protocol = ("silent",)

        def info(self, path: str, **_: Any) -> Any:
            raise RuntimeError("no route to host")

    fsspec.register_implementation("silent", Silent, clobber=True)
    with pytest.raises(OutputError, match=r"cannot read silent://host/x/export\.json: .*no route"):
        verify_export("silent://me:secret@host/x")


def test_extra_and_swapped_files_are_reported_and_kept(plan: ExportPlan, out: Path) -> None:
    extra = out / "leftImg8bit" / "train" / "tiny" / "extra_leftImg8bit.png"
    extra.write_bytes(b"x")
    assert verify_export(out) == [
        "leftImg8bit/train/tiny/extra_leftImg8bit.png is not part of the export"
    ]
    assert extra.exists()
    extra.unlink()
    first, second = (out / plan.paths(i)["image"] for i in (0, 1))
    swapped = first.read_bytes(), second.read_bytes()
    first.write_bytes(swapped[1])
    second.write_bytes(swapped[0])
    assert len(verify_export(out)) == 2


def test_a_link_in_place_of_a_file_is_reported(plan: ExportPlan, out: Path, tmp_path: Path) -> None:
    image = out / plan.paths(0)["image"]
    (tmp_path / "elsewhere.png").write_bytes(image.read_bytes())
    image.unlink()
    image.symlink_to(tmp_path / "elsewhere.png")
    assert "is a link" in verify_export(out)[0]


def test_counts_and_order_of_a_consistent_forgery_are_checked(out: Path) -> None:
    manifest = out / "manifest.jsonl"
    lines = manifest.read_text().splitlines(keepends=True)
    for forged in (lines[:-1], [lines[1], lines[0], *lines[2:]], [*lines, lines[-1]], ["[]\n"]):
        manifest.write_text("".join(forged))
        contents = json.loads((out / "export.json").read_text())
        del contents["sha256"]
        data = manifest.read_bytes()
        from weather_aug import _files

        contents["files"]["manifest.jsonl"] = {
            "size": len(data),
            "sha256": _files.sha256_of(data),
        }
        (out / "export.json").write_bytes(layout.sealed_contents(contents))
        assert verify_export(out)


def test_paths_that_lead_outside_are_not_followed(out: Path) -> None:
    manifest = out / "manifest.jsonl"
    manifest.write_text(manifest.read_text().replace("leftImg8bit/train", "../../etc", 1))
    assert any("not a plain path" in problem for problem in verify_export(out))


def test_what_is_no_finished_export_is_told_apart(tmp_path: Path) -> None:
    assert "is not an export" in verify_export(tmp_path)[0]
    (tmp_path / ".export").mkdir()
    (tmp_path / ".export" / "journal").write_bytes(b"")
    assert "is not finished" in verify_export(tmp_path)[0]
    (tmp_path / "export.json").write_text("[" * 100_000)
    assert "not valid JSON" in verify_export(tmp_path)[0]


def test_it_needs_neither_torch_nor_a_renderer(out: Path) -> None:
    code = (
        "import sys\n"
        "from pathlib import Path\n"
        "from weather_aug.writers.verify import verify_export\n"
        f"assert verify_export(Path({str(out)!r})) == []\n"
        "heavy = {'torch', 'numba', 'cv2', 'numpy', 'fsspec'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
