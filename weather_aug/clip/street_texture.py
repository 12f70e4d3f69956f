"""Noise and edges to paint with: a baked tile with all octaves, and box-filtered patterns (numba).

The tile is periodic and comes with its mip levels, so that one look-up gives every octave that the
pixel can resolve and none that would alias.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled
from weather_aug._keys import key_of, uniforms

Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]
Colour = tuple[float, float, float]

TILE_PX = 512


@functools.cache
def noise_tile() -> Float32:
    """Return the tile of 512 x 512 and its mip levels, one after the other, flat.

    Values have zero mean and a standard deviation of 1/3.
    """
    tile = np.zeros((TILE_PX, TILE_PX))
    amplitude = 1.0
    for octave in range(2, 10):
        count = 2**octave
        lattice = uniforms(key_of("street-noise", octave), count * count).reshape(count, count)
        tile += amplitude * _stretched(lattice - 0.5, TILE_PX // count)
        amplitude *= 0.66
    tile = (tile - tile.mean()) / (3.0 * tile.std())
    levels = [tile]
    while len(levels[-1]) > 1:
        n = len(levels[-1]) // 2
        levels.append(levels[-1].reshape(n, 2, n, 2).mean((1, 3)))
    flat: Float32 = np.concatenate([level.ravel() for level in levels]).astype(np.float32)
    flat.flags.writeable = False
    return flat


def _stretched(lattice: NDArray[np.float64], factor: int) -> NDArray[np.float64]:
    """Interpolate a periodic lattice smoothly to `factor` times its size."""
    share = (np.arange(factor) + 0.5) / factor
    share = share * share * (3.0 - 2.0 * share)
    for axis in range(2):
        a = np.repeat(lattice, factor, axis)
        b = np.repeat(np.roll(lattice, -1, axis), factor, axis)
        weight = np.tile(share, lattice.shape[axis])
        weight = weight[:, None] if axis == 0 else weight[None, :]
        lattice = a + (b - a) * weight
    return lattice


@compiled
def _bilinear(tile: Float32, level: int, u: float, v: float) -> float:
    size = 512 >> level
    # Levels lie behind each other: the sum of 4**9 + 4**8 + ... down to this level.
    offset = ((1 << 20) - (1 << (20 - 2 * level))) // 3
    x, y = u * size - 0.5, v * size - 0.5
    fx, fy = math.floor(x), math.floor(y)
    ax, ay = x - fx, y - fy
    ix, iy = int(fx) & (size - 1), int(fy) & (size - 1)
    jx, jy = (ix + 1) & (size - 1), (iy + 1) & (size - 1)
    row, next_row = offset + iy * size, offset + jy * size
    top = tile[row + ix] + (tile[row + jx] - tile[row + ix]) * ax
    low = tile[next_row + ix] + (tile[next_row + jx] - tile[next_row + ix]) * ax
    return float(top + (low - top) * ay)


@compiled
def noise(tile: Float32, u_m: float, v_m: float, period_m: float, footprint_m: float) -> float:
    """Return the tile's value at a point, filtered to a footprint; about -1..1.

    Args:
        tile: From `noise_tile`.
        u_m: Surface coordinate.
        v_m: Surface coordinate.
        period_m: Length after which the noise repeats; the largest blobs measure a quarter of it.
        footprint_m: Size of the pixel on the surface.
    """
    u, v = u_m / period_m, v_m / period_m
    level = math.log2(max(footprint_m / period_m * 512.0, 1.0))
    fine = int(level)
    if fine >= 8:
        return 0.0
    a, b = _bilinear(tile, fine, u, v), _bilinear(tile, fine + 1, u, v)
    return a + (b - a) * (level - fine)


@compiled
def grain(tile: Float32, u_m: float, v_m: float, period_m: float, footprint_m: float) -> float:
    """Return `noise` without its blobs larger than a 32nd of the period; about -1..1.

    Blobs show where the tile repeats; grain may repeat often and stay unnoticed.
    """
    u, v = u_m / period_m, v_m / period_m
    level = math.log2(max(footprint_m / period_m * 512.0, 1.0))
    fine = int(level)
    if fine >= 4:
        return 0.0
    a, b = _bilinear(tile, fine, u, v), _bilinear(tile, fine + 1, u, v)
    return 2.6 * (a + (b - a) * (level - fine) - _bilinear(tile, 4, u, v))


@compiled
def band(x: float, low: float, high: float, footprint: float) -> float:
    """Return the share of the footprint around x that lies in [low, high]."""
    f = max(footprint, 1e-4)
    return min(max((min(high, x + 0.5 * f) - max(low, x - 0.5 * f)) / f, 0.0), 1.0)


@compiled
def stripe(x: float, period: float, low: float, high: float, footprint: float) -> float:
    """Return `band` for a pattern that repeats; a footprint beyond the period sees the mean."""
    f = min(max(footprint, 1e-4), period)
    x = x - period * math.floor(x / period)
    share = band(x, low, high, f) + band(x - period, low, high, f) + band(x + period, low, high, f)
    return min(share, 1.0)


@compiled
def mixed(a: Colour, b: Colour, share: float) -> Colour:
    """Return a at share 0, b at share 1."""
    return (
        a[0] + (b[0] - a[0]) * share,
        a[1] + (b[1] - a[1]) * share,
        a[2] + (b[2] - a[2]) * share,
    )


@compiled
def times(a: Colour, factor: float) -> Colour:
    """Return a colour made brighter or darker."""
    return a[0] * factor, a[1] * factor, a[2] * factor


@compiled
def smooth(low: float, high: float, x: float) -> float:
    """Return 0 below `low`, 1 above `high`, a smooth step between."""
    t = min(max((x - low) / (high - low), 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)
