"""Take the recorded sun away: the sky's share of each pixel, cast shadows, and the light itself.

Convention:
    Pure functions of a `Site`. Maps lie on its small grid and are read between its cells
    bilinearly; lines (slope, offset) are evaluated with a feature of the full-size pixel, so that
    their detail is the picture's: `luma`, Rec. 709's sum of the sRGB values in [0, 1], for light,
    and `SKY_FEATURE` of the same values for the sky. Gains are natural logarithms of linear light.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug.colour import LUMINANCE
from weather_aug.edit.physical.guided import box_mean, box_sum, guided_coefficients
from weather_aug.edit.physical.site import Site, shrunk
from weather_aug.taxonomy import GROUND, ROAD, SIDEWALK, SKY, TERRAIN, TRAIN_ID, VEGETATION

Bool = NDArray[np.bool_]
Float32 = NDArray[np.float32]

DARK = 0.003
"""Linear light added before a logarithm: a level of noise weighs little there."""

SKY_FEATURE = (-0.5, 0.0, 1.5)
"""Weights of sRGB red, green and blue: a blue sky and a white cloud are equally sky (about 1 to
1.2), a white wall before a blue sky is not (0.8), leaves are far off (0.2)."""
SKY_RADIUS_CELLS, LEAVES_RADIUS_CELLS = 4, 10
"""How far into trees sky may show where the label calls it tree."""
LOCAL_SKY_CELLS = 24
LEAST_BLUE = 0.16
"""Of sRGB blue over red, so that a white sky makes nothing blue."""
BRIGHTEST_BEFORE = 0.85
"""What stands before the sky has at most this share of its feature."""
USUAL_BEFORE, CLOSEST_BEFORE = 0.5, 0.72
MATTE_MARGINS = (0.12, 0.08)
"""Shares of the way between the surface's feature and the sky's that are wholly one or the other:
noise and clouds."""

LIT_QUANTILE, LIT_SPREAD, LIT_DROP = 0.75, 0.7, 0.35
DISTANCE_BINS_M = np.geomspace(4.0, 60.0, 8)
SHADOW_DROP = 0.45
"""Log luminance by which a cast shadow is darker than the lit ground at least."""
SHADOW_SIDE_M, SHADOW_LEAST_CELLS = 1.1, 8
"""A darker place is shadow from this size on, and a smaller one where it is bluer, too: manholes
are not."""
BLUER = 0.1
SHADOW_REACH_CELLS = 5
LOCAL_LIT_CELLS = 16
EDGE_RADIUS_CELLS, EDGE_EPSILON = 2, 2e-4
MARKING_WIDTH_M, MARKING_CONTRAST = 0.3, 0.3
LEAST_GAIN, MOST_GAIN = math.log(0.75), math.log(2.5)
"""Of all but the ground."""
MOST_GROUND_GAIN = math.log(9.0)
HOLLOW_DROPS, GUESSED_RANGE_M = (2.8, 4.2), (32.0, 60.0)
WALL_SHARE, LEAF_SHARE, TERRAIN_SHARE = 0.45, 0.3, 0.75
CONTACT_M, CONTACT_DARKENING, FARTHEST_M = 0.4, 0.45, 8.0
STANDING_M, STANDING_RANGE_M = 0.15, 20.0
OBJECT_RADIUS_CELLS, OBJECT_EPSILON = 6, 0.01
LEAST_CELLS, PRIOR_CELLS, BIN_PRIOR_CELLS = 20, 60, 100
TINT_LIMIT = 0.35
ROAD_ALBEDO, GROUND_ALBEDO, ALBEDO_SPREAD = 0.12, 0.18, 0.6

_WALLS = tuple(TRAIN_ID[name] for name in ("building", "wall", "fence"))
_VEHICLES = tuple(
    TRAIN_ID[name] for name in ("car", "truck", "bus", "train", "motorcycle", "bicycle")
)


class Flattening(NamedTuple):
    """How much brighter each place is without cast shadows; a kernel applies overcast times it."""

    ground: Float32
    """(h, w, 4) for road, sidewalk and terrain: slope and offset of the log gain by luma, least
    and most log gain."""
    objects: Float32
    """(h, w, 2) for all else: slope and offset of the log gain by luma, to be kept within
    `LEAST_GAIN` and `MOST_GAIN`; 0 in the sky."""
    tint: Float32
    """(3,) what red, green and blue gain beside it for each unit of the ground's log gain."""


def sky_matte(site: Site) -> tuple[Float32, Float32]:
    """Sky's share of a pixel: slope * feature + offset, clipped to [0, 1].

    The feature is `SKY_FEATURE` of the pixel's sRGB values. Each place knows the feature of the sky
    near it and of what stands before that, and their mixture is a line between both; leaves and
    wires need no label.

    Returns:
        Slope and offset, (h, w) float32; both 0 away from the sky.

    Source:
        The compositing equation of two known colours, as in Smith and Blinn, "Blue Screen
        Matting", SIGGRAPH 1996, with one feature.
    """
    is_sky = _share(site)
    if is_sky.max() < 0.5:
        return np.zeros(site.shape, np.float32), np.zeros(site.shape, np.float32)
    srgb = site.srgb
    feature = _mixed(srgb, SKY_FEATURE)
    # The local sky is the labelled sky without what is dark in it.
    whole = (is_sky > 0.99).astype(np.float32)
    middle = box_mean(feature, whole, LOCAL_SKY_CELLS, empty=0.0)
    everywhere = np.float32(np.median(feature[whole > 0])) if whole.any() else np.float32(1.0)
    middle = np.where(middle > 0, middle, everywhere)
    bright = whole * (feature > 0.8 * middle)
    sky = box_mean(feature, bright, LOCAL_SKY_CELLS, empty=float(everywhere))
    # The square keeps cells that are part sky from passing for what stands before it.
    short = np.maximum(np.float32(BRIGHTEST_BEFORE) * sky - feature, 0.0) ** 2
    before = box_mean(feature, short, SKY_RADIUS_CELLS, empty=-9.0)
    before = np.where(before < -8, np.float32(USUAL_BEFORE) * sky, before)
    # Two colours too close together would make the line steep and its noise loud.
    before = np.minimum(before, np.float32(CLOSEST_BEFORE) * sky)
    low = before + np.float32(MATTE_MARGINS[0]) * (sky - before)
    span = np.float32(1 - sum(MATTE_MARGINS)) * (sky - before)
    reach = _sky_reach(site, is_sky, srgb)
    slope = reach / np.maximum(span, 1e-3)
    return slope.astype(np.float32), (-slope * low).astype(np.float32)


def _sky_reach(site: Site, is_sky: Float32, srgb: Float32) -> Float32:
    """(h, w) 0 or 1: where sky may show; in and beside its label, and some way into trees.

    Where nobody labelled the picture, trees are often taken for houses; what is as blue as the sky
    counts as a tree there.
    """
    near = cv2.dilate((is_sky > 0.3).astype(np.uint8), np.ones((3, 3), np.uint8))
    holed = site.small_classes == VEGETATION
    if site.frame.label is None:
        blueness = srgb[..., 2] - srgb[..., 0]
        blue = max(float(np.median(blueness[is_sky > 0.5])), LEAST_BLUE)
        bluish = (blueness > 0.5 * blue).astype(np.uint8)
        # Closed over what is thin, a lamp or a wire.
        holed |= cv2.erode(cv2.dilate(bluish, np.ones((7, 7))), np.ones((5, 5))) > 0
    size = 2 * LEAVES_RADIUS_CELLS + 1
    far = holed & (cv2.dilate(near, np.ones((size, size), np.uint8)) > 0)
    return np.maximum(near, far).astype(np.float32)


def flattening(site: Site) -> Flattening:
    """How much light each place lacks against an even sky.

    On the ground all that cast shadows take is given back, up to a gain of 9, edges and all, but
    for what is darker than any shadow and what lies close to a vehicle. Walls and leaves come
    nearer to the mean of their surroundings. The sky, vehicles, lamps, signs and people stay as
    they are: how dark they are says more of their paint than of the sun.
    """
    luma = _mixed(site.srgb, LUMINANCE)
    level = np.log(_mixed(site.light, LUMINANCE) + np.float32(DARK))
    ground = site.is_ground & np.isfinite(site.depth_m)
    objects = _object_gain(site, luma, level)
    if ground.sum() < LEAST_CELLS:
        return Flattening(np.zeros((*site.shape, 4), np.float32), objects, np.zeros(3, np.float32))
    base = _without_markings(site, level, ground)
    drop, shadow = _shadow(site, base, _lit_level(site, base, ground), ground)
    return Flattening(
        _ground_gain(site, luma, level - base, drop * shadow, ground),
        objects,
        _tint(site, drop * shadow, ground),
    )


def illumination(site: Site, flat: Flattening) -> Float32:
    """Light that falls on each place (h, w) once shadows are gone: albedo = light / illumination.

    Linear light that a white surface would be recorded with, before any tone; told by the road,
    or by other ground where there is none, around each place, and by all of it farther away.

    Source:
        An aged asphalt's albedo of 0.12; other ground is taken for 0.18.
    """
    luma = _mixed(site.srgb, LUMINANCE)
    lines = flat.ground
    gain = np.clip(lines[..., 0] * luma + lines[..., 1], lines[..., 2], lines[..., 3])
    flattened = np.log(_mixed(site.light, LUMINANCE) + np.float32(DARK)) + gain
    told, albedo = site.small_classes == ROAD, ROAD_ALBEDO
    if told.sum() < LEAST_CELLS:
        told, albedo = site.is_ground, GROUND_ALBEDO
    if told.sum() < LEAST_CELLS:
        told, albedo = site.small_classes != SKY, GROUND_ALBEDO
    if not told.any():
        return np.full(site.shape, np.exp(np.median(flattened)) / albedo, np.float32)
    whole = np.float32(np.median(flattened[told]))
    near = (told & (np.abs(flattened - whole) < ALBEDO_SPREAD)).astype(np.float32)
    off = box_sum(near * (flattened - whole), LOCAL_LIT_CELLS)
    off /= box_sum(near, LOCAL_LIT_CELLS) + np.float32(PRIOR_CELLS)
    return np.exp(whole + off) / np.float32(albedo)


def _ground_gain(
    site: Site, luma: Float32, marking: Float32, drop: Float32, ground: Bool
) -> Float32:
    """(h, w, 4) of `Flattening.ground`: what shadows took, given back."""
    lines = np.zeros((*site.shape, 4), np.float32)
    gain = np.clip(drop, 0.0, MOST_GROUND_GAIN)
    # What is darker than a shadow under the open sky can be hardly sees the sky: it stays dark.
    hollow = np.clip((drop - HOLLOW_DROPS[0]) / (HOLLOW_DROPS[1] - HOLLOW_DROPS[0]), 0.0, 1.0)
    gain *= 1 - hollow
    if site.frame.label is None:
        # Far off, what is low passes for ground.
        near, far = GUESSED_RANGE_M
        gain *= np.clip((far - site.depth_m) / (far - near), 0.0, 1.0)
    gain = np.where(site.small_classes == TERRAIN, np.float32(TERRAIN_SHARE) * gain, gain)
    open_air, contact = _contact(site, ground)
    gain = (gain * open_air + contact).astype(np.float32)
    plain = (ground & (marking < MARKING_CONTRAST)).astype(np.float32)
    slope, offset = guided_coefficients(luma, gain, plain, EDGE_RADIUS_CELLS, EDGE_EPSILON)
    window = np.ones((2 * EDGE_RADIUS_CELLS + 1,) * 2, np.uint8)
    least = cv2.erode(np.where(plain > 0, gain, 9.0).astype(np.float32), window)
    most = cv2.dilate(np.where(plain > 0, gain, -9.0).astype(np.float32), window)
    told = most >= least
    # On a marking its own luma tells nothing of the light, the asphalt around it does.
    marked = (ground & (plain == 0)).astype(np.uint8)
    share = 1 - cv2.dilate(marked, np.ones((5, 5), np.uint8)).astype(np.float32)
    lines[..., 0], lines[..., 1] = slope * share, offset * share + gain * (1 - share)
    lines[..., 2], lines[..., 3] = np.where(told, least, gain), np.where(told, most, gain)
    return lines


def _without_markings(site: Site, level: Float32, ground: Bool) -> Float32:
    """The ground's log luminance (h, w) without bright lines narrower than 0.3 m."""
    focal_cells = max(site.frame.camera.focal_px) / site.step
    above = np.where(ground, level, np.float32(9.0))
    base = level.copy()
    count = ground.sum(axis=1)
    known = count > 0
    nearness = np.where(ground, 1 / site.depth_m, 0.0).sum(axis=1) / np.maximum(count, 1)
    sides = MARKING_WIDTH_M * focal_cells * nearness
    sides = 2 * np.minimum(np.ceil(sides / 2).astype(int), 10) + 1
    for side in np.unique(sides[known]):
        strip = np.flatnonzero((sides == side) & known)
        window = np.ones((1, int(side)), np.uint8)
        eroded = cv2.erode(above[strip], window)
        eroded[eroded > 8] = -9.0
        opened = cv2.dilate(eroded, window)
        base[strip] = np.where(opened > -8, np.minimum(opened, level[strip]), level[strip])
    return base


def _lit_level(site: Site, base: Float32, ground: Bool) -> Float32:
    """Log luminance (h, w) of the lit ground by class and distance, from robust medians."""
    lit = np.zeros(site.shape, np.float32)
    edges = np.log(DISTANCE_BINS_M).astype(np.float32)
    centres = 0.5 * (edges[1:] + edges[:-1])
    # Every other row and column tell as much, if they see any of it.
    part = (slice(None, None, 2),) * 2 if ground[::2, ::2].any() else (slice(None),) * 2
    some_ground, some_classes = ground[part], site.small_classes[part]
    some_base, some_depth = base[part], site.depth_m[part]
    whole = _lit_median(some_base[some_ground])
    for name in GROUND:
        mine = some_ground & (some_classes == name)
        values = some_base[mine]
        levels = np.full(len(centres), whole)
        if len(values):
            share = len(values) / (len(values) + BIN_PRIOR_CELLS)
            levels += share * (_lit_median(values) - whole)
            places = np.searchsorted(edges[1:-1], np.log(some_depth[mine]))
            near = values > levels[0] - LIT_SPREAD
            for k in range(len(centres)):
                told = values[near & (places == k)]
                if len(told):
                    off = np.clip(np.median(told) - levels[k], -0.4, 0.4)
                    levels[k] += off * len(told) / (len(told) + BIN_PRIOR_CELLS)
        here = ground & (site.small_classes == name)
        lit[here] = np.interp(np.log(site.depth_m[here]), centres, levels)
    return lit


def _lit_median(values: Float32) -> float:
    high = float(np.quantile(values, LIT_QUANTILE))
    return float(np.median(values[values > high - LIT_SPREAD]))


def _shadow(site: Site, base: Float32, lit: Float32, ground: Bool) -> tuple[Float32, Float32]:
    """By how much (log) the ground is darker than when lit, and where a cast shadow is why."""
    drop = np.where(ground, lit - base, 0.0).astype(np.float32)
    is_lit = (ground & (np.abs(drop) < LIT_DROP)).astype(np.float32)
    near = box_sum(is_lit, LOCAL_LIT_CELLS)
    # The lit ground beside a shadow says more of what lies in it than the whole road does.
    lighter = box_sum(is_lit * -drop, LOCAL_LIT_CELLS) / (near + np.float32(PRIOR_CELLS))
    drop = np.where(ground, drop + lighter, 0.0).astype(np.float32)
    dark = (drop > SHADOW_DROP).astype(np.uint8)
    blueness = (site.light[..., 2] + np.float32(DARK)) / (site.light[..., 0] + np.float32(DARK))
    usual = (
        float(np.median(blueness[::3, ::3][is_lit[::3, ::3] > 0]))
        if is_lit[::3, ::3].any()
        else 1.0
    )
    wide = _wide(site, dark)
    small = dark & (blueness > usual * (1 + BLUER)).view(np.uint8)
    core = cv2.dilate(wide | small, np.ones((2 * SHADOW_REACH_CELLS + 1,) * 2, np.uint8))
    return drop, cv2.blur(core.astype(np.float32), (5, 5))


def _wide(site: Site, dark: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(h, w) 0 or 1: the connected dark places that are a metre long or wide on the ground."""
    _, names, boxes, centres = cv2.connectedComponentsWithStats(dark, connectivity=4)
    columns, rows = centres.astype(int).clip(0).T
    cell_m = site.depth_m[rows, columns] * site.step / max(site.frame.camera.focal_px)
    slant = site.depth_m[rows, columns] / site.camera_height_m
    size_m = cell_m * np.maximum(
        boxes[:, cv2.CC_STAT_WIDTH], slant * (boxes[:, cv2.CC_STAT_HEIGHT] - 1)
    )
    kept = (size_m > SHADOW_SIDE_M) & (boxes[:, cv2.CC_STAT_AREA] >= SHADOW_LEAST_CELLS)
    # Name 0 is all that is not dark.
    kept[0] = False
    return kept.astype(np.uint8)[names]


def _tint(site: Site, gain: Float32, ground: Bool) -> Float32:
    """(3,) log gains of the colours beside each unit of log gain: shadows lose their blue."""
    classes, gain, light = site.small_classes[::3, ::3], gain[::3, ::3], site.light[::3, ::3]
    paved = ground[::3, ::3] & ((classes == ROAD) | (classes == SIDEWALK))
    shaded, is_lit = paved & (gain > SHADOW_DROP), paved & (np.abs(gain) < 0.2)
    if is_lit.sum() < LEAST_CELLS or shaded.sum() < LEAST_CELLS:
        return np.zeros(3, np.float32)
    usual = np.median(_chroma(light[is_lit]), axis=0)
    tint = (usual - _chroma(light[shaded])) / gain[shaded][:, None]
    # A shadow that is warmer than the light is none of the sun's.
    bounds = np.array([[0.0, 0.0, -TINT_LIMIT], [TINT_LIMIT, 0.0, 0.0]])
    return np.clip(np.median(tint, axis=0), *bounds).astype(np.float32)


def _chroma(light: Float32) -> Float32:
    """(N, 3) logarithms of red, green and blue over green."""
    logs = np.log(light + np.float32(DARK))
    return logs - logs[:, 1:2]


def _contact(site: Site, ground: Bool) -> tuple[Float32, Float32]:
    """Where shadows may go, in [0, 1], and the log gain of what an even sky leaves dark."""
    standing = ~site.is_ground & (site.small_classes != SKY)
    if site.frame.label is not None:
        standing = np.isin(site.small_classes, _VEHICLES)
    else:
        standing &= site.small_classes != VEGETATION
        # The classes' own limit is as high as a bumper.
        standing |= (site.height_m > STANDING_M) & (site.depth_m < STANDING_RANGE_M)
    shade = np.zeros(site.shape, np.float32)
    # Above the first ground there is none to shade.
    top = int(np.argmax(ground.any(axis=1)))
    standing, depth = standing[top:], np.where(ground, site.depth_m, np.float32(1.0))[top:]
    if standing.any():
        _, nearest = cv2.distanceTransformWithLabels(
            (~standing).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
        )
        rows, columns = (places.astype(np.float32)[nearest - 1] for places in np.nonzero(standing))
        across = np.arange(site.shape[1], dtype=np.float32) - columns
        # A cell down the picture is a longer way on the ground than one across it.
        down = np.arange(len(depth), dtype=np.float32)[:, None] - rows
        down *= depth / np.float32(site.camera_height_m)
        cell_m = depth * np.float32(site.step / max(site.frame.camera.focal_px))
        # Not so far that shade becomes a denormal number, which is slow.
        distance_m = np.minimum(np.sqrt(across * across + down * down) * cell_m, FARTHEST_M)
        shade[top:] = np.where(ground[top:], np.exp(distance_m / np.float32(-CONTACT_M)), 0.0)
    return 1 - shade, np.log1p(-np.float32(CONTACT_DARKENING) * shade)


def _object_gain(site: Site, luma: Float32, level: Float32) -> Float32:
    """(h, w, 2) of `Flattening.objects`."""
    table = np.zeros(256, np.float32)
    table[list(_WALLS)], table[VEGETATION] = WALL_SHARE, LEAF_SHARE
    share = table[site.small_classes]
    weight = (share > 0).astype(np.float32)
    slope, offset = guided_coefficients(luma, level, weight, OBJECT_RADIUS_CELLS, OBJECT_EPSILON)
    mean = box_mean(level, weight, max(2, site.shape[0] // 5), empty=0.0)
    # Equal shares mark the group.
    for of_group in (LEAF_SHARE, WALL_SHARE):
        here = share == np.float32(of_group)
        some = level[::3, ::3][here[::3, ::3]]
        if len(some):
            mean[here] = 0.5 * (mean[here] + np.median(some))
    return np.stack([-share * slope, share * (mean - offset)], axis=-1)


def _mixed(colours: Float32, weights: Any) -> Float32:
    """(h, w) weighted sums of the channels of (h, w, 3)."""
    return cv2.transform(colours, np.asarray(weights, np.float32)[None])


def _share(site: Site) -> Float32:
    """(h, w) share of the sky's label in each cell."""
    labelled = np.where(site.classes == SKY, np.uint8(255), np.uint8(0))
    return shrunk(labelled, site.step).astype(np.float32) * np.float32(1 / 255)
