"""One exporter per output: a lock that the system frees when its holder dies."""

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
        ConflictError: If another process holds it, or workers of a dead one still write.
        OutputError: If the lock cannot be written.
    """
    state = out / layout.STATE
    busy = f"{printable(out, 200)} is being exported to"
    with _lock.exclusive(state / _LOCK, busy):
        try:
            _wait_for_orphans(state)
            yield
        finally:
            if not (out / layout.JOURNAL).exists():
                with suppress(OSError):
                    for file in state.iterdir():
                        file.unlink()
                    state.rmdir()


@contextmanager
def working(out: Path) -> Iterator[None]:
    """Mark this process as a worker on `out`: no other exporter starts before it has left.

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
