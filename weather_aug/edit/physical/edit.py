"""The physical editor: a window of a frame under the weather's sky, wet or snowed on."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.types import Camera, Frame, Window
from weather_aug.colour import LUMINANCE
from weather_aug.edit.ambience import Ambience
from weather_aug.edit.physical.dress import Geometry, Look, dress
from weather_aug.edit.physical.layers import (
    ILLUMINATION,
    ROUGH,
    ROUGH_SKY,
    SHARP,
    SHARP_SKY,
    Layers,
)
from weather_aug.edit.physical.materials import material_table
from weather_aug.edit.physical.noise import noise_tile
from weather_aug.edit.physical.overcast import CONTRAST_LOSS, ZENITH_GAIN, tone
from weather_aug.edit.surface import surface_of
from weather_aug.weather import Weather

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]
NOISE_PERIOD_M = 2457.6


def edited(
    frame: Frame, layers: Layers, weather: Weather, ambience: Ambience, window: Window, without=()
) -> UInt8:
    """Background (H, W, 3) sRGB of a window in the weather."""
    has = lambda name: name not in without
    overcast = weather.overcast if has("relight") else 0.0
    curve, matrix = tone(overcast)
    look = look_of(weather, ambience, layers, has, overcast)
    maps = small_maps(layers, look, curve, matrix)
    _, _, height, width = window
    out = np.empty((3, height, width), np.uint8)
    dress(
        surface_of(frame),
        layers.classes.reshape(-1),
        window,
        geometry_of(frame.camera, ambience, layers.plane),
        look,
        curve.astype(np.float32),
        matrix.astype(np.float32),
        material_table(labelled=frame.label is not None),
        maps,
        layers.step,
        noise_tile(),
        out,
    )
    return cv2.merge(tuple(out))


def look_of(weather, ambience, layers, has, overcast) -> Look:
    white = float(ambience.airlight @ LUMINANCE)
    wet = weather.wetness
    flooded = 0.15 * wet**2 + 0.55 * min(weather.rain_mm_per_h / 75.0, 1.0) ** 0.5
    # A white surface in the open is as bright as the mean of the sky; streets see half of it.
    lit = float(np.median(layers.maps[ILLUMINATION]))
    exposure = (0.65 * white / lit) ** (0.6 * overcast)
    exposure = min(max(exposure, 0.92), 1.8) * (1.0 - 0.15 * weather.snow_cover * has("snow_cover"))
    values = (
        weather.overcast if has("sky") else 0.0,
        overcast * (1 - CONTRAST_LOSS * overcast),
        exposure,
        ZENITH_GAIN,
        *ambience.airlight,
        wet if has("film") else 0.0,
        wet if has("mirror") else 0.0,
        min(flooded, 1.0),
        weather.puddles if has("puddles") else 0.0,
        weather.snow_cover if has("snow_cover") else 0.0,
        weather.road_snow_cover if has("snow_cover") else 0.0,
        weather.snow_depth_m if has("snow_cover") else 0.0,
        1.0 if has("tracks") else 0.0,
        0.97 * white,
    )
    return Look(*(np.float32(v) for v in values))


def geometry_of(camera: Camera, ambience: Ambience, plane) -> Geometry:
    rays = ambience.axes_world @ camera.world_from_camera[:3, :3]
    origin = ambience.axes_world @ camera.centre_world
    climb = np.array([-plane[1], -plane[2], 1.0]) @ rays
    height = origin[2] - plane[0] - plane[1:] @ origin[:2]
    values = (
        *camera.focal_px,
        *camera.principal_px,
        *rays[0],
        *rays[1],
        *climb,
        *np.mod(origin[:2], NOISE_PERIOD_M),
        height,
    )
    return Geometry(*(np.float32(v) for v in values))


def small_maps(layers: Layers, look: Look, curve, matrix) -> Float32:
    """The kernel's (14, h, w) float32 maps: the mirrored light under the weather's sky."""
    maps = layers.maps.astype(np.float32)
    levels = np.interp  # toned light of linear light
    from weather_aug.colour import SRGB_LEVELS_LINEAR

    air = np.array([look.red, look.green, look.blue]) * (1 + 0.5 * look.zenith_gain)
    out = np.empty((14, *maps.shape[1:]), np.float32)
    out[:4] = maps[:4]
    toned = lambda v: np.interp(v, SRGB_LEVELS_LINEAR, curve).astype(np.float32)
    out[4:6] = toned(maps[4:6])
    out[6:8] = maps[6:8]
    for k, (first, sky) in enumerate(((SHARP, SHARP_SKY), (ROUGH, ROUGH_SKY))):
        free = maps[sky]
        rgb = maps[first : first + 3] / np.maximum(1 - free, 1e-3)
        rgb = np.einsum("ij,jhw->ihw", matrix, toned(rgb)) * look.exposure
        out[8 + 3 * k : 11 + 3 * k] = rgb * (1 - free) + free * air[:, None, None]
    return out
