"""What a disk holds after a power cut: what was synced, and perhaps some of the rest."""

from __future__ import annotations

import os
import random
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


class Disk:
    """A folder as its disk knows it: names by synced folders, bytes by synced files.

    Convention:
        Files and folders are told apart by their inodes, which are held open so that none is used
        again.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._names: dict[int, dict[str, int]] = {}
        self._bytes: dict[int, bytes] = {}
        self._held: dict[int, int] = {}

    def synced(self, descriptor: int) -> None:
        """Take down what fsync of `descriptor` has promised."""
        info, path = os.fstat(descriptor), Path(f"/proc/self/fd/{descriptor}")
        if info.st_ino not in self._held:
            self._held[info.st_ino] = os.dup(descriptor)
        if stat.S_ISDIR(info.st_mode):
            self._names[info.st_ino] = {entry.name: entry.inode() for entry in os.scandir(path)}
        else:
            self._bytes[info.st_ino] = path.read_bytes()

    def close(self) -> None:
        """Let the inodes go."""
        for descriptor in self._held.values():
            os.close(descriptor)

    def after_cut(self, place: Path, chance: random.Random | None, *, names_kept: bool) -> None:
        """Write what the disk holds if the power goes now.

        Args:
            place: New folder.
            chance: Draws which of the changes that were not synced are there; none if None.
            names_kept: Names are there as they are now, as where a file system's journal holds
                them; bytes are not.
        """
        self._chance, self._names_kept = chance, names_kept
        live = [self._root, *self._root.rglob("*")]
        self._live = {path.stat().st_ino: path for path in live}
        self._write(self._root.stat().st_ino, place)

    def _write(self, inode: int, place: Path) -> None:
        if inode in self._names or self._is_live_folder(inode):
            place.mkdir()
            for name, entry in self._entries(inode).items():
                self._write(entry, place / name)
        else:
            place.write_bytes(self._content(inode))

    def _entries(self, inode: int) -> dict[str, int]:
        synced = self._names.get(inode, {})
        now = synced
        if self._is_live_folder(inode):
            now = {entry.name: entry.inode() for entry in os.scandir(self._live[inode])}
        if self._chance is None:
            return now if self._names_kept else synced
        drawn = {}
        for name in sorted({**synced, **now}):
            entry = self._chance.choice([synced.get(name), now.get(name)])
            if entry is not None:
                drawn[name] = entry
        return drawn

    def _content(self, inode: int) -> bytes:
        synced = self._bytes.get(inode, b"")
        if self._chance is None or inode not in self._live:
            return synced
        now = self._live[inode].read_bytes()
        if now.startswith(synced):
            return now[: self._chance.randint(len(synced), len(now))]
        return self._chance.choice([synced, now])

    def _is_live_folder(self, inode: int) -> bool:
        return inode in self._live and self._live[inode].is_dir()


@contextmanager
def watched(root: Path, before_sync: Callable[[Disk], None]) -> Iterator[Disk]:
    """Take down each sync below `root`, and call `before_sync` before it."""
    disk, real, busy = Disk(root), os.fsync, [False]

    def sync(descriptor: int) -> None:
        if busy[0] or not Path(f"/proc/self/fd/{descriptor}").resolve().is_relative_to(root):
            return real(descriptor)
        busy[0] = True
        try:
            before_sync(disk)
            real(descriptor)
            disk.synced(descriptor)
        finally:
            busy[0] = False

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", sync)
        try:
            yield disk
        finally:
            disk.close()
