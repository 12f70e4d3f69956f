"""Spray behind vehicles: which puffs there are, where, and how dense they look."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from render_scene import make_camera

from weather_aug.air import Air
from weather_aug.edit.physical.vehicles import Vehicle
from weather_aug.errors import ArgumentError
from weather_aug.particles.field import COVARIANCE, OPACITY, VELOCITY
from weather_aug.render import spray
from weather_aug.render.fields import _projected
from weather_aug.render.spray import spray_colour, spray_particles, spray_strength
from weather_aug.render.stage import medium_of, optics_of
from weather_aug.weather import Weather

STILL = Air((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
AXES = np.eye(3)


def vehicle(speed=20.0, ahead=25.0, *, kind="car", parked=False, key=7):
    heading = np.array([1.0, 0.0, 0.0])
    size = {"car": (4.4, 1.8, 1.5), "truck": (7.5, 2.4, 3.2)}[kind]
    return Vehicle(kind, np.array([ahead, 0.0, 0.0]), heading, size, speed * heading, parked, key)


def puffs(*vehicles, time_s=3.0, camera=None, wetness=1.0, air=STILL, seed=0):
    camera = camera or make_camera()
    return spray_particles(
        vehicles, camera, time_s, wetness=wetness, air=air, axes_world=AXES, seed=seed
    )


def in_world(records, camera):
    return records[:, :3] @ camera.world_from_camera[:3, :3].T + camera.centre_world


def covariance_of(record):
    matrix = np.empty((3, 3))
    matrix[np.triu_indices(3)] = record[COVARIANCE:OPACITY]
    return np.triu(matrix) + np.triu(matrix, 1).T


@pytest.mark.parametrize("wetness", [0.0, 1e-9, 0.5, 1.0])
def test_a_dry_road_a_slow_or_a_parked_car_gives_none(wetness):
    assert spray_strength(vehicle(5.0), wetness) == 0
    assert spray_strength(vehicle(parked=True), wetness) == 0
    assert spray_strength(vehicle(15.0), wetness) == pytest.approx(0.75 * wetness)
    assert spray_strength(vehicle(30.0, kind="truck"), wetness) == pytest.approx(1.5 * wetness)
    assert puffs(vehicle(), wetness=0.0).shape == puffs(vehicle(4.0)).shape == (0, 13)
    assert puffs(vehicle(parked=True)).shape == puffs().shape == (0, 13)


@given(a=st.floats(0, 40), b=st.floats(0, 40))
def test_faster_sprays_more(a, b):
    low, high = sorted((a, b))
    assert spray_strength(vehicle(low), 1.0) <= spray_strength(vehicle(high), 1.0) <= 1.5


def plume_depth(car, time_s, seed):
    """Largest optical depth along the plume, on a grid across it, m."""
    records = puffs(car, time_s=time_s, seed=seed).astype(np.float64)
    # Camera axes: x to the right, y down; the plume is along z.
    x, y = np.meshgrid(np.linspace(-1.5, 1.5, 13), np.linspace(0.2, 1.6, 15))
    total = np.zeros_like(x)
    for record in records:
        across = covariance_of(record)[:2, :2]
        offset = np.stack([x - record[0], y - record[1]], axis=-1)
        power = np.einsum("...i,ij,...j", offset, np.linalg.inv(across), offset)
        total += -np.log1p(-record[OPACITY]) * np.exp(-0.5 * power)
    return total.max()


def test_the_whole_plume_has_the_depth_that_was_asked_for():
    # From far behind, where rays run along the plume.
    depths = [plume_depth(vehicle(20.0, 300.0), t, seed) for seed in range(3) for t in (1.0, 4.37)]
    # Puffs are shed up to 0.35 of the width aside, so no ray meets the middle of all.
    assert 0.55 * 0.75 < np.mean(depths) < 1.05 * 0.75
    assert np.std(depths) < 0.12


def mean_length_s(records, car):
    """Mean way from the rear, weighted by what a puff hides, over the speed."""
    behind = car.centre_world[0] - 2.2 - in_world(records, make_camera())[:, 0]
    section = np.array(
        [
            -math.log1p(-r[OPACITY]) * np.sqrt(np.linalg.det(covariance_of(r)[:2, :2]))
            for r in records
        ]
    )
    return float((behind * section).sum() / section.sum() / 20.0)


def test_a_plume_is_as_long_as_the_car_drives_in_less_than_half_a_second(monkeypatch):
    car = vehicle(20.0, 300.0)
    # An exponential plume's mean lag is its length; the wake shortens it.
    assert 0.15 < mean_length_s(puffs(car), car) < 0.32
    heights = in_world(puffs(car), make_camera())[:, 2]
    assert 0.3 < heights.min() and heights.max() < 0.9
    monkeypatch.setattr(spray, "THINNING_S", 100.0)
    assert mean_length_s(puffs(car), car) > 0.36


def moved_on(car, by_s):
    return replace(car, centre_world=car.centre_world + by_s * car.velocity_m_per_s)


def same_puffs(step_s):
    """Whether the puffs of a later moment are those of an earlier one, each moved on."""
    camera, car = make_camera(), vehicle(20.0, 60.0)
    first = puffs(car, time_s=3.01, camera=camera)
    later = puffs(moved_on(car, step_s), time_s=3.01 + step_s, camera=camera)
    places = in_world(first, camera) + step_s * first[:, VELOCITY:COVARIANCE] @ (
        camera.world_from_camera[:3, :3].T
    )
    # All but the oldest of the first, which have gone, and the newest of the second.
    shed = round(step_s / spray.EMISSION_S)
    kept, there = places[shed:], in_world(later, camera)[: len(places) - shed]
    return len(kept) > 15 and bool(np.abs(kept - there).max() < 0.15)


def test_puffs_stay_themselves_from_frame_to_frame(monkeypatch):
    assert same_puffs(0.05)
    drawn = spray._draws
    # A fault: numbered from the newest one, so that each takes over its neighbour's place.
    monkeypatch.setattr(spray, "_draws", lambda key, first, count: drawn(key, 0, count))
    assert not same_puffs(0.05)


def test_any_moment_alone_gives_the_same_bytes():
    car = vehicle()
    alone = puffs(car, time_s=7.77)
    for time_s in (7.7, 0.0, 1e6):
        puffs(car, time_s=time_s)
    assert puffs(car, time_s=7.77).tobytes() == alone.tobytes()
    assert puffs(car, vehicle(key=8), time_s=7.77)[: len(alone)].tobytes() == alone.tobytes()
    assert puffs(car, time_s=7.77, seed=1).tobytes() != alone.tobytes()
    assert puffs(vehicle(key=8), time_s=7.77).tobytes() != alone.tobytes()


def test_two_cameras_see_the_same_puffs():
    front = make_camera()
    pose = front.world_from_camera.copy()
    c, s = math.cos(0.3), math.sin(0.3)
    pose[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ pose[:3, :3]
    turned = replace(front, world_from_camera=pose)
    a, b = puffs(vehicle(), camera=front), puffs(vehicle(), camera=turned)
    np.testing.assert_allclose(in_world(a, front), in_world(b, turned), atol=1e-4)
    np.testing.assert_allclose(a[:, OPACITY], b[:, OPACITY], rtol=1e-3)


@pytest.mark.parametrize("yaw_rad", [0.0, 0.4])
def test_a_puff_is_as_dense_as_a_ray_through_it_finds(yaw_rad):
    camera, car = make_camera(), vehicle(20.0, 40.0)
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    pose = camera.world_from_camera.copy()
    pose[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ pose[:3, :3]
    pose[:3, 3] = (5.0, -12.0, 4.0)
    camera = replace(camera, world_from_camera=pose)
    plume = spray._plume(car, 3.01, 1.0, np.zeros(3), AXES[2], 0)
    records = spray._records(plume, camera)
    assert len(records) == len(plume.position)
    for n in (0, 10, 23):
        ray = plume.position[n] - camera.centre_world
        ray = ray / np.linalg.norm(ray)
        steps = np.linspace(-12, 12, 4001)[:, None] * ray
        inverse = np.linalg.inv(plume.covariance[n])
        density = np.exp(-0.5 * np.einsum("ni,ij,nj->n", steps, inverse, steps))
        density *= np.sqrt(np.linalg.det(inverse) / (2 * np.pi) ** 3)
        tau = plume.section_m2[n] * density.sum() * (24 / 4000)
        assert records[n, OPACITY] == pytest.approx(1 - math.exp(-tau), rel=1e-4)


@pytest.mark.parametrize("time_s", [1.7, 3.4, 3.9])
def test_a_puff_that_is_shed_at_this_very_moment_has_a_size(time_s):
    assert math.floor(time_s / spray.EMISSION_S) * spray.EMISSION_S > time_s
    plume = spray._plume(vehicle(), time_s, 1.0, np.zeros(3), AXES[2], 0)
    assert np.isfinite(plume.covariance).all()


def test_the_wind_blows_old_puffs_aside():
    camera = make_camera()
    windy = Air((0.0, 6.0, 0.0), (0.0, 18.0, 0.0))
    shift = in_world(puffs(vehicle(), air=windy), camera) - in_world(puffs(vehicle()), camera)
    # Records go from the oldest to the newest.
    assert (np.diff(shift[:, 1]) < 0).all()
    assert 3.0 < shift[0, 1] < 7.2 and shift[-1, 1] < 0.1


def test_spray_is_between_the_sky_and_the_road(ambience):
    colour = spray_colour(ambience)
    assert ((ambience.ground < colour) & (colour < ambience.airlight)).all()


def test_the_projection_takes_the_puffs(ambience):
    camera = make_camera(320, 192, velocity=(20.0, 0, 0))
    records = puffs(vehicle(20.0, 22.0), camera=camera)
    assert records.dtype == np.float32 and np.isfinite(records).all()
    # Who drives with the camera is blurred by what the puff lags behind alone.
    assert (records[:, VELOCITY + 2] < 0).all()
    splats = _projected(
        [records],
        [spray_colour(ambience)],
        optics_of(camera, AXES[2]),
        medium_of(Weather.rain("heavy"), (), ambience),
        np.zeros(257, np.float32),
        ambience.airlight,
        (0, 0, 192, 320),
        True,
    )
    assert len(splats) >= 15 and np.isfinite(splats).all()


def test_puffs_around_the_camera_fade():
    near = puffs(vehicle(20.0, 4.0))
    assert (near[:, 2] > spray.NEAR_M).all()
    assert near[near[:, 2] < 1.5, OPACITY].max(initial=0.0) < 0.3


def test_bad_arguments_are_refused_by_name():
    with pytest.raises(ArgumentError, match="wetness"):
        puffs(vehicle(), wetness=1.5)
    with pytest.raises(ArgumentError, match="time_s"):
        puffs(vehicle(), time_s=math.nan)
    with pytest.raises(ArgumentError, match="seed"):
        puffs(vehicle(), seed=0.5)
