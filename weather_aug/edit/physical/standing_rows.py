"""Water and snow on a run of pixels of what stands: walls, cars, crowns. Compiled."""

from __future__ import annotations

import numpy as np

from weather_aug._compiled import compiled
from weather_aug.edit.physical.buffer import (
    BELOW_TOP,
    COVERED,
    DEPTH_ABOVE,
    HEIGHT,
    LEVEL,
    LIT,
    MEAN,
    NOISE,
    SIZE,
    B,
    G,
    R,
)
from weather_aug.edit.physical.ground_rows import (
    covered,
    film,
    lay_snow,
    luminance,
    ramp,
    snow_light,
)
from weather_aug.edit.physical.layers import ILLUMINATION
from weather_aug.edit.physical.materials import BURIED, CAP_M, COVER, LEAF, POROSITY
from weather_aug.edit.physical.materials import LEVEL as LEVEL_COLUMN
from weather_aug.edit.physical.spread import spread_run

NO_CAP_M = 99.0
BURIED_RANGE_M = 30.0
"""Farther off, the road's plane is not known to centimetres."""
LEAF_SOFTNESS = 0.5
"""Of where leaves turn white: single leaves are smaller than a pixel, and must not flicker."""
GRAIN_NOISE = 0.25
"""Share of the noise in where leaves are white; the rest is the picture's own light and dark."""


@compiled
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


@compiled
def film_run(run, look, material, small, cell, share, b):
    """Darken wet walls, trunks and clothes."""
    x0, x1, _, _ = run
    spread_run(small, ILLUMINATION, 1, cell, share, x0, x1, b, LIT)
    film(x0, x1, look.film * material[POROSITY], look.exposure, b)


@compiled
def standing_run(run, depth, geometry, look, material, small, cell, share, b):
    """Snow on upper edges, level parts and leaves and around the foot; see `ground_run`."""
    x0, x1, _, _ = run
    zero, one = np.float32(0.0), np.float32(1.0)
    spread_run(small, ILLUMINATION, 3, cell, share, x0, x1, b, LIT)
    _feet(run, depth, geometry, b)
    amount = look.snow * material[COVER]
    if material[LEAF] > zero:
        _leaves(x0, x1, amount, look.exposure, b)
    else:
        _edges(x0, x1, look.snow * material[CAP_M], look.snow_depth_m, b)
        if material[LEVEL_COLUMN] > zero:
            _levels(x0, x1, amount, b)
    buries = look.snow * material[BURIED]
    grey = luminance(look.red, look.green, look.blue)
    leaf, tiny = material[LEAF] > zero, np.float32(1e-6)
    for x in range(x0, x1):
        noise = b[NOISE, x]
        buried = look.snow_depth_m * (np.float32(0.6) + np.float32(0.8) * noise)
        lies = one - ramp(np.float32(0.7) * buried, np.float32(1.1) * buried + tiny, b[HEIGHT, x])
        cover = max(b[COVERED, x], buries * lies)
        light = max(b[LIT, x], np.float32(0.02))
        bright = snow_light(light, look) * (np.float32(0.81) + np.float32(0.11) * noise)
        dim = np.float32(0.25) + np.float32(4.0) * b[MEAN, x] / light
        bright *= min(dim, np.float32(0.85)) if leaf else one
        lay_snow(x, cover, bright / grey, look, b)


@compiled
def _feet(run, depth, geometry, b):
    """Height over the road's plane, as far as it can be known, and metres a pixel."""
    x0, x1, left, y = run
    ray_y = (y - geometry.cy) / geometry.fy
    climb_y = geometry.climb_y * ray_y + geometry.climb_z
    per_fx, per_fy = np.float32(1.0) / geometry.fx, np.float32(1.0) / geometry.fy
    for x in range(x0, x1):
        z = depth[x]
        ray_x = (left + np.float32(x) - geometry.cx) * per_fx
        height = geometry.height_0 + z * (geometry.climb_x * ray_x + climb_y)
        b[HEIGHT, x] = height if z < np.float32(BURIED_RANGE_M) else np.float32(NO_CAP_M)
        b[SIZE, x] = min(z * per_fy, np.float32(1.0))


@compiled
def _edges(x0, x1, cap_m, snow_depth_m, b):
    """Snow along upper edges: how much of each pixel lies within it."""
    zero, one = np.float32(0.0), np.float32(1.0)
    for x in range(x0, x1):
        edge = cap_m * (np.float32(0.6) + np.float32(0.8) * b[NOISE, x])
        edge += np.float32(0.4) * snow_depth_m
        within = (edge - b[BELOW_TOP, x]) / max(b[SIZE, x], np.float32(1e-5))
        b[COVERED, x] = min(max(within, zero), one)


@compiled
def _levels(x0, x1, amount, b):
    """Snow on bonnets and roofs."""
    for x in range(x0, x1):
        level = ramp(np.float32(0.55), np.float32(0.85), b[LEVEL, x])
        fuzz = np.float32(0.07) + np.float32(0.25) * b[SIZE, x]
        b[COVERED, x] = max(b[COVERED, x], covered(amount * level, fuzz, b[NOISE, x]))


@compiled
def _leaves(x0, x1, amount, exposure, b):
    """Snow on what of a crown is lighter than its surroundings: leaves that face the sky."""
    zero, one, half = np.float32(0.0), np.float32(1.0), np.float32(0.5)
    for x in range(x0, x1):
        mean = max(b[MEAN, x], np.float32(0.002)) * exposure
        detail = half + np.float32(0.7) * (luminance(b[R, x], b[G, x], b[B, x]) / mean - one)
        detail = min(max(detail, zero), one)
        grain = detail + np.float32(GRAIN_NOISE) * (b[NOISE, x] - detail)
        b[COVERED, x] = covered(np.float32(0.8) * amount, np.float32(LEAF_SOFTNESS), grain)
