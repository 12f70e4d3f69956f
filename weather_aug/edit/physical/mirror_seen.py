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
from weather_aug.edit.physical.mirror_lines import View
from weather_aug.edit.physical.site import Site
from weather_aug.errors import ArgumentError
from weather_aug.taxonomy import SKY

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

LEAST_OPACITY = 0.5
"""Of a render's cell that shows a surface."""
"""The picture's own light is taken where both see a surface in one depth up to this share."""


class Seen(NamedTuple):
    """The street's mirror image in the road's plane, on the small grid (h, w) of a site.

    In the picture's own places, as if the road were glass with the mirrored street below it: without
    what is below the road, the ground itself, and the sky.
    """

    srgb: Float32
    """(h, w, 3) in [0, 1], of the surfaces alone."""
    depth_m: Float32
    """(h, w) z-depth of the mirror image; of no account where nothing is."""
    opacity: Float32
    """(h, w) in [0, 1]."""


def small_camera(site: Site) -> Camera:
    """The camera of a site's small grid: one pixel is one cell, also where it leaves the picture."""
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
    """The mirror's map and the light it points to, from a render where that shows a surface.

    Where the render shows none, the road mirrors the sky, unless the picture shows a surface in the
    very direction of the mirrored ray: what was never reconstructed stays as it was guessed.

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
    rows = np.arange(shape[0])[:, None]
    shown = (seen.opacity[rows, columns] >= LEAST_OPACITY) & (climb < 0)
    own = relit(site, flat, view, seen)[rows, columns]
    behind = (guessed.source >= 0) & _surface_ahead(site, view, rays, climb)
    picture = light.reshape(-1, 3)[np.maximum(guessed.source, 0)]
    cells = np.arange(shape[0] * shape[1], dtype=np.int32).reshape(shape)
    source = np.where(shown | behind, cells, np.int32(-1))
    with np.errstate(divide="ignore", invalid="ignore"):
        way = 1.0 + view.above_m / (climb * seen.depth_m[rows, columns])
    # Where the render and the picture are silent is the sky, infinitely far.
    spread = np.where(shown, np.clip(way, 0.0, 1.0), np.where(behind, guessed.spread, 1.0))
    spread = spread.astype(np.float32)
    source.flags.writeable = spread.flags.writeable = False
    mixed = np.where(shown[..., None], own, picture).astype(np.float32)
    return MirrorMap(source, spread, view), mixed


def relit(site: Site, flat: relight.Flattening, view: View, seen: Seen) -> Float32:
    """Linear light (h, w, 3) of a render's surfaces without the sun's, on the small grid.

    Each surface takes the relighting of its own place in the picture, or of the picture's border
    nearest to it.
    """
    height, width = site.shape
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    x, y = (columns - view.cx) / view.fx, (rows - view.cy) / view.fy
    normal = np.array([view.nx, view.ny, view.nz])
    image = np.where(np.isfinite(seen.depth_m), seen.depth_m, 0.0)[..., None] * np.stack(
        [x, y, np.ones_like(x)], axis=-1
    )
    over = view.above_m + image @ normal
    place = image - 2.0 * over[..., None] * normal
    z = np.maximum(place[..., 2], 1e-3)
    gains = cv2.remap(
        np.ascontiguousarray(flat.objects),
        (place[..., 0] / z * view.fx + view.cx).astype(np.float32),
        (place[..., 1] / z * view.fy + view.cy).astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    luma = seen.srgb @ LUMINANCE.astype(np.float32)
    gain = np.clip(gains[..., 0] * luma + gains[..., 1], relight.LEAST_GAIN, relight.MOST_GAIN)
    return (linear_from_srgb(seen.srgb) * np.exp(gain)[..., None]).astype(np.float32)


def _rays_on_lines(view: View, shape: tuple[int, int]) -> tuple[Float32, Float32]:
    """Rays (h, w, 2) at depth 1 of the cells of all lines, and how they climb (h, w)."""
    rows, lines = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    down = (rows - view.cy) / (view.fy * view.ny)
    scale = np.maximum(np.float32(1.0) - down * view.nz, np.float32(0.0))
    x = (down * (view.fx * view.nx + view.cx * view.nz) + scale * lines - view.cx) / view.fx
    y = (rows - view.cy) / view.fy
    return np.stack([x, y], axis=-1), view.nx * x + view.ny * y + view.nz


def _surface_ahead(site: Site, view: View, rays: Float32, climb: Float32) -> NDArray[np.bool_]:
    """Where (h, w) the mirrored ray's direction is in the picture, and no sky there."""
    height, width = site.shape
    z = 1.0 - 2.0 * climb * view.nz
    x = (rays[..., 0] - 2.0 * climb * view.nx) / z
    y = (rays[..., 1] - 2.0 * climb * view.ny) / z
    column, row = np.round(x * view.fx + view.cx), np.round(y * view.fy + view.cy)
    inside = (z > 0) & (row >= 0) & (row < height) & (column >= 0) & (column < width)
    row, column = (np.where(inside, k, 0).astype(np.intp) for k in (row, column))
    return inside & (site.small_classes[row, column] != SKY)
