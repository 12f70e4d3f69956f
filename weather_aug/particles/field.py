"""The 4D Gaussian field: which particles are where at time t, seen from a camera.

Convention:
    The field of a class of particles is endless, at rest in a frame that the air has carried (its
    drift) and that has fallen with the class's speed, and a pure function of (seed, kind, class,
    place). Around its place in that frame each particle sways, by a bounded function of time whose
    derivative is part of its velocity. Nothing is stepped and nothing is recycled: any time and any
    camera can be asked for alone, two cameras see the same particles, and where a class is denser
    at a higher rate (all of rain) particles are added to those already there.

    Positions are in world metres; time is in seconds. Axes of the field are those of the world,
    unless a reference camera carries the field along (`field_from_world`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from weather_aug._keys import key_of
from weather_aug.air import Air
from weather_aug.clip.types import Camera, Window
from weather_aug.errors import ArgumentError
from weather_aug.particles import kernels
from weather_aug.particles.resolve import (
    FADE_SHARE,
    Resolved,
    arrivals,
    resolve,
    shutter_turning_rad_per_s,
)
from weather_aug.particles.statistics import Population
from weather_aug.particles.tumble import shape_turns, shapes_in

MAX_PARTICLES = 1_000_000
RECORD = 13
"""Numbers of a particle: position, velocity, covariance (xx, xy, xz, yy, yz, zz), opacity."""
VELOCITY, COVARIANCE, OPACITY = 3, 6, 12
"""Where they begin in a particle's record; its position comes first."""
BLUR_PX = 6.0
"""Reach of the pixel filter around a particle."""
BEYOND_PICTURE = 1.0
"""Particles are drawn up to this far outside the picture, as a tangent, where streaks reach in."""

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ParticleField:
    """Particles of one population that drift and fall; see the module's Convention.

    Raises:
        ArgumentError: If `axes_world` is not (3, 3) or `field_from_world` not a rigid motion.
    """

    population: Population
    seed: int
    air: Air
    """Wind and drift along the street, to its left, up."""
    axes_world: Float64
    """(3, 3), rows: along the street, to the left, up."""
    field_from_world: Float64 | None = None
    """(4, 4) rigid motion of the world into the field's own axes; identity if None.

    With `world_from_reference(t0) @ reference_from_world(t)` the field is carried by a reference
    camera: the particles that a camera sees ignore the ego motion, as if it were parked where it
    stood at t0, while their streaks still tell of it.
    """

    def __post_init__(self) -> None:
        if np.shape(self.axes_world) != (3, 3):
            raise ArgumentError(f"axes_world must be (3, 3), got {np.shape(self.axes_world)}")
        if self.field_from_world is not None:
            _check_rigid(self.field_from_world)

    @property
    def velocity_world_m_per_s(self) -> Float64:
        """(C, 3) velocity of each class now."""
        population = self.population
        speed = population.fall_speed_m_per_s * (1.0 + population.wetness)
        velocity: Float64 = self._wind_world - speed[:, None] * self.axes_world[2]
        return velocity

    @property
    def _wind_world(self) -> Float64:
        return np.asarray(self.air.wind_m_per_s, np.float64) @ self.axes_world

    def resolve(self, camera: Camera, max_particles: int) -> Resolved:
        """What `camera` resolves of this field within a budget; see `resolve.resolve`."""
        relative = self.velocity_world_m_per_s - camera.velocity_m_per_s
        rotation = camera.world_from_camera[:3, :3]
        return resolve(self.population, camera, relative @ rotation, max_particles)

    def particles(
        self, camera: Camera, time_s: float, resolved: Resolved, window: Window
    ) -> Float32:
        """Resolved particles that can touch `window` of the camera's picture at `time_s`.

        Returns:
            (N, 13), in camera axes: position in metres; velocity relative to the camera's centre
            in m/s (still without the camera's own turning); covariance xx, xy, xz, yy, yz, zz in
            m^2 of the particle as a Gaussian; its peak opacity in [0, 1] before projection, below
            1 where it fades near the limits of what is drawn.
        """
        population = self.population
        rotation = camera.world_from_camera[:3, :3]
        field_from_camera = self._field_from_camera(camera)
        turned = np.ascontiguousarray(field_from_camera[:3, :3])
        relative = self.velocity_world_m_per_s - camera.velocity_m_per_s
        sway_m = self._sway_m()
        sway_m_per_s = sway_m * population.sway_rad_per_s
        reach_m = np.array(resolved.reach_m)
        speed = np.linalg.norm(relative, axis=1) + sway_m_per_s.sum(axis=1)
        tangents, steepest = padded_tangents(camera, window), _steepest(camera)
        pad_m = _pad_m(camera, steepest, reach_m, speed, population)
        near_m = resolved.near_m
        fade_per_m = (1.0 / (FADE_SHARE * np.maximum(reach_m, near_m))).astype(np.float32)
        inputs = (
            _class_keys(population.kind, self.seed, len(pad_m)),
            _counts(tuple(population.mean_per_cell)),
            arrivals(population.mean_per_cell),
            population.cell_m,
            field_from_camera[:3, 3] - self._carried_m(time_s),
            *_planes_and_bounds(
                turned, tangents, near_m, reach_m, pad_m, sway_m, population.cell_m
            ),
            kernels.View(
                near_m,
                resolved.near_full_m,
                reach_m,
                fade_per_m,
                np.ascontiguousarray(turned.T),
                tangents,
                pad_m,
                steepest,
            ),
            kernels.Motion(
                (relative @ rotation).astype(np.float32),
                sway_m,
                np.mod(population.sway_rad_per_s * time_s / (2 * np.pi), 1.0),
                self.axes_world[:2] @ turned,
                (sway_m_per_s[:, :, None] * (self.axes_world[:2] @ rotation)).astype(np.float32),
            ),
            kernels.Looks(
                population.diameters_m.astype(np.float32),
                shapes_in(turned) if population.tumbles else _NO_SHAPES,
                shape_turns(time_s) if population.tumbles else _NO_TURNS,
                _SINE,
            ),
        )
        capacity = int(1.5 * resolved.expected_count) + 256
        while True:
            particles = np.empty((capacity, RECORD), np.float32)
            found = min(kernels.scatter(*inputs, particles), MAX_PARTICLES)
            if found <= capacity:
                return particles[:found]
            capacity = found

    def _field_from_camera(self, camera: Camera) -> Float64:
        """(4, 4) pose from which the field is looked at."""
        if self.field_from_world is None:
            return camera.world_from_camera
        pose: Float64 = np.asarray(self.field_from_world, np.float64) @ camera.world_from_camera
        return pose

    def _carried_m(self, time_s: float) -> Float64:
        """(C, 3) displacement of each class since time 0, field axes."""
        wet_s = self.air.wet_s if self.population.kind == "snow" else 0.0
        drift = np.asarray(self.air.drift_m, np.float64) @ self.axes_world
        fallen_m = self.population.fall_speed_m_per_s * (time_s + wet_s)
        carried: Float64 = drift - fallen_m[:, None] * self.axes_world[2]
        return carried

    def _sway_m(self) -> Float64:
        """(C, 2) amplitudes of the sways in the wind of this moment."""
        across = float(np.hypot(*self.air.wind_m_per_s[:2]))
        amplitude: Float64 = self.population.sway_m + across * self.population.sway_per_wind_s
        return amplitude


def _check_rigid(field_from_world: Float64) -> None:
    motion = np.asarray(field_from_world, np.float64)
    if motion.shape != (4, 4):
        raise ArgumentError(f"field_from_world must be (4, 4), got {motion.shape}")
    rotation = motion[:3, :3]
    rigid = np.isfinite(motion).all() and np.linalg.det(rotation) > 0
    rigid = rigid and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
    if not rigid or not np.allclose(motion[3], (0, 0, 0, 1), atol=1e-4):
        raise ArgumentError(
            "field_from_world must be a finite rotation and translation; build it from two poses, "
            "world_from_reference(t0) @ inverse(world_from_reference(t))"
        )


@lru_cache(maxsize=256)
def _class_keys(kind: str, seed: int, classes: int) -> NDArray[np.uint64]:
    return np.array([key_of(kind, seed, c) % 2**64 for c in range(classes)], np.uint64)


@lru_cache(maxsize=64)
def _counts(mean_per_cell: tuple[float, ...]) -> NDArray[np.uint64]:
    """Poisson distribution functions (C, K) of the particles in a cube, as shares of 2^64."""
    mean = np.maximum(np.array(mean_per_cell), 1e-300)[:, None]
    most = int(mean.max() + 12 * np.sqrt(mean.max()) + 24)
    number = np.arange(most)
    log_factorial = np.concatenate([[0.0], np.cumsum(np.log(number[1:]))])
    share = np.exp(number * np.log(mean) - mean - log_factorial).cumsum(axis=1)
    # The largest float64 below 1: a share of 1 would not fit into the word.
    counts = (np.minimum(share, 1 - 2.0**-53) * 2.0**64).astype(np.uint64)
    counts[:, -1] = 2**64 - 1
    return counts


def padded_tangents(camera: Camera, window: Window) -> Float64:
    """Tangents (x0, x1, y0, y1) of a window's view, with the reach of the pixel filter."""
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    top, left, height, width = window
    return np.array(
        [
            (left - BLUR_PX - cx) / fx,
            (left + width + BLUR_PX - cx) / fx,
            (top - BLUR_PX - cy) / fy,
            (top + height + BLUR_PX - cy) / fy,
        ]
    )


def _steepest(camera: Camera) -> Float64:
    """Tangents (2,) across and down of the steepest particles that are drawn.

    Of the whole picture and not of a window, lest a window draws other particles than the whole.
    """
    whole = np.abs(padded_tangents(camera, (0, 0, camera.height, camera.width)))
    return whole.reshape(2, 2).max(axis=1) + BEYOND_PICTURE


def _pad_m(
    camera: Camera, steepest: Float64, reach_m: Float32, speed: Float64, population: Population
) -> Float64:
    """Metres (C,) from which outside a view a particle still touches it.

    By its streak's length, seen at the steepest angle at which particles are drawn.
    """
    still_m = 2 * camera.aperture_m + 2 * population.diameters_m.max(axis=1)
    turning = np.linalg.norm(shutter_turning_rad_per_s(camera)) * reach_m.max(axis=1)
    swept = speed + turning * np.hypot(1.0, np.linalg.norm(steepest))
    pad_m: Float64 = swept * camera.exposure_s * (1.0 + steepest.max()) + still_m
    return pad_m


def _planes_and_bounds(
    rotation: Float64,
    view: Float64,
    near_m: float,
    reach_m: Float32,
    pad_m: Float64,
    sway_m: Float64,
    cell_m: Float64,
) -> tuple[Float64, Float64]:
    """Planes (C, 6, 4) and bounds (C, 2, 3), about the camera in field axes, of the padded view.

    A cube touches the half-space of a plane where its centre keeps the plane, moved out by the
    cube's half extent along the normal.
    """
    x0, x1, y0, y1 = view
    far_m = reach_m.max(axis=1).astype(np.float64)
    normals = np.array(
        [[1, 0, -x0], [-1, 0, x1], [0, 1, -y0], [0, -1, y1], [0, 0, 1.0], [0, 0, -1.0]]
    )
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals @ rotation.T
    planes = np.empty((len(far_m), 6, 4))
    planes[:, :, :3] = normals
    planes[:, :4, 3] = pad_m[:, None]
    planes[:, 4, 3], planes[:, 5, 3] = -near_m, far_m
    swing_m = np.linalg.norm(sway_m, axis=1, keepdims=True)
    planes[:, :, 3] += swing_m + 0.5 * cell_m[:, None] * np.abs(normals).sum(axis=1)
    rays = np.array([(x, y, 1.0) for x in (x0, x1) for y in (y0, y1)]) @ rotation.T
    corners = np.concatenate(
        [far_m[:, None, None] * rays, np.broadcast_to(near_m * rays, (len(far_m), 4, 3))], axis=1
    )
    # Across the picture the pads of both sides add up in the corners.
    pad = np.sqrt(2) * pad_m[:, None] + swing_m
    return planes, np.stack([corners.min(axis=1) - pad, corners.max(axis=1) + pad], axis=1)


_SINE = np.sin(2 * np.pi * np.arange(1024) / 1024).astype(np.float32).astype(np.float64)
_NO_SHAPES = np.empty((0, 5, 6), np.float32)
_NO_TURNS = np.empty(0)
