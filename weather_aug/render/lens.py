"""The glass before the camera: drops, wipers, and the veil of a wet windscreen.

The glass is 0.3 m away and the camera looks at the street, so everything on it is out of focus.
"""

from __future__ import annotations

import hashlib
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import finite, image_uint8
from weather_aug._keys import check_seed
from weather_aug.clip.types import Camera, Window
from weather_aug.colour import SRGB_LEVELS_LINEAR, srgb_from_linear, srgb_of_16_bits
from weather_aug.errors import ArgumentError
from weather_aug.render.lens_drops import drops_on
from weather_aug.render.lens_refraction import draw_drops, fill_pyramid
from weather_aug.render.lens_wiper import (
    BLADE_M,
    BLADE_M_PER_S,
    DULL_EXPOSURE_S,
    GLASS_M,
    Wiper,
    confusion_px,
    draw_blade,
    draw_smears,
    wiper_of,
)
from weather_aug.weather import Weather

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
UInt8 = NDArray[np.uint8]

HIDING_BLUR_PX = 4.0
MOST_VEIL = 0.044
"""Share of the mean light that an entirely wet glass adds."""
HALF_WET_DROPS = 9.0
"""Drops at which the glass scatters half as much as it can."""
_PYRAMID_LEVELS = 6
_SMEAR_BEND_RAD = 0.12
"""By which a ray at the edge of a strip of water is bent."""
_BLADE_LIGHT = 0.03
"""Of a black blade in daylight, over the mean light."""


class Glass(NamedTuple):
    """A picture behind the glass, and what the glass hides."""

    image: UInt8
    """(H, W, 3) sRGB."""
    alpha: Float32
    """(H, W) opacity of drops and blade, in [0, 1]."""
    hidden: UInt8
    """(H, W), 1 where `alpha` exceeds 0.5 and what is in front of the surface blurs it by more than
    4 pixels."""


def through_glass(
    image: UInt8,
    whole: Float32,
    *,
    window: Window,
    camera: Camera,
    weather: Weather,
    seed: int,
    time_s: float,
    glass: str,
    drops: bool = True,
    wipers: bool = True,
    veil: bool = True,
) -> Glass:
    """A window of a picture as it looks through the wet glass before the camera.

    A drop is a lens: inside its soft outline stands a small, blurred, upside-down picture of the
    scene. Drops land, slide and go; at a larger `lens_drops` some are added and none moves. A wiper
    clears those that landed before its last pass and leaves faint arcs. A pure function: any window
    of any frame alone gives the bytes that it has in the whole picture.

    Args:
        image: (H, W, 3) sRGB of the window, in this weather.
        whole: (h, w, 3) float32 linear light of the whole picture in this weather, of any smaller
            size, 256 wide or so; drops show it, and the veil takes its mean.
        window: (top, left, height, width) of `image` in the whole picture.
        camera: Of the whole picture; its focal length and aperture blur the glass, its speed drives
            drops upwards.
        weather: Its `lens_drops` is the mean number of drops in the whole picture where no wiper
            runs; `wipers` the share of the seeds at which one does.
        seed: Which drops land, and whether and when a wiper passes.
        time_s: Moment, seconds.
        glass: Name of the camera behind the glass: each has drops of its own.
        drops: False to leave the drops out.
        wipers: False for a glass that nobody wipes.
        veil: False for glass that scatters no light.

    Raises:
        ArgumentError: If an argument has the wrong type or shape, or the window leaves the picture.

    Source:
        Refraction by a thin prism, (n - 1) times the slope of the drop's surface; circle of
        confusion f A / z of a camera focused far behind the glass. Sizes, lives and opacities:
        docs/physics.md, 6.7.
    """
    image = image_uint8("image", image)
    whole = _checked_whole(whole)
    _check_window(window, image, camera)
    seed, time_s = check_seed("seed", seed), finite("time_s", time_s, -1e9, 1e10)
    name = _number_of(glass)
    wiper = wiper_of(weather, camera, seed, name, time_s) if wipers else None
    landed = drops_on(camera, weather, seed, time_s, name, wiper) if drops else None
    size = image.shape[:2]
    alpha, hidden = np.zeros(size, np.float32), np.zeros(size, np.uint8)
    has_drops = landed is not None and len(landed.rows) > 0
    veiled = veil and weather.lens_drops > 0
    if not (has_drops or veiled or wiper is not None):
        return Glass(image.copy(), alpha, hidden)
    pyramid, levels, mean = _pyramid_of(whole)
    if not np.isfinite(mean).all():
        raise ArgumentError("whole must be finite; shrink a picture without NaN or infinite light")
    light = (veil_share(weather) if veiled else 0.0) * mean
    out = _veiled(image, light) if veiled else image.copy()
    scene = _Scene(
        pyramid,
        levels,
        np.array([whole.shape[1] / camera.width, whole.shape[0] / camera.height], np.float32),
        light.astype(np.float32),
        np.array(window[:2], np.int64),
    )
    if wiper is not None:
        _wiped(scene, wiper, camera, mean, out, alpha, hidden)
    if landed is not None and has_drops:
        draw_drops(landed.rows, *scene, *_curves(), np.float32(HIDING_BLUR_PX), out, alpha, hidden)
    return Glass(out, alpha, hidden)


def veil_share(weather: Weather) -> float:
    """Share of the picture's mean light that the wet glass adds: 1 % in light rain, 4 % in extreme.

    No drops mean dry glass, however wet the street is.
    """
    wet = weather.lens_drops / (weather.lens_drops + HALF_WET_DROPS)
    return MOST_VEIL * wet * (0.8 + 0.2 * weather.wetness)


class _Scene(NamedTuple):
    """What drops show, and where the window is; see `draw_drops`."""

    pyramid: Float32
    levels: NDArray[np.int64]
    scale: Float32
    veil: Float32
    window: NDArray[np.int64]


def _wiped(
    scene: _Scene,
    wiper: Wiper,
    camera: Camera,
    mean: Float64,
    image: UInt8,
    alpha: Float32,
    hidden: UInt8,
) -> None:
    """Draw the smears of the last pass, and the blade while it is there."""
    pivot = np.array(wiper.pivot_px, np.float32)
    smears, along = wiper.smears(camera)
    level = min(2, len(scene.levels) - 1)
    if len(smears):
        draw_smears(
            smears,
            along,
            pivot,
            np.float32(_SMEAR_BEND_RAD * camera.focal_px[0]),
            scene.pyramid,
            *scene.levels[level],
            scene.scale * np.float32(0.5**level),
            scene.veil,
            scene.window,
            *_curves(),
            image,
        )
    if wiper.blade is None:
        return
    dark = (_BLADE_LIGHT * mean + scene.veil).astype(np.float32)
    exposure_s = max(camera.exposure_s, DULL_EXPOSURE_S)
    widths = (
        np.float32(wiper.blade),
        pivot,
        np.float32(wiper.outer_px),
        np.float32(BLADE_M * camera.focal_px[0] / GLASS_M),
        np.float32(BLADE_M_PER_S * exposure_s * camera.focal_px[0] / GLASS_M),
        np.float32(np.hypot(confusion_px(camera), 1.5)),
    )
    draw_blade(*widths, dark, scene.window, *_curves(), image, alpha, hidden)


def _pyramid_of(whole: Float32) -> tuple[Float32, NDArray[np.int64], Float64]:
    """The pyramid of a picture, its levels, and the picture's mean; see `fill_pyramid`."""
    sizes = [whole.shape[:2]]
    while len(sizes) < _PYRAMID_LEVELS and min(sizes[-1]) >= 4:
        sizes.append(tuple(-(-side // 2) for side in sizes[-1]))
    heights = [height for height, _ in sizes]
    starts = np.cumsum([0, *heights])
    levels = np.array([(s, *size) for s, size in zip(starts, sizes, strict=False)], np.int64)
    pyramid = np.empty((int(starts[-1]), whole.shape[1], 3), np.float32)
    return pyramid, levels, np.array(fill_pyramid(whole, levels, pyramid))


def _veiled(image: UInt8, light: Float64) -> UInt8:
    """The picture and light (3,) that is added to each pixel."""
    table = srgb_from_linear(np.minimum(SRGB_LEVELS_LINEAR[:, None] + light, 1.0))
    levels = np.round(255.0 * table).astype(np.uint8)
    return cv2.LUT(image, levels.reshape(256, 1, 3))


def _curves() -> tuple[Float32, UInt8]:
    """Linear light (256,) of sRGB levels, and sRGB levels of linear light (65536,)."""
    return SRGB_LEVELS_LINEAR.astype(np.float32), srgb_of_16_bits()


def _number_of(glass: str) -> int:
    if not isinstance(glass, str):
        raise ArgumentError(f"glass must be a camera's name, got {type(glass).__name__}")
    return int.from_bytes(hashlib.blake2b(glass.encode(), digest_size=8).digest(), "little")


def _checked_whole(whole: Float32) -> Float32:
    if not isinstance(whole, np.ndarray) or whole.dtype != np.float32:
        raise ArgumentError("whole must be a float32 array of linear light; shrink the picture")
    if whole.ndim != 3 or whole.shape[2] != 3 or whole.size == 0:
        raise ArgumentError(f"whole must have shape (h, w, 3), got {whole.shape}")
    # A copy, because the kernel would be compiled once more for what may not be written.
    return np.array(whole, order="C")


def _check_window(window: Window, image: UInt8, camera: Camera) -> None:
    try:
        top, left, height, width = (side.__index__() for side in window)
    except (AttributeError, TypeError, ValueError):
        raise ArgumentError(
            f"window must be four integers (top, left, height, width), got {window!r}"
        ) from None
    if image.shape[:2] != (height, width):
        raise ArgumentError(f"window {window} must have the image's size {image.shape[:2]}")
    inside = 0 <= top and top + height <= camera.height and 0 <= left
    if not (inside and left + width <= camera.width):
        raise ArgumentError(f"window {window} leaves the picture of {camera.height}x{camera.width}")
