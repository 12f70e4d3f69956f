"""Passes over depth and label planes, flattened to (N,). Compiled."""

from __future__ import annotations

import numpy as np

from weather_aug._compiled import compiled
from weather_aug.render.medium import FAR_DEPTH_M


@compiled
def widen_depth(half, out):
    """Turn float16 bits into float32 depth, far and unknown as `inf`; numpy does it slower.

    Args:
        half: (N,) uint16 bits of float16 values.
        out: (N,) int32 view of the float32 output.
    """
    values = out.view(np.float32)
    for i in range(half.shape[0]):
        bits = np.int32(half[i])
        # Exponent and mantissa at their float32 places; the exponent's bias is repaired below.
        out[i] = (bits & np.int32(0x7FFF)) << np.int32(13)
        # Negative numbers lose their sign here, so they become 0, which means unknown.
        out[i] = out[i] if bits < np.int32(0x8000) else np.int32(0)
    for i in range(values.shape[0]):
        z = values[i] * np.float32(2.0**112)
        values[i] = (
            z if (z > np.float32(0.0)) & (z < np.float32(FAR_DEPTH_M)) else np.float32(np.inf)
        )


@compiled
def clean_depth(depth):
    """Set far and unknown depth (NaN, 0, negative) to `inf`, in place; (N,) float32."""
    for i in range(depth.shape[0]):
        z = depth[i]
        depth[i] = (
            z if (z > np.float32(0.0)) & (z < np.float32(FAR_DEPTH_M)) else np.float32(np.inf)
        )


@compiled
def raise_sky(label, sky_id, depth):
    """Set the depth of what is labelled sky to `inf`, in place."""
    for i in range(depth.shape[0]):
        depth[i] = depth[i] if label[i] != sky_id else np.float32(np.inf)


@compiled
def read_labels(label, through, near_distinct, covered, limits, ignore, sky_id, out, invalid):
    """Labels and invalid mask by the rules of `weather_aug.render.label`; all arrays are (N,).

    Args:
        label: uint8 train ids.
        through: float32 transmittance.
        near_distinct: uint8, 1 where something distinct is near.
        covered: uint8.
        limits: Transmittances below which a surface is hazy, doubtful, hidden.
        ignore: Id of what cannot be seen.
        sky_id: Id of the sky.
        out: uint8 out.
        invalid: uint8 out.
    """
    hazy, doubtful, hidden = limits
    for i in range(label.shape[0]):
        t = through[i]
        surface = label[i] != sky_id
        unseen = surface & ((t < hidden) | ((t < hazy) & (near_distinct[i] == 0)))
        unseen = unseen | (covered[i] != 0)
        out[i] = ignore if unseen else label[i]
        invalid[i] = np.uint8(1) if unseen | (surface & (t < doubtful)) else np.uint8(0)
