"""Exports, loaded by the rules of the trainers that they are made for; see `trainers`."""

from __future__ import annotations

import json
import os
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tiny_export import POLICY, TinyClip
from trainers import CROP_TRIES, Pictures, RareClasses, Sizes, fitted, mistaken, scan, varied

from weather_aug.scene.scene import WeatherScene
from weather_aug.taxonomy import IGNORE, TRAIN_ID
from weather_aug.writers.export import export
from weather_aug.writers.layout import LAYOUTS
from weather_aug.writers.plan import plan_export

SIZES = Sizes(scale=(256, 192), crop=160)
"""Twice the pictures, as the authors' are half of theirs; a crop is cut on both axes."""
DRAWS = 500
STATS, BY_CLASS = "sample_class_stats.json", "samples_with_class.json"
SOURCES = {
    "cityscapes": ("CityscapesDataset", "leftImg8bit/train", "gtFine/train"),
    "gta": ("GTADataset", "images", "labels"),
}
TARGETS = {
    "cityscapes": SOURCES["cityscapes"],
    "acdc": ("ACDCDataset", "rgb_anon/train", "gt/train"),
}


def existing(names: dict[str, tuple[str, str, str]]) -> list[str]:
    return [name for name in names if name in LAYOUTS]


def entry(root: Path, names: tuple[str, str, str]) -> dict[str, str]:
    kind, images, labels = names
    return {"type": kind, "data_root": f"{root}/", "img_dir": images, "ann_dir": labels}


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> list[WeatherScene]:
    """Two drives of one name, as merged exports have them; sky and road pass 3,000 pixels."""
    return [
        WeatherScene.build(
            TinyClip(frames=2, width=128, height=96, tint=tint),
            tmp_path_factory.mktemp("scenes") / "tiny",
        )
        for tint in (0, 9)
    ]


@pytest.fixture(scope="module")
def exported(
    scenes: list[WeatherScene], tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str], Path]:
    """An export of a layout, made once."""
    made: dict[str, Path] = {}

    def export_of(layout: str) -> Path:
        if layout not in made:
            made[layout] = tmp_path_factory.mktemp(layout) / "out"
            export(plan_export(scenes, POLICY, count=8, seed=3, layout=layout), made[layout])
        return made[layout]

    return export_of


@pytest.fixture
def harmed(exported: Callable[[str], Path], tmp_path: Path) -> Path:
    """A copy to plant a fault in."""
    return shutil.copytree(exported("cityscapes"), tmp_path / "harmed")


def source_of(root: Path, layout: str = "cityscapes") -> Pictures:
    return Pictures.of(entry(root, SOURCES[layout]), sizes=SIZES)


@pytest.mark.parametrize("layout", existing(SOURCES))
def test_every_picture_has_a_label_that_fits_it(
    exported: Callable[[str], Path], layout: str
) -> None:
    source = source_of(exported(layout), layout)
    assert len(source) == 8
    known = {TRAIN_ID[name] for name in ("road", "sky", "car")} | {IGNORE}
    for index in range(len(source)):
        image, label = source.whole(index)
        assert (image.shape, image.dtype) == ((96, 128, 3), np.uint8)
        assert label is not None
        assert label.shape == (96, 128)
        assert set(np.unique(label)) <= known
        cropped = source.load(index, np.random.default_rng(index))
        assert cropped.image.shape == (160, 160, 3)
        assert cropped.label is not None
        assert cropped.label.shape == (160, 160)


@pytest.mark.parametrize("layout", existing(SOURCES))
def test_500_draws_of_rare_class_sampling_load_every_file(
    exported: Callable[[str], Path], layout: str
) -> None:
    root = exported(layout)
    rare = RareClasses.of(root, source_of(root, layout))
    assert sorted(rare.classes) == [TRAIN_ID["road"], TRAIN_ID["sky"]]
    assert mistaken(root, rare.source) == []
    rng = np.random.default_rng(1)
    drawn = [rare.draw(rng) for _ in range(DRAWS)]
    assert {one.file for one in drawn} == {file for files in rare.files.values() for file in files}
    assert all(one.enough or one.tries == CROP_TRIES + 1 for one in drawn)
    assert sum(one.enough for one in drawn) > 0.9 * DRAWS
    counts = Counter(one.train_id for one in drawn)
    for c, probability in zip(rare.classes, rare.probabilities, strict=True):
        # Four standard deviations of the binomial law; the seed is fixed.
        spread = 4 * np.sqrt(DRAWS * probability * (1 - probability))
        assert abs(counts[c] - DRAWS * probability) <= spread + 1


def test_what_is_drawn_is_the_picture_of_the_statistics(exported: Callable[[str], Path]) -> None:
    root = exported("cityscapes")
    source = source_of(root)
    rare = RareClasses.of(root, source)
    for row in json.loads((root / STATS).read_text()):
        label = source.whole(rare.index_by_file[Path(row["file"]).name]).label
        for c in rare.classes:
            assert np.count_nonzero(label == c) == row.get(str(c), 0)


def test_the_order_of_the_scan_does_not_matter(
    exported: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    root, scandir = exported("cityscapes"), os.scandir
    for reverse in (False, True):
        monkeypatch.setattr(
            os, "scandir", lambda p, r=reverse: sorted(scandir(p), key=lambda e: e.name, reverse=r)
        )
        assert mistaken(root, source_of(root)) == []
        found = list(scan(root / "leftImg8bit/train", "_leftImg8bit.png"))
        assert found == sorted(found, reverse=reverse)


def test_what_is_no_plain_file_ends_a_scan(tmp_path: Path) -> None:
    """As mmcv 1.3.7 does it; read there, and run in `test_real_checkout`."""
    (tmp_path / "clip").mkdir()
    (tmp_path / "clip" / "a_leftImg8bit.png").write_text("")
    (tmp_path / "again").symlink_to("clip")
    found = sorted(scan(tmp_path, "_leftImg8bit.png"))
    assert found == ["again/a_leftImg8bit.png", "clip/a_leftImg8bit.png"]
    (tmp_path / "clip" / ".DS_Store").write_text("")
    with pytest.raises(NotADirectoryError):
        list(scan(tmp_path, "_leftImg8bit.png"))
    (tmp_path / "clip" / ".DS_Store").unlink()
    (tmp_path / "b_leftImg8bit.png").symlink_to("nowhere")
    with pytest.raises(FileNotFoundError):
        list(scan(tmp_path, "_leftImg8bit.png"))


@pytest.mark.parametrize("layout", existing(TARGETS))
def test_a_target_needs_no_labels(
    exported: Callable[[str], Path], tmp_path: Path, layout: str
) -> None:
    root = shutil.copytree(exported(layout), tmp_path / "target")
    names = TARGETS[layout]
    shutil.rmtree(root / names[2].split("/")[0])
    target = Pictures.of(entry(root, names), labelled=False, sizes=SIZES)
    rng = np.random.default_rng(0)
    loaded = [target.load(index, rng) for index in range(len(target))]
    assert len(loaded) == 8
    assert all(one.label is None and one.image.shape == (160, 160, 3) for one in loaded)


def test_a_class_that_never_passes_ends_a_run(harmed: Path) -> None:
    rows = json.loads((harmed / STATS).read_text())
    rows[0][str(TRAIN_ID["car"])] = 32
    (harmed / STATS).write_text(json.dumps(rows))
    with pytest.raises(KeyError):
        RareClasses.of(harmed, source_of(harmed))
    by_class = json.loads((harmed / BY_CLASS).read_text())
    by_class[str(TRAIN_ID["car"])] = [[rows[0]["file"], 32]]
    (harmed / BY_CLASS).write_text(json.dumps(by_class))
    with pytest.raises(AssertionError, match="class 13 has no file"):
        RareClasses.of(harmed, source_of(harmed))


def test_equal_base_names_load_the_wrong_picture(harmed: Path) -> None:
    folder = harmed / "leftImg8bit/train"
    twin = sorted(folder.rglob("*.png"))[0]
    for kind in ("leftImg8bit", "gtFine"):
        suffix = "_labelTrainIds" if kind == "gtFine" else ""
        name = twin.name.replace("_leftImg8bit", f"_{kind}{suffix}")
        (harmed / kind / "train/other").mkdir()
        shutil.copy(
            harmed / kind / "train" / twin.parent.name / name, harmed / kind / "train/other"
        )
    rows = json.loads((harmed / STATS).read_text())
    label = twin.name.replace("_leftImg8bit", "_gtFine_labelTrainIds")
    rows.append({"0": 1, "file": f"gtFine/train/other/{label}"})
    (harmed / STATS).write_text(json.dumps(rows))
    assert len(mistaken(harmed, source_of(harmed))) == 1


def test_a_wrong_label_suffix_is_not_found(harmed: Path) -> None:
    for path in list((harmed / "gtFine").rglob("*_labelTrainIds.png")):
        path.rename(path.with_name(path.name.replace("_labelTrainIds", "_labelIds")))
    with pytest.raises(FileNotFoundError):
        source_of(harmed).whole(0)


def test_a_file_that_is_gone_ends_a_run(harmed: Path) -> None:
    next((harmed / "leftImg8bit").rglob("*.png")).unlink()
    assert len(mistaken(harmed, source_of(harmed))) == 1
    rare = RareClasses.of(harmed, source_of(harmed))
    rng = np.random.default_rng(0)
    with pytest.raises(KeyError):
        for _ in range(DRAWS):
            rare.draw(rng)


def test_labels_of_the_gta_class_may_not_stand_in_folders(harmed: Path) -> None:
    """Its sampler looks for base names among paths: the reason for a flat layout of its own."""
    names = ("GTADataset", "leftImg8bit/train", "gtFine/train")
    for path in list((harmed / "gtFine").rglob("*.png")):
        stem = path.name.replace("_gtFine_labelTrainIds.png", "_leftImg8bit_labelTrainIds.png")
        path.rename(path.with_name(stem))
    source = Pictures.of(entry(harmed, names), sizes=SIZES)
    assert source.whole(0).label is not None
    with pytest.raises(KeyError):
        RareClasses.of(harmed, source).draw(np.random.default_rng(0))


@pytest.mark.parametrize(
    ("size", "scale", "expected"),
    [
        ((1920, 1080), (2048, 1024), (1820, 1024)),
        ((1920, 1280), (2048, 1024), (1536, 1024)),
        ((1408, 376), (2048, 1024), (2048, 547)),
        ((1920, 1080), (1920, 1080), (1920, 1080)),
    ],
)
def test_resizing_keeps_the_aspect(
    size: tuple[int, int], scale: tuple[int, int], expected: tuple[int, int]
) -> None:
    made = fitted(np.zeros(size[::-1], np.uint8), scale, 0)
    assert made.shape == expected[::-1]


def test_a_crop_of_one_class_is_not_varied() -> None:
    label = np.zeros((8, 8), np.uint8)
    assert not varied(label, 0.75)
    label[:4] = 1
    assert varied(label, 0.75)
    label[:7] = IGNORE
    assert not varied(label, 0.75)
