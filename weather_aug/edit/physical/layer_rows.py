"""One row of a frame's layers under the weather's light. Compiled."""

from __future__ import annotations

import numpy as np

from weather_aug._compiled import compiled, inlined
from weather_aug.edit.physical.layers import ILLUMINATION, LUMINANCE_MEAN, ROUGH, SHARP

TABLE_STEPS = 1024
"""Of toned light up to 1, by the square root of light."""
MOST_ROOT = 4
"""The table ends at the square of this: a white surface in the sun is brighter than a picture's
white, because the camera exposes for the whole street."""


@compiled
def load_row(layers, cells, by_root, matrix, look, scratch, out):
    """Copy geometry; take light through the tone; put the weather's sky into what is mirrored.

    Args:
        layers: (20, h, w) uint16, bits of float16.
        cells: (row, first, last) which to load; the latter two unsigned, see `spread_run`.
        by_root: (N,) float32 toned light by the square root of light.
        matrix: (3, 3) float32 colour matrix after the tone.
        look: Weather.
        scratch: (4, w) float32.
        out: (18, w) float32 out.
    """
    _, first, last = cells
    for k in range(SHARP):
        _load(layers, k, cells, out[k])
    for x in range(first, last):
        out[ILLUMINATION, x] = _toned(out[ILLUMINATION, x], by_root)
    for x in range(first, last):
        out[LUMINANCE_MEAN, x] = _toned(out[LUMINANCE_MEAN, x], by_root)
    if look.mirror > np.float32(0.0):
        _mirrored(layers, SHARP, cells, by_root, matrix, look, scratch, SHARP, out)
        _mirrored(layers, ROUGH, cells, by_root, matrix, look, scratch, SHARP + 3, out)


@compiled
def _load(layers, k, cells, out):
    """float16 to float32: exponent and mantissa move, the exponent's bias is repaired by 2^112."""
    row, first, last = cells
    bits = out.view(np.int32)
    for x in range(first, last):
        word = np.int32(layers[k, row, x])
        sign = (word & np.int32(0x8000)) << np.int32(16)
        bits[x] = sign | ((word & np.int32(0x7FFF)) << np.int32(13))
    for x in range(first, last):
        out[x] = out[x] * np.float32(2.0**112)


@compiled
def _mirrored(layers, base, cells, by_root, matrix, look, scratch, slot, out):
    """What three layers of mirrored light and one of mirrored sky are in this weather."""
    _, first, last = cells
    zero, one, least = np.float32(0.0), np.float32(1.0), np.float32(1e-2)
    for k in range(4):
        _load(layers, base + k, cells, scratch[k])
    for k in range(3):
        for x in range(first, last):
            surfaces = max(one - scratch[3, x], zero)
            light = scratch[k, x] / max(surfaces, least)
            scratch[k, x] = surfaces * look.exposure * _toned(light, by_root)
    for k in range(3):
        sky = (look.red, look.green, look.blue)[k]
        for x in range(first, last):
            mixed = matrix[k, 0] * scratch[0, x] + matrix[k, 1] * scratch[1, x]
            out[slot + k, x] = mixed + matrix[k, 2] * scratch[2, x] + scratch[3, x] * sky


@inlined
def _toned(light, by_root):
    last = MOST_ROOT * TABLE_STEPS
    root = np.sqrt(max(light, np.float32(0.0))) * np.float32(TABLE_STEPS)
    root = min(root, np.float32(last))
    step = min(np.int32(root), np.int32(last - 1))
    low = by_root[step]
    return low + (root - np.float32(step)) * (by_root[step + np.int32(1)] - low)
