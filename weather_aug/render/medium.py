"""How much light the air between camera and surface lets through.

Compiled; all numbers are float32. Every pixel goes through the same operations whether the whole
picture or a window of it is rendered.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from weather_aug._compiled import compiled, inlined
from weather_aug._rows import survival
from weather_aug.clip.types import FAR_DEPTH_M
from weather_aug.render.froxels import share_row

LAYER_M = 1000.0
"""Height of the layer of weather: a ray to the sky ends at its top."""
LONGEST_M = 20_000.0
FLATTEST_SINE = 0.05
THICKEST = 60.0
"""Optical depth beyond which no light is left in any number format."""
LOWEST_HEIGHTS = -8.0
"""Scale heights from the camera below which fog thickens no more."""
SPRAY_HEIGHT_M = 0.5
"""Height over which spray thins by a factor e."""


class Optics(NamedTuple):
    """Camera of the whole picture, float32."""

    fx: np.float32
    fy: np.float32
    cx: np.float32
    cy: np.float32
    exposure_s: np.float32
    aperture_m: np.float32
    turn_x: np.float32
    turn_y: np.float32
    turn_z: np.float32
    up_x: np.float32
    up_y: np.float32
    up_z: np.float32
    area_px: np.float32
    limit_x: np.float32 = np.float32(np.inf)
    """Largest tangent of a ray at which a splat's shape is computed."""
    limit_y: np.float32 = np.float32(np.inf)


class Medium(NamedTuple):
    """What is between the camera and the surfaces, float32; extinctions in 1/m."""

    fog_per_m: np.float32
    inverse_height_per_m: np.float32
    haze_per_m: np.float32
    precipitation_per_m: np.float32
    resolved_step_m: np.float32
    spray_per_m: np.float32
    """At the road's surface."""
    camera_heights: np.float32
    """Height of the camera over the road, in scale heights of the spray."""


@compiled
def _mean_of_thin_layer(heights):
    """(1 - exp(-h)) / h for small h, where the difference would cancel."""
    h = heights * np.float32(0.25)
    h = np.float32(1.0) - h
    h = np.float32(1.0) - heights * np.float32(1.0 / 3.0) * h
    return np.float32(1.0) - heights * np.float32(0.5) * h


@inlined
def layer_share(heights):
    """Mean of exp(-h) along a ray that climbs by h scale heights, (1 - exp(-h)) / h."""
    one = np.float32(1.0)
    lowest, highest, thin = np.float32(LOWEST_HEIGHTS), np.float32(80.0), np.float32(0.05)
    h = heights if heights > lowest else lowest
    away = h if abs(h) >= thin else thin
    share = (one - survival(away if away < highest else highest)) / away
    return share if abs(h) >= thin else _mean_of_thin_layer(h)


@inlined
def spray_share(heights, camera_heights):
    """Mean density along a ray that climbs by `heights` scale heights, over that at the road.

    There is no spray below the road's plane: a road that falls away, or noise in the depth, must
    not run into a layer that grows without end.
    """
    one, highest, nearly = np.float32(1.0), np.float32(80.0), np.float32(0.05)
    lowest = -camera_heights
    h = heights if heights > lowest else lowest
    thin = abs(h) < nearly
    away = nearly if thin else h
    length = away if heights > lowest else heights
    share = (one - survival(away if away < highest else highest)) / length
    return survival(camera_heights) * (_mean_of_thin_layer(h) if thin else share)


@inlined
def carried_at(z, resolved_depth, medium):
    """Optical depth of drawn particles, on the axis, up to depth z."""
    return resolved_depth[_bin_of(z, resolved_depth, medium)]


@inlined
def _bin_of(z, resolved_depth, medium):
    """Nearest entry of the table at depth z."""
    last = np.float32(resolved_depth.shape[0] - 1)
    position = z * (np.float32(1.0) / medium.resolved_step_m) + np.float32(0.5)
    # Compared as a float first: the sky's bin does not fit an integer's range on every machine.
    position = position if position < last else last
    return np.uint32(np.int32(position))


@inlined
def near_optical_depth(z, ray_x, ray_y, optics, medium, carried):
    """Optical depth of the air from the camera to a finite depth z along the ray (x, y, 1).

    `carried` is what drawn particles carry of it on the axis. Patches in the fog are left out.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    norm = np.sqrt(one + ray_x * ray_x + ray_y * ray_y)
    rise = optics.up_x * ray_x + optics.up_y * ray_y + optics.up_z
    fog = layer_share(z * rise * medium.inverse_height_per_m)
    spray = spray_share(z * rise * np.float32(1.0 / SPRAY_HEIGHT_M), medium.camera_heights)
    rest = medium.precipitation_per_m * z - carried
    rest = rest if rest > zero else zero
    tau = medium.fog_per_m * fog + medium.spray_per_m * spray + medium.haze_per_m
    tau = (tau * z + rest) * norm
    most = np.float32(THICKEST)
    return tau if tau < most else most


@compiled
def reach_row(depth, ray_x, ray_y, optics, slant, reach):
    """Length of a ray per metre of depth, and the depth at which each pixel's air ends."""
    one = np.float32(1.0)
    far, nearly_flat = np.float32(FAR_DEPTH_M), np.float32(FLATTEST_SINE)
    layer_m, longest_m = np.float32(LAYER_M), np.float32(LONGEST_M)
    across = one + ray_y * ray_y
    rise_y = optics.up_y * ray_y + optics.up_z
    # Counted, because a largest value of floats would not be found in vectors.
    far_count = np.int32(0)
    for x in range(depth.shape[0]):
        slant[x] = np.sqrt(across + ray_x[x] * ray_x[x])
        reach[x] = depth[x]
        far_count += np.int32(1) if depth[x] >= far else np.int32(0)
    if far_count == 0:
        return
    for x in range(depth.shape[0]):
        sine = (optics.up_x * ray_x[x] + rise_y) / slant[x]
        sine = sine if sine > nearly_flat else nearly_flat
        beyond_m = layer_m / sine
        beyond_m = beyond_m if beyond_m < longest_m else longest_m
        reach[x] = depth[x] if depth[x] < far else beyond_m / slant[x]


@compiled
def transmittance_row(ray_x, ray_y, optics, medium, resolved_depth, space, out):
    """Optical depth of the air before each pixel of a row and what of the light survives it.

    Args:
        ray_x: (W,) tangents.
        ray_y: Tangent.
        optics: Camera.
        medium: Air.
        resolved_depth: Optical depth of resolved particles by depth.
        space: RowSpace with slant and share filled in.
        out: (W,) depth at which the air ends in, transmittance out.
    """
    slant, share, _, place, carried, tau = space
    zero = np.float32(0.0)
    width = out.shape[0]
    for x in range(width):
        tau[x] = medium.fog_per_m * out[x] * slant[x]
    rise_y = optics.up_y * ray_y + optics.up_z
    if medium.inverse_height_per_m > zero:
        for x in range(width):
            rise = optics.up_x * ray_x[x] + rise_y
            tau[x] *= layer_share(out[x] * rise * medium.inverse_height_per_m)
    if share.shape[0] > 0:
        for x in range(width):
            tau[x] *= share[x]
    for x in range(width):
        tau[x] += medium.haze_per_m * out[x] * slant[x]
    if medium.spray_per_m > zero:
        for x in range(width):
            rise = optics.up_x * ray_x[x] + rise_y
            climb = out[x] * rise * np.float32(1.0 / SPRAY_HEIGHT_M)
            spray = spray_share(climb, medium.camera_heights)
            tau[x] += medium.spray_per_m * spray * out[x] * slant[x]
    if medium.precipitation_per_m > zero:
        # In three loops, because a look-up among other things would keep all of them slow.
        for x in range(width):
            place[x] = _bin_of(out[x], resolved_depth, medium)
        for x in range(width):
            carried[x] = resolved_depth[place[x]]
        for x in range(width):
            rest = medium.precipitation_per_m * out[x] - carried[x]
            tau[x] += (rest if rest > zero else zero) * slant[x]
    most = np.float32(THICKEST)
    for x in range(width):
        tau[x] = tau[x] if tau[x] < most else most
        out[x] = survival(tau[x])


class RowSpace(NamedTuple):
    """Work space of `air_row` for rows of W pixels."""

    slant: Any
    """(W,) length of a ray per metre of depth."""
    share: Any
    """(W,) factor on the fog's optical depth, or (0,) where the fog is even."""
    nodes: Any
    """For `share_row`."""
    place: Any
    """(W,) uint32."""
    carried: Any
    """(W,) float32."""
    tau: Any
    """(W,) optical depth of the row that was done last."""


@compiled
def row_space(width, patches):
    """RowSpace for rows of `width` pixels."""
    slices, _, columns = patches.share.shape
    share = np.ones(width if slices > 0 else 0, np.float32)
    nodes = np.empty(slices * columns, np.float32)
    floats = np.empty((3, width), np.float32)
    place = np.empty(width, np.uint32)
    return RowSpace(floats[0], share, nodes, place, floats[1], floats[2])


@compiled
def rays_across(width, left, optics):
    """Tangents (width,) of the pixel columns from column `left` of the picture."""
    ray_x = np.empty(width, np.float32)
    for x in range(width):
        ray_x[x] = (np.float32(x + left) - optics.cx) / optics.fx
    return ray_x


@compiled
def air_row(depth, width, y, left, ray_x, ray_y, patches, optics, medium, resolved, space, out):
    """Optical depth (`space.tau`) and transmittance of the air before each pixel of a row.

    Args:
        depth: (W,) metres, `inf` for far.
        width: How many of them are pixels of the picture; the rest fills up the last vector.
        y: Row in the whole picture.
        left: First column in the whole picture.
        ray_x: (W,) tangents.
        ray_y: Tangent.
        patches: FogVolume.
        optics: Camera.
        medium: Air.
        resolved: Optical depth of resolved particles by depth.
        space: RowSpace.
        out: (W,) out: transmittance.
    """
    reach_row(depth, ray_x, ray_y, optics, space.slant, out)
    if space.share.shape[0] > 0:
        share_row(patches, y, left, out[:width], space.nodes, space.place, space.share[:width])
    transmittance_row(ray_x, ray_y, optics, medium, resolved, space, out)


@compiled
def optical_depth(depth, window, optics, medium, resolved_depth, patches):
    """Optical depth (H, W) float32 of the air in front of each pixel of a window."""
    top, left, height, width = window
    ray_x, space = rays_across(width, left, optics), row_space(width, patches)
    through = np.empty(width, np.float32)
    tau = np.empty((height, width), np.float32)
    for y in range(height):
        ray_y = (np.float32(y + top) - optics.cy) / optics.fy
        air_row(
            depth[y],
            width,
            y + top,
            left,
            ray_x,
            ray_y,
            patches,
            optics,
            medium,
            resolved_depth,
            space,
            through,
        )
        tau[y] = space.tau
    return tau
