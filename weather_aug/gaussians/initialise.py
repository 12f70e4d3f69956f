"""Where a fit starts: a Gaussian for each patch of surface that the frames' depth shows.

Each place is taken from the frame that sees it best, and each frame is cut into square cells of
pixels, one Gaussian a cell and surface. So cells grow with distance as pixels do, and overlapping
frames do not pile up layers. A Gaussian lies flat in its surface, is as large as its cell is there,
and has the cell's mean colour. There are none in the sky, which is a cube map, nor in what moves.

Sources:
    OmniRe (Chen et al. 2024): points in moving boxes left out, at most 5,000 an object.
    3DGS-MCMC (Kheradmand et al. 2024): opacity 0.5. 3DGS (Kerbl et al. 2023): colour = 0.5 + C0 dc.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import finite
from weather_aug._keys import check_seed
from weather_aug.clip.poses import inverse_motion
from weather_aug.clip.types import Box, Float64, Frame
from weather_aug.errors import ArgumentError
from weather_aug.gaussians.points import (
    BOX_MARGIN_M,
    View,
    inside,
    moved,
    points_camera,
    points_world,
    seen_best,
    view_of,
)
from weather_aug.gaussians.thinning import cells_of, means_of, some_of, voxels_of
from weather_aug.gaussians.types import SH_COEFFICIENTS, Gaussians
from weather_aug.taxonomy import IGNORE, TRAIN_ID

TRUSTED_DEPTH_M = 80.0
MIN_TRAVEL_M = 1.0
"""A tracked object that goes farther over the clip moves."""
MIN_SPEED_M_PER_S = 1.0
"""One tracked at a single moment moves if it is faster."""
MAX_ACTOR_POINTS = 5000
MAX_PIXELS = 12_000_000
"""Of all frames; of longer clips every n-th pixel is looked at."""
OPACITY = 0.5

_C0 = 0.28209479177387814
_SPREAD = 0.6
_FLATNESS = 0.3
_MAX_RATIO = 10.0
_THINGS = (*range(TRAIN_ID["person"], TRAIN_ID["bicycle"] + 1), IGNORE)


def initial_gaussians(
    frames: Sequence[Frame],
    *,
    count: int,
    seed: int,
    sh_degree: int = 1,
    opacity: float = OPACITY,
    left_out: Collection[int] | None = None,
) -> Gaussians:
    """Gaussians of what stands still, in world axes.

    The result depends neither on the order of `frames` nor on anything but the arguments. Surfaces
    beyond 300 m, and labelled ones without a depth, are placed at 300 m.

    Args:
        frames: Of one clip; those without depth are passed over.
        count: How many; fewer only where the frames show fewer pixels of surface.
        seed: Of which cells are left out to meet `count`, at most one in twenty or so.
        sh_degree: 0..3; coefficients beyond the first are zero.
        opacity: Of each, in (0, 1): 0.5 for relocation (MCMC), 0.1 for splitting by gradient.
        left_out: Track ids whose boxes (5 % and 0.1 m larger) are left out; `moving_tracks(frames)`
            if None.

    Raises:
        ArgumentError: If no frame has depth, none shows a surface, or a number is out of range.
    """
    if isinstance(count, bool) or count != int(count) or count < 1:
        raise ArgumentError(f"count must be an integer of at least 1, got {count!r}")
    if sh_degree not in range(len(SH_COEFFICIENTS)):
        raise ArgumentError(f"sh_degree must be 0, 1, 2 or 3, got {sh_degree!r}")
    check_seed("seed", seed)
    finite("opacity", opacity, 1e-4, 1 - 1e-4)
    ordered = _with_depth(frames)
    tracks = moving_tracks(ordered) if left_out is None else frozenset(left_out)
    pixels = sum(frame.camera.width * frame.camera.height for frame in ordered)
    stride = max(1, math.ceil(math.sqrt(pixels / MAX_PIXELS)))
    views = [_standing(view_of(frame, stride), frame, tracks) for frame in ordered]
    places = [np.nonzero(best) for best in seen_best(views)]
    if not any(len(rows) for rows, _ in places):
        raise ArgumentError("frames show no surface that stands still; check depth and boxes")
    cell_px, cells = cells_of(views, places, int(count))
    kept = some_of(int(cells.max()) + 1, int(count), seed)
    parts, done = [], 0
    for view, (rows, columns) in zip(views, places, strict=True):
        own = cells[done : done + len(rows)]
        done += len(rows)
        used = kept[own]
        parts.append(_patches(view, rows[used], columns[used], own[used], cell_px))
    means, quaternions, scales, colours = (
        np.concatenate(arrays) for arrays in zip(*parts, strict=True)
    )
    return _gaussians(means, quaternions, scales, colours, opacity, sh_degree)


def actor_points(
    frames: Sequence[Frame],
    track_id: int,
    *,
    count: int = MAX_ACTOR_POINTS,
    sh_degree: int = 1,
    opacity: float = OPACITY,
) -> Gaussians:
    """Gaussians of one tracked object, in the axes of its box: x ahead, y left, z up, its centre 0.

    For rigid and deformable objects alike. Points lie within the box made 5 % larger; where frames
    have labels, those of ground and scenery are left out. Of points in one cell those of the
    sharpest view count. The result does not depend on the order of `frames`.

    Args:
        frames: Of one clip.
        track_id: Which object.
        count: At most as many, at least 1.
        sh_degree: 0..3.
        opacity: Of each, in (0, 1).

    Returns:
        Gaussians, round ones; none if the object is hidden in every frame.

    Raises:
        ArgumentError: If no frame has depth, or none has a box of this track.
    """
    finite("count", count, 1)
    finite("opacity", opacity, 1e-4, 1 - 1e-4)
    boxed = [
        (frame, box)
        for frame in _with_depth(frames)
        for box in frame.boxes
        if box.track_id == track_id
    ]
    if not boxed:
        raise ArgumentError(f"track_id {track_id!r} is in no frame with depth; see Frame.boxes")
    found = [_points_in_box(frame, box) for frame, box in boxed]
    points, colours, footprints = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
    if len(points) == 0:
        empty = np.zeros((0, 3))
        return _gaussians(empty, np.zeros((0, 4)), empty, empty, opacity, sh_degree)
    side_m, cells = voxels_of(points, float(np.quantile(footprints, 0.05)), int(count))
    sharpest = np.full(int(cells.max()) + 1, np.inf)
    np.minimum.at(sharpest, cells, footprints)
    used = footprints <= 1.25 * sharpest[cells]
    cells = cells[used]
    means, tones = means_of(points[used], cells), means_of(colours[used], cells)
    sizes = np.maximum(side_m, sharpest)[:, None].repeat(3, axis=1)
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (len(means), 1))
    return _gaussians(means, upright, _SPREAD * sizes, tones, opacity, sh_degree)


def moving_tracks(frames: Sequence[Frame], min_travel_m: float = MIN_TRAVEL_M) -> frozenset[int]:
    """Ids of tracks whose boxes are more than `min_travel_m` from where they were first seen.

    A track of a single moment moves if its velocity is known and above 1 m/s.
    """
    first: dict[int, Box] = {}
    moments: dict[int, set[float]] = {}
    moving = set()
    for frame in sorted(frames, key=lambda frame: (frame.time_s, frame.key)):
        for box in frame.boxes:
            start = first.setdefault(box.track_id, box)
            moments.setdefault(box.track_id, set()).add(frame.time_s)
            travel = box.world_from_box[:3, 3] - start.world_from_box[:3, 3]
            if float(np.linalg.norm(travel)) > min_travel_m:
                moving.add(box.track_id)
    for track, times in moments.items():
        velocity = first[track].velocity_m_per_s
        if len(times) == 1 and velocity is not None:
            moving |= {track} if float(np.linalg.norm(velocity)) > MIN_SPEED_M_PER_S else set()
    return frozenset(moving)


def scene_radius_m(frames: Sequence[Frame]) -> float:
    """How far away things are: the median depth of the surfaces seen up to 80 m, at least 1 m.

    Learning rates of places and sizes are shares of it. 3DGS takes 1.1 times the largest distance
    of a camera from their mean, because cameras that go round a thing are as far from each other as
    from the thing. On a drive that would be half the way driven, and has nothing to do with how
    large a pixel is where it falls: 1.6e-4 of the depth is a sixth of a pixel at f = 1000 px.

    Raises:
        ArgumentError: If no frame has depth, or none shows a surface up to 80 m.
    """
    depths = [np.asarray(frame.depth_m)[2::4, 2::4].ravel() for frame in _with_depth(frames)]
    depth = np.concatenate(depths).astype(np.float64)
    near = depth[(depth > 0) & (depth <= TRUSTED_DEPTH_M)]
    if len(near) == 0:
        raise ArgumentError("frames show no surface within 80 m; check their depth")
    return max(float(np.median(near)), 1.0)


def _with_depth(frames: Sequence[Frame]) -> list[Frame]:
    """Those with depth, in the order of their keys, so that no sum depends on the order given."""
    known = [frame for frame in frames if frame.depth_m is not None]
    if not known:
        raise ArgumentError("frames carry no depth; open the clip with stereo, LiDAR or a prior")
    return sorted(known, key=lambda frame: frame.key)


def _standing(view: View, frame: Frame, tracks: frozenset[int]) -> View:
    """Leave out of `view` what lies in the boxes of `tracks`."""
    boxes = [box for box in frame.boxes if box.track_id in tracks]
    if not boxes:
        return view
    usable = view.usable.copy()
    rows, columns = np.nonzero(usable)
    points = points_world(view, rows, columns)
    for box in boxes:
        within = inside(points, box, margin_m=BOX_MARGIN_M)
        usable[rows[within], columns[within]] = False
    return view._replace(usable=usable)


def _patches(
    view: View,
    rows: NDArray[Any],
    columns: NDArray[Any],
    cells: NDArray[np.int64],
    cell_px: float,
) -> tuple[Float64, Float64, Float64, Float64]:
    """Means, quaternions, scales in metres and colours of the cells of one view."""
    _, cells = np.unique(cells, return_inverse=True)
    points = means_of(points_camera(view, rows, columns), cells)
    slopes = means_of(view.slopes[rows, columns].astype(np.float64), cells)
    colours = means_of(view.colours[rows, columns].astype(np.float64), cells)
    depth = points[:, 2:]
    focal = view.lens[:2] * view.stride_px
    # Along the picture's axes the surface runs by these vectors a pixel.
    steps = -(depth**2) * slopes
    tangents = steps[:, :, None] * (points / depth)[:, None, :]
    tangents[:, 0, 0] += depth[:, 0] / focal[0]
    tangents[:, 1, 1] += depth[:, 0] / focal[1]
    covariances = np.einsum("nki,nkj->nij", tangents, tangents)
    squares, axes = np.linalg.eigh(covariances)
    sizes = np.sqrt(np.maximum(squares, 0.0))
    # Seen at a grazing angle a pixel is longer than a fit can hold.
    sizes[:, 2] = np.minimum(sizes[:, 2], _MAX_RATIO * sizes[:, 1])
    sizes[:, 0] = np.maximum(_FLATNESS * sizes[:, 1], sizes[:, 2] / _MAX_RATIO)
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    rotation = view.world_from_camera[:3, :3]
    means = moved(points, view.world_from_camera)
    return means, _quaternions(rotation @ axes), _SPREAD * cell_px * sizes, colours


def _quaternions(rotations: Float64) -> Float64:
    """(N, 4) unit (w, x, y, z) of rotations (N, 3, 3), their largest component positive.

    Sources:
        Shepperd 1978: the component that is largest is found first, so that nothing cancels.
    """
    r = np.moveaxis(rotations, 0, -1)
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    outer = np.empty((len(rotations), 4, 4))
    for i, value in enumerate((trace, r[0, 0], r[1, 1], r[2, 2])):
        outer[:, i, i] = 1 + 2 * value - trace if i else 1 + trace
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        outer[:, 0, i + 1] = outer[:, i + 1, 0] = r[k, j] - r[j, k]
        outer[:, i + 1, j + 1] = outer[:, j + 1, i + 1] = r[i, j] + r[j, i]
    largest = np.argmax(np.einsum("nii->ni", outer), axis=1)
    picked = outer[np.arange(len(rotations)), largest]
    unit: Float64 = picked / np.linalg.norm(picked, axis=1, keepdims=True)
    return unit


def _points_in_box(frame: Frame, box: Box) -> tuple[Float64, Float64, Float64]:
    """Points (M, 3) of a frame in the axes of a box, their colours (M, 3) and pixel sizes (M,)."""
    window = _window_of(frame, box)
    view = view_of(frame, window=window)
    usable = view.usable
    if view.label is not None:
        usable = usable & np.isin(view.label, _THINGS)
    rows, columns = np.nonzero(usable)
    points = points_world(view, rows, columns)
    within = inside(points, box)
    rows, columns = rows[within], columns[within]
    own = moved(points[within], inverse_motion(box.world_from_box))
    colours = view.colours[rows, columns].astype(np.float64)
    own_depth = view.depth_m[rows, columns].astype(np.float64)
    return own, colours, own_depth / view.lens[0]


def _window_of(frame: Frame, box: Box) -> tuple[slice, slice]:
    """Rows and columns that a box can be seen in, with a pixel around for the edges."""
    camera = frame.camera
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    corners = 0.6 * signs * np.array(box.size_m)
    world = corners @ box.world_from_box[:3, :3].T + box.world_from_box[:3, 3]
    seen = (world - camera.centre_world) @ camera.world_from_camera[:3, :3]
    if seen[:, 2].min() < 0.1:
        return slice(0, camera.height), slice(0, camera.width)
    pixels = seen @ camera.intrinsics.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    limits = np.array([camera.width, camera.height])
    low = np.clip(np.floor(pixels.min(axis=0)) - 2, 0, limits - 1).astype(int)
    high = np.clip(np.ceil(pixels.max(axis=0)) + 3, low + 1, limits).astype(int)
    return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))


def _gaussians(
    means: Float64,
    quaternions: Float64,
    scales_m: Float64,
    colours: Float64,
    opacity: float,
    sh_degree: int,
) -> Gaussians:
    count = len(means)
    sh = np.zeros((count, SH_COEFFICIENTS[sh_degree], 3), np.float32)
    sh[:, 0] = (colours - 0.5) / _C0
    return Gaussians(
        means_m=means.astype(np.float32),
        quaternions=quaternions.astype(np.float32),
        log_scales=np.log(scales_m).astype(np.float32),
        logit_opacities=np.full(count, math.log(opacity / (1 - opacity)), np.float32),
        sh=sh,
        class_scores=np.zeros((count, 0), np.float16),
    )
