"""Disparity of posts, lamps and thin trunks, which square matching windows give to the background.

A post is a few pixels wide and many high. Averaged over the rows along which it is straight, its
profile across stands out from whatever is behind it, and the same profile is looked for in the
other picture.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled

Float32 = NDArray[np.float32]

HALF_WIDTHS_PX = (1, 2, 3)
HALF_HEIGHT_PX = 12
PROFILE_PX = 4
SMOOTH_PX = 0.7
MIN_CONTRAST = 14.0
MAX_RIDGE = 40.0
GOOD_MISMATCH = np.float32(0.3)
RIVAL_MISMATCH = np.float32(0.3)
AGREE_PX = np.float32(0.75)
AGREE_SHARE = 0.8
MATCHED_SHARE = 0.25


def post_disparity(
    left: NDArray[np.uint8], right: NDArray[np.uint8], *, max_disparity_px: float
) -> Float32:
    """Disparity of the left picture's narrow upright structures.

    Args:
        left: (H, W, 3) uint8 RGB.
        right: (H, W, 3) uint8 RGB, rows aligned with `left`.
        max_disparity_px: Largest disparity, pixels.

    Returns:
        (H, W) float32 pixels; 0 where there is no post, or none that has one clear match.
    """
    standing = upright(left)
    beside = cv2.dilate(standing, np.ones((1, 3), np.uint8))
    middle = (standing > MIN_CONTRAST) & (standing >= beside)
    rows = 2 * HALF_HEIGHT_PX + 1
    one, other = (
        cv2.blur(cv2.GaussianBlur(view, (0, 0), SMOOTH_PX).astype(np.float32), (1, rows))
        for view in (left, right)
    )
    raw = _matched(one, other, middle, int(np.ceil(max_disparity_px)))
    return _whole_posts(_agreed(raw, standing > MIN_CONTRAST), standing > MIN_CONTRAST)


def _whole_posts(matched: Float32, posts: NDArray[np.bool_]) -> Float32:
    """Give all of a post the disparity that its matched parts agree on."""
    _, parts = cv2.connectedComponents(posts.astype(np.uint8), connectivity=8)
    whole = matched.copy()
    for part in np.unique(parts[(matched > 0) & posts]):
        mine = parts == part
        values = matched[mine & (matched > 0)]
        middle = np.median(values)
        agree = (np.abs(values - middle) <= 2 * AGREE_PX).mean() > AGREE_SHARE
        if agree and len(values) > MATCHED_SHARE * mine.sum():
            whole[mine & (matched == 0)] = middle
    return whole


def upright(image: NDArray[np.uint8]) -> Float32:
    """Grey levels by which a narrow ridge stands out from both sides along many rows, (H, W)."""
    picture = image.astype(np.float32)
    strongest = np.zeros(image.shape[:2], np.float32)
    for half in HALF_WIDTHS_PX:
        core = cv2.blur(picture, (2 * half - 1, 1))
        aside = half + 1
        padded = cv2.copyMakeBorder(picture, 0, 0, aside, aside, cv2.BORDER_REPLICATE)
        one, other = padded[:, : -2 * aside], padded[:, 2 * aside :]
        brighter = core - np.maximum(one, other)
        darker = np.minimum(one, other) - core
        for ridge in (brighter, darker):
            # A limit, so that one bright leaf is no post.
            level = np.clip(ridge.max(axis=2), -MAX_RIDGE, MAX_RIDGE)
            np.maximum(strongest, cv2.blur(level, (1, 2 * HALF_HEIGHT_PX + 1)), out=strongest)
    return strongest


@compiled
def _matched(left: Float32, right: Float32, posts: NDArray[np.bool_], count: int) -> Float32:
    """Disparity of the pixels of `posts` whose profile has one good match, else 0."""
    height, width = posts.shape
    found = np.zeros((height, width), np.float32)
    costs = np.zeros(count + 1, np.float32)
    profile = np.zeros((3, 2 * PROFILE_PX + 1), np.float32)
    wide = np.float32(2 * PROFILE_PX + 1)
    for row in range(height):
        for column in range(PROFILE_PX, width - PROFILE_PX):
            if not posts[row, column]:
                continue
            energy = np.float32(0.0)
            for channel in range(3):
                mean = np.float32(0.0)
                for place in range(2 * PROFILE_PX + 1):
                    value = left[row, column - PROFILE_PX + place, channel]
                    profile[channel, place] = value
                    mean += value
                mean /= wide
                for place in range(2 * PROFILE_PX + 1):
                    profile[channel, place] -= mean
                    energy += profile[channel, place] * profile[channel, place]
            reach = min(count, column - PROFILE_PX)
            if reach < 3 or energy <= 0:
                continue
            best = 0
            for shift in range(reach + 1):
                total = np.float32(0.0)
                start = column - shift - PROFILE_PX
                for channel in range(3):
                    mean = np.float32(0.0)
                    for place in range(2 * PROFILE_PX + 1):
                        mean += right[row, start + place, channel]
                    mean /= wide
                    for place in range(2 * PROFILE_PX + 1):
                        there = right[row, start + place, channel] - mean
                        off = profile[channel, place] - there
                        total += off * off
                costs[shift] = total / energy
                if costs[shift] < costs[best]:
                    best = shift
            if costs[best] > GOOD_MISMATCH:
                continue
            alone = True
            for shift in range(reach + 1):
                if abs(shift - best) > 3 and costs[shift] < costs[best] + RIVAL_MISMATCH:
                    alone = False
            if alone:
                found[row, column] = np.float32(best) + _vertex(costs, best, reach)
    return found


@compiled
def _vertex(costs: Float32, best: int, last: int) -> np.float32:
    """Offset of the lowest point of the parabola through three costs, -0.5..0.5."""
    if best < 1 or best >= last:
        return np.float32(0.0)
    before, after = costs[best - 1], costs[best + 1]
    bend = before + after - np.float32(2.0) * costs[best]
    if bend <= 0:
        return np.float32(0.0)
    return np.float32(0.5) * (before - after) / bend


@compiled
def _agreed(raw: Float32, posts: NDArray[np.bool_]) -> Float32:
    """Keep what most matches above and below agree with; spread it over the post beside them."""
    height, width = raw.shape
    kept = np.zeros((height, width), np.float32)
    for row in range(height):
        for column in range(width):
            here = raw[row, column]
            if here <= 0:
                continue
            alike, matched = 0, 0
            for other in range(max(0, row - HALF_HEIGHT_PX), min(height, row + HALF_HEIGHT_PX + 1)):
                for beside in range(max(0, column - 1), min(width, column + 2)):
                    if raw[other, beside] > 0:
                        matched += 1
                        alike += abs(raw[other, beside] - here) <= AGREE_PX
            if alike < HALF_HEIGHT_PX or 4 * alike < 3 * matched:
                continue
            for beside in range(max(0, column - 1), min(width, column + 2)):
                if posts[row, beside]:
                    kept[row, beside] = max(kept[row, beside], here)
    return kept
