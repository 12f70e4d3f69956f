"""The physical editor: a window of a frame under the weather's sky, wet or snowed on."""

from __future__ import annotations

from collections.abc import Collection

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
"""Of the tone of linear light, by its square root."""


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
    # Read-only as a scene's labels are: the kernel would be compiled once more for others.
    classes = layers.classes.reshape(-1)
    classes.flags.writeable = False
    _, _, height, width = window
    out = np.empty((3, height, width), np.uint8)
    dress(
        surface_of(frame),
        classes,
        window,
        geometry_of(frame.camera, ambience.axes_world, layers.plane, labelled=labelled),
        look,
        layers.tint,
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
    """The kernel's maps (14, h, w): the layers under the weather's light, where a window is."""
    top, _, height, _ = window
    rows = layers.maps.shape[1]
    first = max(int(top / layers.step) - 1, 0)
    last = min(int((top + height) / layers.step) + 2, rows)
    root = np.linspace(0.0, 1.0, TABLE_STEPS)
    table = np.interp(root**2, SRGB_LEVELS_LINEAR, curve).astype(np.float32)
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
    last = np.float32(TABLE_STEPS - 1)
    root = np.sqrt(max(light, np.float32(0.0))) * last
    if root >= last:
        return table[TABLE_STEPS - 1]
    step = np.int32(root)
    return table[step] + (root - np.float32(step)) * (table[step + 1] - table[step])
