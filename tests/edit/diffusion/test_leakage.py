"""No picture is trained on and held out: the same file, or the same pixels in another file."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pair_trees import list_of, pair_of, picture, save, stored_again

from weather_aug.edit.diffusion import leakage
from weather_aug.edit.diffusion.leakage import (
    TRAINED_ON,
    Digests,
    TrainedOn,
    check_no_leak,
    digests_by_path,
    digests_of,
    leaks,
    pictures_in,
    without_leaks,
)
from weather_aug.edit.diffusion.pairs import PairList
from weather_aug.errors import ArgumentError, DataError, IntegrityError, OutputError


@pytest.fixture
def clean(tmp_path: Path) -> PairList:
    """Two training pairs, one to validate and one to test; all pictures differ."""
    root = tmp_path / "data"
    return list_of(
        root,
        pair_of(root, "clear/1.png", "rain/1.png"),
        pair_of(root, "clear/2.png", "snow/2.png", style="snow"),
        pair_of(root, "clear/3.png", "rain/3.png", split="val"),
        pair_of(root, "clear/4.png", "fog/4.png", style="fog", split="test"),
    )


def with_pair(whole: PairList, source: str, target: str, split: str) -> PairList:
    return replace(whole, pairs=(*whole.pairs, pair_of(whole.root, source, target, split=split)))


def test_a_set_without_leaks_passes(clean: PairList, tmp_path: Path) -> None:
    held_out = [save(tmp_path / "other" / "5.png"), clean.root / "fog", clean.root / "rain/3.png"]
    assert leaks(clean) == []
    assert leaks(clean, held_out) == []
    check_no_leak(clean, held_out)
    assert without_leaks(clean, held_out) == clean


@pytest.mark.parametrize("split", ["val", "test"])
@pytest.mark.parametrize("seen", ["clear/1.png", "rain/1.png", "snow/2.png"])
def test_a_copy_of_a_training_picture_is_found(clean: PairList, split: str, seen: str) -> None:
    (clean.root / "held").mkdir()
    shutil.copy(clean.root / seen, clean.root / "held/copy.png")
    leaky = with_pair(clean, "held/copy.png", "rain/5.png", split)
    assert leaks(leaky) == [f"held/copy.png ({split}) is the file {seen} (train)"]


def test_the_same_pixels_in_another_file_are_found(clean: PairList) -> None:
    again = stored_again(clean.root / "rain/1.png", clean.root / "held/again.png")
    assert digests_of(again).file != digests_of(clean.root / "rain/1.png").file
    leaky = with_pair(clean, "clear/5.png", "held/again.png", "val")
    assert leaks(leaky) == ["held/again.png (val) has the pixels of rain/1.png (train)"]


def test_a_picture_that_was_changed_is_another_one(clean: PairList) -> None:
    """One value of one pixel, and the same values in another shape."""
    image = picture("x")
    one = save(clean.root / "x.png", image)
    two = image.copy()
    two[3, 4, 1] ^= 1
    other = save(clean.root / "y.png", two)
    shape = save(clean.root / "z.png", image.reshape(image.shape[1], image.shape[0], 3))
    found = [digests_of(path) for path in (one, other, shape)]
    assert len({digests.pixels for digests in found}) == 3
    assert len({digests.file for digests in found}) == 3


def test_pictures_elsewhere_are_held_out_too(clean: PairList, tmp_path: Path) -> None:
    judged = tmp_path / "judged" / "deep" / "picture.png"
    stored_again(clean.root / "snow/2.png", judged)
    save(tmp_path / "judged" / "new.png")
    found = leaks(clean, [tmp_path / "judged"])
    assert found == [f"{judged} has the pixels of snow/2.png (train)"]


def test_a_list_that_leaks_is_refused_with_its_cure(clean: PairList) -> None:
    leaky = clean
    for number in range(5):
        name = f"held/{number}.png"
        stored_again(clean.root / "rain/1.png", clean.root / name)
        leaky = with_pair(leaky, name, f"rain/1{number}.png", "val")
    with pytest.raises(DataError) as caught:
        check_no_leak(leaky)
    said = str(caught.value)
    assert said.startswith("5 held-out pictures of 'tiny' are trained on: held/0.png (val)")
    assert "held/2.png" in said
    assert "held/3.png" not in said
    assert "and 2 more; take them out" in said


def test_training_pairs_with_a_held_out_picture_are_left_out(
    clean: PairList, tmp_path: Path
) -> None:
    again = stored_again(clean.root / "rain/1.png", clean.root / "held/again.png")
    leaky = with_pair(clean, "clear/5.png", "held/again.png", "val")
    kept = without_leaks(leaky)
    assert kept.pairs == leaky.pairs[1:]
    check_no_leak(kept)
    assert without_leaks(clean, [again]).pairs == clean.pairs[1:]
    only = replace(clean, pairs=clean.pairs[:1])
    with pytest.raises(ArgumentError, match="every pair"):
        without_leaks(only, [again])


@settings(max_examples=50)
@given(st.data())
def test_leaks_are_those_of_brute_force(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    """Digests drawn from so few that they meet; compared pair by pair."""
    root = tmp_path_factory.getbasetemp()
    few = st.integers(0, 3).map(lambda number: f"{number:064x}")
    more = st.integers(8, 11).map(lambda number: f"{number:064x}")
    base = pair_of(root, "base/a.png", "base/b.png")
    pairs = []
    for number in range(data.draw(st.integers(1, 5))):
        pairs.append(
            replace(
                base,
                source=f"{number}/a.png",
                target=f"{number}/b.png",
                split=data.draw(st.sampled_from(["train", "val", "test"])),
                source_sha256=data.draw(few),
                target_sha256=data.draw(few),
                source_pixels_sha256=data.draw(more),
                target_pixels_sha256=data.draw(more),
            )
        )
    pictures = [
        (path, pair.split, {file, pixels})
        for pair in pairs
        for path, file, pixels in (
            (pair.source, pair.source_sha256, pair.source_pixels_sha256),
            (pair.target, pair.target_sha256, pair.target_pixels_sha256),
        )
    ]
    expected = {
        path
        for path, split, known in pictures
        if split != "train"
        and any(known & other for _, where, other in pictures if where == "train")
    }
    found = leaks(PairList("drawn", root, tuple(pairs)))
    assert {sentence.split(" ")[0] for sentence in found} == expected
    assert len(found) == len(expected)


def test_broken_digests_let_a_leak_through(
    clean: PairList, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The planted fault: without a digest of pixels a stored-again picture is not found."""
    judged = stored_again(clean.root / "rain/1.png", tmp_path / "judged.png")
    assert len(leaks(clean, [judged])) == 1
    real = digests_of

    def files_only(path: Path) -> Digests:
        return real(path)._replace(pixels=f"{hash(path) % 16**64:064x}")

    monkeypatch.setattr(leakage, "digests_of", files_only)
    assert leaks(clean, [judged]) == []
    assert TrainedOn.of(clean).overlap([judged]) == []


def test_digests_come_in_order_whatever_the_threads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(leakage, "_CHUNK", 3)
    paths = [save(tmp_path / f"{number}.png") for number in range(8)]
    assert list(digests_by_path(paths)) == [(path, digests_of(path)) for path in paths]


def test_a_large_set_is_streamed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of an endless set no more is asked for than one chunk."""
    monkeypatch.setattr(leakage, "_CHUNK", 2)
    path = save(tmp_path / "a.png")
    asked = 0

    def endless():
        nonlocal asked
        while True:
            asked += 1
            yield path

    stream = digests_by_path(endless())
    for _ in range(3):
        next(stream)
    stream.close()
    assert asked <= 4


def test_places_are_pictures_or_folders_of_them(tmp_path: Path) -> None:
    one, two = save(tmp_path / "set/b/one.JPG"), save(tmp_path / "set/two.png")
    (tmp_path / "set/notes.txt").write_text("no picture")
    (tmp_path / "set/folder.png").mkdir()
    assert list(pictures_in([tmp_path / "set", two])) == [one, two, two]
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="holds no PNG or JPEG"):
        list(pictures_in([tmp_path / "empty"]))
    with pytest.raises(DataError, match="neither a picture nor a folder"):
        list(pictures_in([tmp_path / "none"]))
    (tmp_path / "set/broken.png").write_bytes(two.read_bytes()[:-20])
    with pytest.raises(DataError, match=r"broken.png is truncated"):
        list(digests_by_path(pictures_in([tmp_path / "set"])))


def test_linked_folders_are_followed_and_entered_once(tmp_path: Path) -> None:
    """Validation sets are often put together of links; one that is skipped would look clean."""
    one, two = save(tmp_path / "disk/fog/one.png"), save(tmp_path / "disk/rain/two.png")
    (tmp_path / "val").mkdir()
    (tmp_path / "val/fog").symlink_to(one.parent)
    (tmp_path / "val/rain.png").symlink_to(two)
    (tmp_path / "disk/fog/round").symlink_to(tmp_path / "disk")
    found = list(pictures_in([tmp_path / "val"]))
    assert found == sorted(found) and {path.resolve() for path in found} == {one, two}
    assert sum(path.resolve() == one for path in found) == 1


def test_a_folder_that_cannot_be_listed_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save(tmp_path / "val/one.png")
    (tmp_path / "val/closed").mkdir()
    real = os.scandir

    def scandir(path: Any) -> Any:
        if str(path).endswith("closed"):
            raise PermissionError(13, "Permission denied", str(path))
        return real(path)

    monkeypatch.setattr(os, "scandir", scandir)
    with pytest.raises(DataError, match="closed: Permission denied"):
        list(pictures_in([tmp_path / "val"]))


def test_an_adapter_knows_what_it_was_trained_on(clean: PairList, tmp_path: Path) -> None:
    trained = TrainedOn.of(clean)
    trained.write(tmp_path)
    assert TrainedOn.read(tmp_path) == trained
    header, *lines = (tmp_path / TRAINED_ON).read_text().splitlines()
    assert header.startswith("#")
    assert lines == sorted(lines)
    assert len(lines) == 2 * 2 * 2
    assert all(re.fullmatch("[0-9a-f]{64}", line) for line in lines)
    assert not trained.digests & {clean.pairs[2].source_sha256, clean.pairs[3].target_sha256}


def test_pictures_that_the_editor_has_seen_are_named(clean: PairList, tmp_path: Path) -> None:
    trained = TrainedOn.of(clean)
    again = stored_again(clean.root / "clear/2.png", tmp_path / "judged/again.png")
    new = save(tmp_path / "judged/new.png")
    assert trained.overlap(tmp_path / "judged") == [again]
    assert trained.overlap(iter([new, clean.root / "rain/3.png"])) == []
    assert trained.overlap([clean.root / "rain"]) == [clean.root / "rain/1.png"]
    with pytest.raises(ArgumentError, match="no pair of train"):
        TrainedOn.of(clean.selected("val"))


HEADER = leakage.TRAINED_ON_HEADER
LOW, HIGH = "0" * 64, "1" * 64


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no record"),
        (f"{LOW}\n", "no record"),
        (f"{HEADER}\n", "no record"),
        (f"{HEADER}\n{HIGH}\n{LOW}\n", "line 3 is out of order"),
        (f"{HEADER}\n{LOW}\n{LOW}\n", "line 3 is out of order"),
        (f"{HEADER}\n{LOW}\n\n{HIGH}\n", "line 3 must be 64"),
        (f"{HEADER}\n{LOW[:-1]}g\n", "line 2 must be 64"),
        (f"{HEADER}\n{LOW}\ufeff\n", "not ASCII"),
        (f"{HEADER}\n{LOW}", "no record"),
        (f"{HEADER}\r\n{LOW}\r\n", "no record"),
    ],
)
def test_a_damaged_record_is_refused(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / TRAINED_ON).write_bytes(text.encode())
    with pytest.raises(DataError, match=said):
        TrainedOn.read(tmp_path)


def test_a_record_that_is_not_there_or_too_large_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(DataError, match="cannot read"):
        TrainedOn.read(tmp_path)
    with pytest.raises(OutputError):
        TrainedOn(frozenset([LOW])).write(tmp_path / "none")
    with pytest.raises(ArgumentError, match="empty"):
        TrainedOn(frozenset())
    with pytest.raises(ArgumentError, match="64 hexadecimal"):
        TrainedOn(frozenset(["short"]))
    TrainedOn(frozenset([LOW])).write(tmp_path)
    monkeypatch.setattr(leakage, "MAX_TRAINED_ON_BYTES", 10)
    with pytest.raises(DataError, match="larger than 10 bytes"):
        TrainedOn.read(tmp_path)


def test_grey_and_palette_pictures_are_known_by_their_colours(tmp_path: Path) -> None:
    grey = np.arange(96, dtype=np.uint8).reshape(8, 12)
    one = save(tmp_path / "grey.png", grey)
    two = save(tmp_path / "rgb.png", np.stack([grey] * 3, axis=-1))
    assert digests_of(one).pixels == digests_of(two).pixels
    assert digests_of(one).file != digests_of(two).file


def test_equal_records_have_equal_bytes_and_their_digest_is_compared(tmp_path: Path) -> None:
    one, two = TrainedOn(frozenset([LOW])), TrainedOn(frozenset([HIGH, LOW]))
    assert TrainedOn.union([one, two, one]) == two
    assert TrainedOn.union([TrainedOn(frozenset([HIGH])), one]).as_bytes() == two.as_bytes()
    with pytest.raises(ArgumentError, match="empty"):
        TrainedOn.union([])
    two.write(tmp_path)
    path = tmp_path / TRAINED_ON
    assert path.read_bytes() == two.as_bytes()
    noted = hashlib.sha256(two.as_bytes()).hexdigest()
    assert TrainedOn.read_file(path, noted) == two
    # Still a record, of another picture.
    path.write_bytes(two.as_bytes().replace(HIGH.encode(), HIGH[:-1].encode() + b"2"))
    assert TrainedOn.read_file(path) != two
    with pytest.raises(IntegrityError, match=r"trained_on\.txt has changed"):
        TrainedOn.read_file(path, noted)
