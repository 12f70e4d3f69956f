"""A street of Gaussians for the benchmarks: a road, two façades and parked boxes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from weather_aug.gaussians.types import Pinhole

CAMERA_HEIGHT_M, FACADE_M, ROOF_M = 1.5, 9.0, 10.0
NEAREST_M, FARTHEST_M = 2.0, 80.0
BOX_M = np.array([1.9, 1.6, 4.2])
BOXES = 10
SHARES = {"road": 0.4, "façades": 0.45, "boxes": 0.15}
WIDTH, THICKNESS = 1.2, 0.2
"""Of a Gaussian along its surface, over the spacing, so that no holes are left; and along the
surface's normal, over its width."""
FOCAL = 0.58
"""Focal length over the picture's width, as of KITTI's cameras."""


class Street(NamedTuple):
    """What the rasteriser and its peer take, before the lens."""

    means_m: Tensor
    quaternions: Tensor
    scales_m: Tensor
    opacities: Tensor
    colours: Tensor
    camera_from_world: Tensor


def lens(width: int, height: int) -> Pinhole:
    """A camera that looks along the street, the horizon in the middle."""
    return Pinhole(FOCAL * width, FOCAL * width, (width - 1) / 2, (height - 1) / 2, width, height)


def street_of(count: int, seed: int = 0) -> Street:
    """`count` Gaussians as wide as the spacing of their neighbours; one draw for all counts.

    Evenly drawn over the logarithm of depth: as many far away as near, as measured points are.
    """
    rng = np.random.default_rng(seed)
    parts = [
        _road(rng, round(SHARES["road"] * count)),
        _facades(rng, round(SHARES["façades"] * count)),
    ]
    parts.append(_boxes(rng, count - sum(len(points) for points, _ in parts)))
    points = np.concatenate([points for points, _ in parts])
    normal_axes = np.concatenate([axes for _, axes in parts])
    # The spacing is the distance to the three nearest, as 3DGS starts its Gaussians.
    spacing = cKDTree(points).query(points, k=4)[0][:, 1:].mean(axis=1)
    scales = np.repeat(WIDTH * spacing[:, None], 3, axis=1) * rng.uniform(0.6, 1.4, (count, 3))
    scales[np.arange(count), normal_axes] *= THICKNESS
    # Nearly along the surface: a tilt of a few degrees about a random axis.
    quaternions = np.concatenate([np.ones((count, 1)), rng.normal(0, 0.05, (count, 3))], axis=1)
    stripes = 0.5 + 0.2 * np.sin(points * (1.1, 1.7, 0.9)).sum(axis=1, keepdims=True) / 3
    colours = np.clip(stripes + rng.normal(0, 0.08, (count, 3)), 0, 1)
    opacities = rng.uniform(0.3, 0.98, count)
    arrays = (points, quaternions, scales, opacities, colours, np.eye(4))
    return Street(*(torch.from_numpy(array.astype(np.float32)) for array in arrays))


Points = tuple[NDArray[np.float64], NDArray[np.int64]]
"""(n, 3) places in the camera's axes, and the axis (n,) that is normal to the surface."""


def _depths(rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    return NEAREST_M * (FARTHEST_M / NEAREST_M) ** rng.uniform(0, 1, count)


def _road(rng: np.random.Generator, count: int) -> Points:
    across = rng.uniform(-FACADE_M, FACADE_M, count)
    places = np.stack([across, np.full(count, CAMERA_HEIGHT_M), _depths(rng, count)], axis=1)
    return places, np.full(count, 1)


def _facades(rng: np.random.Generator, count: int) -> Points:
    sides = np.where(rng.uniform(0, 1, count) < 0.5, -FACADE_M, FACADE_M)
    heights = CAMERA_HEIGHT_M - ROOF_M * rng.uniform(0, 1, count)
    return np.stack([sides, heights, _depths(rng, count)], axis=1), np.full(count, 0)


def _boxes(rng: np.random.Generator, count: int) -> Points:
    """On the faces of parked cars, evenly over cars and faces."""
    middles = np.stack(
        [
            np.where(np.arange(BOXES) % 2, -4.5, 4.5),
            np.full(BOXES, CAMERA_HEIGHT_M - BOX_M[1] / 2),
            6.0 * 1.28 ** np.arange(BOXES),
        ],
        axis=1,
    )
    places = rng.uniform(-0.5, 0.5, (count, 3))
    axes = rng.integers(0, 3, count)
    places[np.arange(count), axes] = np.where(rng.uniform(0, 1, count) < 0.5, -0.5, 0.5)
    return middles[rng.integers(0, BOXES, count)] + places * BOX_M, axes
