"""What the road mirrors, from a render of the street's mirror image instead of the picture alone.

A picture does not show all that its road mirrors: the tops of houses and crowns beyond its upper
border, the sides of cars that face the road. Who has the street's geometry renders it with the
camera's mirror image and hands the render in; what that does not know, the picture still tells.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.types import Camera
from weather_aug.colour import LUMINANCE, linear_from_srgb
from weather_aug.edit.physical import relight
from weather_aug.edit.physical.mirror import MirrorMap
from weather_aug.edit.physical.mirror_lines import FARTHEST_M, View
from weather_aug.edit.physical.site import Site
from weather_aug.errors import ArgumentError

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

LEAST_OPACITY, SURE_OPACITY = 0.5, 0.9
"""Of a render's cell that shows some surface, and of one that shows nothing else."""
BEHIND = 0.9
"""A render's surface is behind what is guessed if that has less than this share of its depth."""
THROUGH = 1.1
"""The picture sees through a place if what it shows there is farther by this factor."""
OWN_ROWS = 2.0
"""A cell is its surface's own mirror image up to so many rows from where that must be."""


class Seen(NamedTuple):
    """The street's mirror image in the road's plane, on the small grid (h, w) of a site.

    In the picture's own places, as if the road were glass with the mirrored street below it; the
    ground itself, what is below it, and the sky are left out.
    """

    srgb: Float32
    """(h, w, 3) in [0, 1], of the surfaces alone."""
    depth_m: Float32
    """(h, w) z-depth of the mirror image; of no account where nothing is."""
    opacity: Float32
    """(h, w) in [0, 1]."""


def small_camera(site: Site) -> Camera:
    """The camera of a site's small grid: one pixel is one cell, also beyond the picture."""
    camera = site.frame.camera
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    step = site.step
    height, width = site.shape
    centre = (cx + 0.5) / step - 0.5, (cy + 0.5) / step - 0.5
    intrinsics = np.array([[fx / step, 0, centre[0]], [0, fy / step, centre[1]], [0, 0, 1.0]])
    return Camera(intrinsics, camera.world_from_camera, width, height)


def road_of(site: Site) -> tuple[Float64, Float64]:
    """A point (3,) of the road's plane, metres, and its unit normal (3,), up; world axes."""
    normal = np.array([-site.plane[1], -site.plane[2], 1.0])
    normal = site.axes_world.T @ normal / np.linalg.norm(normal)
    return site.axes_world.T @ np.array([0.0, 0.0, site.plane[0]]), normal


def with_seen(
    site: Site, flat: relight.Flattening, guessed: MirrorMap, light: Float32, seen: Seen
) -> tuple[MirrorMap, Float32]:
    """The mirror's map and the light it points to: of the picture, a render, and guesses.

    Where the picture itself shows what the road mirrors, it is sharper than any render, and knows
    of things that moved while nobody tracked them. Where it does not, the render does, if it is
    sure: what is half
    transparent there, or behind what is guessed, or what the picture sees through, leaves the guess
    in its place. Where the render is open, too, unless the mirrored ray leaves the picture: there
    nothing is known but the render, and no surface is the sky.

    Args:
        site: The frame.
        flat: Its relighting; what is outside the picture is relit as what is nearest to it inside.
        guessed: The map that the picture alone tells.
        light: (h, w, 3) linear light of the picture's cells, under an overcast sky.
        seen: The render.

    Returns:
        The map, and (h, w, 3) the light that `mirror.mirrored` takes with it.

    Raises:
        ArgumentError: If the render is not one of the site's small grid.
    """
    shape = site.shape
    if not seen.srgb.shape[:2] == seen.depth_m.shape == seen.opacity.shape == shape:
        raise ArgumentError(
            f"the mirrored render must be {shape[0]}x{shape[1]}, one pixel for a cell of the small "
            f"grid, got {seen.srgb.shape[:2]}; render it with small_camera(site)"
        )
    view = guessed.view
    rays, climb = _rays_on_lines(view, shape)
    columns = np.clip(np.round(rays[..., 0] * view.fx + view.cx), 0, shape[1] - 1).astype(np.intp)
    on_lines = np.arange(shape[0])[:, None], columns
    place = places(view, seen.depth_m)
    is_there = seen.depth_m > 0
    gone = (is_there & _seen_through(site, view, place))[on_lines]
    depth_m, opacity = seen.depth_m[on_lines], np.where(is_there, seen.opacity, 0.0)[on_lines]
    shown = _is_shown(site, guessed, rays, climb)
    into = _goes_into(view, shape, rays, climb)
    behind = into & (depth_m > _guessed_depth_m(guessed, climb) / BEHIND)
    sure = (opacity >= SURE_OPACITY) & (climb < 0) & ~gone & ~behind
    own = sure & ~shown
    kept = shown | gone | into | (opacity >= LEAST_OPACITY)
    kept &= ~own & (guessed.source >= 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        way = np.clip(1.0 + view.above_m / (climb * depth_m), 0.0, 1.0)
    # Where the render and the picture are silent is the sky, infinitely far.
    spread = np.where(own, way, np.where(kept, guessed.spread, 1.0)).astype(np.float32)
    cells = np.arange(shape[0] * shape[1], dtype=np.int32).reshape(shape)
    source = np.where(own | kept, cells, np.int32(-1))
    source.flags.writeable = spread.flags.writeable = False
    picture = light.reshape(-1, 3)[np.maximum(guessed.source, 0)]
    rendered = relit(view, flat, place, seen.srgb)[on_lines]
    mixed = np.where(own[..., None], rendered, picture).astype(np.float32)
    return MirrorMap(source, spread, view), mixed


def places(view: View, depth_m: Float32) -> Float32:
    """Camera coordinates (h, w, 3), metres, of what mirror images at depths (h, w) are images of.

    Source: reflection in a plane, x - 2 h n, of a point at height h over it.
    """
    height, width = depth_m.shape
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    rays = np.stack(
        [(columns - view.cx) / view.fx, (rows - view.cy) / view.fy, np.ones_like(rows)], axis=-1
    )
    normal = np.array([view.nx, view.ny, view.nz])
    image = np.where(np.isfinite(depth_m), depth_m, np.float32(0.0))[..., None] * rays
    over = view.above_m + image @ normal
    return np.asarray(image - np.float32(2.0) * over[..., None] * normal, np.float32)


def relit(view: View, flat: relight.Flattening, place: Float32, srgb: Float32) -> Float32:
    """Linear light (h, w, 3) of surfaces at places (h, w, 3) without the sun's.

    Each takes the relighting of its own place in the picture, or of the picture's border nearest to
    it.
    """
    column, row = _pixels(view, place)
    gains = cv2.remap(
        np.ascontiguousarray(flat.objects), column, row, cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    luma = srgb @ LUMINANCE.astype(np.float32)
    gain = np.clip(gains[..., 0] * luma + gains[..., 1], relight.LEAST_GAIN, relight.MOST_GAIN)
    return (linear_from_srgb(srgb.astype(np.float64)) * np.exp(gain)[..., None]).astype(np.float32)


def _pixels(view: View, place: Float32) -> tuple[Float32, Float32]:
    """Columns and rows (h, w) at which the camera sees places; behind it, somewhere far off."""
    z = np.maximum(place[..., 2], np.float32(1e-3))
    column, row = place[..., 0] / z * view.fx + view.cx, place[..., 1] / z * view.fy + view.cy
    return column.astype(np.float32), row.astype(np.float32)


def _seen_through(site: Site, view: View, place: Float32) -> NDArray[np.bool_]:
    """Where (h, w) the picture looks at a place and sees what is far behind it."""
    column, row = (np.round(k) for k in _pixels(view, place))
    inside = _inside(site.shape, place, column, row)
    cell = tuple(np.where(inside, k, 0).astype(np.intp) for k in (row, column))
    # The farthest of the neighbours would call every edge an opening; the nearest forgives a cell.
    nearest = cv2.erode(site.depth_m, np.ones((3, 3), np.uint8))
    return inside & (nearest[cell] > THROUGH * place[..., 2])


def _is_shown(site: Site, guessed: MirrorMap, rays: Float32, climb: Float32) -> NDArray[np.bool_]:
    """Where (h, w) the picture itself shows what is mirrored.

    What is guessed about a surface is where the mirror image of what is seen of it is not.
    """
    width = site.shape[1]
    view = guessed.view
    cell = np.maximum(guessed.source, 0)
    # On its line a mirrored cell has the line's ray in its own row.
    row, line = cell // width, np.arange(width)[None, :].repeat(site.shape[0], axis=0)
    z = site.depth_m.reshape(-1)[cell]
    z = np.where(np.isfinite(z), z, np.float32(FARTHEST_M))
    over = view.above_m + z * climb[row, line]
    depth = z - np.float32(2.0) * over * view.nz
    down = z * rays[row, line, 1] - np.float32(2.0) * over * view.ny
    with np.errstate(divide="ignore", invalid="ignore"):
        image_row = view.fy * down / depth + view.cy
    rows = np.arange(site.shape[0])[:, None]
    near: NDArray[np.bool_] = np.abs(image_row - rows) <= OWN_ROWS
    return near & (guessed.source >= 0) & (depth > 0)


def _rays_on_lines(view: View, shape: tuple[int, int]) -> tuple[Float32, Float32]:
    """Rays (h, w, 2) at depth 1 of the cells of all lines, and how they climb (h, w)."""
    rows, lines = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    down = (rows - view.cy) / (view.fy * view.ny)
    scale = np.maximum(np.float32(1.0) - down * view.nz, np.float32(0.0))
    x = (down * (view.fx * view.nx + view.cx * view.nz) + scale * lines - view.cx) / view.fx
    y = (rows - view.cy) / view.fy
    return np.stack([x, y], axis=-1), view.nx * x + view.ny * y + view.nz


def _guessed_depth_m(guessed: MirrorMap, climb: Float32) -> Float32:
    """(h, w) depth of the mirror image that a map's spread tells of; infinite for the sky."""
    short = np.where(climb < 0, climb, -1.0) * np.minimum(guessed.spread - 1.0, -1e-6)
    return np.where(guessed.source >= 0, guessed.view.above_m / short, np.inf).astype(np.float32)


def _goes_into(
    view: View, shape: tuple[int, int], rays: Float32, climb: Float32
) -> NDArray[np.bool_]:
    """Where (h, w) the mirrored ray's direction is one that the picture shows."""
    turned = np.concatenate([rays, np.ones_like(rays[..., :1])], axis=-1)
    normal = np.array([view.nx, view.ny, view.nz])
    turned = turned - np.float32(2.0) * climb[..., None] * normal
    column, row = (np.round(k) for k in _pixels(view, turned))
    return _inside(shape, turned, column, row)


def _inside(
    shape: tuple[int, int], place: Float32, column: Float32, row: Float32
) -> NDArray[np.bool_]:
    inside = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
    return inside & (place[..., 2] > 0)
