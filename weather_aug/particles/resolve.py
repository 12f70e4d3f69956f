"""Which particles a camera resolves; what it does not resolve becomes extinction.

A particle is drawn where its pixel opacity is at least `alpha_min`; the rest of the population is a
veil in closed form, so that the optical depth of both together is right at any particle budget.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.types import Camera
from weather_aug.particles import kernels
from weather_aug.particles.statistics import Population

NEAR_M = 0.5
"""Nearer particles are drops on the lens or behind the bonnet, not in the air."""
FAR_M = 60.0
"""No particle is drawn beyond."""
FAINTEST_ALPHA = 0.01
"""About 2.5 of 255 levels: fainter particles cannot be seen and are never drawn."""
DEPTH_BINS = 1024

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class Resolved:
    """The resolved part of a population for one camera, and the optical depth it carries."""

    alpha_min: float
    reach_m: Float32
    """(C, Q) depth up to which a particle of this class and size is drawn; 0 for never."""
    expected_count: float
    """Particles drawn in the whole picture, on average."""
    optical_depth: Float32
    """(DEPTH_BINS + 1,) of drawn particles, on the axis, up to the depth k / DEPTH_BINS * FAR_M."""


def resolve(
    population: Population, camera: Camera, streak_m: Float64, max_particles: int
) -> Resolved:
    """Split `population` into drawn particles and veil for one camera.

    Args:
        population: What is in the air.
        camera: The whole picture's camera; a crop draws a subset of its particles.
        streak_m: (C,) path of a particle relative to the camera while the shutter is open.
        max_particles: Expected number of drawn particles at the most.

    Returns:
        The reach of each size; `alpha_min` is the smallest that keeps the count within the budget.

    Source:
        pixel opacity of a drop of width w and streak l pixels: (pi/4) w^2 / (max(w,1) max(l+w,1)).
    """
    fx, fy = camera.focal_px
    focal_px = float(np.sqrt(fx * fy))
    solid_px = camera.width * camera.height / (fx * fy)
    per_size = population.density_per_m3 / population.diameters_m.shape[1]
    alpha_min, reach_m, count = kernels.solve_reach(
        population.diameters_m,
        per_size,
        streak_m,
        focal_px,
        solid_px,
        float(max_particles),
        FAINTEST_ALPHA,
        NEAR_M,
        FAR_M,
    )
    optical_depth = kernels.resolved_optical_depth(
        population.diameters_m, per_size, reach_m, NEAR_M, FAR_M, DEPTH_BINS
    )
    return Resolved(alpha_min, reach_m.astype(np.float32), count, optical_depth)
