"""Which pictures a picture also looks at in Temporal-View attention: by table, rig and window.

Convention:
    A view reference is an index into the cameras of a rig, in the order in which they were given;
    a camera that refers to itself has none. Angles are between optical axes, in rad.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from weather_aug.clip.types import Camera
from weather_aug.errors import ArgumentError, printable

Float64 = NDArray[np.float64]

VIEW_TABLES: Mapping[int, tuple[int, ...]] = MappingProxyType(
    {
        1: (0,),
        2: (1, 0),
        3: (0, 0, 0),
        5: (0, 0, 0, 1, 2),
        6: (0, 0, 0, 1, 2, 3),
    }
)
"""View references by the number of cameras, as WeatherEdit's release has them: of a stereo pair
each looks at the other (KITTI); of three all look at the front (PandaSet, and nuScenes' three in
front); of five (Waymo: front, front-left, front-right, side-left, side-right) each at the next one
towards the front. Six are not in the release: front, front-left, front-right, back-left,
back-right, back (DDAD, nuScenes) go on in the same way, the back at the left one beside it."""

SAME_RAD = math.radians(5.0)
"""Rigs are mounted to a few degrees: angles that differ by less are held to be one."""
FAN_SHARE = 0.25
"""Mean optical axis of a rig, over which its cameras are a fan that opens ahead; Waymo's five have
0.48, nuScenes' ring of six 0.08."""
LEAST_SPEED_M_PER_S = 1.0
"""Under it the way a rig moves says little about where its front is."""
SIDE_M = 10.0
"""How far along its axis a camera's view is taken to lie, where left is told from right."""


def view_references(
    cameras: Sequence[Camera], ahead_world: ArrayLike | None = None
) -> tuple[int, ...]:
    """Which view each camera of a rig also looks at, from where the cameras point.

    The front is the camera whose optical axis is nearest to the way ahead, of parallel ones the
    left. It refers to the nearest camera that is parallel to it (the other one of a stereo pair),
    else to itself. Each other camera refers to the one with the least angle to it among those that
    are nearer to the front than itself; of equal ones to the front, then to the left. Angles within
    5 degrees are equal. Another order of the cameras gives the same references, in that order.

    Args:
        cameras: Of one rig at one moment, at least one.
        ahead_world: (3,) direction of driving in world axes, not zero; the first row of
            `Ambience.axes_world`, say. None takes the middle of the fan that the cameras make;
            where they look all around, the way they move, at 1 m/s or more, and else the side to
            which more of them point. A ring should be told, or its front may change when it stops.

    Returns:
        For each camera the index of another, or its own.

    Raises:
        ArgumentError: If there is no camera, `ahead_world` is no direction, or it is None and the
            cameras stand still and point evenly all around.
    """
    if not cameras:
        raise ArgumentError("view_references needs at least one camera")
    axes = [camera.world_from_camera[:3, 2] for camera in cameras]
    ahead = _ahead(cameras) if ahead_world is None else _direction(ahead_world)
    front = _front(cameras, [_angle_rad(axis, ahead) for axis in axes])
    from_front = [_angle_rad(axis, axes[front]) for axis in axes]
    left = _leftness_m(cameras, cameras[front])
    references = []
    for this, axis in enumerate(axes):
        if this == front:
            references.append(_partner(cameras, front, from_front))
            continue
        nearer = [
            other
            for other in range(len(cameras))
            if other == front or from_front[other] < from_front[this] - SAME_RAD
        ]
        angles = {other: _angle_rad(axes[other], axis) for other in nearer}
        least = min(angles.values())
        equal = [other for other in nearer if angles[other] <= least + SAME_RAD]
        references.append(front if front in equal else max(equal, key=left.__getitem__))
    return tuple(references)


def _ahead(cameras: Sequence[Camera]) -> Float64:
    mean_axis = _mean([camera.world_from_camera[:3, 2] for camera in cameras])
    if np.linalg.norm(mean_axis) >= FAN_SHARE:
        return mean_axis
    velocity = _mean([camera.velocity_m_per_s for camera in cameras])
    if np.linalg.norm(velocity) >= LEAST_SPEED_M_PER_S:
        return velocity
    if np.linalg.norm(mean_axis) < 1e-6:
        raise ArgumentError(
            "the cameras stand still and point evenly all around, so none is the front; give "
            "ahead_world"
        )
    return mean_axis


def _mean(vectors: Sequence[Float64]) -> Float64:
    """(3,), the same bits in any order of the vectors."""
    return np.array([math.fsum(parts) / len(vectors) for parts in zip(*vectors, strict=True)])


def _direction(ahead_world: ArrayLike) -> Float64:
    ahead = np.asarray(ahead_world, dtype=np.float64)
    if ahead.shape != (3,) or not np.isfinite(ahead).all() or not ahead.any():
        raise ArgumentError(f"ahead_world must be (3,) finite and not zero, got {ahead_world!r}")
    return ahead


def _angle_rad(a: Float64, b: Float64) -> float:
    """Exact near 0 and pi, where the arc cosine is not."""
    return math.atan2(float(np.linalg.norm(np.cross(a, b))), float(a @ b))


def _front(cameras: Sequence[Camera], off_ahead_rad: Sequence[float]) -> int:
    best = int(np.argmin(off_ahead_rad))
    left = _leftness_m(cameras, cameras[best])
    leading = [i for i, off in enumerate(off_ahead_rad) if off <= off_ahead_rad[best] + SAME_RAD]
    return max(leading, key=left.__getitem__)


def _leftness_m(cameras: Sequence[Camera], of: Camera) -> list[float]:
    """How far to the left of a camera's axis the others' views lie; their centres if parallel."""
    to_left = -of.world_from_camera[:3, 0]
    views = [camera.centre_world + SIDE_M * camera.world_from_camera[:3, 2] for camera in cameras]
    return [float((view - of.centre_world) @ to_left) for view in views]


def _partner(cameras: Sequence[Camera], front: int, from_front_rad: Sequence[float]) -> int:
    centre = cameras[front].centre_world
    parallel = [
        other for other, off in enumerate(from_front_rad) if other != front and off <= SAME_RAD
    ]
    return min(
        parallel,
        key=lambda other: float(np.linalg.norm(cameras[other].centre_world - centre)),
        default=front,
    )


@dataclass(frozen=True)
class Links:
    """For each picture of a batch, the pictures that its queries also look at, by batch index.

    Raises:
        ArgumentError: If the three differ in length, or an index is outside the batch.
    """

    view: tuple[int, ...]
    """Of the same time, another camera."""
    before: tuple[int, ...]
    """Of the same camera, the time before."""
    after: tuple[int, ...]
    """Of the same camera, the time after."""

    def __post_init__(self) -> None:
        for name, indices in (("view", self.view), ("before", self.before), ("after", self.after)):
            if len(indices) != len(self.view):
                raise ArgumentError(
                    f"links need view, before and after for each picture: {len(self.view)} of view "
                    f"but {len(indices)} of {name}"
                )
            for index in indices:
                if not 0 <= index < len(self.view):
                    raise ArgumentError(
                        f"links.{name} names picture {index} of a batch of {len(self.view)}"
                    )

    def __len__(self) -> int:
        """Number of pictures in the batch."""
        return len(self.view)


def window_links(
    cameras_by_time: Sequence[Sequence[str]], reference_by_camera: Mapping[str, str]
) -> Links:
    """Links of a window of times, its pictures in the order in which they are listed.

    Each picture looks at its camera's view reference of the same time and at its own camera in the
    previous and next time of the window. What the window lacks is the picture itself, so that the
    weight falls to its self-attention. So the pictures of one time are a function of the window
    alone, and a drive is edited by a window that slides.

    The outer times of a window of three look one time far, as all do; in WeatherEdit's release
    every picture looks at the first and the last of the window, the first at itself and the last.
    For the middle time, which is the one that is kept, both are the same.

    Args:
        cameras_by_time: Names of the cameras that have a picture, for each time in turn; a time
            may have none.
        reference_by_camera: For each camera the name of the one it refers to, or its own.

    Raises:
        ArgumentError: If a time has a camera twice, or a camera has no reference.
    """
    index_by_picture: dict[tuple[int, str], int] = {}
    for time, cameras in enumerate(cameras_by_time):
        for camera in cameras:
            if (time, camera) in index_by_picture:
                raise ArgumentError(f"a time has camera {printable(camera)} twice")
            if camera not in reference_by_camera:
                raise ArgumentError(
                    f"camera {printable(camera)} has no view reference; give its own name if it "
                    "looks at none"
                )
            index_by_picture[time, camera] = len(index_by_picture)
    pictures = list(index_by_picture)
    return Links(
        view=tuple(
            index_by_picture.get((time, reference_by_camera[camera]), this)
            for this, (time, camera) in enumerate(pictures)
        ),
        before=tuple(
            index_by_picture.get((time - 1, camera), this)
            for this, (time, camera) in enumerate(pictures)
        ),
        after=tuple(
            index_by_picture.get((time + 1, camera), this)
            for this, (time, camera) in enumerate(pictures)
        ),
    )
