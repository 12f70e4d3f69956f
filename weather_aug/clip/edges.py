"""Depth edges that agree with the picture's: each pixel near a jump goes to one of its two sides.

Measured depth is right inside surfaces and wrong at their edges: stereo windows straddle them,
LiDAR lines miss them, completion smears them. The picture shows where they are. Near a jump, the
pixels close by are parted into a near and a far side by their depth; each side's colours, those far
from the jump counting more, are its colour model; a pixel goes to the side whose colours it has, of
a stereo pair also to the side at whose depth the other picture shows it, and takes the depth of a
pixel there. It never takes a depth in between.

Source: the two colour models in a narrow band are those of Rother et al. 2004, "GrabCut", as kernel
densities; votes weighted by colour and distance are those of Yoon and Kweon 2006, "Adaptive
support-weight approach for correspondence search"; the threshold is that of Otsu 1979.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import finite, image_uint8, like_image
from weather_aug.clip.edges_kernels import add_mismatch, chosen, sides, unspecked
from weather_aug.errors import ArgumentError
from weather_aug.taxonomy import IGNORE, SKY

Float32 = NDArray[np.float32]
Bools = NDArray[np.bool_]

REACH_PX = 6
JUMP_SHARE = 0.1
SAMPLES_PER_SIDE = 6
DENSE_PX = 2
# One surface's colours differ by a share of their brightness, and in the dark by the noise: levels
# are compressed so that this is the same number of levels everywhere.
DARK_LEVEL = 80.0
MIN_BELIEF = 0.02
USUAL_BELIEF = 0.33


class OtherView(NamedTuple):
    """The right picture of a rectified pair, for the depth of the left one."""

    image: NDArray[np.uint8]
    """(H, W, 3) uint8 RGB."""
    focal_baseline_px_m: float
    """Focal length times baseline, pixels times metres: the disparity at 1 m."""


def refined(
    depth_m: Float32,
    image: NDArray[np.uint8],
    *,
    label: NDArray[np.uint8] | None = None,
    confidence: Float32 | None = None,
    other_view: OtherView | None = None,
    min_jump_per_m: float,
    reach_px: int = REACH_PX,
) -> Float32:
    """Depth whose edges lie on the picture's edges.

    Only pixels within `reach_px` of a jump may change, and each takes the depth of a pixel close
    by. A jump is where inverse depth varies within 3x3 pixels by more than `min_jump_per_m` and by
    a tenth, or where sky begins.

    Args:
        depth_m: (H, W) metres, above 0, `inf` in the sky.
        image: (H, W, 3) uint8 RGB.
        label: (H, W) train ids, or None. Pixels then follow those of their own class, and exactly
            the sky's pixels are at `inf`.
        confidence: (H, W) in [0, 1], how far each depth is believed against its colour; None
            for 0.33 everywhere, which is right for depth that may be some pixels off everywhere.
        other_view: The right picture of a stereo pair, or None.
        min_jump_per_m: Smallest step of inverse depth that is an edge, 1/m, above 0; see
            `completion.depth_jump`.
        reach_px: How far from its true place an edge may be, 1 to 32 pixels.

    Returns:
        (H, W) float32 metres, above 0, `inf` in the sky.

    Raises:
        ArgumentError: If shapes differ, a depth is not above 0, or a number is out of range.
    """
    image = image_uint8("image", image)
    like_image("depth_m", depth_m, image.shape[:2])
    finite("min_jump_per_m", min_jump_per_m, 1e-9)
    if isinstance(reach_px, bool) or reach_px != int(reach_px) or not 1 <= reach_px <= 32:
        raise ArgumentError(f"reach_px must be an integer in 1..32, got {reach_px!r}")
    if not (np.asarray(depth_m) > 0).all():
        raise ArgumentError("depth_m must be above 0 everywhere; complete it first")
    inverse = (1 / np.asarray(depth_m, np.float32)).astype(np.float32)
    if label is None:
        classes = np.full(inverse.shape, IGNORE, np.uint8)
    else:
        like_image("label", label, inverse.shape)
        classes = np.ascontiguousarray(label, np.uint8)
    if confidence is None:
        belief = np.full(inverse.shape, USUAL_BELIEF, np.float32)
    else:
        like_image("confidence", confidence, inverse.shape)
        belief = np.clip(confidence, MIN_BELIEF, 1).astype(np.float32)
    colours = _levels(image)
    pair = None
    if other_view is not None:
        right = image_uint8("other_view.image", other_view.image)
        like_image("other_view.image", right[..., 0], inverse.shape)
        scale = finite("other_view.focal_baseline_px_m", other_view.focal_baseline_px_m, 1e-3)
        pair = _levels(right), np.float32(scale)
    # Once to get close, once with cleaner models for what is still between the two.
    for reach in (int(reach_px), (int(reach_px) + 1) // 2):
        inverse = _parted(inverse, colours, pair, classes, belief, min_jump_per_m, reach)
    return _with_labelled_sky(inverse, classes, label is not None)


def _levels(image: NDArray[np.uint8]) -> Float32:
    """Colours in which equal steps look equally large in light and shade, (H, W, 3)."""
    # A light blur keeps sensor noise out and is narrower than any post.
    smooth = cv2.GaussianBlur(image, (0, 0), 0.5)
    table = DARK_LEVEL * np.log1p(np.arange(256) / DARK_LEVEL)
    return table.astype(np.float32)[smooth]


def jumps(inverse: Float32, min_jump_per_m: float) -> Bools:
    """(H, W); pixels with a depth edge within 3x3, from inverse depth in 1/m (0 for sky)."""
    kernel = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(inverse, kernel), cv2.dilate(inverse, kernel)
    step = (high - low) > np.maximum(np.float32(min_jump_per_m), np.float32(JUMP_SHARE) * high)
    return np.asarray(step | ((low == 0) & (high > 0)))


def _parted(
    inverse: Float32,
    colours: Float32,
    pair: tuple[Float32, np.float32] | None,
    classes: NDArray[np.uint8],
    belief: Float32,
    min_jump: float,
    reach: int,
) -> Float32:
    """One round: both sides' models from the depth as it is, then every pixel to its side."""
    edge = jumps(inverse, min_jump)
    away = cv2.distanceTransform((~edge).astype(np.uint8), cv2.DIST_C, 3).astype(np.float32)
    band = away <= reach
    trust = np.clip((away + 0.5) / np.float32(reach), 0.05, 1).astype(np.float32) * belief
    offsets, closeness = _samples(reach)
    near, far, lean = sides(
        inverse, colours, classes, belief, trust, band, np.float32(min_jump), offsets, closeness
    )
    if pair is not None:
        add_mismatch(lean, near, far, colours, *pair)
    parted: Float32 = unspecked(chosen(inverse, colours, classes, near, far, lean), near, far)
    return parted


def _samples(reach: int) -> tuple[NDArray[np.int64], Float32]:
    """Where a window of `reach` is looked at: (N, 2) rows and columns, and (N,) their weights.

    Close by they are dense, for there the depth is taken from; farther away they give colours only,
    and every other row is enough.
    """
    stride = max(1, round(reach / SAMPLES_PER_SIDE))
    rows = np.arange(-(reach // (2 * stride)) * 2 * stride, reach + 1, 2 * stride)
    columns = np.arange(-(reach // stride) * stride, reach + 1, stride)
    close = range(-min(DENSE_PX, reach), min(DENSE_PX, reach) + 1)
    places = {(int(y), int(x)) for y in rows for x in columns} | {
        (y, x) for y in close for x in close
    }
    offsets = np.array(sorted(places - {(0, 0)}), np.int64)
    square = (offsets**2).sum(axis=1)
    return offsets, (1 / (1 + 0.5 * square / reach**2)).astype(np.float32)


def _with_labelled_sky(inverse: Float32, classes: NDArray[np.uint8], labelled: bool) -> Float32:
    with np.errstate(divide="ignore"):
        depth = (1 / inverse).astype(np.float32)
    if not labelled:
        return depth
    sky = classes == SKY
    lost = ~sky & np.isinf(depth)
    if lost.any() and not lost.all():
        known = ~sky & np.isfinite(depth)
        if known.any():
            _, nearest = cv2.distanceTransformWithLabels(
                (~known).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
            )
            depth_by_seed = np.zeros(int(nearest.max()) + 1, np.float32)
            depth_by_seed[nearest[known]] = depth[known]
            depth = np.where(lost, depth_by_seed[nearest], depth)
    return np.where(sky, np.float32(np.inf), depth).astype(np.float32)
