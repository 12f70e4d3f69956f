"""Water and snow on a run of pixels of what stands: walls, cars, crowns. Compiled."""

from __future__ import annotations

import numpy as np

from weather_aug._compiled import inlined
from weather_aug.edit.physical.ground_rows import (
    covered,
    film,
    lay_snow,
    luminance,
    ramp,
    snow_light,
)
from weather_aug.edit.physical.materials import BURIED, CAP_M, COVER, LEAF, LEVEL, POROSITY
from weather_aug.edit.physical.noise import ground_noise
from weather_aug.edit.physical.spread import spread_run

R, G, B = range(3)
BELOW_TOP, DEPTH_ABOVE = 4, 5
LIGHT = 8
LIT = 7
"""Row of the buffer for the light on a run, the mean luminance and how level it is follow."""

NO_CAP_M = 99.0
OBLIQUE = 0.6
"""Noise on walls is that of the ground seen along a slope: it changes across and upwards."""
BURIED_RANGE_M = 30.0
"""Farther off, the road's plane is not known to centimetres."""


@inlined
def caps_row(kinds, depth, fy, b, class_above):
    """How far each pixel lies below the upper edge of its own thing, metres."""
    no_cap, per_fy = np.float32(NO_CAP_M), np.float32(1.0) / fy
    for x in range(kinds.shape[0]):
        z, above = depth[x], b[DEPTH_ABOVE, x]
        same = (kinds[x] == class_above[x]) & (
            abs(z - above) < np.float32(1.5) + np.float32(0.2) * z
        )
        behind = above > np.float32(1.05) * z + np.float32(0.3)
        fresh = np.float32(0.0) if behind else no_cap
        b[BELOW_TOP, x] = b[BELOW_TOP, x] + z * per_fy if same else fresh
        b[DEPTH_ABOVE, x] = z
    for x in range(kinds.shape[0]):
        class_above[x] = kinds[x]


@inlined
def film_run(run, look, material, small, cell, share, b):
    """Darken wet walls, trunks and clothes."""
    x0, x1, _, _ = run
    spread_run(small, LIGHT, 1, cell, share, x0, x1, b, LIT)
    film(x0, x1, look.film * material[POROSITY], LIT, b)


@inlined
def standing_run(run, depth, geometry, look, material, small, cell, share, tile, b):
    """Snow on upper edges, level parts and leaves and around the foot; see `ground_run`."""
    x0, x1, left, y = run
    zero, one = np.float32(0.0), np.float32(1.0)
    spread_run(small, LIGHT, 3, cell, share, x0, x1, b, LIT)
    ray_y = (np.float32(y) - geometry.cy) / geometry.fy
    amount = look.snow * material[COVER]
    for x in range(x0, x1):
        z = depth[x]
        if not z < np.float32(1e4):
            continue
        ray_x = (np.float32(left + x) - geometry.cx) / geometry.fx
        climb = geometry.climb_x * ray_x + geometry.climb_y * ray_y + geometry.climb_z
        height = geometry.height_0 + z * climb
        along = geometry.along_x * ray_x + geometry.along_y * ray_y + geometry.along_z
        aside = geometry.left_x * ray_x + geometry.left_y * ray_y + geometry.left_z
        slope = np.float32(OBLIQUE) * height
        size = z / geometry.fy
        noise = ground_noise(
            tile,
            geometry.along_0 + z * along + slope,
            geometry.left_0 + z * aside + slope,
            size,
            zero,
        )
        light = max(b[LIT, x], np.float32(0.02))
        bright = snow_light(light, look) * (np.float32(0.81) + np.float32(0.11) * noise)
        cover = zero
        if material[LEAF] > zero:
            mean = max(b[LIT + 1, x], np.float32(0.002))
            here = luminance(b[R, x], b[G, x], b[B, x])
            detail = np.float32(0.5) + np.float32(0.7) * (here / (mean * look.exposure) - one)
            detail = min(max(detail, zero), one)
            grain = np.float32(0.25) * noise + np.float32(0.75) * detail
            cover = covered(np.float32(0.8) * amount, np.float32(0.2), grain)
            bright *= min(np.float32(0.25) + np.float32(4.0) * mean / light, np.float32(0.85))
        else:
            edge = material[CAP_M] * look.snow * (np.float32(0.6) + np.float32(0.8) * noise)
            edge += np.float32(0.4) * look.snow_depth_m
            below = b[BELOW_TOP, x]
            cover = one - ramp(np.float32(0.7) * edge, np.float32(1.2) * edge, below)
            # A cap thinner than a pixel covers a part of it.
            cover *= min(edge / size, one)
            if material[LEVEL] > zero:
                level = ramp(np.float32(0.55), np.float32(0.85), b[LIT + 2, x])
                lies = covered(amount * level, np.float32(0.07) + np.float32(0.25) * size, noise)
                cover = max(cover, lies)
        buried = look.snow_depth_m * (np.float32(0.6) + np.float32(0.8) * noise)
        if (height < buried) & (z < np.float32(BURIED_RANGE_M)):
            cover = max(cover, look.snow * material[BURIED])
        grey = luminance(look.red, look.green, look.blue)
        lay_snow(x, cover, bright / grey, look, b)
