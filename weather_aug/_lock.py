"""One process per output: a lock that the system frees when its holder dies.

It is `flock`. Linux sends it to the server of an NFS mount (v3 with lockd, v4), so that machines
exclude each other there, unless it is mounted with nolock or local_lock; on Lustre it needs the
mount option flock.
"""

from __future__ import annotations

import fcntl
import json
import os
import socket
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from weather_aug import _files
from weather_aug.errors import ConflictError, printable

# Whoever looks for the name of a holder has the lock for a moment; that is waited for.
_ATTEMPTS = 3
_MOMENT_S = 0.02


@contextmanager
def exclusive(path: Path, busy: str, sharers: Iterable[Path] = ()) -> Iterator[None]:
    """Hold the lock file `path` alone, or refuse at once.

    The caller removes the file within the block if nothing shall stay of it. A file that stayed
    because its holder was killed is no obstacle.

    Args:
        path: Lock file; its folder is made.
        busy: What is said of a lock that is held, before " by process … on …".
        sharers: Lock files of which those that share `path` hold one each, to name one of them.

    Raises:
        ConflictError: If another process, or another thread of this one, holds it.
        OutputError: If the file cannot be written.
    """
    with _held(path, fcntl.LOCK_EX, busy, sharers) as descriptor:
        with _files.reported(path):
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, _own_name(), 0)
        yield


@contextmanager
def shared(path: Path, busy: str) -> Iterator[None]:
    """Hold the lock file `path` with others that share it; see `exclusive`.

    The file does not name those that share it, and they must not remove it.
    """
    with _held(path, fcntl.LOCK_SH, busy):
        yield


@contextmanager
def _held(path: Path, mode: int, busy: str, sharers: Iterable[Path] = ()) -> Iterator[int]:
    descriptor = _acquired(path, mode, busy, sharers)
    try:
        yield descriptor
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


def _acquired(path: Path, mode: int, busy: str, sharers: Iterable[Path]) -> int:
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
                if not _lock_soon(descriptor, mode):
                    holder = _holder_of(next(filter(_is_held, sharers), path))
                    raise ConflictError(
                        f"{busy} by {holder}; wait for it, or choose another folder"
                    )
                # Else the last holder removed the file between our open and our lock.
                if _is_still(path, descriptor):
                    opened.pop_all()
                    return descriptor


def _lock_soon(descriptor: int, mode: int) -> bool:
    for attempt in range(_ATTEMPTS):
        if attempt:
            time.sleep(_MOMENT_S)
        if try_lock(descriptor, mode):
            return True
    return False


def _is_held(path: Path) -> bool:
    try:
        descriptor = os.open(path, os.O_RDWR)
    except OSError:
        return False
    try:
        return not try_lock(descriptor, fcntl.LOCK_SH)
    finally:
        os.close(descriptor)


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
