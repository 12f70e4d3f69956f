"""What the editor knows of a frame before it knows the weather: maps on the small grid.

They depend on the picture and its geometry alone, so a scene stores them beside the picture and
every weather of it is a function of them, pixel by pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug._rows import halves
from weather_aug.colour import LUMINANCE
from weather_aug.edit.physical import relight, settling
from weather_aug.edit.physical.mirror import mirror_map, mirrored
from weather_aug.edit.physical.mirror_seen import Seen, with_seen
from weather_aug.edit.physical.overcast import ZENITH_GAIN
from weather_aug.edit.physical.site import Site
from weather_aug.edit.surface import shared
from weather_aug.taxonomy import SKY

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
UInt8 = NDArray[np.uint8]

NAMES = (
    *("ground_slope", "ground_offset", "ground_least", "ground_most"),
    *("object_slope", "object_offset", "matte_slope", "matte_offset"),
    *("illumination", "luminance", "facing_up", "lateral_m"),
    *("sharp_red", "sharp_green", "sharp_blue", "sharp_sky"),
    *("rough_red", "rough_green", "rough_blue", "rough_sky"),
)
"""See `relight.Flattening`, `relight.sky_matte`, `relight.illumination`, `settling` and `mirror`.
What is mirrored is the light of surfaces, as it is where they are mirrored and 0 where the sky is,
and by how much of the horizon's light the sky is."""
GROUND_GAIN, OBJECT_GAIN, MATTE = 0, 4, 6
ILLUMINATION, LUMINANCE_MEAN, FACING_UP, LATERAL_M = range(8, 12)
SHARP, ROUGH = 12, 16
MEAN_CELLS = 9
THUMBNAIL_WIDTH_PX = 256


@dataclass(frozen=True, eq=False)
class Layers:
    """Maps of one frame; `step` pixels of the picture are one cell."""

    step: float
    maps: NDArray[np.float16]
    """(20, h, w), in the order of `NAMES`."""
    tint: Float32
    """(3,) of `relight.Flattening`."""
    plane: Float64
    """(3,) of the road: up = plane[0] + plane[1] along + plane[2] left, street axes."""
    classes: UInt8
    """(H, W) train ids, guessed where nobody labelled."""
    illumination: float
    """Luminance of a white surface in the recorded street, linear light."""
    thumbnail: UInt8
    """(h', w', 3) sRGB, the picture at most 256 pixels wide: what glass and glare see of it."""


def layers_of(site: Site, path: Float64 | None = None, seen: Seen | None = None) -> Layers:
    """Look at a frame's surfaces.

    Args:
        site: The frame.
        path: (P, 2) places of the camera in the order driven, street axes (along, left); None where
            nobody knows: the way then goes straight ahead.
        seen: A render of the street's mirror image in the road; None where there is no geometry to
            render: what the road mirrors is then found in the picture.
    """
    flat = relight.flattening(site)
    lit = relight.illumination(site, flat)
    mirror = mirror_map(site)
    surfaces = np.where(site.small_classes[..., None] == SKY, 0.0, overcast_light(site, flat))
    surfaces = surfaces.astype(np.float32)
    if seen is not None:
        mirror, surfaces = with_seen(site, flat, mirror, surfaces, seen)
    shown = mirrored(mirror, surfaces, np.zeros((2, 3)))
    sky_gain = np.array([[1.0] * 3, [1.0 + ZENITH_GAIN] * 3])
    free = mirrored(mirror, np.zeros_like(site.light), sky_gain)
    luminance = site.light @ LUMINANCE.astype(np.float32)
    planes = (
        *np.moveaxis(flat.ground, -1, 0),
        *np.moveaxis(flat.objects, -1, 0),
        *relight.sky_matte(site),
        lit,
        cv2.blur(luminance, (MEAN_CELLS, MEAN_CELLS)),
        settling.facing_up(site),
        settling.lateral_m(site, path),
        *np.moveaxis(shown.sharp, -1, 0),
        free.sharp[..., 0],
        *np.moveaxis(shown.rough, -1, 0),
        free.rough[..., 0],
    )
    stack = halves(np.stack(planes))
    return Layers(
        float(site.step),
        shared(stack),
        shared(flat.tint),
        shared(site.plane),
        shared(site.classes),
        float(np.median(stack[ILLUMINATION])),
        shared(thumbnail_of(site.frame.image)),
    )


def thumbnail_shape(height: int, width: int) -> tuple[int, int]:
    """(h', w') of the thumbnail of a picture, pixels."""
    small_width = min(THUMBNAIL_WIDTH_PX, width)
    return max(1, round(height * small_width / width)), small_width


def thumbnail_of(image: UInt8) -> UInt8:
    """The picture (H, W, 3) at most 256 pixels wide, by means of its pixels."""
    height, width = thumbnail_shape(*image.shape[:2])
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))


def overcast_light(site: Site, flat: relight.Flattening) -> Float32:
    """Linear light (h, w, 3) of what stands, without the sun's."""
    luma = site.srgb @ LUMINANCE.astype(np.float32)
    slope, offset = flat.objects[..., 0], flat.objects[..., 1]
    gain = np.clip(slope * luma + offset, relight.LEAST_GAIN, relight.MOST_GAIN)
    return (site.light * np.exp(gain)[..., None]).astype(np.float32)
