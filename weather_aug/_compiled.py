"""How loops are compiled here: one decorator, so that all kernels keep the same promises.

Serial and without fast-math, so that bits do not depend on threads or on how far the compiler
reassociates; without the interpreter lock. Division follows IEEE 754 (no ZeroDivisionError),
because the check would keep loops from being vectorised. The machine code is cached on disk where
a folder can be written, and thrown away when any source file of the package changes: numba itself
looks only at the file of the function, and would go on using a callee's or a constant's old self.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numba


def compiled(function: Callable[..., Any]) -> Any:
    """Compile `function` on first use; see the module's text."""
    return _cached(numba.njit(nogil=True, error_model="numpy")(function))


def inlined(function: Callable[..., Any]) -> Any:
    """Compile `function` into its callers: for small functions inside the hottest loops."""
    return _cached(numba.njit(nogil=True, error_model="numpy", forceinline=True)(function))


def _cached(dispatcher: Any) -> Any:
    try:
        dispatcher.enable_caching()
    except RuntimeError:
        # No folder can be written: every process compiles for itself.
        return dispatcher
    dispatcher._cache._cache_file._source_stamp = _package_stamp()
    return dispatcher


@lru_cache(maxsize=1)
def _package_stamp() -> str:
    """Digest of all sources of the package."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()
