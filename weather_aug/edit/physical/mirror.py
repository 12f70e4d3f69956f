"""What a wet road mirrors: which surface each place of it shows, and the light that comes of it.

Every surface of the picture that is no ground is mirrored in the road's plane and drawn into the
picture, the nearest first. A flip of the columns about the horizon would be right for the skyline
alone: a car's image must begin at its tyres.

Convention:
    A point, its mirror image and the picture's place below it lie in one plane with the camera's
    own perpendicular to the road. So all drawing happens on lines, the pictures of the road's
    perpendiculars: line j meets the row of the principal point at column j, and all lines meet in
    the nadir. Without roll and pitch they are the columns. Cells are those of the Site's small
    grid; "row" and "column" count cells, centres at integers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import finite
from weather_aug.edit.physical.mirror_lines import (
    FARTHEST_M,
    GROUND,
    OPEN,
    SURFACE,
    View,
    draw_lines,
)
from weather_aug.edit.physical.site import Site
from weather_aug.edit.physical.smear import smear, summed_down
from weather_aug.errors import ArgumentError, CalibrationError
from weather_aug.taxonomy import SKY

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

CALM_SLOPE = 0.01
"""Rms slope of a puddle's water: 0.005 calm, 0.03 to 0.06 under rain."""
FILM_SLOPE = 0.12
"""Rms slope of the film on chippings: 0.08 to 0.2."""
LEAST_UPRIGHT = 0.5
"""Cosine of the largest tilt of a camera whose picture's columns still run up and down."""
BANK_M, BANK_PER_M = 0.3, 0.02
"""Ground so high above the road, at no distance and more for each metre of it, is mirrored."""


@dataclass(frozen=True, eq=False)
class MirrorMap:
    """Which surface the road shows where, on h rows of w lines (see the module's Convention).

    It depends on the frame's geometry alone, not on weather. Arrays are read-only.
    """

    source: NDArray[np.int32]
    """(h, w) flat index of the cell whose light is mirrored; -1 is the sky, and above the
    horizon."""
    spread: Float32
    """(h, w) in [0, 1], the share of the light's way, from surface to camera, before the road:
    0 where a surface touches the road, 1 for the sky."""
    view: View


@dataclass(frozen=True, eq=False)
class Mirror:
    """What the road's plane mirrors at each cell of the small grid, (h, w, 3) linear light.

    As if the road were there: also where something stands in front of it. Above the horizon each
    column goes on with what it shows below.
    """

    sharp: Float32
    """In a calm puddle."""
    rough: Float32
    """In the film on a chipped road."""


def mirror_map(site: Site) -> MirrorMap:
    """Find what the road mirrors.

    Where the mirrored ray meets no surface that the picture shows, the map says sky if the picture
    shows sky in the ray's direction, and otherwise goes on with the next surface. Surfaces that the
    picture's upper border cuts go on above it; beyond its sides the outermost column does.

    Raises:
        CalibrationError: If the camera is tilted by more than 60 degrees against the road.
    """
    view = _view_of(site)
    depth = np.where(np.isfinite(site.depth_m), site.depth_m, np.float32(FARTHEST_M))
    is_bank = np.isfinite(site.height_m) & (site.height_m > BANK_M + BANK_PER_M * depth)
    kind = np.full(site.shape, SURFACE)
    kind[site.is_ground & ~is_bank] = GROUND
    kind[site.small_classes == SKY] = OPEN
    source = np.full(site.shape, -1, np.int32)
    spread = np.ones(site.shape, np.float32)
    draw_lines(depth, kind, view, source, spread)
    source.flags.writeable = spread.flags.writeable = False
    return MirrorMap(source, spread, view)


def mirrored(
    mirror: MirrorMap,
    light: Float32,
    sky_light: Float64,
    *,
    sharp_slope: float = CALM_SLOPE,
    rough_slope: float = FILM_SLOPE,
) -> Mirror:
    """The light that the road mirrors.

    A surface of slopes with rms m blurs the mirror image by 2 m f D_r / (D_s + D_r) up and down, f
    the focal length, D_s the way from camera to road and D_r on to the surface, and by the sine of
    the grazing angle times that across: wet roads draw long smears, short where things stand.

    Args:
        mirror: Of the frame.
        light: (h, w, 3) linear light of the small grid's cells, under the weather's sky.
        sky_light: (2, 3) linear light of the sky at the horizon and overhead; between them it
            follows the sine of the elevation.
        sharp_slope: In [0, 0.5], rms slope of the water in puddles.
        rough_slope: In [0, 0.5], rms slope of the film.

    Raises:
        ArgumentError: If a shape or a slope is wrong.
    """
    if light.shape != (*mirror.source.shape, 3):
        raise ArgumentError(
            f"light must have shape {(*mirror.source.shape, 3)}, got {light.shape}; give the light "
            "of the small grid of the site that the map was made of"
        )
    if np.shape(sky_light) != (2, 3):
        raise ArgumentError(
            f"sky_light must have shape (2, 3), horizon and zenith, got {np.shape(sky_light)}"
        )
    slopes = (
        finite("sharp_slope", sharp_slope, 0.0, 0.5),
        finite("rough_slope", rough_slope, 0.0, 0.5),
    )
    height, width = mirror.source.shape
    twice, ends = np.empty((height + 1, width, 4)), np.empty((width, 4))
    summed_down(
        mirror.source,
        np.ascontiguousarray(light, np.float32).reshape(-1, 3),
        np.ascontiguousarray(sky_light, np.float32),
        mirror.view,
        twice,
        ends,
    )
    images = []
    for slope in slopes:
        out = np.empty((height, width, 3), np.float32)
        smear(ends, twice, mirror.spread, mirror.view, np.float32(slope), out)
        images.append(out)
    return Mirror(*images)


def _view_of(site: Site) -> View:
    camera = site.frame.camera
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    up = np.array([-site.plane[1], -site.plane[2], 1.0])
    length = float(np.linalg.norm(up))
    normal = camera.world_from_camera[:3, :3].T @ site.axes_world.T @ up / length
    if normal[1] > -LEAST_UPRIGHT:
        raise CalibrationError(
            f"frame {site.frame.key}: the camera is tilted by more than 60 degrees against the "
            "road; turn its pictures upright"
        )
    above = float(up @ site.origin - site.plane[0]) / length
    step = site.step
    cells = (fx / step, fy / step, (cx + 0.5) / step - 0.5, (cy + 0.5) / step - 0.5)
    return View(*(np.float32(value) for value in (*cells, *normal, above)))
