"""The map of covers of a drive, from the depth and labels of its frames.

A cover is what a camera sees overhead with open space and then the ground below it: a bridge, a
tunnel's ceiling, a canopy. The heights of all surface points in a column of the street tell:

    bridge      ground . . . . . . deck                 a gap, then points within a deck's height
    facade      ground : : : : : : : : : : : :          no gap
    crown       ground . . . . : : : : : : : :          a gap, then points over metres

A cover that is missed costs little; one that is not there makes a hole in the rain. So each column
needs the ground, the gap and a thin layer, and covers need to be wide. Leaves let rain through:
where labels exist, only what may be part of a building or a bridge is a cover; without labels
only what is as large and flat as a deck, because a crown is neither.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.types import Camera
from weather_aug.errors import SceneError
from weather_aug.particles.shelter import CELL_M, Shelter
from weather_aug.taxonomy import BUILDING, IGNORE, SKY, TRAIN_ID

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Mask = NDArray[np.bool_]

SAMPLES_PER_SIDE = 160
RANGE_M = 40.0
"""Depth is worse farther away, and a drive comes nearer to what it passes below."""
LEAST_SLOPE = 0.08
"""Of a ray that looks up at a cover; roads ahead are hardly steeper."""
LEAST_ABOVE_CAMERA_M = 1.0
LAYER_M = 0.5
"""Height of the layers in which a column's points are counted."""
CLEARANCE_LAYERS = 5
"""Least height of a cover over what is below it: 2.5 m."""
DECK_LAYERS = 4
LAYERS_BELOW, LAYERS_ABOVE = 40, 16
LEAST_POINTS, LEAST_POINTS_BELOW, LEAST_FRAMES = 6, 3, 2
STRAY_SHARE = 0.1
LEAST_AREA_M2 = 8.0
LEAST_UNLABELLED_AREA_M2 = 40.0
MOST_UNEVEN_M = 0.2
"""Median distance of an unlabelled cover's cells from a plane."""
LEAST_WIDTH_CELLS = 5
MAX_CELLS = 64_000_000

# Data sets have a class for bridges and tunnels, and it is not trained on.
_COVERS = np.isin(np.arange(256), (BUILDING, TRAIN_ID["wall"], IGNORE))
# They drive or walk on: what they hide for a moment is free.
_MOVERS = np.isin(
    np.arange(256),
    [TRAIN_ID[name] for name in "person rider car truck bus train motorcycle bicycle".split(" ")],
)

_HALF = 1 << 20
_LAYER_BITS = 16
_HALF_LAYERS = 1 << (_LAYER_BITS - 1)
_ROW = 2 * _HALF


class View(NamedTuple):
    """What a frame says about surfaces."""

    camera: Camera
    depth_m: NDArray[Any]
    """(H, W) z-depth, metres, `inf` for the sky."""
    label: NDArray[np.uint8] | None
    """(H, W) train ids."""


class Points(NamedTuple):
    """Surface points of a drive whose geometry is known; what moves is not among them."""

    street_m: Float64
    """(N, 3) street coordinates, evenly over the surfaces, `CELL_M` / 2 apart."""
    above_camera_m: Float64
    """(N,) height over the camera that came nearest."""
    label: NDArray[np.uint8] | None
    """(N,) train ids."""


class _Table(NamedTuple):
    """Points counted by column and layer, (N,) each, sorted by key."""

    key: Int64
    points: Int64
    """All surfaces."""
    covers: Int64
    """Of them what may be a cover overhead."""
    height_m: Float64
    """Sum of the heights of `covers`, above the reference."""
    frames: Int64
    """In how many frames there are `covers`."""


def shelter_of(views: Iterable[View], axes_world: Float64) -> Shelter | None:
    """Map the covers that the frames of a drive show.

    Args:
        views: Frames of one drive; at most 160 x 160 pixels of each are read.
        axes_world: (3, 3), rows: along the street, to the left, up.

    Returns:
        The map, cut to the covers; None where the sky is open everywhere.

    Raises:
        SceneError: If the covers lie too far apart for one map.
    """
    reference_m: Float64 | None = None
    labelled = True
    tables: list[_Table] = []
    for view in views:
        if reference_m is None:
            reference_m = axes_world @ view.camera.centre_world
        labelled &= view.label is not None
        tables.append(_counted(view, axes_world, reference_m))
        # Merged now and then, so that memory follows the street and not the number of frames.
        if len(tables) == 64:
            tables = [_merged(tables)]
    if reference_m is None:
        return None
    cells, cover_m = _covered(_merged(tables))
    if len(cells) == 0:
        return None
    return _mapped(cells, cover_m, reference_m, axes_world, labelled)


def shelter_of_points(points: Points, axes_world: Float64, reference_m: Float64) -> Shelter | None:
    """Map the covers among a drive's surfaces, by the same rules.

    Each point counts as seen in as many frames as are asked for: a surface that only one frame
    showed is not reconstructed where it is.

    Args:
        points: Of the surfaces.
        axes_world: (3, 3), rows: along the street, to the left, up.
        reference_m: (3,) street coordinates of a place in the drive.

    Returns:
        The map, cut to the covers; None where the sky is open everywhere.

    Raises:
        SceneError: If the covers lie too far apart for one map.
    """
    is_cover = points.above_camera_m > LEAST_ABOVE_CAMERA_M
    if points.label is not None:
        is_cover &= _COVERS[points.label]
    table = _tabulated(points.street_m - reference_m, is_cover)
    cells, cover_m = _covered(table._replace(frames=LEAST_FRAMES * table.frames))
    if len(cells) == 0:
        return None
    return _mapped(cells, cover_m, reference_m, axes_world, points.label is not None)


def _counted(view: View, axes_world: Float64, reference_m: Float64) -> _Table:
    """Count one frame's points."""
    street, slope, label = _points(view, axes_world)
    above_m = street[:, 2] - axes_world[2] @ view.camera.centre_world
    is_cover = (slope > LEAST_SLOPE) & (above_m > LEAST_ABOVE_CAMERA_M)
    if label is not None:
        is_cover &= _COVERS[label]
    return _tabulated(street - reference_m, is_cover)


def _tabulated(place: Float64, is_cover: Mask) -> _Table:
    """Count points (N, 3), metres from the reference, by column and layer, as of one frame."""
    index = np.floor(place / (CELL_M, CELL_M, LAYER_M)).astype(np.int64)
    inside = (np.abs(index) < (_HALF - 1, _HALF - 1, _HALF_LAYERS - LAYERS_BELOW)).all(axis=1)
    index += (_HALF, _HALF, _HALF_LAYERS)
    key = ((index[:, 0] * _ROW + index[:, 1]) << _LAYER_BITS) + index[:, 2]
    key, is_cover, height = key[inside], is_cover[inside], place[inside, 2]
    one = np.ones(len(key), np.int64)
    table = _summed(_Table(key, one, is_cover.astype(np.int64), height * is_cover, one))
    return table._replace(frames=(table.covers > 0).astype(np.int64))


def _points(view: View, axes_world: Float64) -> tuple[Float64, Float64, NDArray[np.uint8] | None]:
    """Surface points (N, 3) in street coordinates, the slopes of their rays, their labels."""
    camera = view.camera
    steps = tuple(-(-side // SAMPLES_PER_SIDE) for side in view.depth_m.shape)
    depth = np.asarray(view.depth_m[:: steps[0], :: steps[1]], np.float64)
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    rows = (np.arange(depth.shape[0]) * steps[0] - cy) / fy
    columns = (np.arange(depth.shape[1]) * steps[1] - cx) / fx
    rays = np.stack([*np.meshgrid(columns, rows), np.ones_like(depth)], axis=-1)
    street_from_camera = axes_world @ camera.world_from_camera[:3, :3]
    rays = rays @ street_from_camera.T
    level = np.hypot(rays[..., 0], rays[..., 1])
    with np.errstate(invalid="ignore"):
        seen = (depth > 0) & (depth * level < RANGE_M)
    label = None if view.label is None else np.asarray(view.label[:: steps[0], :: steps[1]])
    if label is not None:
        seen &= (label != SKY) & ~_MOVERS[label]
    points = axes_world @ camera.centre_world + depth[seen][:, None] * rays[seen]
    slope = rays[seen][:, 2] / np.maximum(level[seen], 1e-6)
    return points, slope, None if label is None else label[seen]


def _merged(tables: list[_Table]) -> _Table:
    return _summed(_Table(*(np.concatenate(column) for column in zip(*tables, strict=True))))


def _summed(table: _Table) -> _Table:
    """Add up the rows of equal keys."""
    order = np.argsort(table.key, kind="stable")
    key = table.key[order]
    if len(key) == 0:
        return table
    first = np.flatnonzero(np.r_[True, key[1:] != key[:-1]])
    sums = [np.add.reduceat(column[order], first) for column in table[1:]]
    return _Table(key[first], *sums)


def _covered(table: _Table) -> tuple[Int64, Float64]:
    """Columns (N,) with a cover, and its height (N,) over the reference; the module tells how."""
    candidate = table.covers > 0
    cells, start = np.unique(table.key[candidate] >> _LAYER_BITS, return_index=True)
    lowest = (table.key[candidate] & (2 * _HALF_LAYERS - 1))[start]
    points, covers, height_m, frames = _columns(table, cells, lowest)
    if len(cells) == 0:
        return cells, np.zeros(0)
    total = covers.sum(axis=1)
    share = np.cumsum(covers, axis=1) / total[:, None]
    low = (share > STRAY_SHARE).argmax(axis=1)
    high = (share >= 1 - 2 * STRAY_SHARE).argmax(axis=1)
    layer = np.arange(points.shape[1])
    # The layer under the lowest points is left out of the gap: their noise is there.
    gap = (layer >= low[:, None] - CLEARANCE_LAYERS) & (layer < low[:, None] - 1)
    below = layer < low[:, None] - CLEARANCE_LAYERS
    underside = (layer >= low[:, None]) & (layer < low[:, None] + 2)
    found = (
        (total >= LEAST_POINTS)
        & (frames >= LEAST_FRAMES)
        & (high - low < DECK_LAYERS)
        & ((points * gap).sum(axis=1) <= STRAY_SHARE * total)
        & ((points * below).sum(axis=1) >= LEAST_POINTS_BELOW)
    )
    cover_m = (height_m * underside).sum(axis=1) / np.maximum((covers * underside).sum(axis=1), 1)
    return cells[found], cover_m[found]


def _columns(table: _Table, cells: Int64, lowest: Int64) -> tuple[Int64, Int64, Float64, Int64]:
    """Points, covers and sums of heights by layer (N, layers) and frames (N,) around each cell.

    A column is 3 x 3 cells; its layers begin LAYERS_BELOW under the cell's lowest cover.
    """
    layers = LAYERS_BELOW + LAYERS_ABOVE
    size = len(cells) * layers
    sums = [np.zeros(size), np.zeros(size), np.zeros(size)]
    frames = np.zeros(len(cells), np.int64)
    owner, layer = table.key >> _LAYER_BITS, table.key & (2 * _HALF_LAYERS - 1)
    for i in (-_ROW, 0, _ROW):
        for j in (-1, 0, 1):
            row = np.minimum(np.searchsorted(cells, owner + i + j), max(len(cells) - 1, 0))
            near = np.flatnonzero(cells[row] == owner + i + j) if len(cells) else row[:0]
            place = layer[near] - lowest[row[near]] + LAYERS_BELOW
            near = near[(place >= 0) & (place < layers)]
            place = layer[near] - lowest[row[near]] + LAYERS_BELOW + row[near] * layers
            for total, column in zip(sums, table[1:4], strict=True):
                total += np.bincount(place, column[near], size)
            np.maximum.at(frames, row[near], table.frames[near])
    points, covers, height_m = (total.reshape(-1, layers) for total in sums)
    return points.astype(np.int64), covers.astype(np.int64), height_m, frames


def _mapped(
    cells: Int64, cover_m: Float64, reference_m: Float64, axes_world: Float64, labelled: bool
) -> Shelter | None:
    """The wide patches of covered cells, cut to their bounds."""
    index = np.stack([cells // _ROW, cells % _ROW], axis=1)
    corner, shape = _bounds(index)
    place = tuple((index - corner).T)
    found = np.zeros(shape, np.uint8)
    found[place] = 1
    heights = np.zeros(shape, np.float32)
    heights[place] = cover_m
    wide = _wide_patches(found, heights, labelled)
    if not wide.any():
        return None
    nearest = _nearest_values(heights, found & wide)
    kept, kept_shape = _bounds(np.argwhere(wide))
    part = tuple(slice(k, k + n) for k, n in zip(kept, kept_shape, strict=True))
    cover = np.where(wide[part] > 0, nearest[part], np.float32(np.inf))
    level = np.append((corner + kept - _HALF) * CELL_M, 0.0)
    return Shelter(cover, reference_m + level, axes_world)


def _bounds(index: Int64) -> tuple[Int64, tuple[int, int]]:
    """Least index (2,), and the shape of the box around all."""
    least, most = index.min(axis=0), index.max(axis=0)
    rows, columns = (int(n) for n in most - least + 1)
    if rows * columns > MAX_CELLS:
        raise SceneError(
            f"bridges of this clip lie {rows * CELL_M:.0f} m x {columns * CELL_M:.0f} m apart, too "
            "far for one map; build it in parts"
        )
    return least, (rows, columns)


def _wide_patches(
    found: NDArray[np.uint8], heights: NDArray[np.float32], labelled: bool
) -> NDArray[np.uint8]:
    """Patches without their small holes, if they are wide, large and mostly found."""
    least_area_m2 = LEAST_AREA_M2 if labelled else LEAST_UNLABELLED_AREA_M2
    margin = LEAST_WIDTH_CELLS
    square = np.ones((LEAST_WIDTH_CELLS, LEAST_WIDTH_CELLS), np.uint8)
    padded = np.pad(found, margin)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, square)
    opened = cv2.morphologyEx(closed, cv2.MORPH_OPEN, square)
    count, patches = cv2.connectedComponents(opened, connectivity=4)
    area = np.bincount(patches.reshape(-1), minlength=count)
    seen = np.bincount(patches.reshape(-1), padded.reshape(-1), count)
    keep = (area * CELL_M**2 >= least_area_m2) & (seen >= 0.5 * area)
    keep[0] = False
    patches = patches[margin:-margin, margin:-margin]
    wide = keep[patches]
    if not labelled:
        for patch in np.flatnonzero(keep):
            cells = (patches == patch) & (found > 0)
            wide &= (patches != patch) | _flat_part(cells, heights)
    return np.asarray(wide, np.uint8)


def _flat_part(cells: Mask, heights: NDArray[np.float32]) -> Mask:
    """Cells near the plane that most of them share; none if they share none."""
    place = np.argwhere(cells) * CELL_M
    design = np.column_stack([place - place.mean(axis=0), np.ones(len(place))])
    value = heights[cells].astype(np.float64)
    off_m = np.abs(value - np.median(value))
    for _ in range(4):
        near = off_m <= 2 * np.median(off_m)
        plane = np.linalg.lstsq(design[near], value[near], rcond=None)[0]
        off_m = np.abs(value - design @ plane)
    flat = np.zeros(cells.shape, bool)
    is_deck = np.median(off_m) < MOST_UNEVEN_M
    flat[cells] = is_deck & (off_m < LEAST_ABOVE_CAMERA_M)
    if flat.sum() * CELL_M**2 < LEAST_UNLABELLED_AREA_M2:
        flat[:] = False
    return flat


def _nearest_values(values: NDArray[np.float32], known: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Each cell's value, or that of the nearest cell that has one."""
    _, nearest = cv2.distanceTransformWithLabels(
        (known == 0).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    value_by_seed = np.zeros(int(nearest.max()) + 1, np.float32)
    value_by_seed[nearest[known > 0]] = values[known > 0]
    return value_by_seed[nearest]
