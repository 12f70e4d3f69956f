"""A few items of many, spread over all of them, the same for the same job."""

from __future__ import annotations

import numpy as np

from weather_aug._keys import key_of, uniforms


def spread_items(domain: str, digest: str, count: int, wanted: int) -> list[int]:
    """Distinct items in [0, count), one from each of `wanted` equal stretches, in shuffled order.

    Args:
        domain: What they are for, at most 16 bytes.
        digest: Of the job, hexadecimal.
        count: How many items there are, above 0.
        wanted: How many to choose; all where there are no more.
    """
    wanted = min(wanted, count)
    numbers = uniforms(key_of(domain, int(digest[:16], 16)), 2 * wanted)
    ends = [stretch * count // wanted for stretch in range(wanted + 1)]
    items = [
        start + int(place * (end - start))
        for start, end, place in zip(ends[:-1], ends[1:], numbers[:wanted], strict=True)
    ]
    return [items[turn] for turn in np.argsort(numbers[wanted:], kind="stable")]
