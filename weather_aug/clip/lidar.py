"""Depth from LiDAR points: projected, cleared of what the camera cannot see, and completed."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import image_uint8, like_image
from weather_aug.clip.completion import completed, depth_jump, sharpened
from weather_aug.clip.edges import refined
from weather_aug.clip.sky import sky_mask
from weather_aug.errors import ArgumentError
from weather_aug.taxonomy import SKY

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

MIN_DEPTH_M = 0.5
MAX_DEPTH_M = 400.0
LINE_SPACING_RAD = 0.0075
SEE_THROUGH_RATIO = 1.1
SEE_THROUGH_M = 0.5
HOLD = 20.0
HOLD_AT_JUMP = 0.2
JUMP_RATIO = 1.3
MIN_RETURNS = 6
MAX_REACH_PX = 16
MIN_BELIEF = 0.5


def lidar_depth(
    points_camera: NDArray[np.floating],
    intrinsics: Float64,
    image: NDArray[np.uint8],
    label: NDArray[np.uint8] | None = None,
) -> Float32:
    """Dense z-depth of a picture from one LiDAR sweep.

    Above the reach of the LiDAR, surfaces go on upward at the depth they have below.

    Args:
        points_camera: (N, 3) points in camera axes, metres.
        intrinsics: (3, 3) pixels.
        image: (H, W, 3) uint8 RGB, guides the completion.
        label: (H, W) train ids for the sky, or None to find the sky by `sky_mask`.

    Returns:
        (H, W) float32 metres, above 0, `inf` in the sky.

    Raises:
        ArgumentError: If shapes do not fit, or no point falls into the picture.
    """
    image = image_uint8("image", image)
    shape = image.shape[:2]
    sparse = without_see_through(
        projected_depth(points_camera, intrinsics, shape), float(intrinsics[0, 0])
    )
    measured = sparse > 0
    if not measured.any():
        raise ArgumentError(
            "points_camera: no point falls into the picture; check the calibration between them"
        )
    if label is None:
        sky = sky_mask(image) & ~_returning(measured, _line_px(intrinsics))
    else:
        like_image("label", label, shape)
        sky = label == SKY
    measured &= ~sky
    inverse = np.where(measured, 1 / np.maximum(sparse, MIN_DEPTH_M), 0).astype(np.float32)
    confidence = np.where(measured, HOLD, 0).astype(np.float32)
    confidence[measured & _at_jump(sparse, _line_px(intrinsics))] = HOLD_AT_JUMP
    smooth = completed(inverse, confidence, image, barrier=sky)
    sharp = sharpened(smooth, min_jump=depth_jump(float(intrinsics[1, 1])))
    depth = 1 / np.clip(sharp, 1 / MAX_DEPTH_M, 1 / MIN_DEPTH_M)
    return refined(
        np.where(sky, np.inf, depth).astype(np.float32),
        image,
        label=label,
        confidence=_belief(measured, _line_px(intrinsics)),
        min_jump_per_m=depth_jump(float(intrinsics[1, 1])),
        reach_px=min(MAX_REACH_PX, max(6, _line_px(intrinsics))),
    )


def projected_depth(
    points_camera: NDArray[np.floating], intrinsics: Float64, shape: tuple[int, int]
) -> Float32:
    """Depth of the nearest point in each pixel, (H, W) float32 metres, 0 where there is none."""
    points = np.asarray(points_camera)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ArgumentError(f"points_camera must have shape (N, 3), got {points.shape}")
    points = points[points[:, 2] > MIN_DEPTH_M].astype(np.float64)
    pixels = points @ np.asarray(intrinsics, np.float64).T
    columns = np.rint(pixels[:, 0] / pixels[:, 2])
    rows = np.rint(pixels[:, 1] / pixels[:, 2])
    seen = (columns >= 0) & (columns < shape[1]) & (rows >= 0) & (rows < shape[0])
    nearest = np.full(shape[0] * shape[1], np.inf, np.float32)
    places = rows[seen].astype(np.int64) * shape[1] + columns[seen].astype(np.int64)
    np.minimum.at(nearest, places, points[seen, 2].astype(np.float32))
    return np.where(np.isfinite(nearest), nearest, 0).reshape(shape).astype(np.float32)


def without_see_through(sparse: Float32, focal_px: float) -> Float32:
    """Drop points that lie behind a surface the LiDAR sees around them.

    The LiDAR sits beside the camera and sees past edges that hide the point from the camera. A
    point goes if nearer ones lie within a line spacing on two opposite sides; ground, which is
    nearer only below, stays.
    """
    side = max(2, round(LINE_SPACING_RAD * focal_px))
    depth = np.where(sparse > 0, sparse, np.inf).astype(np.float32)
    limit = depth / SEE_THROUGH_RATIO - SEE_THROUGH_M
    beside, wide = np.ones((2 * side + 1, side), np.uint8), np.ones((side, 2 * side + 1), np.uint8)
    # The anchor is a kernel's last or first cell, so that it looks to one side only.
    left = cv2.erode(depth, beside, anchor=(side - 1, side))
    right = cv2.erode(depth, beside, anchor=(0, side))
    above = cv2.erode(depth, wide, anchor=(side, side - 1))
    below = cv2.erode(depth, wide, anchor=(side, 0))
    hidden = (np.maximum(left, right) < limit) | (np.maximum(above, below) < limit)
    return np.where(hidden, 0, sparse).astype(np.float32)


def _belief(measured: NDArray[np.bool_], side: int) -> Float32:
    """How far each depth is believed: by how far away the next return is."""
    away = cv2.distanceTransform((~measured).astype(np.uint8), cv2.DIST_L2, 3)
    return np.maximum(MIN_BELIEF, 1 / (1 + (2 * away / side) ** 2)).astype(np.float32)


def _returning(measured: NDArray[np.bool_], side: int) -> NDArray[np.bool_]:
    """Pixels at a return, or amid several: a wall, however much it looks like sky."""
    returns = measured.astype(np.float32)
    window = (4 * side + 1, 4 * side + 1)
    count = cv2.boxFilter(returns, -1, window, normalize=False)
    at_return = cv2.dilate(returns, np.ones((3, 3), np.uint8)) > 0
    return np.asarray(at_return | (count >= MIN_RETURNS))


def _at_jump(sparse: Float32, side: int) -> NDArray[np.bool_]:
    """Points within a line spacing of a depth edge.

    Their place in the picture is uncertain by the motion between the scan and the shutter, so the
    picture's own edges should decide there.
    """
    kernel = np.ones((side, 2 * side + 1), np.uint8)
    far = cv2.dilate(sparse, kernel)
    near = cv2.erode(np.where(sparse > 0, sparse, np.inf).astype(np.float32), kernel)
    return np.asarray((far / JUMP_RATIO > near) & (far - near > 1.0))


def _line_px(intrinsics: Float64) -> int:
    return max(2, round(LINE_SPACING_RAD * float(intrinsics[1, 1])))
