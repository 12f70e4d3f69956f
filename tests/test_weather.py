"""Weather: one severity scale, physical units, and nothing that is not a weather."""

from __future__ import annotations

import json
import math
from dataclasses import FrozenInstanceError, fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from weather_aug.errors import ArgumentError
from weather_aug.severity import FALLING
from weather_aug.weather import Weather, shape_ends

GRID = [i / 100 for i in range(101)]
FACTORY = {"rain": Weather.rain, "snow": Weather.snow, "fog": Weather.fog}

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
    puddles=unit,
    snow_cover=unit,
    road_snow_cover=unit,
    snow_depth_m=st.floats(0, 2),
    overcast=unit,
    wind_m_per_s=st.tuples(wind, wind, wind),
    gustiness=unit,
    snow_wetness=unit,
    fog_patchiness=unit,
    fog_puffs=st.floats(0, 0.5),
    spray_per_km=st.floats(0, 200),
    lamps=unit,
    lens_drops=st.floats(0, 500),
    wipers=unit,
)
THING = {
    "snow_wetness": {"snow_mm_per_h": 1.0},
    "fog_patchiness": {"visibility_m": 200.0},
    "fog_puffs": {"visibility_m": 200.0},
}
"""What each field shapes."""
UNSEEN = {"wind_m_per_s", "gustiness", "fog_scale_height_m", *THING}
"""What cannot be seen alone."""


@pytest.mark.parametrize("kind", FACTORY)
def test_severity_zero_is_clear(kind: str) -> None:
    assert FACTORY[kind](0.0) == Weather.clear() == Weather()
    assert FACTORY[kind](0.0).is_clear
    assert not FACTORY[kind](0.01).is_clear


def test_wind_alone_and_a_height_without_fog_are_clear() -> None:
    assert Weather(wind_m_per_s=(3, 2, 1), gustiness=1, fog_scale_height_m=50).is_clear
    assert Weather(snow_wetness=1, fog_patchiness=1, fog_puffs=0.5).is_clear
    seen = {field.name for field in fields(Weather)} - UNSEEN
    for name in seen - {"visibility_m"}:
        assert not Weather(**{name: 0.1}).is_clear, name
    assert not Weather(visibility_m=1000).is_clear


def test_beyond_extreme_the_severity_is_cut_and_the_unit_kept() -> None:
    flood = Weather.rain(mm_per_h=300)
    assert flood.rain_mm_per_h == 300
    assert flood == replace(Weather.rain("extreme"), rain_mm_per_h=300)
    assert Weather.fog(visibility_m=2).visibility_m == 2


def test_overrides_replace_what_comes_with_the_weather() -> None:
    state = Weather.rain("heavy", wetness=0.1, wind_m_per_s=(3, 0, 0))
    assert state == replace(Weather.rain("heavy"), wetness=0.1, wind_m_per_s=(3.0, 0.0, 0.0))


LEFT = {"rain": ("puddles",), "snow": ("snow_cover", "road_snow_cover", "snow_depth_m")}
"""What rain and snow leave on the ground."""


@pytest.mark.parametrize("kind", ["rain", "snow"])
def test_not_falling_leaves_the_ground_and_the_sky(kind: str) -> None:
    falls, fell = FACTORY[kind]("heavy"), FACTORY[kind]("heavy", falling=False)
    assert fell == replace(falls, **dict.fromkeys(FALLING, 0.0))
    left = ("overcast", "wetness", "lamps", *LEFT[kind])
    assert all(getattr(fell, name) == getattr(falls, name) > 0 for name in left)
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
        slack = 1e-300 + 1e-12 * max(abs(start), abs(end))
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
    dripping = Weather.mix(Weather(lens_drops=30), Weather(lens_drops=5))
    assert dripping.lens_drops == 35
    assert Weather.mix(dripping, Weather(lens_drops=490)).lens_drops == 500


@pytest.mark.parametrize("name", ["wetness", "puddles", "snow_cover", "road_snow_cover"])
def test_a_mixed_share_is_what_either_leaves(name: str) -> None:
    mixed = Weather.mix(Weather(**{name: 0.5}), Weather(**{name: 0.4}))
    assert getattr(mixed, name) == pytest.approx(0.7)


@pytest.mark.parametrize("name", ["overcast", "snow_depth_m", "lamps", "wipers"])
def test_a_mixed_cause_is_shared(name: str) -> None:
    """One sky, one blanket of snow, one reason to switch on lamps: the larger of the two."""
    mixed = Weather.mix(Weather(**{name: 0.5}), Weather(**{name: 0.4}))
    assert getattr(mixed, name) == 0.5


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
OLD_FIELDS = {
    *("rain_mm_per_h", "snow_mm_per_h", "visibility_m", "fog_scale_height_m", "mist_per_km"),
    *("wetness", "snow_cover", "overcast", "wind_m_per_s"),
}


def test_an_older_record_is_read_with_nothing_new() -> None:
    new = {field.name: field.default for field in fields(Weather) if field.name not in OLD_FIELDS}
    assert set(json.loads(OLD_RECORD)) == OLD_FIELDS
    assert Weather.from_json(OLD_RECORD) == Weather.rain("heavy", **new)
    assert not any(new.values())


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
    ("puddles", 1.01),
    ("snow_cover", -0.01),
    ("road_snow_cover", 1.01),
    ("snow_depth_m", 2.01),
    ("overcast", 2),
    ("gustiness", 1.01),
    ("snow_wetness", -0.01),
    ("fog_patchiness", 1.01),
    ("fog_puffs", 0.51),
    ("spray_per_km", 201),
    ("lamps", -0.01),
    ("lens_drops", 501),
    ("wipers", 1.01),
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
