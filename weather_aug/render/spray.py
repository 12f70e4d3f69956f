"""Spray behind vehicles on a wet road: Gaussian puffs that the wheels shed, as particle records.

A puff is shed every 0.05 s of absolute time and is a function of (vehicle, number) and the time
alone: any frame by itself shows the same plume. It is drawn along in the wake for a moment, stays
behind, spreads, drifts with the wind, and its drops fall out within a second.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import finite
from weather_aug._compiled import compiled
from weather_aug._keys import check_seed, key_of
from weather_aug.air import Air, checked_time
from weather_aug.clip.types import Camera
from weather_aug.edit.ambience import Ambience
from weather_aug.edit.physical.vehicles import Vehicle
from weather_aug.particles.field import COVARIANCE, OPACITY, RECORD, VELOCITY
from weather_aug.particles.kernels import GOLDEN, mix64

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

EMISSION_S = 0.05
LONGEST_S = 1.2
"""A puff is gone after so long."""
THINNING_S = 0.4
"""Drops fall out by a factor e in this time; at speed v the plume is about 0.4 s times v long."""
APPEARING_S = 0.04
SLOWEST_M_PER_S, FULL_M_PER_S = 5.0, 15.0
CAR_DEPTH, LARGE_DEPTH = 0.75, 1.5
"""Optical depth along the whole plume of a car and of a lorry or bus on a soaked road."""
WAKE_SHARE, WAKE_S = 0.6, 0.35
"""A puff begins with this share of the vehicle's speed and loses it in this time."""
HEIGHT_M, RISE_M = 0.45, 0.25
"""Of a puff's middle over the road at first, and how much higher it gets."""
NEAR_M, FADED_M = 1.0, 3.5
"""Depth up to which puffs are left out, and from which they are whole: nearer, one splat is no
picture of a cloud around the camera; that is what `Weather.spray_per_km` is for."""
MOST_OPAQUE = 0.9


def spray_colour(ambience: Ambience) -> Float64:
    """Linear colour (3,) of spray: drops that are lit by the sky above and the road below.

    Between the airlight, which fog of the same drops would have, and the ground. Spray is a thin
    layer on a dark road: a quarter of its light comes from there.
    """
    return np.asarray(0.75 * ambience.airlight + 0.25 * ambience.ground)


def spray_strength(vehicle: Vehicle, wetness: float) -> float:
    """Optical depth along the whole plume of a vehicle; 0 for who is parked or slow.

    Args:
        vehicle: Its speed and kind count.
        wetness: Of the road, in [0, 1].

    Source:
        docs/physics.md: 0.3 to 1.5 times the wetness at more than 15 m/s.
    """
    speed = float(np.linalg.norm(vehicle.velocity_m_per_s))
    t = (speed - SLOWEST_M_PER_S) / (FULL_M_PER_S - SLOWEST_M_PER_S)
    t = min(max(t, 0.0), 1.0)
    most = LARGE_DEPTH if vehicle.is_large else CAR_DEPTH
    return 0.0 if vehicle.parked else most * wetness * t * t * (3.0 - 2.0 * t)


def spray_particles(
    vehicles: Sequence[Vehicle],
    camera: Camera,
    time_s: float,
    *,
    wetness: float,
    air: Air,
    axes_world: Float64,
    seed: int,
) -> Float32:
    """Puffs behind the vehicles, in the form that `render.project` takes.

    Args:
        vehicles: Around the camera, at the frame's moment.
        camera: Of the whole picture.
        time_s: Seconds since the clip's start.
        wetness: Of the road, in [0, 1]; a dry one gives no spray.
        air: Its wind of this moment carries the puffs.
        axes_world: (3, 3) rows along the street, to the left, up.
        seed: Which puffs.

    Returns:
        (N, 13) in camera axes: position in metres, velocity relative to the camera's centre in
        m/s, covariance xx, xy, xz, yy, yz, zz in m^2, peak opacity in [0, 0.9] as seen from here:
        1 - exp(-(extinction cross-section) / (2 pi sqrt(det of the covariance across the ray))).

    Raises:
        ArgumentError: If wetness or time are out of range, or the seed is no integer.
    """
    wetness = finite("wetness", wetness, 0.0, 1.0)
    time_s, seed = checked_time("time_s", time_s), check_seed("seed", seed)
    axes_world = np.asarray(axes_world, np.float64)
    wind_world = np.asarray(air.wind_m_per_s, np.float64) @ axes_world
    plumes = [
        _records(_plume(vehicle, time_s, strength, wind_world, axes_world[2], seed), camera)
        for vehicle in vehicles
        if (strength := spray_strength(vehicle, wetness)) > 0.0
    ]
    return np.concatenate(plumes) if plumes else np.empty((0, RECORD), np.float32)


class _Plume(NamedTuple):
    """Puffs of one vehicle, world axes."""

    position: Float64
    """(N, 3) metres."""
    velocity: Float64
    """(N, 3) m/s."""
    covariance: Float64
    """(N, 3, 3) m^2."""
    section_m2: Float64
    """(N,) extinction cross-section."""


def _plume(
    vehicle: Vehicle,
    time_s: float,
    strength: float,
    wind_world: Float64,
    up: Float64,
    seed: int,
) -> _Plume:
    newest = math.floor(time_s / EMISSION_S)
    count = math.ceil(LONGEST_S / EMISSION_S)
    numbers = np.arange(newest - count + 1, newest + 1)
    # Rounding may put the newest puff a hair after the moment.
    age: Float64 = np.maximum(time_s - numbers.astype(np.float64) * EMISSION_S, 0.0)
    key = key_of("vehicle-spray", seed, vehicle.key) & (2**64 - 1)
    draws = _draws(np.uint64(key), numbers[0], count)
    length, width, _ = vehicle.size_m
    velocity, ahead = vehicle.velocity_m_per_s, vehicle.heading_world
    left = np.cross(up, ahead)
    wake = np.exp(-age / WAKE_S)
    blown = 1.0 - wake
    # Shed at the rear wheels of where the vehicle was, carried on by the wake, then by the wind.
    behind = -0.5 * length * ahead - age[:, None] * velocity
    drawn_along = (WAKE_SHARE * WAKE_S * blown)[:, None] * velocity
    drifted = (age - WAKE_S * blown)[:, None] * wind_world
    aside = 0.7 * width * (draws[:, 0] - 0.5)
    height = HEIGHT_M + RISE_M * blown + 0.2 * (draws[:, 1] - 0.5)
    position = vehicle.centre_world + behind + drawn_along + drifted
    position = position + aside[:, None] * left + height[:, None] * up
    carried = (WAKE_SHARE * wake)[:, None] * velocity + blown[:, None] * wind_world
    sigmas = _sigmas_m(age, width, draws[:, 2])
    axes = np.stack([ahead, left, up])
    covariance = np.einsum("nk,ki,kj->nij", sigmas**2, axes, axes)
    return _Plume(position, carried, covariance, strength * _sections_m2(age, width, draws[:, 3]))


def _sigmas_m(age: Float64, width_m: float, draw: Float64) -> Float64:
    """(N, 3) standard deviations along the vehicle, across, up, metres."""
    size = 0.85 + 0.3 * draw
    grown = np.sqrt(age)
    across = 0.28 * width_m + 0.35 * grown
    return size[:, None] * np.stack([0.4 + 0.7 * grown, across, 0.22 + 0.16 * grown], axis=1)


def _thinned(age: Float64) -> Float64:
    """Share of a puff that is still in the air, from its first moment to its last."""
    appearing = np.clip(age / APPEARING_S, 0.0, 1.0)
    ending = np.clip((LONGEST_S - age) / (0.3 * LONGEST_S), 0.0, 1.0)
    return np.asarray(appearing * ending * np.exp(-age / THINNING_S))


def _sections_m2(age: Float64, width_m: float, draw: Float64) -> Float64:
    """(N,) extinction cross-section of puffs that add up to an optical depth of 1 along a plume.

    The mean plume, so that a puff's own section does not depend on which others are there.
    """
    count = round(LONGEST_S / EMISSION_S)
    ages: Float64 = (np.arange(count, dtype=np.float64) + 0.5) * EMISSION_S
    sigmas = _sigmas_m(ages, width_m, np.full(len(ages), 0.5))
    summed = float(np.sum(_thinned(ages) / (2.0 * math.pi * sigmas[:, 1] * sigmas[:, 2])))
    return np.asarray(_thinned(age) * (0.6 + 0.8 * draw) / summed)


def _records(plume: _Plume, camera: Camera) -> Float32:
    """(N, 13) puffs in camera axes, those before the camera."""
    rotation = camera.world_from_camera[:3, :3]
    position = (plume.position - camera.centre_world) @ rotation
    covariance = rotation.T @ plume.covariance @ rotation
    fade = np.clip((position[:, 2] - NEAR_M) / (FADED_M - NEAR_M), 0.0, 1.0)
    # det(across the ray d) = det(C) d^T C^-1 d, for a unit vector d.
    ray = position / np.maximum(np.linalg.norm(position, axis=1, keepdims=True), 1e-9)
    steepness = np.einsum("ni,nij,nj->n", ray, np.linalg.inv(covariance), ray)
    across_m4 = np.linalg.det(covariance) * steepness
    tau = plume.section_m2 * fade * fade * (3.0 - 2.0 * fade) / (2 * math.pi * np.sqrt(across_m4))
    records = np.empty((len(position), RECORD), np.float32)
    records[:, :VELOCITY] = position
    records[:, VELOCITY:COVARIANCE] = (plume.velocity - camera.velocity_m_per_s) @ rotation
    records[:, COVARIANCE:OPACITY] = covariance[:, *np.triu_indices(3)]
    records[:, OPACITY] = np.minimum(-np.expm1(-tau), MOST_OPAQUE)
    kept: Float32 = records[(position[:, 2] > NEAR_M) & (records[:, OPACITY] > 0.0)]
    return kept


@compiled
def _draws(key: Any, first: Any, count: Any) -> Any:
    """(count, 4) uniforms in [0, 1) of the puffs from number `first` on."""
    out = np.empty((count, 4))
    for i in range(count):
        word = mix64(key + np.uint64(np.int64(first + i)) * GOLDEN)
        for k in range(4):
            word = mix64(word + GOLDEN)
            out[i, k] = np.float64(word >> np.uint64(11)) * 2.0**-53
    return out
