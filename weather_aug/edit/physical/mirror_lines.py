"""Compiled loops that draw the mirror images of a picture's surfaces, line by line.

Lines are the pictures of the perpendiculars of the road's plane: see `mirror`. Rows, columns and
lines count cells of the small grid.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from weather_aug._compiled import compiled, inlined

SURFACE, GROUND, OPEN = np.uint8(0), np.uint8(1), np.uint8(2)
"""Kinds of cells: what is mirrored, what mirrors, and the sky."""
FARTHEST_M = 2000.0
"""For surfaces whose depth is unknown: what they show no longer depends on it."""
CONNECTED = np.float32(0.1)
"""Cells, one above the other, are one surface up to this relative difference of depth."""
CONTACT_M, CONTACT_PER_M = np.float32(0.22), np.float32(0.012)
"""A surface that ends nearer to the road's plane than this, at no distance and more for each metre
of it, stands on the ground that is seen below it, a kerb or a road that is not quite flat. From
here on `site` calls unlabelled cells a surface, so that their true foot is hidden in the ground."""
NOT_BEYOND = np.float32(1.03)
"""Ground farther off than this times a surface is seen below it, not at its foot."""
FADES = np.float32(0.3)
"""Share of that height over which the ground seen below a surface gives way to the plane."""
STANDING_M = np.float32(1.2)
"""A surface that ends over ground in no greater height reaches down to it: lorries do."""
BEHIND = np.float32(1.05)
"""What is guessed about a surface is drawn as if so much farther than what is seen of it."""
OVERLAP = np.float32(1.5)
"""Cells by which a mirror image overlaps what stands on it, because the pixel's classes cut finer
than cells."""


class View(NamedTuple):
    """A pinhole over a plane; pixels are cells of the small grid, axes the camera's."""

    fx: np.float32
    fy: np.float32
    cx: np.float32
    cy: np.float32
    nx: np.float32
    """(nx, ny, nz) is the plane's unit normal, up; ny is negative."""
    ny: np.float32
    nz: np.float32
    above_m: np.float32
    """Of the camera over the plane."""


@inlined
def line_at(row, view):
    """(shift, scale): in this row line j is at column shift + scale j; scale is 0 past the nadir.

    The nadir is at (fx nx + cx nz, fy ny + cy nz) / nz.
    """
    down = (row - view.cy) / (view.fy * view.ny)
    scale = max(np.float32(1.0) - down * view.nz, np.float32(0.0))
    return down * (view.fx * view.nx + view.cx * view.nz), scale


@inlined
def ray_at(row, line, view):
    """(x, y) of the ray of a line's cell at depth 1, camera axes, and how it climbs."""
    shift, scale = line_at(row, view)
    x = (shift + scale * line - view.cx) / view.fx
    y = (row - view.cy) / view.fy
    return x, y, view.nx * x + view.ny * y + view.nz


@inlined
def _image(y, z, height, view):
    """Row and depth of the mirror image of a point of depth z, `height` over what mirrors it."""
    depth = z - np.float32(2.0) * height * view.nz
    if depth < np.float32(0.02) * z:
        return np.float32(1e6), z
    down = z * y - np.float32(2.0) * height * view.ny
    return view.fy * down / depth + view.cy, depth


@inlined
def _span(start, end, depth, cell, first, nearest, shown):
    """Draw a cell over the rows of a line from start to end, where nothing nearer is."""
    low = max(np.int64(np.ceil(max(min(start, end), np.float32(-1.0)))), first)
    last = np.float32(nearest.shape[0] - 1)
    high = np.int64(np.floor(max(min(max(start, end), last), np.float32(-1.0))))
    for row in range(low, high + 1):
        if depth < nearest[row]:
            nearest[row] = depth
            shown[row] = cell


@inlined
def _column(row, line, view, width):
    """Column of a line's cell, the outermost beyond the picture's sides."""
    shift, scale = line_at(row, view)
    column = np.int64(np.floor(shift + scale * line + np.float32(0.5)))
    return min(max(column, 0), width - 1)


@compiled
def draw_lines(depth_m, kind, view, source, spread):
    """Draw all lines."""
    height, width = kind.shape
    nearest = np.empty(height, np.float32)
    shown = np.empty(height, np.int32)
    for j in range(width):
        line = np.float32(j)
        first = height
        while first > 0 and ray_at(np.float32(first - 1), line, view)[2] < np.float32(0.0):
            first -= 1
        nearest[:] = np.float32(np.inf)
        shown[:] = np.int32(-1)
        _draw_line(depth_m, kind, view, line, first, nearest, shown)
        _fill_line(kind, view, line, first, nearest, shown)
        for row in range(first, height):
            source[row, j] = shown[row]
            climb = ray_at(np.float32(row), line, view)[2]
            way = np.float32(1.0) + view.above_m / (climb * nearest[row])
            spread[row, j] = min(max(way, np.float32(0.0)), np.float32(1.0))


@compiled
def _draw_line(depth_m, kind, view, line, first, nearest, shown):
    """Mirror the surfaces of one line, from the lowest up.

    Each continues halfway to those above and below it that belong to the same surface; where a
    nearer one hides it, behind that; and where the picture ends, beyond. The gap between a surface
    and the ground below it goes on with what is seen there: the shade under a car.
    """
    height, width = kind.shape
    half = np.float32(0.5)
    below, z_below, row_below, cell_below = OPEN, np.float32(0.0), np.float32(0.0), np.int32(-1)
    depth_below, raised = np.float32(0.0), np.float32(0.0)
    stands, lowest = False, 0
    for row in range(height - 1, -1, -1):
        column = _column(np.float32(row), line, view, width)
        here, cell = kind[row, column], np.int32(row * width + column)
        if here != SURFACE:
            below, z_below, cell_below = here, depth_m[row, column], cell
            continue
        z = depth_m[row, column]
        _, y, climb = ray_at(np.float32(row), line, view)
        over = view.above_m + z * climb
        joined = below == SURFACE and abs(z - z_below) < CONNECTED * min(z, z_below)
        touches = False
        if not joined:
            raised = np.float32(0.0)
            edge = view.above_m + z * ray_at(np.float32(row) + half, line, view)[2]
            # Under the sill of a car the ground is seen farther off: it does not touch.
            if below == GROUND and z_below < NOT_BEYOND * z:
                off = abs(edge) / (CONTACT_M + CONTACT_PER_M * z)
                share = min(max((np.float32(1.0) - off) / FADES, np.float32(0.0)), np.float32(1.0))
                touches, raised = share > half, share * edge
        if over < raised:
            if below == SURFACE:
                below = OPEN
            continue
        image, depth = _image(y, z, over - raised, view)
        if joined:
            middle = half * (image + row_below)
            _span(row_below, middle, depth_below, cell_below, first, nearest, shown)
            _span(middle, image, depth, cell, first, nearest, shown)
        else:
            _span(image - half, image + half, depth, cell, first, nearest, shown)
            if below == SURFACE and z > z_below:
                hidden = half * over
                if not stands:
                    _, y, climb = ray_at(np.float32(lowest), line, view)
                    hidden = view.above_m + z * climb
                hidden_image, _ = _image(y, z, hidden, view)
                _span(hidden_image, image, depth * BEHIND, cell, first, nearest, shown)
            elif below == SURFACE:
                _span(row_below, image, depth_below * BEHIND, cell_below, first, nearest, shown)
            stands = below == GROUND and (touches or over < STANDING_M)
            lowest = row
            if stands:
                gap = cell if touches else cell_below
                edge = np.float32(row) + half - OVERLAP
                _span(edge, image, depth * BEHIND, gap, first, nearest, shown)
        below, z_below, row_below, cell_below, depth_below = here, z, image, cell, depth
        if row == 0:
            _span(image, np.float32(height), depth * BEHIND, cell, first, nearest, shown)


@compiled
def _fill_line(kind, view, line, first, nearest, shown):
    """Give the rows that nothing was drawn on to the surface next to them, or leave them the sky.

    The sky is left where the picture shows it in the direction of the mirrored ray, or where that
    leaves the picture.
    """
    height, width = kind.shape
    start = first
    while start < height and shown[start] < 0:
        start += 1
    if start == height:
        return
    # What is hidden by a surface's foot has no contact of its own, so it is smeared most.
    cell, depth = shown[start], np.float32(FARTHEST_M)
    for row in range(first, height):
        if shown[row] >= 0:
            cell, depth = shown[row], nearest[row]
            continue
        _, y, climb = ray_at(np.float32(row), line, view)
        # A surface without end: its distance is its height over the plane, in units of the way.
        seen, _ = _image(y, np.float32(1.0), climb, view)
        if seen < np.float32(-0.5):
            continue
        seen_row = min(np.int64(seen + np.float32(0.5)), height - 1)
        if kind[seen_row, _column(np.float32(seen_row), line, view, width)] != OPEN:
            shown[row], nearest[row] = cell, depth
