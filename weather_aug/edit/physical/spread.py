"""From the small grid to pixels."""

from __future__ import annotations

import numpy as np

from weather_aug._compiled import inlined


@inlined
def spread_run(small, first, count, cell, share, x0, x1, b, slot):
    """Maps `first` to `first + count` of one row at pixels x0 to x1, into rows `slot` on of `b`.

    Args:
        small: (maps, w) float32.
        first: Of them.
        count: How many.
        cell: (W,) int32, the cell before each pixel.
        share: (W,) float32, how far each pixel is on the way to the next cell.
        x0: First pixel.
        x1: One past the last.
        b: (rows, >= W) float32 out.
        slot: First row to fill.
    """
    last = np.int32(small.shape[1] - 1)
    for k in range(count):
        for x in range(x0, x1):
            j = cell[x]
            before = small[first + k, j]
            after = small[first + k, min(j + np.int32(1), last)]
            b[slot + k, x] = before + share[x] * (after - before)
