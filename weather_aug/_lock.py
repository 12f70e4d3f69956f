"""One process per output: a lock that the system frees when its holder dies."""

from __future__ import annotations

import fcntl
import json
import os
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from weather_aug import _files
from weather_aug.errors import ConflictError, printable


@contextmanager
def exclusive(path: Path, busy: str) -> Iterator[None]:
    """Hold the lock file `path` alone, or refuse at once.

    The caller removes the file within the block if nothing shall stay of it. A file that stayed
    because its holder was killed is no obstacle.

    Args:
        path: Lock file; its folder is made.
        busy: What is said of a lock that is held, before " by process … on …".

    Raises:
        ConflictError: If another process, or another thread of this one, holds it.
        OutputError: If the file cannot be written.
    """
    descriptor = _acquired(path, busy)
    try:
        yield
    finally:
        # Closing is not enough if this process was forked meanwhile: the child has the lock too.
        fcntl.flock(descriptor, fcntl.LOCK_UN)
        os.close(descriptor)


def try_lock(descriptor: int, mode: int) -> bool:
    """Lock an open file (`fcntl.LOCK_EX` or `LOCK_SH`) without waiting; whether that worked."""
    try:
        fcntl.flock(descriptor, mode | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _acquired(path: Path, busy: str) -> int:
    """A descriptor that holds the lock."""
    with _files.reported(path):
        while True:
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
            except FileNotFoundError:
                continue
            with ExitStack() as opened:
                opened.callback(os.close, descriptor)
                if not try_lock(descriptor, fcntl.LOCK_EX):
                    raise ConflictError(
                        f"{busy} by {_holder_of(path)}; wait for it, or choose another folder"
                    )
                # Else the last holder removed the file between our open and our lock.
                if _is_still(path, descriptor):
                    os.ftruncate(descriptor, 0)
                    os.pwrite(descriptor, _own_name(), 0)
                    opened.pop_all()
                    return descriptor


def _is_still(path: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _own_name() -> bytes:
    return json.dumps({"pid": os.getpid(), "host": socket.gethostname()}).encode()


def _holder_of(path: Path) -> str:
    """Who holds the lock; a holder writes its name a moment after it has the lock."""
    for _ in range(20):
        try:
            holder = json.loads(path.read_text())
            return f"process {int(holder['pid'])} on {printable(holder['host'])}"
        except (OSError, ValueError, KeyError, TypeError):
            time.sleep(0.02)
    return "another process"
