"""Depth from a label map alone: flat ground, things that stand on it, sky at infinity.

Convention:
    The camera is `camera_height_m` above flat ground, level across the road, pitched down by
    `pitch_rad`. A thing stands upright at the ground point where its lowest visible pixel touches
    ground; what stands behind something else takes the nearest contact of its own region.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import finite
from weather_aug._compiled import compiled
from weather_aug.errors import ArgumentError
from weather_aug.taxonomy import CLASSES, GROUND, IGNORE, SKY, TRAIN_ID

Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]

MAX_DEPTH_M = 200.0
MIN_DEPTH_M = 0.5
HUNG_HEIGHT_M = 2.8
BEHIND_SHARE = 0.35

_COMPACT = ("person", "rider", "car", "truck", "bus", "train", "motorcycle", "bicycle")
_HUNG = ("traffic light", "traffic sign")
# The kernels below test these numbers as literals: 2 and up stand or hang, 3 and up are compact.
_GROUND_KIND, _SKY_KIND, _WIDE_KIND, _COMPACT_KIND, _POLE_KIND, _HUNG_KIND = range(6)


def _kinds() -> NDArray[np.uint8]:
    kinds = np.full(256, _WIDE_KIND, np.uint8)
    kinds[list(GROUND)] = _GROUND_KIND
    kinds[SKY] = _SKY_KIND
    kinds[[TRAIN_ID[name] for name in _COMPACT]] = _COMPACT_KIND
    kinds[TRAIN_ID["pole"]] = _POLE_KIND
    kinds[[TRAIN_ID[name] for name in _HUNG]] = _HUNG_KIND
    return kinds


_KIND_BY_TRAIN_ID = _kinds()


def geometric_prior_depth(
    label: NDArray[np.uint8],
    *,
    focal_px: float,
    principal_px: tuple[float, float],
    camera_height_m: float = 1.5,
    pitch_rad: float = 0.0,
) -> Float32:
    """Dense z-depth that a label map suggests under the module's Convention.

    Road, sidewalk and terrain lie on the ground plane. Each connected region of another class gets
    a depth per column from its contact with the ground: smoothed along facades, the nearest within
    the region's own height for cars, people and poles. Columns whose foot is hidden take the
    nearest visible contact of the region; a region that touches no ground stands between what
    hides its foot and the ground at its lowest row; signs and lights hang on the
    pole below them, or at 2.8 m before what they cover. Ignored pixels take the class of the
    nearest pixel.

    Args:
        label: (H, W) uint8 train ids, 255 ignored.
        focal_px: Vertical focal length, pixels.
        principal_px: Principal point (cx, cy), pixels.
        camera_height_m: Height of the camera over the ground, metres.
        pitch_rad: How far the camera looks down, radians.

    Returns:
        (H, W) float32 metres in [0.5, 200], `inf` in the sky. Down a column of ground it never
        increases.

    Raises:
        ArgumentError: If an argument is outside its range.
    """
    classes = _filled_label(label)
    height = classes.shape[0]
    finite("focal_px", focal_px, 1e-3)
    finite("camera_height_m", camera_height_m, 0.1, 100.0)
    finite("pitch_rad", pitch_rad, -0.7, 0.7)
    principal_y = finite("principal_px[1]", principal_px[1], -1e6, 1e6)
    ground = _ground_depth(height, focal_px, principal_y, camera_height_m, pitch_rad)
    horizon = principal_y - focal_px * math.tan(pitch_rad)
    # A thing at height y above the ground is seen at depth z in row horizon + f (h - y) / z.
    hung = np.full(height, MAX_DEPTH_M, np.float32)
    above = np.maximum(horizon - np.arange(height), 1e-3)
    hung[:] = np.clip(focal_px * max(HUNG_HEIGHT_M - camera_height_m, 0.3) / above, 4, MAX_DEPTH_M)
    regions, kind_by_region = _regions(classes)
    depth: Float32 = _stood_up(
        classes, regions, kind_by_region, ground, hung, np.float32(BEHIND_SHARE)
    )
    return depth


def _filled_label(label: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The label with each ignored pixel given the class of the nearest other pixel."""
    if label.ndim != 2 or label.dtype != np.uint8 or label.size == 0:
        raise ArgumentError(f"label must be a (H, W) uint8 array, got {label.dtype} {label.shape}")
    unknown = label == IGNORE
    if not unknown.any():
        out_of_range = int(label.max())
    else:
        if unknown.all():
            raise ArgumentError("label ignores every pixel; there is nothing to place")
        out_of_range = int(label[~unknown].max())
    if out_of_range >= len(CLASSES):
        raise ArgumentError(f"label holds {out_of_range}, which is no train id; map it first")
    if not unknown.any():
        return np.ascontiguousarray(label)
    _, nearest = cv2.distanceTransformWithLabels(
        unknown.astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    class_by_seed = np.zeros(int(nearest.max()) + 1, np.uint8)
    class_by_seed[nearest[~unknown]] = label[~unknown]
    return class_by_seed[nearest]


def _ground_depth(
    height: int, focal_px: float, principal_y: float, camera_height_m: float, pitch_rad: float
) -> Float32:
    """(H,) z-depth at which each row meets the ground; the cap above the horizon."""
    slope = (np.arange(height) - principal_y) / focal_px
    drop = slope * math.cos(pitch_rad) + math.sin(pitch_rad)
    nearest = camera_height_m / np.maximum(drop, camera_height_m / MAX_DEPTH_M)
    return np.maximum(nearest, MIN_DEPTH_M).astype(np.float32)


def _regions(classes: NDArray[np.uint8]) -> tuple[Int32, NDArray[np.uint8]]:
    """Connected regions of one class each, numbered from 0, and the kind of each."""
    numbered = np.zeros(classes.shape, np.int32)
    kinds: list[NDArray[np.uint8]] = []
    first = 0
    for train_id in np.flatnonzero(np.bincount(classes.ravel(), minlength=len(CLASSES))):
        mask = (classes == train_id).astype(np.uint8)
        count, parts = cv2.connectedComponents(mask, connectivity=8, ltype=cv2.CV_32S)
        np.add(parts, first - 1, out=numbered, where=mask.view(bool))
        kinds.append(np.full(count - 1, _KIND_BY_TRAIN_ID[train_id], np.uint8))
        first += count - 1
    return numbered, np.concatenate(kinds)


@compiled
def _stood_up(
    classes: NDArray[np.uint8],
    regions: Int32,
    kind_by_region: NDArray[np.uint8],
    ground: Float32,
    hung: Float32,
    behind_share: np.float32,
) -> Float32:
    """Depth of every pixel: ground by row, sky infinite, the rest by region and column."""
    height, width = classes.shape
    count = len(kind_by_region)
    left = np.full(count, width, np.int32)
    right = np.full(count, -1, np.int32)
    for row in range(height):
        for column in range(width):
            region = regions[row, column]
            left[region] = min(left[region], column)
            right[region] = max(right[region], column)
    offset = np.zeros(count + 1, np.int64)
    for region in range(count):
        offset[region + 1] = offset[region] + right[region] - left[region] + 1
    bottom = np.full(offset[count], -1, np.int32)
    tall = np.zeros(offset[count], np.int32)
    for row in range(height):
        for column in range(width):
            region = regions[row, column]
            place = offset[region] + column - left[region]
            bottom[place] = row
            tall[place] += 1
    foot = np.zeros(offset[count], np.float32)
    grounded = np.zeros(count, np.bool_)
    for region in range(count):
        kind = kind_by_region[region]
        if kind >= 2:
            first, last = offset[region], offset[region + 1]
            grounded[region] = _feet(
                bottom[first:last],
                tall[first:last],
                left[region],
                kind,
                regions,
                kind_by_region,
                foot[first:last],
            )
    depth_by_column = np.zeros(offset[count], np.float32)
    for region in range(count):
        if kind_by_region[region] >= 2 and grounded[region]:
            for place in range(offset[region], offset[region + 1]):
                depth_by_column[place] = _ground_at(foot[place], ground)
    for region in range(count):
        if kind_by_region[region] >= 2 and not grounded[region]:
            _ungrounded(
                region,
                kind_by_region,
                regions,
                left,
                offset,
                bottom,
                grounded,
                ground,
                hung,
                behind_share,
                depth_by_column,
            )
    depth = np.empty((height, width), np.float32)
    for row in range(height):
        for column in range(width):
            region = regions[row, column]
            kind = kind_by_region[region]
            if kind == 0:
                depth[row, column] = ground[row]
            elif kind == 1:
                depth[row, column] = np.inf
            else:
                depth[row, column] = depth_by_column[offset[region] + column - left[region]]
    return depth


@compiled
def _ground_at(row: np.float32, ground: Float32) -> np.float32:
    """Ground depth at a fractional row; inverse depth is linear in the row."""
    below = min(int(row), len(ground) - 1)
    after = min(below + 1, len(ground) - 1)
    share = row - np.float32(below)
    inverse = (np.float32(1.0) - share) / ground[below] + share / ground[after]
    return np.float32(np.float32(1.0) / inverse)


@compiled
def _feet(
    bottom: Int32,
    tall: Int32,
    left: int,
    kind: int,
    regions: Int32,
    kind_by_region: NDArray[np.uint8],
    foot: Float32,
) -> bool:
    """Contact row of each column of one region into `foot`; False where none touches ground."""
    height = regions.shape[0]
    span = len(bottom)
    seen = False
    for place in range(span):
        foot[place] = -1
        row = bottom[place]
        if row < 0:
            continue
        at_border = row == height - 1
        if at_border or kind_by_region[regions[row + 1, left + place]] == 0:
            foot[place] = row
            seen = True
    if not seen:
        return False
    _spread(foot)
    lowest = foot.copy()
    total = 0
    filled = 0
    for place in range(span):
        if bottom[place] >= 0:
            total += tall[place]
            filled += 1
    mean_tall = total / max(filled, 1)
    # A compact thing stands on its nearest foot: the gap below a car or between two legs is not
    # farther away. A facade may recede, so it only loses the noise of its outline.
    reach = int(0.6 * mean_tall) if kind >= 3 else 2
    for place in range(span):
        for other in range(max(0, place - reach), min(span, place + reach + 1)):
            lowest[place] = max(lowest[place], foot[other])
    smooth = max(2, reach // 2) if kind >= 3 else 6
    running = np.float64(0.0)
    first, last = 0, -1
    for place in range(span):
        while last < min(span - 1, place + smooth):
            last += 1
            running += lowest[last]
        while first < place - smooth:
            running -= lowest[first]
            first += 1
        foot[place] = np.float32(running / (last - first + 1))
    return True


@compiled
def _spread(foot: Float32) -> None:
    """Give columns without a visible contact (-1) that of the nearest column that has one."""
    span = len(foot)
    distance = np.full(span, span + 1, np.int64)
    value = foot.copy()
    since = span + 1
    held = np.float32(-1.0)
    for place in range(span):
        since += 1
        if foot[place] >= 0:
            since, held = 0, foot[place]
        distance[place], value[place] = since, held
    since = 2 * span + 2
    for place in range(span - 1, -1, -1):
        since += 1
        if foot[place] >= 0:
            since, held = 0, foot[place]
        elif since < distance[place]:
            value[place] = held
    for place in range(span):
        foot[place] = value[place]


@compiled
def _ungrounded(
    region: int,
    kind_by_region: NDArray[np.uint8],
    regions: Int32,
    left: Int32,
    offset: NDArray[np.int64],
    bottom: Int32,
    grounded: NDArray[np.bool_],
    ground: Float32,
    hung: Float32,
    behind_share: np.float32,
    depth_by_column: Float32,
) -> None:
    """Place a region that touches no ground: behind what hides its foot, or hanging in the air."""
    height = regions.shape[0]
    first, last = offset[region], offset[region + 1]
    lowest = 0
    behind_total = np.float64(0.0)
    behind_count = 0
    pole = np.float32(np.inf)
    for place in range(first, last):
        row = bottom[place]
        if row < 0:
            continue
        lowest = max(lowest, row)
        column = left[region] + place - first
        other = regions[row + 1, column]
        if grounded[other]:
            depth = depth_by_column[offset[other] + column - left[other]]
            behind_total += np.log(depth)
            behind_count += 1
        # Signs hang on poles, and thin poles break into pieces in a label map.
        for below in range(row + 1, min(height, row + 2 + height // 12)):
            other = regions[below, column]
            if kind_by_region[other] == 4 and grounded[other]:
                pole = min(pole, depth_by_column[offset[other] + column - left[other]])
    # Its foot is hidden below its lowest visible pixel, so the ground there is the farthest it
    # can stand.
    farthest = ground[lowest]
    nearest = np.float32(np.inf)
    if behind_count > 0:
        nearest = np.float32(np.exp(behind_total / behind_count))
    if kind_by_region[region] >= 4 and np.isfinite(pole):
        chosen = pole
    elif kind_by_region[region] == 5:
        chosen = min(hung[lowest], nearest)
    elif behind_count > 0:
        chosen = max(nearest, np.float32(nearest * (farthest / nearest) ** behind_share))
    else:
        chosen = farthest
    for place in range(first, last):
        depth_by_column[place] = chosen
