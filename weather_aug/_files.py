"""Files that are whole or absent: written beside their place, synced, then renamed into it."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

from weather_aug.errors import DataError, OutputError, printable

TEMPORARY_SUFFIX = ".tmp"
MAX_JSON_BYTES = 16 * 2**20

_TOKEN_BYTES = 8
_TEMPORARY = re.compile(rf".+\.[0-9a-f]{{{2 * _TOKEN_BYTES}}}{re.escape(TEMPORARY_SUFFIX)}")


def write_whole(path: Path, data: bytes) -> None:
    """Write a file so that it is either absent (or the old one) or complete, also after a crash.

    Raises:
        OutputError: If the disk is full or the folder cannot be written; no partial file stays.
    """
    with whole_file(path) as file:
        file.write(data)


@contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file that appears under its name only when the block ends without an error.

    For content too large to hold in memory; else `write_whole`. Several writers of one path do not
    meet: the last one to end has it. One that is killed leaves `NAME.<16 hex digits>.tmp`; see
    `remove_temporaries`.

    Raises:
        OutputError: If the disk is full or the folder cannot be written; no partial file stays.
    """
    token = os.urandom(_TOKEN_BYTES).hex()
    temporary = path.with_name(f"{path.name}.{token}{TEMPORARY_SUFFIX}")
    with reported(path):
        try:
            with temporary.open("xb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
        sync_folder(path.parent)


def remove_temporaries(folder: Path) -> None:
    """Remove what killed writers left in `folder` itself, which has no live one.

    Raises:
        OutputError: If one cannot be removed.
    """
    with reported(folder):
        for path in folder.iterdir():
            if _TEMPORARY.fullmatch(path.name):
                path.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Make renames in `folder` survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def reported(path: Path) -> Iterator[None]:
    """Turn an operating system's refusal into one sentence that names the path."""
    try:
        yield
    except OutputError:
        raise
    except OSError as error:
        cause = error.strerror or str(error)
        cure = "; free some space and run it again" if error.errno == errno.ENOSPC else ""
        raise OutputError(f"cannot write {printable(path, 200)}: {cause}{cure}") from error


def sha256_of(data: bytes | memoryview) -> str:
    """Hexadecimal SHA-256."""
    return hashlib.sha256(data).hexdigest()


def sha256_of_file(path: Path) -> str:
    """Hexadecimal SHA-256 of a file's content."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_json(path: Path, max_bytes: int = MAX_JSON_BYTES) -> Any:
    """Parse a JSON file from an untrusted place.

    Raises:
        DataError: If it is too large, not UTF-8, not JSON, nested too deeply, or holds duplicate
            keys, NaN or infinity.
    """
    try:
        if path.stat().st_size > max_bytes:
            raise DataError(f"{printable(path, 200)} is larger than {max_bytes} bytes")
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise DataError(f"{printable(path, 200)} is not UTF-8 text") from None
    except OSError as error:
        raise DataError(f"cannot read {printable(path, 200)}: {error.strerror}") from None
    return parse_json(text, str(path))


def parse_json(text: str, where: str) -> Any:
    """Parse JSON strictly; `where` is named in errors. See `read_json`."""

    def refuse(constant: str) -> Any:
        raise ValueError(f"{constant} is not allowed")

    def real(number: str) -> float:
        value = float(number)
        return value if abs(value) != float("inf") else refuse(printable(number))

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        table = dict(pairs)
        if len(table) != len(pairs):
            raise ValueError("an object has the same key twice")
        return table

    try:
        return json.loads(text, parse_constant=refuse, parse_float=real, object_pairs_hook=unique)
    except (ValueError, RecursionError) as error:
        cause = "it is nested too deeply" if isinstance(error, RecursionError) else error
        raise DataError(f"{printable(where, 200)} is not valid JSON: {cause}") from None


def check_plain(root: object, relative: str) -> tuple[str, ...]:
    """The parts of a path below `root`, of which none leads elsewhere.

    Raises:
        DataError: If the path is not plain and relative.
    """
    parts = PurePosixPath(relative).parts
    plain = isinstance(relative, str) and parts and "/".join(parts) == relative
    if not plain or any(p in ("..", ".", "/") or "\\" in p or "\0" in p for p in parts):
        raise DataError(f"{printable(root, 200)}: {printable(relative)!r} is not a plain path")
    return parts


def file_inside(root: Path, relative: str) -> Path:
    """The regular file that `relative` names below `root`; links and ways out are refused.

    Raises:
        DataError: If the path is not plain and relative, or no regular file is there.
    """
    path = root
    for part in check_plain(root, relative):
        path = path / part
        try:
            mode = path.lstat().st_mode
        except OSError:
            raise DataError(f"{printable(path, 200)} is missing") from None
        if stat.S_ISLNK(mode):
            raise DataError(f"{printable(path, 200)} is a link; put the file itself there")
    if not stat.S_ISREG(mode):
        raise DataError(f"{printable(path, 200)} is not a regular file")
    return path
