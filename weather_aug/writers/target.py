"""Where the files of samples go: a folder of this machine, or any place that can keep bytes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, Protocol

from weather_aug import _files
from weather_aug.errors import DataError
from weather_aug.writers.layout import STATE, Layout


class Target(Protocol):
    """A place for the files of samples; journal and lock stand in `state`, a local folder.

    Convention:
        Paths are relative, of plain parts divided by "/". A file is whole under its name or absent,
        also when its writer is killed. Targets pickle to workers.
    """

    @property
    def state(self) -> Path:
        """Local folder of lock, journal and root files."""

    def write_whole(self, relative: str, data: bytes) -> None:
        """Write a file so that it is either absent (or the old one) or complete.

        Raises:
            OutputError: If it cannot be written.
        """

    def is_whole(self, relative: str, stored: dict[str, Any], *, digests: bool) -> bool:
        """Whether a file has the `size` and (`digests`) the `sha256` that were recorded."""

    def make_folders(self, relatives: Iterable[str]) -> None:
        """Make folders, where the place knows any.

        Raises:
            OutputError: If one cannot be made.
        """

    def remove_leftovers(self, layout: Layout) -> None:
        """Remove what a killed exporter half wrote below the layout's roots."""


@dataclass(frozen=True)
class LocalFolder:
    """A folder of this machine, or one that it has mounted; see `Target`."""

    path: Path

    @property
    def state(self) -> Path:
        """The folder itself."""
        return self.path

    def write_whole(self, relative: str, data: bytes) -> None:
        """Temporary file, sync, rename."""
        _files.write_whole(self.path / relative, data)

    def is_whole(self, relative: str, stored: dict[str, Any], *, digests: bool) -> bool:
        """Links and ways out of the folder are not followed."""
        try:
            path = _files.file_inside(self.path, relative)
            if path.stat().st_size != stored["size"]:
                return False
            return not digests or _files.sha256_of_file(path) == stored["sha256"]
        except (DataError, OSError):
            return False

    def make_folders(self, relatives: Iterable[str]) -> None:
        """Each with its parents, durably."""
        with _files.reported(self.path):
            self.path.mkdir(parents=True, exist_ok=True)
            # The state's name first: after a power cut, samples without it would be nobody's.
            _files.sync_folder(self.path)
            for relative in relatives:
                folder = self.path / relative
                folder.mkdir(parents=True, exist_ok=True)
                while folder != self.path:
                    folder = folder.parent
                    _files.sync_folder(folder)

    def remove_leftovers(self, layout: Layout) -> None:
        """Temporary files, of the root files and the state, too."""
        temporary = f"*{_files.TEMPORARY_SUFFIX}"
        with _files.reported(self.path):
            found = [
                *(self.path.glob(temporary), (self.path / STATE).glob(temporary)),
                *((self.path / root).rglob(temporary) for root in layout.roots),
            ]
            for path in chain.from_iterable(found):
                # A folder may be called so, and a writer that lost touch may end meanwhile.
                if not path.is_dir():
                    path.unlink(missing_ok=True)
