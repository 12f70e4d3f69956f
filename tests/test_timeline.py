"""WeatherTimeline: any time alone, and air that moves without a jump while the weather changes."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import FrozenInstanceError
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from weather_aug.air import Air, air_of, gust
from weather_aug.errors import ArgumentError
from weather_aug.timeline import WeatherTimeline
from weather_aug.weather import Weather

CALM = Weather.clear()
RAIN = Weather.rain("heavy", wind_m_per_s=(2, 6, 0))
SLEET = Weather.snow("moderate", wind_m_per_s=(-3, 1, 0.2), snow_wetness=0.8, gustiness=0.9)
SNOW = Weather.snow("heavy", snow_wetness=0.1)
STORY = WeatherTimeline(((-4, CALM), (10, RAIN), (25, SLEET), (32, SNOW), (33, CALM)))
"""Calm, rain, sleet, snow, and a sudden end."""

wind = st.floats(-60, 60)
rate = st.just(0.0) | st.floats(0.01, 50)
weathers = st.builds(
    Weather,
    rain_mm_per_h=rate,
    snow_mm_per_h=rate,
    visibility_m=st.floats(10, 1e4) | st.just(math.inf),
    wind_m_per_s=st.tuples(wind, wind, wind),
    gustiness=st.floats(0, 1),
    snow_wetness=st.floats(0, 1),
    fog_patchiness=st.floats(0, 1),
)
steps_s = st.floats(1e-3, 30)
seeds = st.integers(0, 99)


@st.composite
def timelines(draw: Any, most: int = 5) -> WeatherTimeline:
    times_s = np.cumsum([draw(st.floats(-50, 50)), *draw(st.lists(steps_s, max_size=most - 1))])
    return WeatherTimeline(tuple((float(t), draw(weathers)) for t in times_s))


def test_outside_the_knots_the_weather_is_constant() -> None:
    for time_s in (-1e10, -100, -4):
        assert STORY.at(time_s) is STORY.knots[0][1]
    for time_s in (33, 1000, 1e10):
        assert STORY.at(time_s) is STORY.knots[-1][1]


def test_between_knots_it_is_their_blend() -> None:
    assert STORY.at(10) == RAIN
    assert STORY.at(13) == Weather.blend(RAIN, SLEET, 0.2)
    assert STORY.at(28.5) == Weather.blend(SLEET, SNOW, 0.5)


def test_a_transition_is_two_knots() -> None:
    change = WeatherTimeline.transition(CALM, RAIN, 5, 15)
    assert change == WeatherTimeline(((5, CALM), (15, RAIN)))
    assert change.at(10).rain_mm_per_h == pytest.approx(RAIN.rain_mm_per_h / 2)


@given(weathers, st.floats(-100, 100), st.floats(-1e6, 1e6), seeds)
def test_one_knot_is_the_weather_that_has_always_been(
    weather: Weather, knot_s: float, time_s: float, seed: int
) -> None:
    assert WeatherTimeline(((knot_s, weather),)).air(time_s, seed) == air_of(weather, time_s, seed)


@given(weathers, st.floats(-100, 100), steps_s, st.floats(-1e3, 1e3), seeds)
def test_a_change_to_the_same_weather_changes_nothing(
    weather: Weather, start_s: float, span_s: float, time_s: float, seed: int
) -> None:
    change = WeatherTimeline.transition(weather, weather, start_s, start_s + span_s)
    _assert_same_air(air_of(weather, time_s, seed), change.air(time_s, seed), time_s)


@given(timelines(), st.floats(0.01, 0.99), st.floats(-80, 200), seeds)
def test_a_knot_on_the_way_changes_nothing(
    timeline: WeatherTimeline, share: float, time_s: float, seed: int
) -> None:
    halves = [timeline.knots[0]]
    for (a_s, _), b in pairwise(timeline.knots):
        middle_s = a_s + share * (b[0] - a_s)
        halves += [(middle_s, timeline.at(middle_s)), b]
    finer = WeatherTimeline(tuple(halves))
    _assert_same_air(timeline.air(time_s, seed), finer.air(time_s, seed), time_s)


def _assert_same_air(expected: Air, actual: Air, time_s: float) -> None:
    """To the rounding of a few hundred metres per second over the time."""
    for name in ("wind_m_per_s", "drift_m"):
        slack = 1e-12 * 210 * (1 if name == "wind_m_per_s" else abs(time_s) + 30)
        assert getattr(actual, name) == pytest.approx(getattr(expected, name), abs=slack)
    assert actual.wet_s == pytest.approx(expected.wet_s, abs=1e-12 * (abs(time_s) + 1))


@settings(max_examples=50)
@given(timelines(), st.floats(-80, 200), seeds)
def test_air_is_the_integral_of_the_weather(
    timeline: WeatherTimeline, time_s: float, seed: int
) -> None:
    _assert_is_quadrature(timeline, time_s, seed)


@pytest.mark.parametrize("span_s", [1e-9, 1e-4, 0.02, 100.0])
def test_sudden_and_slow_changes_keep_their_digits(span_s: float) -> None:
    for start_s in (0.0, 7.0):
        change = WeatherTimeline.transition(SLEET, RAIN, start_s, start_s + span_s)
        for time_s in (start_s + 0.4 * span_s, start_s + span_s, start_s + span_s + 20):
            _assert_is_quadrature(change, time_s, 3)


def _assert_is_quadrature(timeline: WeatherTimeline, time_s: float, seed: int) -> None:
    """Gauss-Legendre over what `at` and `gust` say, between the knots, in float64."""
    nodes, weights = np.polynomial.legendre.leggauss(16)
    low_s, high_s = sorted((0.0, time_s))
    inner = [t for t, _ in timeline.knots if low_s < t < high_s]
    total, scale = np.zeros(4), 0.0
    for a_s, b_s in pairwise([low_s, *inner, high_s]):
        edges = np.linspace(a_s, b_s, math.ceil((b_s - a_s) / 4) + 1)
        for start_s, end_s in pairwise(edges):
            for node, weight in zip(nodes, weights * (end_s - start_s) / 2, strict=True):
                at_s = start_s + 0.5 * (node + 1) * (end_s - start_s)
                now = timeline.at(at_s)
                blown = 1 + now.gustiness * gust(at_s, seed)
                rates = [w * blown for w in now.wind_m_per_s] + [now.snow_wetness]
                total += weight * np.array(rates)
                scale += weight * max(map(abs, rates))
    air = timeline.air(time_s, seed)
    found = np.array([*air.drift_m, air.wet_s])
    assert np.abs(np.sign(time_s) * total - found).max() <= 1e-9 * scale + 1e-300  # denormal times


@given(timelines(), st.floats(-80, 200), seeds)
def test_the_wind_now_is_that_of_the_weather_now(
    timeline: WeatherTimeline, time_s: float, seed: int
) -> None:
    now = timeline.at(time_s)
    assert timeline.air(time_s, seed).wind_m_per_s == pytest.approx(
        air_of(now, time_s, seed).wind_m_per_s
    )


def _worst_slip_m(air: Callable[[float], Air]) -> float:
    """How far a particle leaves the path that the wind of the moment draws, in 20 ms.

    The particle is a flake that falls at 1 m/s when dry and at 5 m/s when wet.
    """
    step_s, worst = 0.02, 0.0
    times_s = [step_s * i for i in range(-400, 2400)]
    airs = [air(t) for t in times_s]
    for (a_s, a), (b_s, b) in pairwise(zip(times_s, airs, strict=True)):
        moved = np.subtract(b.drift_m, a.drift_m)
        blown = 0.5 * step_s * np.add(a.wind_m_per_s, b.wind_m_per_s)
        wetted = step_s * STORY.at(0.5 * (a_s + b_s)).snow_wetness
        fell = 4.0 * abs(b.wet_s - a.wet_s - wetted)
        worst = max(worst, fell, float(np.abs(moved - blown).max()))
    return worst


def _gusts_forgotten(time_s: float) -> Air:
    """Drift of the mean wind alone."""
    air, calm = STORY.air(time_s, 3), [(t, _steady(w)) for t, w in STORY.knots]
    return Air(air.wind_m_per_s, WeatherTimeline(tuple(calm)).air(time_s, 3).drift_m, air.wet_s)


def _steady(weather: Weather) -> Weather:
    return Weather.from_dict(weather.to_dict() | {"gustiness": 0.0})


def _wind_now_times_time(time_s: float) -> Air:
    """The classic jump."""
    air = STORY.air(time_s, 3)
    return Air(air.wind_m_per_s, tuple(w * time_s for w in air.wind_m_per_s), air.wet_s)


def _weather_now_since_ever(time_s: float) -> Air:
    """The air of today's weather as if it had always been: jumps with the gustiness too."""
    return air_of(STORY.at(time_s), time_s, 3)


def _wetness_now_times_time(time_s: float) -> Air:
    air = STORY.air(time_s, 3)
    return Air(air.wind_m_per_s, air.drift_m, STORY.at(time_s).snow_wetness * time_s)


def _wetness_of_clear_air_counted(time_s: float) -> Air:
    """Wetness run from rain's 0 to sleet's, though rain has no flakes to be dry."""
    air = STORY.air(time_s, 3)
    times_s, wetness = zip(*((t, w.snow_wetness) for t, w in STORY.knots), strict=True)
    grid = np.linspace(0, time_s, 2000)
    wet_s = np.trapezoid(np.interp(grid, times_s, wetness), grid)
    return Air(air.wind_m_per_s, air.drift_m, float(wet_s))


def _other_gusts(time_s: float) -> Air:
    air = STORY.air(time_s, 3)
    return Air(air.wind_m_per_s, STORY.air(time_s, 4).drift_m, air.wet_s)


LARGEST_SLIP_M = 5e-4
"""Of the trapezoid over 20 ms: the wind has kinks at the knots of up to 9 m/s in a second."""


def test_no_particle_jumps() -> None:
    assert _worst_slip_m(lambda t: STORY.air(t, 3)) < LARGEST_SLIP_M


@pytest.mark.parametrize(
    "fault",
    [
        _gusts_forgotten,
        _wind_now_times_time,
        _weather_now_since_ever,
        _wetness_now_times_time,
        _wetness_of_clear_air_counted,
        _other_gusts,
    ],
)
def test_a_particle_that_jumps_would_be_seen(fault: Callable[[float], Air]) -> None:
    assert _worst_slip_m(fault) > 10 * LARGEST_SLIP_M


def test_the_drift_is_smooth_across_every_knot() -> None:
    """From both sides its slope is the wind of the moment."""
    step_s = 1e-6
    for time_s in (0.0, *(t for t, _ in STORY.knots)):
        here = STORY.air(time_s, 3)
        for side_s in (-step_s, step_s):
            there = STORY.air(time_s + side_s, 3)
            slope = np.subtract(there.drift_m, here.drift_m) / side_s
            assert slope == pytest.approx(here.wind_m_per_s, abs=1e-4)


def test_times_are_independent_of_one_another() -> None:
    alone = STORY.air(29.0, 3)
    for time_s in (40.0, -3.0, 29.0):
        STORY.air(time_s, 3)
    assert STORY.air(29.0, 3) == alone == WeatherTimeline(STORY.knots).air(29.0, 3)


def test_a_timeline_is_a_value() -> None:
    pairs: Any = [[0, CALM], [np.float32(2), RAIN]]
    timeline = WeatherTimeline(pairs)
    assert timeline.knots == ((0.0, CALM), (2.0, RAIN))
    assert pairs == [[0, CALM], [2, RAIN]]
    assert {timeline: 1}[WeatherTimeline(((0, CALM), (2, RAIN)))] == 1
    with pytest.raises(FrozenInstanceError):
        timeline.knots = ()  # type: ignore[misc]


@given(timelines())
def test_json_gives_an_equal_timeline_back(timeline: WeatherTimeline) -> None:
    assert WeatherTimeline.from_json(timeline.to_json()) == timeline
    assert WeatherTimeline.from_dict(timeline.to_dict()) == timeline
    json.loads(timeline.to_json(), parse_constant=pytest.fail)


def test_json_reads_as_documented() -> None:
    state = {"knots": [{"time_s": 0, "weather": {}}, {"time_s": 9, "weather": RAIN.to_dict()}]}
    assert WeatherTimeline.from_dict(state) == WeatherTimeline(((0, CALM), (9, RAIN)))


@pytest.mark.parametrize(
    ("knots", "message"),
    [
        ((), "at least one"),
        (None, "pairs"),
        (3, "pairs"),
        ("ab", r"knots\[0\] must be a pair"),
        ((1.0, CALM), r"knots\[0\] must be a pair"),
        (((0, CALM, 1),), r"knots\[0\] must be a pair"),
        (((0, "rain"),), r"knots\[0\].*str for the Weather"),
        (((0, CALM), (1, None)), r"knots\[1\].*NoneType for the Weather"),
        (((0, CALM), (0, RAIN)), r"knots\[1\] is at 0.0 s, not after"),
        (((0, CALM), (2, RAIN), (1, CALM)), r"knots\[2\] is at 1.0 s, not after .* 2.0 s"),
        (((math.nan, CALM),), r"time_s of knots\[0\]"),
        (((0, CALM), (math.inf, RAIN)), r"time_s of knots\[1\]"),
        (((1.1e10, CALM),), r"time_s of knots\[0\]"),
        ((("0", CALM),), r"time_s of knots\[0\]"),
        (((True, CALM),), r"time_s of knots\[0\]"),
    ],
)
def test_knots_that_are_none_are_refused(knots: Any, message: str) -> None:
    with pytest.raises(ArgumentError, match=message):
        WeatherTimeline(knots)


@pytest.mark.parametrize("time_s", [math.nan, math.inf, 1.01e10, "1", None])
def test_a_time_that_is_none_is_refused(time_s: Any) -> None:
    for ask in (STORY.at, lambda t: STORY.air(t, 0)):
        with pytest.raises(ArgumentError, match="time_s"):
            ask(time_s)


def test_a_seed_that_is_none_is_refused() -> None:
    for timeline in (STORY, WeatherTimeline(((0, RAIN),))):
        with pytest.raises(ArgumentError, match="seed"):
            timeline.air(1.0, 0.5)  # type: ignore[arg-type]


@pytest.mark.parametrize(("start_s", "end_s"), [(1, 1), (2, 1), (math.nan, 1), (0, math.inf)])
def test_a_transition_that_takes_no_time_is_refused(start_s: float, end_s: float) -> None:
    with pytest.raises(ArgumentError, match=r"start_s|end_s"):
        WeatherTimeline.transition(CALM, RAIN, start_s, end_s)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not a WeatherTimeline in JSON"),
        ("[" * 100_000, "not a WeatherTimeline in JSON"),
        ("[]", "read from an object, got list"),
        ("{}", "lacks knots"),
        ('{"knots": [], "fps": 3}', "no field fps"),
        ('{"knots": []}', "at least one"),
        ('{"knots": {}}', "knots must be a list, got dict"),
        ('{"knots": "ab"}', "knots must be a list, got str"),
        ('{"knots": [[0, {}]]}', r"knots\[0\] is read from an object, got list"),
        ('{"knots": [{"time_s": 0}]}', r"knots\[0\] lacks weather"),
        ('{"knots": [{"time_s": 0, "weather": {}, "x": 1}]}', r"knots\[0\] has no field x"),
        ('{"knots": [{"time_s": NaN, "weather": {}}]}', r"time_s of knots\[0\]"),
        ('{"knots": [{"time_s": 1e999, "weather": {}}]}', r"time_s of knots\[0\]"),
        ('{"knots": [{"time_s": null, "weather": {}}]}', r"time_s of knots\[0\]"),
        ('{"knots": [{"time_s": 0, "weather": "rain"}]}', r"weather of knots\[0\]: a Weather"),
        ('{"knots": [{"time_s": 0, "weather": {"hail": 1}}]}', r"weather of knots\[0\].*hail"),
        ('{"knots": [{"time_s": 0, "weather": {"wetness": 2}}]}', r"knots\[0\]: wetness must"),
    ],
    ids=lambda text: text[:40],
)
def test_text_that_is_no_timeline_is_refused(text: str, message: str) -> None:
    with pytest.raises(ArgumentError, match=message):
        WeatherTimeline.from_json(text)


def test_what_is_no_text_is_refused() -> None:
    with pytest.raises(ArgumentError, match="not a WeatherTimeline in JSON"):
        WeatherTimeline.from_json(3)  # type: ignore[arg-type]
