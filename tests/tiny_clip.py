"""A tiny street in memory: exact depth and labels, two overlapping cameras on a moving car."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from weather_aug import _files
from weather_aug.clip.types import Camera, Float64, Frame, FrameKey, check_key
from weather_aug.taxonomy import ROAD, SIDEWALK, SKY, TERRAIN, TRAIN_ID

SPEED_M_PER_S = 8.0
RATE_HZ = 10.0
YAW_DEG = {"front": 0.0, "right": -30.0}
CAMERA_HEIGHT_M = 1.5
WALL_Y_M, WALL_HEIGHT_M = 9.0, 8.0
POLE_M = (12.0, -3.5, 0.15, 6.0)
"""x, y, radius, height."""
COLOURS = {
    ROAD: (92, 90, 88),
    SIDEWALK: (140, 132, 126),
    TERRAIN: (104, 120, 70),
    TRAIN_ID["building"]: (150, 96, 74),
    TRAIN_ID["pole"]: (52, 54, 58),
    SKY: (150, 182, 226),
}


@dataclass(frozen=True)
class TinyClip:
    """Road, sidewalk, terrain, a wall, a pole and sky; x ahead, y left, z up, metres."""

    name: str = "tiny"
    frames: int = 4
    width: int = 64
    height: int = 48
    labelled: bool = True
    cameras: tuple[str, ...] = ("front", "right")
    up_world: Float64 = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))

    @property
    def keys(self) -> tuple[FrameKey, ...]:
        return tuple(FrameKey(t, camera) for t in range(self.frames) for camera in self.cameras)

    def frame(self, key: FrameKey) -> Frame:
        key = check_key(self, key)
        camera = self.camera(key)
        label, depth, points = self._hits(camera)
        light = np.array([COLOURS.get(index, (0, 0, 0)) for index in range(256)], np.uint8)
        parity = np.floor(np.where(label[..., None] == SKY, 0.0, points)).sum(axis=-1) % 2
        # It gets darker, so that no two frames have the same light.
        dusk = np.uint8(5 * key.time_index)
        image = light[label] + (18 * parity[..., None]).astype(np.uint8) - dusk
        for array in (image, label, depth):
            array.flags.writeable = False
        return Frame(
            key, key.time_index / RATE_HZ, camera, image, label if self.labelled else None, depth
        )

    def camera(self, key: FrameKey) -> Camera:
        yaw = np.radians(YAW_DEG[key.camera])
        along = np.array([np.cos(yaw), np.sin(yaw), 0.0])
        pose = np.eye(4)
        pose[:3, :3] = np.stack([np.cross(along, self.up_world), -self.up_world, along], axis=1)
        pose[:3, 3] = (SPEED_M_PER_S * key.time_index / RATE_HZ, 0.0, CAMERA_HEIGHT_M)
        focal_px = 0.7 * self.width
        intrinsics = np.array(
            [[focal_px, 0, (self.width - 1) / 2], [0, focal_px, (self.height - 1) / 2], [0, 0, 1]]
        )
        velocity = np.array([SPEED_M_PER_S, 0.0, 0.0])
        return Camera(intrinsics, pose, self.width, self.height, velocity_m_per_s=velocity)

    def _hits(
        self, camera: Camera
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float64]]:
        """Label, z-depth and world point of the nearest surface in each pixel."""
        rows, columns = np.mgrid[: self.height, : self.width].astype(float)
        (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
        rays = np.stack([(columns - cx) / fx, (rows - cy) / fy, np.ones_like(rows)], axis=-1)
        directions = rays @ camera.world_from_camera[:3, :3].T
        origin = camera.centre_world
        depth = np.full(rows.shape, np.inf)
        label = np.full(rows.shape, SKY, np.uint8)
        for surface in (_ground, _wall, _pole):
            hit, ids = surface(origin, directions)
            nearer = hit < depth
            depth[nearer], label[nearer] = hit[nearer], ids[nearer]
        reached = np.where(np.isfinite(depth), depth, 0.0)[..., None]
        return label, depth.astype(np.float32), origin + reached * directions


def _ground(origin: Float64, rays: Float64) -> tuple[Float64, NDArray[np.uint8]]:
    with np.errstate(divide="ignore"):
        hit = np.where(rays[..., 2] < 0, -origin[2] / rays[..., 2], np.inf)
    aside = np.abs(origin[1] + np.where(np.isfinite(hit), hit, 0.0) * rays[..., 1])
    ids = np.select([aside < 4.0, aside < 6.0], [ROAD, SIDEWALK], TERRAIN)
    return hit, ids.astype(np.uint8)


def _wall(origin: Float64, rays: Float64) -> tuple[Float64, NDArray[np.uint8]]:
    with np.errstate(divide="ignore"):
        hit = np.where(rays[..., 1] > 0, (WALL_Y_M - origin[1]) / rays[..., 1], np.inf)
    height = origin[2] + np.where(np.isfinite(hit), hit, 0.0) * rays[..., 2]
    hit = np.where((height >= 0) & (height <= WALL_HEIGHT_M), hit, np.inf)
    return hit, np.full(hit.shape, TRAIN_ID["building"], np.uint8)


def _pole(origin: Float64, rays: Float64) -> tuple[Float64, NDArray[np.uint8]]:
    x, y, radius, top = POLE_M
    aside = origin[:2] - (x, y)
    a = (rays[..., :2] ** 2).sum(axis=-1)
    half_b = rays[..., :2] @ aside
    square = half_b**2 - a * (aside @ aside - radius**2)
    hit = np.where(square > 0, (-half_b - np.sqrt(np.maximum(square, 0))) / a, np.inf)
    height = origin[2] + np.where(np.isfinite(hit), hit, 0.0) * rays[..., 2]
    hit = np.where((hit > 0) & (height >= 0) & (height <= top), hit, np.inf)
    return hit, np.full(hit.shape, TRAIN_ID["pole"], np.uint8)


def digests_of(folder: Path) -> dict[str, str]:
    """SHA-256 of every file below `folder` by relative path."""
    files = sorted(path for path in folder.rglob("*") if not path.is_dir())
    return {path.relative_to(folder).as_posix(): _files.sha256_of_file(path) for path in files}
