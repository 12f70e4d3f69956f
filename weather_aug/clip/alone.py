"""Depth from a picture alone: its horizon, its ground, its sky, and what stands between.

A picture says too little to measure depth. It says enough to part it into ground, sky and the rest,
and these make a label map for the same geometric prior that serves labelled pictures.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import finite, image_uint8
from weather_aug.clip.drivable import edge_behind, ground_edge
from weather_aug.clip.horizon import pitch_from_picture
from weather_aug.clip.prior import geometric_prior_depth
from weather_aug.clip.sky import sky_mask
from weather_aug.taxonomy import BUILDING, ROAD, SKY, TRAIN_ID

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]

WORKING_WIDTH_PX = 320
ABOVE_HORIZON_SHARE = 0.2
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
    label, pitch_rad = surfaces_of(image, focal_px=focal_px, principal_px=principal_px)
    return geometric_prior_depth(
        label,
        focal_px=focal_px,
        principal_px=principal_px,
        camera_height_m=camera_height_m,
        pitch_rad=pitch_rad,
    )


def surfaces_of(image: UInt8, *, focal_px: float, principal_px: tuple[float, float]) -> Surfaces:
    """What an unlabelled picture seems to show; see `depth_from_picture`.

    Raises:
        ArgumentError: If an argument is outside its range.
    """
    focal_px = finite("focal_px", focal_px, 1e-3)
    x, y = (finite(f"principal_px[{i}]", principal_px[i], -1e6, 1e6) for i in range(2))
    pitch_rad = pitch_from_picture(image, focal_px=focal_px, principal_px=(x, y))
    horizon_px = y - focal_px * math.tan(pitch_rad)
    height, width = image.shape[:2]
    scale = min(1.0, WORKING_WIDTH_PX / width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    horizon = (horizon_px + 0.5) * scale - 0.5
    sky = _open_sky(small, horizon)
    edge = ground_edge(
        small,
        sky,
        horizon_px=horizon,
        focal_px=focal_px * scale,
        principal_x_px=(x + 0.5) * scale - 0.5,
    )
    behind = edge_behind(edge, horizon)
    drop = edge - horizon
    top = np.where(behind < edge, horizon - ABOVE_HORIZON_SHARE * drop, edge)
    rows = np.arange(height)[:, None]
    ground, low = (rows >= _rows_at(line, width, scale) for line in (edge, top))
    high = cv2.resize(sky.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    standing = np.where(low, CAR, np.where(high > 0.5, SKY, BUILDING))
    return Surfaces(np.where(ground, ROAD, standing).astype(np.uint8), pitch_rad)


def _open_sky(image: UInt8, horizon_px: float) -> NDArray[np.bool_]:
    """Sky above the horizon that hangs together: without labels, its holes may be windows."""
    sky = sky_mask(image)
    # Nothing below the horizon is sky, however bright.
    sky[int(np.clip(np.floor(horizon_px) + 1, 0, len(sky))) :] = False
    _, parts = cv2.connectedComponents(cv2.dilate(sky.astype(np.uint8), np.ones((3, 3), np.uint8)))
    return np.isin(parts, np.unique(parts[:2][sky[:2]])) & sky


def _rows_at(line: NDArray[Any], width: int, scale: float) -> Float32:
    """A line of rows (w,) of the small picture at the columns of the whole one, (W,)."""
    row = line.astype(np.float32)[None]
    grown = cv2.resize(row, (width, 1), interpolation=cv2.INTER_LINEAR)[0]
    return np.rint((grown + np.float32(0.5)) / np.float32(scale) - np.float32(0.5))
