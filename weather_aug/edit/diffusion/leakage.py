"""No picture that an editor learnt from may stand among those that it is judged on.

Convention:
    A picture is known by two SHA-256: of its file's bytes, and of its pixels, so that one that was
    stored again as another PNG is found as well. Pictures that were resized, cropped or compressed
    again have other pixels: they are not found. Pictures are read one by one and never held.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from tqdm.auto import tqdm

from weather_aug import _files
from weather_aug.clip.images import read_image
from weather_aug.edit.diffusion.pairs import Pair, PairList, check_digest
from weather_aug.errors import ArgumentError, DataError, IntegrityError, printable

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg")
TRAINED_ON = "trained_on.txt"
"""Beside an adapter: what it was trained on."""
TRAINED_ON_HEADER = "# weather_aug trained_on 1: sha256 of files and of pixels"
MAX_TRAINED_ON_BYTES = 2**30
SHOWN_LEAKS = 3

_CHUNK = 256
_THREADS = min(8, os.cpu_count() or 1)


class Digests(NamedTuple):
    """What a picture is known by, each 64 hexadecimal digits."""

    file: str
    """Of the file's bytes."""
    pixels: str
    """Of its size and its RGB values."""


def digests_of(path: Path) -> Digests:
    """Digests of a PNG or JPEG file.

    Raises:
        DataError: If the picture cannot be read; see `clip.images.read_image`.
    """
    picture = read_image(path)
    pixels = hashlib.sha256(b"%dx%d\n" % picture.shape[:2])
    pixels.update(picture.data)
    return Digests(_files.sha256_of_file(path), pixels.hexdigest())


def digests_by_path(
    paths: Iterable[Path], *, progress: bool = False
) -> Iterator[tuple[Path, Digests]]:
    """Each path with its picture's digests, in the order given; a few are read at a time.

    Raises:
        DataError: If a picture cannot be read.
    """
    waiting = iter(tqdm(paths, desc="digests", unit="picture", disable=not progress))
    with ThreadPoolExecutor(_THREADS) as threads:
        while chunk := list(islice(waiting, _CHUNK)):
            yield from zip(chunk, threads.map(digests_of, chunk), strict=True)


def pictures_in(places: Iterable[Path]) -> Iterator[Path]:
    """The files given, and the PNG and JPEG files below the folders given, by name.

    Links to folders are followed: data sets are often put together of them.

    Raises:
        DataError: If a place is neither file nor folder, or a folder holds no picture or cannot be
            read.
    """
    for place in places:
        if place.is_dir():
            below = sorted(filter(_is_picture, _paths_below(place)))
            if not below:
                raise DataError(f"{printable(place, 200)} holds no PNG or JPEG; check the folder")
            yield from below
        elif place.is_file():
            yield place
        else:
            raise DataError(f"{printable(place, 200)} is neither a picture nor a folder of them")


def leaks(pair_list: PairList, held_out: Iterable[Path] = ()) -> list[str]:
    """What is trained on and held out as well, one sentence a picture that is held out.

    The list's own pictures are compared by the digests that it records.

    Args:
        pair_list: Its split "train" is trained on, the rest is held out.
        held_out: More pictures that are held out: files, or folders of nothing but pictures.

    Raises:
        DataError: If a held-out place or picture cannot be read.
    """
    trained = _trained_paths(pair_list)
    held = ((f"{path} ({split})", digests) for path, split, digests in _listed(pair_list, False))
    more = ((printable(path, 200), found) for path, found in digests_by_path(pictures_in(held_out)))
    found = []
    for known in (dict.fromkeys(held), more):
        for name, digests in known:
            if digests.file in trained:
                found.append(f"{name} is the file {trained[digests.file]} (train)")
            elif digests.pixels in trained:
                found.append(f"{name} has the pixels of {trained[digests.pixels]} (train)")
    return found


def check_no_leak(pair_list: PairList, held_out: Iterable[Path] = ()) -> None:
    """Refuse a list that trains on a held-out picture; see `leaks`.

    Raises:
        DataError: If there is such a picture; names the first ones and the cure.
    """
    found = leaks(pair_list, held_out)
    if found:
        shown = "; ".join(found[:SHOWN_LEAKS])
        rest = f"; and {len(found) - SHOWN_LEAKS} more" if len(found) > SHOWN_LEAKS else ""
        raise DataError(
            f"{len(found)} held-out pictures of {printable(pair_list.name)!r} are trained on: "
            f"{shown}{rest}; take them out of the training pairs (without_leaks, --drop-leaks)"
        )


def without_leaks(pair_list: PairList, held_out: Iterable[Path] = ()) -> PairList:
    """The list without those training pairs of which a picture is held out.

    Raises:
        ArgumentError: If no pair is left.
        DataError: As `leaks`.
    """
    held = {d for _, _, digests in _listed(pair_list, False) for d in digests}
    for _, digests in digests_by_path(pictures_in(held_out)):
        held.update(digests)
    kept = [
        pair
        for pair in pair_list.pairs
        if pair.split != "train" or held.isdisjoint(_digests_of_pair(pair))
    ]
    if not kept:
        raise ArgumentError(
            f"every pair of {printable(pair_list.name)!r} trains on what is held out"
        )
    return replace(pair_list, pairs=tuple(kept))


@dataclass(frozen=True)
class TrainedOn:
    """What an editor was trained on.

    Raises:
        ArgumentError: If there is no digest, or one is none.
    """

    digests: frozenset[str]
    """Of files and of pixels, of sources and of targets."""

    def __post_init__(self) -> None:
        if not self.digests:
            raise ArgumentError("digests is empty; an editor was trained on something")
        for digest in self.digests:
            check_digest("digests", digest)

    @classmethod
    def of(cls, pair_list: PairList) -> TrainedOn:
        """What training on a list's split "train" sees.

        Raises:
            ArgumentError: If the list has no such pair.
        """
        pairs = pair_list.selected("train").pairs
        return cls(frozenset(d for pair in pairs for d in _digests_of_pair(pair)))

    @classmethod
    def union(cls, records: Iterable[TrainedOn]) -> TrainedOn:
        """What several were trained on, as one record.

        Raises:
            ArgumentError: If there is none.
        """
        return cls(frozenset[str]().union(*(record.digests for record in records)))

    @classmethod
    def read(cls, folder: Path) -> TrainedOn:
        """Read the record that stands beside an adapter.

        Raises:
            DataError: If there is none, or a line is no digest or out of order.
        """
        return cls.read_file(folder / TRAINED_ON)

    @classmethod
    def read_file(cls, path: Path, sha256: str | None = None) -> TrainedOn:
        """Read a record.

        Args:
            path: Of its file.
            sha256: Of its bytes, where somebody noted it; not compared if None.

        Raises:
            DataError: If there is none, or a line is no digest or out of order.
            IntegrityError: If it has other bytes.
        """
        try:
            if path.stat().st_size > MAX_TRAINED_ON_BYTES:
                raise DataError(
                    f"{printable(path, 200)} is larger than {MAX_TRAINED_ON_BYTES} bytes"
                )
            data = path.read_bytes()
        except OSError as error:
            raise DataError(f"cannot read {printable(path, 200)}: {error.strerror}") from None
        return cls.parse(data, str(path), sha256)

    @classmethod
    def parse(cls, data: bytes, path: str, sha256: str | None = None) -> TrainedOn:
        """A record's bytes as a record; `path` is named in errors. See `read_file`."""
        if sha256 not in (None, _files.sha256_of(data)):
            raise IntegrityError(
                f"{printable(path, 200)} has changed since it was written; take the file as it was"
            )
        try:
            *lines, end = data.decode("ascii").split("\n")
        except UnicodeDecodeError:
            raise DataError(f"{printable(path, 200)} is not ASCII text") from None
        if lines[:1] != [TRAINED_ON_HEADER] or len(lines) < 2 or end:
            raise DataError(f"{printable(path, 200)} is no record of what an editor was trained on")
        before = ""
        for number, line in enumerate(lines[1:], 2):
            where = f"{printable(path, 200)}, line {number}"
            try:
                check_digest(where, line)
            except ArgumentError as error:
                raise DataError(f"{error}; take the file that the training wrote") from None
            if line <= before:
                raise DataError(f"{where} is out of order; take the file that the training wrote")
            before = line
        return cls(frozenset(lines[1:]))

    def write(self, folder: Path) -> None:
        """Write the record beside an adapter, whole or not at all.

        Raises:
            OutputError: If it cannot be written.
        """
        _files.write_whole(folder / TRAINED_ON, self.as_bytes())

    def as_bytes(self) -> bytes:
        """The record's file: equal records have equal bytes."""
        return ("\n".join([TRAINED_ON_HEADER, *sorted(self.digests)]) + "\n").encode("ascii")

    def overlap(self, places: Path | Iterable[Path]) -> list[Path]:
        """Pictures of an evaluation set that the editor has seen.

        Args:
            places: Folder, or files and folders, of nothing but pictures.

        Raises:
            DataError: If a place or picture cannot be read.
        """
        given = [places] if isinstance(places, Path) else places
        found = digests_by_path(pictures_in(given))
        return [path for path, digests in found if not self.digests.isdisjoint(digests)]


def _paths_below(place: Path) -> Iterator[Path]:
    """Every file, also in folders that are linked to, each of which is entered once."""

    def refuse(error: OSError) -> None:
        raise DataError(f"cannot read {printable(error.filename, 200)}: {error.strerror}")

    entered: set[Path] = set()
    for folder, below, names in os.walk(place, onerror=refuse, followlinks=True):
        real = Path(folder).resolve()
        if real in entered:
            below.clear()
            continue
        entered.add(real)
        below.sort()
        yield from (Path(folder, name) for name in names)


def _is_picture(path: Path) -> bool:
    return path.suffix.lower() in PICTURE_SUFFIXES and path.is_file()


def _listed(pair_list: PairList, trained: bool) -> Iterator[tuple[str, str, Digests]]:
    """Path, split and digests of each picture that is trained on, or that is held out."""
    for pair in pair_list.pairs:
        if (pair.split == "train") == trained:
            source = Digests(pair.source_sha256, pair.source_pixels_sha256)
            target = Digests(pair.target_sha256, pair.target_pixels_sha256)
            yield printable(pair.source, 200), pair.split, source
            yield printable(pair.target, 200), pair.split, target


def _trained_paths(pair_list: PairList) -> dict[str, str]:
    """Path of each picture that is trained on, by either digest."""
    return {d: path for path, _, digests in _listed(pair_list, True) for d in digests}


def _digests_of_pair(pair: Pair) -> tuple[str, ...]:
    return (
        pair.source_sha256,
        pair.target_sha256,
        pair.source_pixels_sha256,
        pair.target_pixels_sha256,
    )
