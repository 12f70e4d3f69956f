"""A picture's background in the weather, row by row, in linear light. Compiled.

Every pixel's numbers depend on its own place in the whole picture only, so that any window of a
picture has the same bytes. Serial and without fast-math, so that every process has them, too.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from weather_aug._compiled import compiled
from weather_aug._rows import apart_row, encode_row, survival, together_row
from weather_aug.edit.physical.buffer import BELOW_TOP, FREE, GROUNDED, LUMA, ROWS, SKYNESS, B, G, R
from weather_aug.edit.physical.ground_rows import ground_run
from weather_aug.edit.physical.layer_rows import load_row
from weather_aug.edit.physical.layers import GROUND_GAIN, MATTE, OBJECT_GAIN
from weather_aug.edit.physical.materials import CAP_M, COVER, GROUND, LEAF, POROSITY
from weather_aug.edit.physical.noise_rows import KNOT_PX, knots_across, noise_row
from weather_aug.edit.physical.relight import LEAST_GAIN, MOST_GAIN, SKY_FEATURE
from weather_aug.edit.physical.spread import spread_run
from weather_aug.edit.physical.standing_rows import NO_CAP_M, caps_row, film_run, standing_run
from weather_aug.edit.surface import depth_row

MAPS = 18
"""Those of `layers`, but what is mirrored is three colours under the weather's light, twice."""
OBJECT_GAINS = (np.float32(LEAST_GAIN), np.float32(MOST_GAIN))


class Geometry(NamedTuple):
    """A whole picture's camera over the street, float32."""

    fx: np.float32
    fy: np.float32
    cx: np.float32
    cy: np.float32
    along_x: np.float32
    """Steps of a surface's place in street axes for each metre of depth, by tangents (x, y, 1)."""
    along_y: np.float32
    along_z: np.float32
    left_x: np.float32
    left_y: np.float32
    left_z: np.float32
    climb_x: np.float32
    """The same of its height over the road's plane."""
    climb_y: np.float32
    climb_z: np.float32
    along_0: np.float32
    """The camera, metres, modulo the period of the noise."""
    left_0: np.float32
    height_0: np.float32
    """Over the road's plane, metres."""
    labelled: np.float32
    """1 where somebody said what is ground, 0 where it was guessed."""


@compiled
def dress(surface, classes, window, geometry, look, tint, tone, table, layers, step, tile, out):
    """Paint one window's background in the weather.

    Args:
        surface: The whole picture, its depth and label.
        classes: (N,) uint8 train ids of the whole picture, guessed where nobody labelled.
        window: (top, left, height, width) in the whole picture.
        geometry: Camera of the whole picture.
        look: Weather.
        tint: (3,) float32 of the ground's gain.
        tone: (256,) float32 light by sRGB level and by square root of light (1024,), toned, and
            the (3, 3) float32 colour matrix after it.
        table: (256, 9) float32 materials.
        layers: (20, h, w) uint16, bits of the float16 layers of the whole picture.
        step: Pixels of a cell, float32.
        tile: Noise.
        out: (H, W, 3) uint8 out.
    """
    top, left, height, width = window
    curve, by_root, matrix = tone
    rows, columns = layers.shape[1], layers.shape[2]
    b = np.zeros((ROWS, width + 16), np.float32)
    pair = np.zeros((2, MAPS, columns), np.float32)
    at = np.array([-1, -1])
    scratch = np.empty((4, columns), np.float32)
    # One more, so that the last cell has a next one.
    small = np.zeros((MAPS, columns + 1), np.float32)
    cell = np.empty(width, np.uint32)
    share = np.empty(width, np.float32)
    _cells(left, width, step, columns, cell, share)
    first_cell = np.uint64(cell[0])
    last_cell = np.uint64(min(np.int64(cell[width - 1]) + 2, columns))
    count, _ = knots_across(left, width, surface.width)
    knots = np.empty((2, count), np.float32)
    knot_depth = np.empty(count * KNOT_PX, np.float32)
    levels = np.empty((3, width), np.uint8)
    kinds = np.empty(width, np.uint8)
    class_above = np.full(width, np.uint8(255), np.uint8)
    for x in range(width):
        b[BELOW_TOP, x] = np.float32(NO_CAP_M)
    depth = np.empty(width, np.float32)
    bits = depth.view(np.int32)
    zero = np.float32(0.0)
    snowy = (look.snow > zero) | (look.road_snow > zero)
    pools = (look.puddles > zero) & (look.mirror > zero)
    wet = (look.film > zero) | (look.mirror > zero)
    # Upper edges are found from the top of the picture on.
    start = 0 if look.snow > zero else top
    for y in range(start, top + height):
        depth_row(surface, y, left, bits, depth)
        first = y * surface.width + left
        for x in range(width):
            kinds[x] = classes[first + x]
        if look.snow > zero:
            caps_row(kinds, depth, geometry.fy, b, class_above)
        if y < top:
            continue
        place = (np.float32(y) + np.float32(0.5)) / step - np.float32(0.5)
        place = min(max(place, zero), np.float32(rows - 1))
        upper = min(np.int32(place), np.int32(max(rows - 2, 0)))
        lower = min(upper + 1, rows - 1)
        for row in range(upper, lower + 1):
            if at[row % 2] != row:
                cells = (row, first_cell, last_cell)
                load_row(layers, cells, by_root, matrix, look, scratch, pair[row % 2])
                at[row % 2] = row
        down = place - np.float32(upper)
        _lerp_rows(pair, upper % 2, lower % 2, down, first_cell, last_cell, small)
        apart_row(surface.image[first : first + width], levels[0], levels[1], levels[2])
        _light(levels, curve, width, b)
        if look.flattening > zero:
            _flatten(kinds, table, small, cell, share, look, tint, width, b)
        _tone(look.exposure, matrix, width, b)
        if snowy or pools:
            noise_row(
                *(surface, classes, kinds, y, left, width, geometry, table, tile),
                *((snowy, pools), knots, knot_depth, b),
            )
        if snowy or wet:
            x0 = 0
            while x0 < width:
                kind = kinds[x0]
                x1 = x0 + 1
                while x1 < width and kinds[x1] == kind:
                    x1 += 1
                material = table[kind]
                run = (np.uint64(x0), np.uint64(x1), np.float32(left), np.float32(y))
                if material[GROUND] > zero:
                    ground_run(run, depth, geometry, look, material, small, cell, share, b)
                else:
                    if look.film > zero and material[POROSITY] > zero:
                        film_run(run, look, material, small, cell, share, b)
                    holds = (material[CAP_M] > zero) | (material[LEAF] > zero)
                    if look.snow > zero and holds and material[COVER] > zero:
                        standing_run(run, depth, geometry, look, material, small, cell, share, b)
                x0 = x1
        if look.sky > zero and _any_sky(small, first_cell, last_cell):
            _sky(small, cell, share, left, y, geometry, look, width, b)
        for channel in range(3):
            encode_row(b[channel, :width], levels[channel])
        together_row(levels[0], levels[1], levels[2], out[y - top])


@compiled
def _cells(left, width, step, columns, cell, share):
    """For each pixel of a row, the cell before it and how far it is on the way to the next."""
    for x in range(width):
        place = (np.float32(left + x) + np.float32(0.5)) / step - np.float32(0.5)
        place = min(max(place, np.float32(0.0)), np.float32(columns - 1))
        first = min(np.int32(place), np.int32(max(columns - 2, 0)))
        cell[x] = np.uint32(first)
        share[x] = place - np.float32(first)


@compiled
def _lerp_rows(pair, above, below, down, first, last, small):
    for k in range(MAPS):
        for j in range(first, last):
            value = pair[above, k, j]
            small[k, j] = value + down * (pair[below, k, j] - value)


@compiled
def _any_sky(small, first, last):
    total = np.float32(0.0)
    for j in range(first, last):
        total = max(total, max(abs(small[MATTE, j]), abs(small[MATTE + 1, j])))
    return total > np.float32(0.0)


@compiled
def _light(levels, curve, width, b):
    """Linear light of a row, its sRGB luma, and its feature of the sky."""
    for channel in range(3):
        for x in range(width):
            b[channel, x] = curve[levels[channel, x]]
    for x in range(width):
        b[LUMA, x] = (
            np.float32(0.2126 / 255) * np.float32(levels[0, x])
            + np.float32(0.7152 / 255) * np.float32(levels[1, x])
            + np.float32(0.0722 / 255) * np.float32(levels[2, x])
        )
    red, blue = np.float32(SKY_FEATURE[0] / 255), np.float32(SKY_FEATURE[2] / 255)
    for x in range(width):
        b[SKYNESS, x] = red * np.float32(levels[0, x]) + blue * np.float32(levels[2, x])


@compiled
def _flatten(kinds, table, small, cell, share, look, tint, width, b):
    """The sun's light and shadow go."""
    zero = np.float32(0.0)
    least, most = OBJECT_GAINS
    start, end = np.uint64(0), np.uint64(width)
    grounded = zero
    for x in range(width):
        b[GROUNDED, x] = table[kinds[x], GROUND]
        grounded = max(grounded, b[GROUNDED, x])
    spread_run(small, OBJECT_GAIN, 2, cell, share, start, end, b, FREE + 4)
    if grounded == zero:
        # Half of all rows; without ground no channel differs.
        for x in range(width):
            other = b[FREE + 4, x] * b[LUMA, x] + b[FREE + 5, x]
            gain = survival(-(look.flattening * min(max(other, least), most)))
            b[R, x] *= gain
            b[G, x] *= gain
            b[B, x] *= gain
        return
    spread_run(small, GROUND_GAIN, 4, cell, share, start, end, b, FREE)
    for x in range(width):
        ground = b[FREE, x] * b[LUMA, x] + b[FREE + 1, x]
        ground = min(max(ground, b[FREE + 2, x]), b[FREE + 3, x])
        other = b[FREE + 4, x] * b[LUMA, x] + b[FREE + 5, x]
        other = min(max(other, least), most)
        b[FREE, x] = look.flattening * (ground if b[GROUNDED, x] > zero else other)
    for x in range(width):
        b[FREE + 1, x] = max(b[FREE, x], zero) * b[GROUNDED, x]
    for channel in range(3):
        shift = tint[channel]
        for x in range(width):
            b[channel, x] *= survival(-(b[FREE, x] + shift * b[FREE + 1, x]))


@compiled
def _tone(exposure, matrix, width, b):
    """Saturation and white."""
    for x in range(width):
        r, g, v = b[R, x] * exposure, b[G, x] * exposure, b[B, x] * exposure
        b[R, x] = matrix[0, 0] * r + matrix[0, 1] * g + matrix[0, 2] * v
        b[G, x] = matrix[1, 0] * r + matrix[1, 1] * g + matrix[1, 2] * v
        b[B, x] = matrix[2, 0] * r + matrix[2, 1] * g + matrix[2, 2] * v


@compiled
def _sky(small, cell, share, left, y, geometry, look, width, b):
    """An overcast sky where the sky is, also between leaves."""
    zero, one = np.float32(0.0), np.float32(1.0)
    spread_run(small, MATTE, 2, cell, share, np.uint64(0), np.uint64(width), b, FREE)
    ray_y = (np.float32(y) - geometry.cy) / geometry.fy
    rise = geometry.climb_y * ray_y + geometry.climb_z
    across = one + ray_y * ray_y
    for x in range(width):
        matte = b[FREE, x] * b[SKYNESS, x] + b[FREE + 1, x]
        matte = min(max(matte, zero), one)
        weight = look.sky * matte
        ray_x = (np.float32(left + x) - geometry.cx) / geometry.fx
        sine = (geometry.climb_x * ray_x + rise) / np.sqrt(across + ray_x * ray_x)
        brighter = one + look.zenith_gain * max(sine, zero)
        b[R, x] += weight * (look.red * brighter - b[R, x])
        b[G, x] += weight * (look.green * brighter - b[G, x])
        b[B, x] += weight * (look.blue * brighter - b[B, x])
