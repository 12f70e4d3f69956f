"""The physical editor: a window of a frame under the weather's sky, wet or snowed on."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled
from weather_aug.clip.types import Camera, Frame, Window
from weather_aug.colour import SRGB_LEVELS_LINEAR
from weather_aug.edit.ambience import Ambience
from weather_aug.edit.physical.dress import LIGHT, MAPS, SHARP, Geometry, dress
from weather_aug.edit.physical.layers import SHARP as SHARP_LAYER
from weather_aug.edit.physical.layers import Layers
from weather_aug.edit.physical.look import Look, look_of
from weather_aug.edit.physical.materials import material_table
from weather_aug.edit.physical.noise import PERIOD_M, noise_tile
from weather_aug.edit.physical.overcast import tone
from weather_aug.edit.surface import surface_of
from weather_aug.weather import Weather

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
UInt8 = NDArray[np.uint8]

TABLE_STEPS = 1024
"""Of the tone of linear light up to 1, by its square root."""
MOST_ROOT = 4
"""The table ends at the square of this: a white surface in the sun is brighter than a picture's
white, because the camera exposes for the whole street."""


def edited(
    frame: Frame,
    layers: Layers,
    weather: Weather,
    ambience: Ambience,
    window: Window,
    without: Collection[str] = (),
) -> UInt8:
    """Background of a window in the weather: a pure function of its arguments.

    The same place of the street is wet, puddled or white in every picture of it, whichever camera
    took it and when, because noise is anchored to the world.

    Args:
        frame: Picture with depth; its label says what holds water and snow.
        layers: Of the same frame.
        weather: State of air and ground; what is in the air is not drawn here.
        ambience: Light and axes of the scene.
        window: (top, left, height, width); its pixels equal the same pixels of the whole.
        without: Effects that are left out: relight, sky, film, mirror, puddles, snow_cover, tracks.

    Returns:
        (H, W, 3) sRGB.
    """
    look = look_of(weather, ambience, layers.illumination, without)
    curve, matrix = tone(0.0 if "relight" in without else weather.overcast)
    labelled = frame.label is not None
    _, _, height, width = window
    out = np.empty((3, height, width), np.uint8)
    dress(
        surface_of(frame),
        _flat(layers.classes),
        window,
        geometry_of(frame.camera, ambience.axes_world, layers.plane, labelled=labelled),
        look,
        _flat(layers.tint),
        curve.astype(np.float32),
        matrix.astype(np.float32),
        material_table(labelled=labelled),
        maps_in(layers, window, look, curve, matrix),
        np.float32(layers.step),
        noise_tile(),
        out,
    )
    image: UInt8 = cv2.merge(tuple(out))
    return image


def geometry_of(camera: Camera, axes_world: Float64, plane: Float64, *, labelled: bool) -> Geometry:
    """What the kernels know of a camera over the road's plane; see `Site.plane`."""
    rays = axes_world @ camera.world_from_camera[:3, :3]
    origin = axes_world @ camera.centre_world
    climb = np.array([-plane[1], -plane[2], 1.0]) @ rays
    height_m = origin[2] - plane[0] - plane[1:] @ origin[:2]
    places = np.mod(origin[:2], PERIOD_M)
    values = (
        *(*camera.focal_px, *camera.principal_px, *rays[0], *rays[1]),
        *(*climb, *places, height_m, float(labelled)),
    )
    return Geometry(*(np.float32(value) for value in values))


def maps_in(layers: Layers, window: Window, look: Look, curve: Float64, matrix: Float64) -> Float32:
    """The kernel's maps (18, h, w): the layers under the weather's light, where a window is."""
    top, _, height, _ = window
    rows = layers.maps.shape[1]
    first = max(int(top / layers.step) - 1, 0)
    last = min(int((top + height) / layers.step) + 2, rows)
    table = _tone_table(curve)
    horizon = np.array([look.red, look.green, look.blue])
    out = np.zeros((MAPS, *layers.maps.shape[1:]), np.float32)
    _under_tone(
        layers.maps[:, first:last].astype(np.float32),
        table,
        (matrix * look.exposure).astype(np.float32),
        horizon,
        look.mirror > 0,
        first,
        out,
    )
    return out


def _flat(array: NDArray[Any]) -> Any:
    """A read-only (N,) view, so that the kernel is compiled once for what may be written or not."""
    flat = np.ascontiguousarray(array).reshape(-1).view(np.ndarray)
    flat.flags.writeable = False
    return flat


def _tone_table(curve: Float64) -> Float32:
    """Toned light (N,) by the square root of light, `TABLE_STEPS` a unit, from 0 to `MOST_ROOT`."""
    light = np.linspace(0.0, MOST_ROOT, MOST_ROOT * TABLE_STEPS + 1) ** 2
    # The tone is a power of light, so that its last two levels say how it goes on.
    power = np.log(curve[-1] / curve[-2]) / np.log(SRGB_LEVELS_LINEAR[-1] / SRGB_LEVELS_LINEAR[-2])
    inside = np.interp(light, SRGB_LEVELS_LINEAR, curve)
    return np.where(light > 1.0, curve[-1] * light**power, inside).astype(np.float32)


@compiled
def _under_tone(maps, table, matrix, sky, mirrors, first, out):
    """Copy geometry; take light through the tone; put the weather's sky into what is mirrored."""
    zero, one = np.float32(0.0), np.float32(1.0)
    for row in range(maps.shape[1]):
        for column in range(maps.shape[2]):
            for k in range(SHARP):
                value = maps[k, row, column]
                lit = (k == LIGHT) | (k == LIGHT + 1)
                out[k, first + row, column] = _toned(value, table) if lit else value
            if not mirrors:
                continue
            for kind in range(2):
                base = SHARP_LAYER + 4 * kind
                horizons = maps[base + 3, row, column]
                surfaces = one - horizons
                surfaces = max(surfaces, zero)
                share = max(surfaces, np.float32(1e-2))
                r = _toned(maps[base, row, column] / share, table)
                g = _toned(maps[base + 1, row, column] / share, table)
                b = _toned(maps[base + 2, row, column] / share, table)
                for channel in range(3):
                    value = matrix[channel, 0] * r + matrix[channel, 1] * g + matrix[channel, 2] * b
                    mixed = surfaces * value + horizons * sky[channel]
                    out[SHARP + 3 * kind + channel, first + row, column] = mixed


@compiled
def _toned(light, table):
    last = np.float32(MOST_ROOT * TABLE_STEPS)
    root = np.sqrt(max(light, np.float32(0.0))) * np.float32(TABLE_STEPS)
    if root >= last:
        return table[MOST_ROOT * TABLE_STEPS]
    step = np.int32(root)
    return table[step] + (root - np.float32(step)) * (table[step + 1] - table[step])
