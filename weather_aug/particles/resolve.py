"""Which particles a camera resolves; what it does not resolve becomes extinction.

A particle is drawn where its pixel opacity is at least `alpha_min` times a factor that doubles at
30 m; the rest of the population is a veil in closed form, so that the optical depth of both
together is right at any particle budget. Drawn particles fade in behind the near limit, out before
their reach, and in when the density rises, so that none pops up; the veil accounts for that too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.types import Camera
from weather_aug.particles import kernels
from weather_aug.particles.statistics import Population

NEAR_M = 0.5
"""Nearer particles are drops on the lens or behind the bonnet, not in the air."""
NEAR_FULL_M = 0.7
"""The opacity of particles rises from 0 at the near limit to its full value here."""
NEAR_SWEEPS = 1.5
"""A particle that comes nearer by 1 / this of its depth while the shutter is open would sweep over
the picture as no straight streak does; where that is farther than `NEAR_M`, it is the near limit,
and the near fade is stretched alike."""
MOST_TURN_RAD = 0.1
"""A camera that turns by more while its shutter is open smears its whole picture; streaks are drawn
as for this."""
FADE_SHARE = 0.15
"""Share of its reach, at the end, over which the opacity of a particle falls to 0."""
ARRIVALS = (0.25, 0.1)
"""While the density rises, a particle of a hash cell of mean count m appears over the arrival of
this many later ones: 0.25 + 0.1 m. Dense cells thus let theirs appear over a tenth of the rate."""
LEAST_REACH = NEAR_FULL_M / NEAR_M / (1.0 - FADE_SHARE)
"""A size whose reach is less than this times the near limit is not drawn, so that the two fades
never overlap."""
FAR_M = 60.0
"""No particle is drawn beyond."""
FAINTEST_ALPHA = 0.01
"""About 2.5 of 255 levels: fainter particles cannot be seen and are never drawn."""
HALF_DEPTH_M = 30.0
"""A particle this far must be twice as opaque as one at the lens to be drawn: what is near carries
the look, and the reach of each size changes without leaps."""
DEPTH_BINS = 1024

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Resolved:
    """The resolved part of a population for one camera, and the optical depth it carries."""

    alpha_min: float
    reach_m: Float32
    """(C, Q) depth up to which a particle of this class and size is drawn; 0 for never."""
    expected_count: float
    """Particles drawn in the whole picture, on average, those that fade included."""
    optical_depth: Float32
    """(DEPTH_BINS + 1,) of drawn particles, on the axis, up to the depth k / DEPTH_BINS * FAR_M."""
    near_m: float = NEAR_M
    """No particle is drawn nearer."""

    @property
    def near_full_m(self) -> float:
        """Where the near fade ends."""
        return self.near_m * (NEAR_FULL_M / NEAR_M)


def resolve(
    population: Population, camera: Camera, relative_m_per_s: Float64, max_particles: int
) -> Resolved:
    """Split `population` into drawn particles and veil for one camera.

    Remembered by the numbers that matter, because a loader asks for the same camera and weather
    again and again; the arrays are read-only.

    Args:
        population: What is in the air.
        camera: The whole picture's camera; a crop draws a subset of its particles.
        relative_m_per_s: (C, 3) velocity of each class relative to the camera, camera axes.
        max_particles: Expected number of drawn particles at the most.

    Returns:
        The reach of each size; `alpha_min` is the smallest that keeps the count within the budget.

    Source:
        pixel opacity of a drop of width w and streak l pixels: (pi/4) w^2 / (max(w,1) max(l+w,1)).
    """
    picture = (*camera.focal_px, *camera.principal_px, camera.width, camera.height)
    return _resolved(
        np.shape(population.diameters_m),
        population.diameters_m.tobytes(),
        population.density_per_m3.tobytes(),
        drawn_share(population.mean_per_cell).tobytes(),
        np.ascontiguousarray(relative_m_per_s, np.float64).tobytes(),
        picture,
        camera.exposure_s,
        max_particles,
    )


@lru_cache(maxsize=256)
def _resolved(
    shape: tuple[int, ...],
    diameters: bytes,
    density: bytes,
    drawn_share: bytes,
    relative: bytes,
    picture: tuple[float, ...],
    exposure_s: float,
    max_particles: int,
) -> Resolved:
    """`resolve` of plain numbers: the arrays come as bytes, to be compared and hashed."""
    diameters_m = np.frombuffer(diameters).reshape(shape).copy()
    per_size = np.frombuffer(density) / shape[1]
    velocity = np.frombuffer(relative).reshape(-1, 3)
    across = _across_picture(picture, velocity)
    near_m = max(NEAR_M, NEAR_SWEEPS * exposure_s * float(np.abs(velocity[:, 2]).max()))
    fx, fy, _, _, width, height = picture
    alpha_min, reach_m, count = kernels.solve_reach(
        diameters_m,
        per_size,
        across * exposure_s,
        float(np.sqrt(fx * fy)),
        width * height / (fx * fy),
        HALF_DEPTH_M,
        float(max_particles),
        FAINTEST_ALPHA,
        near_m,
        LEAST_REACH * near_m,
        FAR_M,
    )
    opaque = per_size * np.frombuffer(drawn_share)
    optical_depth = kernels.resolved_optical_depth(
        diameters_m,
        opaque,
        reach_m,
        near_m,
        near_m * NEAR_FULL_M / NEAR_M,
        FADE_SHARE,
        FAR_M,
        DEPTH_BINS,
    )
    reach_m = reach_m.astype(np.float32)
    for array in (reach_m, optical_depth):
        array.flags.writeable = False
    return Resolved(alpha_min, reach_m, count, optical_depth, near_m)


def shutter_turning_rad_per_s(camera: Camera) -> Float64:
    """(3,) how fast the camera turns, at most `MOST_TURN_RAD` while its shutter is open."""
    turn_rad = float(np.linalg.norm(camera.angular_velocity_rad_per_s)) * camera.exposure_s
    turning: Float64 = camera.angular_velocity_rad_per_s * min(
        1.0, MOST_TURN_RAD / max(turn_rad, 1e-12)
    )
    return turning


def arrivals(mean_per_cell: Float64) -> Float64:
    """Later particles (C,) that a hash cell must have room for until one is fully there."""
    least, share = ARRIVALS
    width: Float64 = least + share * np.asarray(mean_per_cell)
    return width


def drawn_share(mean_per_cell: Float64) -> Float64:
    """Share (C,) of the opacity that the arrival of the latest particles leaves, on average.

    Of a cell's n particles the one with j later ones is (j + f) / w there, at most 1, with f
    uniform and w = `arrivals`; there is one with probability P(n > j) of the Poisson law.
    """
    mean = np.maximum(mean_per_cell, 1e-9)[:, None]
    width = arrivals(mean)
    later = np.arange(math.ceil(width.max()))
    end = np.clip(width, later, later + 1)
    missing = (end - later) - (end**2 - later**2) / (2 * width)
    log_factorial = np.array([math.lgamma(j + 1) for j in later])
    up_to = np.exp(later * np.log(mean) - mean - log_factorial).cumsum(axis=1)
    # Of nearly empty cells 1 - exp(-m) would lose its digits.
    more = np.where(later == 0, -np.expm1(-mean), np.maximum(1.0 - up_to, 0.0))
    share: Float64 = 1.0 - (more * missing).sum(axis=1) / mean[:, 0]
    return share


def _across_picture(picture: tuple[float, ...], relative: Float64) -> Float64:
    """Speed (C,) across the line of sight, m/s, averaged over the picture.

    `relative` is (C, 3), in camera axes. Motion along the line of sight draws no streak: from a
    moving car the speed across is much less than the speed. The camera's own turning is left out,
    because its share grows with depth.
    """
    fx, fy, cx, cy, width, height = picture
    tx = (np.linspace(0, width, 7) - cx) / fx
    ty = (np.linspace(0, height, 7) - cy) / fy
    across_x = relative[:, 0, None, None] - tx[:, None] * relative[:, 2, None, None]
    across_y = relative[:, 1, None, None] - ty[None, :] * relative[:, 2, None, None]
    return np.asarray(np.hypot(across_x, across_y).mean(axis=(1, 2)))
