"""How much a loss should count a pixel: an alternative to ignoring what is hard to see."""

from __future__ import annotations

from typing import Any

from weather_aug.render.label import LEAST_TRANSMITTANCE

WHOLE_TRANSMITTANCE = 0.1
"""From so much of a surface's light on, its pixel counts like any other."""


def loss_weight_of(transmittance: Any, invalid: Any, sky: Any, lost: Any | None) -> Any:
    """Weights in [0, 1] of the transmittance's type and shape: clip((T - 0.02) / 0.08, 0, 1).

    The sky has no surface whose light could be lost: it counts whole wherever it is valid, or
    training on fog would forget it. What the weather turned into ignore counts nothing.

    Args:
        transmittance: (..., H, W) float32 in [0, 1], an array or a torch tensor, as all others.
        invalid: (..., H, W), not 0 where a pixel is unreadable.
        sky: (..., H, W) bool, where the clear picture shows the sky.
        lost: (..., H, W) bool, where the weather turned a label into ignore; None where nobody
            labelled: then every invalid pixel counts nothing.

    Source:
        docs/physics.md, labels: a soft form of the 2 % below which a surface cannot be named.
    """
    span = WHOLE_TRANSMITTANCE - LEAST_TRANSMITTANCE
    weight = ((transmittance - LEAST_TRANSMITTANCE) / span).clip(0.0, 1.0)
    readable = invalid == 0
    weight[sky & readable] = 1.0
    weight[~readable if lost is None else lost] = 0.0
    return weight
