"""Depth from a picture alone: its horizon, its ground, its sky, and what stands between.

A picture says too little to measure depth. It says enough to part it into ground, sky and the rest,
and these make a label map for the same geometric prior that serves labelled pictures.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import finite, image_uint8
from weather_aug._compiled import compiled
from weather_aug.clip.completion import completed
from weather_aug.clip.drivable import edge_behind, ground_edge
from weather_aug.clip.horizon import pitch_from_picture, shrunk
from weather_aug.clip.prior import MAX_DEPTH_M, MIN_DEPTH_M, geometric_prior_depth
from weather_aug.clip.sky import sky_mask
from weather_aug.taxonomy import BUILDING, ROAD, SKY, TRAIN_ID

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]

ABOVE_HORIZON_SHARE = 0.2
GROUND_CONFIDENCE, FOOT_CONFIDENCE, FACADE_CONFIDENCE = 100.0, 1.0, 3e-3
FOOT_ROWS = 3
SWEEPS = 8
COLOUR_REACH_PX = 9
CAR = TRAIN_ID["car"]


class Surfaces(NamedTuple):
    """What a picture shows, and how the camera stands."""

    label: UInt8
    """(H, W) train ids; of a guess road, sky, car for what is low and narrow, building for all else
    that stands."""
    pitch_rad: float
    """How far the camera looks down."""


def depth_from_picture(
    image: UInt8,
    *,
    focal_px: float,
    principal_px: tuple[float, float],
    camera_height_m: float = 1.5,
) -> Float32:
    """Dense z-depth that an unlabelled picture of a street suggests: coarse, and never measured.

    The ground is flat and the camera level across the road; its pitch is that of
    `horizon.pitch_from_picture`. What is neither ground nor sky stands upright where it meets the
    ground in its column, see `prior.geometric_prior_depth`.

    Args:
        image: (H, W, 3) uint8 RGB.
        focal_px: Vertical focal length, pixels.
        principal_px: Principal point (cx, cy), pixels.
        camera_height_m: Height of the camera over the ground, metres.

    Returns:
        (H, W) float32 metres in [0.5, 200], `inf` in the sky.

    Raises:
        ArgumentError: If an argument has another type or shape, or is outside its range.
    """
    image = image_uint8("image", image)
    finite("camera_height_m", camera_height_m, 0.1, 100.0)
    parted = _parted(image, focal_px, principal_px)
    prior = geometric_prior_depth(
        parted.label,
        focal_px=focal_px * parted.scale,
        principal_px=parted.principal_px,
        camera_height_m=camera_height_m,
        pitch_rad=parted.pitch_rad,
    )
    sky = parted.label == SKY
    # In inverse depth the ground is linear, and a membrane over it stays flat.
    inverse = completed(
        np.reciprocal(prior), _confidence(parted.label), parted.image, barrier=sky, sweeps=SWEEPS
    )
    height, width = image.shape[:2]
    grown = cv2.resize(inverse, (width, height), interpolation=cv2.INTER_LINEAR)
    depth = 1 / np.clip(grown, 1 / MAX_DEPTH_M, 1 / MIN_DEPTH_M)
    depth[_sky_at_full_size(image, parted.image, sky)] = np.inf
    return np.asarray(depth, np.float32)


def _confidence(label: UInt8) -> Float32:
    """How far the prior is believed: on the ground, less at a foot, hardly above it."""
    confidence = np.full(label.shape, FACADE_CONFIDENCE, np.float32)
    confidence[label == CAR] = 0
    confidence[(label == ROAD)] = GROUND_CONFIDENCE
    stands = (label == BUILDING) | (label == CAR)
    foot = np.zeros_like(stands)
    for rows in range(1, FOOT_ROWS + 1):
        foot[:-rows] |= stands[:-rows] & (label[rows:] == ROAD)
    confidence[foot] = FOOT_CONFIDENCE
    confidence[label == SKY] = 0
    return confidence


def surfaces_of(image: UInt8, *, focal_px: float, principal_px: tuple[float, float]) -> Surfaces:
    """What an unlabelled picture seems to show; see `depth_from_picture`.

    Raises:
        ArgumentError: If an argument is outside its range.
    """
    parted = _parted(image, focal_px, principal_px)
    size = image.shape[1::-1]
    label = cv2.resize(parted.label, size, interpolation=cv2.INTER_NEAREST_EXACT)
    return Surfaces(np.asarray(label), parted.pitch_rad)


class _Parted(NamedTuple):
    """A picture, shrunk by `scale`, and what it seems to show."""

    image: UInt8
    label: UInt8
    scale: float
    principal_px: tuple[float, float]
    pitch_rad: float


def _parted(image: UInt8, focal_px: float, principal_px: tuple[float, float]) -> _Parted:
    focal_px = finite("focal_px", focal_px, 1e-3)
    x, y = (finite(f"principal_px[{i}]", principal_px[i], -1e6, 1e6) for i in range(2))
    small, scale = shrunk(image)
    # Pixel centres sit at integers, so the picture starts half a pixel before 0.
    x, y, focal_px = (x + 0.5) * scale - 0.5, (y + 0.5) * scale - 0.5, focal_px * scale
    pitch_rad = pitch_from_picture(small, focal_px=focal_px, principal_px=(x, y))
    horizon_px = y - focal_px * math.tan(pitch_rad)
    sky = _open_sky(small, horizon_px)
    edge = ground_edge(small, sky, horizon_px=horizon_px, focal_px=focal_px, principal_x_px=x)
    behind = edge_behind(edge, horizon_px)
    top = np.where(behind < edge, horizon_px - ABOVE_HORIZON_SHARE * (edge - horizon_px), edge)
    rows = np.arange(len(small))[:, None]
    standing = np.where(rows >= np.rint(top), CAR, np.where(sky, SKY, BUILDING))
    label = np.where(rows >= edge, ROAD, standing).astype(np.uint8)
    return _Parted(small, label, scale, (x, y), pitch_rad)


def _sky_at_full_size(image: UInt8, small: UInt8, sky: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The small picture's sky (h, w) at full size (H, W), its border where the colours part."""
    size = image.shape[1::-1]
    share = cv2.blur(sky.astype(np.float32), (3, 3))
    share = cv2.resize(share, size, interpolation=cv2.INTER_LINEAR)
    if image.shape == small.shape or not sky.any():
        return np.asarray(share > 0.5)
    sides = [_mean_colour(small, mask.astype(np.float32)) for mask in (sky, ~sky)]
    border: NDArray[np.bool_] = _parted_by_colour(image, share, *sides)
    return border


def _mean_colour(image: UInt8, weight: Float32) -> Float32:
    """Of the weighted pixels around each, (h, w, 3)."""
    reach = (COLOUR_REACH_PX, COLOUR_REACH_PX)
    total = cv2.blur(image * weight[..., None], reach)
    return np.asarray(total / np.maximum(cv2.blur(weight, reach), 1e-6)[..., None], np.float32)


@compiled
def _parted_by_colour(
    image: UInt8, share: Float32, sky: Float32, land: Float32
) -> NDArray[np.bool_]:
    """Near the border (0 < share < 1) the side whose colour nearby is closer, (H, W)."""
    height, width = share.shape
    rows, columns = sky.shape[:2]
    found = share > np.float32(0.5)
    for row in range(height):
        i = row * rows // height
        for column in range(width):
            if np.float32(0.02) < share[row, column] < np.float32(0.98):
                j = column * columns // width
                to_sky = to_land = np.float32(0.0)
                for channel in range(3):
                    value = np.float32(image[row, column, channel])
                    to_sky += (value - sky[i, j, channel]) ** 2
                    to_land += (value - land[i, j, channel]) ** 2
                found[row, column] = to_sky < to_land
    return found


def _open_sky(image: UInt8, horizon_px: float) -> NDArray[np.bool_]:
    """Sky above the horizon that hangs together: without labels, its holes may be windows."""
    sky = sky_mask(image)
    # Nothing below the horizon is sky, however bright.
    sky[int(np.clip(np.floor(horizon_px) + 1, 0, len(sky))) :] = False
    _, parts = cv2.connectedComponents(cv2.dilate(sky.astype(np.uint8), np.ones((3, 3), np.uint8)))
    return np.isin(parts, np.unique(parts[:2][sky[:2]])) & sky
