"""Rings that drops draw on the water of a road. Compiled."""

from __future__ import annotations

import math

import numpy as np

from weather_aug._compiled import compiled, inlined
from weather_aug.edit.physical.buffer import MIRRORED, POOL, SIZE

CELL_M = 0.14
"""One ring at a time in each square cell of this side; it fades before it could leave it."""
LIFE_S = 0.35
SPEED_M_PER_S = 0.2
WAVE_M = 0.03
COARSEST_M = 0.02
"""Pixels longer than this average the rings away."""
ON_POOL, ON_FILM = 0.35, 0.12
"""Largest relative change of what standing water and a film mirror."""


@compiled
def ripple(run, depth, geometry, look, b):
    """Modulate what is mirrored on pixels x0 to x1 of the ground; see `ground_rows.ground_run`."""
    x0, x1, left, y = run
    zero, one = np.float32(0.0), np.float32(1.0)
    ray_y = (y - geometry.cy) / geometry.fy
    along_y = geometry.along_y * ray_y + geometry.along_z
    left_y = geometry.left_y * ray_y + geometry.left_z
    per_cell = np.float32(1.0 / CELL_M)
    known_i = known_j = np.float32(np.nan)
    rings, centre_u, centre_v, age = False, zero, zero, zero
    for x in range(x0, x1):
        if b[SIZE, x] >= np.float32(COARSEST_M):
            continue
        z = depth[x]
        ray_x = (left + np.float32(x) - geometry.cx) / geometry.fx
        along = geometry.along_0 + z * (geometry.along_x * ray_x + along_y)
        aside = geometry.left_0 + z * (geometry.left_x * ray_x + left_y)
        i, j = np.floor(along * per_cell), np.floor(aside * per_cell)
        # Near the camera many pixels of a row lie in one cell.
        if i != known_i or j != known_j:
            known_i, known_j = i, j
            rings, centre_u, centre_v, age = _ring(i, j, look)
        if not rings:
            continue
        fine = one - b[SIZE, x] * np.float32(1.0 / COARSEST_M)
        wave = _height(along - centre_u, aside - centre_v, age) * fine
        deep = np.float32(ON_FILM) + b[POOL, x] * np.float32(ON_POOL - ON_FILM)
        change = max(one + deep * wave, zero)
        for k in range(6):
            b[MIRRORED + k, x] *= change


@inlined
def _ring(i, j, look):
    """Whether a cell has a ring, its centre in metres, and its age in lives; cells beat alone."""
    row, column = np.uint32(np.int32(i)), np.uint32(np.int32(j))
    beat = look.time_s * np.float32(1.0 / LIFE_S) + _unit(_hashed(row, column, np.uint32(0)))
    whole = np.floor(beat)
    word = _hashed(row, column, np.uint32(np.int32(whole)))
    rings = _unit(word) < look.ripples
    word = _mixed(word + np.uint32(0x9E3779B9))
    centre_u = np.float32(0.3) + np.float32(0.4) * _unit(word)
    centre_v = np.float32(0.3) + np.float32(0.4) * _unit(_mixed(word))
    size = np.float32(CELL_M)
    return rings, (i + centre_u) * size, (j + centre_v) * size, beat - whole


@inlined
def _height(du, dv, age):
    """Height of a ring, in [-1, 1], so many metres from its centre."""
    one = np.float32(1.0)
    off = np.sqrt(du * du + dv * dv) - np.float32(SPEED_M_PER_S * LIFE_S) * age
    phase = off * np.float32(1.0 / WAVE_M)
    if abs(phase) >= one:
        return np.float32(0.0)
    packet = (one - phase * phase) * (one - age)
    return packet * np.float32(math.cos(np.float32(2.0 * math.pi) * phase))


@inlined
def _hashed(a, b, c):
    word = _mixed(a * np.uint32(0x85EBCA6B) + np.uint32(0x27D4EB2F))
    word = _mixed(word ^ (b * np.uint32(0xC2B2AE35)))
    return _mixed(word ^ (c * np.uint32(0x165667B1)))


@inlined
def _mixed(word):
    """The finaliser of MurmurHash3."""
    word = np.uint32(word)
    word = np.uint32((word ^ (word >> np.uint32(16))) * np.uint32(0x85EBCA6B))
    word = np.uint32((word ^ (word >> np.uint32(13))) * np.uint32(0xC2B2AE35))
    return np.uint32(word ^ (word >> np.uint32(16)))


@inlined
def _unit(word):
    """In [0, 1)."""
    return np.float32(np.uint32(word) >> np.uint32(8)) * np.float32(2.0**-24)
