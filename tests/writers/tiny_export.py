"""A tiny labelled street in memory, and what a test compares of an export of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from weather_aug import _files
from weather_aug.clip.types import Camera, Frame, FrameKey, check_key
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.taxonomy import TRAIN_ID

POLICY = WeatherPolicy(types={"clear": 1, "rain": 2, "snow": 2, "fog": 1})


@dataclass(frozen=True)
class TinyClip:
    """Frames of a road under a sky with one car, seen from a rig that drives ahead."""

    name: str = "tiny"
    frames: int = 4
    width: int = 48
    height: int = 32
    labelled: bool = True
    tint: int = 0
    cameras: tuple[str, ...] = ("front",)
    up_world: np.ndarray = field(default_factory=lambda: np.array([0.0, -1.0, 0.0]))

    @property
    def keys(self) -> tuple[FrameKey, ...]:
        return tuple(
            FrameKey(time, camera) for time in range(self.frames) for camera in self.cameras
        )

    def frame(self, key: FrameKey) -> Frame:
        key = check_key(self, key)
        width, height = self.width, self.height
        intrinsics = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]])
        pose = np.eye(4)
        pose[2, 3] = key.time_index
        rows, columns = np.mgrid[:height, :width]
        below = rows - height / 2
        label = np.where(below > 0, TRAIN_ID["road"], TRAIN_ID["sky"]).astype(np.uint8)
        label[height // 2 : height // 2 + 4, 8 + key.time_index : 16] = TRAIN_ID["car"]
        depth = np.where(below > 0, 1.6 * width / np.maximum(below, 0.5), np.inf)
        noise = (rows * 7 + columns * 13 + key.time_index * 31 + self.tint) % 64
        image = np.stack([90 + noise, 100 + noise, 110 + noise], axis=-1).astype(np.uint8)
        return Frame(
            key,
            0.1 * key.time_index,
            Camera(intrinsics, pose, width, height),
            image,
            label if self.labelled else None,
            depth.astype(np.float32),
        )


def tree_of(out: Path) -> dict[str, str]:
    """SHA-256 of every file by relative path, in a fixed order."""
    files = sorted(path for path in out.rglob("*") if not path.is_dir())
    return {path.relative_to(out).as_posix(): _files.sha256_of_file(path) for path in files}
