"""Where the horizon of a level-standing camera is, from the lines that run along the street."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

WORKING_WIDTH_PX = 320
STEEPEST_RAD = math.radians(10.0)
USUAL_PITCH_RAD = math.radians(3.0)
SIDEWAYS_SHARE = 0.3
STEP_PX = 2.0
TOLERANCE_RAD = math.radians(2.0)
LEAST_SINE, GREATEST_SINE = 0.06, 0.97
LEAST_LENGTH_SHARE = 0.03
SURE_LENGTH = 8.0
BELIEF = 12.0


def pitch_from_picture(
    image: NDArray[np.uint8], *, focal_px: float, principal_px: tuple[float, float]
) -> float:
    """How far the camera looks down, radians: from where the lines of the street meet.

    Kerbs, lane marks, eaves and rows of windows meet in one point on the horizon. Each point near
    the principal one is scored by the length of the segments that run through it; a pitch of some
    degrees is usual, so that a picture without such lines counts as level.

    Args:
        image: (H, W, 3) uint8 RGB.
        focal_px: Vertical focal length, pixels.
        principal_px: Principal point (cx, cy), pixels.

    Returns:
        Radians in [-0.175, 0.175], above 0 where the camera looks down.
    """
    height, width = image.shape[:2]
    scale = min(1.0, WORKING_WIDTH_PX / width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    segments = _segments(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
    # Pixel centres sit at integers, so the picture starts half a pixel before 0.
    centre = (np.array(principal_px) + 0.5) * scale - 0.5
    focal = focal_px * scale
    pitches = np.arctan(_steps(focal * math.tan(STEEPEST_RAD)) / focal)
    rows = centre[1] - focal * np.tan(pitches)
    columns = centre[0] + _steps(SIDEWAYS_SHARE * size[0])
    score = _length_through(segments, rows, columns).max(axis=1) / size[0]
    score = BELIEF * score / (SURE_LENGTH + segments[:, 4].sum() / size[0])
    likely = score - 0.5 * (pitches / USUAL_PITCH_RAD) ** 2
    return float(pitches[int(likely.argmax())])


def _steps(reach: float) -> NDArray[np.float64]:
    count = int(reach / STEP_PX)
    return STEP_PX * np.arange(-count, count + 1, dtype=np.float64)


def _segments(image: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Middle (x, y), direction (x, y) and length of oblique segments, (N, 5), pixels."""
    if min(image.shape[:2]) < 8:
        return np.zeros((0, 5))
    found = cv2.createLineSegmentDetector(0).detect(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))[0]
    ends = np.zeros((0, 4)) if found is None else found.reshape(-1, 4).astype(np.float64)
    run = ends[:, 2:] - ends[:, :2]
    length = np.hypot(run[:, 0], run[:, 1])
    sine = np.abs(run[:, 1]) / np.maximum(length, 1e-6)
    # Level lines cross the street and upright ones stand: they meet elsewhere.
    kept = (sine > LEAST_SINE) & (sine < GREATEST_SINE)
    kept &= length > LEAST_LENGTH_SHARE * image.shape[1]
    middle, unit = (ends[:, :2] + ends[:, 2:]) / 2, run / np.maximum(length, 1e-6)[:, None]
    return np.column_stack([middle, unit, length])[kept]


def _length_through(
    segments: NDArray[np.float64], rows: NDArray[np.float64], columns: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(R, C) length of the segments that point at each place, less where they miss it."""
    x, y, ux, uy, length = segments.T[:, :, None, None]
    dx, dy = columns[None, None, :] - x, rows[None, :, None] - y
    off = np.abs(dx * uy - dy * ux) / np.maximum(np.hypot(dx, dy), 1.0)
    through = length * np.maximum(0.0, 1.0 - off / TOLERANCE_RAD)
    total: NDArray[np.float64] = through.sum(axis=0)
    return total
