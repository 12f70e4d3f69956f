"""Compiled loop of the published particle field: a box of particles, seen by a camera."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled
from weather_aug.particles.kernels import GOLDEN, mix64

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

MOST_SIGMAS = 6.8
"""No normal number of `_normals` is farther from 0: sqrt(2 ln 2**33) = 6.76."""


class Attributes(NamedTuple):
    """How the particles of a box are drawn; the fields of `PublishedPreset` of the same names."""

    opacity_mean: float
    opacity_std: float
    opacity_per_m: float
    """Per metre of max(forward, 2 |x|); 0 where the opacity is drawn."""
    forward_axis: int
    scale_mean_m: Float64
    scale_std_m: Float64
    y_multipliers: Float64
    tilt_axis: int
    tilt_mean_rad: float
    tilt_std_rad: float


class View(NamedTuple):
    """What a camera and a window of its picture can see; tangents are padded by the pixel blur."""

    camera_from_box: Float64
    """(3, 4)."""
    picture: Float64
    """(4,) tangents x0, x1, y0, y1 of the whole picture."""
    window: Float64
    """(4,) tangents of the window."""
    near_m: float
    reach_m: float
    """How far from its middle a particle can be seen."""


@compiled
def particles_in_view(
    key: np.uint64,
    low_m: Float64,
    extent_m: Float64,
    shift_m: Float64,
    attributes: Attributes,
    view: View,
    out: Float32,
) -> int:
    """Write the records of the particles that can touch the window, in the order of their index.

    A particle is kept if its sphere of `reach_m` touches the frustum of the whole picture, and the
    Gaussian's footprint, linear in the angle as a splat's is, touches the window. The first says
    what is in the picture whatever the window; the second drops no pixel of the window.

    Args:
        key: Of the field.
        low_m: (3,) lowest corner of the box.
        extent_m: (3,) its sides.
        shift_m: (3,) displacement of all particles, each in [0, side); they wrap.
        attributes: What to draw.
        view: Camera and window.
        out: (count, 13) float32 records; see `PublishedField.particles`.

    Returns:
        Number of records.
    """
    found = 0
    count = out.shape[0]
    m = view.camera_from_box
    leaning = np.empty(4)
    for k in range(4):
        leaning[k] = view.reach_m * np.sqrt(1.0 + view.picture[k] * view.picture[k])
    start = np.empty(3)
    p = np.empty(3)
    tilted = np.empty((3, 3))
    for i in range(count):
        word = mix64(key + np.uint64(i + 1) * GOLDEN)
        place = mix64(word)
        start[0] = np.float64(place & np.uint64(0x1FFFFF)) * 2.0**-21 * extent_m[0]
        start[1] = np.float64((place >> np.uint64(21)) & np.uint64(0x1FFFFF)) * 2.0**-21
        start[1] *= extent_m[1]
        start[2] = np.float64(place >> np.uint64(42)) * 2.0**-22 * extent_m[2]
        for k in range(3):
            moved = start[k] + shift_m[k]
            p[k] = low_m[k] + (moved if moved < extent_m[k] else moved - extent_m[k])
        z = m[2, 0] * p[0] + m[2, 1] * p[1] + m[2, 2] * p[2] + m[2, 3]
        if z < view.near_m:
            continue
        x = m[0, 0] * p[0] + m[0, 1] * p[1] + m[0, 2] * p[2] + m[0, 3]
        if x < view.picture[0] * z - leaning[0] or x > view.picture[1] * z + leaning[1]:
            continue
        y = m[1, 0] * p[0] + m[1, 1] * p[1] + m[1, 2] * p[2] + m[1, 3]
        if y < view.picture[2] * z - leaning[2] or y > view.picture[3] * z + leaning[3]:
            continue
        half = view.reach_m * np.sqrt(1.0 + (x / z) ** 2)
        if x + half < view.window[0] * z or x - half > view.window[1] * z:
            continue
        half = view.reach_m * np.sqrt(1.0 + (y / z) ** 2)
        if y + half < view.window[2] * z or y - half > view.window[3] * z:
            continue
        row = out[found]
        row[0], row[1], row[2] = x, y, z
        row[3:6] = np.float32(0.0)
        third = 3 * i // count
        row[12] = _write_attributes(word, third, p, attributes, m, tilted, row)
        found += 1
    return found


@compiled
def _write_attributes(
    word: np.uint64,
    third: int,
    position: Float64,
    attributes: Attributes,
    camera_from_box: Float64,
    tilted: Float64,
    row: Float32,
) -> float:
    """Draw one particle: write its covariance in camera axes, return its opacity.

    `tilted` is room for a (3, 3): its own axes as columns, in camera axes. The opacity of fog is
    that of time 0, because a fall changes neither coordinate it depends on.
    """
    first = mix64(word ^ np.uint64(0xD6E8FEB86659FD93))
    second = mix64(first + GOLDEN)
    third_word = mix64(second + GOLDEN)
    opacity_draw, tilt_draw = _normals(first)
    x_draw, y_draw = _normals(second)
    z_draw, _ = _normals(third_word)
    mean, std = attributes.scale_mean_m, attributes.scale_std_m
    variances = (
        (mean[0] + std[0] * x_draw) ** 2,
        (attributes.y_multipliers[third] * (mean[1] + std[1] * y_draw)) ** 2,
        (mean[2] + std[2] * z_draw) ** 2,
    )
    tilt_rad = attributes.tilt_mean_rad + attributes.tilt_std_rad * tilt_draw
    cosine, sine = np.cos(tilt_rad), np.sin(tilt_rad)
    # A right-handed turn about axis k carries axis k + 1 towards axis k + 2.
    still = attributes.tilt_axis
    one, two = (still + 1) % 3, (still + 2) % 3
    for r in range(3):
        at = camera_from_box[r]
        tilted[r, still] = at[still]
        tilted[r, one] = cosine * at[one] + sine * at[two]
        tilted[r, two] = cosine * at[two] - sine * at[one]
    slot = 6
    for r in range(3):
        for c in range(r, 3):
            total = 0.0
            for k in range(3):
                total += variances[k] * tilted[r, k] * tilted[c, k]
            row[slot] = total
            slot += 1
    if attributes.opacity_per_m > 0.0:
        depth_m = max(position[attributes.forward_axis], 2.0 * abs(position[0]))
        return -np.expm1(-attributes.opacity_per_m * depth_m)
    opacity = attributes.opacity_mean + attributes.opacity_std * opacity_draw
    return min(max(opacity, 0.0), 1.0)


@compiled
def _normals(word: np.uint64) -> tuple[Any, Any]:
    """Two independent standard normal numbers of one hash (Box and Muller 1958)."""
    radius = np.sqrt(-2.0 * np.log((np.float64(word >> np.uint64(32)) + 0.5) * 2.0**-32))
    angle = 2.0 * np.pi * np.float64(word & np.uint64(0xFFFFFFFF)) * 2.0**-32
    return radius * np.cos(angle), radius * np.sin(angle)
