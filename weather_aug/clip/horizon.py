"""How far a camera looks down, from the lines that run along the street to the horizon."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled

WIDEST_PX, TALLEST_PX = 320, 640
STEEPEST_RAD = math.radians(10.0)
USUAL_PITCH_RAD = math.radians(3.0)
SIDEWAYS_SHARE = 0.3
ROW_STEP_PX, COLUMN_STEP_PX = 2.0, 4.0
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
    small, scale = shrunk(image)
    height, width = small.shape[:2]
    segments = _segments(small)
    # Pixel centres sit at integers, so the picture starts half a pixel before 0.
    centre_x, centre_y = ((place + 0.5) * scale - 0.5 for place in principal_px)
    focal = focal_px * scale
    reach = min(focal * math.tan(STEEPEST_RAD), float(height))
    pitches = np.arctan(_steps(reach, ROW_STEP_PX) / focal)
    rows = centre_y - focal * np.tan(pitches)
    columns = centre_x + _steps(SIDEWAYS_SHARE * width, COLUMN_STEP_PX)
    score = _length_through(segments, rows, columns).max(axis=1) / width
    score = BELIEF * score / (SURE_LENGTH + segments[:, 4].sum() / width)
    likely = score - 0.5 * (pitches / USUAL_PITCH_RAD) ** 2
    return float(pitches[int(likely.argmax())])


def shrunk(image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], float]:
    """A copy of at most 320 x 640 pixels, and its scale: 1 where the picture is no larger."""
    height, width = image.shape[:2]
    scale = min(1.0, WIDEST_PX / width, TALLEST_PX / height)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA)), scale


def _steps(reach: float, step: float) -> NDArray[np.float64]:
    count = int(reach / step)
    return step * np.arange(-count, count + 1, dtype=np.float64)


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


@compiled
def _length_through(
    segments: NDArray[np.float64], rows: NDArray[np.float64], columns: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(R, C) length of the segments that point at each place, less where they miss it."""
    total = np.zeros((len(rows), len(columns)))
    for index in range(len(segments)):
        x, y, along_x, along_y, length = segments[index]
        for i in range(len(rows)):
            dy = rows[i] - y
            for j in range(len(columns)):
                dx = columns[j] - x
                off = abs(dx * along_y - dy * along_x) / max(math.sqrt(dx * dx + dy * dy), 1.0)
                if off < TOLERANCE_RAD:
                    total[i, j] += length * (1.0 - off / TOLERANCE_RAD)
    return total
