"""How loops are compiled here: one decorator, so that all kernels keep the same promises.

Serial and without fast-math, so that bits do not depend on threads or on how far the compiler
reassociates; cached on disk; without the interpreter lock. Division follows IEEE 754 (no
ZeroDivisionError), because the check would keep loops from being vectorised.
"""

from __future__ import annotations

import numba

compiled = numba.njit(cache=True, nogil=True, error_model="numpy")
