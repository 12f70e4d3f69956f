"""What a picture's surfaces are and where they lie, before any weather: computed once per frame.

Convention:
    Street axes are (along the street, to its left, up), metres, with the world's origin. The small
    grid has one cell for `step` x `step` pixels; the centre of cell (i, j) is at pixel
    ((i + 1/2) step - 1/2, (j + 1/2) step - 1/2), and cells at the right and lower border may reach
    beyond the picture.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled
from weather_aug.clip.types import FAR_DEPTH_M, Camera, Frame
from weather_aug.colour import SRGB_LEVELS_LINEAR
from weather_aug.taxonomy import GROUND, IGNORE, ROAD, SIDEWALK, SKY, TERRAIN, TRAIN_ID, VEGETATION

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
UInt8 = NDArray[np.uint8]

CELLS_ACROSS = 320
"""At most so many cells of the small grid lie side by side."""
PLANE_RANGE_M = (3.0, 40.0)
PLANE_SIDE_M = 8.0
PLANE_ROUNDS = 4
WIDE_ROUNDS = (6.0, 4.0, 2.0, 1.0, 1.0)
SURE_SHARE = 0.7
"""Of the road's points; a plane through fewer may be the wrong one."""
PLANE_TOLERANCE_M = 0.15
STEEPEST_SLOPE = 0.12
LEAST_PLANE_POINTS = 60
GROUND_TOLERANCE_M = 0.22
GROUND_TOLERANCE_PER_M = 0.012
ROAD_HALF_WIDTH_M = 9.0
COLOUR_BLUR_PX = 9
GAP_PX = 12
SPECKLE_PX = 5
BUILDING = TRAIN_ID["building"]


@dataclass(frozen=True, eq=False)
class Site:
    """A frame's surfaces on the small grid (h, w), and its classes at full size."""

    frame: Frame
    axes_world: Float64
    """(3, 3), rows are the street's axes."""
    camera_height_m: float
    step: int
    classes: UInt8
    """(H, W) train ids: the label's, and guessed from geometry and colour where there is none; 255
    stays in wide unlabelled places (the own bonnet)."""
    plane: Float64
    """(3,) of the road: up = plane[0] + plane[1] along + plane[2] left, street axes."""

    @property
    def shape(self) -> tuple[int, int]:
        """(h, w) of the small grid."""
        height, width = self.classes.shape
        return -(-height // self.step), -(-width // self.step)

    @cached_property
    def small_classes(self) -> UInt8:
        """(h, w) train ids at the cells' centres."""
        return np.ascontiguousarray(_centres(self.classes, self.step))

    @cached_property
    def depth_m(self) -> Float32:
        """(h, w) z-depth at the cells' centres, `inf` for sky and unknown."""
        small = _centres(np.asarray(self.frame.depth_m), self.step).astype(np.float32)
        small[~((small > 0) & (small < FAR_DEPTH_M)) | (self.small_classes == SKY)] = np.inf
        return small

    @cached_property
    def levels(self) -> UInt8:
        """(h, w, 3) sRGB, the means of the cells."""
        return shrunk(self.frame.image, self.step)

    @cached_property
    def srgb(self) -> Float32:
        """(h, w, 3) the same in [0, 1]."""
        return self.levels.astype(np.float32) * np.float32(1 / 255)

    @cached_property
    def light(self) -> Float32:
        """(h, w, 3) the same as linear light."""
        return cv2.LUT(self.levels, SRGB_LEVELS_LINEAR.astype(np.float32))

    @cached_property
    def rays(self) -> Float32:
        """(h, w, 3) street axes: what a metre of depth adds to the place of a surface."""
        return street_rays(self.frame.camera, self.axes_world, self.shape, self.step)

    @cached_property
    def origin(self) -> Float64:
        """(3,) the camera in street axes."""
        return self.axes_world @ self.frame.camera.centre_world

    @cached_property
    def points(self) -> Float32:
        """(h, w, 3) places of the surfaces in street axes; not finite in the sky."""
        return (self.origin + self.offsets).astype(np.float32)

    @cached_property
    def offsets(self) -> Float32:
        """(h, w, 3) the same from the camera."""
        with np.errstate(invalid="ignore"):
            return self.depth_m[..., None] * self.rays

    @cached_property
    def height_m(self) -> Float32:
        """(h, w) of the surfaces over the road's plane; `inf` in the sky."""
        above = self.origin[2] - self.plane[0] - self.plane[1:] @ self.origin[:2]
        climb = np.array([-self.plane[1], -self.plane[2], 1.0], np.float32)
        with np.errstate(invalid="ignore"):
            height = np.float32(above) + self.offsets @ climb
        return np.where(np.isfinite(self.depth_m), height, np.float32(np.inf))

    @cached_property
    def is_ground(self) -> NDArray[np.bool_]:
        """(h, w) where road, sidewalk or terrain is seen."""
        return np.isin(self.small_classes, GROUND)


def site_of(frame: Frame, axes_world: Float64, camera_height_m: float) -> Site:
    """Look at a frame with depth.

    Args:
        frame: With `depth_m`; a label says what surfaces are, geometry and colour where there is
            none.
        axes_world: (3, 3), rows along the street, to its left, up.
        camera_height_m: Of the camera over the road, where too little of the road is seen to tell.
    """
    width = frame.image.shape[1]
    step = -(-width // CELLS_ACROSS)
    plane = _road_plane(frame, axes_world, camera_height_m)
    classes = _classes(frame, axes_world, plane)
    return Site(frame, axes_world, camera_height_m, step, classes, plane)


def shrunk(plane: NDArray[Any], step: int) -> NDArray[Any]:
    """Means (h, w, ...) of the cells of a plane (H, W, ...)."""
    height, width = plane.shape[:2]
    rows, columns = -(-height // step), -(-width // step)
    if (rows * step, columns * step) != (height, width):
        plane = cv2.copyMakeBorder(
            plane, 0, rows * step - height, 0, columns * step - width, cv2.BORDER_REPLICATE
        )
    return cv2.resize(plane, (columns, rows), interpolation=cv2.INTER_AREA)


def street_rays(camera: Camera, axes_world: Float64, shape: tuple[int, int], step: int) -> Float32:
    """(h, w, 3) in street axes: the step of a surface's place for each metre of its depth."""
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    # Through the pixels that `_centres` takes: of an even step none lies at a cell's very centre.
    x = (np.minimum(np.arange(shape[1]) * step + step // 2, camera.width - 1) - cx) / fx
    y = (np.minimum(np.arange(shape[0]) * step + step // 2, camera.height - 1) - cy) / fy
    street_from_camera = axes_world @ camera.world_from_camera[:3, :3]
    across = x[None, :, None] * street_from_camera[:, 0]
    down = y[:, None, None] * street_from_camera[:, 1]
    return (across + down + street_from_camera[:, 2]).astype(np.float32)


def _centres(plane: NDArray[Any], step: int) -> NDArray[Any]:
    """Values (h, w) at the cells' centres of a plane (H, W)."""
    height, width = plane.shape
    rows = np.minimum(np.arange(-(-height // step)) * step + step // 2, height - 1)
    columns = np.minimum(np.arange(-(-width // step)) * step + step // 2, width - 1)
    return plane[rows[:, None], columns]


def _road_plane(frame: Frame, axes_world: Float64, camera_height_m: float) -> Float64:
    """Plane through the near road: least squares with outliers dropped, level where few tell."""
    camera = frame.camera
    height, width = frame.image.shape[:2]
    step = max(1, round(width / 160))
    shape = -(-height // step), -(-width // step)
    rays = street_rays(camera, axes_world, shape, step).astype(np.float64)
    depth = _centres(np.asarray(frame.depth_m), step).astype(np.float64)
    near, far = PLANE_RANGE_M
    origin = axes_world @ camera.centre_world
    with np.errstate(invalid="ignore", over="ignore"):
        offset = np.where(np.isfinite(depth), depth, 0.0)[..., None] * rays
    low = np.abs(offset[..., 2] + camera_height_m)
    picked = (depth > near) & (depth < far) & (np.abs(offset[..., 1]) < PLANE_SIDE_M)
    picked &= low < 0.5 + STEEPEST_SLOPE * np.hypot(offset[..., 0], offset[..., 1])
    if frame.label is not None:
        picked &= _centres(frame.label, step) == ROAD
    points = offset[picked]
    level = np.array([-camera_height_m, 0.0, 0.0])
    fitted, on_it = _fitted_plane(points, level, (1.0,) * PLANE_ROUNDS)
    if on_it < SURE_SHARE * len(points):
        # A road that climbs leaves the level's neighbourhood within metres.
        steep, on_steep = _fitted_plane(points, level, WIDE_ROUNDS)
        fitted = steep if on_steep > on_it else fitted
    return _through_origin(fitted, origin)


def _fitted_plane(
    points: Float64, level: Float64, rounds: tuple[float, ...]
) -> tuple[Float64, int]:
    """Plane (3,) through points (N, 3), and how many lie on it; `level` and 0 where few do.

    Each round fits what lies near the plane of the round before: nearer than the tolerance times
    the round's number.
    """
    fitted, reach = level, np.hypot(points[:, 0], points[:, 1])
    tolerance = PLANE_TOLERANCE_M + 0.02 * reach
    # Far points say more of the slope than of the height, and are noisier.
    weight = 1.0 / (5.0 + reach)
    for widened in rounds:
        off = points[:, 2] - fitted[0] - points[:, :2] @ fitted[1:]
        kept = np.abs(off) < widened * tolerance
        if kept.sum() < LEAST_PLANE_POINTS:
            return level, 0
        design = np.column_stack([np.ones(kept.sum()), points[kept, :2]]) * weight[kept, None]
        fitted = np.linalg.lstsq(design, points[kept, 2] * weight[kept], rcond=None)[0]
        if np.abs(fitted[1:]).max() > STEEPEST_SLOPE or not 0.3 < -fitted[0] < 5.0:
            return level, 0
    off = points[:, 2] - fitted[0] - points[:, :2] @ fitted[1:]
    return fitted, int((np.abs(off) < tolerance).sum())


def _through_origin(plane: Float64, origin: Float64) -> Float64:
    """The same plane seen from the world's origin instead of from the camera."""
    up = origin[2] + plane[0] - plane[1:] @ origin[:2]
    return np.array([up, plane[1], plane[2]])


def _classes(frame: Frame, axes_world: Float64, plane: Float64) -> UInt8:
    """Train ids (H, W): the label's, and guesses where there is none."""
    if frame.label is not None:
        return _without_gaps(frame.label)
    camera = frame.camera
    rays = axes_world @ camera.world_from_camera[:3, :3]
    origin = axes_world @ camera.centre_world
    above = origin[2] - plane[0] - plane[1:] @ origin[:2]
    climb = np.array([-plane[1], -plane[2], 1.0]) @ rays
    numbers = (*camera.focal_px, *camera.principal_px, above, *climb, *rays[1])
    out = np.empty(frame.image.shape[:2], np.uint8)
    _guess(
        cv2.blur(frame.image, (COLOUR_BLUR_PX, COLOUR_BLUR_PX)),
        # A copy, because the kernel would be compiled once more for what may not be written.
        np.array(frame.depth_m, np.float32, order="C"),
        np.array(numbers, np.float32),
        out,
    )
    return cv2.medianBlur(cv2.medianBlur(out, SPECKLE_PX), SPECKLE_PX)


def _without_gaps(label: UInt8) -> UInt8:
    """The label with its narrow unlabelled gaps closed by what is nearest; wide ones stay 255."""
    gap = label == IGNORE
    if not gap.any() or gap.all():
        return label
    distance, nearest = cv2.distanceTransformWithLabels(
        gap.astype(np.uint8), cv2.DIST_L1, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    by_number = np.full(int(nearest.max()) + 1, IGNORE, np.uint8)
    by_number[nearest[~gap]] = label[~gap]
    return np.where(gap & (distance <= GAP_PX), by_number[nearest], label)


@compiled
def _guess(image, depth, geometry, out):
    """Name what nobody labelled: sky by endless depth, ground by height, green by colour."""
    fx, fy, cx, cy, above = geometry[0], geometry[1], geometry[2], geometry[3], geometry[4]
    for row in range(out.shape[0]):
        y = (np.float32(row) - cy) / fy
        for column in range(out.shape[1]):
            z = depth[row, column]
            if not (z > np.float32(0.0)) or z >= np.float32(FAR_DEPTH_M):
                out[row, column] = np.uint8(SKY)
                continue
            x = (np.float32(column) - cx) / fx
            height = above + z * (geometry[5] * x + geometry[6] * y + geometry[7])
            side = abs(z * (geometry[8] * x + geometry[9] * y + geometry[10]))
            r, g, b = image[row, column, 0], image[row, column, 1], image[row, column, 2]
            whole = np.int32(r) + np.int32(g) + np.int32(b)
            green = (np.int32(3) * np.int32(g) - whole) * np.int32(16) > whole + np.int32(96)
            limit = np.float32(GROUND_TOLERANCE_M) + np.float32(GROUND_TOLERANCE_PER_M) * z
            if height < limit:
                if green:
                    out[row, column] = np.uint8(TERRAIN)
                elif side < np.float32(ROAD_HALF_WIDTH_M):
                    out[row, column] = np.uint8(ROAD)
                else:
                    out[row, column] = np.uint8(SIDEWALK)
            else:
                dark = whole < np.int32(150)
                leaf = green | (dark & (height > np.float32(3.0)))
                out[row, column] = np.uint8(VEGETATION) if leaf else np.uint8(BUILDING)
