"""Long exposures from fast and turning cameras: nothing gained, nothing lost, no window apart."""

from dataclasses import replace

import numpy as np
import pytest
from air_only import AIR_ONLY, air_only
from render_scene import make_camera, make_frame

from weather_aug.air import Air
from weather_aug.particles import field as fields
from weather_aug.particles import resolve as resolving
from weather_aug.particles import statistics
from weather_aug.particles.field import ParticleField
from weather_aug.particles.resolve import NEAR_M
from weather_aug.render.compose import render
from weather_aug.weather import Weather

SNOW = Weather(snow_mm_per_h=4.0)
MOTIONS = {
    "motorway at night": (33.0, 0.0, 0.05),
    "faster": (33.0, 0.0, 0.1),
    "turning": (0.0, 2.0, 0.1),
    "turning fast": (5.0, 6.0, 0.02),
}


def moving(name, width=480, height=270):
    speed, turning, exposure_s = MOTIONS[name]
    return make_camera(
        width,
        height,
        600.0,
        velocity=(speed, 0.0, 0.0),
        exposure_s=exposure_s,
        angular_velocity_rad_per_s=np.array([0.0, turning, 0.0]),
    )


@pytest.mark.parametrize("name", MOTIONS)
def test_drawn_and_veil_are_the_whole(name, ambience):
    frame = make_frame(moving(name), 60, 20.0)
    logs = [
        np.log(render(frame, SNOW, seed=1, ambience=ambience, options=options).transmittance.mean())
        for options in (AIR_ONLY, air_only(0))
    ]
    assert logs[0] == pytest.approx(logs[1], rel=0.03)


def test_streaks_of_any_length_would_cover_the_picture(ambience, monkeypatch):
    """The planted fault: particles beside and behind the lens sweep into the picture."""
    monkeypatch.setattr(resolving, "NEAR_SWEEPS", 0.0)
    monkeypatch.setattr(fields, "BEYOND_PICTURE", 50.0)
    resolving._resolved.cache_clear()
    with pytest.raises(AssertionError):
        test_drawn_and_veil_are_the_whole("faster", ambience)
    resolving._resolved.cache_clear()


@pytest.mark.parametrize("name", MOTIONS)
def test_a_window_is_a_part_of_the_whole(name, ambience):
    frame = make_frame(moving(name, 200, 120), 60, 20.0)
    whole = render(frame, SNOW, seed=1, ambience=ambience)
    for top, left, height, width in ((0, 0, 40, 60), (70, 130, 50, 70), (50, 90, 3, 5)):
        part = render(frame, SNOW, seed=1, ambience=ambience, window=(top, left, height, width))
        rows, columns = slice(top, top + height), slice(left, left + width)
        np.testing.assert_array_equal(whole.image[rows, columns], part.image)
        np.testing.assert_array_equal(whole.transmittance[rows, columns], part.transmittance)


def test_the_near_limit_moves_away_from_a_fast_camera():
    field = ParticleField(statistics.snow(2.0), 1, Air((0, 0, 0), (0, 0, 0)), np.eye(3))
    assert field.resolve(make_camera(velocity=(10.0, 0, 0), exposure_s=0.005), 100).near_m == NEAR_M
    fast = field.resolve(make_camera(velocity=(30.0, 0, 0), exposure_s=0.05), 100)
    assert fast.near_m == pytest.approx(2.25, rel=1e-3)


def test_reach_changes_without_leaps_as_the_camera_speeds_up():
    """Dense snow of flakes wider than a pixel: the budget's worth changes little by little."""
    population = statistics.snow(4.0)
    field = ParticleField(population, 1, Air((0, 4, 0), (0, 0, 0)), np.eye(3))
    camera = make_camera(1920, 1280, 2060.0, exposure_s=0.01)
    reaches = []
    for speed in np.arange(18.0, 19.5, 0.05):
        faster = replace(camera, velocity_m_per_s=np.array([speed, 0.0, 0.0]))
        reaches.append(field.resolve(faster, 20_000).reach_m.astype(float))
    steps = np.abs(np.diff(reaches, axis=0)).max()
    assert 0 < steps < 0.5


@pytest.mark.parametrize(("level", "unseen"), [(166, True), (60, False)])
def test_the_published_look_hides_what_is_as_grey_as_it(level, unseen, ambience):
    camera = make_camera(160, 96)
    frame = make_frame(camera, level, 30.0, np.zeros((96, 160), np.uint8))
    options = air_only(preset="weatheredit")
    shot = render(frame, Weather.fog("heavy"), seed=1, ambience=ambience, options=options)
    hazy = shot.transmittance < 0.3
    assert hazy.mean() > 0.5
    middle = hazy & (shot.transmittance > 0.1)
    assert (shot.label[middle] == 255).mean() == pytest.approx(float(unseen), abs=0.1)
