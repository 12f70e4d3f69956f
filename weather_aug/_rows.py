"""Arithmetic of whole rows of pixels that the editor and the renderer share. Compiled."""

from __future__ import annotations

from typing import Any

import numpy as np

from weather_aug._compiled import compiled, inlined


@compiled
def survival(optical_depth):
    """exp(-x) for x in [-16, 80] to 2e-5, in operations that give equal bits on every machine."""
    x = optical_depth * np.float32(-0.015625)
    one = np.float32(1.0)
    p = one + x * np.float32(1.0 / 6.0)
    p = one + x * np.float32(0.2) * p
    p = one + x * np.float32(0.25) * p
    p = one + x * np.float32(1.0 / 3.0) * p
    p = one + x * np.float32(0.5) * p
    p = one + x * p
    p = p * p
    p = p * p
    p = p * p
    p = p * p
    p = p * p
    return p * p


@inlined
def encoded(v):
    """The sRGB level, not rounded, of linear light in [0, 1], to 0.1 of a level.

    A polynomial in the square root on the power branch (largest error 0.083 levels), the exact
    line below it; every 8-bit level survives decoding and encoding.
    """
    s = np.sqrt(v)
    p = np.float32(-1.6236571) + s * np.float32(0.5173023)
    p = np.float32(2.0315735) + s * p
    p = np.float32(-1.4027363) + s * p
    p = np.float32(1.5179509) + s * p
    p = np.float32(-0.0401096) + s * p
    p = p if v > np.float32(0.0031308) else np.float32(12.92) * v
    return p * np.float32(255.0)


@compiled
def encode_row(light, out):
    """Turn linear light into sRGB levels, rounded."""
    zero, one = np.float32(0.0), np.float32(1.0)
    for x in range(light.shape[0]):
        v = light[x]
        v = v if v > zero else zero
        v = v if v < one else one
        out[x] = np.uint8(np.int32(encoded(v) + np.float32(0.5)))


@compiled
def apart_row(pixels, red, green, blue):
    """Colours of a row (W, 3) into rows that may be longer."""
    for x in range(pixels.shape[0]):
        red[x] = pixels[x, 0]
        green[x] = pixels[x, 1]
        blue[x] = pixels[x, 2]


@compiled
def together_row(red, green, blue, out):
    """The inverse of `apart_row`."""
    for x in range(out.shape[0]):
        out[x, 0] = red[x]
        out[x, 1] = green[x]
        out[x, 2] = blue[x]


def halves(values: Any) -> Any:
    """float16 of finite float32 `values`, rounded as numpy does, several times as fast.

    What float16 cannot hold becomes its largest number, and what it holds with fewer digits (below
    6e-5) becomes 0.
    """
    values = np.ascontiguousarray(values, np.float32)
    out = np.empty(values.shape, np.uint16)
    _halve(values.reshape(-1).view(np.int32), out.reshape(-1))
    return out.view(np.float16)


@compiled
def _halve(bits, out):
    """The exponent's bias moves by 112; then the mantissa is cut, ties to even."""
    least, largest = np.int32(0x38800000), np.int32(0x477FE000)
    for i in range(bits.shape[0]):
        size = bits[i] & np.int32(0x7FFFFFFF)
        word = min(size, largest) - np.int32(0x38000000)
        word = (word + np.int32(0xFFF) + ((word >> np.int32(13)) & np.int32(1))) >> np.int32(13)
        word = word if size >= least else np.int32(0)
        sign = (bits[i] >> np.int32(16)) & np.int32(0x8000)
        out[i] = np.uint16(word | sign)
