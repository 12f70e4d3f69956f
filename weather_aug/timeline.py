"""WeatherTimeline: weather that changes with time, and the air it has moved meanwhile.

Convention:
    A timeline is a value: knots (time, Weather), constant before the first and after the last,
    `Weather.blend` between two. Any time can be asked for alone and in any order.

    No particle jumps while the weather changes, because

    1. a particle's place depends on the time (its fall in still air when dry), on `Air.drift_m` and
       on `Air.wet_s` (how much faster it fell when wet), on the seed, and, by centimetres around
       that place, on how strongly the wind of the moment lets drops sway. The first two are
       integrals since time 0, so they are continuous, and their slopes are the wind and wetness of
       the moment: streaks point where particles go. Wind now times time is no drift: when the wind
       changes by 1 m/s at 100 s, all the air would leap 100 m;
    2. particles are thinned, never drawn again: whether one is there depends on its own fixed draw
       against the rate, and its size, its speeds when dry and when wet, and its phase of swaying do
       not depend on the weather. So a rate that changes adds or removes particles, moves none;
    3. snow wetness and fog shape may differ on the two sides of a knot without snow or fog (each
       blend holds the value of the side that has it). Nothing of it is in the air then.

    A renderer keeps its part by placing particles from `air` and never from the wind; its caller by
    keeping the seed along the timeline.
"""

from __future__ import annotations

import json
import math
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from weather_aug.air import Air, air_of, checked_time, gust, gust_moments_s
from weather_aug.errors import ArgumentError, printable
from weather_aug.weather import Weather, shape_ends

Knot = tuple[float, Weather]


@dataclass(frozen=True)
class WeatherTimeline:
    """Weather as a function of time; see the module's Convention.

    Example:
        >>> shower = WeatherTimeline(((0, Weather.clear()), (20, Weather.rain("heavy"))))
        >>> shower.at(10).rain_mm_per_h
        10.0

    Raises:
        ArgumentError: If there is no knot, a time is not finite or not after the one before, or a
            knot holds no Weather.
    """

    knots: tuple[Knot, ...]
    """(time in seconds since the clip's start, weather), times rising and in [-1e10, 1e10]."""

    def __post_init__(self) -> None:
        try:
            knots = tuple(_knot(i, knot) for i, knot in enumerate(self.knots))
        except TypeError:
            raise ArgumentError(
                f"knots must be pairs (time_s, Weather), got {type(self.knots).__name__}"
            ) from None
        if not knots:
            raise ArgumentError("knots must hold at least one pair (time_s, Weather)")
        for i, ((before_s, _), (time_s, _)) in enumerate(pairwise(knots), 1):
            if not before_s < time_s:
                raise ArgumentError(
                    f"knots[{i}] is at {time_s!r} s, not after the one before at {before_s!r} s; "
                    "sort them by time and drop repeated times"
                )
        object.__setattr__(self, "knots", knots)

    @classmethod
    def transition(cls, a: Weather, b: Weather, start_s: float, end_s: float) -> WeatherTimeline:
        """`a` until `start_s`, `b` from `end_s`, a blend between.

        Raises:
            ArgumentError: If the end is not after the start.
        """
        start_s, end_s = checked_time("start_s", start_s), checked_time("end_s", end_s)
        if not start_s < end_s:
            raise ArgumentError(f"end_s must be after start_s = {start_s!r}, got {end_s!r}")
        return cls(((start_s, a), (end_s, b)))

    def at(self, time_s: float) -> Weather:
        """The weather at `time_s`.

        Raises:
            ArgumentError: If the time is not finite or beyond 1e10 s.
        """
        time_s = checked_time("time_s", time_s)
        after = bisect_right(self.knots, time_s, key=lambda knot: knot[0])
        if after == 0:
            return self.knots[0][1]
        start_s, start = self.knots[after - 1]
        if after == len(self.knots):
            return start
        end_s, end = self.knots[after]
        return Weather.blend(start, end, (time_s - start_s) / (end_s - start_s))

    def air(self, time_s: float, seed: int) -> Air:
        """The air at `time_s`: wind of the moment, drift and wetness gathered since time 0.

        Args:
            time_s: Seconds since the clip's start, in [-1e10, 1e10].
            seed: Which gusts blow.

        Raises:
            ArgumentError: If the time is not finite or no seconds, or the seed is no integer.

        Source:
            Between knots wind and gustiness are linear in time, so the drift is the integral of a
            quadratic times sines; by parts, see `weather_aug.air`.
        """
        time_s = checked_time("time_s", time_s)
        if len(self.knots) == 1:
            return air_of(self.knots[0][1], time_s, seed)
        weather = self.at(time_s)
        now = 1.0 + weather.gustiness * gust(time_s, seed)
        along, left, up = weather.wind_m_per_s
        low_s, high_s = sorted((0.0, time_s))
        parts = [stretch.gathered(seed) for stretch in self._stretches(low_s, high_s)]
        sign = math.copysign(1.0, time_s)
        drift_along, drift_left, drift_up, wet_s = (
            sign * math.fsum(part[i] for part in parts) for i in range(4)
        )
        return Air((along * now, left * now, up * now), (drift_along, drift_left, drift_up), wet_s)

    def to_dict(self) -> dict[str, Any]:
        """Knots as JSON values."""
        return {"knots": [{"time_s": t, "weather": w.to_dict()} for t, w in self.knots]}

    @classmethod
    def from_dict(cls, state: dict[str, Any]) -> WeatherTimeline:
        """The inverse of `to_dict`; unknown fields are refused.

        Raises:
            ArgumentError: If it is not {"knots": [{"time_s": …, "weather": {…}}, …]}.
        """
        (knots,) = _fields("a WeatherTimeline", state, ("knots",))
        if not isinstance(knots, list | tuple):
            raise ArgumentError(f"knots must be a list, got {type(knots).__name__}")
        return cls(tuple(_knot_from_dict(i, knot) for i, knot in enumerate(knots)))

    def to_json(self) -> str:
        """One line of JSON that `from_json` reads back to an equal WeatherTimeline."""
        return json.dumps(self.to_dict(), allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> WeatherTimeline:
        """Read what `to_json` wrote.

        Raises:
            ArgumentError: If the text is not a JSON object of a timeline.
        """
        try:
            state = json.loads(text)
        except (TypeError, ValueError, RecursionError) as error:
            raise ArgumentError(f"not a WeatherTimeline in JSON: {printable(error)}") from None
        return cls.from_dict(state)

    def _stretches(self, low_s: float, high_s: float) -> Iterator[_Stretch]:
        """What lies between two times, cut at the knots."""
        (first_s, first), (last_s, last) = self.knots[0], self.knots[-1]
        if low_s < first_s:
            yield _stretch((low_s, first), (first_s, first), low_s, min(high_s, first_s))
        for before, after in pairwise(self.knots):
            start_s, end_s = max(low_s, before[0]), min(high_s, after[0])
            if start_s < end_s:
                yield _stretch(before, after, start_s, end_s)
        if high_s > last_s:
            yield _stretch((last_s, last), (high_s, last), max(low_s, last_s), high_s)


@dataclass(frozen=True)
class _Stretch:
    """A span of time over which wind, gustiness and snow wetness run linearly."""

    start_s: float
    end_s: float
    winds: tuple[tuple[float, float], ...]
    """(start, end) of each of the three components, m/s."""
    gustiness: tuple[float, float]
    wetness: tuple[float, float]

    def gathered(self, seed: int) -> tuple[float, float, float, float]:
        """Drift (along, left, up) in metres and wetness in seconds over the span."""
        span_s = self.end_s - self.start_s
        plain, rising, bending = gust_moments_s(self.start_s, self.end_s, seed)
        g, more_g = self.gustiness[0], self.gustiness[1] - self.gustiness[0]
        along, left, up = (
            0.5 * (w + end) * span_s
            + w * g * plain
            + (w * more_g + (end - w) * g) * rising
            + (end - w) * more_g * bending
            for w, end in self.winds
        )
        return along, left, up, 0.5 * (self.wetness[0] + self.wetness[1]) * span_s


def _stretch(before: Knot, after: Knot, start_s: float, end_s: float) -> _Stretch:
    """The part from `start_s` to `end_s` of the way between two knots."""
    (before_s, a), (after_s, b) = before, after

    def cut(start: float, end: float) -> tuple[float, float]:
        slope = end - start
        whole_s = after_s - before_s
        return (
            start + slope * ((start_s - before_s) / whole_s),
            start + slope * ((end_s - before_s) / whole_s),
        )

    return _Stretch(
        start_s,
        end_s,
        tuple(cut(x, y) for x, y in zip(a.wind_m_per_s, b.wind_m_per_s, strict=True)),
        cut(a.gustiness, b.gustiness),
        cut(*shape_ends(a, b, "snow_wetness")),
    )


def _knot(i: int, knot: Any) -> Knot:
    """A checked knot, or an error that names the `i`-th."""
    try:
        time_s, weather = knot
    except (TypeError, ValueError):
        raise ArgumentError(
            f"knots[{i}] must be a pair (time_s, Weather), got {type(knot).__name__}"
        ) from None
    if not isinstance(weather, Weather):
        raise ArgumentError(
            f"knots[{i}] must be a pair (time_s, Weather), got {type(weather).__name__} for the "
            "Weather"
        )
    return checked_time(f"time_s of knots[{i}]", time_s), weather


def _knot_from_dict(i: int, state: Any) -> Knot:
    time_s, weather = _fields(f"knots[{i}]", state, ("time_s", "weather"))
    try:
        return time_s, Weather.from_dict(weather)
    except ArgumentError as error:
        raise ArgumentError(f"weather of knots[{i}]: {error}") from None


def _fields(what: str, state: Any, names: tuple[str, ...]) -> list[Any]:
    """Values of exactly these fields of an object, or an error that says which is amiss."""
    if not isinstance(state, dict):
        raise ArgumentError(f"{what} is read from an object, got {type(state).__name__}")
    for unknown in sorted(set(state) - set(names), key=str):
        raise ArgumentError(
            f"{what} has no field {printable(unknown)}; its fields are {', '.join(names)}"
        )
    for missing in (name for name in names if name not in state):
        raise ArgumentError(f"{what} lacks {missing}; its fields are {', '.join(names)}")
    return [state[name] for name in names]
