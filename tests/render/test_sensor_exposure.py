"""Exposure and gain share the light that weather takes; noise follows the gain."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from weather_aug.errors import ArgumentError
from weather_aug.render import sensor
from weather_aug.render.sensor import (
    daylight_share,
    exposure_s_in,
    gain_noise,
    gain_of,
    quality_of,
)
from weather_aug.weather import Weather

KINDS = (Weather.rain, Weather.snow, Weather.fog)
SHOWER = Weather.rain("moderate")


@pytest.mark.parametrize("kind", KINDS)
def test_worse_weather_is_darker_and_noisier(kind):
    states = [kind(s) for s in np.linspace(0, 1, 81)]
    light = [daylight_share(w) for w in states]
    assert light[0] == 1.0
    assert all(a >= b > 0 for a, b in pairwise(light))
    for values in (
        [exposure_s_in(0.002, w) for w in states],
        [gain_of(w) for w in states],
        [gain_noise(w).middle_levels for w in states],
        [-quality_of(gain_noise(w)) for w in states],
    ):
        assert values == sorted(values)
        assert values[0] < values[-1]
    assert 0.8 <= gain_noise(kind("light")).middle_levels < 1.5
    assert 2.0 < gain_noise(kind("extreme")).middle_levels <= 3.2


def test_a_closed_deck_leaves_10_to_20_klx_of_100():
    assert 0.10 <= daylight_share(Weather(overcast=1.0)) <= 0.20


def test_snow_on_the_ground_brightens():
    deck = Weather(overcast=1.0)
    snowy = Weather(overcast=1.0, snow_cover=1.0, road_snow_cover=1.0)
    assert daylight_share(snowy) > 1.5 * daylight_share(deck)
    assert exposure_s_in(0.005, snowy) < exposure_s_in(0.005, deck)
    assert daylight_share(Weather(snow_cover=1.0, road_snow_cover=1.0)) == 1.0


@given(
    st.sampled_from(KINDS), st.floats(0, 1), st.floats(1e-5, 1.0), st.floats(0, 400), st.booleans()
)
def test_time_and_gain_together_make_up_for_the_light(kind, s, own_s, rain, closed):
    weather = Weather.mix(kind(s), Weather(rain_mm_per_h=rain, overcast=float(closed)))
    time_s = exposure_s_in(own_s, weather)
    assert own_s <= time_s <= max(own_s, 0.020)
    assert time_s <= 4 * own_s * (1 + 1e-12)
    gain, stretch, light = gain_of(weather, own_s), time_s / own_s, daylight_share(weather)
    assert 1.0 <= gain <= 4.0
    if gain < 4.0:
        assert gain * stretch * light == pytest.approx(1.0)
    else:
        assert gain * stretch * light <= 1.0 + 1e-9


def test_a_camera_that_cannot_wait_is_noisier():
    levels = [gain_noise(SHOWER, t).middle_levels for t in (0.005, 0.015, 0.019)]
    assert levels[0] < levels[1] < levels[2]


def test_a_bad_exposure_is_named():
    for value in (0.0, -1.0, 2.0, np.nan, "long"):
        with pytest.raises(ArgumentError, match="camera_exposure_s"):
            exposure_s_in(value, SHOWER)


def test_a_law_that_shares_no_light_is_seen(monkeypatch):
    """Planted: a longer exposure, and all the gain as well."""
    weather, own_s = SHOWER, 0.005
    product = gain_of(weather) * exposure_s_in(own_s, weather) / own_s * daylight_share(weather)
    assert product == pytest.approx(1.0)
    monkeypatch.setattr(sensor, "exposure_s_in", lambda own_s, weather: own_s)
    product = gain_of(weather) * exposure_s_in(own_s, weather) / own_s * daylight_share(weather)
    assert product > 1.5
