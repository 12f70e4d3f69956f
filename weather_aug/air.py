"""How the air of a weather moves: its wind now, and how far it has carried since time 0.

Convention:
    Gusts are one number a moment, common to the whole street: a profile of mean 0 and root mean
    square 1 that the weather's gustiness scales and its mean wind points. The profile is a sum of
    sines, so its integral has a closed form: how far the air has drifted at any time is known
    without stepping through the times before. Profile and drift depend on the seed and the time
    since 0 alone. Vectors are along the street, to its left, up.

    Times are float64. At 1e9 s a time is known to 1e-7 s, a gust to 1e-7 of its size and the drift
    in a wind of 10 m/s to a few micrometres; a clip that counts from its start loses nothing.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass
from functools import lru_cache

from weather_aug._checks import finite
from weather_aug._keys import check_seed, key_of, uniforms
from weather_aug.weather import Weather, Wind, along_left_up

LONGEST_TIME_S = 1e10
"""Times beyond it are no seconds (nor would their drift be known to a millimetre)."""

_RAD_PER_S = tuple(2 * math.pi / (6.0 * math.sqrt(n)) for n in (1, 5, 14))
"""Periods of 6, 13.4 and 22.4 s: roots of different square-free numbers, so no sum of the sines
repeats and none is a combination tone of the others."""
_AMPLITUDE = math.sqrt(2 / len(_RAD_PER_S))
"""Of each sine; a sine's mean square is half its amplitude squared."""


@dataclass(frozen=True)
class Air:
    """Motion of the air at one moment; vectors are (along the street, to its left, up).

    Raises:
        ArgumentError: If a number is not finite, or a vector has not three of them.
    """

    wind_m_per_s: Wind
    """Wind at this moment, gusts included."""
    drift_m: Wind
    """How far the wind has carried the air since time 0."""
    wet_s: float = 0.0
    """Integral of the snow's wetness since time 0, seconds: wet flakes fall faster."""

    def __post_init__(self) -> None:
        for name in ("wind_m_per_s", "drift_m"):
            object.__setattr__(self, name, along_left_up(name, getattr(self, name)))
        object.__setattr__(self, "wet_s", finite("wet_s", self.wet_s))

    @classmethod
    def held(cls, weather: Weather) -> Air:
        """Air that blows with `weather`'s mean wind but has carried nothing yet.

        For pictures side by side: streaks lean with each weather's wind, yet drops and flakes stay
        in place from one weather to the next.
        """
        return cls(weather.wind_m_per_s, (0.0, 0.0, 0.0), 0.0)


def air_of(weather: Weather, time_s: float, seed: int) -> Air:
    """The air of a weather that has been the same since time 0.

    Args:
        weather: Its wind, gustiness and snow wetness are read.
        time_s: Seconds since the clip's start, in [-1e10, 1e10].
        seed: Which gusts blow.

    Raises:
        ArgumentError: If the time is not finite or no seconds, or the seed is no integer.
    """
    time_s = checked_time("time_s", time_s)
    now = 1.0 + weather.gustiness * gust(time_s, seed)
    blown_s = time_s + weather.gustiness * gust_integral_s(0.0, time_s, seed)
    along, left, up = weather.wind_m_per_s
    return Air(
        (along * now, left * now, up * now),
        (along * blown_s, left * blown_s, up * blown_s),
        weather.snow_wetness * time_s,
    )


def gust(time_s: float, seed: int) -> float:
    """Gust at `time_s` in units of its root mean square, in [-sqrt(6), sqrt(6)], mean 0.

    Raises:
        ArgumentError: If the time is not finite or no seconds, or the seed is no integer.

    Source:
        Our choice: three sines of periods between 5 and 25 s, of equal power, with phases keyed by
        the seed. They stand for the gusts that pass a car in seconds, not for a turbulence
        spectrum.
    """
    time_s = checked_time("time_s", time_s)
    return _AMPLITUDE * sum(
        math.sin(rad_per_s * time_s + phase)
        for rad_per_s, phase in zip(_RAD_PER_S, _phases(check_seed("seed", seed)), strict=True)
    )


def gust_integral_s(start_s: float, end_s: float, seed: int) -> float:
    """Integral of `gust` from `start_s` to `end_s`, seconds; negative spans change its sign."""
    return gust_moments_s(start_s, end_s, seed)[0]


def gust_moments_s(start_s: float, end_s: float, seed: int) -> tuple[float, float, float]:
    """Integrals of `gust` times u^k for k = 0, 1, 2, seconds, in closed form.

    u runs from 0 at `start_s` to 1 at `end_s`. They give the drift in a wind and a gustiness that
    change linearly, because their product is a quadratic in u.
    """
    start_s = checked_time("start_s", start_s)
    span_s = checked_time("end_s", end_s) - start_s
    scale = span_s * _AMPLITUDE
    totals = [0.0, 0.0, 0.0]
    for rad_per_s, phase in zip(_RAD_PER_S, _phases(check_seed("seed", seed)), strict=True):
        start = cmath.rect(scale, rad_per_s * start_s + phase)
        for k, moment in enumerate(_moments(rad_per_s * span_s)):
            totals[k] += (start * moment).imag
    return totals[0], totals[1], totals[2]


def checked_time(name: str, time_s: float) -> float:
    """Return a time in seconds as a float, or refuse it by `name`."""
    return finite(name, time_s, -LONGEST_TIME_S, LONGEST_TIME_S)


def _moments(turn: float) -> tuple[complex, complex, complex]:
    """Integrals of u^k exp(i turn u) over u in [0, 1], for k = 0, 1, 2.

    By parts; a short turn by its series, because by parts its digits cancel.
    """
    if abs(turn) < 1:
        sums = [0j, 0j, 0j]
        term = 1 + 0j
        for n in range(20):
            for k in range(3):
                sums[k] += term / (n + k + 1)
            term *= 1j * turn / (n + 1)
        return sums[0], sums[1], sums[2]
    end = cmath.rect(1.0, turn)
    zeroth = (end - 1) / (1j * turn)
    first = (end - zeroth) / (1j * turn)
    return zeroth, first, (end - 2 * first) / (1j * turn)


@lru_cache(maxsize=1024)
def _phases(seed: int) -> tuple[float, ...]:
    """Of each sine, radians."""
    drawn = uniforms(key_of("gust", seed), len(_RAD_PER_S))
    return tuple(2 * math.pi * float(u) for u in drawn)
