"""Depth from a rectified stereo pair: semi-global matching, checked both ways and completed."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import finite, image_uint8, like_image
from weather_aug._compiled import compiled
from weather_aug.clip.completion import completed, sharpened
from weather_aug.clip.edges import OtherView, refined
from weather_aug.clip.posts import post_disparity
from weather_aug.clip.sky import sky_mask, texture
from weather_aug.errors import ArgumentError
from weather_aug.taxonomy import SKY

Float32 = NDArray[np.float32]

MATCH_SIDE_PX = 3
CHECK_PX = 1.0
SPECKLE_PX = 120
HIDDEN_CONFIDENCE = 0.3
GUESS_CONFIDENCE = 0.02
MIN_DISPARITY_PX = 0.4
MIN_DEPTH_M = 2.5
MIN_TEXTURE = 6.0
MIN_JUMP_PX = 1.5
EDGE_REACH_PX = 10
MATCH_BELIEF = 0.33
BLUE_GREY_LEVELS = 35
HIGH_SHARE = 0.9
ISLAND_SHARE = 2e-3
ISLAND_GREY_LEVELS = 20.0


class Disparity(NamedTuple):
    """Disparity of one view of a stereo pair."""

    disparity_px: Float32
    """(H, W); 0 where nothing was matched."""
    trusted: NDArray[np.bool_]
    """(H, W); matched, and the other view agrees to CHECK_PX."""


def stereo_depth(
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    *,
    focal_px: float,
    baseline_m: float,
    label: NDArray[np.uint8] | None = None,
) -> Float32:
    """Dense z-depth of the left picture of a rectified pair.

    For the right picture's depth mirror both and swap them: `right_depth`.

    Args:
        left: (H, W, 3) uint8 RGB.
        right: (H, W, 3) uint8 RGB, rows aligned with `left`.
        focal_px: Focal length of both, pixels.
        baseline_m: Distance between the camera centres, metres.
        label: (H, W) train ids of the left picture for its sky, or None to find the sky by
            `sky_mask`.

    Returns:
        (H, W) float32 metres, above 0, `inf` in the sky.

    Raises:
        ArgumentError: If the pictures differ in size or a number is out of range.
    """
    left, right = image_uint8("left", left), image_uint8("right", right)
    like_image("right", right[..., 0], left.shape[:2])
    finite("focal_px", focal_px, 1.0)
    finite("baseline_m", baseline_m, 1e-3)
    reach_px = focal_px * baseline_m / MIN_DEPTH_M
    match = disparity(left, right, max_disparity_px=reach_px)
    if not match.trusted.any():
        raise ArgumentError("left and right have nothing in common; are they one moment's pair?")
    if label is None:
        # White walls look like sky; matches nearer than 100 m say otherwise, but only where there
        # is something to match: empty sky gives consistent nonsense.
        near = match.trusted & (match.disparity_px > focal_px * baseline_m / 100.0)
        looks = sky_mask(left)
        gaps = _blue_gaps(looks, left)
        sky = looks & (gaps | ~_dense(near & (texture(left) > MIN_TEXTURE)))
    else:
        like_image("label", label, left.shape[:2])
        sky = label == SKY
    posts = post_disparity(left, right, max_disparity_px=reach_px)
    # A post that is no nearer than what was matched there is drawn on it.
    posts[posts < np.where(match.trusted & ~sky, match.disparity_px + MIN_JUMP_PX, 0)] = 0
    posts[posts > _nearest_below(match) + MIN_JUMP_PX] = 0
    if label is None:
        sky &= posts < MIN_JUMP_PX
        sky &= gaps | ~_nearer_islands(sky, match, left, right)
    matched_px = np.where(posts > 0, posts, match.disparity_px)
    trusted = (match.trusted | (posts > 0)) & ~sky
    filled, hidden = _from_background(matched_px, trusted)
    values = np.where(trusted, matched_px, filled)
    guessed = np.where(hidden, HIDDEN_CONFIDENCE, GUESS_CONFIDENCE)
    confidence = np.where(trusted, 1.0, guessed).astype(np.float32)
    confidence[sky | (values <= 0)] = 0
    smooth = completed(values, confidence, left, barrier=sky, stiffness=4.0)
    sharp = sharpened(smooth, min_jump=MIN_JUMP_PX)
    depth = focal_px * baseline_m / np.maximum(sharp, MIN_DISPARITY_PX)
    dense = np.where(sky, np.inf, depth).astype(np.float32)
    belief = np.where(posts > 0, 1, np.where(sky | trusted | hidden, MATCH_BELIEF, 0))
    return refined(
        dense,
        left,
        label=label,
        confidence=np.asarray(belief, np.float32),
        other_view=OtherView(right, focal_px * baseline_m),
        min_jump_per_m=MIN_JUMP_PX / (focal_px * baseline_m),
        reach_px=EDGE_REACH_PX,
    )


def right_depth(
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    *,
    focal_px: float,
    baseline_m: float,
    label: NDArray[np.uint8] | None = None,
) -> Float32:
    """Dense z-depth of the right picture; arguments and result as in `stereo_depth`."""
    mirrored_label = None if label is None else np.ascontiguousarray(label[:, ::-1])
    depth = stereo_depth(
        np.ascontiguousarray(right[:, ::-1]),
        np.ascontiguousarray(left[:, ::-1]),
        focal_px=focal_px,
        baseline_m=baseline_m,
        label=mirrored_label,
    )
    return np.ascontiguousarray(depth[:, ::-1])


def disparity(
    left: NDArray[np.uint8], right: NDArray[np.uint8], *, max_disparity_px: float
) -> Disparity:
    """Left disparity by semi-global matching, trusted where the right view agrees.

    Source: Hirschmueller 2008, "Stereo processing by semiglobal matching and mutual information"
    (OpenCV's variant with Birchfield-Tomasi cost).
    """
    count = int(np.ceil(max(max_disparity_px, 16) / 16)) * 16
    left_px = _matched(left, right, count)
    right_px = _matched(left=right[:, ::-1], right=left[:, ::-1], count=count)[:, ::-1]
    height, width = left_px.shape
    columns = np.arange(width, dtype=np.float32) - left_px
    rows = np.repeat(np.arange(height, dtype=np.float32)[:, None], width, axis=1)
    there = cv2.remap(
        np.ascontiguousarray(right_px), columns, rows, cv2.INTER_NEAREST, borderValue=-1e3
    )
    trusted = (left_px > 0) & (np.abs(left_px - there) <= CHECK_PX)
    return Disparity(np.where(left_px > 0, left_px, 0).astype(np.float32), trusted)


def _matched(left: NDArray[np.uint8], right: NDArray[np.uint8], count: int) -> Float32:
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=count,
        blockSize=MATCH_SIDE_PX,
        P1=8 * 3 * MATCH_SIDE_PX**2,
        P2=32 * 3 * MATCH_SIDE_PX**2,
        preFilterCap=31,
        uniquenessRatio=5,
        speckleWindowSize=SPECKLE_PX,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    # OpenCV leaves the first `count` columns unmatched; a margin moves them out of the picture.
    wide = [
        cv2.copyMakeBorder(np.ascontiguousarray(view), 0, 0, count, 0, cv2.BORDER_REPLICATE)
        for view in (left, right)
    ]
    sixteenths = matcher.compute(*wide)[:, count:]
    return sixteenths.astype(np.float32) / 16


def _nearest_below(match: Disparity) -> Float32:
    """Greatest disparity in a column at or below each row: what stands there is no nearer."""
    known = np.where(match.trusted, match.disparity_px, 0).astype(np.float32)
    steady = cv2.dilate(cv2.medianBlur(known, 5), np.ones((1, 9), np.uint8))
    return np.asarray(np.maximum.accumulate(steady[::-1], axis=0)[::-1], np.float32)


def _blue_gaps(sky: NDArray[np.bool_], image: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Sky of a colour that is nothing but sky: blue, and as high as most of the sky.

    Matching cannot contradict it: a gap between leaves moves with the leaves.
    """
    blue = image[..., 2].astype(np.int16) - image[..., 0] > BLUE_GREY_LEVELS
    lowest = np.searchsorted(np.cumsum(sky.sum(axis=1)), HIGH_SHARE * sky.sum())
    high = np.arange(len(sky))[:, None] < lowest
    return np.asarray(sky & blue & high)


def _nearer_islands(
    sky: NDArray[np.bool_],
    match: Disparity,
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
) -> NDArray[np.bool_]:
    """Small pieces of sky that the right picture shows where a near thing would be: white signs."""
    count, parts, stats, _ = cv2.connectedComponentsWithStats(sky.astype(np.uint8))
    small = stats[:, cv2.CC_STAT_AREA] < ISLAND_SHARE * sky.size
    small[0] = False
    numbered = cv2.dilate(np.where(small[parts], parts, 0).astype(np.float32), np.ones((7, 7)))
    part = numbered.astype(np.int32)
    rim = (part > 0) & match.trusted & ~sky
    matched = np.bincount(part[rim], minlength=count)
    around = np.bincount(part[rim], match.disparity_px[rim], count) / np.maximum(matched, 1)
    # With its rim, for a piece of one colour matches anywhere within itself.
    rows, columns = np.nonzero(part > 0)
    piece = part[rows, columns]
    off_px = np.rint(around[piece]).astype(np.int64)
    here = left[rows, columns].astype(np.int32)
    as_far = np.abs(here - right[rows, columns]).sum(axis=1)
    as_near = np.abs(here - right[rows, np.maximum(columns - off_px, 0)]).sum(axis=1)
    better = np.bincount(piece, as_far - as_near, count) / np.maximum(
        np.bincount(piece, minlength=count), 1
    )
    nearer = small & (better > ISLAND_GREY_LEVELS) & (matched > 0)
    return np.asarray(nearer[parts] & sky)


def _dense(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels whose surroundings are mostly masked, in a square or along a post."""
    share = mask.astype(np.float32)
    return np.asarray((cv2.blur(share, (9, 9)) > 0.5) | (cv2.blur(share, (3, 15)) > 0.6))


@compiled
def _from_background(
    disparity_px: Float32, trusted: NDArray[np.bool_]
) -> tuple[Float32, NDArray[np.bool_]]:
    """Fill each untrusted run of a row with the smaller disparity of its two ends.

    What one camera sees and the other does not is background, hidden behind the nearer surface.
    The second result marks runs that have the width such a hidden strip has: the difference of
    the two disparities (and some pixels more, lost to the matching window).
    """
    height, width = disparity_px.shape
    filled = np.zeros((height, width), np.float32)
    hidden = np.zeros((height, width), np.bool_)
    for row in range(height):
        start = 0
        before = np.float32(0.0)
        for column in range(width + 1):
            if column < width and not trusted[row, column]:
                continue
            after = disparity_px[row, column] if column < width else np.float32(0.0)
            inside = before > 0 and after > 0
            value = min(before, after) if inside else max(before, after)
            jump = abs(after - before)
            strip = inside and jump > 2 and column - start < jump + 8
            for place in range(start, column):
                filled[row, place] = value
                hidden[row, place] = strip
            before, start = after, column + 1
    return filled, hidden
