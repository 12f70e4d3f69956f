"""Viewpoints: places beside a recorded camera, written down or drawn.

Convention:
    A viewpoint is seen from the recorded camera: to its left (level), ahead (level) and up (against
    gravity), metres. Then the camera turns there: by yaw about the vertical, to the left; by pitch
    about its own horizontal axis, upwards; by roll about its own view, clockwise as it looks.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import finite
from weather_aug._keys import uniforms
from weather_aug.clip.types import Camera
from weather_aug.edit.ambience import CAMERA_HEIGHT_RANGE_M
from weather_aug.errors import ArgumentError, printable

Float64 = NDArray[np.float64]
Range = tuple[float, float]

LIMITS = {
    "lateral_m": 100.0,
    "height_m": 100.0,
    "forward_m": 100.0,
    "yaw_deg": 180.0,
    "pitch_deg": 180.0,
    "roll_deg": 180.0,
}
"""A viewpoint lies no farther from the recorded one, to either side."""


@dataclass(frozen=True)
class Viewpoint:
    """A place beside a recorded camera; the default is that camera's own.

    Raises:
        ArgumentError: If a number is not finite, or beyond its limit in `LIMITS`.
    """

    lateral_m: float = 0.0
    """To the left of the recorded camera's heading, level, in [-100, 100]."""
    height_m: float = 0.0
    """Against gravity, in [-100, 100]."""
    forward_m: float = 0.0
    """Along the recorded camera's heading, level, in [-100, 100]."""
    yaw_deg: float = 0.0
    """About the vertical, to the left, in [-180, 180]."""
    pitch_deg: float = 0.0
    """About the camera's own axis to the right, upwards, in [-180, 180]."""
    roll_deg: float = 0.0
    """About the camera's own view, clockwise, in [-180, 180]."""

    def __post_init__(self) -> None:
        for name, limit in LIMITS.items():
            object.__setattr__(self, name, finite(name, getattr(self, name), -limit, limit))

    def to_dict(self) -> dict[str, float]:
        """Fields as JSON values; `Viewpoint(**fields)` is equal to this one."""
        return asdict(self)

    @classmethod
    def from_dict(cls, state: Mapping[str, Any]) -> Viewpoint:
        """The inverse of `to_dict`; missing fields are 0, unknown ones are refused."""
        return _from_dict(cls, state)


@dataclass(frozen=True)
class ViewpointJitter:
    """How far drawn viewpoints lie from the recorded one; each number is uniform in its range.

    Convention:
        A range is a pair (low, high), or one number for the range from its negative to it. A draw
        is a pure function of its key, and each number has a uniform of its own: another range of
        one leaves the others as they were.

    Raises:
        ArgumentError: If a range is not of finite numbers in order, within `LIMITS`.
    """

    lateral_m: Range | float = (-1.0, 1.0)
    height_m: Range | float = (-0.3, 0.3)
    forward_m: Range | float = (0.0, 0.0)
    yaw_deg: Range | float = (-5.0, 5.0)
    pitch_deg: Range | float = (-2.0, 2.0)
    roll_deg: Range | float = (0.0, 0.0)

    def __post_init__(self) -> None:
        for name, limit in LIMITS.items():
            object.__setattr__(self, name, _range(name, getattr(self, name), limit))

    def draw(self, key: int) -> Viewpoint:
        """The viewpoint of a key (see `weather_aug._keys.key_of`)."""
        shares = uniforms(key, len(LIMITS)).tolist()
        drawn = {}
        for name, share in zip(LIMITS, shares, strict=True):
            low, high = getattr(self, name)
            # The product may leave the range by a rounding.
            drawn[name] = min(max(low + share * (high - low), low), high)
        return Viewpoint(**drawn)

    def to_dict(self) -> dict[str, list[float]]:
        """Fields as JSON values; `from_dict` gives an equal jitter."""
        return {name: list(value) for name, value in asdict(self).items()}

    @classmethod
    def from_dict(cls, state: Mapping[str, Any]) -> ViewpointJitter:
        """The inverse of `to_dict`; missing fields have defaults, unknown ones are refused."""
        return _from_dict(cls, state)


def moved(camera: Camera, axes_world: Float64, viewpoint: Viewpoint) -> Camera:
    """The camera at a viewpoint, carried along by the same car.

    Args:
        camera: The recorded one.
        axes_world: (3, 3), rows along the street, to its left, up; only up is used.
        viewpoint: Where to, from the recorded one.

    Returns:
        The same lens elsewhere. As a part of the same rigid car it turns as fast, and moves with
        the recorded camera's velocity and what the turning adds at its distance.

    Raises:
        ArgumentError: If the viewpoint is none.
        CalibrationError: If it would move faster than any car does.
    """
    if not isinstance(viewpoint, Viewpoint):
        raise ArgumentError(
            f"viewpoint must be a Viewpoint, got {type(viewpoint).__name__}; write "
            "Viewpoint(lateral_m=1.0)"
        )
    if viewpoint == Viewpoint():
        return camera
    up = axes_world[2] / np.linalg.norm(axes_world[2])
    world_from_old = camera.world_from_camera[:3, :3]
    ahead = heading(world_from_old, up)
    left = np.cross(up, ahead)
    offset = viewpoint.lateral_m * left + viewpoint.height_m * up + viewpoint.forward_m * ahead
    new_from_pitched = _turned((0.0, 0.0, 1.0), viewpoint.roll_deg)
    turned = _turned(up, viewpoint.yaw_deg) @ world_from_old
    world_from_new = turned @ _turned((1.0, 0.0, 0.0), viewpoint.pitch_deg) @ new_from_pitched
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = world_from_new, camera.centre_world + offset
    turning_world = world_from_old @ camera.angular_velocity_rad_per_s
    return replace(
        camera,
        world_from_camera=pose,
        velocity_m_per_s=camera.velocity_m_per_s + np.cross(turning_world, offset),
        angular_velocity_rad_per_s=world_from_new.T @ turning_world,
    )


def heading(world_from_camera: Float64, up: Float64) -> Float64:
    """(3,) level unit vector of a camera's view; of one that looks straight up or down, of its top.

    Args:
        world_from_camera: (3, 3) rotation.
        up: (3,) unit vector.
    """
    view, top = world_from_camera[:, 2], -world_from_camera[:, 1]
    level = view - (view @ up) * up
    if np.linalg.norm(level) < 1e-3:
        level = top - (top @ up) * up
    return np.asarray(level / np.linalg.norm(level))


def raised_height_m(height_m: float, by_m: float) -> float:
    """Height over the road of a camera that was moved up, as far as the renderer knows heights."""
    low, high = CAMERA_HEIGHT_RANGE_M
    return min(max(height_m + by_m, low), high)


def _turned(axis: Any, angle_deg: float) -> Float64:
    """Right-handed rotation (3, 3) about a unit vector, after Rodrigues."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = math.radians(angle_deg)
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def _range(name: str, value: Any, limit: float) -> Range:
    if isinstance(value, tuple | list):
        if len(value) != 2:
            raise ArgumentError(f"{name} must be a range (low, high) or one number, got {value!r}")
        low, high = (finite(name, side, -limit, limit) for side in value)
    else:
        high = finite(name, value, 0.0, limit)
        low = -high
    if low > high:
        raise ArgumentError(f"{name} must be a range (low, high), got ({low:g}, {high:g})")
    return (low, high)


def _from_dict(kind: type[Any], state: Any) -> Any:
    if not isinstance(state, Mapping):
        raise ArgumentError(f"a {kind.__name__} is read from an object, got {printable(state)!r}")
    known = [field.name for field in fields(kind)]
    unknown = sorted(set(state) - set(known), key=str)
    if unknown:
        raise ArgumentError(
            f"{kind.__name__} has no field {printable(unknown[0])}; it has {', '.join(known)}"
        )
    return kind(**state)
