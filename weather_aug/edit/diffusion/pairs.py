"""The list of picture pairs that an editor is trained on: a text file, one pair a line.

Convention:
    The first line of a list is its header, `{"format": "weather_aug pairs", "version": 1, "name":
    …, "root": …}`; each other line is one `Pair` as a JSON object with all of its fields. Paths are
    plain, relative to the list's root, with "/" between their parts. A root that is not absolute is
    relative to the folder of the list. Label maps hold train ids (see `weather_aug.taxonomy`).

    A list says which pictures an editor may learn from (`split == "train"`) and which are held out
    ("val" and "test"); digests of both kinds stand in it, so that `leakage` can tell without
    reading the pictures again, and so that what is trained on is what was listed.
"""

from __future__ import annotations

import json
import os
import string
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path, PurePosixPath
from typing import Any

from weather_aug import _files
from weather_aug.edit.background import STYLES
from weather_aug.errors import ArgumentError, DataError, OutputError, printable

FORMAT = "weather_aug pairs"
VERSION = 1
PAIR_STYLES = ("clear", *STYLES)
"""Weathers of a pair's target; "clear" pairs teach an editor to leave a clear picture as it is."""
SPLITS = ("train", "val", "test")
MAX_LINE_BYTES = 2**16
MAX_PAIRS = 5_000_000

_HEADER_KEYS = {"format", "version", "name", "root"}
_HEX = frozenset(string.hexdigits.lower())


@dataclass(frozen=True)
class Pair:
    """A clear picture and one in a weather; see the module's Convention.

    Raises:
        ArgumentError: If a path is not plain and relative, a label is no PNG, the style or the
            split is unknown, `aligned` is not a boolean, or a digest is none.
    """

    source: str
    """Path of the clear picture."""
    target: str
    """Path of the picture in the weather; of another place where `aligned` is false."""
    source_label: str | None
    """Path of the clear picture's label map, a PNG; None where nobody labelled it."""
    target_label: str | None
    """Path of the label map of `target`, a PNG; None where nobody labelled it."""
    style: str
    """Weather of the target, of `PAIR_STYLES`."""
    split: str
    """"train", or "val" and "test" for pictures that are never trained on."""
    aligned: bool
    """Whether both pictures have one camera pose and size, so that pixels can be compared."""
    source_sha256: str
    """Of the file's bytes, 64 hexadecimal digits."""
    target_sha256: str
    source_pixels_sha256: str
    """Of the decoded picture; see `leakage.digests_of`."""
    target_pixels_sha256: str

    def __post_init__(self) -> None:
        _check_path("source", self.source)
        _check_path("target", self.target)
        for name in ("source_label", "target_label"):
            label = getattr(self, name)
            if label is not None:
                _check_path(name, label)
                if not label.lower().endswith(".png"):
                    raise ArgumentError(f"{name} {printable(label)!r} is no PNG; store ids as PNG")
        for name, known in (("style", PAIR_STYLES), ("split", SPLITS)):
            value = getattr(self, name)
            if value not in known:
                raise ArgumentError(
                    f"{name} must be one of {', '.join(known)}, got {printable(value)!r}"
                )
        if not isinstance(self.aligned, bool):
            raise ArgumentError(f"aligned must be true or false, got {printable(self.aligned)!r}")
        for name in _DIGESTS:
            check_digest(name, getattr(self, name))


_FIELDS = tuple(field.name for field in fields(Pair))
_DIGESTS = tuple(name for name in _FIELDS if name.endswith("_sha256"))
_PATHS = ("source", "target", "source_label", "target_label")


@dataclass(frozen=True)
class PairList:
    """Pairs below one folder.

    Raises:
        ArgumentError: If there are no pairs.
    """

    name: str
    """What the list is called, for people."""
    root: Path
    """Folder that the pairs' paths are relative to."""
    pairs: tuple[Pair, ...]

    def __post_init__(self) -> None:
        if not self.pairs:
            raise ArgumentError(f"the pair list {printable(self.name)!r} holds no pair")
        object.__setattr__(self, "root", Path(os.path.abspath(self.root)))  # noqa: PTH100

    @property
    def styles(self) -> tuple[str, ...]:
        """Styles of which there are pairs, in the order of `PAIR_STYLES`."""
        found = {pair.style for pair in self.pairs}
        return tuple(style for style in PAIR_STYLES if style in found)

    def counts(self) -> dict[tuple[str, str], int]:
        """Number of pairs by (style, split)."""
        return dict(Counter((pair.style, pair.split) for pair in self.pairs))

    def selected(self, split: str, style: str | None = None) -> PairList:
        """The pairs of a split, of all styles or of one, in the order of the list.

        Raises:
            ArgumentError: If split or style are unknown, or there is no such pair.
        """
        _check_choice("split", split, SPLITS)
        if style is not None:
            _check_choice("style", style, PAIR_STYLES)
        chosen = [
            pair for pair in self.pairs if pair.split == split and style in (None, pair.style)
        ]
        if not chosen:
            wanted = split if style is None else f"{split} and {style}"
            raise ArgumentError(
                f"the pair list {printable(self.name)!r} has no pair of {wanted}; it has "
                f"{told_counts(self)}"
            )
        return replace(self, pairs=tuple(chosen))

    def file(self, relative: str) -> Path:
        """The file that a path of a pair names.

        Raises:
            DataError: If there is no regular file, or a link on the way to it.
        """
        return _files.file_inside(self.root, relative)


def told_counts(pair_list: PairList) -> str:
    """How many pairs there are, such as "3 rain train, 1 snow val"."""
    counts = pair_list.counts()
    order = [(style, split) for style in PAIR_STYLES for split in SPLITS]
    return ", ".join(f"{counts[key]} {key[0]} {key[1]}" for key in order if key in counts)


def joined(lists: Sequence[PairList]) -> PairList:
    """One list of the pairs of several, in their order; its root is the folder they share.

    Raises:
        ArgumentError: If there is no list.
    """
    if not lists:
        raise ArgumentError("there is no pair list to join; give at least one")
    root = Path(os.path.commonpath([part.root for part in lists]))
    pairs = tuple(
        _below(part.root.relative_to(root).as_posix(), pair)
        for part in lists
        for pair in part.pairs
    )
    return PairList("+".join(part.name for part in lists), root, pairs)


def write_pairs(path: Path, pair_list: PairList) -> None:
    """Write a list whole, or not at all.

    The root is written relative to the list's folder if it lies in it, else absolute.

    Raises:
        OutputError: If the file cannot be written.
    """
    folder = Path(os.path.abspath(path)).parent  # noqa: PTH100
    inside = pair_list.root.is_relative_to(folder)
    root = pair_list.root.relative_to(folder).as_posix() if inside else str(pair_list.root)
    header = {"format": FORMAT, "version": VERSION, "name": pair_list.name, "root": root}
    if path.is_dir():
        raise OutputError(f"{printable(path, 200)} is a folder; name a file for the pair list")
    with _files.reported(path):
        folder.mkdir(parents=True, exist_ok=True)
    with _files.whole_file(path) as file:
        file.write(json.dumps(header).encode() + b"\n")
        for pair in pair_list.pairs:
            record = {name: getattr(pair, name) for name in _FIELDS}
            file.write(json.dumps(record).encode() + b"\n")


def with_clear(listed: PairList) -> PairList:
    """The list, and of each clear picture that is trained on a pair with itself.

    From these an adapter learns the style "clear", which blends of styles fade to.
    """
    itself: dict[str, Pair] = {}
    for pair in listed.selected("train").pairs:
        itself[pair.source] = replace(
            pair,
            style="clear",
            target=pair.source,
            target_label=pair.source_label,
            target_sha256=pair.source_sha256,
            target_pixels_sha256=pair.source_pixels_sha256,
            aligned=True,
        )
    others = (pair for pair in listed.pairs if pair.style != "clear")
    return replace(listed, pairs=(*itself.values(), *others))


def read_pairs(path: Path, *, root: Path | None = None) -> PairList:
    """Read a list from an untrusted place; pictures are not looked at.

    Args:
        path: The file.
        root: Folder of the pictures, instead of the one that the header names.

    Raises:
        DataError: If the file cannot be read or is no such list; names the line and the cure.
    """
    lines = _lines(path)
    number, first = next(lines, (1, None))
    if first is None:
        raise DataError(f"{printable(path, 200)} is empty; list the pairs again")
    header = _header(_where(path, number), first)
    pairs: list[Pair] = []
    for number, text in lines:
        if len(pairs) == MAX_PAIRS:
            raise DataError(f"{_where(path, number)}: more than {MAX_PAIRS} pairs; split the list")
        pairs.append(_pair(_where(path, number), text))
    if not pairs:
        raise DataError(f"{printable(path, 200)} holds no pair; list the pairs again")
    return PairList(
        header["name"], path.parent / header["root"] if root is None else root, tuple(pairs)
    )


def check_digest(name: str, value: Any) -> str:
    """Return a SHA-256 in 64 small hexadecimal digits, or refuse it by `name`."""
    if not isinstance(value, str) or len(value) != 64 or not _HEX.issuperset(value):
        raise ArgumentError(f"{name} must be 64 hexadecimal digits, got {printable(value)!r}")
    return value


def _below(folder: str, pair: Pair) -> Pair:
    if folder == ".":
        return pair
    paths: dict[str, Any] = {name: getattr(pair, name) for name in _PATHS}
    moved = {name: f"{folder}/{path}" for name, path in paths.items() if path is not None}
    return replace(pair, **{**paths, **moved})


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Number, from 1, and text of each line."""
    try:
        with path.open("rb") as file:
            number = 1
            while line := file.readline(MAX_LINE_BYTES + 1):
                if len(line) > MAX_LINE_BYTES:
                    raise DataError(
                        f"{_where(path, number)} is longer than {MAX_LINE_BYTES} bytes; is it a "
                        "pair list?"
                    )
                try:
                    yield number, line.decode("utf-8")
                except UnicodeDecodeError:
                    raise DataError(
                        f"{_where(path, number)} is not UTF-8 text; is it a pair list?"
                    ) from None
                number += 1
    except OSError as error:
        raise DataError(f"cannot read {printable(path, 200)}: {error.strerror}") from None


def _where(path: Path, number: int) -> str:
    return f"{printable(path, 200)}, line {number}"


def _header(where: str, text: str) -> dict[str, Any]:
    header = _files.parse_json(text, where)
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise DataError(f'{where} is no header of a pair list ("format": "{FORMAT}")')
    if header.get("version") != VERSION:
        raise DataError(
            f"{where}: version {printable(header.get('version'))} of pair lists is not {VERSION}; "
            "list the pairs again"
        )
    _check_keys(where, header, _HEADER_KEYS)
    for key in ("name", "root"):
        if not isinstance(header[key], str) or not _names_a_file(header[key]):
            raise DataError(f"{where}: {key} must be text, got {printable(header[key])!r}")
    return header


def _pair(where: str, text: str) -> Pair:
    record = _files.parse_json(text, where)
    if not isinstance(record, dict):
        raise DataError(f"{where} is no JSON object; each line after the first is one pair")
    _check_keys(where, record, set(_FIELDS))
    try:
        return Pair(**record)
    except ArgumentError as error:
        raise DataError(f"{where}: {error}; mend the line or list the pairs again") from None


def _check_keys(where: str, record: dict[str, Any], known: set[str]) -> None:
    strange, missing = sorted(record.keys() - known), sorted(known - record.keys())
    if strange:
        raise DataError(f"{where}: unknown field {printable(strange[0])!r}; remove it")
    if missing:
        raise DataError(f"{where}: {missing[0]} is missing; list the pairs again")


def _check_path(name: str, path: Any) -> None:
    parts = PurePosixPath(path).parts if isinstance(path, str) else ()
    plain = bool(parts) and "/".join(parts) == path and _names_a_file(path)
    if not plain or any(part in ("..", ".", "/") or "\\" in part for part in parts):
        raise ArgumentError(f"{name} {printable(path)!r} is not a plain path below the root")


def _names_a_file(text: str) -> bool:
    """Whether the operating system could have a file of this name."""
    try:
        return bool(text) and b"\0" not in os.fsencode(text)
    except UnicodeEncodeError:
        return False


def _check_choice(name: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise ArgumentError(f"{name} must be one of {', '.join(known)}, got {printable(value)!r}")
