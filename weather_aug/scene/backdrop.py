"""What stands behind the weather of a recorded frame: stored backgrounds, blended as it asks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.types import Frame
from weather_aug.colour import SRGB_LEVELS_LINEAR, srgb_of_16_bits
from weather_aug.edit.physical.layers import Layers, thumbnail_of
from weather_aug.edit.surface import shared
from weather_aug.render.compose import RenderedFrame
from weather_aug.render.label import kept_labels
from weather_aug.render.label_snow import buried_borders, covered_faces, snow_limits
from weather_aug.render.options import RenderOptions
from weather_aug.scene import store
from weather_aug.scene.backgrounds_record import background_path
from weather_aug.scene.records import FrameRecord, Manifest
from weather_aug.scene.styles import lying_in
from weather_aug.weather import Weather

UInt8 = NDArray[np.uint8]

WHITE = 65535
"""Linear light is summed in steps of this; finer than any level of sRGB."""


class Backdrop(NamedTuple):
    """What a recorded frame looks like before air, particles, glass and sensor."""

    image: UInt8
    """(H, W, 3) sRGB."""
    lying: Weather
    """The snow on its ground; see `lying_in`."""


def read_background(folder: Path, record: FrameRecord, style: str) -> UInt8:
    """(H, W, 3) sRGB of a frame in a style that the scene has.

    Raises:
        SceneError: If its file cannot be read.
    """
    return store.read_picture(folder / background_path(style, record.key), record.camera)


def backdrop_of(
    folder: Path, manifest: Manifest, recorded: Frame, weights: Mapping[str, float]
) -> Backdrop:
    """A recorded frame with shares of its stored backgrounds.

    A style whose picture is the recorded one shows nothing: no snow of it hides a label.

    Args:
        folder: Of the scene.
        manifest: Of the scene, with these styles.
        recorded: The frame.
        weights: At least 0 and together at most 1, by style; the rest is the recorded picture.

    Raises:
        SceneError: If a picture cannot be read.
    """
    record = manifest.by_key[recorded.key]
    itself = manifest.files[record.files["image"]]
    shown = {
        style: weight
        for style, weight in weights.items()
        if manifest.files[background_path(style, record.key)] != itself
    }
    pictures = [(weight, read_background(folder, record, style)) for style, weight in shown.items()]
    return Backdrop(blended(recorded.image, pictures), lying_in(shown, 1.0))


def blended(recorded: UInt8, pictures: Sequence[tuple[float, UInt8]]) -> UInt8:
    """Shares of pictures, and of the recorded one what is missing to 1, in linear light.

    Args:
        recorded: (H, W, 3) sRGB.
        pictures: Share and picture of each; the shares sum to at most 1.
    """
    left = max(1.0 - sum(share for share, _ in pictures), 0.0)
    shares = [(left, recorded), *pictures]
    seen = [(share, picture) for share, picture in shares if share > 0]
    if len(seen) == 1:
        return seen[0][1]
    light = sum(_light(picture, share) for share, picture in seen)
    levels = np.minimum(light, np.float32(WHITE)).astype(np.uint16)
    image: UInt8 = srgb_of_16_bits()[levels]
    return image


def _light(picture: UInt8, share: float) -> NDArray[np.float32]:
    """A share of the linear light of a picture, in steps of `WHITE`, rounding included."""
    # Half a step in all, whatever the number of pictures, since the shares sum to 1.
    table = share * (WHITE * SRGB_LEVELS_LINEAR + 0.5)
    return np.asarray(cv2.LUT(picture, table.astype(np.float32)))


def with_picture(layers: Layers, image: UInt8) -> Layers:
    """Layers of a frame that looks otherwise: glass and glare see the picture that is shown."""
    return replace(layers, thumbnail=shared(thumbnail_of(image)))


def under_snow(
    shot: RenderedFrame, frame: Frame, lying: Weather, options: RenderOptions
) -> RenderedFrame:
    """The render of a frame that shows snow with what its label cannot claim below it.

    Args:
        shot: In the weather, without effects on surfaces.
        frame: Whose label says what lies below, and whose depth where.
        lying: What lies on its ground; see `lying_in`.
        options: As they were asked for.
    """
    limits = snow_limits(lying, options)
    if limits is None or shot.label is None:
        return shot
    buried = buried_borders(frame, shot.window, limits)
    return replace(
        shot,
        label=kept_labels(shot.label, buried, options.labels),
        invalid=shot.invalid | buried | covered_faces(frame, shot.window, limits),
    )
