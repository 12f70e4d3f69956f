"""What a caller hands to a transform, checked: pictures, depth, policies, options."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import MAX_PIXELS, like_image
from weather_aug.errors import ArgumentError, printable
from weather_aug.render.options import DEFAULT_OPTIONS, RenderOptions
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.taxonomy import IGNORE, SKY

UInt8 = NDArray[np.uint8]


def rgb_uint8(image: Any) -> UInt8:
    """A C-contiguous (H, W, 3) uint8 picture of a uint8 or float32 one.

    Raises:
        ArgumentError: If it is no numpy array of such a shape, type and range.
    """
    if not isinstance(image, np.ndarray):
        raise ArgumentError(
            f"image must be a numpy array (H, W, 3), got {type(image).__name__}; weather comes "
            "before conversion to tensors, and np.asarray makes an array of a PIL picture"
        )
    if image.ndim != 3 or image.shape[2] != 3:
        raise ArgumentError(f"image must have shape (H, W, 3), got {image.shape}{_cure(image)}")
    height, width, _ = image.shape
    if height == 0 or width == 0:
        raise ArgumentError(f"image has a zero side: {image.shape}")
    if height * width > MAX_PIXELS:
        raise ArgumentError(f"image has {height * width} pixels, more than {MAX_PIXELS}")
    if image.dtype == np.uint8:
        return np.ascontiguousarray(image)
    if image.dtype.newbyteorder("=") != np.float32:
        raise ArgumentError(
            f"image must be uint8, or float32 in [0, 1], got {image.dtype}; convert it with "
            "image.astype"
        )
    low, high = float(image.min()), float(image.max())
    if not (low >= -1e-6 and high <= 1 + 1e-6):
        bytes_as_floats = low >= 0 and 2 < high <= 255
        cure = (
            "divide it by 255, or keep uint8"
            if bytes_as_floats
            else "weather comes before normalisation"
        )
        raise ArgumentError(f"image must be finite and in [0, 1], got [{low:g}, {high:g}]; {cure}")
    return np.ascontiguousarray(np.rint(np.clip(image, 0, 1) * np.float32(255)).astype(np.uint8))


def _cure(image: NDArray[Any]) -> str:
    """What makes (H, W, 3) of another shape, where that is known."""
    if image.ndim == 3 and image.shape[0] == 3:
        return ": move its channels last with image.transpose(1, 2, 0)"
    if image.ndim == 3 and image.shape[2] == 4:
        return ": leave its alpha out with image[..., :3]"
    if image.ndim == 2 or image.shape[2:] == (1,):
        return ": read it in colour, or repeat its channel three times"
    return ""


def given_depth(depth: Any, shape: tuple[int, int], label: UInt8 | None) -> NDArray[Any]:
    """A caller's depth, refused if it is mostly holes, which would silently be taken for far.

    Raises:
        ArgumentError: If it is, or is no float array of the picture's (H, W).
    """
    depth = np.asarray(depth)
    like_image("depth", depth, shape)
    if depth.dtype.kind != "f":
        raise ArgumentError(f"depth must be a float array in metres, got {depth.dtype}")
    known = np.isfinite(depth) & (depth > 0)
    surface = np.ones(shape, bool) if label is None else label != SKY
    open_sky = depth == np.inf
    if label is not None:
        open_sky &= label == IGNORE
    expected = int(np.count_nonzero(surface & ~open_sky))
    found = int(np.count_nonzero(surface & known))
    if surface.any() and (found == 0 or 2 * found < expected):
        raise ArgumentError(
            f"depth is known (finite and above 0) on {found / max(expected, 1):.0%} of the pixels "
            "outside the sky, and unknown depth counts as far: complete the depth first, or leave "
            "it out"
        )
    if depth.dtype == np.float16:
        return np.ascontiguousarray(depth)
    with np.errstate(over="ignore"):
        # What does not fit is as far as the sky.
        return np.ascontiguousarray(depth, dtype=np.float32)


def checked_policy(policy: Any) -> WeatherPolicy:
    """A policy, its `to_dict` form, or None for the default one.

    Raises:
        ArgumentError: If it is none of these.
    """
    if isinstance(policy, WeatherPolicy):
        return policy
    if not isinstance(policy, dict | None):
        raise ArgumentError(
            "policy must be a WeatherPolicy, or its fields as a dict, got "
            f"{type(policy).__name__}; write WeatherPolicy(types={{'rain': 1, 'clear': 1}})"
        )
    return WeatherPolicy.from_dict(policy or {})


def checked_options(options: Any) -> RenderOptions:
    """Options, their fields as a dict, or None for the default ones.

    Raises:
        ArgumentError: If they are none of these.
    """
    if options is None:
        return DEFAULT_OPTIONS
    if isinstance(options, RenderOptions):
        return options
    if not isinstance(options, dict):
        raise ArgumentError(
            f"options must be RenderOptions, or a dict of its fields, got {type(options).__name__}"
        )
    known = [each.name for each in fields(RenderOptions)]
    unknown = sorted(set(options) - set(known), key=str)
    if unknown:
        raise ArgumentError(
            f"RenderOptions has no field {printable(unknown[0])}; it has {', '.join(known)}"
        )
    return RenderOptions(**options)
