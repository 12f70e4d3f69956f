"""Particles over a band of rows, in tiles of 4 x 4 pixels. Compiled.

A particle's footprint is a few pixels wide and a few high: sixteen pixels in a square hold most of
it, sixteen in a row would not. A band is rows of planes (red, green, blue, transmittance, depth);
the tiles that a particle touches are copied out of it, blended in one piece, and copied back when
the band is done. Loops over a tile run over `range(16)` with constant offsets and no branches, so
that the compiler makes straight vector code of them on any machine; each pixel's numbers are the
same whichever tile it falls into.
"""

from __future__ import annotations

import numpy as np

from weather_aug._compiled import compiled, inlined
from weather_aug.render.project import (
    CONIC,
    DEPTH,
    HALF_HEIGHT,
    HALF_WIDTH,
    HIDING_ALPHA,
    LEAN,
    LIGHT,
    PEAK,
    REACH2,
    U,
    V,
)

PLANES = 5
"""Red, green, blue, transmittance, depth."""
TILE_FLOATS = 16 * PLANES
NEAR_EDGE_M = 0.1
"""A particle fades out from this far in front of a surface to as far behind it."""


@compiled
def blend_band(splats, window, band_top, planes, tiles):
    """Blend splats, in their order, over one band.

    Args:
        splats: (M, 16) float32 of `project`: those that touch the band, far to near.
        window: (top, left, height, width) in the whole picture.
        band_top: First row of the band in the window.
        planes: (rows, 5, stride) float32 linear light, transmittance and depth of the band; rows
            and stride are multiples of 4, what lies beyond the window is of no account.
        tiles: (rows / 4, stride / 4, 80) float32 scratch.
    """
    if splats.shape[0] == 0:
        return
    top, left, height, width = window
    rows, columns = min(planes.shape[0], height - band_top), width
    for i in range((rows + 3) >> 2):
        for j in range((columns + 3) >> 2):
            _load(tiles[i, j], planes, 4 * i, 4 * j)
    for m in range(splats.shape[0]):
        s = splats[m]
        u, v = s[U] - np.float32(left), s[V] - np.float32(top + band_top)
        conic = (s[CONIC], s[CONIC + 1], s[CONIC + 2])
        shape = (s[U], s[V], *conic, s[REACH2], s[PEAK], s[DEPTH])
        colour = (s[LIGHT], s[LIGHT + 1], s[LIGHT + 2])
        half_v, half_u, lean = s[HALF_HEIGHT], s[HALF_WIDTH], s[LEAN]
        first = max(int(np.floor(v - half_v)), 0) >> 2
        last = min(int(np.ceil(v + half_v)), rows - 1) >> 2
        half_u += abs(lean) * np.float32(1.5)
        for i in range(first, last + 1):
            middle = u + lean * (np.float32(4 * i) + np.float32(1.5) - v)
            start = max(int(np.floor(middle - half_u)), 0) >> 2
            stop = min(int(np.ceil(middle + half_u)), columns - 1) >> 2
            for j in range(start, stop + 1):
                x, y = np.float32(left + 4 * j), np.float32(top + band_top + 4 * i)
                _blend(tiles[i, j], shape, colour, x, y)
    for i in range((rows + 3) >> 2):
        for j in range((columns + 3) >> 2):
            _store(tiles[i, j], planes, 4 * i, 4 * j)


@inlined
def _load(tile, planes, y, x):
    for p in range(5):
        for r in range(4):
            # Read before written: four at a time go through one register.
            a, b = planes[y + r, p, x], planes[y + r, p, x + 1]
            c, d = planes[y + r, p, x + 2], planes[y + r, p, x + 3]
            k = 16 * p + 4 * r
            tile[k], tile[k + 1], tile[k + 2], tile[k + 3] = a, b, c, d


@inlined
def _store(tile, planes, y, x):
    for p in range(4):
        for r in range(4):
            k = 16 * p + 4 * r
            a, b, c, d = tile[k], tile[k + 1], tile[k + 2], tile[k + 3]
            planes[y + r, p, x], planes[y + r, p, x + 1] = a, b
            planes[y + r, p, x + 2], planes[y + r, p, x + 3] = c, d


@inlined
def _alpha(dx, dy, ahead, a, b, c, reach2, peak):
    """Opacity of a splat (dx, dy) pixels from its middle and `ahead` metres before the surface.

    exp(-p / 2) is (exp(-p / 16))^8 with a fourth-order series: 1 % off where the footprint ends,
    1e-5 at its middle. A particle fades into the surface behind it within 20 cm.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    power = (a * dx + np.float32(2.0) * b * dy) * dx + c * dy * dy
    e = power * np.float32(-0.0625)
    fall = one + e * np.float32(0.25)
    fall = one + e * np.float32(1.0 / 3.0) * fall
    fall = one + e * np.float32(0.5) * fall
    fall = one + e * fall
    fall = fall * fall
    fall = fall * fall
    fall = fall * fall
    before = np.float32(0.5) + np.float32(0.5 / NEAR_EDGE_M) * ahead
    before = before if before > zero else zero
    before = before if before < one else one
    alpha = peak * fall * before
    return alpha if power <= reach2 else zero


@inlined
def _blend(tile, shape, colour, x, y):
    """Blend a splat into the tile whose first pixel is (x, y) of the whole picture."""
    u, v, a, b, c, reach2, peak, z = shape
    red, green, blue = colour
    one = np.float32(1.0)
    for k in range(16):
        dx = x + np.float32(np.int32(k) & np.int32(3)) - u
        dy = y + np.float32(np.int32(k) >> np.int32(2)) - v
        alpha = _alpha(dx, dy, tile[64 + k] - z, a, b, c, reach2, peak)
        tile[k] += alpha * (red - tile[k])
        tile[16 + k] += alpha * (green - tile[16 + k])
        tile[32 + k] += alpha * (blue - tile[32 + k])
        tile[48 + k] *= one - alpha


@compiled
def cover_splat(splat, rows, window, planes, covered):
    """Set `covered` (H, W) of the window where a splat is more than half opaque.

    `planes` starts at row rows[0] of the window; rows [rows[0], rows[1]) are looked at.
    """
    top, left, _, width = window
    u, v, half_v = splat[U] - np.float32(left), splat[V] - np.float32(top), splat[HALF_HEIGHT]
    half_u = half_v * abs(splat[LEAN]) + splat[HALF_WIDTH]
    first = max(int(np.floor(v - half_v)), rows[0])
    last = min(int(np.ceil(v + half_v)), rows[1] - 1)
    start = max(int(np.floor(u - half_u)), 0)
    stop = min(int(np.ceil(u + half_u)), width - 1)
    for y in range(first, last + 1):
        for x in range(start, stop + 1):
            dx, dy = np.float32(x + left) - splat[U], np.float32(y + top) - splat[V]
            ahead = planes[y - rows[0], 4, x] - splat[DEPTH]
            a, b, c = splat[CONIC], splat[CONIC + 1], splat[CONIC + 2]
            if _alpha(dx, dy, ahead, a, b, c, splat[REACH2], splat[PEAK]) > HIDING_ALPHA:
                covered[y, x] = 1
