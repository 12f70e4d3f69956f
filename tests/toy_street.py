"""A checkered street of boxes in 14 views of 320x192, to learn as Gaussians in under a minute."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from box_street import CARS, FACADES, BoxStreet

from weather_aug.clip.types import Camera, Float64, Frame, FrameKey
from weather_aug.taxonomy import BUILDING, ROAD, SKY

FINER = 2
"""Pixels are means of as many squared, so that edges are as soft as a camera's."""
COLOURS = {ROAD: (105, 105, 110), BUILDING: (170, 120, 90), SKY: (150, 180, 225)}
CAR_COLOUR = (40, 70, 160)


class _Slowly(BoxStreet):
    """A metre a step."""

    def camera(self, key: FrameKey) -> Camera:
        camera = super().camera(key)
        pose = camera.world_from_camera.copy()
        pose[0, 3] = 1.0 * key.time_index
        return replace(camera, world_from_camera=pose)


def frames(
    views: int = 14, width: int = 320, height: int = 192, noise: float = 0.01
) -> list[Frame]:
    """A drive of a metre a step; the depth has relative `noise`."""
    street = _Slowly(
        boxes=(*FACADES, *CARS[2:12]), frames=views, width=FINER * width, height=FINER * height
    )
    return [_frame(street.frame(key), noise) for key in street.keys]


def _frame(fine: Frame, noise: float) -> Frame:
    assert fine.depth_m is not None and fine.label is not None
    camera = fine.camera.resized(fine.camera.width // FINER, fine.camera.height // FINER)
    image = cv2.resize(_painted(fine), (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    depth, label = (np.ascontiguousarray(p[::FINER, ::FINER]) for p in (fine.depth_m, fine.label))
    rng = np.random.default_rng(fine.key.time_index)
    depth = depth * (1 + noise * rng.standard_normal(depth.shape).astype(np.float32))
    return replace(fine, camera=camera, image=image, label=label, depth_m=depth)


def _painted(frame: Frame) -> np.ndarray:
    """Squares of a metre and a half, lighter and darker, on everything but the sky."""
    camera, label = frame.camera, frame.label
    rows, columns = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([columns, rows, np.ones_like(rows)], -1) @ np.linalg.inv(camera.intrinsics).T
    depth = np.where(np.isfinite(frame.depth_m), frame.depth_m, 0.0)
    points: Float64 = (rays * depth[..., None]) @ camera.world_from_camera[:3, :3].T
    points = points + camera.centre_world
    squares = np.floor(points / 1.5 + 1e-3).astype(int).sum(axis=-1) % 2
    shade = np.where(label == SKY, 1.0, 0.75 + 0.5 * squares)
    colours = np.full((256, 3), CAR_COLOUR, np.float64)
    for index, colour in COLOURS.items():
        colours[index] = colour
    return np.clip(colours[label] * shade[..., None], 0, 255).astype(np.uint8)
