"""Random numbers keyed by what is drawn, never by who draws it or in which order.

A key is a 128-bit BLAKE2b hash of a domain and fixed-width fields; the numbers behind it come from
a counter-based generator (Philox). The maps from 64-bit words to uniforms are ours, because numpy
guarantees the words of a bit generator across versions, not the numbers of `Generator` (NEP 19).
"""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

from weather_aug.errors import ArgumentError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_LOW, _HIGH = -(2**63), 2**64


def key_of(domain: str, *fields: int) -> int:
    """Hash `domain` and integer `fields` into a 128-bit key; equal input, equal key.

    Each field fills 16 bytes, so that no two lists of fields collide by concatenation.

    Raises:
        ArgumentError: If a field is not an integer in [-2**63, 2**64).
    """
    # A domain longer than 16 bytes is refused by the hash; it must not lose its end.
    digest = hashlib.blake2b(digest_size=16, person=domain.encode())
    digest.update(len(fields).to_bytes(8, "little"))
    for field in fields:
        value = check_seed("field", field)
        digest.update(value.to_bytes(16, "little", signed=True))
    return int.from_bytes(digest.digest(), "little")


def uniforms(key: int, count: int) -> NDArray[np.float64]:
    """`count` numbers in [0, 1), each on a grid of 2**-53, that depend on `key` alone."""
    import numpy as np

    words = np.random.Philox(key=key).random_raw(count)
    uniform: NDArray[np.float64] = (words >> np.uint64(11)).astype(np.float64) * 2.0**-53
    return uniform


def check_seed(name: str, value: int) -> int:
    """Return `value` as a Python int, or refuse it by `name`."""
    try:
        number = value.__index__()
    except (AttributeError, TypeError):
        raise ArgumentError(f"{name} must be an integer, got {type(value).__name__}") from None
    if isinstance(value, bool) or not _LOW <= number < _HIGH:
        raise ArgumentError(f"{name} must be an integer in [-2**63, 2**64), got {value!r}")
    return number
