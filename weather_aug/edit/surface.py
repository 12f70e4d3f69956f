"""The recorded picture behind the weather, as kernels read it: in place, row by row. Compiled.

A frame's arrays may be huge, memory-mapped and read-only, and its depth half or single precision.
Kernels get them flat and read-only, whatever they were, so that there is one compiled version and
only the rows of the window are touched.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled
from weather_aug.clip.types import FAR_DEPTH_M, Frame, Window
from weather_aug.errors import ArgumentError
from weather_aug.taxonomy import IGNORE, SKY

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]


class Surface(NamedTuple):
    """A whole picture, flat: pixel (y, x) is at y * width + x."""

    image: UInt8
    """(N, 3) sRGB of the picture, or of a window of it."""
    image_window: Window
    """Which window."""
    half: NDArray[np.uint16]
    """(N,) bits of float16 depth, or (0,)."""
    single: Float32
    """(N,) float32 depth, or (0,)."""
    label: UInt8
    """(N,) train ids, or (0,) where nobody labelled."""
    width: int
    """Of the picture, pixels."""


def surface_of(frame: Frame) -> Surface:
    """A frame's picture, depth and label for kernels; nothing is copied that need not be."""
    height, width = frame.image.shape[:2]
    depth = np.asarray(frame.depth_m)
    half, single = np.empty(0, np.uint16), np.empty(0, np.float32)
    if depth.dtype == np.float16:
        half = np.ascontiguousarray(depth).view(np.uint16)
    else:
        single = np.ascontiguousarray(depth, np.float32)
    label = np.empty(0, np.uint8) if frame.label is None else frame.label
    return Surface(
        _flat(frame.image, 3),
        (0, 0, height, width),
        _flat(half),
        _flat(single),
        _flat(label),
        width,
    )


def checked_window(window: Window | None, height: int, width: int) -> Window:
    """`window` as integers, or the whole picture; refuse one that leaves the picture."""
    if window is None:
        return (0, 0, height, width)
    try:
        top, left, rows, columns = (v.__index__() for v in window)
    except (AttributeError, TypeError, ValueError):
        raise ArgumentError(
            f"window must be four integers (top, left, height, width), got {window!r}"
        ) from None
    if not (0 <= top and 0 <= left and rows > 0 and columns > 0):
        raise ArgumentError(f"window {window} must be (top >= 0, left >= 0, height > 0, width > 0)")
    if top + rows > height or left + columns > width:
        raise ArgumentError(f"window {window} leaves the picture of {height}x{width} pixels")
    return (top, left, rows, columns)


def repainted(surface: Surface, image: UInt8, window: Window) -> Surface:
    """The same surface with another picture (H, W, 3) of one window of it."""
    return surface._replace(image=_flat(image, 3), image_window=window)


def depth_of(surface: Surface, window: Window) -> Float32:
    """Depth (H, W) of a window, metres, `inf` for far, unknown and labelled sky."""
    out = np.empty(window[2:], np.float32)
    _fill_depth(surface, window, out.view(np.int32), out)
    return out


def kinds_of(surface: Surface, window: Window) -> UInt8:
    """Train ids (H, W) of a window; of an unlabelled one, SKY where depth is endless, else 255."""
    out = np.empty(window[2:], np.uint8)
    depth = np.empty(window[3], np.float32)
    _fill_kinds(surface, window, depth.view(np.int32), depth, out)
    return out


@compiled
def _fill_kinds(surface, window, bits, depth, out):
    top, left, height, width = window
    labelled = surface.label.shape[0] > 0
    for y in range(height):
        if labelled:
            start = (top + y) * surface.width + left
            for x in range(width):
                out[y, x] = surface.label[start + x]
            continue
        depth_row(surface, top + y, left, bits, depth)
        sky_row(surface, top + y, left, depth, out[y])
        for x in range(width):
            out[y, x] = np.uint8(SKY) if out[y, x] != np.uint8(0) else np.uint8(IGNORE)


@compiled
def _fill_depth(surface, window, bits, out):
    top, left, height, _ = window
    for y in range(height):
        depth_row(surface, top + y, left, bits[y], out[y])


@compiled
def depth_row(surface, y, left, bits, out):
    """Depth of picture row y from column `left`, far and unknown as `inf`; (W,).

    `bits` is the int32 view of `out`. A label of sky outranks a measured depth: sensors see leaves
    and wires before it.
    """
    far, infinite = np.float32(FAR_DEPTH_M), np.float32(np.inf)
    width = out.shape[0]
    start = y * surface.width + left
    if surface.half.shape[0] > 0:
        half = surface.half[start : start + width]
        for x in range(width):
            word = np.int32(half[x])
            # Exponent and mantissa at their float32 places; the exponent's bias is repaired below.
            # Negative numbers lose their sign and become 0, which means unknown.
            wide = (word & np.int32(0x7FFF)) << np.int32(13)
            bits[x] = wide if word < np.int32(0x8000) else np.int32(0)
        for x in range(width):
            out[x] = out[x] * np.float32(2.0**112)
    else:
        single = surface.single[start : start + width]
        for x in range(width):
            out[x] = single[x]
    for x in range(width):
        z = out[x]
        out[x] = z if (z > np.float32(0.0)) & (z < far) else infinite
    if surface.label.shape[0] > 0:
        label = surface.label[start : start + width]
        for x in range(width):
            out[x] = out[x] if label[x] != np.uint8(SKY) else infinite


@compiled
def sky_row(surface, y, left, depth, out):
    """Where picture row y from column `left` is sky; (W,) uint8.

    By its label, and where nobody labelled by its endless `depth` (W,).
    """
    width = out.shape[0]
    if surface.label.shape[0] == 0:
        for x in range(width):
            out[x] = np.uint8(depth[x] == np.float32(np.inf))
        return
    start = y * surface.width + left
    label = surface.label[start : start + width]
    for x in range(width):
        out[x] = np.uint8(label[x] == np.uint8(SKY))


@compiled
def light_row(surface, y, left, linear, red, green, blue):
    """Light of picture row y from column `left` by the table `linear`; (W,) each."""
    top_, left_, _, stride = surface.image_window
    start = (y - top_) * stride + left - left_
    image = surface.image[start : start + red.shape[0]]
    for x in range(red.shape[0]):
        red[x] = linear[image[x, 0]]
        green[x] = linear[image[x, 1]]
        blue[x] = linear[image[x, 2]]


def _flat(array: NDArray[Any], channels: int = 0) -> Any:
    """A read-only (N,) or (N, channels) view of `array`, of a copy if it is not contiguous."""
    return shared(array).reshape((-1, channels) if channels else (-1,))


def shared(array: NDArray[Any]) -> Any:
    """A contiguous view that nobody can write, of a plain array, of a copy if it is none.

    Kernels are compiled once for what may be written and once for what may not, so they get these.
    """
    view = np.ascontiguousarray(array).view(np.ndarray)[...]
    view.flags.writeable = False
    return view
