"""Orders that are keyed, as every draw is: the same wherever they are made."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from weather_aug._keys import key_of, uniforms


@lru_cache(maxsize=4)
def permutation(domain: str, seed: int, epoch: int, count: int) -> NDArray[np.int64]:
    """(count,) numbers 0..count-1 in a random order, read-only.

    The items are sorted by random words. Each word ends in its item's number, so that no two are
    equal and every way of sorting gives the same order.

    Args:
        domain: At most 16 bytes; orders for other purposes differ.
        seed: In [-2**63, 2**64), as is the epoch.
        epoch: Of the training.
        count: Above 0.
    """
    low = np.uint64((1 << max(count - 1, 1).bit_length()) - 1)
    words = np.random.Philox(key=key_of(domain, seed, epoch)).random_raw(count)
    ordered = np.sort((words & ~low) | np.arange(count, dtype=np.uint64)) & low
    order = ordered.astype(np.int64)
    order.flags.writeable = False
    return order


def dealt(seed: int, epoch: int, item: int, count: int) -> float:
    """A number in (0, 1) for each item, so evenly spread that shares of them are exact.

    Of an epoch's `count` numbers, those in an interval of length s are `count * s`, rounded up or
    down (systematic sampling); which item has which number is random.
    """
    # Half a step of a coarse grid: no number falls on the bound of two intervals.
    offset = (int(uniforms(key_of("dealt offset", seed, epoch), 1)[0] * 2**20) + 0.5) / 2**20
    return (int(permutation("dealt", seed, epoch, count)[item]) + offset) / count
