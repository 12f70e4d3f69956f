"""Checks 9 and 10: particles move as they say, and the paper's mode is ours for a parked car."""

from dataclasses import replace

import numpy as np
import pytest
from air_only import air_only
from oracles import faults
from particles.particle_scene import AXES, camera, inside, whole
from physics_scene import measured
from render_scene import make_frame
from scipy.spatial import cKDTree

from weather_aug.air import air_of
from weather_aug.particles import statistics
from weather_aug.particles.field import ParticleField
from weather_aug.render.compose import render
from weather_aug.render.fields import RigMotion
from weather_aug.weather import Weather

GUSTY = Weather(rain_mm_per_h=20.0, snow_mm_per_h=2.0, wind_m_per_s=(1.0, 3.0, 0.0), gustiness=0.3)
WETTER = replace(GUSTY, snow_wetness=0.5)
POPULATIONS = {
    "rain": (GUSTY, statistics.rain(20.0)),
    "snow": (GUSTY, statistics.snow(2.0)),
    "wet snow": (WETTER, statistics.snow(2.0, wetness=0.5)),
}


def held_still(population):
    """Without its sways, whose sines are looked up in a table of 1024."""
    none = np.zeros_like(population.sway_m)
    return replace(population, sway_m=none, sway_per_wind_s=none)


def records_at(weather, population, time_s, air=air_of):
    """Resolved particles of a parked camera in gusty air; one reach for all times."""
    cam = camera()
    this = ParticleField(population, 1, air(weather, time_s, 1), AXES)
    resolved = this.resolve(cam, 20_000)
    resolved = replace(resolved, reach_m=np.full_like(resolved.reach_m, 5.0))
    return cam, this.particles(cam, time_s, resolved, whole(cam))


def check_continuity(weather, population, at=records_at, *, swaying=True):
    """P(t + dt) - P(t) = D dt for every particle inside the view: no wrap, no birth, no loss."""
    tolerance_m = 2e-5
    if swaying:
        # A step of the sines' table is 0.6 % of a turn.
        tolerance_m += 0.01 * (population.sway_m + 5 * population.sway_per_wind_s).max()
    step_s, worst = 0.002, 0.0
    for time_s in (0.0, 1.3, 5.0, 37.2, 500.0):
        cam, before = at(weather, population, time_s)
        _, after = at(weather, population, time_s + step_s)
        stays = inside(before, cam) & (before[:, 2] > 1) & (before[:, 2] < 4.8)
        middle = np.abs(before[:, 0] / before[:, 2]) < 0.6
        middle &= np.abs(before[:, 1] / before[:, 2]) < 0.35
        stays &= middle
        moved = before[stays, :3].astype(float) + step_s * before[stays, 3:6]
        off = cKDTree(after[:, :3].astype(float)).query(moved)[0].max()
        assert stays.sum() > 100
        worst = max(worst, off)
        assert off < tolerance_m
    measured(f"9: {len(before)} particles, off by {worst:.1e} m of {tolerance_m:.1e}")


@pytest.mark.parametrize("swaying", [False, True])
@pytest.mark.parametrize("kind", POPULATIONS)
def test_9_continuity(kind, swaying):
    weather, population = POPULATIONS[kind]
    check_continuity(weather, population if swaying else held_still(population), swaying=swaying)


@pytest.mark.parametrize("kind", POPULATIONS)
def test_9_wraps_in_view_are_found_out(kind):
    """A box of the paper's kind that the camera looks into."""
    weather, population = POPULATIONS[kind]
    population = held_still(population)
    with pytest.raises(AssertionError):
        check_continuity(weather, population, faults.wrapped(records_at), swaying=False)


@pytest.mark.parametrize("kind", POPULATIONS)
def test_9_the_wind_of_now_times_the_time_is_found_out(kind):
    """Gusts: the drift is the integral of the wind; wind times time leaps with each gust."""
    weather, population = POPULATIONS[kind]

    def leaping(weather, population, time_s):
        return records_at(weather, population, time_s, faults.air_of_wind_times_time)

    with pytest.raises(AssertionError):
        check_continuity(weather, held_still(population), leaping, swaying=False)


def test_9_wetness_that_is_forgotten_is_found_out():
    """Wet flakes fall faster than the drift of dry ones."""
    population = held_still(statistics.snow(2.0, wetness=0.5))
    with pytest.raises(AssertionError):
        check_continuity(GUSTY, population, swaying=False)


TIME_S = 2.0
PARKED = camera(yaw_deg=25, centre=(8.0, -3.0, 1.5))
DRIVEN = camera(
    yaw_deg=70,
    centre=(19.0, 4.0, 1.6),
    velocity_m_per_s=np.array([3.0, 6.0, 0.0]),
    angular_velocity_rad_per_s=np.array([0.0, 0.3, 0.0]),
)


def places(population, cam, motion):
    air = air_of(GUSTY, TIME_S, 1)
    this = ParticleField(population, 1, air, AXES, motion)
    # What a parked camera resolves: the paper's particles know of no ego motion.
    resolved = ParticleField(population, 1, air, AXES).resolve(PARKED, 20_000)
    return this.particles(cam, TIME_S, resolved, whole(cam))


def ours(world_from_first, world_from_now):
    return RigMotion(world_from_first, world_from_now).field_from_world


def check_parked_modes_agree(motion_of, ambience):
    """v_cam = 0 and omega = 0: modes W and C are identical to 1e-6, and so are the pictures."""
    pose = PARKED.world_from_camera
    for population in (statistics.rain(20.0), statistics.snow(2.0)):
        plain = places(population, PARKED, None)
        carried = places(population, PARKED, motion_of(pose, pose))
        assert plain.shape == carried.shape
        measured(f"10: parked off by {np.abs(plain - carried).max():.1e}")
        assert np.abs(plain - carried).max() <= 1e-6
    frame = make_frame(PARKED, 60, 20.0, time_s=TIME_S)
    shots = [
        render(
            frame,
            GUSTY,
            seed=1,
            ambience=ambience,
            options=air_only(alignment=alignment),
            rig=RigMotion(pose, pose),
        )
        for alignment in ("world", "camera")
    ]
    worst = np.abs(shots[0].transmittance - shots[1].transmittance).max()
    measured(f"10: pictures off by {worst:.1e}")
    assert worst <= 1e-5


def check_driven_sees_parked(motion_of):
    """Mode C: in camera axes a driven camera's particles are those of the parked one, 1e-5 m."""
    motion = motion_of(PARKED.world_from_camera, DRIVEN.world_from_camera)
    for population in (statistics.rain(20.0), statistics.snow(2.0)):
        parked = places(population, PARKED, None)
        parked = parked[inside(parked, PARKED)].astype(float)
        driven = places(population, DRIVEN, motion).astype(float)
        off = cKDTree(driven[:, :3]).query(parked[:, :3])[0]
        measured(f"10: {len(parked)} carried off by {off.max():.1e} m")
        assert off.max() < 1e-5


def test_10_paper_mode(ambience):
    check_parked_modes_agree(ours, ambience)
    check_driven_sees_parked(ours)


def test_10_a_wrong_alignment_is_found_out(ambience):
    with pytest.raises(AssertionError):
        check_parked_modes_agree(faults.pose_of_now, ambience)
    with pytest.raises(AssertionError):
        check_driven_sees_parked(faults.turned_about_the_origin)
    with pytest.raises(AssertionError):
        check_driven_sees_parked(lambda first, now: np.linalg.inv(ours(first, now)))
