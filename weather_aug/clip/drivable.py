"""Where the ground ends in an unlabelled picture: a heuristic, used for depth only.

In each column the ground runs from the lower border up to one row; what is above stands on it. The
rows are those that part the colours of the ground best from all others, smoothly from column to
column. Both colour models are learnt from the picture itself: at first a pixel is ground by its
place below the horizon alone, above the horizon nothing is.

Source: a boundary in each column, found by dynamic programming over the columns, is the free space
of Badino et al. 2009, "The Stixel World"; two colour histograms learnt in turns with the
segmentation are those of Boykov and Jolly 2001 and Rother et al. 2004, "GrabCut".
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled

Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]

# Fitted to labelled streets: the log odds that a pixel shows ground, by its place alone.
PLACE_AT_HORIZON, PLACE_BY_DROP, PLACE_BY_SIDE = -1.5, 20.0, 2.0
PLACE_WEIGHT, COLOUR_WEIGHT, TEXTURE_WEIGHT = 0.6, 1.0, 0.5
MOST_PLACE, MOST_COLOUR = 4.0, 2.0
ROUNDS = 2
LEVELS = 16
STEP_COST, JUMP_COST = 1.0, 40.0
NARROW_PX = (5, 9, 15, 25, 41, 67)
NARROW_SHARE = 2.0
LEAST_STEP_PX = 2


def ground_edge(
    image: NDArray[np.uint8],
    sky: NDArray[np.bool_],
    *,
    horizon_px: float,
    focal_px: float,
    principal_x_px: float,
) -> Int32:
    """The first row of ground in each column.

    Args:
        image: (H, W, 3) uint8 RGB, some hundred pixels across.
        sky: (H, W) bool.
        horizon_px: Row of the horizon; may lie outside.
        focal_px: Vertical focal length, pixels.
        principal_x_px: Column of the principal point.

    Returns:
        (W,) int32 in 0..H, below the horizon; H where a column shows no ground.
    """
    height, width = sky.shape
    top = int(np.clip(np.floor(horizon_px) + 1, 0, height))
    if top == height:
        return np.full(width, height, np.int32)
    drop = (np.arange(height) - horizon_px) / focal_px
    side = np.abs(np.arange(width) - principal_x_px) / (0.5 * width)
    place = PLACE_AT_HORIZON + PLACE_BY_DROP * drop[:, None] - PLACE_BY_SIDE * side
    place = np.clip(place, -MOST_PLACE, MOST_PLACE).astype(np.float32)
    colour, texture = _words(image)
    share = 1 / (1 + np.exp(-place))
    share[:top] = 0
    seen = (~sky).astype(np.float32)
    edge = np.full(width, height, np.int32)
    for _ in range(ROUNDS):
        odds = COLOUR_WEIGHT * _log_odds(colour, share, seen)
        odds += TEXTURE_WEIGHT * _log_odds(texture, share, seen)
        odds += PLACE_WEIGHT * place
        odds[sky] = -MOST_COLOUR
        edge = top + _edge(odds[top:], np.float32(STEP_COST), np.float32(JUMP_COST))
        found = np.arange(height)[:, None] >= edge
        share = np.where(np.arange(height)[:, None] >= top, 0.5 * (share + found), 0)
    return edge.astype(np.int32)


def edge_behind(edge: Int32, horizon_px: float) -> Int32:
    """The same edge without narrow things in front of it, (W,): where a facade meets the ground.

    Something three metres wide that meets the ground at a depth z reaches f * 3 / z pixels across
    and f * h / z below the horizon, so that it is about twice as wide as it is low.

    Args:
        edge: (W,) of `ground_edge`.
        horizon_px: Row of the horizon.
    """
    behind = edge.copy()
    signal = edge.astype(np.float32)[None]
    for side in NARROW_PX:
        if side >= len(edge):
            break
        opened = cv2.morphologyEx(signal, cv2.MORPH_OPEN, np.ones((1, side), np.uint8))[0]
        low = edge - horizon_px >= side / NARROW_SHARE
        taken = low & (edge - opened >= LEAST_STEP_PX)
        behind = np.where(taken, np.minimum(behind, opened.astype(np.int32)), behind)
    return behind


def _words(image: NDArray[np.uint8]) -> tuple[Int32, Int32]:
    """Colour and roughness of each pixel as bins (H, W), 0..4095 and 0..15."""
    smooth = cv2.cvtColor(cv2.blur(image, (3, 3)), cv2.COLOR_RGB2LAB).astype(np.int32)
    tint = np.clip((smooth[..., 1:] - 128) // 4 + LEVELS // 2, 0, LEVELS - 1)
    colour = (smooth[..., 0] // 16 * LEVELS + tint[..., 0]) * LEVELS + tint[..., 1]
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    across = cv2.blur(np.abs(cv2.Sobel(grey, cv2.CV_32F, 1, 0)), (5, 5))
    rough = np.clip(2 * np.log2(1 + across), 0, LEVELS - 1).astype(np.int32)
    return colour, rough


def _log_odds(words: Int32, share: Float32, seen: Float32) -> Float32:
    """Log of how much more frequent a pixel's word is on the ground than elsewhere, (H, W)."""
    shape = (LEVELS,) * (3 if words.max() >= LEVELS else 1)
    counts = []
    for weight in (share * seen, (1 - share) * seen):
        binned = np.bincount(words.ravel(), weight.ravel(), int(np.prod(shape)))
        count = binned.astype(np.float64).reshape(shape)
        for axis in range(len(shape)):
            count = _smoothed(count, axis)
        counts.append(count / max(count.sum(), 1.0))
    floor = 1e-5
    odds = np.log(counts[0] + floor) - np.log(counts[1] + floor)
    odds = np.clip(odds, -MOST_COLOUR, MOST_COLOUR).astype(np.float32)
    return odds.ravel()[words]


def _smoothed(count: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    padded = np.moveaxis(count, axis, 0)
    before = np.concatenate([padded[:1], padded[:-1]])
    after = np.concatenate([padded[1:], padded[-1:]])
    return np.moveaxis(0.25 * before + 0.5 * padded + 0.25 * after, 0, axis)


@compiled
def _edge(odds: Float32, step_cost: np.float32, jump_cost: np.float32) -> Int32:
    """Rows (W,) of least cost: odds lost above and below, and a cost of each step sideways."""
    height, width = odds.shape
    cost = np.zeros((width, height + 1), np.float32)
    for column in range(width):
        run = np.float32(0.0)
        for row in range(height - 1, -1, -1):
            run -= odds[row, column]
            cost[column, row] = run
    origin = np.zeros((width, height + 1), np.int32)
    best = np.empty(height + 1, np.float32)
    for column in range(1, width):
        least = 0
        for row in range(height + 1):
            best[row] = cost[column - 1, row]
            origin[column, row] = row
            if best[row] < best[least]:
                least = row
        for row in range(1, height + 1):
            if best[row - 1] + step_cost < best[row]:
                best[row] = best[row - 1] + step_cost
                origin[column, row] = origin[column, row - 1]
        for row in range(height - 1, -1, -1):
            if best[row + 1] + step_cost < best[row]:
                best[row] = best[row + 1] + step_cost
                origin[column, row] = origin[column, row + 1]
        reach = cost[column - 1, least] + jump_cost
        for row in range(height + 1):
            if reach < best[row]:
                best[row] = reach
                origin[column, row] = least
            cost[column, row] += best[row]
    edge = np.empty(width, np.int32)
    row = 0
    for other in range(height + 1):
        if cost[width - 1, other] < cost[width - 1, row]:
            row = other
    for column in range(width - 1, -1, -1):
        edge[column] = row
        row = origin[column, row]
    return edge
