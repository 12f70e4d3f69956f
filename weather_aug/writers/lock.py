"""One exporter per output, or one per shard of it: locks that the system frees with their holders.

An ordinary run holds the output's lock alone. Shards share that lock, and each holds one of its
own, so that shards run beside each other, but neither beside an ordinary run nor twice. Machines
exclude each other where `flock` reaches all of them, see `_lock`. Where it does not, whoever starts
a run beside another loses time or has a run fail, but no samples: files are renamed into place
whole, and a journal is believed line by line, by the digests of the files that it names.
"""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from weather_aug import _files, _lock
from weather_aug.errors import ConflictError, OutputError, printable
from weather_aug.writers import layout

ORPHANS_WAIT_S = 10.0
"""How long a new exporter waits for the workers of a killed one; they leave within 2 s."""

_LOCK = "lock"
_FENCE = "workers"


@contextmanager
def exclusive(out: Path) -> Iterator[None]:
    """Hold the output `out` alone; its state folder goes with the lock unless work is left in it.

    Raises:
        ConflictError: If another process holds it or a shard of it, or workers of a dead one still
            write.
        OutputError: If the lock cannot be written.
    """
    state, shards = out / layout.STATE, out / layout.SHARDS
    with _lock.exclusive(state / _LOCK, _busy(out), shards.glob(f"*/{layout.STATE}/{_LOCK}")):
        try:
            for fences in (state, *shards.glob(f"*/{layout.STATE}")):
                _wait_for_orphans(fences)
            yield
        finally:
            if not (out / layout.JOURNAL).exists():
                _remove(state)
    # On NFS the lock kept its folder while it was open.
    with suppress(OSError):
        state.rmdir()


@contextmanager
def shared(out: Path, shard_state: Path, name: str) -> Iterator[None]:
    """Hold one shard of the output `out` alone, and `out` with other shards.

    Args:
        out: Folder of the output, or the state of one at a url.
        shard_state: What `out` is to an ordinary run.
        name: Of the shard, for people.

    Raises:
        ConflictError: If another process holds the shard or the output, or workers of a dead one
            still write.
        OutputError: If a lock cannot be written.
    """
    own = shard_state / layout.STATE
    with (
        _lock.shared(out / layout.STATE / _LOCK, _busy(out)),
        _lock.exclusive(own / _LOCK, f"{name} of {_busy(out)}"),
    ):
        for fences in (out / layout.STATE, own):
            _wait_for_orphans(fences)
        yield


@contextmanager
def working(out: Path) -> Iterator[None]:
    """Mark this process as a worker on `out`: no other exporter starts before it has left.

    Args:
        out: Folder of the output; the state of one at a url, or of a shard.

    Raises:
        ConflictError: If a new exporter already took the output over.
    """
    descriptor = os.open(out / layout.STATE / _FENCE, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        if not _lock.try_lock(descriptor, fcntl.LOCK_SH):
            raise ConflictError(f"{printable(out, 200)} was taken over by another exporter")
        yield
    finally:
        os.close(descriptor)


def _busy(out: Path) -> str:
    return f"{printable(out, 200)} is being exported to"


def _remove(state: Path) -> None:
    """Remove a state folder, its lock last, as another exporter may start when that is gone."""
    with suppress(OSError):
        lock = state / _LOCK
        for path in sorted(state.rglob("*"), reverse=True):
            if path != lock:
                path.rmdir() if path.is_dir() else path.unlink()
        lock.unlink()
        state.rmdir()


def _wait_for_orphans(state: Path) -> None:
    fence = state / _FENCE
    with _files.reported(fence):
        descriptor = os.open(fence, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        deadline = time.monotonic() + ORPHANS_WAIT_S
        while not _lock.try_lock(descriptor, fcntl.LOCK_EX):
            if time.monotonic() > deadline:
                raise ConflictError(
                    f"workers of an earlier export still write to {printable(state.parent, 200)}; "
                    "end them, then run it again"
                )
            time.sleep(0.02)
    finally:
        os.close(descriptor)


def check_output(out: Path, scenes: list[Path]) -> Path:
    """Return `out` as an absolute path of a folder that may be exported to; make it if needed.

    Raises:
        ConflictError: If the folder holds something that is not an export.
        OutputError: If it lies inside a scene, is a file, or cannot be made.
    """
    try:
        out = out.resolve()
        inside = [scene for scene in scenes if out.is_relative_to(scene.resolve())]
    except (OSError, RuntimeError) as error:
        raise OutputError(f"cannot write to {printable(out, 200)}: {error}") from None
    if inside:
        raise OutputError(
            f"{printable(out, 200)} lies inside the scene {printable(inside[0], 200)}; choose a "
            "folder outside it"
        )
    if out.exists() and not out.is_dir():
        raise OutputError(f"{printable(out, 200)} is not a folder; choose another output")
    with _files.reported(out):
        out.mkdir(parents=True, exist_ok=True)
        foreign = {entry.name for entry in out.iterdir()} - {layout.STATE}
        known = any((out / own).exists() for own in (layout.CONTENTS, layout.JOURNAL))
        if foreign and not known:
            raise ConflictError(
                f"{printable(out, 200)} is no export, but holds {printable(sorted(foreign)[0])}; "
                "choose an empty or new folder"
            )
    return out
