"""Weather: the physical state of the air and the ground, and one severity scale for all of it."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from weather_aug._checks import finite, real
from weather_aug.errors import ArgumentError, printable

CONTRAST_THRESHOLD = 0.05
"""Contrast left at the meteorological optical range (World Meteorological Organization)."""

NAMED_SEVERITIES = {"light": 0.25, "moderate": 0.5, "heavy": 0.75, "extreme": 1.0}

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
        is not part of it: light 0.25, moderate 0.5, heavy 0.75, extreme 1; between the stops all
        quantities are log-linear in s, below light they fall to 0 with s squared (fog extinction:
        with s), so that s = 0 is clear. A Weather is a state at one moment and knows no time: how
        its gusts blow and how far they carry the air is `weather_aug.air`, how weather changes is
        `WeatherTimeline`. Gustiness, snow wetness, fog patchiness and fog puffs only shape the
        wind, snow and fog that are there; without those they mean nothing.

    Raises:
        ArgumentError: If a field is outside its range.

    Source:
        Rates inside the classes of the American Meteorological Society and the Met Office;
        fog stops at the three levels of Foggy Cityscapes; see docs/physics.md.
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
    """Of the ground, in [0, 1]. Part of the state and of labels' recipes; not drawn yet."""
    snow_cover: float = 0.0
    """Of the ground beside the road, in [0, 1]; not drawn yet."""
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
        s = _severity(severity, "mm_per_h", mm_per_h, rain_severity)
        state = {
            "rain_mm_per_h": _RAIN.at(s) if mm_per_h is None else mm_per_h,
            "mist_per_km": _RAIN_MIST.at(s),
            "wetness": _WETNESS.at(s),
            "overcast": _RAIN_OVERCAST.at(s),
            "wind_m_per_s": (0.0, _RAIN_WIND.at(s), 0.0),
            "gustiness": _RAIN_GUSTINESS.at(s),
            "spray_per_km": _RAIN_SPRAY.at(s),
        }
        if not falling:
            state |= {"rain_mm_per_h": 0.0, "mist_per_km": 0.0, "spray_per_km": 0.0}
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
        s = _severity(severity, "mm_per_h", mm_per_h, snow_severity)
        state = {
            "snow_mm_per_h": _SNOW.at(s) if mm_per_h is None else mm_per_h,
            "mist_per_km": _BLOWING_SNOW.at(s),
            "snow_cover": _SNOW_COVER.at(s),
            "overcast": _SNOW_OVERCAST.at(s),
            "wind_m_per_s": (0.0, _SNOW_WIND.at(s), 0.0),
            "gustiness": _SNOW_GUSTINESS.at(s),
        }
        if not falling:
            state |= {"snow_mm_per_h": 0.0, "mist_per_km": 0.0}
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
        s = _severity(severity, "visibility_m", visibility_m, fog_severity)
        inverse_height = _fog_inverse_height(s)
        state = {
            "visibility_m": visibility_from_severity(s) if visibility_m is None else visibility_m,
            "fog_scale_height_m": 1.0 / inverse_height if inverse_height else math.inf,
            "overcast": _FOG_OVERCAST.at(s),
            "wind_m_per_s": (0.0, _FOG_WIND.at(s), 0.0),
        }
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
            wetness=1 - (1 - a.wetness) * (1 - b.wetness),
            snow_cover=1 - (1 - a.snow_cover) * (1 - b.snow_cover),
            overcast=max(a.overcast, b.overcast),
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
    "rain_mm_per_h": (0.0, 400.0),
    "snow_mm_per_h": (0.0, 50.0),
    "visibility_m": (1.0, math.inf),
    "fog_scale_height_m": (1.0, math.inf),
    "mist_per_km": (0.0, 100.0),
    "wetness": (0.0, 1.0),
    "snow_cover": (0.0, 1.0),
    "overcast": (0.0, 1.0),
    "gustiness": (0.0, 1.0),
    "snow_wetness": (0.0, 1.0),
    "fog_patchiness": (0.0, 1.0),
    "fog_puffs": (0.0, 0.5),
    "spray_per_km": (0.0, 200.0),
}
_STRONGEST_WIND_M_PER_S = 60.0
_SHAPED_THING = {
    "snow_wetness": "snow_mm_per_h",
    "fog_patchiness": "fog_per_m",
    "fog_puffs": "fog_per_m",
}
"""Fields that only shape something else, and what says how much of that there is."""
_UNSEEN_ALONE = {"wind_m_per_s", "gustiness", "fog_scale_height_m", *_SHAPED_THING}


@dataclass(frozen=True)
class _Stops:
    """A quantity at light, moderate, heavy and extreme, and the power it falls with below light."""

    values: tuple[float, float, float, float]
    power_below: int = 2

    def at(self, s: float) -> float:
        if s <= 0.25:
            return self.values[0] * (4 * s) ** self.power_below
        lower = min(int(4 * s) - 1, 2)
        a, b = self.values[lower], self.values[lower + 1]
        return a * (b / a) ** (4 * s - 1 - lower)

    def severity_of(self, value: float) -> float:
        """The inverse of `at`, cut at 1; needs strictly rising stops."""
        if value <= self.values[0]:
            return 0.25 * (value / self.values[0]) ** (1 / self.power_below)
        for lower in range(3):
            a, b = self.values[lower], self.values[lower + 1]
            if value <= b:
                return (1 + lower + math.log(value / a) / math.log(b / a)) / 4
        return 1.0


_RAIN = _Stops((1.5, 5.0, 20.0, 75.0))
_RAIN_MIST = _Stops((0.2, 0.6, 2.0, 5.0))
_WETNESS = _Stops((0.5, 0.8, 1.0, 1.0))
_RAIN_OVERCAST = _Stops((0.6, 0.8, 1.0, 1.0))
_RAIN_WIND = _Stops((1.5, 3.0, 6.0, 10.0))
_RAIN_GUSTINESS = _Stops((0.3, 0.3, 0.3, 0.3))
_RAIN_SPRAY = _Stops((0.5, 2.0, 10.0, 25.0))
_SNOW = _Stops((0.4, 1.0, 2.0, 4.0))
_BLOWING_SNOW = _Stops((0.3, 0.8, 2.0, 5.0))
_SNOW_COVER = _Stops((0.25, 0.6, 0.9, 1.0))
_SNOW_OVERCAST = _Stops((0.6, 0.8, 1.0, 1.0))
_SNOW_WIND = _Stops((0.5, 1.0, 2.0, 4.0))
_SNOW_GUSTINESS = _Stops((0.25, 0.25, 0.25, 0.25))
_FOG = _Stops((0.005, 0.01, 0.02, 0.06), power_below=1)
_FOG_OVERCAST = _Stops((0.6, 0.8, 1.0, 1.0))
_FOG_WIND = _Stops((0.5, 0.5, 0.5, 0.5))
_FOG_INVERSE_HEIGHT = (0.0, 0.0, 1 / 60, 1 / 25)


def rain_severity(mm_per_h: float) -> float:
    """Severity in [0, 1] of a rain rate; the inverse of `Weather.rain` up to extreme."""
    return _RAIN.severity_of(finite("mm_per_h", mm_per_h, *_RANGES["rain_mm_per_h"]))


def snow_severity(mm_per_h: float) -> float:
    """Severity in [0, 1] of a liquid-equivalent snow rate."""
    return _SNOW.severity_of(finite("mm_per_h", mm_per_h, *_RANGES["snow_mm_per_h"]))


def fog_severity(visibility_m: float) -> float:
    """Severity in [0, 1] of a meteorological optical range in metres."""
    visibility_m = real("visibility_m", visibility_m)
    if visibility_m < _RANGES["visibility_m"][0]:
        raise ArgumentError(f"visibility_m must be at least 1 m, got {visibility_m!r}")
    return _FOG.severity_of(-math.log(CONTRAST_THRESHOLD) / visibility_m)


def visibility_from_severity(s: float) -> float:
    """Meteorological optical range in metres of a fog severity in [0, 1]."""
    beta_per_m = _FOG.at(s)
    return -math.log(CONTRAST_THRESHOLD) / beta_per_m if beta_per_m else math.inf


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


def parse_severity(severity: float | str) -> float:
    """A severity in [0, 1] from a number or one of its names.

    Raises:
        ArgumentError: If it is neither.
    """
    if isinstance(severity, str):
        if severity not in NAMED_SEVERITIES:
            raise ArgumentError(
                f"severity {printable(severity)!r} is not one of {', '.join(NAMED_SEVERITIES)}, "
                "nor a number in [0, 1]"
            )
        return NAMED_SEVERITIES[severity]
    return finite("severity", severity, 0, 1)


def _severity(severity: float | str | None, unit: str, value: float | None, inverse: Any) -> float:
    if (severity is None) == (value is None):
        raise ArgumentError(f"give either a severity or {unit}")
    if severity is None:
        return float(inverse(value))
    try:
        return parse_severity(severity)
    except ArgumentError as error:
        raise ArgumentError(f"{error}; for a value in its unit write {unit}=...") from None


def _fog_inverse_height(s: float) -> float:
    """1/m; linear between the stops, because it is 0 at the light ones."""
    position = max(4 * s - 1, 0.0)
    lower = min(int(position), 2)
    a, b = _FOG_INVERSE_HEIGHT[lower], _FOG_INVERSE_HEIGHT[lower + 1]
    return a + (b - a) * (position - lower)


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
