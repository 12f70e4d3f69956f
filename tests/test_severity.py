"""Severity: one scale for all weather, and what each point on it means in units."""

from __future__ import annotations

import itertools
import math
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from weather_aug import severity as stops
from weather_aug.errors import ArgumentError
from weather_aug.severity import (
    NAMED_SEVERITIES,
    fog_severity,
    parse_severity,
    rain_severity,
    snow_severity,
    visibility_from_severity,
)
from weather_aug.weather import Weather

GRID = [i / 100 for i in range(101)]
STOPS = [0.25, 0.5, 0.75, 1.0]
FACTORY = {"rain": Weather.rain, "snow": Weather.snow, "fog": Weather.fog}

TABLE = {
    ("rain", "rain_mm_per_h"): (1.5, 5, 20, 75),
    ("rain", "mist_per_km"): (0.2, 0.6, 2.0, 5.0),
    ("rain", "spray_per_km"): (0.5, 2, 10, 25),
    ("rain", "overcast"): (0.35, 0.8, 1, 1),
    ("rain", "gustiness"): (0.3, 0.3, 0.3, 0.3),
    ("rain", "wetness"): (0.5, 0.8, 1, 1),
    ("rain", "puddles"): (0.02, 0.06, 0.15, 0.3),
    ("rain", "lamps"): (0.3, 0.7, 1, 1),
    ("rain", "lens_drops"): (3, 10, 30, 80),
    ("rain", "wipers"): (0.2, 0.5, 0.8, 1),
    ("snow", "snow_mm_per_h"): (0.4, 1, 2, 4),
    ("snow", "mist_per_km"): (0.3, 0.8, 2, 5),
    ("snow", "overcast"): (0.35, 0.8, 1, 1),
    ("snow", "gustiness"): (0.25, 0.25, 0.25, 0.25),
    ("snow", "wetness"): (0.4, 0.6, 0.7, 0.7),
    ("snow", "snow_cover"): (0.1, 0.6, 0.9, 1),
    ("snow", "road_snow_cover"): (0.02, 0.2, 0.5, 0.9),
    ("snow", "snow_depth_m"): (0.01, 0.03, 0.08, 0.2),
    ("snow", "lamps"): (0.3, 0.7, 1, 1),
    ("snow", "lens_drops"): (1, 2, 5, 10),
    ("snow", "wipers"): (0.1, 0.2, 0.4, 0.6),
    ("fog", "fog_per_m"): (0.005, 0.01, 0.02, 0.06),
    ("fog", "overcast"): (0.35, 0.8, 1, 1),
    ("fog", "wetness"): (0.1, 0.2, 0.3, 0.4),
    ("fog", "lamps"): (0.5, 0.8, 1, 1),
}
"""Documented values at light, moderate, heavy, extreme."""

POWER_BELOW = {("fog", "fog_per_m"): 1}


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


RISING = [quantity for quantity, values in TABLE.items() if len(set(values)) == 4]


@pytest.mark.parametrize(("kind", "name"), RISING)
def test_units_rise_strictly_with_severity(kind: str, name: str) -> None:
    values = [getattr(FACTORY[kind](s), name) for s in GRID]
    assert all(a < b for a, b in itertools.pairwise(values))


SHRINKING = ("visibility_m", "fog_scale_height_m")


@pytest.mark.parametrize("kind", FACTORY)
def test_nothing_falls_with_severity(kind: str) -> None:
    """All that weather is made of stays or rises, the strength of its wind too; ranges shrink."""
    states = [FACTORY[kind](s) for s in GRID]
    for name in {field.name for field in fields(Weather)} - {"wind_m_per_s", *SHRINKING}:
        values = [getattr(state, name) for state in states]
        assert all(a <= b for a, b in itertools.pairwise(values)), name
    speeds = [math.hypot(*state.wind_m_per_s) for state in states]
    assert all(a <= b for a, b in itertools.pairwise(speeds))
    for name in SHRINKING:
        values = [getattr(state, name) for state in states]
        assert all(a >= b for a, b in itertools.pairwise(values)), name


def test_a_table_that_dips_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(stops.SNOW, "snow_depth_m", stops.Stops((0.01, 0.03, 0.02, 0.2)))
    with pytest.raises(AssertionError, match="snow_depth_m"):
        test_nothing_falls_with_severity("snow")


@pytest.mark.parametrize("kind", FACTORY)
def test_a_severity_brings_what_is_documented_and_nothing_else(kind: str) -> None:
    """Every field is in the table of its kind, is the wind, or is as in clear weather."""
    state, clear = FACTORY[kind]("extreme"), Weather()
    listed = {name for of, name in TABLE if of == kind} | {"wind_m_per_s", *SHRINKING}
    for field in fields(Weather):
        if field.name not in listed:
            assert getattr(state, field.name) == getattr(clear, field.name), field.name


@pytest.mark.parametrize("s", GRID[1:])
def test_snow_wets_the_ground_and_covers_the_verge_before_the_road(s: float) -> None:
    snow = Weather.snow(s)
    assert snow.wetness > 0
    assert snow.road_snow_cover < snow.snow_cover


def test_what_ends_with_the_fall_is_in_the_air_or_on_the_glass() -> None:
    in_the_air = {"rain_mm_per_h", "snow_mm_per_h", "mist_per_km", "spray_per_km"}
    assert set(stops.FALLING) == in_the_air | {"lens_drops", "wipers"}
    assert set(stops.FALLING) <= {field.name for field in fields(Weather)}


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


@given(st.floats(0.01, 1))
def test_a_unit_brings_what_its_severity_brings(s: float) -> None:
    given_in_units = Weather.rain(mm_per_h=Weather.rain(s).rain_mm_per_h)
    for name in {name for kind, name in TABLE if kind == "rain"}:
        assert _close(getattr(Weather.rain(s), name), getattr(given_in_units, name), 1e-8)


def test_named_severities() -> None:
    assert NAMED_SEVERITIES == {"light": 0.25, "moderate": 0.5, "heavy": 0.75, "extreme": 1.0}
    for name, s in NAMED_SEVERITIES.items():
        assert parse_severity(name) == s
        for factory in FACTORY.values():
            assert factory(name) == factory(s)


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


README_ROWS = {
    "rain, mm/h": [("rain", "rain_mm_per_h")],
    "snow, mm/h of water": [("snow", "snow_mm_per_h")],
    "wetness of the road in rain": [("rain", "wetness")],
    "snow cover beside the road · on it": [("snow", "snow_cover"), ("snow", "road_snow_cover")],
    "drops on the glass in rain": [("rain", "lens_drops")],
}


@pytest.mark.parametrize("row", README_ROWS)
def test_the_readme_says_what_the_stops_are(row: str) -> None:
    text = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
    (line,) = [line for line in text.splitlines() if line.startswith(f"| {row} |")]
    cells = [[float(value) for value in cell.split("·")] for cell in line.split("|")[2:-1]]
    for column, (kind, name) in enumerate(README_ROWS[row]):
        table = {"rain": stops.RAIN, "snow": stops.SNOW}[kind]
        assert tuple(cell[column] for cell in cells) == table[name].values
