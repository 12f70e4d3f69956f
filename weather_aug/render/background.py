"""What stands behind the weather in a picture: the edited background, and all of it, shrunk."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.types import Frame, Window
from weather_aug.edit.ambience import Ambience
from weather_aug.edit.physical.edit import edited
from weather_aug.edit.physical.layers import Layers, layers_of
from weather_aug.edit.physical.look import changes_background
from weather_aug.edit.physical.site import site_of
from weather_aug.edit.surface import Surface, repainted, surface_of
from weather_aug.render.options import RenderOptions
from weather_aug.weather import Weather

Float32 = NDArray[np.float32]


def background_of(
    frame: Frame,
    weather: Weather,
    ambience: Ambience,
    window: Window,
    layers: Layers | None,
    options: RenderOptions,
) -> Surface:
    """The frame's surface with the weather's background in a window.

    Without layers it is the recorded one: those who need none do not have to look at the frame.
    """
    surface = surface_of(frame)
    if layers is None or not changes_background(weather, options.without):
        return surface
    image = edited(frame, layers, weather, ambience, window, options.without)
    return repainted(surface, image, window)


def looked_at(frame: Frame, ambience: Ambience) -> Layers:
    """What the editor knows of a frame, found out now."""
    return layers_of(site_of(frame, ambience.axes_world, ambience.camera_height_m))


def shrunk(frame: Frame, layers: Layers) -> tuple[Frame, Layers]:
    """The frame at most 256 pixels wide, and its layers: what glass and lens see of the whole."""
    height, width = frame.image.shape[:2]
    small_height, small_width = layers.thumbnail.shape[:2]
    rows = (np.arange(small_height) * 2 + 1) * height // (2 * small_height)
    columns = (np.arange(small_width) * 2 + 1) * width // (2 * small_width)
    places = rows[:, None], columns[None, :]
    assert frame.depth_m is not None
    small = replace(
        frame,
        camera=frame.camera.resized(small_width, small_height),
        image=layers.thumbnail,
        label=None if frame.label is None else np.ascontiguousarray(frame.label[places]),
        depth_m=np.ascontiguousarray(frame.depth_m[places]),
        normals_world=None,
    )
    classes = np.ascontiguousarray(layers.classes[places])
    # Kernels are compiled for layers that nobody can write.
    classes.flags.writeable = False
    step = layers.step * small_width / width
    return small, replace(layers, step=step, classes=classes)
