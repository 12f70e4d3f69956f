"""Weather styles of Gaussians and of stored backgrounds: the weather in them, and in which shares.

Also what a render leaves out because a style shows it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

from weather_aug._checks import finite
from weather_aug.errors import ArgumentError, printable
from weather_aug.render.options import RenderOptions
from weather_aug.scene.policy import TYPES, weather_of
from weather_aug.severity import FOG, NAMED_SEVERITIES, SNOW, fog_severity
from weather_aug.timeline import WeatherTimeline
from weather_aug.weather import Weather

CARRIED = ("relight", "sky", "film", "mirror", "puddles", "ripples", "snow_cover", "tracks")
"""Effects on surfaces: a style has them already."""
STYLE_SEVERITY = "heavy"
"""Of the weather that styles are fitted to; `amount` goes from none of it to all."""
LEAST_AMOUNT = 1e-9
"""Of a style; less is rounding."""
PHYSICAL = "physical"
"""In the place of a style: the physical editor dresses the recorded picture while rendering."""


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


def style_amounts(weather: Weather, styles: Collection[str]) -> dict[str, float]:
    """How much of each style a weather asks for, in the order snow, rain, fog.

    A style shows its weather at `STYLE_SEVERITY`, so that much of what makes it is all of it: of
    snow the cover beside the road, of rain the wetness, of fog the severity of the visibility. Snow
    and fog are wet, too; only wetness beyond what they bring at their own severity asks for rain.
    Where the amounts sum to more than 1, snow has its share first, then rain, then fog: snow hides
    a film of water, and fog is what rendering adds anyway. Each amount is continuous in the
    weather's numbers and does not fall as its own weather becomes more severe; clear asks for none,
    and what is in the air alone (falling, spray) asks for none either, but for fog.

    Args:
        weather: Any.
        styles: Names of those that there are.

    Returns:
        Amounts in (0, 1] that sum to at most 1, by name; what is not asked for is not among them.

    Raises:
        ArgumentError: If the weather is none.
    """
    if not isinstance(weather, Weather):
        raise ArgumentError(f"weather must be a Weather, got {type(weather).__name__}")
    whole = NAMED_SEVERITIES[STYLE_SEVERITY]
    fog = fog_severity(weather.visibility_m)
    snow = SNOW["snow_cover"].severity_of(weather.snow_cover)
    brought = max(SNOW["wetness"].at(snow), FOG["wetness"].at(fog))
    heaviest = {name: weather_of(name, STYLE_SEVERITY) for name in ("snow", "rain")}
    asked = {
        "snow": weather.snow_cover / heaviest["snow"].snow_cover,
        "rain": (weather.wetness - brought) / heaviest["rain"].wetness,
        "fog": fog / whole,
    }
    amounts: dict[str, float] = {}
    for name, amount in asked.items():
        left = 1.0 - sum(amounts.values())
        if name in styles and min(amount, left) > LEAST_AMOUNT:
            amounts[name] = min(amount, left)
    return amounts


def weights_of(
    style: str | Mapping[str, float], amount: float, styles: Collection[str]
) -> dict[str, float]:
    """Weights above 0 by name of the style, as `gaussians.gather.gather` takes them.

    Args:
        style: A name, or weights by name, at least 0 and together at most 1.
        amount: In [0, 1], of all of them.
        styles: Names of those that there are.

    Raises:
        ArgumentError: If a style is unknown, or weights or amount leave their range.
    """
    amount = finite("amount", amount, 0.0, 1.0)
    weights = {style: 1.0} if isinstance(style, str) else dict(style)
    for name, weight in weights.items():
        if name not in styles:
            raise ArgumentError(
                f"style {printable(name)!r} is unknown; there is {', '.join(styles) or 'none'}"
            )
        finite(f"the weight of style {name!r}", weight, 0.0)
    total = sum(weights.values())
    # Shares that are written in decimals may add up to a little more than 1.
    if not total <= 1 + 1e-6:
        raise ArgumentError(f"the weights of styles must add up to at most 1, got {total:g}")
    return {name: amount * weight for name, weight in weights.items() if amount * weight > 0}


def weights_asked(
    weather: Weather | WeatherTimeline,
    time_s: float,
    style: str | Mapping[str, float] | None,
    amount: float,
    styles: Collection[str],
) -> dict[str, float]:
    """Weights above 0 by name: of the style that is named, else of those the weather asks for.

    Args:
        weather: At `time_s`, or a timeline.
        time_s: Since the first frame.
        style: As of `weights_of`; None leaves it to the weather.
        amount: In [0, 1], of all of them.
        styles: Names of those that there are.

    Raises:
        ArgumentError: As `weights_of` and `style_amounts`.
    """
    if style is not None:
        return weights_of(style, amount, styles)
    if isinstance(weather, WeatherTimeline):
        weather = weather.at(time_s)
    return weights_of(style_amounts(weather, styles), amount, styles)


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
    """Without what a style shows already: the physical editor would dress the street twice."""
    return replace(options, without=(*options.without, *CARRIED))
