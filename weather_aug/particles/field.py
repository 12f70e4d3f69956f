"""The 4D Gaussian field: which particles are where at time t, seen from a camera.

Convention:
    The field of a class of particles is endless, at rest in a frame that drifts with the class's
    velocity (wind plus fall), and a pure function of (seed, kind, class, place). Nothing is
    stepped and nothing is recycled: any time and any camera can be asked for alone, two cameras
    see the same particles, and where a class is denser at a higher rate (all of rain) particles are
    added to those already there. Positions are in world metres; time is in seconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from weather_aug._keys import key_of
from weather_aug.clip.types import Camera
from weather_aug.particles import kernels
from weather_aug.particles.resolve import NEAR_M, Resolved, resolve
from weather_aug.particles.statistics import Population

MAX_PARTICLES = 1_000_000
SWAY_RAD_PER_S = (3.1, 2.2)
"""Of the first class; later (larger) classes sway slower."""
BLUR_PX = 6.0
"""Reach of the pixel filter around a particle."""

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Window = tuple[int, int, int, int]
"""(top, left, height, width) of a part of a picture, pixels."""


@dataclass(frozen=True, eq=False)
class ParticleField:
    """Particles of one population that drift and fall; see the module's Convention."""

    population: Population
    seed: int
    wind_world_m_per_s: Float64
    """(3,)."""
    axes_world: Float64
    """(3, 3), rows: along the street, to the left, up."""
    drift_world_m: Float64 | None = None
    """(3,) how far the wind has carried the air since time 0; wind times time if None."""

    @property
    def velocity_world_m_per_s(self) -> Float64:
        """(C, 3) drift of each class."""
        fall = self.population.fall_speed_m_per_s[:, None] * self.axes_world[2]
        velocity: Float64 = self.wind_world_m_per_s - fall
        return velocity

    def resolve(self, camera: Camera, max_particles: int) -> Resolved:
        """What `camera` resolves of this field within a budget; see `resolve.resolve`."""
        relative = self.velocity_world_m_per_s - camera.velocity_m_per_s
        across = _across_picture(camera, relative @ camera.world_from_camera[:3, :3])
        return resolve(self.population, camera, across * camera.exposure_s, max_particles)

    def particles(
        self, camera: Camera, time_s: float, resolved: Resolved, window: Window
    ) -> Float32:
        """Resolved particles that can touch `window` of the camera's picture at `time_s`.

        Returns:
            (N, 7): position in metres, velocity relative to the camera's centre in m/s (still
            without the camera's own turning), diameter in metres; all in camera axes.
        """
        population = self.population
        rotation = camera.world_from_camera[:3, :3]
        velocity = self.velocity_world_m_per_s
        relative = velocity - camera.velocity_m_per_s
        view, pad_m = _padded_view(camera, window, resolved.reach_m, relative, population)
        slower = 1.0 / (1.0 + 0.1 * np.arange(len(pad_m)))
        sway_rad_per_s = slower[:, None] * np.array(SWAY_RAD_PER_S)
        sway_axes = self.axes_world[:2]
        sway_velocities = population.sway_m * sway_rad_per_s[:, :, None] * (sway_axes @ rotation)
        inputs = (
            _class_keys(population.kind, self.seed, len(pad_m)),
            population.density_per_m3 * population.cell_m**3,
            population.cell_m,
            camera.centre_world - self._carried_m(time_s),
            resolved.reach_m,
            *_planes_and_bounds(rotation, view, resolved.reach_m, pad_m),
            _EXPONENTIAL,
            population.sway_m,
            sway_rad_per_s * time_s / (2 * np.pi),
            np.ascontiguousarray(sway_axes),
            _SINE,
            NEAR_M,
            np.ascontiguousarray(rotation.T),
            view,
            pad_m,
            population.diameters_m.astype(np.float32),
            (relative @ rotation).astype(np.float32),
            sway_velocities.astype(np.float32),
        )
        capacity = int(1.5 * resolved.expected_count) + 256
        while True:
            particles = np.empty((capacity, 7), np.float32)
            found = min(kernels.scatter(*inputs, particles), MAX_PARTICLES)
            if found <= capacity:
                return particles[:found]
            capacity = found

    def _carried_m(self, time_s: float) -> Float64:
        """(C, 3) displacement of each class since time 0, world axes."""
        carried: Float64 = self.velocity_world_m_per_s * time_s
        if self.drift_world_m is not None:
            carried = carried + (self.drift_world_m - self.wind_world_m_per_s * time_s)
        return carried


def _across_picture(camera: Camera, relative: Float64) -> Float64:
    """Speed (C,) across the line of sight, m/s, averaged over the picture.

    `relative` is (C, 3), in camera axes. Motion along the line of sight draws no streak: from a
    moving car the speed across is much less than the speed. The camera's own turning is left out,
    because its share grows with depth.
    """
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    tx = (np.linspace(0, camera.width, 7) - cx) / fx
    ty = (np.linspace(0, camera.height, 7) - cy) / fy
    across_x = relative[:, 0, None, None] - tx[:, None] * relative[:, 2, None, None]
    across_y = relative[:, 1, None, None] - ty[None, :] * relative[:, 2, None, None]
    return np.asarray(np.hypot(across_x, across_y).mean(axis=(1, 2)))


@lru_cache(maxsize=256)
def _class_keys(kind: str, seed: int, classes: int) -> NDArray[np.uint64]:
    return np.array([key_of(kind, seed, c) % 2**64 for c in range(classes)], np.uint64)


def _padded_view(
    camera: Camera, window: Window, reach_m: Float32, relative: Float64, population: Population
) -> tuple[Float64, Float64]:
    """Tangents (x0, x1, y0, y1) of the window's view, and metres (C,) to pad it by.

    A particle touches the window with its streak, so the view is padded by the streak's length (in
    metres, seen at the steepest angle of the picture) and by the blur (in pixels).
    """
    fx, fy = camera.focal_px
    cx, cy = camera.principal_px
    top, left, height, width = window
    view = np.array(
        [
            (left - BLUR_PX - cx) / fx,
            (left + width + BLUR_PX - cx) / fx,
            (top - BLUR_PX - cy) / fy,
            (top + height + BLUR_PX - cy) / fy,
        ]
    )
    speed = np.linalg.norm(relative, axis=1) + population.sway_m * sum(SWAY_RAD_PER_S)
    still_m = 2 * camera.aperture_m + 2 * population.diameters_m.max(axis=1)
    still_m += np.sqrt(2) * population.sway_m
    # A padded particle is seen at a steeper angle than the view's own, which lengthens its streak:
    # once round settles it.
    widest = np.abs(view).max()
    for _ in range(2):
        steepness = np.hypot(1.0, np.sqrt(2) * widest)
        turning = np.linalg.norm(camera.angular_velocity_rad_per_s) * reach_m.max(axis=1)
        streak_m = (speed + turning * steepness) * camera.exposure_s * (1.0 + widest)
        pad_m = streak_m + still_m
        widest = np.minimum(np.abs(view).max() + pad_m / NEAR_M, np.abs(view).max() + 1.0)
    return view, np.asarray(pad_m)


def _planes_and_bounds(
    rotation: Float64, view: Float64, reach_m: Float32, pad_m: Float64
) -> tuple[Float64, Float64]:
    """Planes (C, 6, 4) and bounds (C, 2, 3), about the camera in world axes, of the padded view."""
    x0, x1, y0, y1 = view
    far_m = reach_m.max(axis=1).astype(np.float64)
    normals = np.array(
        [[1, 0, -x0], [-1, 0, x1], [0, 1, -y0], [0, -1, y1], [0, 0, 1.0], [0, 0, -1.0]]
    )
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    planes = np.empty((len(far_m), 6, 4))
    planes[:, :, :3] = normals @ rotation.T
    planes[:, :, 3] = pad_m[:, None] + np.array([0, 0, 0, 0, -NEAR_M, 0])
    planes[:, 5, 3] += far_m
    rays = np.array([(x, y, 1.0) for x in (x0, x1) for y in (y0, y1)]) @ rotation.T
    corners = np.concatenate(
        [far_m[:, None, None] * rays, np.broadcast_to(NEAR_M * rays, (len(far_m), 4, 3))], axis=1
    )
    pad = pad_m[:, None]
    return planes, np.stack([corners.min(axis=1) - pad, corners.max(axis=1) + pad], axis=1)


def _quantiles_of_exponential() -> Float32:
    """Quantiles (4097,) of the unit exponential to interpolate in, scaled to the mean 1."""
    quantiles = -np.log1p(-np.minimum(np.arange(4097), 4095.5) / 4096)
    mean = 0.5 * (quantiles[:-1] + quantiles[1:]).mean()
    return (quantiles / mean).astype(np.float32)


_EXPONENTIAL = _quantiles_of_exponential()
_SINE = np.sin(2 * np.pi * np.arange(1024) / 1024).astype(np.float32).astype(np.float64)
