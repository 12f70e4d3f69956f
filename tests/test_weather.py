"""Weather: one severity scale, physical units, and nothing that is not a weather."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import FrozenInstanceError, fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from weather_aug.errors import ArgumentError
from weather_aug.severity import (
    NAMED_SEVERITIES,
    fog_severity,
    parse_severity,
    rain_severity,
    snow_severity,
    visibility_from_severity,
)
from weather_aug.weather import Weather, shape_ends

GRID = [i / 100 for i in range(101)]
STOPS = [0.25, 0.5, 0.75, 1.0]
FACTORY = {"rain": Weather.rain, "snow": Weather.snow, "fog": Weather.fog}

TABLE = {
    ("rain", "rain_mm_per_h"): (1.5, 5, 20, 75),
    ("rain", "mist_per_km"): (0.2, 0.6, 2.0, 5.0),
    ("rain", "wetness"): (0.5, 0.8, 1, 1),
    ("rain", "overcast"): (0.6, 0.8, 1, 1),
    ("rain", "gustiness"): (0.3, 0.3, 0.3, 0.3),
    ("rain", "spray_per_km"): (0.5, 2, 10, 25),
    ("snow", "snow_mm_per_h"): (0.4, 1, 2, 4),
    ("snow", "mist_per_km"): (0.3, 0.8, 2, 5),
    ("snow", "snow_cover"): (0.25, 0.6, 0.9, 1),
    ("snow", "overcast"): (0.6, 0.8, 1, 1),
    ("snow", "gustiness"): (0.25, 0.25, 0.25, 0.25),
    ("fog", "fog_per_m"): (0.005, 0.01, 0.02, 0.06),
    ("fog", "overcast"): (0.6, 0.8, 1, 1),
}
"""Documented values at light, moderate, heavy, extreme."""

POWER_BELOW = {("fog", "fog_per_m"): 1}

unit = st.floats(0, 1)
length_m = st.floats(1, 1e6) | st.just(math.inf)
wind = st.floats(-60, 60)
weathers = st.builds(
    Weather,
    rain_mm_per_h=st.floats(0, 400),
    snow_mm_per_h=st.floats(0, 50),
    visibility_m=length_m,
    fog_scale_height_m=length_m,
    mist_per_km=st.floats(0, 100),
    wetness=unit,
    snow_cover=unit,
    overcast=unit,
    wind_m_per_s=st.tuples(wind, wind, wind),
    gustiness=unit,
    snow_wetness=unit,
    fog_patchiness=unit,
    fog_puffs=st.floats(0, 0.5),
    spray_per_km=st.floats(0, 200),
)
THING = {
    "snow_wetness": {"snow_mm_per_h": 1.0},
    "fog_patchiness": {"visibility_m": 200.0},
    "fog_puffs": {"visibility_m": 200.0},
}
"""What each field shapes."""


def _close(expected: float, actual: float, relative: float) -> bool:
    return math.isclose(expected, actual, rel_tol=relative, abs_tol=1e-300)


@pytest.mark.parametrize(("quantity", "values"), TABLE.items(), ids=str)
def test_each_stop_has_the_documented_value(
    quantity: tuple[str, str], values: tuple[float, ...]
) -> None:
    kind, name = quantity
    for severity, value in zip(NAMED_SEVERITIES, values, strict=True):
        assert math.isclose(value, getattr(FACTORY[kind](severity), name), rel_tol=1e-12)


def test_fog_stops_are_the_documented_ranges() -> None:
    """600, 300, 150 and 50 m are the extinctions' ranges in round numbers."""
    for severity, visibility_m in zip(NAMED_SEVERITIES, (600, 300, 150, 50), strict=True):
        assert Weather.fog(severity).visibility_m == pytest.approx(visibility_m, rel=2e-3)
    heights = [Weather.fog(severity).fog_scale_height_m for severity in NAMED_SEVERITIES]
    assert heights == [math.inf, math.inf, pytest.approx(60), pytest.approx(25)]


@pytest.mark.parametrize(("quantity", "values"), TABLE.items(), ids=str)
def test_between_stops_quantities_are_log_linear(
    quantity: tuple[str, str], values: tuple[float, ...]
) -> None:
    kind, name = quantity
    for s in GRID[26:]:
        expected = math.exp(np.interp(s, STOPS, np.log(values)))
        assert math.isclose(expected, getattr(FACTORY[kind](s), name), rel_tol=1e-12)


@pytest.mark.parametrize(("quantity", "values"), TABLE.items(), ids=str)
def test_below_light_quantities_fall_to_zero_by_their_power(
    quantity: tuple[str, str], values: tuple[float, ...]
) -> None:
    kind, name = quantity
    power = POWER_BELOW.get(quantity, 2)
    for s in GRID[1:26]:
        expected = values[0] * (4 * s) ** power
        assert math.isclose(expected, getattr(FACTORY[kind](s), name), rel_tol=1e-12)


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("rain", "rain_mm_per_h"),
        ("rain", "mist_per_km"),
        ("rain", "spray_per_km"),
        ("snow", "snow_mm_per_h"),
        ("snow", "mist_per_km"),
        ("snow", "snow_cover"),
        ("fog", "fog_per_m"),
    ],
)
def test_units_rise_strictly_with_severity(kind: str, name: str) -> None:
    values = [getattr(FACTORY[kind](s), name) for s in GRID]
    assert all(a < b for a, b in itertools.pairwise(values))


@pytest.mark.parametrize("kind", FACTORY)
def test_nothing_falls_with_severity(kind: str) -> None:
    """Quantities that saturate (wetness, clouds) and the wind stay or rise; ranges shrink."""
    states = [FACTORY[kind](s) for s in GRID]
    for name in ("wetness", "snow_cover", "overcast", "gustiness"):
        values = [getattr(state, name) for state in states]
        assert all(a <= b for a, b in itertools.pairwise(values)), name
    speeds = [math.hypot(*state.wind_m_per_s) for state in states]
    assert all(a <= b for a, b in itertools.pairwise(speeds))
    for name in ("visibility_m", "fog_scale_height_m"):
        values = [getattr(state, name) for state in states]
        assert all(a >= b for a, b in itertools.pairwise(values)), name


@pytest.mark.parametrize("kind", FACTORY)
def test_severity_zero_is_clear(kind: str) -> None:
    assert FACTORY[kind](0.0) == Weather.clear() == Weather()
    assert FACTORY[kind](0.0).is_clear
    assert not FACTORY[kind](0.01).is_clear


def test_wind_alone_and_a_height_without_fog_are_clear() -> None:
    assert Weather(wind_m_per_s=(3, 2, 1), gustiness=1, fog_scale_height_m=50).is_clear
    assert Weather(snow_wetness=1, fog_patchiness=1, fog_puffs=0.5).is_clear
    for name in ("rain_mm_per_h", "snow_mm_per_h", "mist_per_km", "spray_per_km"):
        assert not Weather(**{name: 0.1}).is_clear
    for name in ("wetness", "snow_cover", "overcast"):
        assert not Weather(**{name: 0.1}).is_clear
    assert not Weather(visibility_m=1000).is_clear


@given(st.floats(1e-3, 1))
def test_severity_comes_back_from_units(s: float) -> None:
    assert _close(s, rain_severity(Weather.rain(s).rain_mm_per_h), 1e-9)
    assert _close(s, snow_severity(Weather.snow(s).snow_mm_per_h), 1e-9)
    assert _close(s, fog_severity(Weather.fog(s).visibility_m), 1e-9)


@given(st.floats(1e-6, 75), st.floats(1e-6, 4), st.floats(50, 1e7))
def test_units_come_back_from_severity(rain: float, snow: float, visibility_m: float) -> None:
    assert _close(rain, Weather.rain(rain_severity(rain)).rain_mm_per_h, 1e-9)
    assert _close(snow, Weather.snow(snow_severity(snow)).snow_mm_per_h, 1e-9)
    assert _close(visibility_m, visibility_from_severity(fog_severity(visibility_m)), 1e-9)


def test_beyond_extreme_the_severity_is_cut_and_the_unit_kept() -> None:
    flood = Weather.rain(mm_per_h=300)
    assert flood.rain_mm_per_h == 300
    assert flood == replace(Weather.rain("extreme"), rain_mm_per_h=300)
    assert Weather.fog(visibility_m=2).visibility_m == 2


@given(st.floats(0.01, 1))
def test_a_unit_brings_what_its_severity_brings(s: float) -> None:
    given_in_units = Weather.rain(mm_per_h=Weather.rain(s).rain_mm_per_h)
    for field in ("mist_per_km", "spray_per_km", "wetness", "overcast", "gustiness"):
        assert _close(getattr(Weather.rain(s), field), getattr(given_in_units, field), 1e-8)


def test_named_severities() -> None:
    assert NAMED_SEVERITIES == {"light": 0.25, "moderate": 0.5, "heavy": 0.75, "extreme": 1.0}
    for name, s in NAMED_SEVERITIES.items():
        assert parse_severity(name) == s
        for factory in FACTORY.values():
            assert factory(name) == factory(s)


def test_overrides_replace_what_comes_with_the_weather() -> None:
    state = Weather.rain("heavy", wetness=0.1, wind_m_per_s=(3, 0, 0))
    assert state == replace(Weather.rain("heavy"), wetness=0.1, wind_m_per_s=(3.0, 0.0, 0.0))


@pytest.mark.parametrize("kind", ["rain", "snow"])
def test_not_falling_leaves_the_ground_and_the_sky(kind: str) -> None:
    falls, fell = FACTORY[kind]("heavy"), FACTORY[kind]("heavy", falling=False)
    in_the_air = {f"{kind}_mm_per_h": 0.0, "mist_per_km": 0.0, "spray_per_km": 0.0}
    assert fell == replace(falls, **in_the_air)
    assert fell.overcast > 0
    assert not fell.is_clear


@given(weathers, weathers)
def test_blend_ends_are_exact(a: Weather, b: Weather) -> None:
    assert Weather.blend(a, b, 0) == a
    assert Weather.blend(a, b, 1) == b


@given(weathers, weathers, unit, unit)
def test_blend_runs_one_way_between_its_ends(a: Weather, b: Weather, t: float, u: float) -> None:
    early, late = (Weather.blend(a, b, x) for x in sorted((t, u)))
    for quantity in _quantities(a):
        start, end = _quantities(a)[quantity], _quantities(b)[quantity]
        first, second = _quantities(early)[quantity], _quantities(late)[quantity]
        slack = 1e-12 * max(abs(start), abs(end))
        way = 1 if end >= start else -1
        assert way * (first - start) >= -slack
        assert way * (second - first) >= -slack
        assert way * (end - second) >= -slack


def _quantities(state: Weather) -> dict[str, float]:
    """What a transition runs through: rates, shares, extinctions, wind."""
    inverse = ("visibility_m", "fog_scale_height_m")
    plain = (f.name for f in fields(Weather) if f.name not in (*inverse, "wind_m_per_s"))
    return (
        {name: getattr(state, name) for name in plain}
        | {name: 1 / getattr(state, name) for name in inverse}
        | {f"wind {i}": value for i, value in enumerate(state.wind_m_per_s)}
    )


def test_blend_half_way_is_half_of_each_rate_and_extinction() -> None:
    half = Weather.blend(Weather.clear(), Weather(rain_mm_per_h=10, visibility_m=200), 0.5)
    assert half.rain_mm_per_h == 5
    assert half.visibility_m == pytest.approx(400)


@given(weathers, unit)
def test_a_blend_of_equal_weathers_is_that_weather(state: Weather, t: float) -> None:
    assert Weather.blend(state, replace(state), t) == state


@pytest.mark.parametrize(("name", "thing"), THING.items(), ids=THING)
@pytest.mark.parametrize("t", [1e-9, 0.3, 1 - 1e-9])
def test_a_shape_holds_where_only_one_side_has_its_thing(
    name: str, thing: dict[str, float], t: float
) -> None:
    """A flake must not grow wet because the weather without snow says 0.4."""
    has, has_not = Weather(**thing, **{name: 0.1}), Weather(**{name: 0.4})
    assert getattr(Weather.blend(has, has_not, t), name) == 0.1
    assert getattr(Weather.blend(has_not, has, t), name) == 0.1


@pytest.mark.parametrize(("name", "thing"), THING.items(), ids=THING)
def test_a_shape_runs_linearly_where_both_or_none_has_its_thing(
    name: str, thing: dict[str, float]
) -> None:
    """Not weighted by the amounts, which would bend a transition of snow to more snow."""
    for some, more in (({}, {}), (thing, {k: 3 * v for k, v in thing.items()})):
        a, b = Weather(**some, **{name: 0.1}), Weather(**more, **{name: 0.4})
        for t in (0.25, 0.5, 0.75):
            assert getattr(Weather.blend(a, b, t), name) == pytest.approx(0.1 + 0.3 * t)


@given(weathers, weathers, st.floats(1e-9, 1 - 1e-9), st.sampled_from([*THING]))
def test_shape_ends_are_the_limits_of_a_blend(a: Weather, b: Weather, t: float, name: str) -> None:
    assume(a != b)
    start, end = shape_ends(a, b, name)
    between = getattr(Weather.blend(a, b, t), name)
    assert math.isclose(start + t * (end - start), between, abs_tol=1e-15)


@given(weathers, weathers)
def test_mix_does_not_depend_on_the_order(a: Weather, b: Weather) -> None:
    assert Weather.mix(a, b) == Weather.mix(b, a)


def test_mix_of_equally_strong_winds_does_not_depend_on_the_order() -> None:
    a, b = Weather(wind_m_per_s=(0, 3, 0)), Weather(wind_m_per_s=(3, 0, 0))
    assert Weather.mix(a, b) == Weather.mix(b, a)


@given(weathers)
def test_mix_with_clear_changes_nothing(state: Weather) -> None:
    assume(state.visibility_m < math.inf or state.fog_scale_height_m == math.inf)
    mixed = Weather.mix(state, Weather.clear())
    for name, value in _quantities(state).items():
        assert math.isclose(value, _quantities(mixed)[name], rel_tol=1e-12, abs_tol=1e-15), name


def test_mix_adds_rates_and_extinctions() -> None:
    both = Weather.mix(Weather(rain_mm_per_h=2, wetness=0.5), Weather.fog(visibility_m=300))
    assert both.rain_mm_per_h == 2
    assert both.visibility_m == pytest.approx(300)
    twice = Weather.mix(Weather.fog(visibility_m=300), Weather.fog(visibility_m=300))
    assert twice.visibility_m == pytest.approx(150)
    assert Weather.mix(Weather(wetness=0.5), Weather(wetness=0.5)).wetness == 0.75


def test_mixed_fog_has_the_height_that_its_extinctions_weigh() -> None:
    low = Weather(visibility_m=100, fog_scale_height_m=20)
    high = Weather(visibility_m=300)
    inverse = (low.fog_per_m / 20) / (low.fog_per_m + high.fog_per_m)
    assert Weather.mix(low, high).fog_scale_height_m == pytest.approx(1 / inverse)


@pytest.mark.parametrize(
    ("name", "some", "thrice"),
    [
        ("snow_wetness", {"snow_mm_per_h": 1.0}, {"snow_mm_per_h": 3.0}),
        ("fog_patchiness", {"visibility_m": 300.0}, {"visibility_m": 100.0}),
        ("fog_puffs", {"visibility_m": 300.0}, {"visibility_m": 100.0}),
    ],
)
def test_a_mixed_shape_is_weighted_by_its_thing(
    name: str, some: dict[str, float], thrice: dict[str, float]
) -> None:
    a, b = Weather(**some, **{name: 0.4}), Weather(**thrice, **{name: 0.2})
    assert getattr(Weather.mix(a, b), name) == pytest.approx(0.25)
    assert getattr(Weather.mix(a, Weather(**{name: 0.5})), name) == 0.4
    assert getattr(Weather.mix(Weather(**{name: 0.1}), Weather(**{name: 0.4})), name) == 0.4


def test_mixed_gusts_are_of_the_stronger_wind_and_spray_adds() -> None:
    breeze = Weather(wind_m_per_s=(0, 2, 0), gustiness=0.9, spray_per_km=3)
    gale = Weather(wind_m_per_s=(-9, 0, 0), gustiness=0.2, spray_per_km=4)
    both = Weather.mix(breeze, gale)
    assert (both.wind_m_per_s, both.gustiness) == (gale.wind_m_per_s, 0.2)
    assert both.spray_per_km == 7
    assert Weather.mix(both, Weather(spray_per_km=199)).spray_per_km == 200
    calm = Weather(wind_m_per_s=(0, 2, 0), gustiness=0.1)
    assert Weather.mix(breeze, calm).gustiness == Weather.mix(calm, breeze).gustiness == 0.9


def test_fog_has_nothing_new() -> None:
    for s in GRID:
        fog = Weather.fog(s)
        assert not any(getattr(fog, name) for name in (*THING, "gustiness", "spray_per_km"))


def test_fog_per_m_is_koschmieder() -> None:
    assert math.exp(-Weather(visibility_m=123).fog_per_m * 123) == pytest.approx(0.05)
    assert Weather().fog_per_m == 0


@given(weathers)
def test_json_gives_an_equal_weather_back(state: Weather) -> None:
    assert Weather.from_json(state.to_json()) == state
    assert Weather.from_dict(state.to_dict()) == state
    json.loads(state.to_json(), parse_constant=pytest.fail)


def test_json_names_every_field() -> None:
    assert list(Weather().to_dict()) == [field.name for field in fields(Weather)]
    assert Weather.from_dict({}) == Weather()


OLD_RECORD = (
    '{"rain_mm_per_h": 20.0, "snow_mm_per_h": 0.0, "visibility_m": null, "fog_scale_height_m": '
    'null, "mist_per_km": 2.0, "wetness": 1.0, "snow_cover": 0.0, "overcast": 1.0, "wind_m_per_s": '
    "[0.0, 6.0, 0.0]}"
)
"""Heavy rain as it was written before air had gusts."""


def test_an_older_record_is_read_with_nothing_new() -> None:
    plain = Weather.rain("heavy", gustiness=0, spray_per_km=0)
    assert Weather.from_json(OLD_RECORD) == plain


def test_a_weather_is_a_value() -> None:
    state = Weather.rain("heavy")
    with pytest.raises(FrozenInstanceError):
        state.wetness = 0.0  # type: ignore[misc]
    assert {state: 1}[Weather.rain(0.75)] == 1
    assert Weather(rain_mm_per_h=np.float32(2)) == Weather(rain_mm_per_h=2)


BAD_FIELDS: list[tuple[str, Any]] = [
    *((field.name, math.nan) for field in fields(Weather) if field.name != "wind_m_per_s"),
    *((field.name, "heavy") for field in fields(Weather) if field.name != "wind_m_per_s"),
    *((field.name, True) for field in fields(Weather) if field.name != "wind_m_per_s"),
    ("rain_mm_per_h", math.inf),
    ("rain_mm_per_h", -0.1),
    ("rain_mm_per_h", 401),
    ("rain_mm_per_h", None),
    ("rain_mm_per_h", 10**400),
    ("snow_mm_per_h", math.inf),
    ("snow_mm_per_h", 51),
    ("visibility_m", 0.9),
    ("visibility_m", -math.inf),
    ("fog_scale_height_m", 0.0),
    ("mist_per_km", 101),
    ("wetness", 1.01),
    ("snow_cover", -0.01),
    ("overcast", 2),
    ("gustiness", 1.01),
    ("snow_wetness", -0.01),
    ("fog_patchiness", 1.01),
    ("fog_puffs", 0.51),
    ("spray_per_km", 201),
    ("wind_m_per_s", (0, 0)),
    ("wind_m_per_s", 3.0),
    ("wind_m_per_s", "abc"),
    ("wind_m_per_s", (0, math.nan, 0)),
    ("wind_m_per_s", (0, math.inf, 0)),
    ("wind_m_per_s", (0, 61, 0)),
]


@pytest.mark.parametrize(("name", "value"), BAD_FIELDS, ids=lambda v: str(v)[:20])
def test_a_field_out_of_range_is_refused_by_name(name: str, value: Any) -> None:
    with pytest.raises(ArgumentError, match=name):
        Weather(**{name: value})
    with pytest.raises(ArgumentError, match=name):
        Weather.from_dict({name: math.nan if value is None else value})


@pytest.mark.parametrize("severity", [-0.01, 1.01, math.nan, math.inf, "hurricane", True, [0.5]])
@pytest.mark.parametrize("kind", FACTORY)
def test_a_severity_out_of_range_is_refused(kind: str, severity: Any) -> None:
    with pytest.raises(ArgumentError, match="severity"):
        FACTORY[kind](severity)


@pytest.mark.parametrize(
    ("kind", "unit_name", "value"),
    [
        ("rain", "mm_per_h", math.inf),
        ("rain", "mm_per_h", math.nan),
        ("rain", "mm_per_h", "25"),
        ("snow", "mm_per_h", -1),
        ("snow", "mm_per_h", 51),
        ("fog", "visibility_m", 0),
        ("fog", "visibility_m", math.nan),
    ],
)
def test_a_unit_out_of_range_is_refused(kind: str, unit_name: str, value: Any) -> None:
    with pytest.raises(ArgumentError, match=unit_name):
        FACTORY[kind](**{unit_name: value})


def test_either_a_severity_or_a_unit() -> None:
    for arguments in ({}, {"severity": 0.5, "mm_per_h": 3}):
        with pytest.raises(ArgumentError, match="either a severity or mm_per_h"):
            Weather.rain(**arguments)


def test_an_unknown_field_is_refused_by_name() -> None:
    for make in (lambda: Weather.rain(0.5, hail=1), lambda: Weather.from_dict({"hail": 1})):
        with pytest.raises(ArgumentError, match="no field hail"):
            make()
    with pytest.raises(ArgumentError, match="no field 1"):
        Weather.from_dict({1: 1, "hail": 2})  # type: ignore[dict-item]


@pytest.mark.parametrize("t", [-0.1, 1.1, math.nan, "half"])
def test_a_blend_outside_its_ends_is_refused(t: Any) -> None:
    with pytest.raises(ArgumentError, match="t must be"):
        Weather.blend(Weather(), Weather(), t)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        "3",
        '"rain"',
        '{"rain_mm_per_h": NaN}',
        "[" * 100_000,
        '{"visibility_m": "x"}',
    ],
    ids=lambda text: text[:20],
)
def test_text_that_is_no_weather_is_refused(text: str) -> None:
    with pytest.raises(ArgumentError):
        Weather.from_json(text)


def test_fog_that_comes_keeps_its_height() -> None:
    """Half-way from clear air the layer is thinner, not twice as high."""
    fog = Weather.fog(1.0)
    half = Weather.blend(Weather.clear(), fog, 0.5)
    assert half.fog_scale_height_m == pytest.approx(fog.fog_scale_height_m)
    assert half.fog_per_m == pytest.approx(0.5 * fog.fog_per_m)
