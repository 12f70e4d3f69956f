"""From the small grid to pixels."""

from __future__ import annotations

import numpy as np

from weather_aug._compiled import compiled


@compiled
def spread_run(small, first, count, cell, share, x0, x1, b, slot):
    """Maps `first` to `first + count` of one row at pixels x0 to x1, into rows `slot` on of `b`.

    Args:
        small: (maps, w + 1) float32.
        first: Of them.
        count: How many.
        cell: (W,) uint32, the cell before each pixel.
        share: (W,) float32, how far each pixel is on the way to the next cell.
        x0: First pixel, unsigned: an index that may be negative keeps loops from being vectorised.
        x1: One past the last, unsigned.
        b: (rows, >= W) float32 out.
        slot: First row to fill.
    """
    for k in range(count):
        for x in range(x0, x1):
            j = cell[x]
            before = small[first + k, j]
            after = small[first + k, j + np.uint32(1)]
            b[slot + k, x] = before + share[x] * (after - before)
