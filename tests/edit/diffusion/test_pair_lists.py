"""Lists of data sets: their own split, day only, the right label, draws by the key."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tyro
from pair_trees import (
    acdc_tree,
    bdd100k_tree,
    muses_tree,
    plain_tree,
    save,
    save_label,
)

from weather_aug.cli.pairs import ListPairs
from weather_aug.edit.diffusion import pair_lists as module
from weather_aug.edit.diffusion.leakage import check_no_leak, digests_of, leaks
from weather_aug.edit.diffusion.pair_lists import (
    acdc_pairs,
    bdd100k_pairs,
    folder_pairs,
    muses_pairs,
)
from weather_aug.edit.diffusion.pairs import Pair, PairList, read_pairs
from weather_aug.errors import ArgumentError, DataError

Tree = Callable[[Path], Path]
Builder = Callable[..., PairList]
SETS = [
    (acdc_tree, acdc_pairs),
    (muses_tree, muses_pairs),
    (bdd100k_tree, bdd100k_pairs),
    (plain_tree, folder_pairs),
]
DRAWN = SETS[1:]


@pytest.fixture
def acdc(tmp_path: Path) -> Path:
    return acdc_tree(tmp_path / "acdc")


@pytest.fixture
def muses(tmp_path: Path) -> Path:
    return muses_tree(tmp_path / "muses")


@pytest.fixture
def bdd100k(tmp_path: Path) -> Path:
    return bdd100k_tree(tmp_path / "bdd100k")


@pytest.fixture
def plain(tmp_path: Path) -> Path:
    return plain_tree(tmp_path / "plain")


def of_target(listed: PairList, target: str) -> Pair:
    (found,) = [pair for pair in listed.pairs if pair.target == target]
    return found


def checked(listed: PairList) -> PairList:
    """Every promise that all builders make."""
    for pair in listed.pairs:
        for path, file, pixels in (
            (pair.source, pair.source_sha256, pair.source_pixels_sha256),
            (pair.target, pair.target_sha256, pair.target_pixels_sha256),
        ):
            assert digests_of(listed.file(path)) == (file, pixels)
            assert "night" not in path
        for label in (pair.source_label, pair.target_label):
            assert label is None or listed.file(label).suffix == ".png"
        for path in (pair.source, pair.target, pair.source_label, pair.target_label):
            split = {"train", "val", "test"} & {
                part.removesuffix("_ref") for part in (path or pair.source).split("/")
            }
            assert split == {pair.split}
    assert len({pair.target for pair in listed.pairs}) == len(listed.pairs)
    check_no_leak(listed)
    return listed


@pytest.mark.parametrize(("tree", "builder"), SETS)
def test_every_set_keeps_its_split_and_its_pictures(
    tree: Tree, builder: Builder, tmp_path: Path
) -> None:
    listed = checked(builder(tree(tmp_path)))
    assert listed.styles == ("rain", "snow", "fog")
    assert set(listed.counts()) >= {(s, t) for s in listed.styles for t in ("train", "val")}


@pytest.mark.parametrize(("tree", "builder"), SETS)
def test_a_list_is_the_same_wherever_the_set_lies(
    tree: Tree, builder: Builder, tmp_path: Path
) -> None:
    one = builder(tree(tmp_path / "one"))
    shutil.copytree(tmp_path / "one", tmp_path / "two")
    assert builder(tmp_path / "two").pairs == one.pairs


@pytest.mark.parametrize(("tree", "builder"), SETS)
def test_a_folder_that_is_no_such_set_says_what_was_expected(
    tree: Tree, builder: Builder, tmp_path: Path
) -> None:
    with pytest.raises(DataError, match=r"holds n.*(train|labels)"):
        builder(tmp_path)


@pytest.mark.parametrize(("tree", "builder"), SETS)
def test_a_damaged_picture_is_named(tree: Tree, builder: Builder, tmp_path: Path) -> None:
    target = tmp_path / builder(tree(tmp_path)).pairs[0].target
    target.write_bytes(target.read_bytes()[:-30])
    with pytest.raises(DataError, match=rf"{target.name} is truncated"):
        builder(tmp_path)


@pytest.mark.parametrize(("tree", "builder"), SETS)
def test_a_link_is_not_followed(tree: Tree, builder: Builder, tmp_path: Path) -> None:
    root = tree(tmp_path / "set")
    target = root / builder(root).pairs[0].target
    target.rename(tmp_path / "outside.png")
    target.symlink_to(tmp_path / "outside.png")
    with pytest.raises(DataError, match="is a link"):
        builder(root)


def test_acdc_pairs_a_picture_with_its_reference_frame(acdc: Path) -> None:
    listed = acdc_pairs(acdc)
    assert listed.counts() == {
        (style, split): 2 for style in ("rain", "snow", "fog") for split in ("train", "val", "test")
    }
    pair = of_target(listed, "rgb_anon/rain/train/GOPR01/GOPR01_frame_000011_rgb_anon.png")
    assert pair.source == "rgb_anon/rain/train_ref/GOPR01/GOPR01_frame_000011_rgb_ref_anon.png"
    assert pair.target_label == "gt/rain/train/GOPR01/GOPR01_frame_000011_gt_labelTrainIds.png"
    assert (
        pair.source_label == "gt/rain/train_ref/GOPR01/GOPR01_frame_000011_gt_ref_labelTrainIds.png"
    )
    assert not any(pair.aligned for pair in listed.pairs)
    unlabelled = of_target(listed, "rgb_anon/fog/val/GOPR02/GOPR02_frame_000012_rgb_anon.png")
    assert unlabelled.source_label is None
    assert unlabelled.target_label is not None
    assert all(pair.target_label is None for pair in listed.selected("test").pairs)


def test_acdc_without_a_reference_frame_is_refused(acdc: Path) -> None:
    next((acdc / "rgb_anon/snow/val_ref").rglob("*.png")).unlink()
    with pytest.raises(DataError, match=r"_rgb_ref_anon.png is missing; unpack the reference"):
        acdc_pairs(acdc)


def test_muses_draws_a_clear_picture_by_day_of_the_same_split(muses: Path) -> None:
    listed = muses_pairs(muses)
    assert sum(listed.counts().values()) == 3 * 3 * 2
    for pair in listed.pairs:
        assert pair.source.startswith(f"frame_camera/{pair.split}/clear/day/")
        assert pair.target.startswith(f"frame_camera/{pair.split}/{pair.style}/day/")
        if pair.split == "test":
            assert (pair.source_label, pair.target_label) == (None, None)
        else:
            stem = pair.target.removeprefix("frame_camera/").removesuffix("_frame_camera.png")
            assert pair.target_label == f"gt_semantic/{stem}_gt_labelTrainIds.png"
            assert pair.source_label is not None
        assert not pair.aligned


@pytest.mark.parametrize(
    "labels", ["det_20/det_{split}.json", "bdd100k_labels_images_{split}.json"]
)
def test_bdd100k_goes_by_the_attributes(tmp_path: Path, labels: str) -> None:
    root = bdd100k_tree(tmp_path, f"labels/{labels}")
    for images in ("10k", "100k"):
        # Nothing overlaps, so that both sets can be listed whole.
        listed = checked(bdd100k_pairs(root, images=images))
        letters = {"rain": "r", "snow": "s", "fog": "f"}
        for pair in listed.pairs:
            folder = f"images/{images}/{pair.split}/both-{pair.split}"
            assert pair.target == f"{folder}-{letters[pair.style]}-daytime.jpg"
            assert pair.source in (f"{folder}-c-daytime.jpg", f"{folder}-p-daytime.jpg")
            mask = f"labels/sem_seg/masks/{pair.split}/{Path(pair.target).stem}.png"
            assert pair.target_label == (mask if images == "10k" else None)
        # Nobody tells the weather of the test pictures.
        assert {pair.split for pair in listed.pairs} == {"train", "val"}


@pytest.mark.parametrize("images", ["10k", "100k"])
@pytest.mark.parametrize("split", ["val", "test"])
def test_bdd100k_does_not_train_on_what_the_other_set_holds_out(
    bdd100k: Path, images: str, split: str
) -> None:
    name = "both-train-r-daytime.jpg"
    other = bdd100k / "images" / ("100k" if images == "10k" else "10k")
    assert of_target(bdd100k_pairs(bdd100k, images=images), f"images/{images}/train/{name}")
    (other / "train" / name).rename(other / split / name)
    listed = bdd100k_pairs(bdd100k, images=images)
    assert all(Path(pair.target).name != name for pair in listed.pairs)


def test_bdd100k_knows_the_other_set_by_its_labels_alone(bdd100k: Path) -> None:
    """Where only one set of pictures was unpacked, attribute files and masks tell its split."""
    name = "both-train-s-daytime"
    shutil.rmtree(bdd100k / "images/100k")
    path = bdd100k / "labels/det_20/det_val.json"
    entries = json.loads(path.read_text())
    entries.append({"name": f"{name}.jpg", "attributes": {}})
    path.write_text(json.dumps(entries))
    listed = bdd100k_pairs(bdd100k, images="10k")
    assert name not in {Path(pair.target).stem for pair in listed.pairs}


def test_bdd100k_masks_tell_the_10k_split(bdd100k: Path) -> None:
    name = "both-train-f-daytime"
    shutil.rmtree(bdd100k / "images/10k")
    (bdd100k / f"labels/sem_seg/masks/train/{name}.png").rename(
        bdd100k / f"labels/sem_seg/masks/val/{name}.png"
    )
    listed = bdd100k_pairs(bdd100k, images="100k")
    assert name not in {Path(pair.target).stem for pair in listed.pairs}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{}", "not a whole JSON array"),
        ("", "not a whole JSON array"),
        ('[{"name": "a", "attributes": {}}', "not a whole JSON array"),
        ("[{]", "not a whole JSON array"),
        ("[1]", "not a whole JSON array"),
        ("[" * 100_000, "not a whole JSON array"),
        ('[{"name": "a.jpg"}]', "entry without name or attributes"),
        ('[{"name": 1, "attributes": {}}]', "entry without name or attributes"),
        ('["\ud800"]', "not UTF-8"),
    ],
)
def test_bdd100k_attributes_that_cannot_be_read_are_named(
    bdd100k: Path, text: str, said: str
) -> None:
    path = bdd100k / "labels/det_20/det_train.json"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(DataError, match=rf"det_train.json.*{said}"):
        bdd100k_pairs(bdd100k)


@pytest.mark.parametrize("chars", [1, 7, 64, 10_000])
def test_attributes_are_read_piece_by_piece(
    bdd100k: Path, monkeypatch: pytest.MonkeyPatch, chars: int
) -> None:
    path = bdd100k / "labels/det_20/det_train.json"
    expected = json.loads(path.read_text())
    monkeypatch.setattr(module, "_READ_CHARS", chars)
    assert list(module._entries(path)) == expected
    path.write_text(json.dumps(expected, separators=(",", ":")))
    assert list(module._entries(path)) == expected


def test_an_endless_entry_is_given_up(bdd100k: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = bdd100k / "labels/det_20/det_train.json"
    path.write_text('[{"name": "' + "a" * 10_000 + '"}]')
    monkeypatch.setattr(module, "_READ_CHARS", 100)
    monkeypatch.setattr(module, "MAX_ENTRY_CHARS", 1000)
    with pytest.raises(DataError, match="not a whole JSON array"):
        list(module._entries(path))


def test_an_unknown_set_of_pictures_is_refused(bdd100k: Path) -> None:
    with pytest.raises(ArgumentError, match="10k or 100k"):
        bdd100k_pairs(bdd100k, images="1k")  # type: ignore[arg-type]


def test_plain_folders_are_aligned_by_name(plain: Path) -> None:
    listed = folder_pairs(plain)
    assert listed.counts() == {
        ("rain", "train"): 3,
        ("rain", "val"): 3,
        ("snow", "train"): 2,
        ("snow", "val"): 2,
        ("fog", "train"): 2,
        ("fog", "val"): 2,
    }
    for pair in listed.pairs:
        name = Path(pair.target).name
        assert pair.aligned == (name != "elsewhere.png")
        if pair.aligned:
            assert pair.source == f"clear/{pair.split}/{name}"
            assert pair.source_label == pair.target_label == f"labels/{pair.split}/{name}"
        else:
            assert pair.target_label is None
            assert pair.source_label == pair.source.replace("clear", "labels")


def test_plain_folders_take_jpeg_and_refuse_two_of_one_name(plain: Path) -> None:
    (plain / "rain/train/a.png").unlink()
    save(plain / "rain/train/a.JPG")
    assert of_target(folder_pairs(plain), "rain/train/a.JPG").source == "clear/train/a.png"
    save(plain / "clear/train/a.jpg")
    with pytest.raises(DataError, match="differ in their suffix alone"):
        folder_pairs(plain)


@pytest.mark.parametrize(("tree", "builder"), DRAWN)
def test_a_weather_without_clear_pictures_is_refused(
    tree: Tree, builder: Builder, tmp_path: Path
) -> None:
    root = tree(tmp_path)
    for pair in builder(root).selected("val").pairs:
        folder = (root / pair.source).parent
        for path in folder.glob("*-[cp]-*" if builder is bdd100k_pairs else "*"):
            path.unlink()
    with pytest.raises(DataError, match="no clear picture of the split val"):
        builder(root)


@pytest.mark.parametrize(("tree", "builder"), DRAWN)
def test_a_seed_must_be_an_integer(tree: Tree, builder: Builder, tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match="seed must be an integer"):
        builder(tree(tmp_path), seed=0.5)


def many(root: Path, weather: str, count: int) -> None:
    for number in range(count):
        tiny = np.full((8, 8, 3), number, np.uint8)
        tiny[0, 0] = ("clear", "rain", "snow").index(weather)
        save(root / f"frame_camera/train/{weather}/day/{number:03d}_frame_camera.png", tiny)


def test_draws_hang_on_the_seed_and_the_picture_alone(tmp_path: Path) -> None:
    many(tmp_path, "clear", 6)
    many(tmp_path, "rain", 120)
    sources = {pair.target: pair.source for pair in muses_pairs(tmp_path).pairs}
    times = Counter(sources.values())
    # 120 draws of 6: 20 each, give or take four standard deviations.
    assert len(times) == 6
    assert all(abs(count - 20) < 4 * 4.1 for count in times.values())
    other = {pair.target: pair.source for pair in muses_pairs(tmp_path, seed=1).pairs}
    assert sum(sources[target] == other[target] for target in sources) < 50
    for target in list(sources)[:60]:
        (tmp_path / target).unlink()
    many(tmp_path, "snow", 3)
    fewer = {p.target: p.source for p in muses_pairs(tmp_path).pairs if p.style == "rain"}
    assert fewer == {target: sources[target] for target in fewer}
    assert len(fewer) == 60


def test_a_draw_across_splits_is_caught(muses: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The planted fault: clear pictures of all splits in one pot. The leakage check sees it."""
    real = module._unpaired

    def pooled(pictures, label, seed):  # type: ignore[no-untyped-def]
        clear = sorted(
            path for (style, _), paths in pictures.items() for path in paths if style == "clear"
        )
        return real(pictures | {("clear", split): clear for split in module.SPLITS}, label, seed)

    monkeypatch.setattr(module, "_unpaired", pooled)
    listed = muses_pairs(muses)
    assert leaks(listed)
    with pytest.raises(AssertionError):
        checked(listed)


def test_the_command_lists_and_counts(
    plain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "lists" / "pairs.jsonl"
    ListPairs("folder", plain, out).run()
    assert read_pairs(out) == folder_pairs(plain)
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "rain: 3 train, 3 val, 0 test"
    assert said[-1] == f"14 pairs (12 aligned, 12 with both labels) in {out}"


@pytest.mark.parametrize(("tree", "builder"), SETS)
def test_the_command_knows_every_set(
    tree: Tree, builder: Builder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tree(tmp_path / "set")
    name = builder.__name__.removesuffix("_pairs")
    ListPairs(name, root, tmp_path / "pairs.jsonl").run()
    assert read_pairs(tmp_path / "pairs.jsonl").pairs == builder(root).pairs


def test_the_command_refuses_leaks_or_leaves_them_out(
    plain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "pairs.jsonl"
    shutil.copy(plain / "snow/train/a.png", plain / "rain/val/again.png")
    with pytest.raises(DataError, match=r"rain/val/again.png \(val\) is the file snow/train/a.png"):
        ListPairs("folder", plain, out).run()
    assert not out.exists()
    ListPairs("folder", plain, out, drop_leaks=True).run()
    assert capsys.readouterr().out.startswith("1 training pairs left out")
    assert all(pair.target != "snow/train/a.png" for pair in read_pairs(out).pairs)
    judged = shutil.copy(plain / "fog/train/b.png", tmp_path / "judged.png")
    with pytest.raises(DataError, match=r"judged.png is the file fog/train/b.png"):
        ListPairs("folder", plain, out, held_out=(Path(judged),)).run()


def test_the_command_is_typed(plain: Path, tmp_path: Path) -> None:
    out = tmp_path / "pairs.jsonl"
    words = ["folder", str(plain), "--out", str(out), "--held-out", "a", "b", "--drop-leaks"]
    command = tyro.cli(ListPairs, args=words)
    expected = ListPairs("folder", plain, out, (Path("a"), Path("b")), drop_leaks=True)
    assert command == expected


def test_the_command_refuses_flags_that_mean_nothing(acdc: Path, tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match="--images is for bdd100k"):
        ListPairs("acdc", acdc, tmp_path / "pairs.jsonl", images="100k").run()
    with pytest.raises(ArgumentError, match="--seed is not for acdc"):
        ListPairs("acdc", acdc, tmp_path / "pairs.jsonl", seed=1).run()


def test_labels_of_train_ids_are_taken_not_raw_ids(acdc: Path, muses: Path) -> None:
    for listed in (acdc_pairs(acdc), muses_pairs(muses)):
        labels = {p.target_label for p in listed.pairs} | {p.source_label for p in listed.pairs}
        assert all(label is None or label.endswith("abelTrainIds.png") for label in labels)


def test_a_label_that_is_a_link_is_refused(plain: Path, tmp_path: Path) -> None:
    label = plain / "labels/train/a.png"
    save_label(tmp_path / "outside.png")
    label.unlink()
    label.symlink_to(tmp_path / "outside.png")
    with pytest.raises(DataError, match="is a link"):
        folder_pairs(plain)
