"""Boxes on a road seen by a moving camera: exact depth and labels, for what hangs overhead."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.types import Camera, Float64, Frame, FrameKey, check_key
from weather_aug.taxonomy import BUILDING, IGNORE, ROAD, SKY, TRAIN_ID, VEGETATION

SPEED_M_PER_S = 10.0
CAMERA_HEIGHT_M = 1.6
Box = tuple[int, tuple[float, float], tuple[float, float], tuple[float, float]]
"""Train id, and ranges of x, y and z."""

DECK: Box = (IGNORE, (30.0, 42.0), (-12.0, 12.0), (5.0, 6.2))
FACADES: tuple[Box, ...] = tuple(
    (BUILDING, (x, x + 18.0), sides, (0.0, 12.0))
    for x in (-20.0, 0.0, 50.0, 70.0)
    for sides in ((9.0, 19.0), (-19.0, -9.0))
)
CARS: tuple[Box, ...] = tuple(
    (TRAIN_ID["car"], (x, x + 4.4), (4.5, 6.3), (0.3, 2.0)) for x in range(0, 70, 6)
)
CROWNS: tuple[Box, ...] = tuple(
    (VEGETATION, (x, x + 4.0), (-8.0, -4.0), (3.0, 7.0)) for x in range(4, 70, 9)
)


@dataclass(frozen=True)
class BoxStreet:
    """A level road, z = 0, x ahead, y left; boxes stand on it or hang over it."""

    boxes: tuple[Box, ...]
    frames: int = 8
    labelled: bool = True
    noise: float = 0.0
    """Standard deviation of the depth's error as a share of it."""
    is_drive: bool = True
    name: str = "boxes"
    cameras: tuple[str, ...] = ("front",)
    width: int = 320
    height: int = 180

    @property
    def up_world(self) -> Float64:
        return np.array([0.0, 0.0, 1.0])

    @property
    def keys(self) -> tuple[FrameKey, ...]:
        return tuple(FrameKey(t, camera) for t in range(self.frames) for camera in self.cameras)

    def camera(self, key: FrameKey) -> Camera:
        pose = np.eye(4)
        pose[:3, :3] = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
        pose[:3, 3] = (0.5 * SPEED_M_PER_S * key.time_index, 0.0, CAMERA_HEIGHT_M)
        focal_px = 0.8 * self.width
        intrinsics = np.array(
            [[focal_px, 0, self.width / 2], [0, focal_px, self.height / 2], [0, 0, 1]]
        )
        velocity = np.array([SPEED_M_PER_S, 0, 0])
        return Camera(intrinsics, pose, self.width, self.height, velocity_m_per_s=velocity)

    def frame(self, key: FrameKey) -> Frame:
        key = check_key(self, key)
        camera = self.camera(key)
        rows, columns = np.mgrid[: self.height, : self.width].astype(float)
        (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
        rays = np.stack([(columns - cx) / fx, (rows - cy) / fy, np.ones_like(rows)], axis=-1)
        rays = rays @ camera.world_from_camera[:3, :3].T
        with np.errstate(divide="ignore"):
            depth = np.where(rays[..., 2] < 0, -CAMERA_HEIGHT_M / rays[..., 2], np.inf)
        label = np.where(np.isfinite(depth), ROAD, SKY).astype(np.uint8)
        for index, *ranges in self.boxes:
            hit = _box_hit(camera.centre_world, rays, np.array(ranges))
            label[hit < depth] = index
            depth = np.minimum(depth, hit)
        rng = np.random.default_rng(key.time_index)
        depth = depth * np.maximum(1 + self.noise * rng.standard_normal(depth.shape), 0.1)
        image = np.full((*depth.shape, 3), 120, np.uint8)
        shown: NDArray[np.uint8] | None = label if self.labelled else None
        time_s = 0.5 * key.time_index
        return Frame(key, time_s, camera, image, shown, depth.astype(np.float32))


def _box_hit(origin: Float64, rays: Float64, ranges: Float64) -> Float64:
    enter, leave = np.zeros(rays.shape[:2]), np.full(rays.shape[:2], np.inf)
    for axis in range(3):
        # Never 0, so that a ray along a face divides.
        slope = rays[..., axis] + 1e-12
        one, other = ((side - origin[axis]) / slope for side in ranges[axis])
        enter = np.maximum(enter, np.minimum(one, other))
        leave = np.minimum(leave, np.maximum(one, other))
    hit: Float64 = np.where((enter < leave) & (enter > 0), enter, np.inf)
    return hit
