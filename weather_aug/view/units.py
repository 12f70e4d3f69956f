"""A weather in few words, with its units, for titles and captions."""

from __future__ import annotations

import math

from weather_aug.weather import Weather


def in_units(weather: Weather) -> str:
    """What falls and hangs in the air, else what lies on the ground, else "clear".

    Example:
        >>> in_units(Weather.rain("heavy"))
        '20 mm/h'
        >>> in_units(Weather.mix(Weather.snow("light"), Weather.fog(visibility_m=150)))
        '0.4 mm/h of water, visibility 150 m'
        >>> in_units(Weather.rain("heavy", falling=False))
        'wet ground'
    """
    told = []
    if weather.rain_mm_per_h > 0:
        told.append(f"{_short(weather.rain_mm_per_h)} mm/h")
    if weather.snow_mm_per_h > 0:
        told.append(f"{_short(weather.snow_mm_per_h)} mm/h of water")
    if weather.visibility_m < math.inf:
        told.append(f"visibility {_short(weather.visibility_m)} m")
    if not told and max(weather.mist_per_km, weather.spray_per_km) > 0:
        told.append("mist")
    if told:
        return ", ".join(told)
    if max(weather.snow_cover, weather.road_snow_cover) > 0:
        return "snow on the ground"
    if max(weather.wetness, weather.puddles) > 0:
        return "wet ground"
    return "clear" if weather.is_clear else "clear air"


def titled(kind: str, weather: Weather) -> str:
    """A type's name and what it is in units: "rain: 20 mm/h", or "clear" alone."""
    return kind if kind == "clear" else f"{kind}: {in_units(weather)}"


def _short(number: float) -> str:
    return f"{number:.0f}" if number >= 100 else f"{number:.2g}"
