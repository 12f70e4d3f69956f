"""Air: gusts with the promised statistics, and a drift that is the integral of the wind."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import FrozenInstanceError
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from weather_aug import air as module
from weather_aug.air import Air, air_of, gust, gust_integral_s, gust_moments_s
from weather_aug.errors import ArgumentError
from weather_aug.weather import Weather

SEEDS = [0, 1, -7, 2**63]
TWO_PI = 2 * Fraction("3.14159265358979323846264338327950288419716939937510")
seeds = st.integers(-(2**63), 2**64 - 1)
GUSTY = Weather.rain("heavy", wind_m_per_s=(4, -3, 0.5), gustiness=0.6, snow_wetness=0.4)


def _gusts(seed: int) -> np.ndarray:
    """Over 5.5 hours."""
    return np.array([gust(0.5 * i, seed) for i in range(40_000)])


def _is_fair(values: np.ndarray) -> bool:
    """Mean 0, mean square 1, and as much calm as storm (the third moment tells)."""
    moments = [float((values**k).mean()) for k in (1, 2, 3)]
    return all(
        abs(moment - expected) < 3e-3
        for moment, expected in zip(moments, (0.0, 1.0, 0.0), strict=True)
    )


@pytest.mark.parametrize("seed", SEEDS)
def test_gusts_have_mean_zero_and_unit_mean_square(seed: int) -> None:
    values = _gusts(seed)
    assert _is_fair(values)
    assert np.abs(values).max() <= math.sqrt(6)


@pytest.mark.parametrize(
    "patch",
    [
        {"_AMPLITUDE": 1.0},
        {"_RAD_PER_S": (0.0, 0.47, 1.05)},
        # Commensurable: the third is the sum of the others, so storms outweigh calms.
        {"_RAD_PER_S": (0.4, 0.4 * (1 + 5**0.5) / 2, 0.4 * (3 + 5**0.5) / 2)},
    ],
    ids=["too weak", "a constant gust", "commensurable"],
)
def test_other_sines_would_be_seen(patch: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in patch.items():
        monkeypatch.setattr(module, name, value)
    assert not all(_is_fair(_gusts(seed)) for seed in SEEDS)


def test_gusts_last_seconds_not_frames_nor_minutes() -> None:
    periods_s = [2 * math.pi / rad_per_s for rad_per_s in module._RAD_PER_S]
    assert all(5 <= period_s <= 25 for period_s in periods_s)


def test_each_seed_has_its_own_gusts() -> None:
    profiles = {tuple(gust(t, seed) for t in (0.0, 3.0, 11.0)) for seed in range(200)}
    assert len(profiles) == 200


def test_gusts_are_these_in_every_process() -> None:
    """Frames are drawn again from their seeds for years: the gusts are part of the format."""
    assert gust(0.0, 0) == pytest.approx(2.2025783135304517, rel=1e-12)
    assert gust(12.5, 7) == pytest.approx(0.7322541724411085, rel=1e-12)


@given(st.floats(-1e3, 1e3), st.floats(-100, 100), st.integers(0, 99))
def test_moments_are_the_integrals_of_gusts(start_s: float, span_s: float, seed: int) -> None:
    _assert_moments_match_quadrature(start_s, span_s, seed)


@pytest.mark.parametrize("span_s", [0.0, 1e-12, 1e-6, 0.01, 0.9, 1.0, 2.2, 3.6, 400.0, -1e-6])
def test_short_and_long_spans_keep_their_digits(span_s: float) -> None:
    """By parts, the digits of a short span would cancel; the series takes over in time."""
    for seed in SEEDS:
        _assert_moments_match_quadrature(17.0, span_s, seed)


def test_moments_by_parts_alone_would_be_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    def by_parts(turn: float) -> tuple[complex, complex, complex]:
        end = np.exp(1j * turn)
        zeroth = (end - 1) / (1j * turn)
        first = (end - zeroth) / (1j * turn)
        return zeroth, first, (end - 2 * first) / (1j * turn)

    monkeypatch.setattr(module, "_moments", by_parts)
    with pytest.raises(AssertionError):
        _assert_moments_match_quadrature(17.0, 1e-6, 0)


def _assert_moments_match_quadrature(start_s: float, span_s: float, seed: int) -> None:
    nodes, weights = np.polynomial.legendre.leggauss(20)
    panels = max(math.ceil(abs(span_s) / 4), 1)
    u = ((np.arange(panels)[:, None] + 0.5 * (nodes + 1)) / panels).ravel()
    share = np.tile(0.5 * weights, panels) / panels
    values = np.array([gust(start_s + span_s * x, seed) for x in u])
    actual = gust_moments_s(start_s, start_s + span_s, seed)
    span_s = (start_s + span_s) - start_s
    for k in range(3):
        expected = span_s * float((share * values * u**k).sum())
        assert abs(expected - actual[k]) <= 2e-12 * abs(span_s) + 1e-300  # denormal spans


@given(st.tuples(*[st.floats(-500, 500)] * 3), seeds)
def test_integrals_of_gusts_add_up(times_s: tuple[float, float, float], seed: int) -> None:
    a, b, c = times_s
    parts = gust_integral_s(a, b, seed) + gust_integral_s(b, c, seed)
    assert math.isclose(parts, gust_integral_s(a, c, seed), abs_tol=1e-11)
    assert gust_integral_s(a, a, seed) == 0


def test_far_times_keep_the_promised_digits() -> None:
    """Sines of exact rationals, reduced by a 50-digit circle."""
    for time_s in (1.7e9 + 0.123, -1e9, 1e6):
        exact = 0.0
        for rad_per_s, phase in zip(module._RAD_PER_S, module._phases(3), strict=True):
            turned = Fraction(rad_per_s) * Fraction(time_s) + Fraction(phase)
            exact += module._AMPLITUDE * math.sin(float(turned % TWO_PI))
        assert abs(exact - gust(time_s, 3)) < 1e-7 * max(abs(time_s) / 1e9, 1) * math.sqrt(6)


@given(st.floats(-1e5, 1e5), st.integers(0, 99))
def test_without_gusts_drift_is_wind_times_time(time_s: float, seed: int) -> None:
    wind = (4.0, -3.0, 0.5)
    steady = air_of(Weather(wind_m_per_s=wind, snow_wetness=0.5), time_s, seed)
    assert steady == Air(wind, tuple(w * time_s for w in wind), 0.5 * time_s)


def test_gusts_scale_the_wind_and_its_drift() -> None:
    blown = air_of(GUSTY, 30.0, 5)
    now = 1 + 0.6 * gust(30.0, 5)
    assert blown.wind_m_per_s == pytest.approx((4 * now, -3 * now, 0.5 * now))
    carried_s = 30 + 0.6 * gust_integral_s(0, 30, 5)
    assert blown.drift_m == pytest.approx((4 * carried_s, -3 * carried_s, 0.5 * carried_s))
    assert blown.wet_s == pytest.approx(12.0)


@pytest.mark.parametrize("time_s", [0.0, -0.0])
def test_at_time_zero_nothing_has_drifted(time_s: float) -> None:
    assert air_of(GUSTY, time_s, 5).drift_m == (0, 0, 0)
    assert air_of(GUSTY, time_s, 5).wet_s == 0


def _worst_slip_m(air: Callable[[float], Air]) -> float:
    """How far the drift leaves the path that the wind of the moment draws, in a frame's time."""
    step_s, worst = 0.05, 0.0
    airs = [air(step_s * i) for i in range(-200, 1200)]
    for a, b in itertools.pairwise(airs):
        moved = np.subtract(b.drift_m, a.drift_m)
        blown = 0.5 * step_s * np.add(a.wind_m_per_s, b.wind_m_per_s)
        worst = max(worst, float(np.abs(moved - blown).max()))
    return worst


def _without_gusts(weather: Weather, time_s: float, seed: int) -> Air:
    drift = tuple(w * time_s for w in weather.wind_m_per_s)
    return Air(air_of(weather, time_s, seed).wind_m_per_s, drift)


def _wind_now_times_time(weather: Weather, time_s: float, seed: int) -> Air:
    wind = air_of(weather, time_s, seed).wind_m_per_s
    return Air(wind, tuple(w * time_s for w in wind))


def _gusts_of_another_seed(weather: Weather, time_s: float, seed: int) -> Air:
    wind = air_of(weather, time_s, seed).wind_m_per_s
    return Air(wind, air_of(weather, time_s, seed + 1).drift_m)


def test_drift_goes_where_the_wind_blows() -> None:
    assert _worst_slip_m(lambda t: air_of(GUSTY, t, 5)) < 2e-4  # trapezoid of 50 ms


@pytest.mark.parametrize("fault", [_without_gusts, _wind_now_times_time, _gusts_of_another_seed])
def test_a_drift_that_leaves_the_wind_would_be_seen(fault: Callable[..., Air]) -> None:
    assert _worst_slip_m(lambda t: fault(GUSTY, t, 5)) > 20 * 2e-4


def test_held_air_blows_but_has_not_moved() -> None:
    assert Air.held(GUSTY) == Air((4.0, -3.0, 0.5), (0.0, 0.0, 0.0), 0.0)


def test_air_is_a_value() -> None:
    air = Air((1, 2, 3), [4, 5, 6])  # type: ignore[arg-type]
    assert air == Air((1.0, 2.0, 3.0), (4.0, 5.0, 6.0), 0.0)
    assert {air: 1}[air] == 1
    with pytest.raises(FrozenInstanceError):
        air.wet_s = 1.0  # type: ignore[misc]


@pytest.mark.parametrize("name", ["wind_m_per_s", "drift_m"])
@pytest.mark.parametrize("vector", [(0, 0), 3.0, (0, math.nan, 0), (0, math.inf, 0), "abc", None])
def test_a_vector_that_is_none_is_refused_by_name(name: str, vector: Any) -> None:
    with pytest.raises(ArgumentError, match=name):
        Air(**{"wind_m_per_s": (0, 0, 0), "drift_m": (0, 0, 0), name: vector})


@pytest.mark.parametrize("wet_s", [math.nan, math.inf, "1", True])
def test_a_wetness_that_is_none_is_refused(wet_s: Any) -> None:
    with pytest.raises(ArgumentError, match="wet_s"):
        Air((0, 0, 0), (0, 0, 0), wet_s)


@pytest.mark.parametrize("time_s", [math.nan, math.inf, 1.01e10, -1.01e10, "1", True, None])
def test_a_time_that_is_none_is_refused(time_s: Any) -> None:
    with pytest.raises(ArgumentError, match="time_s"):
        air_of(GUSTY, time_s, 0)
    with pytest.raises(ArgumentError, match="time_s"):
        gust(time_s, 0)
    with pytest.raises(ArgumentError, match="end_s"):
        gust_integral_s(0.0, time_s, 0)


@pytest.mark.parametrize("seed", [1.0, "1", True, None, 2**64, -(2**63) - 1])
def test_a_seed_that_is_none_is_refused(seed: Any) -> None:
    """Also after the equal integer has been drawn and remembered."""
    gust(0.0, 1)
    with pytest.raises(ArgumentError, match="seed"):
        air_of(GUSTY, 0.0, seed)
