"""Dense maps from sparse or holed ones: a membrane that bends freely at the picture's edges.

Both stereo and LiDAR leave holes. The missing values x minimise

    sum c (x - v)^2 + sum w_pq (x_p - x_q)^2,    w_pq = max(exp(-|I_p - I_q| / sigma), floor),

with data v of confidence c and the picture I as guide. In inverse depth a plane is linear in the
pixel coordinates and a membrane between measurements is linear too, so ground and facades stay
flat. The system is solved coarse to fine by red-black over-relaxation, in a fixed order.

Source: weighted least squares smoothing, Farbman et al. 2008; the guided form is that of Min et
al. 2014, "Fast Global Image Smoothing".
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled

Float32 = NDArray[np.float32]

EDGE_GREY_LEVELS = 5.0
EDGE_FLOOR = 2e-3
COARSEST_SIDE = 12
SWEEPS = 24
OVER_RELAXATION = np.float32(1.7)


def completed(
    values: Float32,
    confidence: Float32,
    guide: NDArray[np.uint8],
    *,
    barrier: NDArray[np.bool_] | None = None,
    stiffness: float = 1.0,
    sweeps: int = SWEEPS,
) -> Float32:
    """Fill and smooth a map along the picture's edges.

    Args:
        values: (H, W); what is measured where `confidence` is positive, ignored elsewhere. At least
            one value must be measured.
        confidence: (H, W), 0 or more; 1 lets the surroundings pull, 100 holds the value.
        guide: (H, W, 3) picture.
        barrier: (H, W), or None; nothing flows between pixels that differ in it.
        stiffness: Factor on all w; more is smoother.
        sweeps: Relaxation sweeps on each level.

    Returns:
        (H, W) float32.
    """
    across, down = edge_weights(guide, barrier)
    across *= np.float32(stiffness)
    down *= np.float32(stiffness)
    weighted = np.where(confidence > 0, values, 0).astype(np.float32) * confidence
    return _solved(weighted, confidence.astype(np.float32), across, down, sweeps)


def edge_weights(
    guide: NDArray[np.uint8], barrier: NDArray[np.bool_] | None = None
) -> tuple[Float32, Float32]:
    """Weights (H, W-1) across and (H-1, W) down, in [EDGE_FLOOR, 1], 0 at barriers."""
    # A light blur keeps sensor noise and JPEG blocks from counting as edges.
    smooth = cv2.GaussianBlur(guide, (0, 0), 0.7).astype(np.float32)
    across = _weight(greatest(np.abs(np.diff(smooth, axis=1))))
    down = _weight(greatest(np.abs(np.diff(smooth, axis=0))))
    if barrier is not None:
        across[barrier[:, 1:] != barrier[:, :-1]] = 0
        down[barrier[1:] != barrier[:-1]] = 0
    return across, down


def sharpened(inverse: Float32, *, min_jump: float, rounds: int = 4) -> Float32:
    """Turn the ramps at depth edges into steps, so that no surface hangs between two others.

    Where inverse depth (or disparity) varies within 3x3 by more than `min_jump` and by a tenth of
    its value, each pixel takes the nearer of the two extremes (a shock filter).
    """
    sharp = inverse
    kernel = np.ones((3, 3), np.uint8)
    for _ in range(rounds):
        low, high = cv2.erode(sharp, kernel), cv2.dilate(sharp, kernel)
        edge = (high - low) > np.maximum(np.float32(min_jump), 0.1 * high)
        snapped = np.where(sharp - low < high - sharp, low, high)
        sharp = np.where(edge, snapped, sharp).astype(np.float32)
    return sharp


def depth_jump(focal_px: float) -> float:
    """Step of inverse depth (1/m) that is an edge and not ground.

    Ground seen from height h changes by 1 / (f h) a row; within 3x3 that is twice, and seen from
    1.3 m on an uphill road no more than this.
    """
    return 3.0 / focal_px


def greatest(channels: NDArray[Any]) -> NDArray[Any]:
    """(H, W) greatest of three channels (H, W, 3): numpy's own `max` over a short axis is slow."""
    first, second, third = (channels[..., index] for index in range(3))
    return np.maximum(np.maximum(first, second), third)


def _weight(difference: Float32) -> Float32:
    weight = np.exp(difference * np.float32(-1 / EDGE_GREY_LEVELS))
    return np.maximum(weight, np.float32(EDGE_FLOOR)).astype(np.float32)


def _solved(
    weighted: Float32, confidence: Float32, across: Float32, down: Float32, sweeps: int
) -> Float32:
    height, width = weighted.shape
    if min(height, width) <= COARSEST_SIDE:
        total = confidence.sum()
        start = np.full_like(weighted, weighted.sum() / total if total > 0 else 0)
        sweeps = 8 * sweeps
    else:
        less, sure, beside, below = _coarser(weighted, confidence, across, down)
        coarse = _solved(less, sure, beside, below, sweeps)
        start = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    solution: Float32 = _relaxed(start, weighted, confidence, across, down, sweeps, OVER_RELAXATION)
    return solution


@compiled
def _coarser(
    weighted: Float32, confidence: Float32, across: Float32, down: Float32
) -> tuple[Float32, Float32, Float32, Float32]:
    """Sum data over 2x2 blocks; combine weights as resistors in series, then in parallel."""
    height, width = weighted.shape
    rows, columns = (height + 1) // 2, (width + 1) // 2
    coarse_weighted = np.zeros((rows, columns), np.float32)
    coarse_confidence = np.zeros((rows, columns), np.float32)
    for row in range(height):
        for column in range(width):
            coarse_weighted[row // 2, column // 2] += weighted[row, column]
            coarse_confidence[row // 2, column // 2] += confidence[row, column]
    coarse_across = np.zeros((rows, columns - 1), np.float32)
    tiny = np.float32(1e-9)
    half = np.float32(0.5)
    one = np.float32(1.0)
    for row in range(height):
        for column in range(columns - 1):
            fine = 2 * column + 1
            resistance = half / (across[row, fine - 1] + tiny) + one / (across[row, fine] + tiny)
            if fine + 1 < width - 1:
                resistance += half / (across[row, fine + 1] + tiny)
            coarse_across[row // 2, column] += one / resistance
    coarse_down = np.zeros((rows - 1, columns), np.float32)
    for row in range(rows - 1):
        fine = 2 * row + 1
        for column in range(width):
            resistance = half / (down[fine - 1, column] + tiny) + one / (down[fine, column] + tiny)
            if fine + 1 < height - 1:
                resistance += half / (down[fine + 1, column] + tiny)
            coarse_down[row, column // 2] += one / resistance
    return coarse_weighted, coarse_confidence, coarse_across, coarse_down


@compiled
def _relaxed(
    start: Float32,
    weighted: Float32,
    confidence: Float32,
    across: Float32,
    down: Float32,
    sweeps: int,
    omega: np.float32,
) -> Float32:
    height, width = start.shape
    x = start.copy()
    tiny = np.float32(1e-12)
    for _ in range(sweeps):
        for colour in range(2):
            for row in range(height):
                for column in range((row + colour) % 2, width, 2):
                    pull = weighted[row, column]
                    total = confidence[row, column] + tiny
                    if column > 0:
                        weight = across[row, column - 1]
                        pull += weight * x[row, column - 1]
                        total += weight
                    if column < width - 1:
                        weight = across[row, column]
                        pull += weight * x[row, column + 1]
                        total += weight
                    if row > 0:
                        weight = down[row - 1, column]
                        pull += weight * x[row - 1, column]
                        total += weight
                    if row < height - 1:
                        weight = down[row, column]
                        pull += weight * x[row + 1, column]
                        total += weight
                    # A pixel cut off from data and neighbours keeps its coarse value.
                    if total > np.float32(1e-6):
                        x[row, column] += omega * (pull / total - x[row, column])
    return x
