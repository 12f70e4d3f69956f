"""WeatherPolicy: which weather a sample gets, as a function of (seed, epoch, item) alone."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import reduce
from typing import Any

from weather_aug._checks import finite
from weather_aug._keys import key_of, uniforms
from weather_aug.errors import ArgumentError, printable
from weather_aug.severity import fog_severity, parse_severity, rain_severity, snow_severity
from weather_aug.weather import Weather

TYPES = ("clear", "rain", "snow", "fog")
COMMONEST_SEVERITY = 0.5
"""Moderate: what falls and lies in most pictures of bad weather."""
VARIED = {
    "wetness": (0.6, 1.4, 1.0),
    "puddles": (0.0, 4.0, 1.0),
    "snow_cover": (0.5, 1.5, 1.0),
    "road_snow_cover": (0.0, 2.5, 1.0),
    "snow_depth_m": (0.4, 2.0, 2.0),
    "overcast": (0.7, 1.3, 1.0),
    "lamps": (0.2, 1.6, 1.0),
    "lens_drops": (0.0, 3.0, 500.0),
    "wipers": (0.2, 1.8, 1.0),
}
"""What differs between days of equal severity: least and greatest factor of the severity's value,
and what the product is cut at. Streets drain and are swept, it has rained for minutes or for hours,
drivers and windscreens differ. New names go to the end, so that draws of the others stay."""
_FIELDS = ("types", "severity", "falling", "variation")


@dataclass(frozen=True)
class WeatherDraw:
    """One sample's weather: a value that can be logged and rendered again."""

    weather: Weather
    seed: int
    """Of the particles."""
    kind: str
    """Name of the type drawn, as in the policy."""
    severity: float | None
    """In [0, 1]; None of a weather that was not drawn by one."""


@dataclass(frozen=True)
class WeatherPolicy:
    """How often which weather is drawn, and how severe.

    Convention:
        A draw is a pure function of (seed, epoch, item): no worker, order or earlier draw changes
        it. Types are weighted; a name with "+" (such as "rain+fog") is both at once. Of the default
        a quarter stays clear, because a network that sees weather on every sample forgets clear
        days. Severity has a triangular density over its range with its peak at moderate (0.5), or
        at the end of the range that is nearest to it. The wind blows from any side with equal
        chance. Of the draws of rain and snow a share `falling` falls; the others show what it
        leaves behind: wet or white ground under clouds, clear air and clean glass. What differs
        from day to day at equal severity (`VARIED`: how wet, puddled or white the road is, lamps,
        drops on the glass, ...) is multiplied by factors that are uniform in their ranges and do
        not know of each other.

    Raises:
        ArgumentError: If a type is unknown, a weight negative, or a range outside [0, 1].
    """

    types: Mapping[str, float] = field(
        default_factory=lambda: {"clear": 1.0, "rain": 1.0, "snow": 1.0, "fog": 1.0}
    )
    """Weight of each type; they need not sum to 1."""
    severity: tuple[float, float] = (0.1, 1.0)
    falling: float = 0.8
    variation: float = 1.0
    """How much of the factors' ranges is used: 0 gives each severity's own values, 1 all of it."""

    def __post_init__(self) -> None:
        if not isinstance(self.types, Mapping) or not self.types:
            raise ArgumentError("types must map at least one weather type to its weight")
        for name in self.types:
            unknown = [part for part in str(name).split("+") if part not in TYPES]
            if unknown:
                raise ArgumentError(
                    f"weather type {printable(unknown[0])!r} is not one of {', '.join(TYPES)}"
                )
        # Equal policies draw equally, in whatever order a file lists their types (YAML sorts them).
        names = sorted(
            self.types, key=lambda name: [TYPES.index(part) for part in str(name).split("+")]
        )
        types = {name: finite(f"weight of {name}", self.types[name], 0) for name in names}
        if not 0 < sum(types.values()) < math.inf:
            raise ArgumentError("the weights of types must sum to a finite number above 0")
        try:
            first, second = [self.severity] if isinstance(self.severity, str) else self.severity
        except (TypeError, ValueError):
            raise ArgumentError(
                "severity must be a range (low, high) in [0, 1], got "
                f"{printable(repr(self.severity))}"
            ) from None
        try:
            low, high = parse_severity(first), parse_severity(second)
        except ArgumentError as error:
            raise ArgumentError(
                f"severity must be a range (low, high) in [0, 1]: {error}"
            ) from None
        if low > high:
            raise ArgumentError(f"severity must be a range (low, high), got {self.severity}")
        object.__setattr__(self, "falling", finite("falling", self.falling, 0, 1))
        object.__setattr__(self, "variation", finite("variation", self.variation, 0, 1))
        object.__setattr__(self, "types", types)
        object.__setattr__(self, "severity", (low, high))

    @classmethod
    def rain(
        cls,
        mm_per_h: tuple[float, float] = (1.5, 75.0),
        *,
        falling: float = 1.0,
        variation: float = 1.0,
    ) -> WeatherPolicy:
        """Rain alone, of rates in a range in mm/h."""
        severity = _severities("mm_per_h", mm_per_h, rain_severity)
        return cls({"rain": 1.0}, severity, falling, variation)

    @classmethod
    def snow(
        cls,
        mm_per_h: tuple[float, float] = (0.4, 4.0),
        *,
        falling: float = 1.0,
        variation: float = 1.0,
    ) -> WeatherPolicy:
        """Snow alone, of rates in a range in mm/h of water."""
        severity = _severities("mm_per_h", mm_per_h, snow_severity)
        return cls({"snow": 1.0}, severity, falling, variation)

    @classmethod
    def fog(
        cls, visibility_m: tuple[float, float] = (50.0, 600.0), *, variation: float = 1.0
    ) -> WeatherPolicy:
        """Fog alone, of meteorological optical ranges in metres, given in either order."""
        severity = _severities("visibility_m", visibility_m, fog_severity)
        return cls({"fog": 1.0}, severity, variation=variation)

    def with_clear(self, share: float) -> WeatherPolicy:
        """The same weathers, with a share in [0, 1] of the draws left clear.

        Raises:
            ArgumentError: If the share is outside [0, 1], or below 1 and nothing else is drawn.
        """
        share = finite("share", share, 0, 1)
        others = {name: weight for name, weight in self.types.items() if name != "clear"}
        total = sum(others.values())
        if total == 0 and share < 1:
            raise ArgumentError("this policy draws clear weather alone; add types to it first")
        scaled = {name: (1 - share) * weight / total for name, weight in others.items() if total}
        return replace(self, types={"clear": share, **scaled})

    def draw(self, seed: int, epoch: int, item: int, *, which: float | None = None) -> WeatherDraw:
        """The weather of one item of one epoch.

        Args:
            seed: In [-2**63, 2**64), as are the next two.
            epoch: Of the training.
            item: Of the epoch.
            which: In [0, 1), decides the type in place of the key's own number, for whoever deals
                types out evenly; the rest of the draw stays what it is.
        """
        key = key_of("weather-draw", seed, epoch, item)
        own, how, falls, direction, particles = uniforms(key, 5)
        kind = self._kind(own if which is None else finite("which", which, 0, 1))
        severity = _triangular(float(how), *self.severity)
        falling = float(falls) < self.falling
        parts = [weather_of(part, severity, falling=falling) for part in kind.split("+")]
        weather = self._varied(reduce(Weather.mix, parts), key_of("weather-day", seed, epoch, item))
        speed = math.hypot(*weather.wind_m_per_s)
        angle = 2 * math.pi * float(direction)
        wind = (speed * math.cos(angle), speed * math.sin(angle), 0.0)
        return WeatherDraw(
            replace(weather, wind_m_per_s=wind), int(particles * 2**53), kind, severity
        )

    def _varied(self, weather: Weather, key: int) -> Weather:
        """The weather on one of the days of its severity."""
        changes = {}
        for uniform, (name, (least, greatest, most)) in zip(
            uniforms(key, len(VARIED)), VARIED.items(), strict=True
        ):
            factor = least + (greatest - least) * float(uniform)
            value = getattr(weather, name) * (1 + self.variation * (factor - 1))
            changes[name] = min(value, most)
        return replace(weather, **changes)

    def _kind(self, uniform: float) -> str:
        left = uniform * sum(self.types.values())
        for name, weight in self.types.items():
            left -= weight
            if left < 0:
                return name
        return next(name for name, weight in reversed([*self.types.items()]) if weight > 0)

    def to_dict(self) -> dict[str, Any]:
        """Fields as JSON values."""
        return {
            "types": dict(self.types),
            "severity": list(self.severity),
            "falling": self.falling,
            "variation": self.variation,
        }

    @classmethod
    def from_dict(cls, state: dict[str, Any]) -> WeatherPolicy:
        """The inverse of `to_dict`; unknown fields are refused."""
        if not isinstance(state, dict):
            raise ArgumentError(
                f"a WeatherPolicy is read from an object, got {type(state).__name__}"
            )
        unknown = sorted(set(state) - set(_FIELDS), key=str)
        if unknown:
            raise ArgumentError(
                f"WeatherPolicy has no field {printable(unknown[0])}; it has {', '.join(_FIELDS)}"
            )
        return cls(**state)


def _severities(
    name: str, values: tuple[float, float], severity_of: Callable[[float], float]
) -> tuple[float, float]:
    """A range of severities from one in a physical unit."""
    try:
        first, second = values
    except (TypeError, ValueError):
        raise ArgumentError(f"{name} must be a range (low, high), got {values!r}") from None
    low, high = sorted((severity_of(first), severity_of(second)))
    return low, high


def _triangular(uniform: float, low: float, high: float) -> float:
    """The number below which a share `uniform` of the triangular law with its peak at moderate is.

    The inverse of the law's distribution on [low, high].
    """
    if low == high:
        return low
    width, peak = high - low, min(max(COMMONEST_SEVERITY, low), high)
    if uniform * width < peak - low:
        return low + math.sqrt(uniform * width * (peak - low))
    return high - math.sqrt((1 - uniform) * width * (high - peak))


def weather_of(kind: str, severity: float | str, *, falling: bool = True) -> Weather:
    """The Weather of a type's name and a severity.

    Raises:
        ArgumentError: If the type or the severity is unknown.
    """
    if kind == "clear":
        return Weather.clear()
    if kind == "rain":
        return Weather.rain(severity, falling=falling)
    if kind == "snow":
        return Weather.snow(severity, falling=falling)
    if kind == "fog":
        return Weather.fog(severity)
    raise ArgumentError(f"weather type {printable(kind)!r} is not one of {', '.join(TYPES)}")
