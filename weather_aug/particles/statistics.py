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

from weather_aug._checks import finite
from weather_aug.errors import ArgumentError

Float64 = NDArray[np.float64]

RAIN_EDGES_MM = np.array(
    [0.5, 0.65, 0.8, 1.0, 1.2, 1.45, 1.7, 2.0, 2.3, 2.7, 3.1, 3.6, 4.2, 5.0, 6.0]
)
"""Speed classes of drops, by diameter."""
SNOW_EDGES_MM = np.array([0.5, 0.6, 0.72, 0.86, 1.02, 1.2, 1.4, 1.62, 1.86, 2.15, 2.5, 2.9, 3.37])
"""Speed classes of flakes, by melted diameter; 3.37 mm melted is a flake of 15 mm."""
SIZES_PER_CLASS = 16
RAIN_CELL_M = np.clip(0.55 * np.sqrt(RAIN_EDGES_MM[:-1] * RAIN_EDGES_MM[1:]), 0.4, 3.0)
SNOW_CELL_M = 0.75 * np.sqrt(SNOW_EDGES_MM[:-1] * SNOW_EDGES_MM[1:])
"""Sides of the hash cells of each class: near the fastest for cars' cameras."""
TRACE_MM_PER_H = 1e-4
"""Rates up to this are nothing: a kilometre of it takes a four-thousandth of the light."""

MARSHALL_PALMER_PER_M3_MM = 8000.0
DRY_FLAKE_G_PER_CM3_MM = 0.17
"""Density of a dry aggregate is this over its diameter in mm (Holroyd 1971)."""
WET_FLAKE_G_PER_CM3_MM = 0.72
"""The same of a wet or rimed one (Rasmussen 1999)."""
RASMUSSEN_FALL_SPEED_M_PER_S = 1.0
"""Of all dry flakes, in Rasmussen's extinction."""
SNOW_SWAY_M = 0.06
SNOW_SWAY_RAD_PER_S = (3.1, 2.2)
"""Of the smallest flakes; larger ones sway slower."""
RAIN_SWAY_RAD_PER_S = (12.6, 10.1)
CALM_JITTER_M_PER_S = 0.1
JITTER_PER_WIND = 0.1
"""Drops stray from their common velocity by 0.1 m/s and a tenth of the wind (RMS, each way)."""


@dataclass(frozen=True, eq=False)
class Population:
    """Particles of one kind in the air at one rate, in classes of one fall speed each.

    Convention:
        C classes; inside a class the Q diameters are equally frequent (mid-quantiles of the
        distribution at this rate). A class's speed does not depend on the rate, so that a particle
        keeps its path when the severity changes; nor does what a class is (its edges, its cells)
        depend on rate or wetness.
    """

    kind: str
    density_per_m3: Float64
    """(C,)."""
    diameters_m: Float64
    """(C, Q), rising along each row."""
    fall_speed_m_per_s: Float64
    """(C,), of dry flakes; wet ones fall 1 + `wetness` times as fast."""
    cell_m: Float64
    """(C,) side of the hash cells; part of the field's identity, never of the rate."""
    sway_rad_per_s: Float64
    """(C, 2) of the two horizontal sways of each class."""
    sway_m: Float64
    """(C, 2) amplitudes of the sways in still air."""
    sway_per_wind_s: Float64
    """(C, 2) growth of the amplitudes with the horizontal wind, metres per m/s."""
    extinction_per_m: float
    """Of the whole distribution, also of what is too small for a class."""
    wetness: float = 0.0
    """Of snow, in [0, 1]."""
    tumbles: bool = False
    """Whether the particles are tumbling ellipsoids; balls if not."""

    @property
    def mean_per_cell(self) -> Float64:
        """(C,) expected particles of each class in one hash cell."""
        mean: Float64 = self.density_per_m3 * self.cell_m**3
        return mean


def rain(rate_mm_per_h: float, *, fall_speed: str = "brandes") -> Population:
    """Raindrops after Marshall and Palmer (1948), falling after Brandes (2002) or Atlas (1973).

    N(D) = 8000 exp(-4.1 R^-0.21 D) per m3 and mm; drops from 0.5 mm are particles, the smaller
    ones count only in the extinction. Distributions are cut at 6 mm. Each drop strays from its
    class's velocity by a sway of 0.1 m/s + 0.1 |wind| (RMS, each way), fast enough that its
    amplitude stays under 2 cm + 2 cm per m/s: with the wind a drop's place moves by that much.

    Args:
        rate_mm_per_h: Above 0.
        fall_speed: Law of the terminal speed, "brandes" or "atlas".

    Raises:
        ArgumentError: If there is no such law.
    """
    if fall_speed not in FALL_SPEEDS:
        raise ArgumentError(
            f"fall_speed must be one of {', '.join(FALL_SPEEDS)}, got {fall_speed!r}"
        )
    slope = marshall_palmer_slope_per_mm(rate_mm_per_h)
    density, diameters_mm = _classes(
        RAIN_EDGES_MM, slope, lambda d: MARSHALL_PALMER_PER_M3_MM * np.exp(-slope * d)
    )
    middle_mm = np.sqrt(RAIN_EDGES_MM[:-1] * RAIN_EDGES_MM[1:])
    sway_rad_per_s = np.tile(RAIN_SWAY_RAD_PER_S, (len(middle_mm), 1))
    return Population(
        kind="rain",
        density_per_m3=density,
        diameters_m=diameters_mm * 1e-3,
        fall_speed_m_per_s=_settled(FALL_SPEEDS[fall_speed](middle_mm)),
        cell_m=RAIN_CELL_M,
        sway_rad_per_s=sway_rad_per_s,
        sway_m=math.sqrt(2) * CALM_JITTER_M_PER_S / sway_rad_per_s,
        sway_per_wind_s=math.sqrt(2) * JITTER_PER_WIND / sway_rad_per_s,
        extinction_per_m=rain_extinction_per_m(rate_mm_per_h),
    )


def snow(rate_mm_per_h: float, wetness: float = 0.0) -> Population:
    """Snowflakes after Gunn and Marshall (1958), falling after Locatelli and Hobbs (1974).

    N = 3800 S^-0.87 exp(-2.55 S^-0.48 Dm) per m3 and mm of melted diameter Dm; a dry flake of
    density 0.17/D g/cm3 has the diameter D = sqrt(Dm^3 / 0.17) mm and falls with 0.8 D^0.16 m/s.
    Wet flakes are denser (up to 0.72/D), hence smaller, fall 1 + wetness times as fast, and are
    fewer by that factor, because the same rate reaches the ground.

    Args:
        rate_mm_per_h: Liquid equivalent, above 0.
        wetness: From 0 (dry) to 1 (wet, rimed).

    Raises:
        ArgumentError: If the wetness is out of range.
    """
    wetness = finite("wetness", wetness, 0.0, 1.0)
    slope, intercept = gunn_marshall(rate_mm_per_h)
    intercept /= 1.0 + wetness
    density, melted_mm = _classes(SNOW_EDGES_MM, slope, lambda d: intercept * np.exp(-slope * d))
    middle_mm = flake_diameter_mm(np.sqrt(SNOW_EDGES_MM[:-1] * SNOW_EDGES_MM[1:]))
    slower = 1.0 + 0.1 * np.arange(len(middle_mm))[:, None]
    sway_rad_per_s = np.array(SNOW_SWAY_RAD_PER_S) / slower
    return Population(
        kind="snow",
        density_per_m3=density,
        diameters_m=flake_diameter_mm(melted_mm, wetness) * 1e-3,
        fall_speed_m_per_s=_settled(0.8 * middle_mm**0.16),
        cell_m=SNOW_CELL_M,
        sway_rad_per_s=sway_rad_per_s,
        sway_m=np.full_like(sway_rad_per_s, SNOW_SWAY_M * (1.0 - 0.5 * wetness)),
        sway_per_wind_s=np.zeros_like(sway_rad_per_s),
        extinction_per_m=snow_extinction_per_m(rate_mm_per_h, wetness),
        wetness=wetness,
        tumbles=True,
    )


def marshall_palmer_slope_per_mm(rate_mm_per_h: float) -> float:
    """Slope of the drop-size distribution, 4.1 R^-0.21 per mm."""
    return 4.1 * rate_mm_per_h**-0.21


def gunn_marshall(rate_mm_per_h: float) -> tuple[float, float]:
    """Slope per mm and intercept per m3 and mm of the melted-diameter distribution."""
    return 2.55 * rate_mm_per_h**-0.48, 3800.0 * rate_mm_per_h**-0.87


def brandes_fall_speed_m_per_s(diameter_mm: Float64) -> Float64:
    """Terminal speed of drops in still air at sea level (Brandes et al. 2002), at least 0."""
    d = diameter_mm
    speed = -0.1021 + 4.932 * d - 0.9551 * d**2 + 0.07934 * d**3 - 0.002362 * d**4
    return np.maximum(speed, 0.0)


def atlas_fall_speed_m_per_s(diameter_mm: Float64) -> Float64:
    """Terminal speed of drops in still air at sea level (Atlas et al. 1973), at least 0."""
    return np.maximum(9.65 - 10.3 * np.exp(-0.6 * diameter_mm), 0.0)


FALL_SPEEDS: dict[str, Callable[[Float64], Float64]] = {
    "brandes": brandes_fall_speed_m_per_s,
    "atlas": atlas_fall_speed_m_per_s,
}


def flake_density_g_per_cm3_mm(wetness: float) -> float:
    """Density of a flake times its diameter, between a dry one's (0.17) and a wet one's (0.72)."""
    return DRY_FLAKE_G_PER_CM3_MM + wetness * (WET_FLAKE_G_PER_CM3_MM - DRY_FLAKE_G_PER_CM3_MM)


def flake_diameter_mm(melted_mm: Float64, wetness: float = 0.0) -> Float64:
    """Diameter of the aggregate that melts to a drop of `melted_mm`."""
    diameter: Float64 = np.sqrt(melted_mm**3 / flake_density_g_per_cm3_mm(wetness))
    return diameter


def rain_extinction_per_m(rate_mm_per_h: float) -> float:
    """Silhouette area per volume of all drops up to 6 mm; 0.182 R^0.63 per km without the cut."""
    slope = marshall_palmer_slope_per_mm(rate_mm_per_h)
    x = slope * RAIN_EDGES_MM[-1]
    second_moment = 2.0 - math.exp(-x) * (x * x + 2 * x + 2)
    return math.pi / 4 * 1e-6 * MARSHALL_PALMER_PER_M3_MM * second_moment / slope**3


def snow_extinction_per_m(rate_mm_per_h: float, wetness: float = 0.0) -> float:
    """Silhouette area per volume of all flakes, whatever their sizes: 2.45 S per km when dry.

    Where the density of a flake times its diameter is a constant C3, its silhouette is 1.5 times
    its mass over C3. The size law agrees to 5 % from 0.4 to 4 mm/h where it is cut at 6 mm of
    melted water, as the law of drops is; beyond, no cut serves all rates, this line does. What the
    classes leave out (flakes under 0.5 mm and over 3.37 mm melted) becomes veil, not particles.

    Source:
        Rasmussen et al. (1999): 1.5 W / C3, water content W = S / (3.6 v), v = 1 m/s when dry.
    """
    fall_speed_m_per_s = RASMUSSEN_FALL_SPEED_M_PER_S * (1.0 + wetness)
    water_g_per_m3 = rate_mm_per_h / (3.6 * fall_speed_m_per_s)
    return 1.5 * water_g_per_m3 / (1e3 * flake_density_g_per_cm3_mm(wetness))


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


def _settled(fall_speed_m_per_s: Float64) -> Float64:
    """Speeds rounded to float32.

    The last bits of numpy's `exp` and `power` depend on the CPU, and the time since the clip's
    start would multiply them.
    """
    return fall_speed_m_per_s.astype(np.float32).astype(np.float64)
