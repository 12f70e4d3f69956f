"""A grid over the ground with the parts above each cell, and the rays that walk through it (numba).

The grid is two-dimensional: a street is flat, so cells with the height of their tallest part
reject most rays without looking at a shape.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import inlined
from weather_aug.clip.street_parts import Parts
from weather_aug.clip.street_path import Curve, Section, centre_y
from weather_aug.clip.street_shapes import span

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
Hit = tuple[float, int]

CELL_M = 2.5


class World(NamedTuple):
    """Everything that a ray can meet, sorted into cells."""

    kind: Int64
    frame: Float64
    shape: Float64
    planes: Float64
    seed: Float64
    """(N,)"""
    ball: Float64
    """(N, 4): centre and squared radius of a sphere around each part, world."""
    start: Int64
    """(cells + 1,): the parts of cell c are item[start[c]:start[c + 1]]."""
    item: Int64
    top_m: Float64
    """(cells,): height of the tallest part of each cell."""
    corner: Float64
    """(2,): least x and y of the grid."""
    size: Int64
    """(2,): cells along x and y."""
    roof_m: float
    """Height above which there is nothing."""


def world_of(parts: Parts) -> World:
    """Sort parts into the cells of a grid that covers them all."""
    c, s = parts.frame[:, 3], parts.frame[:, 4]
    middle, half = parts.bounds[:, :3], parts.bounds[:, 3:]
    x = parts.frame[:, 0] + c * middle[:, 0] - s * middle[:, 1]
    y = parts.frame[:, 1] + s * middle[:, 0] + c * middle[:, 1]
    z = parts.frame[:, 2] + middle[:, 2]
    reach_x = np.abs(c) * half[:, 0] + np.abs(s) * half[:, 1]
    reach_y = np.abs(s) * half[:, 0] + np.abs(c) * half[:, 1]
    corner = np.array([(x - reach_x).min(), (y - reach_y).min()])
    low = np.stack([x - reach_x, y - reach_y], 1) - corner
    high = np.stack([x + reach_x, y + reach_y], 1) - corner
    first = np.floor(low / CELL_M).astype(np.int64)
    last = np.floor(high / CELL_M).astype(np.int64)
    size = last.max(0) + 1
    top = z + half[:, 2]
    start, item, top_m = _filled(first, last, size, top)
    ball = np.stack([x, y, z, (half * half).sum(1)], 1)
    return World(
        kind=parts.kind,
        frame=parts.frame,
        shape=parts.shape,
        planes=parts.planes if len(parts.planes) else np.zeros((1, 4)),
        seed=np.ascontiguousarray(parts.look[:, 7]),
        ball=ball,
        start=start,
        item=item,
        top_m=top_m,
        corner=corner,
        size=size,
        roof_m=float(top.max()),
    )


def _filled(first: Int64, last: Int64, size: Int64, top: Float64) -> tuple[Int64, Int64, Float64]:
    """List the parts of each cell, from the ranges of cells that each part covers."""
    extent = last - first + 1
    count = extent[:, 0] * extent[:, 1]
    part = np.repeat(np.arange(len(count)), count)
    number = np.arange(len(part)) - np.repeat(np.cumsum(count) - count, count)
    wide = extent[part, 0]
    cell = (first[part, 1] + number // wide) * size[0] + first[part, 0] + number % wide
    order = np.argsort(cell, kind="stable")
    cells = int(size[0] * size[1])
    start = np.zeros(cells + 1, np.int64)
    np.cumsum(np.bincount(cell, minlength=cells), out=start[1:])
    top_m = np.zeros(cells)
    np.maximum.at(top_m, cell, top[part])
    return start, part[order], top_m


@inlined
def cell_of(world: World, x: float, y: float) -> int:
    """Return the index of the cell over a point of the ground, -1 outside the grid."""
    cx = math.floor((x - world.corner[0]) / 2.5)
    cy = math.floor((y - world.corner[1]) / 2.5)
    if 0 <= cx < world.size[0] and 0 <= cy < world.size[1]:
        return cy * world.size[0] + cx
    return -1


@inlined
def first_part(
    world: World,
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    limit: float,
) -> Hit:
    """Return the nearest part before `limit`: (t, index), or (limit, -1).

    A negative limit makes it a shadow ray: it stops at any part, also one that it starts in.

    Source:
        Amanatides and Woo, A Fast Voxel Traversal Algorithm, 1987.
    """
    h = 2.5
    shadow = limit < 0.0
    if shadow:
        limit = math.inf
    px, py = ox - world.corner[0], oy - world.corner[1]
    nx, ny = world.size[0], world.size[1]
    t, stop = 0.0, limit
    if dz > 1e-12:
        stop = min(stop, (world.roof_m - oz) / dz)
    # Clip the ray to the grid.
    for axis in range(2):
        o, d, extent = (px, dx, nx * h) if axis == 0 else (py, dy, ny * h)
        if abs(d) < 1e-12:
            if o < 0.0 or o >= extent:
                return limit, -1
        else:
            a, b = -o / d, (extent - o) / d
            t, stop = max(t, min(a, b)), min(stop, max(a, b))
    if t >= stop:
        return limit, -1
    cx = min(max(math.floor((px + dx * t) / h), 0), nx - 1)
    cy = min(max(math.floor((py + dy * t) / h), 0), ny - 1)
    sx, sy = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
    gx = h / abs(dx) if abs(dx) > 1e-12 else math.inf
    gy = h / abs(dy) if abs(dy) > 1e-12 else math.inf
    tx = ((cx + (sx > 0)) * h - px) / dx if abs(dx) > 1e-12 else math.inf
    ty = ((cy + (sy > 0)) * h - py) / dy if abs(dy) > 1e-12 else math.inf
    best, found = limit, -1
    square = dx * dx + dy * dy + dz * dz
    start, item, top_m, ball = world.start, world.item, world.top_m, world.ball
    kind, frame, shape = world.kind, world.frame, world.shape
    planes, seed = world.planes, world.seed
    while t < stop and t < best:
        leave = min(tx, ty)
        cell = cy * nx + cx
        lowest = oz + dz * (t if dz > 0.0 else min(leave, stop))
        if lowest <= top_m[cell]:
            for k in range(start[cell], start[cell + 1]):
                i = item[k]
                bx, by, bz = ball[i, 0] - ox, ball[i, 1] - oy, ball[i, 2] - oz
                along = bx * dx + by * dy + bz * dz
                if (bx * bx + by * by + bz * bz - ball[i, 3]) * square > along * along:
                    continue
                c, s = frame[i, 3], frame[i, 4]
                rx, ry = ox - frame[i, 0], oy - frame[i, 1]
                near, far = span(
                    kind[i],
                    c * rx + s * ry,
                    c * ry - s * rx,
                    oz - frame[i, 2],
                    c * dx + s * dy,
                    c * dy - s * dx,
                    dz,
                    shape[i],
                    planes,
                    seed[i],
                    best,
                )
                if near > far:
                    continue
                if shadow:
                    if far > 0.0:
                        return 0.0, i
                elif 0.0 < near < best:
                    best, found = near, i
        t = leave
        if tx <= ty:
            cx, tx = cx + sx, tx + gx
        else:
            cy, ty = cy + sy, ty + gy
        if cx < 0 or cy < 0 or cx >= nx or cy >= ny:
            break
    return best, found


@inlined
def ground_hit(
    curve: Curve,
    section: Section,
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
) -> Hit:
    """Return where a ray from above meets the ground: (t, 1 road, 2 kerb face or 3 pavement)."""
    if dz > -1e-9:
        return math.inf, 0
    inside = (section.kerb_height_m - oz) / dz
    x = ox + dx * inside
    if abs(oy + dy * inside - centre_y(curve, x)) >= section.kerb_m:
        return inside, 3
    outside = -oz / dz
    x = ox + dx * outside
    if abs(oy + dy * outside - centre_y(curve, x)) < section.kerb_m:
        return outside, 1
    for _ in range(40):
        t = 0.5 * (inside + outside)
        if abs(oy + dy * t - centre_y(curve, ox + dx * t)) < section.kerb_m:
            inside = t
        else:
            outside = t
    return outside, 2
