"""WeatherPolicy: fair draws, each a function of (seed, epoch, item) alone."""

from __future__ import annotations

import math
import random
from collections import Counter
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from weather_aug._keys import uniforms
from weather_aug.errors import ArgumentError
from weather_aug.scene.policy import VARIED, WeatherDraw, WeatherPolicy, weather_of
from weather_aug.weather import Weather

ITEMS = 20_000
TYPES = {"clear": 1.0, "rain": 2.0, "snow": 2.0, "fog": 1.0, "rain+fog": 0.5}
FALLS = {"rain": "rain_mm_per_h", "snow": "snow_mm_per_h"}
LEAST_P = 1e-6

seeds = st.integers(-(2**63), 2**64 - 1)
types = st.dictionaries(
    st.sampled_from([*TYPES, "snow+fog"]), st.floats(0.01, 100), min_size=1, max_size=6
)


@pytest.fixture(scope="module")
def draws() -> list[WeatherDraw]:
    policy = WeatherPolicy(TYPES, severity=(0.2, 0.9), falling=0.7)
    return [policy.draw(11, 0, item) for item in range(ITEMS)]


def test_types_come_by_their_weights(draws: list[WeatherDraw]) -> None:
    counts = Counter(draw.kind for draw in draws)
    weights = np.array(list(TYPES.values()))
    observed = [counts[kind] for kind in TYPES]
    assert sum(observed) == ITEMS
    assert stats.chisquare(observed, ITEMS * weights / weights.sum()).pvalue >= LEAST_P


@pytest.mark.parametrize("kind", TYPES)
def test_severity_is_triangular_with_moderate_the_commonest(
    draws: list[WeatherDraw], kind: str
) -> None:
    severity = np.array([draw.severity for draw in draws if draw.kind == kind])
    assert 0.2 <= severity.min() < severity.max() <= 0.9
    peak = (0.5 - 0.2) / 0.7
    assert stats.kstest(severity, "triang", (peak, 0.2, 0.7)).pvalue >= LEAST_P
    assert stats.kstest(severity, "uniform", (0.2, 0.7)).pvalue < LEAST_P, "a planted fault"


@pytest.mark.parametrize(("low", "high", "peak"), [(0.6, 1.0, 0.0), (0.0, 0.3, 1.0)])
def test_severity_leans_to_moderate_from_outside(low: float, high: float, peak: float) -> None:
    policy = WeatherPolicy({"fog": 1.0}, severity=(low, high))
    severity = [policy.draw(2, 0, item).severity for item in range(3_000)]
    assert stats.kstest(severity, "triang", (peak, low, high - low)).pvalue >= LEAST_P


# Days of equal severity


def factors(policy: WeatherPolicy, count: int = 4_000) -> dict[str, np.ndarray[Any, Any]]:
    """What each varied value of heavy snow and rain is of the severity's own."""
    usual = Weather.mix(Weather.rain(0.25), Weather.snow(0.25))
    drawn = [policy.draw(9, 0, item).weather for item in range(count)]
    return {
        name: np.array([getattr(w, name) for w in drawn]) / getattr(usual, name) for name in VARIED
    }


LIGHT_DAYS = {"types": {"rain+snow": 1.0}, "severity": (0.25, 0.25), "falling": 1.0}


def test_days_differ_within_the_documented_ranges() -> None:
    usual = Weather.mix(Weather.rain(0.25), Weather.snow(0.25))
    for name, factor in factors(WeatherPolicy(**LIGHT_DAYS)).items():
        least, greatest, most = VARIED[name]
        cut = most / getattr(usual, name)
        assert least - 1e-9 <= factor.min() and factor.max() <= min(greatest, cut) + 1e-9, name
        whole = factor[factor < cut - 1e-9]
        law = (least, min(greatest, cut) - least)
        assert stats.kstest(whole, "uniform", law).pvalue >= LEAST_P, name


def independent(found: dict[str, np.ndarray[Any, Any]]) -> bool:
    table = np.corrcoef(np.array(list(found.values())))
    count = len(next(iter(found.values())))
    return bool((np.abs(table - np.eye(len(table))) <= 4.5 / math.sqrt(count)).all())


def test_what_varies_does_not_know_of_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = WeatherPolicy(**LIGHT_DAYS)
    assert independent(factors(policy))

    def one_for_all(key: int, count: int) -> Any:
        return np.full(count, uniforms(key, 1)[0])

    monkeypatch.setattr("weather_aug.scene.policy.uniforms", one_for_all)
    assert not independent(factors(policy)), "a planted fault is not told"


def test_a_day_says_nothing_of_its_severity() -> None:
    policy = WeatherPolicy({"rain": 1.0}, falling=1.0)
    drawn = [policy.draw(3, 0, item) for item in range(4_000)]
    drops = [d.weather.lens_drops / Weather.rain(d.severity).lens_drops for d in drawn]
    correlation = np.corrcoef(drops, [d.severity for d in drawn])[0, 1]
    assert abs(correlation) <= 4.5 / math.sqrt(len(drawn))


def test_variation_narrows_the_ranges() -> None:
    half = factors(WeatherPolicy(**LIGHT_DAYS, variation=0.5), 1_000)
    assert half["puddles"].min() >= 0.5
    assert half["puddles"].max() <= 2.5
    none = factors(WeatherPolicy(**LIGHT_DAYS, variation=0.0), 10)
    assert all((factor == 1).all() for factor in none.values())


def test_a_quarter_of_the_default_stays_clear_to_the_last_bit() -> None:
    drawn = [WeatherPolicy().draw(1, 0, item) for item in range(8_000)]
    clear = [draw for draw in drawn if draw.kind == "clear"]
    assert stats.binomtest(len(clear), len(drawn), 0.25).pvalue >= LEAST_P
    assert all(draw.weather.is_clear for draw in clear)
    assert not any(draw.weather.is_clear for draw in drawn if draw.kind != "clear")


def test_nothing_that_ended_comes_back() -> None:
    policy = WeatherPolicy({"rain": 1.0, "snow": 1.0}, falling=0.0)
    for item in range(300):
        weather = policy.draw(0, 0, item).weather
        assert weather.lens_drops == weather.wipers == weather.rain_mm_per_h == 0
        assert weather.wetness > 0


@pytest.mark.parametrize("kind", FALLS)
def test_the_share_that_falls_is_the_policys(draws: list[WeatherDraw], kind: str) -> None:
    falls = [getattr(draw.weather, FALLS[kind]) > 0 for draw in draws if draw.kind == kind]
    assert stats.binomtest(sum(falls), len(falls), 0.7).pvalue >= LEAST_P


def test_wind_blows_from_any_side_with_the_weathers_strength(draws: list[WeatherDraw]) -> None:
    winds = np.array([d.weather.wind_m_per_s for d in draws if d.kind == "snow"])
    angles = np.arctan2(winds[:, 1], winds[:, 0])
    assert stats.kstest(angles, "uniform", (-math.pi, 2 * math.pi)).pvalue >= LEAST_P
    draw = next(d for d in draws if d.kind == "snow")
    expected = math.hypot(*Weather.snow(draw.severity).wind_m_per_s)
    assert math.hypot(*draw.weather.wind_m_per_s) == pytest.approx(expected)


def test_one_draws_numbers_do_not_know_of_each_other(draws: list[WeatherDraw]) -> None:
    """Whether it falls and where the wind comes from say nothing of the severity."""
    snow = [draw for draw in draws if draw.kind == "snow"]
    severity = np.array([draw.severity for draw in snow])
    falls = np.array([draw.weather.snow_mm_per_h > 0 for draw in snow])
    assert stats.ks_2samp(severity[falls], severity[~falls]).pvalue >= LEAST_P
    winds = np.array([draw.weather.wind_m_per_s for draw in snow])
    angles = np.arctan2(winds[:, 1], winds[:, 0]) % (2 * math.pi)
    assert abs(np.corrcoef(severity, angles)[0, 1]) <= 4 / math.sqrt(len(snow))
    assert stats.ks_2samp(angles[falls], angles[~falls]).pvalue >= LEAST_P


def test_particle_seeds_differ(draws: list[WeatherDraw]) -> None:
    assert len({draw.seed for draw in draws}) == ITEMS


@pytest.mark.parametrize("step", [(1, 0, 0), (0, 1, 0), (0, 0, 1)], ids=["seed", "epoch", "item"])
def test_neighbours_do_not_know_of_each_other(step: tuple[int, int, int]) -> None:
    policy = WeatherPolicy({"rain": 1.0}, severity=(0, 1))
    seed, epoch, item = step
    here = np.array([policy.draw(5, 5, i).severity for i in range(5_000)])
    there = np.array([policy.draw(5 + seed, 5 + epoch, i + item).severity for i in range(5_000)])
    assert abs(np.corrcoef(here, there)[0, 1]) <= 4 / math.sqrt(len(here))
    assert not np.array_equal(here, there)


@given(seeds, seeds, seeds)
def test_a_draw_is_pure(seed: int, epoch: int, item: int) -> None:
    policy = WeatherPolicy(TYPES)
    before = random.getstate(), np.random.get_state()[1].tolist()  # noqa: NPY002
    first = policy.draw(seed, epoch, item)
    policy.draw(seed + 1 if seed < 0 else seed - 1 if seed else 1, epoch, item)
    assert policy.draw(seed, epoch, item) == first
    assert WeatherPolicy.from_dict(policy.to_dict()).draw(seed, epoch, item) == first
    assert (random.getstate(), np.random.get_state()[1].tolist()) == before  # noqa: NPY002


def test_a_plus_is_both_at_once() -> None:
    draw = WeatherPolicy({"rain+fog": 1.0}, severity=(0.5, 0.5), falling=1).draw(0, 0, 0)
    both = Weather.mix(Weather.rain(0.5), Weather.fog(0.5))
    assert draw.kind == "rain+fog"
    assert draw.weather.rain_mm_per_h == both.rain_mm_per_h > 0
    assert draw.weather.visibility_m == both.visibility_m < math.inf


@pytest.mark.parametrize("kind", ["rain", "snow", "fog"])
def test_a_single_type_is_drawn_to_the_last_bit(kind: str) -> None:
    """Nothing is mixed into it, so that a recipe shows the numbers that were asked for."""
    draw = WeatherPolicy({kind: 1.0}, falling=1.0, variation=0.0).draw(1, 2, 3)
    expected = weather_of(kind, draw.severity).to_dict()
    assert expected | {"wind_m_per_s": None} == draw.weather.to_dict() | {"wind_m_per_s": None}


@pytest.mark.parametrize(("falling", "falls"), [(0.0, False), (1.0, True)])
def test_falling_at_its_ends(falling: float, falls: bool) -> None:
    policy = WeatherPolicy({"rain": 1.0}, falling=falling)
    assert all((policy.draw(0, 0, i).weather.rain_mm_per_h > 0) is falls for i in range(50))


def test_a_weight_of_zero_is_never_drawn() -> None:
    policy = WeatherPolicy({"snow": 0.0, "rain": 1.0, "fog": 0.0})
    assert {policy.draw(0, 0, item).kind for item in range(500)} == {"rain"}
    assert policy._kind(1.0) == "rain"


@given(types, st.tuples(st.floats(0, 1), st.floats(0, 1)), st.floats(0, 1))
def test_a_dict_gives_an_equal_policy_back(
    weights: dict[str, float], severity: tuple[float, float], falling: float
) -> None:
    policy = WeatherPolicy(weights, (min(severity), max(severity)), falling, falling / 2)
    assert WeatherPolicy.from_dict(policy.to_dict()) == policy
    assert WeatherPolicy.from_dict({}) == WeatherPolicy()


def test_names_stand_for_severities() -> None:
    assert WeatherPolicy(severity=("light", "heavy")).severity == (0.25, 0.75)  # type: ignore[arg-type]


def test_a_callers_dict_is_copied() -> None:
    weights = {"rain": 1.0}
    policy = WeatherPolicy(weights)
    weights["snow"] = 5.0
    assert policy.types == {"rain": 1.0}


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"types": {}}, "at least one"),
        ({"types": ["rain"]}, "at least one"),
        ({"types": {"hail": 1}}, "'hail' is not one of clear, rain, snow, fog"),
        ({"types": {"rain+hail": 1}}, "'hail'"),
        ({"types": {"": 1}}, "''"),
        ({"types": {3: 1}}, "'3'"),
        ({"types": {"rain": -1}}, "weight of rain"),
        ({"types": {"rain": math.nan}}, "weight of rain"),
        ({"types": {"rain": math.inf}}, "weight of rain"),
        ({"types": {"rain": "2"}}, "weight of rain"),
        ({"types": {"rain": 0, "fog": 0}}, "above 0"),
        ({"types": {"rain": 1e308, "fog": 1e308}}, "finite"),
        ({"severity": (0.5, 0.2)}, "severity must be a range"),
        ({"severity": (0.5, 1.2)}, "severity"),
        ({"severity": (0.5, math.nan)}, "severity"),
        ({"severity": 0.5}, r"severity must be a range \(low, high\) in .*, got 0.5$"),
        ({"severity": "heavy"}, "severity must be a range .*, got .heavy.$"),
        ({"severity": (0.1, 0.2, 0.3)}, "severity must be a range"),
        ({"severity": None}, "severity must be a range"),
        ({"falling": 1.1}, "falling"),
        ({"falling": True}, "falling"),
        ({"variation": 1.1}, "variation"),
        ({"variation": None}, "variation"),
        ({"wetness": 1}, "no field wetness"),
    ],
    ids=str,
)
def test_a_bad_policy_is_refused(arguments: dict[str, Any], says: str) -> None:
    with pytest.raises(ArgumentError, match=says.replace("'", ".")):
        WeatherPolicy.from_dict(arguments)
    if "wetness" not in arguments:
        with pytest.raises(ArgumentError, match=says.replace("'", ".")):
            WeatherPolicy(**arguments)


@pytest.mark.parametrize("state", [None, [], "rain", 3])
def test_a_policy_is_read_from_an_object(state: Any) -> None:
    with pytest.raises(ArgumentError, match="object"):
        WeatherPolicy.from_dict(state)


def test_an_unknown_type_or_bad_key_is_refused() -> None:
    with pytest.raises(ArgumentError, match="hail"):
        weather_of("hail", 0.5)
    with pytest.raises(ArgumentError, match="severity"):
        weather_of("rain", 1.5)
    for key in ((2**64, 0, 0), (0, 1.5, 0), (0, 0, True)):
        with pytest.raises(ArgumentError, match="integer"):
            WeatherPolicy().draw(*key)  # type: ignore[arg-type]


@given(types, st.randoms(use_true_random=False), st.integers(0, 999))
def test_equal_policies_draw_equally(
    weights: dict[str, float], shuffle: random.Random, item: int
) -> None:
    """A file may list the types in another order; YAML sorts them."""
    names = [*weights]
    shuffle.shuffle(names)
    other = WeatherPolicy({name: weights[name] for name in names})
    assert other == WeatherPolicy(weights)
    assert other.draw(3, 0, item) == WeatherPolicy(weights).draw(3, 0, item)
