"""The particles of WeatherEdit's release, enumerated as ours are, to compare with them.

Convention:
    The field is a box of `preset.count` particles, uniform in it, all of which fall at one speed
    and wrap vertically. Like `ParticleField` it is a pure function of (preset, seed, time, camera):
    no frame has to be rendered before another. It gives the same record, so that the same renderer
    draws it; for the published look that renderer must neither conserve the energy of what is
    smaller than a pixel, nor add streaks, nor put a veil for what is not drawn, and must blend in
    sRGB with the colour `grey_srgb`.

    Where we leave the release:

    * Recycling. The paper's "P = p_max - delta" drops the overshoot, so that all particles leaving
      in one frame land on one sheet; the release adds the vertical extent. Both step from frame to
      frame. The release's is the wrap on a torus, which has the closed form used here.
    * Alignment. The release turns positions about the world's origin by the change of pose between
      two frames, which is neither the paper's equation nor a rigid motion of the box with the
      camera; we use the paper's Delta T = T_t T_0^-1.
    * Opacities outside [0, 1] are clamped. Particles nearer than `resolve.NEAR_M` are not drawn
      (release: 0.1 m).
    * Tilts are right-handed rotations about one axis of the box, applied to the Gaussian and not to
      its path: the release is silent on the order of its quaternions, and this one (w first) leaves
      the long side of rain on the tilted vertical.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import finite
from weather_aug._keys import check_seed, key_of
from weather_aug.clip.types import Camera, Window
from weather_aug.errors import ArgumentError
from weather_aug.particles import published_kernels as kernels
from weather_aug.particles.field import padded_tangents
from weather_aug.particles.published_presets import BOX_AXES, PublishedPreset
from weather_aug.particles.resolve import NEAR_M

Dynamics = Literal["recycled", "none"]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

FRAME_INTERVAL_S = 0.1
"""Of the recordings that the release was made for."""
REACH_SIGMAS = 3.34
"""Where a Gaussian of opacity 1 has fallen to 1/255, in standard deviations."""


@dataclass(frozen=True, eq=False)
class PublishedField:
    """The release's particles around a camera; see the module's Convention.

    Raises:
        ArgumentError: If the seed is not an integer, `dynamics` is unknown, the interval is not
            positive, or a vector or matrix has another shape.
    """

    preset: PublishedPreset
    seed: int
    origin_world: Float64
    """(3,) centre of the reference camera at time 0, metres."""
    axes_world: Float64
    """(3, 3), rows: along the first heading, to the left, up."""
    field_from_world: Float64 | None = None
    """(4, 4) of this moment: `field_from_world(first, now)` carries the box with the camera, as in
    the paper; None leaves it where it was at time 0, the paper's ablation without alignment."""
    dynamics: Dynamics = "recycled"
    """"none" is the paper's ablation without motion."""
    attributes: bool = True
    """False is the ablation `PublishedPreset.without_attributes`."""
    frame_interval_s: float = FRAME_INTERVAL_S
    """How long the release's "frame" of falling lasts, seconds."""

    def __post_init__(self) -> None:
        check_seed("seed", self.seed)
        finite("frame_interval_s", self.frame_interval_s, 1e-4, 10.0)
        if self.dynamics not in get_args(Dynamics):
            known = ", ".join(get_args(Dynamics))
            raise ArgumentError(f"dynamics must be one of {known}, got {self.dynamics!r}")
        shapes = {"origin_world": (3,), "axes_world": (3, 3), "field_from_world": (4, 4)}
        for name, shape in shapes.items():
            array = getattr(self, name)
            if array is not None and np.shape(array) != shape:
                raise ArgumentError(f"{name} must have shape {shape}, got {np.shape(array)}")

    @property
    def grey_srgb(self) -> float:
        """Of all particles, sRGB in [0, 1]."""
        return self.preset.grey_srgb

    @property
    def fall_m_per_s(self) -> float:
        """Speed of all particles."""
        moves = self.dynamics == "recycled"
        return self.preset.fall_m_per_frame / self.frame_interval_s if moves else 0.0

    def particles(self, camera: Camera, time_s: float, window: Window) -> Float32:
        """Particles that can touch `window` of the camera's picture at `time_s`.

        Args:
            camera: Of the whole picture.
            time_s: Since the moment at which `origin_world` and the first pose were taken.
            window: (top, left, height, width); a window's particles are those of the whole picture
                that can touch it, in the same order.

        Returns:
            (N, 13): position in metres; velocity 0, because the release knows no shutter; the
            covariance xx, xy, xz, yy, yz, zz of the Gaussian in square metres; its peak opacity.
            All in camera axes.
        """
        preset = self.preset if self.attributes else self.preset.without_attributes()
        records = np.empty((preset.count, 13), np.float32)
        found = kernels.particles_in_view(
            np.uint64(key_of(f"published {preset.weather}", self.seed) % 2**64),
            np.array(preset.box_low_m),
            np.array(preset.extent_m),
            self._shift_m(time_s),
            _attributes(preset),
            self._view(camera, window, preset),
            records,
        )
        return records[:found]

    def _shift_m(self, time_s: float) -> Float64:
        """Fall (3,) since time 0 along the box's axes, each within one side of the box."""
        k = self.preset.vertical_axis
        side_m = self.preset.extent_m[k]
        upwards = BOX_AXES[self.preset.axes][k][2]
        shift_m = np.zeros(3)
        shift_m[k] = -upwards * self.fall_m_per_s * time_s % side_m
        return shift_m

    def _view(self, camera: Camera, window: Window, preset: PublishedPreset) -> kernels.View:
        world_from_box = np.eye(4)
        world_from_box[:3, :3] = (np.array(BOX_AXES[preset.axes]) @ self.axes_world).T
        world_from_box[:3, 3] = self.origin_world
        pose = camera.world_from_camera
        if self.field_from_world is not None:
            pose = self.field_from_world @ pose
        camera_from_box = np.linalg.inv(pose) @ world_from_box
        largest = np.array(preset.scale_mean_m) + kernels.MOST_SIGMAS * np.array(preset.scale_std_m)
        largest[1] *= max(preset.y_multipliers)
        return kernels.View(
            np.ascontiguousarray(camera_from_box[:3]),
            padded_tangents(camera, (0, 0, camera.height, camera.width)),
            padded_tangents(camera, window),
            NEAR_M,
            float(REACH_SIGMAS * largest.max()),
        )


def field_from_world(world_from_first: Float64, world_from_now: Float64) -> Float64:
    """The inverse (4, 4) of the paper's Delta T = T_t T_0^-1, for alignment with a camera.

    Args:
        world_from_first: (4, 4) pose of the reference camera at time 0.
        world_from_now: (4, 4) its pose at this moment. The cameras of one rig share it.
    """
    return world_from_first @ np.linalg.inv(world_from_now)


def _attributes(preset: PublishedPreset) -> kernels.Attributes:
    return kernels.Attributes(
        opacity_mean=preset.opacity_mean,
        opacity_std=preset.opacity_std,
        opacity_per_m=preset.opacity_per_size / preset.size_m,
        forward_axis=preset.forward_axis,
        scale_mean_m=np.array(preset.scale_mean_m),
        scale_std_m=np.array(preset.scale_std_m),
        y_multipliers=np.array(preset.y_multipliers),
        tilt_axis=("x", "y", "z").index(preset.tilt_axis),
        tilt_mean_rad=preset.tilt_mean_rad,
        tilt_std_rad=preset.tilt_std_rad,
    )
