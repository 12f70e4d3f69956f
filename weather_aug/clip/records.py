"""Untrusted small files: tables of numbers, JSON and point clouds, each fault one typed error."""

from __future__ import annotations

import json
import math
import os
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weather_aug.errors import ArgumentError, ClipError, printable

Float64 = NDArray[np.float64]

MAX_TEXT_BYTES = 64 * 2**20
MAX_ARRAY_BYTES = 256 * 2**20


def folder_at(path: str | os.PathLike[str], what: str) -> Path:
    """Return `path` as a Path, or refuse one that is not a folder.

    Raises:
        ClipError: If there is no such folder; the message names it.
    """
    folder = Path(path)
    if not folder.is_dir():
        state = "is not a folder" if folder.exists() else "does not exist"
        raise ClipError(f"{what} {shown(folder)} {state}; check the path")
    return folder


def read_lines(path: Path) -> list[str]:
    """Lines of a small text file, without blank ones at the end.

    Raises:
        ClipError: If the file is missing, larger than 64 MiB or not text.
    """
    try:
        return _bounded_bytes(path, MAX_TEXT_BYTES).decode("utf-8").rstrip().splitlines()
    except UnicodeDecodeError:
        raise ClipError(f"{shown(path)} is not a text file; restore it") from None


def read_numbers(path: Path, columns: int) -> Float64:
    """(N, columns) finite numbers of a text file, one row a line.

    Raises:
        ClipError: If a line holds another count, text, NaN or infinity; the line is named.
    """
    rows = [
        numbers_of(line, columns, f"{shown(path)} line {index}")
        for index, line in enumerate(read_lines(path), start=1)
    ]
    if not rows:
        raise ClipError(f"{shown(path)} is empty; restore it")
    return np.stack(rows)


def numbers_of(text: str, columns: int, where: str) -> Float64:
    """(columns,) finite numbers separated by blanks; `where` is named in the error."""
    try:
        row = np.array([float(word) for word in text.split()])
    except ValueError:
        raise ClipError(f"{where} holds something that is not a number; repair it") from None
    if row.shape != (columns,):
        raise ClipError(f"{where} holds {row.size} numbers instead of {columns}; repair it")
    if not np.isfinite(row).all():
        raise ClipError(f"{where} holds NaN or infinity; repair it or leave those frames out")
    return row


def read_array(path: Path, name: str | None = None) -> NDArray[Any]:
    """Array of a .npy file, or the array `name` of a .npz file; never unpickled.

    Raises:
        ClipError: If the file is missing, damaged, larger than 256 MiB unpacked, or has no such
            array.
    """
    try:
        if name is None:
            _bounded_size(path, MAX_ARRAY_BYTES)
            return np.asarray(np.load(path, allow_pickle=False))
        with zipfile.ZipFile(path) as archive:
            member = archive.getinfo(f"{name}.npy")
            if member.file_size > MAX_ARRAY_BYTES:
                raise ClipError(f"{shown(path)}: {name} unpacks to {member.file_size} bytes")
            with archive.open(member) as stream:
                return np.lib.format.read_array(stream, allow_pickle=False)
    except KeyError:
        raise ClipError(f"{shown(path)} has no array {name!r}; restore the file") from None
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, NotImplementedError) as error:
        if isinstance(error, ClipError):
            raise
        raise ClipError(
            f"{shown(path)} cannot be read as an array: {printable(error)}; restore the file"
        ) from None


def read_floats(path: Path, columns: int) -> NDArray[np.float32]:
    """(N, columns) little-endian float32 records of a raw binary file.

    Raises:
        ClipError: If the file is missing, too large, cut within a record or not finite.
    """
    data = _bounded_bytes(path, MAX_ARRAY_BYTES)
    if len(data) == 0 or len(data) % (4 * columns):
        raise ClipError(
            f"{shown(path)} has {len(data)} bytes, not a whole number of records of {4 * columns}; "
            "copy it again"
        )
    records = np.frombuffer(data, "<f4").reshape(-1, columns)
    if not np.isfinite(records).all():
        raise ClipError(f"{shown(path)} holds NaN or infinity; copy it again")
    return records


def read_json(path: Path) -> Record:
    """The root object of a JSON file.

    Raises:
        ClipError: If the file is missing, larger than 64 MiB or not JSON.
    """
    data = _bounded_bytes(path, MAX_TEXT_BYTES)
    try:
        value = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise ClipError(f"{shown(path)} is not JSON: {printable(error)}; restore it") from None
    return Record(value, path, "")


def inside(folder: Path, relative: str, where: str) -> Path:
    """Path of a file named by untrusted data, refused where it would leave `folder`.

    Raises:
        ClipError: If `relative` is absolute, climbs with "..", or holds control characters.
    """
    pure = PurePosixPath(relative)
    if not relative.isprintable() or pure.is_absolute() or ".." in pure.parts or "\\" in relative:
        raise ClipError(f"{where} names {printable(relative)!r}, which leaves {shown(folder)}")
    return folder / pure


def chosen_indices(frames: slice | None, count: int) -> range:
    """Indices of the frames that the option `frames` chooses out of `count`.

    Raises:
        ArgumentError: If it chooses none.
    """
    indices = range(count)[frames or slice(None)]
    if len(indices) == 0 or indices.step < 0:
        raise ArgumentError(
            f"frames={frames} chooses none of the {count} frames; give a:b within 0:{count}"
        )
    return indices


def checked_scale(scale: float) -> float:
    """Return the option `scale`, or refuse one outside (0, 1]."""
    if not (isinstance(scale, int | float) and 0 < scale <= 1):
        raise ArgumentError(f"scale must be in (0, 1], got {scale!r}")
    return float(scale)


def scaled_size(width: int, height: int, scale: float) -> tuple[int, int]:
    """(width, height) of a picture scaled down, at least one pixel each."""
    return max(1, round(width * scale)), max(1, round(height * scale))


def folder_name(*parts: str) -> str:
    """A clip's name from words, of letters, digits, dot and dash only: a folder can bear it."""
    text = "-".join(part for part in parts if part)
    return "".join(c if c.isascii() and (c.isalnum() or c in ".-_") else "_" for c in text)


@dataclass(frozen=True)
class Record:
    """A value inside a JSON file that remembers where it stands, so that faults can be named."""

    value: Any
    path: Path
    field: str

    def __getitem__(self, name: str) -> Record:
        child = self.get(name)
        if child is None:
            raise self.fault(f"has no {name!r}")
        return child

    def get(self, name: str) -> Record | None:
        """The member `name` of an object, None where it is absent."""
        if not isinstance(self.value, dict):
            raise self.fault(f"must be an object, is {_kind(self.value)}")
        if name not in self.value:
            return None
        return Record(self.value[name], self.path, f"{self.field}.{name}" if self.field else name)

    def __iter__(self) -> Iterator[Record]:
        if not isinstance(self.value, list):
            raise self.fault(f"must be a list, is {_kind(self.value)}")
        for index, item in enumerate(self.value):
            yield Record(item, self.path, f"{self.field}[{index}]")

    def members(self) -> dict[str, Record]:
        """All members of an object."""
        if not isinstance(self.value, dict):
            raise self.fault(f"must be an object, is {_kind(self.value)}")
        return {str(name): self[name] for name in self.value}

    def number(self) -> float:
        """A finite number."""
        if isinstance(self.value, bool) or not isinstance(self.value, int | float):
            raise self.fault(f"must be a number, is {_kind(self.value)}")
        try:
            number = float(self.value)
        except OverflowError:
            number = math.inf
        if not math.isfinite(number):
            raise self.fault("must be a finite number")
        return number

    def integer(self) -> int:
        """An integer."""
        if isinstance(self.value, bool) or not isinstance(self.value, int):
            raise self.fault(f"must be an integer, is {_kind(self.value)}")
        return self.value

    def text(self) -> str:
        """A string."""
        if not isinstance(self.value, str):
            raise self.fault(f"must be text, is {_kind(self.value)}")
        return self.value

    @property
    def where(self) -> str:
        """File and field, for a message."""
        return f"{shown(self.path)}: {printable(self.field or 'the root')}"

    def fault(self, what: str) -> ClipError:
        """The error that says what is wrong with this value."""
        return ClipError(f"{self.where} {what}; restore the file")


def shown(path: Path) -> str:
    """A path for an error message."""
    return printable(path, 300)


def _kind(value: Any) -> str:
    return {dict: "an object", list: "a list", str: "text", type(None): "null"}.get(
        type(value), "a number or boolean"
    )


def _bounded_size(path: Path, limit: int) -> None:
    try:
        size = path.stat().st_size
    except OSError:
        raise ClipError(f"{shown(path)} is missing; restore the file") from None
    if size > limit:
        raise ClipError(f"{shown(path)} has {size} bytes, more than {limit}")


def _bounded_bytes(path: Path, limit: int) -> bytes:
    _bounded_size(path, limit)
    try:
        return path.read_bytes()
    except OSError as error:
        raise ClipError(f"{shown(path)} cannot be read: {error.strerror}") from None
