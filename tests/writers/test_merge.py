"""A Cityscapes root and exports in one folder of links, as rare-class sampling reads it."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_class_stats import NAMES, rare_class_table, read
from tiny_export import POLICY, TinyClip, tree_of

from weather_aug._png import png_bytes
from weather_aug.cli import main
from weather_aug.errors import (
    ArgumentError,
    ConflictError,
    DataError,
    IntegrityError,
    OutputError,
)
from weather_aug.scene.scene import WeatherScene
from weather_aug.taxonomy import TRAIN_ID
from weather_aug.writers import merge, merged
from weather_aug.writers.export import export
from weather_aug.writers.merge import merge_cityscapes
from weather_aug.writers.plan import plan_export

CITIES = {"train": ("aachen", "bochum"), "val": ("lindau",)}
RIDER, CAR = TRAIN_ID["rider"], TRAIN_ID["car"]


def write_root(root: Path, *, rider_pixels: int = 10) -> Path:
    """Five pictures a city; one label holds `rider_pixels` pixels of a rider."""
    for split, cities in CITIES.items():
        for city in cities:
            for number in range(5):
                base = f"{city}_{number:06d}_000019"
                label = np.full((64, 96), TRAIN_ID["sky"], np.uint8)
                label.ravel()[:100] = 255
                if (city, number) == ("bochum", 2):
                    label.ravel()[100 : 100 + rider_pixels] = RIDER
                for path, plane in (
                    (
                        f"leftImg8bit/{split}/{city}/{base}_leftImg8bit.png",
                        np.stack([label] * 3, 2),
                    ),
                    (f"gtFine/{split}/{city}/{base}_gtFine_labelTrainIds.png", label),
                    (f"gtFine/{split}/{city}/{base}_gtFine_labelIds.png", label),
                ):
                    (root / path).parent.mkdir(parents=True, exist_ok=True)
                    (root / path).write_bytes(png_bytes(plane))
    return root


def write_stats(root: Path) -> list[dict[str, Any]]:
    """As the trainers' converter: each training label with its path from the working folder."""
    rows = []
    for path in sorted((root / "gtFine" / "train").rglob("*_labelTrainIds.png")):
        pixels = {"10": 64 * 96 - 100 - 10 * ("bochum_000002" in path.name)}
        if "bochum_000002" in path.name:
            pixels[str(RIDER)] = 10
        rows.append(pixels | {"file": f"data/cityscapes/{path.relative_to(root).as_posix()}"})
    (root / "sample_class_stats.json").write_text(json.dumps(rows))
    return rows


@pytest.fixture(scope="module")
def exports(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two exports of one scene, whose folders have one name."""
    folder = tmp_path_factory.mktemp("exports")
    scene = WeatherScene.build(TinyClip(width=96, height=64), folder / "scene")
    outs = [folder / "first", folder / "second"]
    for seed, out in enumerate(outs):
        export(plan_export([scene], POLICY, count=4, seed=seed), out)
    return outs


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_root(tmp_path / "cityscapes")


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "merged"


def links_of(out: Path) -> dict[str, Path]:
    """What each link of a merge stands for."""
    paths = [Path(folder, name) for folder, _, names in os.walk(out) for name in names]
    own = {*NAMES, merged.CONTENTS}
    return {p.relative_to(out).as_posix(): p.resolve() for p in paths if p.name not in own}


def state(*folders: Path) -> list[Any]:
    """Content and times of every file, to see that none was touched."""
    return [
        (path, path.lstat().st_mtime_ns, path.lstat().st_ino)
        for folder in folders
        for path in sorted(folder.rglob("*"))
    ] + [tree_of(folder) for folder in folders]


def drawn(out: Path) -> dict[int, set[str]]:
    """Labels that rare-class sampling can draw of each class, found as a CityscapesDataset does."""
    images = sorted((out / "leftImg8bit" / "train").rglob("*_leftImg8bit.png"))
    suffixes = "_leftImg8bit.png", "_gtFine_labelTrainIds.png"
    labels = [str(path.relative_to(out / "leftImg8bit")).replace(*suffixes) for path in images]
    assert all((out / "gtFine" / label).is_file() for label in labels)
    names = {label.split("/")[-1] for label in labels}
    assert len(names) == len(labels)
    table = {train_id: set(files) for train_id, files in rare_class_table(out).items()}
    assert all(files <= names for files in table.values())
    return table


def test_a_trainer_finds_both_and_their_statistics(
    root: Path, exports: list[Path], out: Path
) -> None:
    report = merge_cityscapes(root, exports, out)
    assert (report.samples, report.exported, report.counted) == (18, 8, 10)
    sources = [root, *exports]
    files = {
        str(path.relative_to(source)): path.resolve()
        for source in sources
        for path in source.rglob("*.png")
    }
    assert links_of(out) == files
    assert report.linked == len(files) == 3 * 15 + 2 * 8
    assert len(drawn(out)[TRAIN_ID["sky"]]) == 18
    rows, by_file, _ = read(out)
    assert len(rows) == len(by_file) == 18
    assert all((out / path).is_file() for path in by_file)
    assert not any("/val/" in path for path in by_file)


def test_a_class_passes_or_is_dropped_by_the_union(exports: list[Path], tmp_path: Path) -> None:
    rare = merge_cityscapes(write_root(tmp_path / "rare"), exports, tmp_path / "a")
    assert RIDER in rare.dropped_classes
    assert RIDER not in drawn(tmp_path / "a")
    often = write_root(tmp_path / "often", rider_pixels=3001)
    assert RIDER in merge_cityscapes(often, exports, tmp_path / "b").classes
    assert drawn(tmp_path / "b")[RIDER] == {"bochum_000002_000019_gtFine_labelTrainIds.png"}
    assert CAR in rare.dropped_classes


def test_statistics_of_the_root_are_believed_by_base_name(
    root: Path, exports: list[Path], out: Path, tmp_path: Path
) -> None:
    merge_cityscapes(root, exports, tmp_path / "counted")
    rows = write_stats(root)
    assert merge_cityscapes(root, exports, out).counted == 0
    assert read(out) == read(tmp_path / "counted")
    (root / "sample_class_stats.json").write_text(json.dumps(rows[:-2]))
    assert merge_cityscapes(root, exports, out).counted == 2
    assert read(out) == read(tmp_path / "counted")


@pytest.mark.parametrize(
    "rows",
    [
        {},
        7,
        [3],
        [{"0": 1}],
        [{"0": -1, "file": "a"}],
        [{"0": 1.5, "file": "a"}],
        [{"19": 1, "file": "a"}],
        [{"x": 1, "file": "a"}],
    ],
)
def test_statistics_that_are_none_are_refused(root: Path, out: Path, rows: Any) -> None:
    (root / "sample_class_stats.json").write_text(json.dumps(rows))
    with pytest.raises(DataError, match="remove it, then labels are counted"):
        merge_cityscapes(root, [], out)
    assert not out.exists()


@pytest.mark.parametrize("hard", [False, True])
def test_sources_are_never_written_to(
    root: Path, exports: list[Path], out: Path, hard: bool
) -> None:
    write_stats(root)
    before = state(root, *exports)
    for _ in range(2):
        merge_cityscapes(root, exports, out, hard=hard)
    shutil.rmtree(out)
    assert state(root, *exports) == before


def test_a_second_run_changes_nothing(root: Path, exports: list[Path], out: Path) -> None:
    merge_cityscapes(root, exports, out)
    before = links_of(out), tree_of(out)
    report = merge_cityscapes(root, exports, out)
    assert (report.linked, report.removed) == (0, 0)
    assert (links_of(out), tree_of(out)) == before


@pytest.mark.parametrize("hard", [False, True])
def test_a_merge_is_repaired_and_follows_its_exports(
    root: Path, exports: list[Path], out: Path, hard: bool
) -> None:
    merge_cityscapes(root, exports, out, hard=hard)
    whole = tree_of(out)
    lost = next((out / "gtFine").rglob("tiny_*.png"))
    lost.unlink()
    (out / "samples_with_class.json").write_text("{}")
    assert merge_cityscapes(root, exports, out, hard=hard).linked == 1
    assert tree_of(out) == whole
    if not hard:
        assert merge_cityscapes(root, exports[:1], out).removed == 8
        assert len(drawn(out)[TRAIN_ID["sky"]]) == 14
        merge_cityscapes(root, exports, out)
        assert tree_of(out) == whole


def test_links_may_become_hard_and_back(root: Path, exports: list[Path], out: Path) -> None:
    for hard in (False, True, False):
        merge_cityscapes(root, exports, out, hard=hard)
        assert all((out / path).is_symlink() != hard for path in links_of(out))
        drawn(out)


def test_links_hold_where_everything_is_moved(exports: list[Path], tmp_path: Path) -> None:
    here = tmp_path / "here"
    root = write_root(here / "cityscapes")
    copy = Path(shutil.copytree(exports[0], here / "export"))
    merge_cityscapes(root, [copy], here / "merged")
    here.rename(tmp_path / "there")
    assert len(drawn(tmp_path / "there" / "merged")[TRAIN_ID["sky"]]) == 14
    for name in (merged.CONTENTS, *NAMES):
        assert str(tmp_path) not in (tmp_path / "there" / "merged" / name).read_text()


def test_a_root_of_links_is_followed(root: Path, exports: list[Path], tmp_path: Path) -> None:
    farm = tmp_path / "farm"
    farm.mkdir()
    for part in ("leftImg8bit", "gtFine"):
        (farm / part).symlink_to(root / part)
    report = merge_cityscapes(farm, exports, tmp_path / "out")
    assert report.samples == 18


def test_exports_alone_are_merged(exports: list[Path], out: Path) -> None:
    report = merge_cityscapes(exports[0], exports[1:], out)
    assert (report.samples, report.exported, report.counted) == (8, 4, 0)
    assert len(drawn(out)[TRAIN_ID["sky"]]) == 8


def test_a_root_without_train_ids_is_refused_with_the_cure(
    root: Path, exports: list[Path], out: Path
) -> None:
    next((root / "gtFine" / "train").rglob("*_labelTrainIds.png")).unlink()
    with pytest.raises(
        DataError, match=r"1 of 10 .*run `python tools/convert_datasets/cityscapes.py"
    ):
        merge_cityscapes(root, exports, out)
    with pytest.raises(DataError, match="is no Cityscapes root"):
        merge_cityscapes(root / "gtFine", exports, out)
    assert not out.exists()


def test_one_base_name_for_two_labels_is_refused(
    root: Path, exports: list[Path], out: Path
) -> None:
    with pytest.raises(ConflictError, match="have one base name"):
        merge_cityscapes(root, [exports[0], exports[0]], out)
    other = root / "leftImg8bit" / "train" / "other"
    shutil.copytree(root / "leftImg8bit" / "train" / "aachen", other)
    shutil.copytree(root / "gtFine" / "train" / "aachen", root / "gtFine" / "train" / "other")
    with pytest.raises(ConflictError, match="have one base name"):
        merge_cityscapes(root, exports, out)


def test_exports_that_are_no_labelled_source_are_refused(
    root: Path, exports: list[Path], scene: WeatherScene, tmp_path: Path
) -> None:
    out = tmp_path / "merged"
    gta, val, bare = tmp_path / "gta", tmp_path / "val", tmp_path / "bare"
    export(plan_export([scene], POLICY, count=1, seed=0, layout="gta"), gta)
    export(plan_export([scene], POLICY, count=1, seed=0, split="val"), val)
    unlabelled = WeatherScene.build(TinyClip(labelled=False), tmp_path / "scene")
    export(plan_export([unlabelled], POLICY, count=1, seed=0), bare)
    for path, words in [
        (gta, "the layout gta; a labelled source needs cityscapes"),
        (val, "the split val; a labelled source needs train"),
        (bare, "1 samples without a label"),
    ]:
        with pytest.raises(ArgumentError, match=words):
            merge_cityscapes(root, [path], out)
    with pytest.raises(DataError, match="is no finished export"):
        merge_cityscapes(root, [tmp_path / "nowhere"], out)
    assert not out.exists()


def test_damaged_and_unfinished_exports_are_refused(
    root: Path, exports: list[Path], out: Path, tmp_path: Path
) -> None:
    def lose_a_picture(copy: Path) -> None:
        next(copy.rglob("*_leftImg8bit.png")).unlink()

    def cut_a_label(copy: Path) -> None:
        label = next(copy.rglob("*_labelTrainIds.png"))
        label.write_bytes(label.read_bytes()[:-1])

    def forge(copy: Path) -> None:
        (copy / "manifest.jsonl").write_text("")

    def reopen(copy: Path) -> None:
        (copy / "export.json").unlink()

    for number, (damage, error) in enumerate(
        [
            (lose_a_picture, IntegrityError),
            (cut_a_label, IntegrityError),
            (forge, IntegrityError),
            (reopen, DataError),
        ]
    ):
        copy = Path(shutil.copytree(exports[0], tmp_path / str(number)))
        damage(copy)
        with pytest.raises(error, match=r"is damaged|is no finished export"):
            merge_cityscapes(root, [copy], out)
    assert not out.exists()


def test_outputs_that_are_not_a_merge_are_left_alone(
    root: Path, exports: list[Path], tmp_path: Path
) -> None:
    mine = tmp_path / "mine"
    (mine / "leftImg8bit").mkdir(parents=True)
    (mine / "merge.json").write_text("{}")
    for out, error, words in [
        (mine, ConflictError, "is no merge, but holds leftImg8bit"),
        (root, OutputError, "lies inside"),
        (root / "merged", OutputError, "lies inside"),
        (exports[0] / "merged", OutputError, "lies inside"),
        (next(root.rglob("*.png")), OutputError, "lies inside"),
        (tmp_path, ConflictError, "is no merge"),
    ]:
        before = state(root, *exports, mine)
        with pytest.raises(error, match=words):
            merge_cityscapes(root, exports, out)
        assert state(root, *exports, mine) == before


def test_a_file_of_somebody_else_in_a_merge_is_kept(
    root: Path, exports: list[Path], out: Path
) -> None:
    merge_cityscapes(root, exports, out)
    note = out / "gtFine" / "note.txt"
    note.write_text("mine")
    before = tree_of(out)
    with pytest.raises(ConflictError, match=r"note.txt is not of this merge"):
        merge_cityscapes(root, exports[:1], out)
    assert tree_of(out) == before
    note.unlink()
    link = next((out / "leftImg8bit").rglob("*.png"))
    link.unlink()
    link.write_bytes(b"mine")
    with pytest.raises(ConflictError, match="is not of this merge"):
        merge_cityscapes(root, exports, out)
    assert link.read_bytes() == b"mine"


def test_a_linked_folder_in_a_merge_does_not_lead_into_the_root(
    root: Path, exports: list[Path], out: Path
) -> None:
    merge_cityscapes(root, exports, out)
    whole = tree_of(out)
    train = out / "leftImg8bit" / "train"
    shutil.rmtree(train)
    train.symlink_to(root / "leftImg8bit" / "train")
    before = state(root)
    merge_cityscapes(root, exports, out)
    assert state(root) == before
    assert tree_of(out) == whole


@pytest.mark.parametrize("after", [0, 1, 20, 60])
def test_a_merge_cut_short_is_completed(
    root: Path,
    exports: list[Path],
    out: Path,
    tmp_path: Path,
    after: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    merge_cityscapes(root, exports, tmp_path / "whole")
    real, left = merge._linked, iter(range(after))

    def stopped(*arguments: Any) -> bool:
        if next(left, None) is None:
            raise KeyboardInterrupt
        return real(*arguments)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(merge, "_linked", stopped)
        merge_cityscapes(root, exports, out)
    assert not any((out / name).exists() for name in NAMES)
    merge_cityscapes(root, exports, out)
    assert tree_of(out) == tree_of(tmp_path / "whole")


def test_a_merge_in_use_is_refused(root: Path, exports: list[Path], out: Path) -> None:
    from weather_aug import _lock

    with (
        _lock.exclusive(out / ".merge.lock", "busy"),
        pytest.raises(ConflictError, match=f"is being merged by process {os.getpid()}"),
    ):
        merge_cityscapes(root, exports, out)
    merge_cityscapes(root, exports, out)


def test_hard_links_across_disks_name_the_cure(
    root: Path, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def across(*_: object) -> None:
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr(Path, "hardlink_to", across)
    with pytest.raises(OutputError, match="make symbolic links instead"):
        merge_cityscapes(root, [], out, hard=True)


def test_a_merge_that_believes_every_class_would_be_noticed(
    root: Path, exports: list[Path], out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(merge.ClassStats, "kept", tuple(range(19)))
    merge_cityscapes(root, exports, out)
    with pytest.raises((AssertionError, KeyError)):
        drawn(out)


def test_the_command_merges_and_names_dropped_classes(
    root: Path, exports: list[Path], out: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["merge", str(root), *map(str, exports), "--out", str(out)])
    told = capsys.readouterr()
    assert "18 labelled pictures (10 + 8) in" in told.out
    assert "61 links made, 0 removed" in told.out
    assert "leaves out" in told.err
    assert "rider" in told.err
    with pytest.raises(SystemExit) as ended:
        main(["merge", str(root), str(exports[0]), "--out", str(root / "x")])
    assert ended.value.code == 6
