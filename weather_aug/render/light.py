"""Colours of particles under a scene's light."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from weather_aug.edit.ambience import Ambience

Float64 = NDArray[np.float64]


def rain_colour(ambience: Ambience) -> Float64:
    """Linear colour of a drop: an inverted view of 165 degrees of its surroundings.

    Source:
        Garg and Nayar (2007): a drop refracts sky, horizon and ground; 6 % is reflected light.
    """
    refracted = 0.45 * ambience.sky + 0.20 * ambience.middle + 0.35 * ambience.ground
    mean = (ambience.sky + ambience.middle + ambience.ground) / 3
    return np.asarray(0.94 * refracted + 0.06 * mean)


def snow_colour(ambience: Ambience) -> Float64:
    """Linear colour of a flake: diffuse, lit from above and below, never brighter than the sky."""
    diffuse = 0.9 * 0.5 * (ambience.sky + ambience.ground)
    return np.minimum(diffuse, 0.98 * ambience.sky)


def particle_colour(kind: str, light: Ambience) -> Float64:
    """Linear colour (3,) of a kind of particle ("rain" or "snow") under a light."""
    return {"rain": rain_colour, "snow": snow_colour}[kind](light)
