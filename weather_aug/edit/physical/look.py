"""What a weather does to surfaces, in the numbers that the editor's kernels take."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from weather_aug.colour import LUMINANCE
from weather_aug.edit.ambience import Ambience
from weather_aug.edit.physical.overcast import CONTRAST_LOSS, ZENITH_GAIN
from weather_aug.weather import Weather

CANYON_SHARE = 0.65
"""Of the sky that a street sees: a white surface there is this much of the sky's luminance."""
EXPOSING_POWER = 0.6
"""How far the camera's automatic exposure follows; 1 would keep the street's luminance."""
EXPOSURE_RANGE = (1.0, 1.8)
WET_EXPOSURE = 0.15
"""How much longer the camera exposes a wet street, which is darker."""
SNOW_EXPOSURE_LOSS = 0.15
"""How much darker all else comes out between white fields."""
SNOW_SHARE_OF_SKY = 0.97
"""Most luminance of snow over the horizon's."""
RIPPLING_MM_PER_H = 10.0
"""Rain that leaves no place without rings."""
RIPPLES_PERIOD_S = 3600.0
"""After which the rings repeat: single precision knows no later milliseconds."""
FILM_FLOODED, RAIN_FLOODED, FLOODING_MM_PER_H = 0.15, 0.55, 75.0
"""Share of a wet road where the film covers the stones, at rest and in the heaviest rain."""


class Look(NamedTuple):
    """What the weather does to surfaces, float32."""

    sky: np.float32
    """How far the sky is an overcast one."""
    flattening: np.float32
    """Exponent of the light that takes the place of the sun's."""
    exposure: np.float32
    """Gain on everything but the sky and snow."""
    zenith_gain: np.float32
    red: np.float32
    """Airlight."""
    green: np.float32
    blue: np.float32
    film: np.float32
    """Wetness, as far as it darkens."""
    mirror: np.float32
    """Wetness, as far as it mirrors."""
    flooded: np.float32
    """Share of the wet road where the film covers the stones."""
    puddles: np.float32
    snow: np.float32
    road_snow: np.float32
    snow_depth_m: np.float32
    tracks: np.float32
    """1 where wheels keep snow off the road, else 0."""
    snow_light: np.float32
    """Most luminance of snow."""
    ripples: np.float32
    """Share of the places where a drop has just drawn a ring."""
    time_s: np.float32
    """For the rings."""


def changes_background(weather: Weather, without: Collection[str] = ()) -> bool:
    """Whether a weather changes what surfaces look like, not only the air before them."""
    states = {
        "relight": weather.overcast,
        "sky": weather.overcast,
        "film": weather.wetness,
        "mirror": weather.wetness,
        "snow_cover": max(weather.snow_cover, weather.road_snow_cover),
    }
    return any(amount > 0 for effect, amount in states.items() if effect not in without)


def look_of(
    weather: Weather,
    ambience: Ambience,
    illumination: float,
    time_s: float,
    without: Collection[str],
) -> Look:
    """The numbers of a weather under a scene's light.

    Args:
        weather: State of air and ground.
        ambience: Its airlight is the overcast sky's colour at the horizon.
        illumination: Luminance of a white surface in the recorded street, linear light.
        time_s: Of the picture, seconds.
        without: Effects that are left out.
    """

    def drawn(effect: str, amount: float) -> float:
        return 0.0 if effect in without else amount

    white = float(ambience.airlight @ LUMINANCE)
    overcast = drawn("relight", weather.overcast)
    snow = drawn("snow_cover", weather.snow_cover)
    low, high = EXPOSURE_RANGE
    exposure = (CANYON_SHARE * white / illumination) ** (EXPOSING_POWER * overcast)
    rain = min(weather.rain_mm_per_h / FLOODING_MM_PER_H, 1.0) ** 0.5
    values: dict[str, float] = dict(
        sky=drawn("sky", weather.overcast),
        flattening=overcast * (1.0 - CONTRAST_LOSS * overcast),
        exposure=min(max(exposure, low), high)
        * (1.0 - SNOW_EXPOSURE_LOSS * snow)
        * (1.0 + WET_EXPOSURE * drawn("film", weather.wetness)),
        zenith_gain=ZENITH_GAIN,
        red=ambience.airlight[0],
        green=ambience.airlight[1],
        blue=ambience.airlight[2],
        film=drawn("film", weather.wetness),
        mirror=drawn("mirror", weather.wetness),
        flooded=FILM_FLOODED * weather.wetness**2 + RAIN_FLOODED * rain,
        puddles=drawn("puddles", weather.puddles),
        snow=snow,
        road_snow=drawn("snow_cover", weather.road_snow_cover),
        snow_depth_m=drawn("snow_cover", weather.snow_depth_m),
        tracks=drawn("tracks", 1.0),
        snow_light=SNOW_SHARE_OF_SKY * white,
        ripples=drawn("ripples", min(weather.rain_mm_per_h / RIPPLING_MM_PER_H, 1.0)),
        time_s=math.fmod(time_s, RIPPLES_PERIOD_S),
    )
    return Look(**{name: np.float32(value) for name, value in values.items()})
