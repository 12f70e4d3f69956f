"""Where an export is read back from: a folder, or a url."""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from weather_aug import _files
from weather_aug.errors import DataError, OutputError, printable
from weather_aug.writers import layout


class Source(Protocol):
    """Files to be read; paths are relative, of plain parts divided by "/".

    Convention:
        A file that is missing, or none, is a DataError whose sentence names it. Where it is the
        place that does not answer, it is an OutputError.
    """

    def size(self, relative: str) -> int:
        """Size of a file in bytes."""

    def read(self, relative: str, offset: int = 0, size: int | None = None) -> bytes:
        """Bytes of a file: `size` of them from `offset` on, as far as there are; all if None."""

    def open(self, relative: str) -> io.BufferedReader:
        """A file of any size, to be read from its start."""

    def files(self) -> Iterator[str]:
        """Paths of all files."""


@dataclass(frozen=True)
class LocalSource:
    """A folder of this machine; links are not followed. See `Source`."""

    path: Path

    def size(self, relative: str) -> int:
        """By its folder."""
        return _files.file_inside(self.path, relative).stat().st_size

    def read(self, relative: str, offset: int = 0, size: int | None = None) -> bytes:
        """Whole or in part."""
        with self.open(relative) as file:
            file.seek(offset)
            try:
                return file.read(-1 if size is None else size)
            except OSError as error:
                raise self._unreadable(relative, error) from error

    def open(self, relative: str) -> io.BufferedReader:
        """As Python does."""
        try:
            return _files.file_inside(self.path, relative).open("rb")
        except OSError as error:
            raise self._unreadable(relative, error) from error

    def files(self) -> Iterator[str]:
        """Whatever is no folder."""
        for folder, _, names in os.walk(self.path):
            for name in sorted(names):
                yield (Path(folder) / name).relative_to(self.path).as_posix()

    def _unreadable(self, relative: str, error: OSError) -> DataError:
        where = printable(self.path / relative, 200)
        return DataError(f"{where} cannot be read: {error.strerror}")

    def __str__(self) -> str:
        return printable(self.path, 200)


Readable = str | Path | Source
"""A folder, a url, or what `source_of` made of one."""


def is_url(out: object) -> bool:
    """Whether an output is a place that fsspec reaches, and no folder."""
    return isinstance(out, str) and "://" in out


def source_of(out: Readable) -> Source:
    """What reads from `out`.

    Raises:
        ArgumentError: If fsspec does not know a url.
        MissingExtraError: If the package of its file system is not installed.
    """
    if not isinstance(out, str | Path):
        return out
    if is_url(out):
        from weather_aug.writers.place import Place

        return Place(str(out))
    return LocalSource(Path(out))


def exists(source: Source, relative: str) -> bool:
    """Whether a file is there.

    Raises:
        OutputError: If the place does not answer.
    """
    try:
        source.size(relative)
    except OutputError:
        raise
    except (DataError, OSError):
        return False
    return True


def contents_of(source: Source) -> dict[str, Any]:
    """The fields of an export's `export.json`; see `layout.read_contents`.

    Raises:
        DataError: If it is missing, too large or not JSON.
        IntegrityError: If it is not an export's, or its own digest does not match.
        OutputError: If the place does not answer.
    """
    most = _files.MAX_JSON_BYTES + 1
    size = min(source.size(layout.CONTENTS), most)
    data = source.read(layout.CONTENTS, 0, size) if size else b""
    return layout.checked_contents(data, f"{source}/{layout.CONTENTS}")


def sha256_of(source: Source, relative: str) -> str:
    """Hexadecimal SHA-256 of a file."""
    with source.open(relative) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def lines_of(source: Source, relative: str) -> Iterator[str]:
    """Lines of a text file, with their ends; what is not UTF-8 is replaced."""
    with source.open(relative) as file:
        for line in file:
            yield line.decode("utf-8", "replace")
