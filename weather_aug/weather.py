"""Weather: the physical state of the air and the ground, and one severity scale for all of it."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from weather_aug import severity as stops
from weather_aug._checks import finite, real
from weather_aug.errors import ArgumentError, printable
from weather_aug.severity import CONTRAST_THRESHOLD, severity_from

Wind = tuple[float, float, float]


@dataclass(frozen=True)
class Weather:
    """The physical state of air and ground; the default is clear air over a dry road.

    Build one with `rain`, `snow`, `fog` or `clear`; every field can be overridden in its unit.

    Convention:
        A Weather is a value: frozen, hashable, comparable, and the same in every clip. What falls
        and what lies on the ground are separate fields: a wet road without rain is a Weather, and
        so is snowfall over a clear road. Wind is given along the street, not in world axes: (along
        the clip's first heading, to its left, up). Severity s in [0, 1] names a physical state, it
        is not part of it; see `weather_aug.severity`. A Weather is a state at one moment and knows
        no time: how its gusts blow and how far they carry the air is `weather_aug.air`, how weather
        changes is `WeatherTimeline`. Gustiness, snow wetness, patchiness and puffs only shape the
        wind, snow and fog that are there; without those they mean nothing.

    Raises:
        ArgumentError: If a field is outside its range.

    Source:
        docs/physics.md.
    """

    rain_mm_per_h: float = 0.0
    """Rain rate, in [0, 400]."""
    snow_mm_per_h: float = 0.0
    """Snowfall as liquid water, in [0, 50]."""
    visibility_m: float = math.inf
    """Meteorological optical range in the fog at camera height, in [1, inf]; inf is no fog."""
    fog_scale_height_m: float = math.inf
    """Height over which the fog thins by a factor e, in [1, inf]; inf is fog without a top."""
    mist_per_km: float = 0.0
    """Extinction of what comes with precipitation (mist, blowing snow), in [0, 100] per km."""
    wetness: float = 0.0
    """Of the ground and the walls, from dry (0) to a closed film of water (1)."""
    puddles: float = 0.0
    """Share of the road under standing water, in [0, 1]."""
    snow_cover: float = 0.0
    """Share of the ground beside the road that snow covers, in [0, 1]."""
    road_snow_cover: float = 0.0
    """Share of the road that snow covers, in [0, 1]."""
    snow_depth_m: float = 0.0
    """Of the snow on the ground, in [0, 2]; deep snow buries kerbs."""
    overcast: float = 0.0
    """From the recorded sky (0) to a closed cloud deck (1)."""
    wind_m_per_s: Wind = (0.0, 0.0, 0.0)
    """Mean wind (along the first heading, to its left, up), each in [-60, 60]."""
    gustiness: float = 0.0
    """Root mean square of the gusts as a share of the mean wind, in [0, 1]."""
    snow_wetness: float = 0.0
    """Of the falling flakes, from dry (0) to melting (1); wet flakes fall faster, sway less."""
    fog_patchiness: float = 0.0
    """How uneven the fog is, in [0, 1]: kappa of a log-normal fractal noise of mean 1."""
    fog_puffs: float = 0.0
    """Share of the fog's extinction that drifting Gaussian puffs carry, in [0, 0.5]."""
    spray_per_km: float = 0.0
    """Extinction of spray at the road, in [0, 200] per km; thins with a scale height of 0.5 m."""
    lamps: float = 0.0
    """Share of the vehicles that drive with lamps on, in [0, 1]."""
    lens_drops: float = 0.0
    """Mean number of drops on the glass before a camera, in a whole picture, in [0, 500]."""
    wipers: float = 0.0
    """Share of the drives in which the wipers run, in [0, 1]."""

    def __post_init__(self) -> None:
        for name, (low, high) in _RANGES.items():
            value = real(name, getattr(self, name))
            if not low <= value <= high:
                raise ArgumentError(f"{name} must be in [{low:g}, {high:g}], got {value!r}")
            object.__setattr__(self, name, value)
        wind = along_left_up("wind_m_per_s", self.wind_m_per_s, _STRONGEST_WIND_M_PER_S)
        object.__setattr__(self, "wind_m_per_s", wind)

    @classmethod
    def clear(cls) -> Weather:
        """Clear air over a dry road: rendering it gives the recorded picture back, bit by bit."""
        return cls()

    @classmethod
    def rain(
        cls,
        severity: float | str | None = None,
        *,
        mm_per_h: float | None = None,
        falling: bool = True,
        **overrides: Any,
    ) -> Weather:
        """Rain, with the mist, spray, wetness, overcast sky and gusty wind that come with it.

        Args:
            severity: In [0, 1] or a name (light, moderate, heavy, extreme).
            mm_per_h: The rate instead of a severity; what comes with it follows the rate.
            falling: False for the time after: wet ground and overcast sky, nothing in the air.
            **overrides: Fields of Weather in their units.
        """
        s = severity_from(severity, "mm_per_h", mm_per_h, stops.rain_severity)
        state = _state(stops.RAIN, s, stops.RAIN_WIND_M_PER_S, falling)
        if falling and mm_per_h is not None:
            state["rain_mm_per_h"] = mm_per_h
        return _build(cls, state, overrides)

    @classmethod
    def snow(
        cls,
        severity: float | str | None = None,
        *,
        mm_per_h: float | None = None,
        falling: bool = True,
        **overrides: Any,
    ) -> Weather:
        """Dry snowfall, with the blowing snow, ground cover, clouds and gusty wind of its rate.

        Args:
            severity: In [0, 1] or a name (light, moderate, heavy, extreme).
            mm_per_h: The liquid-equivalent rate instead of a severity.
            falling: False for the time after: snow on the ground and overcast sky, clear air.
            **overrides: Fields of Weather in their units.
        """
        s = severity_from(severity, "mm_per_h", mm_per_h, stops.snow_severity)
        state = _state(stops.SNOW, s, stops.SNOW_WIND_M_PER_S, falling)
        if falling and mm_per_h is not None:
            state["snow_mm_per_h"] = mm_per_h
        return _build(cls, state, overrides)

    @classmethod
    def fog(
        cls,
        severity: float | str | None = None,
        *,
        visibility_m: float | None = None,
        **overrides: Any,
    ) -> Weather:
        """Fog of a meteorological optical range, under the sky that comes with it.

        Args:
            severity: In [0, 1] or a name (light, moderate, heavy, extreme).
            visibility_m: Distance at which contrast falls to 5 %, metres, instead of a severity.
            **overrides: Fields of Weather in their units.
        """
        s = severity_from(severity, "visibility_m", visibility_m, stops.fog_severity)
        state = _state(stops.FOG, s, stops.FOG_WIND_M_PER_S, True)
        state["visibility_m"] = (
            stops.visibility_from_severity(s) if visibility_m is None else visibility_m
        )
        state["fog_scale_height_m"] = stops.fog_scale_height_m(s)
        return _build(cls, state, overrides)

    @staticmethod
    def blend(a: Weather, b: Weather, t: float) -> Weather:
        """The transition from `a` (t = 0) to `b` (t = 1); rates and extinctions run linearly.

        What shapes the snow or the fog (its wetness, patchiness, puffs) runs linearly too where
        both sides have it; where only one has, it holds for the whole blend, so that snow that
        fades does not turn wet or dry on the way.
        """
        t = finite("t", t, 0, 1)
        if t in (0.0, 1.0) or a == b:
            return b if t == 1.0 else a
        shapes: dict[str, Any] = {}
        for name in _SHAPED_THING:
            start, end = shape_ends(a, b, name)
            # The sum may leave its ends by a rounding.
            shapes[name] = min(max(start + t * (end - start), min(start, end)), max(start, end))
        return replace(_combine(a, b, 1.0 - t, t), **shapes)

    @staticmethod
    def mix(a: Weather, b: Weather) -> Weather:
        """Both at once: rates and extinctions add, the stronger wind blows with its gusts.

        Snow wetness is the mean weighted by snow rate; fog patchiness and puffs by extinction.
        """
        # Of two equally strong winds the order must not decide.
        windier = max(a, b, key=lambda w: (_speed(w), w.wind_m_per_s, w.gustiness))
        return replace(
            _combine(a, b, 1.0, 1.0),
            **{name: _either(getattr(a, name), getattr(b, name)) for name in _SHARES},
            **{name: max(getattr(a, name), getattr(b, name)) for name in _SHARED_CAUSES},
            wind_m_per_s=windier.wind_m_per_s,
            gustiness=windier.gustiness,
            **{name: _mixed_shape(a, b, name) for name in _SHAPED_THING},
        )

    @property
    def fog_per_m(self) -> float:
        """Extinction of the fog at camera height, 1/m; -ln(0.05) over the visibility."""
        return -math.log(CONTRAST_THRESHOLD) / self.visibility_m

    @property
    def is_clear(self) -> bool:
        """Whether nothing of this weather can be seen (wind, or a shape without its thing)."""
        seen = (f for f in fields(self) if f.name not in _UNSEEN_ALONE)
        return all(getattr(self, f.name) == f.default for f in seen)

    def to_dict(self) -> dict[str, Any]:
        """Fields as JSON values; infinity is None."""
        state = asdict(self) | {"wind_m_per_s": list(self.wind_m_per_s)}
        return {k: None if v == math.inf else v for k, v in state.items()}

    @classmethod
    def from_dict(cls, state: dict[str, Any]) -> Weather:
        """The inverse of `to_dict`; missing fields have defaults, unknown ones are refused."""
        if not isinstance(state, dict):
            raise ArgumentError(f"a Weather is read from an object, got {type(state).__name__}")
        values = {
            k: math.inf if v is None and k in ("visibility_m", "fog_scale_height_m") else v
            for k, v in state.items()
        }
        return _build(cls, {}, values)

    def to_json(self) -> str:
        """One line of JSON that `from_json` reads back to an equal Weather."""
        return json.dumps(self.to_dict(), allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> Weather:
        """Read what `to_json` wrote.

        Raises:
            ArgumentError: If the text is not a JSON object of Weather's fields.
        """
        try:
            state = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise ArgumentError(f"not a Weather in JSON: {printable(error)}") from None
        return cls.from_dict(state)


_RANGES = {
    "rain_mm_per_h": (0.0, stops.MOST_RAIN_MM_PER_H),
    "snow_mm_per_h": (0.0, stops.MOST_SNOW_MM_PER_H),
    "visibility_m": (stops.LEAST_VISIBILITY_M, math.inf),
    "fog_scale_height_m": (1.0, math.inf),
    "mist_per_km": (0.0, 100.0),
    "wetness": (0.0, 1.0),
    "puddles": (0.0, 1.0),
    "snow_cover": (0.0, 1.0),
    "road_snow_cover": (0.0, 1.0),
    "snow_depth_m": (0.0, 2.0),
    "overcast": (0.0, 1.0),
    "gustiness": (0.0, 1.0),
    "snow_wetness": (0.0, 1.0),
    "fog_patchiness": (0.0, 1.0),
    "fog_puffs": (0.0, 0.5),
    "spray_per_km": (0.0, 200.0),
    "lamps": (0.0, 1.0),
    "lens_drops": (0.0, 500.0),
    "wipers": (0.0, 1.0),
}
_STRONGEST_WIND_M_PER_S = 60.0
_SHAPED_THING = {
    "snow_wetness": "snow_mm_per_h",
    "fog_patchiness": "fog_per_m",
    "fog_puffs": "fog_per_m",
}
"""Fields that only shape something else, and what says how much of that there is."""
_SHARES = ("wetness", "puddles", "snow_cover", "road_snow_cover")
"""Of two weathers at once these are what either leaves, as if independent."""
_SHARED_CAUSES = ("overcast", "snow_depth_m", "lamps", "wipers")
"""Of these it is the larger: one sky, one reason to switch on lamps."""
_UNSEEN_ALONE = {"wind_m_per_s", "gustiness", "fog_scale_height_m", *_SHAPED_THING}


def along_left_up(name: str, vector: Wind, most: float = math.inf) -> Wind:
    """Return `vector` as three finite floats in [-most, most], or refuse it by `name`."""
    try:
        along, left, up = vector
    except (TypeError, ValueError):
        raise ArgumentError(f"{name} must be three numbers (along, left, up)") from None
    return (
        finite(name, along, -most, most),
        finite(name, left, -most, most),
        finite(name, up, -most, most),
    )


def shape_ends(a: Weather, b: Weather, name: str) -> tuple[float, float]:
    """Values just after `a` and just before `b` of a field that shapes their snow or fog.

    Between the two, `Weather.blend` runs linearly. Where only one side has what the field shapes,
    its value stands at both ends.
    """
    start, end = getattr(a, name), getattr(b, name)
    has_a, has_b = (getattr(w, _SHAPED_THING[name]) > 0 for w in (a, b))
    if has_a == has_b:
        return start, end
    return (start, start) if has_a else (end, end)


def _state(
    table: dict[str, stops.Stops], s: float, wind_m_per_s: stops.Stops, falling: bool
) -> dict[str, Any]:
    """Fields of a Weather at severity `s`; without what ends when it stops falling, if so."""
    state: dict[str, Any] = {
        name: stop.at(s) for name, stop in table.items() if falling or name not in stops.FALLING
    }
    return state | {"wind_m_per_s": (0.0, wind_m_per_s.at(s), 0.0)}


def _either(a: float, b: float) -> float:
    return 1 - (1 - a) * (1 - b)


def _build(cls: type[Weather], state: dict[str, Any], overrides: dict[str, Any]) -> Weather:
    known = {f.name for f in fields(cls)}
    unknown = sorted(set(overrides) - known, key=str)
    if unknown:
        raise ArgumentError(
            f"Weather has no field {printable(unknown[0])}; its fields are "
            f"{', '.join(f.name for f in fields(cls))}"
        )
    return cls(**(state | overrides))


def _speed(weather: Weather) -> float:
    return math.hypot(*weather.wind_m_per_s)


def _mixed_shape(a: Weather, b: Weather, name: str) -> float:
    """Mean of a shaping field, weighted by how much of its thing there is; the larger if none."""
    values = [getattr(w, name) for w in (a, b)]
    amounts = [getattr(w, _SHAPED_THING[name]) for w in (a, b)]
    total = sum(amounts)
    if not total:
        return max(values)
    mean = sum(value * (amount / total) for value, amount in zip(values, amounts, strict=True))
    return min(max(mean, min(values)), max(values))


def _combine(a: Weather, b: Weather, share_a: float, share_b: float) -> Weather:
    """Add the two states field by field, each times its share; fog adds as extinction.

    Fog of different heights becomes one layer whose inverse scale height is the mean of the two,
    weighted by their extinctions.
    """
    state: dict[str, Any] = {
        name: min(max(share_a * getattr(a, name) + share_b * getattr(b, name), low), high)
        for name, (low, high) in _RANGES.items()
        if high < math.inf
    }
    state["wind_m_per_s"] = tuple(
        min(max(share_a * x + share_b * y, -_STRONGEST_WIND_M_PER_S), _STRONGEST_WIND_M_PER_S)
        for x, y in zip(a.wind_m_per_s, b.wind_m_per_s, strict=True)
    )
    fog_a, fog_b = share_a / a.visibility_m, share_b / b.visibility_m
    fog = fog_a + fog_b
    # Without any fog the heights weigh alike; they say something only once fog is added.
    part_a, part_b = (fog_a / fog, fog_b / fog) if fog else (share_a, share_b)
    thinning = part_a / a.fog_scale_height_m + part_b / b.fog_scale_height_m
    state["visibility_m"] = max(1 / fog, _RANGES["visibility_m"][0]) if fog else math.inf
    lowest = _RANGES["fog_scale_height_m"][0]
    state["fog_scale_height_m"] = max(1 / thinning, lowest) if thinning else math.inf
    return Weather(**state)
