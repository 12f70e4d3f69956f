"""How loops are compiled here: one decorator, so that all kernels keep the same promises.

Serial and without fast-math, so that bits do not depend on threads or on how far the compiler
reassociates; without the interpreter lock. Going without fast-math costs little: on a CPU with
AVX-512 a frame of even fog, of fog with rain and of snow was slower with it by 8 to 11 %, one of
uneven fog faster by 4 %, and up to one value in 100,000 changed by a level. Division follows IEEE
754 (no ZeroDivisionError), because the check would keep loops from being vectorised.

The machine code is cached on disk where a folder can be written: in NUMBA_CACHE_DIR if it is set,
else in `__pycache__` beside the source, else in the user's cache folder; never in a place that all
users share, unless NUMBA_CACHE_DIR names one. A cache file is a pickle, so only files are read that
belong to this user or to the administrator, and they are written for their owner alone. A file that
is damaged, or that another version of numba or of any source file of this package wrote, is
compiled anew: numba itself looks only at the file of the function, would go on using a callee's or
a constant's old self, and would stop at a damaged file.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import tempfile
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import FunctionCache
from numba.core.serialize import dumps


def compiled(function: Callable[..., Any]) -> Any:
    """Compile `function` on first use; see the module's text."""
    return _cached(numba.njit(nogil=True, error_model="numpy")(function))


def inlined(function: Callable[..., Any]) -> Any:
    """Compile `function` into its callers: for small functions inside the hottest loops."""
    return _cached(numba.njit(nogil=True, error_model="numpy", forceinline=True)(function))


def reassociated(function: Callable[..., Any]) -> Any:
    """Compile `function` so that sums may be taken in any order: for gradients only.

    On one machine its bits are the same each time; another may add in another order.
    """
    flags = {"reassoc", "nsz", "contract"}
    return _cached(numba.njit(nogil=True, error_model="numpy", fastmath=flags)(function))


def _cached(dispatcher: Any) -> Any:
    # No folder can be written: every process compiles for itself.
    with contextlib.suppress(RuntimeError):
        dispatcher._cache = _Cache(dispatcher.py_func)
    return dispatcher


class _Cache(FunctionCache):  # type: ignore[misc]
    """Numba's cache of one function, over files that are checked."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        stem = Path(self.cache_path) / self._impl.filename_base
        self._cache_file = CheckedFiles(stem, f"numba {numba.__version__} {_package_stamp()}")

    def save_overload(self, sig: Any, data: Any) -> None:
        # The folder may have gone, or the disk be full, since the import.
        with contextlib.suppress(OSError):
            super().save_overload(sig, data)


class CheckedFiles:
    """One file for each signature of a function, behind a digest of all that it depends on.

    There is no index, so that processes that compile different signatures at the same time cannot
    write over each other's entries.
    """

    def __init__(self, stem: Path, stamp: str) -> None:
        self.stem = stem
        self.stamp = stamp

    def load(self, key: Any) -> Any:
        """What was saved for `key`; None if nothing was, or nothing that can be trusted."""
        try:
            with self._path(key).open("rb") as file:
                if not _is_trusted(os.fstat(file.fileno())):
                    return None
                digest, data = file.read(_DIGEST_BYTES), file.read()
        except OSError:
            return None
        if digest != self._digest(data):
            return None
        saved_key, value = pickle.loads(data)
        return value if saved_key == key else None

    def save(self, key: Any, value: Any) -> None:
        """Write `value` so that a reader sees all of it or nothing."""
        data = dumps((key, value))
        path = self._path(key)
        # Its owner alone may read what mkstemp makes.
        handle, name = tempfile.mkstemp(prefix=path.name, suffix=".tmp", dir=path.parent)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(self._digest(data) + data)
            Path(name).replace(path)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise

    def flush(self) -> None:
        """Forget all signatures."""
        for path in self.stem.parent.glob(f"{self.stem.name}-*.nbc"):
            path.unlink(missing_ok=True)

    def _path(self, key: Any) -> Path:
        name = hashlib.sha256(repr(key).encode()).hexdigest()[:16]
        return self.stem.with_name(f"{self.stem.name}-{name}.nbc")

    def _digest(self, data: bytes) -> bytes:
        return hashlib.sha256(self.stamp.encode() + data).digest()


_DIGEST_BYTES = hashlib.sha256().digest_size


def _is_trusted(status: os.stat_result) -> bool:
    """Whether nobody but this user or the administrator can have written a file."""
    if not hasattr(os, "getuid"):
        return True
    return status.st_uid in (0, os.getuid()) and not status.st_mode & 0o022


@lru_cache(maxsize=1)
def _package_stamp() -> str:
    """Digest of all sources of the package."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()
