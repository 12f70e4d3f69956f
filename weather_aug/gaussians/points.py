"""Pixels as points in space: which to trust, how their surface lies, and who sees them best."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled
from weather_aug.clip.poses import inverse_motion
from weather_aug.clip.types import Box, Float64, Frame
from weather_aug.taxonomy import IGNORE, SKY

Float32 = NDArray[np.float32]
Bools = NDArray[np.bool_]

MIN_DEPTH_M = 0.5
SHELL_M = 300.0
"""What lies beyond is placed here: no drive is long enough to see the difference."""
JUMP_SHARE = 0.05
"""A step of depth to a neighbour that is an edge, where the surface does not run on as a plane."""
BEHIND_SHARE = 0.03
"""Depth errs by this share of itself: what lies that little behind a surface belongs to it."""
FOOTPRINT_RATIO = 1.05
"""Views whose pixels are this close in size see a place equally well."""
BOX_GROWTH = 1.05
BOX_MARGIN_M = 0.1


class View(NamedTuple):
    """A frame's pixels (h, w), maybe every n-th of them, as ends of rays."""

    world_from_camera: Float64
    lens: Float64
    """(4,) fx, fy, cx, cy of the pixels kept."""
    stride_px: int
    depth_m: Float32
    """(h, w) z-depth, at most `SHELL_M`; `inf` in the sky, NaN where it is not known."""
    usable: Bools
    """(h, w): there is a surface, and its depth is not one between two surfaces."""
    slopes: Float32
    """(h, w, 2) change of inverse depth from a pixel of the frame to the next, right and down."""
    colours: Float32
    """(h, w, 3) sRGB in 0..1."""
    label: NDArray[np.uint8] | None
    """(h, w) train ids."""


def view_of(frame: Frame, stride_px: int = 1, window: tuple[slice, slice] | None = None) -> View:
    """See the pixels of `frame`, which has depth, as points.

    Pixels without a depth that are labelled, and not as sky, are placed at `SHELL_M`.

    Args:
        frame: With depth.
        stride_px: Keep every n-th pixel across and down.
        window: Rows and columns to look at; all if None.
    """
    rows, columns = window or (slice(None), slice(None))
    measured = np.asarray(frame.depth_m)[rows, columns].astype(np.float32)
    image = frame.image[rows, columns]
    label = None if frame.label is None else frame.label[rows, columns]
    depth = np.where(measured >= MIN_DEPTH_M, np.minimum(measured, np.float32(SHELL_M)), np.nan)
    sky = np.isposinf(measured)
    if label is not None:
        # A label settles it: what is not sky has an end, however far.
        sky = np.where(label == IGNORE, sky, label == SKY)
    depth = np.where(sky, np.float32(np.inf), depth).astype(np.float32)
    skipped, slopes = _edges((1 / depth).astype(np.float32))
    pick = slice(stride_px // 2, None, stride_px)
    height, width = depth[pick, pick].shape
    colours = cv2.resize(
        np.ascontiguousarray(image[: height * stride_px, : width * stride_px]),
        (width, height),
        interpolation=cv2.INTER_AREA,
    )
    (fx, fy), (cx, cy) = frame.camera.focal_px, frame.camera.principal_px
    start = stride_px // 2
    offsets = (cx - (columns.start or 0) - start, cy - (rows.start or 0) - start)
    lens = np.array([fx, fy, *offsets]) / stride_px
    return View(
        world_from_camera=frame.camera.world_from_camera,
        lens=lens,
        stride_px=stride_px,
        depth_m=np.ascontiguousarray(depth[pick, pick]),
        usable=np.isfinite(depth[pick, pick]) & ~skipped[pick, pick],
        slopes=slopes[pick, pick],
        colours=np.reshape(colours, (height, width, 3)).astype(np.float32) / np.float32(255),
        label=None if label is None else label[pick, pick],
    )


def points_world(view: View, rows: NDArray[Any], columns: NDArray[Any]) -> Float64:
    """(N, 3) where the rays through pixels (row, column) of `view` end, metres."""
    return moved(points_camera(view, rows, columns), view.world_from_camera)


def moved(points: Float64, a_from_b: Float64) -> Float64:
    """(N, 3) points of frame b in frame a, by a rigid motion (4, 4)."""
    # Term by term: the same bits everywhere, and no threads for three numbers.
    x, y, z = (points[:, i, None] * a_from_b[:3, i] for i in range(3))
    there: Float64 = x + y + z + a_from_b[:3, 3]
    return there


def points_camera(view: View, rows: NDArray[Any], columns: NDArray[Any]) -> Float64:
    """(N, 3) as `points_world`, in the axes of the camera."""
    fx, fy, cx, cy = view.lens
    depth = view.depth_m[rows, columns].astype(np.float64)
    return np.stack([(columns - cx) / fx * depth, (rows - cy) / fy * depth, depth], axis=-1)


def inside(points: Float64, box: Box, growth: float = BOX_GROWTH, margin_m: float = 0.0) -> Bools:
    """(N,): which points (N, 3) in world axes lie in a box that is made larger.

    Args:
        points: Metres.
        box: Tracked box.
        growth: Factor on its sides.
        margin_m: Then added on each side, metres.
    """
    half = 0.5 * growth * np.array(box.size_m) + margin_m
    own = moved(points, inverse_motion(box.world_from_box))
    return np.asarray((np.abs(own) <= half).all(axis=-1))


def seen_best(views: Sequence[View]) -> list[Bools]:
    """Of each view (h, w): usable pixels whose place no other view sees better.

    A view sees a place better if its pixels are smaller there, and nothing stands in between. Views
    with pixels of one size (to 5 %) go by their order, so that each place is seen best by one.
    """
    height = max((view.depth_m.shape[0] for view in views), default=0)
    width = max((view.depth_m.shape[1] for view in views), default=0)
    depths = np.full((len(views), height, width), np.nan, np.float32)
    for depth, view in zip(depths, views, strict=True):
        # At an edge depth tells nothing about what is beside it.
        known = view.usable | ~np.isfinite(view.depth_m)
        h, w = view.depth_m.shape
        depth[:h, :w] = np.where(known, view.depth_m, np.nan)
    lenses = np.array([view.lens for view in views]).reshape(-1, 4)
    strides = np.array([view.stride_px for view in views], np.float64)
    poses = np.array([view.world_from_camera for view in views]).reshape(-1, 4, 4)
    best = []
    for index, view in enumerate(views):
        rows, columns = np.nonzero(view.usable)
        points = points_world(view, rows, columns)
        own = view.depth_m[rows, columns].astype(np.float64)
        kept = np.zeros_like(view.usable)
        kept[rows, columns] = ~_beaten(points, own, index, depths, lenses, strides, poses)
        best.append(kept)
    return best


def _edges(inverse: Float32) -> tuple[Bools, Float32]:
    """Pixels (H, W) to be skipped, and slopes (H, W, 2), of inverse depth in 1/m, NaN unknown.

    Inverse depth is linear in the pixel on any plane, however slanted. Where it is not, and steps,
    there is an edge; the pixels of the surface in front keep their depth, because thin posts are
    nothing but edges; those behind and between may be a mixture.
    """
    skipped = np.zeros(inverse.shape, np.bool_)
    slopes = np.zeros((*inverse.shape, 2), np.float32)
    for axis, column in ((1, 0), (0, 1)):
        if inverse.shape[axis] < 2:
            continue
        pad = [(0, 0), (0, 0)]
        pad[axis] = (1, 1)
        longer = np.moveaxis(np.pad(inverse, pad, "reflect", reflect_type="odd"), axis, 0)
        before, after = (np.moveaxis(part, 0, axis) for part in (longer[:-2], longer[2:]))
        # What is not known is taken to run on as the other side does.
        before, after = (
            np.where(np.isnan(one), np.where(np.isnan(other), inverse, 2 * inverse - other), one)
            for one, other in ((before, after), (after, before))
        )
        into, out = inverse - before, after - inverse
        limit = np.float32(JUMP_SHARE) * inverse
        rough = np.abs(out - into) > limit
        kernel = np.ones((3, 1) if axis == 0 else (1, 3), np.uint8)
        near_rough = cv2.dilate(rough.astype(np.uint8), kernel) > 0
        steps = np.maximum(np.abs(into), np.abs(out)) > limit
        in_front = np.maximum(before, after) <= inverse + limit
        skipped |= steps & near_rough & ~in_front
        gentle = np.where(np.abs(into) < np.abs(out), into, out)
        slope = np.where(near_rough, gentle, 0.5 * (into + out))
        slopes[..., column] = np.nan_to_num(slope)
    return skipped, slopes


@compiled
def _beaten(
    points: Any, own_depths: Any, own: Any, depths: Any, lenses: Any, strides: Any, poses: Any
) -> Any:
    """(N,): whether another view sees the point (N, 3) of view `own` better; see `seen_best`."""
    beaten = np.zeros(len(points), np.bool_)
    count, height, width = depths.shape
    bins = 1.0 / np.log(FOOTPRINT_RATIO)
    own_focal = lenses[own, 0] * strides[own]
    for n in range(len(points)):
        own_bin = np.floor(np.log(own_depths[n] / own_focal) * bins)
        slack = BEHIND_SHARE * own_depths[n]
        for k in range(1, count):
            # The neighbours in time first: they are the likeliest.
            j = (own + k) % count
            x = points[n, 0] - poses[j, 0, 3]
            y = points[n, 1] - poses[j, 1, 3]
            z = points[n, 2] - poses[j, 2, 3]
            depth = poses[j, 0, 2] * x + poses[j, 1, 2] * y + poses[j, 2, 2] * z
            if depth < MIN_DEPTH_M:
                continue
            right = poses[j, 0, 0] * x + poses[j, 1, 0] * y + poses[j, 2, 0] * z
            down = poses[j, 0, 1] * x + poses[j, 1, 1] * y + poses[j, 2, 1] * z
            u = lenses[j, 0] * right / depth + lenses[j, 2] + 0.5
            v = lenses[j, 1] * down / depth + lenses[j, 3] + 0.5
            if not (0.0 <= u < width and 0.0 <= v < height):
                continue
            surface = depths[j, int(v), int(u)]
            if not depth <= surface + slack:
                continue
            footprint = depth / (lenses[j, 0] * strides[j])
            other_bin = np.floor(np.log(footprint) * bins)
            if other_bin < own_bin or (other_bin == own_bin and j < own):
                beaten[n] = True
                break
    return beaten
