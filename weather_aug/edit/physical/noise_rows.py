"""World-anchored noise along a row of pixels. Compiled.

The noise is looked up at every fourth column of the picture and runs straight between them: on the
ground a pixel is many times longer than wide, and what is finer than it is averaged anyway; near
the car a pixel is far smaller than the noise's finest cell.
"""

from __future__ import annotations

import numpy as np

from weather_aug._compiled import compiled
from weather_aug.edit.physical.buffer import LIE, NOISE
from weather_aug.edit.physical.materials import COVER, GROUND, ROAD
from weather_aug.edit.physical.noise import ground_noise
from weather_aug.edit.surface import depth_row

KNOT_PX = 4
OTHER_M = 11.3
"""Offset of the water's noise from the snow's."""
OBLIQUE = 0.6
"""Noise on walls is that of the ground seen along a slope: it changes across and upwards."""
FLATTEST_SINE = 0.02
FARTHEST_M = 2000.0


@compiled
def knots_across(left, width, whole_width):
    """How many knots a window needs, and the picture's column of the first."""
    first = left // KNOT_PX * KNOT_PX
    return (left + width - 1 - first) // KNOT_PX + 2, first


@compiled
def noise_row(
    surface, classes, kinds, y, left, width, geometry, table, tile, wanted, knots, depth, b
):
    """Noise of one row's places where snow can lie, and the water's on the road.

    Args:
        surface: The recorded picture.
        classes: (N,) train ids of the whole picture.
        kinds: (W,) of the row.
        y: Row of the picture.
        left: Column of the window's first pixel.
        width: Of the window.
        geometry: Of the whole picture.
        table: Materials.
        tile: Noise.
        wanted: (snow's, water's) noise.
        knots: (2, K) float32 scratch.
        depth: (>= 4 K) float32 scratch.
        b: Buffer; fills NOISE, with 1/2 where it is not wanted, and LIE if it is wanted.
    """
    snow, pools = wanted
    count, first = knots_across(left, width, surface.width)
    wide = min(count * KNOT_PX, surface.width - first)
    row_depth = depth[:wide]
    depth_row(surface, y, first, row_depth.view(np.int32), row_depth)
    ray_y = (np.float32(y) - geometry.cy) / geometry.fy
    along_y = geometry.along_y * ray_y + geometry.along_z
    left_y = geometry.left_y * ray_y + geometry.left_z
    climb_y = geometry.climb_y * ray_y + geometry.climb_z
    across = np.float32(1.0) + ray_y * ray_y
    start = y * surface.width + first
    for k in range(count):
        knots[0, k] = knots[1, k] = np.float32(0.5)
    # A knot that nobody asks for holds 1/2 until then; one that is asked for, more than that.
    if snow:
        _ask(kinds, table, COVER, left - first, knots[0])
    if pools:
        _ask(kinds, table, ROAD, left - first, knots[1])
    for k in range(count):
        asked = (knots[0, k] > np.float32(0.5), knots[1, k] > np.float32(0.5))
        if not (asked[0] or asked[1]):
            continue
        x = min(np.int32(k * KNOT_PX), np.int32(wide - 1))
        z = row_depth[x]
        if not z < np.float32(FARTHEST_M):
            knots[0, k] = knots[1, k] = np.float32(0.5)
            continue
        ray_x = (np.float32(first + x) - geometry.cx) / geometry.fx
        along = geometry.along_0 + z * (geometry.along_x * ray_x + along_y)
        aside = geometry.left_0 + z * (geometry.left_x * ray_x + left_y)
        climb = geometry.climb_x * ray_x + climb_y
        size = z / geometry.fy
        if table[classes[start + x], GROUND] > np.float32(0.0):
            sine = -climb / np.sqrt(across + ray_x * ray_x)
            size /= max(sine, np.float32(FLATTEST_SINE))
        else:
            slope = np.float32(OBLIQUE) * (geometry.height_0 + z * climb)
            along += slope
            aside += slope
            size *= np.float32(KNOT_PX)
        if asked[0]:
            knots[0, k] = ground_noise(tile, along, aside, size, np.float32(0.0))
        if asked[1]:
            knots[1, k] = ground_noise(tile, along, aside, size, np.float32(OTHER_M))
    _between(knots, 0, left - first, width, b, NOISE)
    if pools:
        _between(knots, 1, left - first, width, b, LIE)


@compiled
def _ask(kinds, table, column, offset, knots):
    """Set the knots on both sides of pixels whose class has something in a column of the table."""
    for x in range(kinds.shape[0]):
        if table[kinds[x], column] > np.float32(0.0):
            k = (offset + x) // KNOT_PX
            knots[k] = knots[k + 1] = np.float32(1.0)


@compiled
def _between(knots, which, offset, width, b, slot):
    per_knot = np.float32(1.0 / KNOT_PX)
    start = np.uint32(offset)
    for x in range(width):
        place = np.uint32(start + np.uint32(x))
        k = place // np.uint32(KNOT_PX)
        share = np.float32(place - k * np.uint32(KNOT_PX)) * per_knot
        before, after = knots[which, k], knots[which, k + np.uint32(1)]
        b[slot, x] = before + share * (after - before)
