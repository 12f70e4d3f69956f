"""The field carried with a reference camera (paper mode C) against the field at rest (mode W)."""

import numpy as np
import pytest
from particle_scene import AXES, camera, field, inside, steady, whole

from weather_aug.particles import statistics
from weather_aug.particles.field import ParticleField

POPULATIONS = [statistics.rain(20.0), statistics.snow(2.0, wetness=0.3)]
TIME_S = 2.0
PARKED = camera(yaw_deg=25, centre=(8.0, -3.0, 1.5))
DRIVEN = camera(
    yaw_deg=70,
    centre=(19.0, 4.0, 1.6),
    velocity_m_per_s=np.array([3.0, 6.0, 0.0]),
    angular_velocity_rad_per_s=np.array([0.0, 0.3, 0.0]),
)


def field_from_world(reference_then, reference_now):
    """T_0 T_t^-1 of the reference camera's poses."""
    return reference_then.world_from_camera @ np.linalg.inv(reference_now.world_from_camera)


def as_released(reference_then, reference_now):
    """Planted fault: the paper's code turns about the world's origin and adds C_t - C_0."""
    motion = np.eye(4)
    then, now = (c.world_from_camera for c in (reference_then, reference_now))
    motion[:3, :3] = now[:3, :3] @ then[:3, :3].T
    motion[:3, 3] = now[:3, 3] - then[:3, 3]
    return np.linalg.inv(motion)


def places(population, cam, resolved, motion):
    carried = field(population, time_s=TIME_S, wind=(1.0, 0.5, 0.0), field_from_world=motion)
    return carried.particles(cam, TIME_S, resolved, whole(cam))


def test_identity_changes_nothing_bit_for_bit():
    for population in POPULATIONS:
        resolved = field(population).resolve(DRIVEN, 5_000)
        np.testing.assert_array_equal(
            places(population, DRIVEN, resolved, None),
            places(population, DRIVEN, resolved, np.eye(4)),
        )


@pytest.mark.parametrize("population", POPULATIONS)
def test_without_ego_motion_both_modes_agree(population):
    """v_cam = 0 and omega = 0: identical to 1e-6."""
    resolved = field(population).resolve(PARKED, 5_000)
    motion = field_from_world(PARKED, PARKED)
    plain = places(population, PARKED, resolved, None)
    carried = places(population, PARKED, resolved, motion)
    np.testing.assert_allclose(plain, carried, atol=1e-6)
    # The released formula agrees here too: a parked car cannot tell them apart.
    np.testing.assert_allclose(
        plain, places(population, PARKED, resolved, as_released(PARKED, PARKED)), atol=1e-6
    )


def mismatch(population, motion):
    """Median distance of what the driven camera sees to what the parked one saw, camera axes."""
    resolved = field(population).resolve(PARKED, 20_000)
    parked = places(population, PARKED, resolved, None)
    driven = places(population, DRIVEN, resolved, motion)
    # A moving camera looks a little further around its picture, for longer streaks.
    parked = parked[inside(parked, PARKED)]
    distance = np.linalg.norm(parked[:300, None, :3] - driven[None, :, :3], axis=-1)
    nearest = distance.argmin(axis=1)
    return distance.min(axis=1), parked[:300], driven[nearest]


@pytest.mark.parametrize("population", POPULATIONS)
def test_a_carried_field_ignores_the_ego_motion(population):
    """Places and attitudes in camera axes are those of the parked camera at t0."""
    distance, parked, driven = mismatch(population, field_from_world(PARKED, DRIVEN))
    assert distance.max() < 1e-5
    np.testing.assert_allclose(parked[:, 6:], driven[:, 6:], atol=1e-5)


@pytest.mark.parametrize("population", POPULATIONS)
def test_turning_about_the_origin_does_not(population):
    distance, _, _ = mismatch(population, as_released(PARKED, DRIVEN))
    assert np.median(distance) > 0.05


def test_streaks_of_a_carried_field_still_tell_of_the_motion():
    """Velocities are those of the true pose and speed: wind, fall and ego motion."""
    population = statistics.rain(20.0)
    air = steady((1.0, 0.5, 0.0), TIME_S)
    motion = field_from_world(PARKED, DRIVEN)
    resolved = field(population).resolve(DRIVEN, 5_000)
    carried = ParticleField(population, 1, air, AXES, motion)
    found = carried.particles(DRIVEN, TIME_S, resolved, whole(DRIVEN))
    velocity = found[:, 3:6] @ DRIVEN.world_from_camera[:3, :3].T
    mean = velocity.mean(axis=0) + DRIVEN.velocity_m_per_s
    np.testing.assert_allclose(mean[:2], (1.0, 0.5), atol=0.1)
    fall = -velocity[:, 2]
    assert set(np.round(fall, 3)) <= set(np.round(population.fall_speed_m_per_s, 3))


def test_resolved_particles_do_not_depend_on_the_alignment():
    population = statistics.rain(20.0)
    plain = field(population).resolve(DRIVEN, 5_000)
    motion = field_from_world(PARKED, DRIVEN)
    assert field(population, field_from_world=motion).resolve(DRIVEN, 5_000) is plain
