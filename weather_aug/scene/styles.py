"""Weather styles of Gaussians: which weather they show, and what a render then leaves out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from weather_aug.render.options import RenderOptions
from weather_aug.scene.policy import TYPES, weather_of
from weather_aug.weather import Weather

CARRIED = ("relight", "sky", "film", "mirror", "puddles", "ripples", "snow_cover", "tracks")
"""Effects on surfaces: a style of the Gaussians has them already."""
STYLE_SEVERITY = "heavy"
"""Of the weather that styles are fitted to; `amount` goes from none of it to all."""


def style_weather(name: str) -> Weather | None:
    """What lies on the ground and covers the sky in a style: its weather, with nothing in the air.

    None for a style whose name is no type of weather.
    """
    if name not in TYPES:
        return None
    weather = weather_of(name, STYLE_SEVERITY, falling=False)
    air = Weather.clear()
    in_the_air = ("visibility_m", "fog_scale_height_m", "mist_per_km", "spray_per_km", "lamps")
    return replace(weather, **{field: getattr(air, field) for field in in_the_air})


def lying_in(style: str | Mapping[str, float] | None, amount: float) -> Weather:
    """The snow on the ground of a style, or of a mixture of styles; all else is clear."""
    if style is None:
        return Weather.clear()
    weights = {style: 1.0} if isinstance(style, str) else style
    known = [(share, style_weather(name)) for name, share in weights.items()]
    snow = {
        name: sum(amount * share * getattr(weather, name) for share, weather in known if weather)
        for name in ("snow_cover", "road_snow_cover", "snow_depth_m")
    }
    return replace(Weather.clear(), **snow)


def carried_options(options: RenderOptions) -> RenderOptions:
    """Without what a style's colours show already: the editor would dress the street twice."""
    return replace(options, without=(*options.without, *CARRIED))
