"""How much light a water surface mirrors, and how dark it makes what lies under it.

Convention:
    Angles are grazing angles: between the ray and the surface, not its normal; radians.
    Reflectances are for unpolarised light on a smooth surface of water (n = 1.333) in air, in
    [0, 1].
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from weather_aug._compiled import inlined
from weather_aug.errors import ArgumentError

Float64 = NDArray[np.float64]

WATER_INDEX = 1.333
DIFFUSE_FROM_AIR = 0.066
"""Share of light from all sides of the air that water throws back: the mean of `fresnel` over the
hemisphere, weighted by the sine of the grazing angle."""
DIFFUSE_FROM_WATER = 1.0 - (1.0 - DIFFUSE_FROM_AIR) / WATER_INDEX**2
"""Share of light from all sides of the water that stays in it: the same exchange backwards."""
_INDEX2 = np.float32(WATER_INDEX**2)


def fresnel(grazing_rad: ArrayLike) -> Float64:
    """Share of unpolarised light that a smooth water surface mirrors, by Fresnel's equations.

    Schlick's approximation is 0.04 to 0.06 too high between 2 and 10 degrees, where most of a road
    is seen; this is exact.

    Args:
        grazing_rad: Any shape, in [0, pi / 2].

    Returns:
        The same shape, 1 at 0 and 0.0204 at pi / 2.

    Raises:
        ArgumentError: If an angle is outside the range.
    """
    grazing = np.asarray(grazing_rad, np.float64)
    if not ((grazing >= 0.0) & (grazing <= 0.5 * np.pi)).all():
        raise ArgumentError(
            "grazing_rad must be angles in [0, pi / 2] between ray and surface, got "
            f"{np.min(grazing):g} to {np.max(grazing):g}; give radians, and the angle to the "
            "surface instead of to its normal"
        )
    sine = np.sin(grazing)
    inside = np.sqrt(WATER_INDEX**2 - np.cos(grazing) ** 2)
    across = (sine - inside) / (sine + inside)
    along = (WATER_INDEX**2 * sine - inside) / (WATER_INDEX**2 * sine + inside)
    return np.asarray(0.5 * (across**2 + along**2))


def film_ratio(albedo: ArrayLike) -> Float64:
    """How dark a water film makes a rough surface: its wet albedo over its dry one.

    Light that the surface scatters is partly thrown back by the film's upper side and meets the
    surface again; a darker surface takes more of it at each turn (Angstroem 1925; Lekner and Dorf
    1988). The mirrored light is not in it.

    Args:
        albedo: Of the dry surface, any shape, in [0, 1]; per channel for coloured surfaces.

    Returns:
        The same shape: 0.49 for black, 0.52 at 0.12 (asphalt), 0.93 for white.

    Raises:
        ArgumentError: If an albedo is outside the range.
    """
    dry = np.asarray(albedo, np.float64)
    if not ((dry >= 0.0) & (dry <= 1.0)).all():
        raise ArgumentError(
            f"albedo must be in [0, 1], got {np.min(dry):g} to {np.max(dry):g}; divide the light "
            "by the illumination first"
        )
    passes = (1.0 - DIFFUSE_FROM_AIR) * (1.0 - DIFFUSE_FROM_WATER)
    return np.asarray(passes / (1.0 - DIFFUSE_FROM_WATER * dry))


@inlined
def fresnel_of_sine(sine):
    """`fresnel` by the sine of the grazing angle, float32, in [0, 1]; exact but for rounding.

    One root and two divisions, which rows of pixels share among the lanes of a register, so that no
    polynomial is faster by enough to be worth its error.
    """
    inside = np.sqrt(sine * sine + (_INDEX2 - np.float32(1.0)))
    across = (inside - sine) / (inside + sine)
    along = (_INDEX2 * sine - inside) / (_INDEX2 * sine + inside)
    return np.float32(0.5) * (across * across + along * along)


@inlined
def film_ratio_of(albedo):
    """`film_ratio`, float32."""
    passes = np.float32((1.0 - DIFFUSE_FROM_AIR) * (1.0 - DIFFUSE_FROM_WATER))
    return passes / (np.float32(1.0) - np.float32(DIFFUSE_FROM_WATER) * albedo)
