"""A picture's background in the weather, row by row, in linear light. Compiled.

Every pixel's numbers depend on its own place in the whole picture only, so that any window of a
picture has the same bytes. Serial and without fast-math, so that every process has them, too.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from weather_aug._compiled import compiled, inlined
from weather_aug._rows import encode_row, survival
from weather_aug.edit.physical.ground_rows import ground_run
from weather_aug.edit.physical.materials import CAP_M, COVER, GROUND, LEAF, POROSITY
from weather_aug.edit.physical.relight import LEAST_GAIN, MOST_GAIN, SKY_FEATURE
from weather_aug.edit.physical.spread import spread_run
from weather_aug.edit.physical.standing_rows import caps_row, film_run, standing_run
from weather_aug.edit.surface import depth_row, light_row

CAP_ROWS = 96
"""How far above a window the upper edges of things are looked for, pixels."""
NO_CAP_M = 99.0

R, G, B, LUMA = range(4)
"""Rows of the buffer: linear light, and the recorded picture's sRGB luma."""
BELOW_TOP, DEPTH_ABOVE = 4, 5
"""How far below its own upper edge a pixel lies, metres; depth of the pixel above it."""
SKYNESS = 6
"""The recorded picture's feature of the sky."""
FREE = 7
"""First row that the runs may use."""
BUFFER_ROWS = 24

GROUND_GAIN, OBJECT_GAIN, MATTE, LIGHT = 0, 4, 6, 8
SHARP, MAPS = 12, 18
"""Where the kernel's maps are in their stack: those of `layers`, but what is mirrored is three
colours under the weather's light, twice."""
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
def dress(
    surface, classes, window, geometry, look, tint, curve, matrix, table, maps, step, tile, out
):
    """Paint one window's background in the weather.

    Args:
        surface: The recorded picture.
        classes: (N,) uint8 train ids of the whole picture, guessed where nobody labelled.
        window: (top, left, height, width) in the whole picture.
        geometry: Camera of the whole picture.
        look: Weather.
        tint: (3,) float32 of the ground's gain.
        curve: (256,) float32 toned light by sRGB level.
        matrix: (3, 3) float32 colour matrix after it.
        table: (256, 9) float32 materials.
        maps: (18, h, w) float32 on the small grid of the whole picture.
        step: Pixels of a cell, float32.
        tile: Noise.
        out: (3, H, W) uint8 out.
    """
    top, left, height, width = window
    columns = maps.shape[2]
    b = np.zeros((BUFFER_ROWS, width + 16), np.float32)
    small = np.empty((MAPS, columns), np.float32)
    cell = np.empty(width, np.int32)
    share = np.empty(width, np.float32)
    _cells(left, width, step, columns, cell, share)
    kinds = np.empty(width, np.uint8)
    class_above = np.full(width, np.uint8(255), np.uint8)
    for x in range(width):
        b[BELOW_TOP, x] = np.float32(NO_CAP_M)
    depth = np.empty(width, np.float32)
    bits = depth.view(np.int32)
    zero = np.float32(0.0)
    snowy = (look.snow > zero) | (look.road_snow > zero)
    wet = (look.film > zero) | (look.mirror > zero)
    start = max(top - CAP_ROWS, 0) if look.snow > zero else top
    for y in range(start, top + height):
        depth_row(surface, y, left, bits, depth)
        first = y * surface.width + left
        for x in range(width):
            kinds[x] = classes[first + x]
        if look.snow > zero:
            caps_row(kinds, depth, geometry.fy, b, class_above)
        if y < top:
            continue
        has_sky = _small_row(maps, y, step, small)
        light_row(surface, y, left, curve, b[R, :width], b[G, :width], b[B, :width])
        luma_row(surface, y, left, b)
        if look.flattening > zero:
            _flatten(kinds, table, small, cell, share, look, tint, width, b)
        _tone(look.exposure, matrix, width, b)
        if snowy or wet:
            x0 = 0
            while x0 < width:
                kind = kinds[x0]
                x1 = x0 + 1
                while x1 < width and kinds[x1] == kind:
                    x1 += 1
                material = table[kind]
                run = (x0, x1, left, y)
                if material[GROUND] > zero:
                    ground_run(run, depth, geometry, look, material, small, cell, share, tile, b)
                else:
                    if look.film > zero and material[POROSITY] > zero:
                        film_run(run, look, material, small, cell, share, b)
                    holds = (material[CAP_M] > zero) | (material[LEAF] > zero)
                    if look.snow > zero and holds and material[COVER] > zero:
                        standing_run(
                            run, depth, geometry, look, material, small, cell, share, tile, b
                        )
                x0 = x1
        if has_sky and look.sky > zero:
            _sky(small, cell, share, left, y, geometry, look, width, b)
        for channel in range(3):
            encode_row(b[channel, :width], out[channel, y - top])


@compiled
def _cells(left, width, step, columns, cell, share):
    """For each pixel of a row, the cell before it and how far it is on the way to the next."""
    for x in range(width):
        place = (np.float32(left + x) + np.float32(0.5)) / step - np.float32(0.5)
        place = min(max(place, np.float32(0.0)), np.float32(columns - 1))
        first = min(np.int32(place), np.int32(max(columns - 2, 0)))
        cell[x] = first
        share[x] = place - np.float32(first)


@compiled
def _small_row(maps, y, step, small):
    """All maps at the height of picture row y; whether any of its cells may be sky."""
    rows, columns = maps.shape[1], maps.shape[2]
    place = (np.float32(y) + np.float32(0.5)) / step - np.float32(0.5)
    place = min(max(place, np.float32(0.0)), np.float32(rows - 1))
    upper = min(np.int32(place), np.int32(max(rows - 2, 0)))
    lower = min(upper + 1, rows - 1)
    down = place - np.float32(upper)
    for k in range(MAPS):
        for j in range(columns):
            first = maps[k, upper, j]
            small[k, j] = first + down * (maps[k, lower, j] - first)
    sky = np.float32(0.0)
    for j in range(columns):
        sky += abs(small[MATTE, j]) + abs(small[MATTE + 1, j])
    return sky > np.float32(0.0)


@compiled
def luma_row(surface, y, left, b):
    """The recorded picture's sRGB luma and its feature of the sky."""
    top_, left_, _, stride = surface.image_window
    start = (y - top_) * stride + left - left_
    width = b.shape[1] - 16
    image = surface.image[start : start + width]
    for x in range(width):
        b[LUMA, x] = (
            np.float32(0.2126 / 255) * np.float32(image[x, 0])
            + np.float32(0.7152 / 255) * np.float32(image[x, 1])
            + np.float32(0.0722 / 255) * np.float32(image[x, 2])
        )
    red, blue = np.float32(SKY_FEATURE[0] / 255), np.float32(SKY_FEATURE[2] / 255)
    for x in range(width):
        b[SKYNESS, x] = red * np.float32(image[x, 0]) + blue * np.float32(image[x, 2])


@compiled
def _flatten(kinds, table, small, cell, share, look, tint, width, b):
    """The sun's light and shadow go, by runs of ground and of what stands."""
    x0 = 0
    while x0 < width:
        ground = table[kinds[x0], GROUND] > np.float32(0.0)
        x1 = x0 + 1
        while x1 < width and (table[kinds[x1], GROUND] > np.float32(0.0)) == ground:
            x1 += 1
        if ground:
            spread_run(small, GROUND_GAIN, 4, cell, share, x0, x1, b, FREE)
            _ground_gain(x0, x1, look.flattening, tint, b)
        else:
            spread_run(small, OBJECT_GAIN, 2, cell, share, x0, x1, b, FREE)
            _object_gain(x0, x1, look.flattening, b)
        x0 = x1


@inlined
def _ground_gain(x0, x1, strength, tint, b):
    zero = np.float32(0.0)
    for x in range(x0, x1):
        gain = b[FREE, x] * b[LUMA, x] + b[FREE + 1, x]
        gain = max(gain, b[FREE + 2, x])
        b[FREE, x] = strength * min(gain, b[FREE + 3, x])
    for channel in range(3):
        for x in range(x0, x1):
            gain = b[FREE, x]
            gain += tint[channel] * max(gain, zero)
            b[channel, x] *= survival(-gain)


@inlined
def _object_gain(x0, x1, strength, b):
    least, most = OBJECT_GAINS
    for x in range(x0, x1):
        gain = b[FREE, x] * b[LUMA, x] + b[FREE + 1, x]
        b[FREE, x] = survival(-strength * min(max(gain, least), most))
    for channel in range(3):
        for x in range(x0, x1):
            b[channel, x] *= b[FREE, x]


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
    spread_run(small, MATTE, 2, cell, share, 0, width, b, FREE)
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
