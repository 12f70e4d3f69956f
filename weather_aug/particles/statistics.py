"""How many drops and flakes of which size and speed are in the air: measured distributions.

Diameters are in millimetres inside this file, because the published laws are; everything handed
out is in metres. A drop's or flake's shadow (its silhouette) counts once: the extinction efficiency
is 1 for a camera, whose pixels are wider than the diffraction lobe.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]

RAIN_EDGES_MM = np.array(
    [0.5, 0.65, 0.8, 1.0, 1.2, 1.45, 1.7, 2.0, 2.3, 2.7, 3.1, 3.6, 4.2, 5.0, 6.0]
)
"""Speed classes of drops, by diameter."""
SNOW_EDGES_MM = np.array([0.5, 0.6, 0.72, 0.86, 1.02, 1.2, 1.4, 1.62, 1.86, 2.15, 2.5, 2.9, 3.37])
"""Speed classes of flakes, by melted diameter; 3.37 mm melted is a flake of 15 mm."""
SIZES_PER_CLASS = 16
TRACE_MM_PER_H = 1e-4
"""Rates up to this are nothing: a kilometre of it takes a four-thousandth of the light."""

MARSHALL_PALMER_PER_M3_MM = 8000.0
FLAKE_DENSITY_G_PER_CM3_MM = 0.17
"""Density of an aggregate is this over its diameter in mm (Holroyd 1971)."""


@dataclass(frozen=True)
class Population:
    """Particles of one kind in the air at one rate, in classes of one fall speed each.

    Convention:
        C classes; inside a class the Q diameters are equally frequent (mid-quantiles of the
        distribution at this rate). A class's speed does not depend on the rate, so that a particle
        keeps its path when the severity changes.
    """

    kind: str
    density_per_m3: Float64
    """(C,)."""
    diameters_m: Float64
    """(C, Q), rising along each row."""
    fall_speed_m_per_s: Float64
    """(C,)."""
    cell_m: Float64
    """(C,) side of the hash cells; part of the field's identity, never of the rate."""
    sway_m: float
    """Amplitude of the sideways sway, 0 for none."""
    extinction_per_m: float
    """Of the whole distribution, also of what is too small for a class."""


def rain(rate_mm_per_h: float) -> Population:
    """Raindrops after Marshall and Palmer (1948), falling after Brandes (2002).

    N(D) = 8000 exp(-4.1 R^-0.21 D) per m3 and mm; drops from 0.5 mm are particles, the smaller
    ones count only in the extinction. Distributions are cut at 6 mm.
    """
    slope = marshall_palmer_slope_per_mm(rate_mm_per_h)
    density, diameters_mm = _classes(
        RAIN_EDGES_MM, slope, lambda d: MARSHALL_PALMER_PER_M3_MM * np.exp(-slope * d)
    )
    middle_mm = np.sqrt(RAIN_EDGES_MM[:-1] * RAIN_EDGES_MM[1:])
    return Population(
        kind="rain",
        density_per_m3=density,
        diameters_m=diameters_mm * 1e-3,
        fall_speed_m_per_s=rain_fall_speed_m_per_s(middle_mm),
        cell_m=np.clip(0.5 * middle_mm, 0.5, 2.0),
        sway_m=0.0,
        extinction_per_m=rain_extinction_per_m(rate_mm_per_h),
    )


def snow(rate_mm_per_h: float) -> Population:
    """Snowflakes after Gunn and Marshall (1958), falling after Locatelli and Hobbs (1974).

    N = 3800 S^-0.87 exp(-2.55 S^-0.48 Dm) per m3 and mm of melted diameter; a flake of density
    0.17/D g/cm3 has the diameter D = sqrt(Dm^3 / 0.17) mm and falls with 0.8 D^0.16 m/s.
    """
    slope, intercept = gunn_marshall(rate_mm_per_h)
    density, melted_mm = _classes(SNOW_EDGES_MM, slope, lambda d: intercept * np.exp(-slope * d))
    flake_mm = flake_diameter_mm(melted_mm)
    middle_mm = flake_diameter_mm(np.sqrt(SNOW_EDGES_MM[:-1] * SNOW_EDGES_MM[1:]))
    return Population(
        kind="snow",
        density_per_m3=density,
        diameters_m=flake_mm * 1e-3,
        fall_speed_m_per_s=0.8 * middle_mm**0.16,
        cell_m=np.clip(0.2 * middle_mm, 0.4, 1.5),
        sway_m=0.06,
        extinction_per_m=snow_extinction_per_m(rate_mm_per_h),
    )


def marshall_palmer_slope_per_mm(rate_mm_per_h: float) -> float:
    """Slope of the drop-size distribution, 4.1 R^-0.21 per mm."""
    return 4.1 * rate_mm_per_h**-0.21


def gunn_marshall(rate_mm_per_h: float) -> tuple[float, float]:
    """Slope per mm and intercept per m3 and mm of the melted-diameter distribution."""
    return 2.55 * rate_mm_per_h**-0.48, 3800.0 * rate_mm_per_h**-0.87


def rain_fall_speed_m_per_s(diameter_mm: Float64) -> Float64:
    """Terminal speed of drops in still air at sea level (Brandes et al. 2002), at least 0."""
    d = diameter_mm
    speed = -0.1021 + 4.932 * d - 0.9551 * d**2 + 0.07934 * d**3 - 0.002362 * d**4
    return np.maximum(speed, 0.0)


def flake_diameter_mm(melted_mm: Float64) -> Float64:
    """Diameter of the aggregate that melts to a drop of `melted_mm`."""
    diameter: Float64 = np.sqrt(melted_mm**3 / FLAKE_DENSITY_G_PER_CM3_MM)
    return diameter


def rain_extinction_per_m(rate_mm_per_h: float) -> float:
    """Silhouette area per volume of all drops up to 6 mm; 0.182 R^0.63 per km without the cut."""
    slope = marshall_palmer_slope_per_mm(rate_mm_per_h)
    x = slope * RAIN_EDGES_MM[-1]
    second_moment = 2.0 - math.exp(-x) * (x * x + 2 * x + 2)
    return math.pi / 4 * 1e-6 * MARSHALL_PALMER_PER_M3_MM * second_moment / slope**3


def snow_extinction_per_m(rate_mm_per_h: float) -> float:
    """Silhouette area per volume of all flakes; near 2.46 S per km (Rasmussen 1999).

    Flakes beyond the largest class (15 mm) count here too: they become veil, not particles.
    """
    slope, intercept = gunn_marshall(rate_mm_per_h)
    third_moment = 6.0 * intercept / slope**4
    return math.pi / 4 * 1e-6 * third_moment / FLAKE_DENSITY_G_PER_CM3_MM


def _classes(
    edges_mm: Float64, slope_per_mm: float, number: Callable[[Float64], Float64]
) -> tuple[Float64, Float64]:
    """Density (C,) and mid-quantile diameters (C, Q) of an exponential distribution in classes."""
    low, high = edges_mm[:-1, None], edges_mm[1:, None]
    density = ((number(low) - number(high)) / slope_per_mm)[:, 0]
    quantile = (np.arange(SIZES_PER_CLASS) + 0.5) / SIZES_PER_CLASS
    kept = -np.expm1(-slope_per_mm * (high - low))
    diameters = low - np.log1p(-quantile * kept) / slope_per_mm
    return density, diameters
