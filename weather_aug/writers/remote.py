"""Samples on any place that fsspec reaches: s3, gs, abfs, sftp, hdfs, …; see `FsspecFolder`."""

from __future__ import annotations

import hashlib
import json
import uuid
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from weather_aug import _files
from weather_aug._extras import require
from weather_aug.errors import (
    ArgumentError,
    ConflictError,
    DataError,
    printable,
)
from weather_aug.writers.layout import CONTENTS, JOURNAL, MARK, STATE, Layout, sealed_contents
from weather_aug.writers.place import Place

STATES = Path(".weather-aug-export")
"""Where the states of exports to urls stand if nobody chooses, in the working directory."""

_PUTS_WHOLE = {"s3", "s3a", "gs", "gcs", "abfs", "abfss", "az", "oss", "oci", "tos", "memory"}
"""Protocols of stores where an object appears when it is complete, and not before."""


def default_state(url: str) -> Path:
    """Folder for the state of an export to `url`, one for each."""
    return STATES / _files.sha256_of(url.rstrip("/").encode())[:16]


@dataclass(frozen=True, repr=False)
class FsspecFolder:
    """A folder at a place that fsspec knows; see `Target`.

    Convention:
        A file is put under its name in one step where the store does that, else written under a
        temporary name and renamed; a place that can do neither is refused. What a power cut there
        costs is the place's own affair. Lock, journal and root files stand in `state`, a local
        folder; `publish` copies the root files. While an export goes on, a mark at the place names
        its job, so that without the state it is known, too, and can be made again.
    """

    url: str
    state: Path
    options: Mapping[str, Any] = field(default_factory=dict)
    """Of the file system, such as credentials; they go to workers and into no message."""

    def __post_init__(self) -> None:
        """Find the file system.

        Raises:
            ArgumentError: If fsspec does not know the url, or the place can write no file whole.
            MissingExtraError: If the package of the file system is not installed.
        """
        if not self._puts_whole and not self._renames:
            raise ArgumentError(
                f"{self} can neither put nor rename a file in one step, so a killed export could "
                "leave half of one; export to a folder and copy that"
            )

    def write_whole(self, relative: str, data: bytes) -> None:
        """One put, or a temporary file and a rename."""
        with self._appearing(relative) as path:
            self._fs.pipe_file(path, data)

    def is_whole(self, relative: str, stored: Mapping[str, Any], *, digests: bool) -> bool:
        """A digest is that of the bytes read back.

        Raises:
            OutputError: If the place does not answer: that is no damage.
        """
        path = self.place.path(relative)
        with self.place.reported(relative, "read"):
            try:
                if self._fs.info(path)["size"] != stored["size"]:
                    return False
                return not digests or self._digest(path) == stored["sha256"]
            except (FileNotFoundError, IsADirectoryError):
                return False

    def make_folders(self, relatives: Iterable[str]) -> None:
        """Each with its parents, where there are folders."""
        if self._puts_whole:
            return
        for relative in relatives:
            with self.place.reported(relative, "write"):
                self._fs.makedirs(self.place.path(relative), exist_ok=True)

    def remove_leftovers(self, layout: Layout) -> None:
        """Temporary files, where the place needs any, and those of the state."""
        suffix = _files.TEMPORARY_SUFFIX
        with _files.reported(self.state):
            for local in (*self.state.glob(f"*{suffix}"), *(self.state / STATE).glob(f"*{suffix}")):
                local.unlink()
        if self._puts_whole:
            return
        with self.place.reported("", "write"):
            for path in [*self.place.entries(), *self.place.below((*layout.roots, STATE))]:
                if path.endswith(suffix):
                    # A writer that lost touch may just have renamed it.
                    with suppress(FileNotFoundError):
                        self._fs.rm_file(path)

    def found_job(self) -> Any:
        """The job that the place is of, finished or not; None if nothing there tells.

        Raises:
            ConflictError: If it holds something else, of which the state does not know either.
            OutputError: If it cannot be read.
        """
        for name in (MARK, CONTENTS):
            found = self._json(name)
            if isinstance(found, dict) and isinstance(found.get("job"), dict):
                # One that was changed names no job; it is published anew, if the state knows it.
                if name == MARK or _is_sealed(found):
                    return found["job"]
        if any((self.state / name).exists() for name in (JOURNAL, CONTENTS)):
            return None
        with self.place.reported("", "read"):
            foreign = sorted(path.rstrip("/").rpartition("/")[2] for path in self.place.entries())
        if foreign and foreign != [STATE]:
            raise ConflictError(
                f"{self} is no export, but holds {printable(foreign[0])}; choose an empty or new "
                "place"
            )
        return None

    def finished_contents(self) -> dict[str, Any] | None:
        """`export.json` of an export that was finished there; None while one is being written.

        Raises:
            OutputError: If it cannot be read.
        """
        found = None if self._json(MARK) is not None else self._json(CONTENTS)
        return found if isinstance(found, dict) and "job" in found and _is_sealed(found) else None

    def begin(self, job: Mapping[str, Any]) -> None:
        """Mark the place as one that `job` is written to, and as not finished."""
        self.make_folders([STATE])
        self.write_whole(MARK, json.dumps({"job": job}, allow_nan=False).encode())
        with self.place.reported(CONTENTS, "write"), suppress(FileNotFoundError):
            self._fs.rm_file(self.place.path(CONTENTS))

    def publish(self, names: Iterable[str]) -> None:
        """Copy root files that are not there whole beside the samples, then remove the mark.

        Args:
            names: Of files in `state`, the one that makes the export complete last.
        """
        for name in names:
            local = self.state / name
            with _files.reported(local):
                stored = {"size": local.stat().st_size, "sha256": _files.sha256_of_file(local)}
            if not self.is_whole(name, stored, digests=True):
                with self._appearing(name) as path:
                    self._fs.put_file(str(local), path)
        with self.place.reported(STATE, "write"):
            for path in self.place.below([STATE]):
                self._fs.rm_file(path)
            # A store of objects has no folder that could be left.
            with suppress(OSError, NotImplementedError):
                self._fs.rmdir(self.place.path(STATE))

    @cached_property
    def place(self) -> Place:
        """The place that files go to."""
        return Place(self.url, self.options)

    @property
    def _fs(self) -> Any:
        return self.place.fs

    @cached_property
    def _puts_whole(self) -> bool:
        protocol = self._fs.protocol
        return bool(_PUTS_WHOLE.intersection([protocol] if isinstance(protocol, str) else protocol))

    @property
    def _renames(self) -> bool:
        """Whether `mv` is the file system's own; fsspec's copies and removes."""
        spec = require("fsspec.spec", extra="remote", to="export to a url")
        return type(self._fs).mv is not spec.AbstractFileSystem.mv

    @contextmanager
    def _appearing(self, relative: str) -> Iterator[str]:
        """Where to write so that the file appears under its name when the block ends."""
        path = self.place.path(relative)
        with self.place.reported(relative, "write"):
            if self._puts_whole:
                yield path
                return
            # Of this writer alone: a worker that lost touch may still write the same file.
            temporary = f"{path}.{uuid.uuid4().hex[:8]}{_files.TEMPORARY_SUFFIX}"
            try:
                yield temporary
                self._rename(temporary, path)
            except BaseException:
                with suppress(Exception):
                    self._fs.rm_file(temporary)
                raise

    def _rename(self, source: str, path: str) -> None:
        try:
            self._fs.mv(source, path)
        except OSError:
            # Not every place renames onto a file.
            if not self._fs.exists(path):
                raise
            self._fs.rm_file(path)
            self._fs.mv(source, path)

    def _digest(self, path: str) -> str:
        with self._fs.open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()

    def _json(self, relative: str) -> Any:
        """A JSON file's value; None if it is absent or not one."""
        path = self.place.path(relative)
        with self.place.reported(relative, "read"):
            try:
                if self._fs.info(path)["size"] > _files.MAX_JSON_BYTES:
                    return None
                return _files.parse_json(self._fs.cat_file(path).decode(), str(self))
            except (FileNotFoundError, UnicodeDecodeError, DataError):
                return None

    def __reduce__(self) -> tuple[Any, ...]:
        """Workers open the place themselves.

        Raises:
            ArgumentError: If they would open another one.
        """
        if "memory" in self._fs.protocol:
            raise ArgumentError(f"{self} is seen by this process alone; export with workers=1")
        return (FsspecFolder, (self.url, self.state, dict(self.options)))

    def __str__(self) -> str:
        """The url without user, password and query."""
        return str(self.place)

    __repr__ = __str__


def _is_sealed(contents: Mapping[str, Any]) -> bool:
    """Whether the fields of an `export.json` are those that were sealed."""
    fields = {name: value for name, value in contents.items() if name != "sha256"}
    return bool(json.loads(sealed_contents(fields)) == contents)
