"""What an export wrote, read back from disk: the sheet's samples and the classes' pixels."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import fsspec
import numpy as np
import pytest
from tiny_export import TinyClip

from weather_aug.errors import IntegrityError
from weather_aug.scene.scene import WeatherScene
from weather_aug.taxonomy import CLASSES, coloured
from weather_aug.writers.export import export
from weather_aug.writers.manifest import manifest_lines
from weather_aug.writers.plan import ExportPlan, plan_grid
from weather_aug.writers.source import source_of
from weather_aug.writers.written import read_part, read_written, written_sheet


@pytest.fixture(scope="module")
def out(plan: ExportPlan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Not to be harmed."""
    return export(plan, tmp_path_factory.mktemp("written") / "out").out


@pytest.fixture(scope="module")
def tars(scene: WeatherScene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same street as tars."""
    plan = plan_grid([scene], ["clear", "fog=0.9"], layout="webdataset")
    return export(plan, tmp_path_factory.mktemp("tars") / "out").out


def test_a_url_is_read_as_a_folder_is(out: Path, tars: Path) -> None:
    memory = fsspec.filesystem("memory")
    for folder in (out, tars):
        url = f"memory://written/{folder.parent.name}"
        memory.put(str(folder), url, recursive=True)
        local = read_written(folder)
        for place in (url, f"file://{folder}", source_of(url)):
            written = read_written(place)
            assert written.shown == local.shown
            assert np.array_equal(written.pixels, local.pixels)
            sheet = written_sheet(place, written, tile_width=48)
            assert np.array_equal(sheet, written_sheet(str(folder), local, tile_width=48))
    memory.rm(f"{url}/{local.shown[0]['files']['tar']['path']}")
    with pytest.raises(IntegrityError, match=r"memory://written/.*\.tar is missing"):
        read_written(url)


def test_of_a_tar_at_a_url_only_the_part_is_read(
    tars: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory = fsspec.filesystem("memory")
    memory.put(str(tars), "memory://written/ranges", recursive=True)
    asked: list[int] = []
    cat = type(memory).cat_file

    def counting(self: Any, path: str, start: int | None = None, end: int | None = None) -> bytes:
        data: bytes = cat(self, path, start, end)
        asked.append(len(data))
        return data

    monkeypatch.setattr(type(memory), "cat_file", counting)
    entry = json.loads(next(manifest_lines(tars)))
    read_part("memory://written/ranges", entry, "label")
    assert asked == [entry["members"]["label"]["size"]]


def test_shares_are_those_of_the_labels_on_disk(out: Path) -> None:
    labels = [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in out.rglob("*TrainIds.png")]
    written = read_written(out)
    assert (written.counted, written.labelled, len(written.shown)) == (10, 10, 8)
    shares = written.shares
    assert shares is not None
    assert sum(shares.values()) == pytest.approx(1)
    for train_id, name in [*enumerate(CLASSES), (255, "ignored")]:
        assert shares[name] == pytest.approx(np.mean([(x == train_id).mean() for x in labels]))
    assert min(shares["road"], shares["car"], shares["ignored"]) > 0


def test_a_few_labels_of_many_are_counted_and_the_same_again(out: Path) -> None:
    written, again = (read_written(out, shown=3, counted=4) for _ in range(2))
    assert (written.counted, len(written.shown)) == (4, 3)
    assert written.pixels.sum() == 4 * 48 * 32
    assert written.shown == again.shown
    assert np.array_equal(written.pixels, again.pixels)


@pytest.mark.parametrize("folder", ["out", "tars"])
def test_parts_are_the_files(folder: str, request: pytest.FixtureRequest) -> None:
    root = request.getfixturevalue(folder)
    lines = list(manifest_lines(root))
    for line in lines:
        entry = json.loads(line)
        assert read_part(root, entry, "image").shape == (32, 48, 3)
        label = read_part(root, entry, "label")
        counts = {str(c): int((label == c).sum()) for c in range(19) if (label == c).any()}
        assert counts == entry["class_pixels"]
    if folder == "out":
        path = root / entry["files"]["image"]["path"]
        expected = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB)
        assert np.array_equal(read_part(root, entry, "image"), expected)


def test_the_sheet_shows_pictures_and_labels_from_disk(out: Path) -> None:
    written = read_written(out, shown=1)
    sheet = written_sheet(out, written, tile_width=48)
    (entry,) = written.shown
    image, label = (read_part(out, entry, part) for part in ("image", "label"))
    assert np.array_equal(sheet[26 : 26 + 32, 26 : 26 + 48], image)
    assert np.array_equal(sheet[62 : 62 + 32, 26 : 26 + 48], coloured(label))


def test_the_sheet_of_tars_has_a_name_over_each_picture(tars: Path) -> None:
    written = read_written(tars)
    sheet = written_sheet(tars, written, tile_width=100)
    assert sheet.shape[1] == max(26 + 4 * 104, 640)
    # Two blocks of pictures and labels, then the histogram.
    assert sheet.shape[0] > 2 * (26 + 2 * (67 + 4))


def test_without_labels_there_is_no_histogram(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    folder = tmp_path_factory.mktemp("bare")
    bare = WeatherScene.build(TinyClip(labelled=False), folder / "scene")
    out = export(plan_grid([bare], ["clear"]), folder / "out").out
    written = read_written(out)
    assert written.shares is None
    assert written_sheet(out, written, tile_width=48).shape == (26 + 36, 26 + 4 * 52, 3)


def test_what_is_half_labelled_shows_grey(
    scene: WeatherScene, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("half")
    bare = WeatherScene.build(TinyClip(frames=2, labelled=False), folder / "scene")
    out = export(plan_grid([bare, scene], ["clear"]), folder / "out").out
    written = read_written(out)
    assert (written.counted, written.labelled, len(written.shown)) == (4, 4, 6)
    sheet = written_sheet(out, written, tile_width=48)
    assert (sheet[62 : 62 + 32, 26 : 26 + 48] == 128).all()


def test_changed_bytes_are_noticed(plan: ExportPlan, tmp_path: Path) -> None:
    out = export(plan, tmp_path / "out").out
    entry = read_written(out, shown=1).shown[0]
    path = out / entry["files"]["label"]["path"]
    data = bytearray(path.read_bytes())
    data[-20] ^= 1
    path.write_bytes(data)
    with pytest.raises(IntegrityError, match="has changed since it was written"):
        read_written(out)
    path.unlink()
    with pytest.raises(IntegrityError, match="is missing"):
        read_written(out)
