"""A street of Gaussians in milliseconds, without a fit: road, two walls, a moving car, sky.

x ahead, y left, z up, metres. The road is z = 0 from x = -2 to 40 and 4.5 m to each side, where
walls of 5 m stand: a building at the left, a hedge at the right. A car drives ahead of the camera,
both with the same speed at first. Surfaces are sheets of Gaussians two centimetres thick.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from weather_aug._keys import key_of, uniforms
from weather_aug.clip.types import Camera, Float64, FrameKey
from weather_aug.gaussians.types import CLASSES, Actor, Gaussians, Reconstruction, Sky, Style
from weather_aug.taxonomy import BUILDING, ROAD, TRAIN_ID, VEGETATION

Y_DC = 0.28209479177387814
"""The constant harmonic: colour = 0.5 + Y_DC · coefficient."""
CAR = TRAIN_ID["car"]
TRACK_ID = 7
CAR_SIZE_M = (4.0, 1.8, 1.5)
HALF_WIDTH_M, WALL_M = 4.5, 5.0
ROAD_X_M = (-2.0, 40.0)
TIMES_S = tuple(0.2 * index for index in range(6))
SPEED_M_PER_S = 5.0
SIZE_PX = (96, 64)
COLOURS = {
    ROAD: (0.36, 0.35, 0.35),
    BUILDING: (0.62, 0.42, 0.30),
    VEGETATION: (0.25, 0.45, 0.22),
    CAR: (0.15, 0.25, 0.65),
}
SNOW = (0.92, 0.93, 0.96)
_THICKNESS_M = 0.02
_SQRT_HALF = np.sqrt(0.5)
_Z_TO = {  # quaternions that turn z to an axis
    0: (_SQRT_HALF, 0.0, _SQRT_HALF, 0.0),
    1: (_SQRT_HALF, -_SQRT_HALF, 0.0, 0.0),
    2: (1.0, 0.0, 0.0, 0.0),
}


def camera_at(
    x_m: float, y_m: float = 0.0, yaw_deg: float = 0.0, size_px: tuple[int, int] = SIZE_PX
) -> Camera:
    """A camera 1.5 m over the road that looks ahead, turned by `yaw_deg` to the left."""
    yaw = np.deg2rad(yaw_deg)
    ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, (0.0, 0.0, -1.0), ahead], axis=1)
    pose[:3, 3] = (x_m, y_m, 1.5)
    width, height = size_px
    focal_px = 0.7 * width
    centre = ((width - 1) / 2, (height - 1) / 2)
    intrinsics = np.array([[focal_px, 0, centre[0]], [0, focal_px, centre[1]], [0, 0, 1.0]])
    return Camera(intrinsics, pose, width, height)


def tiny_reconstruction(
    *, spacing_m: float = 0.5, car: bool = True, styles: Sequence[str] = ("snow",)
) -> Reconstruction:
    """The street with its colours of degree 1, scores that are certain, and a car or none.

    Args:
        spacing_m: Between Gaussians; 0.5 makes some 3,000.
        car: Whether the car is there, as track 7.
        styles: Names of styles; each is the scene under snow.
    """
    ground = _sheet(2, (0.0, ROAD_X_M, (-HALF_WIDTH_M, HALF_WIDTH_M)), ROAD, spacing_m)
    left = _sheet(1, (HALF_WIDTH_M, ROAD_X_M, (0.0, WALL_M)), BUILDING, spacing_m)
    right = _sheet(1, (-HALF_WIDTH_M, ROAD_X_M, (0.0, WALL_M)), VEGETATION, spacing_m)
    background = joined((ground, left, right))
    shell = _car(0.5 * spacing_m)
    actor_gaussians = shell if car else _rows(shell, slice(0))
    count = len(actor_gaussians)
    cameras = {
        FrameKey(index, "front"): camera_at(SPEED_M_PER_S * t) for index, t in enumerate(TIMES_S)
    }
    identity = np.eye(3, 4, dtype=np.float32)
    sky = _sky()
    return Reconstruction(
        background=background,
        sky=sky,
        actors=(_actor(),) if car else (),
        actor_gaussians=actor_gaussians,
        owners=np.zeros(count, np.int32),
        offsets_m=np.zeros((count, 4, 3), np.float32),
        cameras=cameras,
        exposures=dict.fromkeys(cameras, identity),
        styles={name: _snowed(background, actor_gaussians, sky) for name in styles},
        support=np.full(len(background), 50.0, np.float32),
    )


def joined(parts: Sequence[Gaussians]) -> Gaussians:
    """All Gaussians of `parts`, in their order."""
    names = ("means_m", "quaternions", "log_scales", "logit_opacities", "sh", "class_scores")
    return Gaussians(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def _rows(gaussians: Gaussians, rows: slice) -> Gaussians:
    names = ("means_m", "quaternions", "log_scales", "logit_opacities", "sh", "class_scores")
    return Gaussians(*(getattr(gaussians, name)[rows] for name in names))


def _sheet(
    axis: int,
    place: tuple[float, tuple[float, float], tuple[float, float]],
    train_id: int,
    spacing_m: float,
) -> Gaussians:
    """A sheet across `axis`: where on it, and from where to where along the other two."""
    at, *spans = place
    others = [index for index in range(3) if index != axis]
    steps = [np.arange(low + spacing_m / 2, high, spacing_m) for low, high in spans]
    grid = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 2)
    means = np.empty((len(grid), 3), np.float32)
    means[:, axis] = at
    means[:, others] = grid
    count = len(grid)
    sides = (0.6 * spacing_m, 0.6 * spacing_m, _THICKNESS_M)
    # A draw for each Gaussian, so that surfaces have a texture and colours a direction.
    draws = uniforms(key_of("tiny scene", train_id, axis, int(1000 * at)), 12 * count)
    sh = (0.05 * (draws.reshape(count, 4, 3) - 0.5)).astype(np.float32)
    sh[:, 0] *= 8
    sh[:, 0] += (np.array(COLOURS[train_id], np.float32) - 0.5) / np.float32(Y_DC)
    scores = np.zeros((count, CLASSES), np.float16)
    scores[:, train_id] = 1
    return Gaussians(
        means,
        np.tile(np.array(_Z_TO[axis], np.float32), (count, 1)),
        np.tile(np.log(np.array(sides, np.float32)), (count, 1)),
        np.full(count, 3.5, np.float32),
        sh,
        scores,
    )


def _car(spacing_m: float) -> Gaussians:
    half = 0.5 * np.array(CAR_SIZE_M)
    spans = [(-side, side) for side in half]
    sides = []
    for axis in range(3):
        others = [spans[index] for index in range(3) if index != axis]
        sides += [
            _sheet(axis, (sign * half[axis], others[0], others[1]), CAR, spacing_m)
            for sign in (-1, 1)
        ]
    return joined(sides)


def _actor() -> Actor:
    poses = np.tile(np.eye(4), (len(TIMES_S), 1, 1))
    poses[:, 0, 3] = 10.0 + SPEED_M_PER_S * np.array(TIMES_S)
    poses[:, 1, 3] = -1.0
    poses[:, 2, 3] = 0.5 * CAR_SIZE_M[2] + 0.2
    return Actor(TRACK_ID, "car", False, CAR_SIZE_M, np.array(TIMES_S), poses)


def _sky() -> Sky:
    """Paler towards the horizon; the lower half was never seen."""
    size = 16
    height = _heights(size)
    blue = np.array([0.35, 0.55, 0.85])
    share = np.clip(height, 0, 1)[..., None]
    faces = (share * blue + (1 - share) * np.array([0.8, 0.85, 0.9])).astype(np.float32)
    return Sky(faces, height > -0.1)


def _heights(size: int) -> Float64:
    """(6, S, S) sine of the elevation of each texel, z up: OpenGL's layout."""
    s, t = np.meshgrid(*[(np.arange(size) + 0.5) / size * 2 - 1] * 2)
    one = np.ones_like(s)
    directions = [
        (one, -t, -s), (-one, -t, s), (s, one, t), (s, -one, -t), (s, -t, one), (-s, -t, -one),
    ]  # fmt: skip
    vectors = np.array(directions).transpose(0, 2, 3, 1)
    heights: NDArray[np.float64] = vectors[..., 2] / np.linalg.norm(vectors, axis=-1)
    return heights


def _snowed(background: Gaussians, actor_gaussians: Gaussians, sky: Sky) -> Style:
    def white(sh: NDArray[np.float32]) -> NDArray[np.float16]:
        whiter = 0.3 * sh
        whiter[:, 0] += 0.7 * (np.array(SNOW, np.float32) - 0.5) / np.float32(Y_DC)
        return whiter.astype(np.float16)

    grey = 0.5 * sky.faces + 0.5 * np.float32(0.85)
    return Style(white(background.sh), white(actor_gaussians.sh), grey.astype(np.float16))
