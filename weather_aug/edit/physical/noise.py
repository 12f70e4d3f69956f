"""World-anchored noise: where snow lies first and water stands longest.

A square tile of fractal value noise, spread so that every level is equally frequent, with half-size
copies for what is far away. Two looks at it, far apart in scale and turned against each other, do
not repeat within a street.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import inlined
from weather_aug._keys import key_of

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]

TILE_CELLS = 512
CELL_M = 0.06
"""Side of a cell at the fine look; 16 times that at the coarse one."""
LEVELS = 8
"""Copies, each half the size of the one before."""
COARSER = 16.0
COARSE_SHARE = 0.62
"""Of the sum of both looks."""
TURN = (0.8, 0.6)
"""Cosine and sine of the angle between the looks."""
PERIOD_M = 5 * TILE_CELLS * CELL_M * COARSER
"""Along and left: a multiple of both looks' periods, turned by `TURN` or not."""
_COARSEST_LATTICE, _OCTAVES, _GAIN = 8, 6, 0.62


@cache
def noise_tile() -> UInt8:
    """The tile and its smaller copies end to end, (N,) uint8: level 0 has 512 x 512 cells."""
    level = _spread(_fractal())
    copies = [level]
    for _ in range(LEVELS - 1):
        level = 0.25 * (level[::2, ::2] + level[1::2, ::2] + level[::2, 1::2] + level[1::2, 1::2])
        copies.append(level)
    tile = np.concatenate([np.round(255 * copy).astype(np.uint8).ravel() for copy in copies])
    tile.flags.writeable = False
    return tile


def _fractal() -> NDArray[np.float64]:
    """Sum of octaves of periodic value noise; additions and products only, for equal bits."""
    total = np.zeros((TILE_CELLS, TILE_CELLS))
    for octave in range(_OCTAVES):
        lattice = _COARSEST_LATTICE << octave
        total += _GAIN**octave * _value_noise(lattice, octave)
    return total


def _value_noise(lattice: int, octave: int) -> NDArray[np.float64]:
    index = np.arange(lattice * lattice, dtype=np.uint64)
    word = index * np.uint64(0x9E3779B97F4A7C15) + np.uint64(key_of("noise-tile", octave) % 2**64)
    word = (word ^ (word >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    word = (word ^ (word >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    knots = ((word ^ (word >> np.uint64(31))) >> np.uint64(11)).astype(np.float64) / 2.0**53
    knots = knots.reshape(lattice, lattice)
    place = np.arange(TILE_CELLS) * (lattice / TILE_CELLS)
    low = place.astype(np.int64)
    part = place - low
    weight = part * part * (3 - 2 * part)
    high = (low + 1) % lattice
    rows = knots[low] + weight[:, None] * (knots[high] - knots[low])
    return rows[:, low] + weight * (rows[:, high] - rows[:, low])


def _spread(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same order of values, evenly spread over [0, 1]."""
    rank = np.empty(values.size)
    rank[np.argsort(values, axis=None, kind="stable")] = np.arange(values.size)
    return (rank / (values.size - 1)).reshape(values.shape)


@inlined
def looked_up(tile, u, v, level):
    """Bilinear value in [0, 1] at (u, v), in cells of level 0, on a copy of the tile."""
    size = np.int32(TILE_CELLS) >> level
    # Level k starts after 512^2 (1 + 1/4 + ... + 1/4^(k-1)) = 4/3 (512^2 - size^2) cells.
    start = (np.int32(4 * TILE_CELLS * TILE_CELLS) - np.int32(4) * size * size) // np.int32(3)
    scale = np.float32(1.0) / np.float32(np.int32(1) << level)
    half = np.float32(0.5)
    x, y = u * scale - half, v * scale - half
    left, top = np.floor(x), np.floor(y)
    right_share, lower_share = x - left, y - top
    mask = size - np.int32(1)
    column, row = np.int32(left) & mask, np.int32(top) & mask
    next_column, next_row = (column + np.int32(1)) & mask, (row + np.int32(1)) & mask
    above, below = start + row * size, start + next_row * size
    a, b = np.float32(tile[above + column]), np.float32(tile[above + next_column])
    c, d = np.float32(tile[below + column]), np.float32(tile[below + next_column])
    upper = a + right_share * (b - a)
    lower = c + right_share * (d - c)
    return (upper + lower_share * (lower - upper)) * np.float32(1.0 / 255.0)


@inlined
def ground_noise(tile, along, left, footprint_m, offset):
    """Noise in [0, 1], evenly spread, of a place on the ground; `offset` chooses another one.

    Args:
        tile: Of `noise_tile`.
        along: Metres.
        left: Metres.
        footprint_m: Size of the pixel on the ground: what is smaller is averaged.
        offset: Metres at the fine look. At the coarse one, whose patches are larger than a few
            metres, it is as many cells.
    """
    per_m = np.float32(1.0 / CELL_M)
    level = np.int32(0)
    wide = footprint_m * per_m
    while wide > np.float32(1.5) and level < np.int32(LEVELS - 1):
        wide *= np.float32(0.5)
        level += np.int32(1)
    fine = looked_up(tile, (along + offset) * per_m, (left - offset) * per_m, level)
    coarse_level = level - np.int32(4)
    coarse_level = coarse_level if coarse_level > np.int32(0) else np.int32(0)
    turned_u = np.float32(TURN[0]) * along + np.float32(TURN[1]) * left
    turned_v = np.float32(TURN[0]) * left - np.float32(TURN[1]) * along
    slow = per_m * np.float32(1.0 / COARSER)
    aside = offset * per_m
    coarse = looked_up(tile, turned_u * slow - aside, turned_v * slow + aside, coarse_level)
    return evened(np.float32(COARSE_SHARE) * coarse + np.float32(1.0 - COARSE_SHARE) * fine)


@inlined
def evened(value):
    """Distribution function of the sum of both looks: what makes it evenly spread again."""
    a, b = np.float32(COARSE_SHARE), np.float32(1.0 - COARSE_SHARE)
    one, half = np.float32(1.0), np.float32(0.5)
    two_ab = np.float32(2.0) * a * b
    if value < b:
        return value * value / two_ab
    if value > a:
        return one - (one - value) * (one - value) / two_ab
    return (value - half * b) / a
