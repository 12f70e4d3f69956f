"""The air alone: transmittance, fog profile, contrast at the visibility, encoding."""

import numpy as np
import pytest
from air_only import AIR_ONLY
from oracles.reference_render import linear, optical_depth, rays, srgb
from render_scene import make_camera, make_frame
from scipy.integrate import quad

from weather_aug._rows import encode_row, survival
from weather_aug.colour import SRGB_LEVELS_LINEAR
from weather_aug.render.compose import render
from weather_aug.weather import Weather


def test_survival_is_the_exponential():
    depths = np.linspace(-8, 60, 20_001).astype(np.float32)
    actual = np.array([survival(x) for x in depths])
    np.testing.assert_allclose(np.exp(-depths.astype(float)), actual, rtol=5e-5, atol=1e-9)


def test_every_level_survives_decoding_and_encoding():
    levels = np.empty(256, np.uint8)
    encode_row(SRGB_LEVELS_LINEAR.astype(np.float32), levels)
    np.testing.assert_array_equal(np.arange(256), levels)


def test_encoding_is_srgb_to_a_tenth_of_a_level():
    """Before rounding: a level is wrong only within a tenth of the step between two levels."""
    light = np.linspace(0, 1, 100_001)
    levels = np.empty(light.shape, np.uint8)
    encode_row(light.astype(np.float32), levels)
    assert np.abs(levels - srgb(light)).max() < 0.6


@pytest.mark.parametrize("scale_height_m", [5.0, 25.0, 60.0, np.inf])
def test_height_fog_is_the_integral_along_the_ray(scale_height_m, ambience):
    """Against quadrature of the exponential profile, up, level and down."""
    camera = make_camera(width=60, height=40)
    weather = Weather(visibility_m=120.0, fog_scale_height_m=scale_height_m)
    depth_m = 30.0
    frame = make_frame(camera, 60, depth_m)
    shot = render(frame, weather, seed=0, ambience=ambience, options=AIR_ONLY)
    for v, u in ((0, 0), (19, 30), (39, 59), (10, 45)):
        x, y = rays(camera)[v, u]
        path, rise = depth_m * np.hypot(1, np.hypot(x, y)), -y * depth_m

        def extinction(s, rise=rise, path=path):
            return weather.fog_per_m * np.exp(-rise * s / path / scale_height_m)

        expected = np.exp(-quad(extinction, 0, path)[0])
        assert shot.transmittance[v, u] == pytest.approx(expected, rel=2e-4)


@pytest.mark.parametrize("scale_height_m", [1.0, 3.0, 10.0, 25.0])
def test_sky_above_height_fog_shines_through(scale_height_m, ambience):
    """A thin layer has a top: the optical depth of the sky is beta H over the sine of elevation."""
    camera = make_camera(width=60, height=40)
    weather = Weather(visibility_m=150.0, fog_scale_height_m=scale_height_m)
    frame = make_frame(camera, 200, np.inf)
    shot = render(frame, weather, seed=0, ambience=ambience, options=AIR_ONLY)
    x, y = rays(camera)[0, 30]
    sine = -y / np.sqrt(1 + x * x + y * y)
    path = min(1000 / sine, 20000)
    thinning = 1 - np.exp(-path * sine / scale_height_m)
    expected = np.exp(-weather.fog_per_m * scale_height_m / sine * thinning)
    assert shot.transmittance[0, 30] == pytest.approx(expected, rel=1e-3)


def test_air_matches_the_reference(ambience):
    rng = np.random.default_rng(3)
    camera = make_camera()
    depth = rng.uniform(1, 150, (96, 160)).astype(np.float32)
    depth[:30] = np.inf
    weather = Weather.mix(Weather.fog("heavy"), Weather(mist_per_km=3.0))
    frame = make_frame(camera, 90, depth)
    shot = render(frame, weather, seed=0, ambience=ambience, options=AIR_ONLY)
    expected = np.exp(
        -optical_depth(
            depth.astype(float),
            rays(camera),
            np.array([0, -1.0, 0]),
            weather.fog_per_m,
            1 / weather.fog_scale_height_m,
            weather.mist_per_km * 1e-3,
            0.0,
            np.zeros_like,
        )
    )
    np.testing.assert_allclose(expected, shot.transmittance, rtol=1e-3, atol=1e-7)  # float32


def test_fog_is_blended_in_linear_light(ambience):
    """Half the light of a grey surface and half of the airlight; gamma blending is far off."""
    camera = make_camera(width=21, height=21, focal_px=500.0)
    depth_m = 100.0
    weather = Weather(visibility_m=-np.log(0.05) * depth_m / np.log(2))
    frame = make_frame(camera, 30, depth_m)
    shot = render(frame, weather, seed=0, ambience=ambience, options=AIR_ONLY)
    expected = srgb(0.5 * linear(30) + 0.5 * ambience.airlight)
    assert np.abs(shot.image[10, 10] - expected).max() <= 1
    in_gamma = 0.5 * 30 + 0.5 * srgb(ambience.airlight)
    assert np.abs(shot.image[10, 10] - in_gamma).min() > 20


def test_fog_hides_far_before_near(ambience):
    camera = make_camera()
    depth = np.linspace(100, 3, 96, dtype=np.float32)[:, None]
    frame = make_frame(camera, 40, depth)
    shot = render(frame, Weather.fog("heavy"), seed=0, ambience=ambience, options=AIR_ONLY)
    assert shot.transmittance[-1].min() > 0.9
    assert shot.transmittance[0].max() < 0.25
    to_airlight = np.abs(shot.image[0].astype(float) - srgb(ambience.airlight)).max()
    assert to_airlight < 25
    assert np.abs(shot.image[-1].astype(int) - 40).max() < 45
