"""Noise, glare and compression of a camera's picture, row by row. Compiled.

A pixel's noise is a hash of its place in the whole picture, so a window has the pixels of the whole
one. Rows are padded to whole vectors: the few pixels left over would cost as much as hundreds.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled, inlined
from weather_aug._rows import apart_row, encoded, together_row
from weather_aug.particles.kernels import GOLDEN, mix64
from weather_aug.render.compression import BLOCK_PX, compress

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]

REACH_PX = 2
"""How far a pixel's colour looks for photosites of that colour."""
_BYTES_VARIANCE = 4.0 * (256.0**2 - 1.0) / 12.0
MOSAIC_SCALE = np.float32(2.0 * _BYTES_VARIANCE**-0.5)
"""Makes the deviation of a sum of four bytes 2, which filling in colours halves."""
FINE_SCALE = np.float32((0.4 * _BYTES_VARIANCE) ** -0.5)
"""The same for brightness, whose variance the smoothing by (3/5, 4 x 1/10) multiplies by 2/5."""
COLOUR_SHARE = 0.8
"""Deviation of a photosite's colour noise over that of its brightness."""
SIDE_SCALE = np.float32((1.0 + COLOUR_SHARE**2 * 7.0 / 8.0) ** -0.5)
MIDDLE_SCALE = np.float32((1.0 + COLOUR_SHARE**2 * 3.0 / 8.0) ** -0.5)
"""Of red and blue, and of green: less (R + 2 G + B) / 4 they have variances of 7/8 and 3/8."""


@compiled
def expose(
    image: UInt8,
    corner: tuple[np.int64, np.int64],
    key: np.uint64,
    sigma: Float32,
    light: Float32,
    kept: np.float32,
    across: Float32,
    rows: NDArray[np.int64],
    shares: Float32,
    steps: Float32,
    out: UInt8,
) -> None:
    """Add glare, then noise, to a window, and compress it.

    Eight rows at a time, because a block's pixels are then still at hand.

    Args:
        image: (H, W, 3) sRGB levels.
        corner: (top, left) of the window in the whole picture, pixels.
        key: Of the frame's noise.
        sigma: (256,) float32 standard deviation of the noise by level, levels; (0,) for no noise.
        light: (256,) float32 linear light by level.
        kept: Share of the light that is not scattered.
        across: (h, 3, W rounded up to a multiple of 16) veil as it is on each row of the small
            picture; (0, 3, ...) for no glare.
        rows: (H,) first of the two rows of `across` between which a row lies.
        shares: (H,) float32 share of the second.
        steps: (3, 8, 8) float32 steps of the compression; (0, 8, 8) for none.
        out: (H, W, 3) uint8 out.
    """
    top, left = corner
    height, width, _ = image.shape
    wide = across.shape[2]
    raw = np.zeros((5, wide + 2 * REACH_PX), np.float32)
    fine = np.zeros_like(raw)
    own, other = np.empty(wide + 2 * REACH_PX, np.float32), np.empty(raw.shape[1], np.float32)
    noise = np.empty((3, wide), np.float32)
    level, deviation = np.empty(wide, np.float32), np.empty(wide, np.float32)
    noisy, veiled = sigma.shape[0] > 0, across.shape[0] > 0
    strip = np.zeros((3, BLOCK_PX, wide), np.uint8)
    words = strip.view(np.uint64)
    odd = np.empty(wide, np.bool_)
    for x in range(wide):
        odd[x] = (x + left) & 1 == 1
    if noisy:
        for k in range(4):
            v = top - REACH_PX + k
            _draw_row(key, v, left, raw[v % 5], fine[v % 5])
    for y in range(height):
        k = y % BLOCK_PX
        apart_row(image[y], strip[0, k], strip[1, k], strip[2, k])
        if noisy:
            v = top + y
            _draw_row(key, v + REACH_PX, left, raw[(v + REACH_PX) % 5], fine[(v + REACH_PX) % 5])
            a, b, c, d = raw[(v - 2) % 5], raw[(v - 1) % 5], raw[v % 5], raw[(v + 1) % 5]
            e = raw[(v + 2) % 5]
            _columns(a, b, c, d, e, own, other)
            if v & 1 == 0:
                _fill_in(own, odd, True, noise[0])
                _fill_in_green(b, c, d, odd, True, noise[1])
                _fill_in(other, odd, False, noise[2])
            else:
                _fill_in(other, odd, True, noise[0])
                _fill_in_green(b, c, d, odd, False, noise[1])
                _fill_in(own, odd, False, noise[2])
            _add_brightness(fine[(v - 1) % 5], fine[v % 5], fine[(v + 1) % 5], noise)
        if noisy or veiled:
            for channel in range(3):
                levels = strip[channel, k]
                if veiled:
                    upper, lower = across[rows[y], channel], across[rows[y] + 1, channel]
                    _look_up_row(levels, light, level)
                    _veil_row(kept, upper, lower, shares[y], level)
                else:
                    _copy_row(levels, level)
                if noisy:
                    _look_up_row(levels, sigma, deviation)
                    _add_noise(deviation, noise[channel], level)
                _round_row(level, levels)
        if k + 1 < BLOCK_PX and y + 1 < height:
            continue
        if steps.shape[0] > 0:
            _fill_blocks(strip, k + 1, width)
            compress(words, steps)
        for i in range(k + 1):
            together_row(strip[0, i], strip[1, i], strip[2, i], out[y - k + i])


@compiled
def _fill_blocks(strip: UInt8, height: np.int64, width: np.int64) -> None:
    """Repeat the last column and row of a strip in the blocks that the picture's end cuts."""
    for channel in range(3):
        for y in range(height):
            row = strip[channel, y]
            for x in range(width, (width + BLOCK_PX - 1) // BLOCK_PX * BLOCK_PX):
                row[x] = row[width - 1]
        for y in range(height, BLOCK_PX):
            strip[channel, y] = strip[channel, height - 1]


@compiled
def spread_across(veil: Float32, columns: NDArray[np.int64], shares: Float32, out: Float32) -> None:
    """Draw a small picture (h, w, 3) out to the columns of a window, (h, 3, W).

    Column x lies `shares[x]` of the way from the small picture's column `columns[x]` to the next.
    """
    for y in range(veil.shape[0]):
        for channel in range(3):
            for x in range(columns.shape[0]):
                a, b = veil[y, columns[x], channel], veil[y, columns[x] + 1, channel]
                out[y, channel, x] = a + shares[x] * (b - a)


@compiled
def _draw_row(key: np.uint64, y: np.int64, left: np.int64, raw: Float32, fine: Float32) -> None:
    """Two independent, nearly Gaussian numbers for each photosite of row `y`.

    The row's key enters the pixels' hash at two places: entering it once, rows would be shifted
    copies of each other. A second round of the hash gives the second number.
    """
    word = mix64(key + np.uint64(y) * GOLDEN)
    first, second = np.uint32(word), np.uint32(word >> np.uint64(32))
    start = np.uint32(np.int64(left) - np.int64(REACH_PX))
    for x in range(raw.shape[0]):
        h = np.uint32(np.uint32(np.uint32(x) + start) * np.uint32(0x9E3779B9)) ^ first
        h = np.uint32(np.uint32(h ^ np.uint32(h >> np.uint32(16))) * np.uint32(0x7FEB352D))
        h = np.uint32(h + second)
        h = np.uint32(np.uint32(h ^ np.uint32(h >> np.uint32(15))) * np.uint32(0x846CA68B))
        h = np.uint32(h ^ np.uint32(h >> np.uint32(16)))
        raw[x] = MOSAIC_SCALE * _sum_of_bytes(h)
        h = np.uint32(np.uint32(h + first) * np.uint32(0x21F0AAAD))
        h = np.uint32(np.uint32(h ^ np.uint32(h >> np.uint32(15))) * np.uint32(0xD35A2D97))
        fine[x] = FINE_SCALE * _sum_of_bytes(np.uint32(h ^ np.uint32(h >> np.uint32(15))))


@inlined
def _sum_of_bytes(h: np.uint32) -> np.float32:
    """Less its mean, 510."""
    byte = np.uint32(255)
    low = np.uint32(h & byte) + np.uint32(np.uint32(h >> np.uint32(8)) & byte)
    high = np.uint32(np.uint32(h >> np.uint32(16)) & byte) + np.uint32(h >> np.uint32(24))
    return np.float32(np.int32(np.uint32(low + high)) - np.int32(510))


@compiled
def _columns(
    a: Float32, b: Float32, c: Float32, d: Float32, e: Float32, own: Float32, other: Float32
) -> None:
    """Fill in, down the columns, what lies on every second row.

    Args:
        a: Photosites two rows above.
        b: One row above.
        c: The row itself.
        d: One row below.
        e: Two rows below.
        own: Out, for the colour that this row has.
        other: Out, for the colour of the rows beside it.
    """
    near, far, half = np.float32(2.0 / 3.0), np.float32(1.0 / 6.0), np.float32(0.5)
    for x in range(own.shape[0]):
        own[x] = near * c[x] + far * (a[x] + e[x])
        other[x] = half * (b[x] + d[x])


@compiled
def _fill_in(row: Float32, odd: NDArray[np.bool_], on_even: bool, out: Float32) -> None:
    """Fill in, along a row, what lies on every second column.

    Weights (1, 4, 1) / 6 on the colour's own photosites and (1, 1) / 2 between them: both halve the
    variance, so that the grain shows no pattern of two pixels.
    """
    near, far, half = np.float32(2.0 / 3.0), np.float32(1.0 / 6.0), np.float32(0.5)
    for x in range(out.shape[0]):
        on = near * row[x + 2] + far * (row[x] + row[x + 4])
        between = half * (row[x + 1] + row[x + 3])
        out[x] = on if odd[x] != on_even else between


@compiled
def _fill_in_green(
    above: Float32,
    row: Float32,
    below: Float32,
    odd: NDArray[np.bool_],
    on_odd: bool,
    out: Float32,
) -> None:
    """Fill in green, which lies on every second pixel as the black squares of a chessboard.

    2 / 5 of a green photosite and 3 / 20 of its four diagonal neighbours; a quarter of the four
    neighbours elsewhere: both leave a quarter of the variance.
    """
    near, far, quarter = np.float32(0.4), np.float32(0.15), np.float32(0.25)
    for x in range(out.shape[0]):
        corners = above[x + 1] + above[x + 3] + below[x + 1] + below[x + 3]
        on = near * row[x + 2] + far * corners
        between = quarter * (row[x + 1] + row[x + 3] + above[x + 2] + below[x + 2])
        out[x] = on if odd[x] == on_odd else between


@compiled
def _add_brightness(above: Float32, row: Float32, below: Float32, noise: Float32) -> None:
    """Turn the noise of colours (3, W) into that of pixels, each colour with variance 1.

    Their brightness is replaced by a finer one: filling in takes colours from far, but detail, and
    with it the noise, from near; and cameras smooth colours more.
    """
    near, far = np.float32(0.6), np.float32(0.1)
    quarter, half, kept = np.float32(0.25), np.float32(0.5), np.float32(COLOUR_SHARE)
    side, middle = SIDE_SCALE, MIDDLE_SCALE
    red, green, blue = noise[0], noise[1], noise[2]
    for x in range(red.shape[0]):
        around = (row[x + 1] + row[x + 3]) + (above[x + 2] + below[x + 2])
        grey = quarter * (red[x] + blue[x]) + half * green[x]
        common = near * row[x + 2] + far * around - kept * grey
        red[x] = side * (common + kept * red[x])
        green[x] = middle * (common + kept * green[x])
        blue[x] = side * (common + kept * blue[x])


@compiled
def _look_up_row(levels: UInt8, table: Float32, out: Float32) -> None:
    """Look levels up; alone, because loops that look up are not vectorised."""
    for x in range(out.shape[0]):
        out[x] = table[levels[x]]


@compiled
def _veil_row(
    kept: np.float32, upper: Float32, lower: Float32, share: np.float32, row: Float32
) -> None:
    """Turn a row's light into levels, not rounded, with the veil over it."""
    for x in range(row.shape[0]):
        veil = upper[x] + share * (lower[x] - upper[x])
        row[x] = _level(kept * row[x] + veil)


@inlined
def _level(v: np.float32) -> np.float32:
    """SRGB level, not rounded, of linear light from 0 on; what is brighter than white is white."""
    return encoded(v if v < np.float32(1.0) else np.float32(1.0))


@compiled
def levels_of(light: Float32, out: Float32) -> None:
    """Unrounded sRGB level of every value of a row."""
    for x in range(out.shape[0]):
        out[x] = _level(light[x])


@compiled
def _copy_row(levels: UInt8, out: Float32) -> None:
    for x in range(out.shape[0]):
        out[x] = np.float32(levels[x])


@compiled
def _add_noise(deviation: Float32, noise: Float32, out: Float32) -> None:
    for x in range(out.shape[0]):
        out[x] += deviation[x] * noise[x]


@compiled
def _round_row(row: Float32, out: UInt8) -> None:
    zero, white = np.float32(0.0), np.float32(255.0)
    for x in range(out.shape[0]):
        v = row[x]
        v = v if v > zero else zero
        v = v if v < white else white
        out[x] = np.uint8(np.int32(v + np.float32(0.5)))
