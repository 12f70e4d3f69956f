"""What snow on surfaces does to labels: buried borders, and signs under snow.

Snow has no class: what it lies on keeps its own. Only where it hides where one ground ends and the
next begins, and the faces of signs and lights, something is lost. How far snow lies is the mean of
each class (the weather's cover times the material's share), never the noise of single pixels, so
that no plane of the edited picture is needed; wheel tracks, which run inside lanes, do not count.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled
from weather_aug.clip.types import Camera, Frame, Window
from weather_aug.edit.physical.ground_rows import ramp
from weather_aug.edit.physical.materials import MATERIALS
from weather_aug.edit.surface import depth_of, surface_of
from weather_aug.render.options import RenderOptions
from weather_aug.taxonomy import GROUND, IGNORE, ROAD, TRAIN_ID
from weather_aug.weather import Weather

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]

BURIED_COVER = 0.8
"""Snow that covers more of the ground on both sides hides a border,"""
BURIED_DEPTH_M = 0.03
"""if it is deeper than a kerb's rounding."""
BAND_M, BAND_PX = 0.25, 4
"""How far from its border a ground's class is uncertain: the larger of the two."""
WIDEST_BAND_PX = 64
"""Of a band, nearer to the camera than a quarter of a metre is so wide."""
GAP_PX = 4
"""Unlabelled pixels between two grounds across which they still have a border."""
COVERED_FACE = 0.7
"""A sign's face under so much snow cannot be read."""
FACES = (TRAIN_ID["traffic light"], TRAIN_ID["traffic sign"])
FACE_ROWS = 96
"""How far below its upper edge a face may be covered, pixels."""
CAP_SHARE_OF_DEPTH = 0.4
"""Of the ground's snow depth that lies on upper edges besides a material's own cap."""


class SnowLimits(NamedTuple):
    """What a weather's snow hides."""

    buried: UInt8
    """(256,), 1 for the train ids of grounds whose borders are buried."""
    cap_m: Float32
    """(256,) how far down from their upper edges the snow on faces reaches; 0 for what is none."""


def snow_limits(weather: Weather, options: RenderOptions) -> SnowLimits | None:
    """What snow hides in a weather; None if nothing."""
    if not options.has("snow_cover"):
        return None
    buried = np.zeros(256, np.uint8)
    if weather.snow_depth_m > BURIED_DEPTH_M:
        for train_id in GROUND:
            buried[train_id] = mean_cover(train_id, weather) > BURIED_COVER
    if buried.sum() < 2:
        buried[:] = 0
    cap_m = np.zeros(256, np.float32)
    if weather.snow_cover > 0.0:
        for name, material in MATERIALS.items():
            if TRAIN_ID[name] in FACES and material.cover > 0.0:
                own = material.cap_m * weather.snow_cover
                cap_m[TRAIN_ID[name]] = own + CAP_SHARE_OF_DEPTH * weather.snow_depth_m
    return SnowLimits(buried, cap_m) if buried.any() or cap_m.any() else None


def mean_cover(train_id: int, weather: Weather) -> float:
    """Share of a ground's surface that snow covers, in [0, 1]."""
    if train_id == ROAD:
        return weather.road_snow_cover
    name = next(name for name, other in TRAIN_ID.items() if other == train_id)
    return weather.snow_cover * MATERIALS[name].cover


def buried_borders(frame: Frame, window: Window, limits: SnowLimits) -> UInt8:
    """Where the border between two grounds is lost under snow.

    Args:
        frame: Recorded frame, labelled.
        window: (top, left, height, width) in its picture.
        limits: Of the weather.

    Returns:
        (H, W) uint8, 1 on both sides of a border of buried grounds within 4 pixels of it, or
        within 0.25 m where that is more, but within 64 pixels. The same in any window.
    """
    outer, label = _around(frame, window, WIDEST_BAND_PX + GAP_PX + 1)
    out = np.zeros(label.shape, np.uint8)
    if limits.buried[_present(label)].sum() >= 2:
        depth = depth_of(surface_of(frame), outer)
        _band(label, depth, _pinhole(frame.camera, outer), limits.buried, out)
    return _cut(out, outer, window)


def covered_faces(frame: Frame, window: Window, limits: SnowLimits) -> UInt8:
    """Where snow from their upper edges hides the faces of signs and lights.

    The mean snow cap of the editor: as high as the material's cap times the cover, and 0.4 times
    the snow's depth, where nothing nearer stands above.

    Args:
        frame: Recorded frame, labelled.
        window: (top, left, height, width) in its picture.
        limits: Of the weather.

    Returns:
        (H, W) uint8, 1 where more than 0.7 of a face is covered. The same in any window.
    """
    outer, label = _around(frame, window, FACE_ROWS + 1)
    out = np.zeros(label.shape, np.uint8)
    if (limits.cap_m[_present(label)] > 0).any():
        depth = depth_of(surface_of(frame), outer)
        per_fy = np.float32(1.0 / frame.camera.focal_px[1])
        _faces(label, depth, per_fy, limits.cap_m, np.float32(COVERED_FACE), out)
    return _cut(out, outer, window)


def _around(frame: Frame, window: Window, margin: int) -> tuple[Window, UInt8]:
    """The window with a margin, as far as the picture goes, and its label."""
    assert frame.label is not None
    top, left, height, width = window
    rows, columns = frame.label.shape
    y0, x0 = max(top - margin, 0), max(left - margin, 0)
    y1, x1 = min(top + height + margin, rows), min(left + width + margin, columns)
    # A copy, because the kernels would be compiled once more for what may not be written.
    return (y0, x0, y1 - y0, x1 - x0), np.array(frame.label[y0:y1, x0:x1], order="C")


def _cut(plane: UInt8, outer: Window, window: Window) -> UInt8:
    y, x = window[0] - outer[0], window[1] - outer[1]
    return plane[y : y + window[2], x : x + window[3]]


def _present(label: UInt8) -> NDArray[np.int64]:
    """Ids that occur."""
    counts = cv2.calcHist([label], [0], None, [256], [0, 256])
    return np.flatnonzero(counts)


def _pinhole(camera: Camera, window: Window) -> tuple[float, ...]:
    """Focal lengths and principal point of the whole picture, and where the window starts."""
    return (*camera.focal_px, *camera.principal_px, float(window[1]), float(window[0]))


@compiled
def _band(label: Any, depth: Any, pinhole: Any, buried: Any, out: Any) -> None:
    """Mark both sides of each border of buried grounds; all arrays are (H, W)."""
    height, width = label.shape
    for y in range(height):
        for x in range(width):
            kind = label[y, x]
            if buried[kind] == 0:
                continue
            i = x + 1
            while i < width and i <= x + GAP_PX and label[y, i] == IGNORE:
                i += 1
            if i < width and label[y, i] != kind and buried[label[y, i]] != 0:
                _stamp(y, x, label, depth, pinhole, buried, out)
                _stamp(y, i, label, depth, pinhole, buried, out)
            j = y + 1
            while j < height and j <= y + GAP_PX and label[j, x] == IGNORE:
                j += 1
            if j < height and label[j, x] != kind and buried[label[j, x]] != 0:
                _stamp(y, x, label, depth, pinhole, buried, out)
                _stamp(j, x, label, depth, pinhole, buried, out)


@compiled
def _stamp(y: Any, x: Any, label: Any, depth: Any, pinhole: Any, buried: Any, out: Any) -> None:
    """Mark buried ground around a pixel (y, x) next to a border."""
    fx, fy, cx, cy, left, top = pinhole
    z = np.float64(depth[y, x])
    px, py = (left + x - cx) / fx * z, (top + y - cy) / fy * z
    wide, tall = BAND_PX, BAND_PX
    if z < 1e4:
        wide = min(max(BAND_PX, int(np.ceil(BAND_M * fx / z))), WIDEST_BAND_PX)
        tall = min(max(BAND_PX, int(np.ceil(BAND_M * fy / z))), WIDEST_BAND_PX)
    for j in range(max(y - tall, 0), min(y + tall + 1, label.shape[0])):
        for i in range(max(x - wide, 0), min(x + wide + 1, label.shape[1])):
            if buried[label[j, i]] == 0:
                continue
            away2 = (i - x) * (i - x) + (j - y) * (j - y)
            other = np.float64(depth[j, i])
            qx = (left + i - cx) / fx * other - px
            qy = (top + j - cy) / fy * other - py
            metres2 = qx * qx + qy * qy + (other - z) * (other - z)
            if away2 < BAND_PX * BAND_PX or metres2 < BAND_M * BAND_M:
                out[j, i] = np.uint8(1)


@compiled
def _faces(label: Any, depth: Any, per_fy: Any, cap_m: Any, most: Any, out: Any) -> None:
    """Mark what lies under the snow caps of faces; all arrays but the table are (H, W)."""
    height, width = label.shape
    below = np.full(width, np.float32(np.inf))
    rows = np.zeros(width, np.int32)
    for y in range(1, height):
        for x in range(width):
            kind, z, above = label[y, x], depth[y, x], depth[y - 1, x]
            cap = cap_m[kind]
            if cap == np.float32(0.0):
                below[x] = np.float32(np.inf)
                continue
            leap = np.float32(1.5) + np.float32(0.2) * z
            if kind == label[y - 1, x] and abs(z - above) < leap:
                below[x] += z * per_fy
                rows[x] += np.int32(1)
            else:
                behind = above > np.float32(1.05) * z + np.float32(0.3)
                below[x] = np.float32(0.0) if behind else np.float32(np.inf)
                rows[x] = np.int32(0)
            cover = np.float32(1.0) - ramp(np.float32(0.7) * cap, np.float32(1.2) * cap, below[x])
            if cover > most and rows[x] < FACE_ROWS:
                out[y, x] = np.uint8(1)
