"""What a weather asks of the kernels: off by name, steady, and nothing for nothing."""

from dataclasses import fields, replace

import numpy as np
import pytest
from edit_scene import AMBIENCE
from hypothesis import given
from hypothesis import strategies as st

from weather_aug.colour import LUMINANCE
from weather_aug.edit.physical import look as module
from weather_aug.edit.physical.look import EXPOSURE_RANGE, Look, changes_background, look_of
from weather_aug.weather import Weather

ALL = Weather(
    rain_mm_per_h=5.0,
    wetness=0.8,
    puddles=0.2,
    snow_cover=0.6,
    road_snow_cover=0.4,
    snow_depth_m=0.1,
    overcast=0.7,
)
SHOWS = {
    "relight": {"flattening", "exposure"},
    "sky": {"sky"},
    "film": {"film", "exposure"},
    "mirror": {"mirror"},
    "puddles": {"puddles"},
    "ripples": {"ripples"},
    "snow_cover": {"snow", "road_snow", "snow_depth_m", "exposure"},
    "tracks": {"tracks"},
}
"""Effects, and what leaving one out changes."""
states = st.floats(0, 1)
weathers = st.builds(
    Weather,
    wetness=states,
    puddles=states,
    snow_cover=states,
    road_snow_cover=states,
    snow_depth_m=states,
    overcast=states,
    rain_mm_per_h=st.floats(0, 100),
)


def look(weather, without=(), illumination=0.3):
    return look_of(weather, AMBIENCE, illumination, 1.0, without)


def changed(one, other):
    pairs = zip(Look._fields, one, other, strict=True)
    return {name for name, before, after in pairs if before != after}


def check_left_out(effect, left_out=look):
    assert changed(look(ALL), left_out(ALL, (effect,))) == SHOWS[effect]


@pytest.mark.parametrize("effect", SHOWS)
def test_an_effect_left_out_changes_what_it_should_and_nothing_else(effect):
    check_left_out(effect)


def test_leaving_out_a_neighbour_is_found():
    with pytest.raises(AssertionError):
        check_left_out("film", lambda weather, without: look(weather, (*without, "mirror")))


def test_clear_weather_asks_for_nothing():
    clear = look(Weather())
    for name in ("sky", "flattening", "film", "mirror", "puddles", "snow", "road_snow"):
        assert getattr(clear, name) == 0
    assert clear.exposure == 1
    assert not changes_background(Weather())


@pytest.mark.parametrize("name", ["overcast", "wetness", "snow_cover", "road_snow_cover"])
def test_each_state_changes_the_background_until_all_of_it_is_left_out(name):
    weather = Weather(**{name: 0.3})
    assert changes_background(weather)
    off = {
        "overcast": ("relight", "sky"),
        "wetness": ("film", "mirror"),
        "snow_cover": ("snow_cover",),
        "road_snow_cover": ("snow_cover",),
    }[name]
    for kept in off:
        others = tuple(effect for effect in off if effect != kept)
        assert changes_background(weather, others)
    assert not changes_background(weather, off)


def test_what_is_only_in_the_air_leaves_the_background():
    air = Weather(rain_mm_per_h=30.0, snow_mm_per_h=2.0, visibility_m=200.0, spray_per_km=3.0)
    assert not changes_background(air)


@given(weathers, st.floats(0.05, 3.0))
def test_numbers_are_finite_single_and_in_range(weather, illumination):
    found = look(weather, (), illumination)
    assert all(isinstance(value, np.float32) and np.isfinite(value) for value in found)
    for name in ("sky", "flattening", "film", "mirror", "flooded", "puddles", "snow", "road_snow"):
        assert 0 <= getattr(found, name) <= 1
    assert 0.8 * EXPOSURE_RANGE[0] < found.exposure < 1.2 * EXPOSURE_RANGE[1]


def check_continuous(look_at):
    """A thousandth more of anything changes no number by more than a hundredth."""
    for base in (Weather(), ALL, Weather.snow("extreme"), Weather.rain("light")):
        for field in fields(Weather):
            value = getattr(base, field.name)
            if field.name in ("wetness", "puddles", "overcast") or "cover" in field.name:
                near = replace(base, **{field.name: value + (1e-3 if value < 0.5 else -1e-3)})
                assert np.abs(np.subtract(look_at(base), look_at(near))).max() < 0.01


def test_small_changes_stay_small():
    check_continuous(look)


def test_an_exposure_that_switches_is_found():
    def switching(weather):
        found = look(weather)
        gain = np.float32(1.1 if weather.overcast > 0 else 1.0)
        return found._replace(exposure=found.exposure * gain)

    with pytest.raises(AssertionError):
        check_continuous(switching)


def test_a_dark_street_is_exposed_longer_and_a_bright_one_is_not():
    weather = Weather(overcast=1.0)
    gains = [look(weather, (), light).exposure for light in (0.05, 0.3, 0.5, 3.0)]
    assert gains == sorted(gains, reverse=True)
    assert gains[0] == np.float32(EXPOSURE_RANGE[1])
    assert gains[-1] == np.float32(EXPOSURE_RANGE[0])


def test_rain_floods_a_road_more_than_what_it_leaves():
    wet = Weather(wetness=1.0)
    rain = [look(replace(wet, rain_mm_per_h=r)).flooded for r in (0, 1, 5, 20, 75, 400)]
    assert rain == sorted(rain)
    assert rain[0] == np.float32(module.FILM_FLOODED)
    assert rain[-1] == np.float32(module.FILM_FLOODED + module.RAIN_FLOODED)


def test_snow_is_no_brighter_than_the_sky():
    assert look(ALL).snow_light < AMBIENCE.airlight @ LUMINANCE
