"""The pair list on disk: what was written is read, and what is no list is refused by its line."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pair_trees import list_of, pair_of

from weather_aug import _files
from weather_aug.edit.diffusion import pairs as module
from weather_aug.edit.diffusion.pairs import (
    PAIR_STYLES,
    SPLITS,
    Pair,
    PairList,
    joined,
    read_pairs,
    told_counts,
    with_clear,
    write_pairs,
)
from weather_aug.errors import ArgumentError, DataError, OutputError

DIGEST = "0123456789abcdef" * 4
PAIR = Pair("clear/a.png", "rain/a.png", None, "labels/a.png", "rain", "train", True, *[DIGEST] * 4)

NAMES = st.text(
    st.characters(exclude_characters="/\\\0", exclude_categories=["Cs"]), min_size=1, max_size=20
).filter(lambda name: name not in (".", ".."))
PATHS = st.lists(NAMES, min_size=1, max_size=3).map("/".join)
PNGS = st.none() | PATHS.map(lambda path: f"{path}.png")
DIGESTS = st.binary(min_size=32, max_size=32).map(bytes.hex)
PAIRS = st.builds(
    Pair,
    PATHS,
    PATHS,
    PNGS,
    PNGS,
    st.sampled_from(PAIR_STYLES),
    st.sampled_from(SPLITS),
    st.booleans(),
    DIGESTS,
    DIGESTS,
    DIGESTS,
    DIGESTS,
)


@pytest.fixture
def listed(tmp_path: Path) -> Path:
    """A list of two pairs."""
    path = tmp_path / "pairs.jsonl"
    write_pairs(path, PairList("tiny", tmp_path, (PAIR, replace(PAIR, style="snow"))))
    return path


@settings(max_examples=30)  # each waits for the disk
@given(st.lists(PAIRS, min_size=1, max_size=5), NAMES)
def test_what_is_written_is_read(
    tmp_path_factory: pytest.TempPathFactory, pairs: list[Pair], name: str
) -> None:
    folder = tmp_path_factory.getbasetemp()
    whole = PairList(name, folder / "data", tuple(pairs))
    write_pairs(folder / "pairs.jsonl", whole)
    assert read_pairs(folder / "pairs.jsonl") == whole


def test_each_line_after_the_header_is_one_pair(listed: Path) -> None:
    header, *lines = [json.loads(line) for line in listed.read_text().splitlines()]
    assert header == {"format": "weather_aug pairs", "version": 1, "name": "tiny", "root": "."}
    assert [line["style"] for line in lines] == ["rain", "snow"]
    assert list(lines[0]) == [field.name for field in fields(Pair)]


def test_a_list_beside_its_pictures_may_move_and_another_keeps_its_root(tmp_path: Path) -> None:
    inside, outside = tmp_path / "data" / "pairs.jsonl", tmp_path / "lists" / "pairs.jsonl"
    for path in (inside, outside):
        write_pairs(path, PairList("tiny", tmp_path / "data", (PAIR,)))
    (tmp_path / "data").rename(tmp_path / "moved")
    assert read_pairs(tmp_path / "moved" / "pairs.jsonl").root == tmp_path / "moved"
    assert read_pairs(outside).root == tmp_path / "data"
    assert read_pairs(outside, root=tmp_path / "moved").root == tmp_path / "moved"


def test_a_root_does_not_hang_on_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_pairs(Path("pairs.jsonl"), PairList("tiny", Path("data"), (PAIR,)))
    whole = read_pairs(Path("pairs.jsonl"))
    assert whole.root == tmp_path / "data"
    assert os.fspath(whole.root).startswith("/")


Change = Callable[[list[Any]], Any]


def _set(line: int, key: str, value: Any) -> Change:
    return lambda lines: lines[line].__setitem__(key, value)


@pytest.mark.parametrize(
    ("change", "line", "said"),
    [
        (_set(0, "format", "pairs"), 1, "header"),
        (lambda lines: lines.pop(0), 1, "header"),
        (_set(0, "version", 2), 1, "version 2"),
        (_set(0, "more", 1), 1, "'more'"),
        (lambda lines: lines[0].pop("root"), 1, "root is missing"),
        (_set(0, "root", "a\0b"), 1, "root must be text"),
        (_set(0, "root", ""), 1, "root must be text"),
        (_set(0, "name", 3), 1, "name must be text"),
        (_set(1, "source", "../../secret.png"), 2, "source '../../secret.png' is not a plain path"),
        (_set(1, "target", "/etc/passwd"), 2, "target"),
        (_set(2, "target", "a//b.png"), 3, "target"),
        (_set(2, "target", "a\\b.png"), 3, "target"),
        (_set(2, "target", "a\0b.png"), 3, "target"),
        (_set(2, "target", "\ud800.png"), 3, "target"),
        (_set(2, "target", "."), 3, "target"),
        (_set(2, "target", ""), 3, "target"),
        (_set(2, "target", 7), 3, "target"),
        (_set(2, "source", None), 3, "source"),
        (_set(1, "source_label", "labels/a.jpg"), 2, "source_label 'labels/a.jpg' is no PNG"),
        (_set(1, "target_label", "../a.png"), 2, "target_label"),
        (_set(1, "style", "hail"), 2, "style must be one of clear, rain, snow, fog, got 'hail'"),
        (_set(1, "style", ["rain"]), 2, "style"),
        (_set(1, "split", "dev"), 2, "split must be one of train, val, test"),
        (_set(1, "aligned", 1), 2, "aligned must be true or false"),
        (_set(1, "source_sha256", DIGEST.upper()), 2, "source_sha256"),
        (_set(1, "target_sha256", DIGEST[:-1]), 2, "target_sha256"),
        (_set(1, "source_pixels_sha256", None), 2, "source_pixels_sha256"),
        (_set(1, "target_pixels_sha256", "g" * 64), 2, "target_pixels_sha256"),
        (_set(1, "weight", 1), 2, "unknown field 'weight'"),
        (lambda lines: lines[2].pop("split"), 3, "split is missing"),
        (lambda lines: lines.__setitem__(1, [1, 2]), 2, "no JSON object"),
        (lambda lines: lines.__setitem__(1, ""), 2, "no JSON object"),
    ],
)
def test_a_wrong_line_is_named(listed: Path, change: Change, line: int, said: str) -> None:
    lines = [json.loads(text) for text in listed.read_text().splitlines()]
    change(lines)
    listed.write_text("".join(json.dumps(entry) + "\n" for entry in lines))
    with pytest.raises(DataError) as caught:
        read_pairs(listed)
    assert f"pairs.jsonl, line {line}" in str(caught.value)
    assert said in str(caught.value)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (b'{"style": "rain", "style": "rain"}', "same key twice"),
        (b'{"style": NaN}', "NaN"),
        (b'{"style": 1e999}', "not allowed"),
        (b"{", "not valid JSON"),
        (b"\n", "not valid JSON"),
        (b"[" * 5000, "nested too deeply"),
        (b"\xff\xfe", "not UTF-8"),
        (b" " * (module.MAX_LINE_BYTES + 1), "longer than"),
    ],
)
def test_what_is_no_strict_json_is_named(listed: Path, line: bytes, said: str) -> None:
    listed.write_bytes(listed.read_bytes() + line + b"\n")
    with pytest.raises(DataError, match=f"pairs.jsonl, line 4.*{said}"):
        read_pairs(listed)


def test_a_file_that_is_no_list_is_refused(
    tmp_path: Path, listed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    empty = tmp_path / "empty.jsonl"
    empty.write_bytes(b"")
    with pytest.raises(DataError, match="is empty"):
        read_pairs(empty)
    empty.write_bytes(listed.read_bytes().split(b"\n")[0] + b"\n")
    with pytest.raises(DataError, match="holds no pair"):
        read_pairs(empty)
    with pytest.raises(DataError, match=r"cannot read.*No such file"):
        read_pairs(tmp_path / "none.jsonl")
    with pytest.raises(DataError, match=r"cannot read.*directory"):
        read_pairs(tmp_path)
    monkeypatch.setattr(module, "MAX_PAIRS", 1)
    with pytest.raises(DataError, match="line 3: more than 1 pairs"):
        read_pairs(listed)


def test_a_list_is_written_whole_or_not_at_all(
    listed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = listed.read_bytes()

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(_files.os, "fsync", full)
    with pytest.raises(OutputError, match="No space left"):
        write_pairs(listed, PairList("other", tmp_path, (PAIR,)))
    assert listed.read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["pairs.jsonl"]
    with pytest.raises(OutputError, match="is a folder"):
        write_pairs(tmp_path, PairList("other", tmp_path, (PAIR,)))


def test_selected_pairs_and_their_counts(tmp_path: Path) -> None:
    kinds = [("rain", "train"), ("snow", "val"), ("rain", "val"), ("rain", "train")]
    pairs = tuple(
        replace(PAIR, style=style, split=split, target=f"{number}.png")
        for number, (style, split) in enumerate(kinds)
    )
    whole = PairList("tiny", tmp_path, pairs)
    assert whole.styles == ("rain", "snow")
    assert whole.counts() == {("rain", "train"): 2, ("snow", "val"): 1, ("rain", "val"): 1}
    assert told_counts(whole) == "2 rain train, 1 rain val, 1 snow val"
    assert whole.selected("train").pairs == (pairs[0], pairs[3])
    assert whole.selected("val", "snow").pairs == (pairs[1],)
    with pytest.raises(ArgumentError, match=r"no pair of train and snow; it has 2 rain train"):
        whole.selected("train", "snow")
    with pytest.raises(ArgumentError, match="no pair of test"):
        whole.selected("test")
    with pytest.raises(ArgumentError, match="split must be one of"):
        whole.selected("dev")
    with pytest.raises(ArgumentError, match="style must be one of"):
        whole.selected("train", "hail")
    with pytest.raises(ArgumentError, match="holds no pair"):
        PairList("none", tmp_path, ())


def test_a_picture_outside_the_root_is_not_read(tmp_path: Path) -> None:
    """Neither a link nor a way up leads out; the link is what a hostile archive would hold."""
    root = tmp_path / "data"
    whole = list_of(root, pair_of(root, "a.png", "b.png"))
    assert whole.file("a.png") == root / "a.png"
    (tmp_path / "secret.png").write_bytes((root / "a.png").read_bytes())
    (root / "link.png").symlink_to(tmp_path / "secret.png")
    (root / "up").symlink_to(tmp_path)
    for way in ("link.png", "up/secret.png"):
        with pytest.raises(DataError, match="is a link"):
            whole.file(way)
    with pytest.raises(DataError, match="not a plain path"):
        whole.file("../secret.png")
    with pytest.raises(DataError, match="missing"):
        whole.file("none.png")


def test_lists_of_several_sets_are_joined(tmp_path: Path) -> None:
    one = PairList("one", tmp_path / "sets" / "acdc", (PAIR,))
    two = PairList("two", tmp_path / "sets" / "muses", (replace(PAIR, style="fog"),))
    whole = joined([one, two])
    assert (whole.name, whole.root) == ("one+two", tmp_path / "sets")
    assert [pair.source for pair in whole.pairs] == ["acdc/clear/a.png", "muses/clear/a.png"]
    assert whole.pairs[0].source_label is None
    assert whole.pairs[1].target_label == "muses/labels/a.png"
    assert [pair.style for pair in whole.pairs] == ["rain", "fog"]
    assert joined([one]) == one
    with pytest.raises(ArgumentError, match="no pair list"):
        joined([])


def test_clear_pictures_are_listed_with_themselves(tmp_path: Path) -> None:
    """Once each, of those that are trained on only, and not again a second time."""
    names = ("rain", "train", "a"), ("snow", "train", "a"), ("fog", "val", "b")
    pairs = [
        pair_of(
            tmp_path,
            f"clear/{name}.png",
            f"{style}/{name}.png",
            style=style,
            split=split,
            aligned=False,
        )
        for style, split, name in names
    ]
    listed = list_of(tmp_path, *pairs)
    whole = with_clear(listed)
    clear = whole.selected("train", "clear").pairs
    assert [pair.source for pair in clear] == ["clear/a.png"]
    assert clear[0].target == clear[0].source and clear[0].aligned
    assert clear[0].target_sha256 == clear[0].source_sha256
    assert whole.pairs[1:] == listed.pairs
    assert with_clear(whole) == whole
