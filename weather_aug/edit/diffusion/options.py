"""Choices of the diffusion editor that are no weights: attention, sizes, what is left out."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from weather_aug._checks import finite
from weather_aug.errors import ArgumentError, printable

SD_TURBO = "stabilityai/sd-turbo"
ABLATIONS = ("labels", "view", "temporal")
"""What the editor can be asked to do without: label conditioning, and either reference of its
attention."""


@dataclass(frozen=True)
class AttentionWeights:
    """Shares of each reference in Temporal-View attention.

    The output of an attention layer is `itself * Self + view * View + before * Before + after *
    After`, where the others have the same queries and keys and values from another picture.

    Raises:
        ArgumentError: If a weight is not finite and in [0, 2], or all are 0.
    """

    itself: float
    view: float
    before: float
    after: float

    def __post_init__(self) -> None:
        weights = (self.itself, self.view, self.before, self.after)
        for name, value in zip(("itself", "view", "before", "after"), weights, strict=True):
            finite(name, value, 0, 2)
        if not math.fsum(weights) > 0:
            raise ArgumentError("attention weights are all 0; give at least one")


def paper_weights(blend: float = 0.6) -> AttentionWeights:
    """Weights of WeatherEdit's equation: blend * Self + (1 - blend) * (View + Temporal).

    They sum to 2 - blend, not to 1: with 0.6 every layer's output is 40 % too large. The temporal
    term is the mean of both neighbours.
    """
    rest = 1 - finite("blend", blend, 0, 1)
    return AttentionWeights(blend, rest, rest / 2, rest / 2)


RELEASE_WEIGHTS = AttentionWeights(0.60, 0.28, 0.06, 0.06)
"""Weights of WeatherEdit's released code: convex, 0.6 itself and of the rest 0.7 for the view."""
SELF_ONLY = AttentionWeights(1.0, 0.0, 0.0, 0.0)
"""Stock self-attention."""


@dataclass(frozen=True)
class DiffusionOptions:
    """How a diffusion editor is loaded and run.

    Raises:
        ArgumentError: If a choice is none.
    """

    base: str = SD_TURBO
    """Folder of a model in the diffusers layout, or the id of one that is in the local cache."""
    adapter: Path | None = None
    """Folder that `weather-aug train-editor` wrote; needed."""
    attention: AttentionWeights = RELEASE_WEIGHTS
    without: tuple[str, ...] = ()
    """Ablations, of `ABLATIONS`."""
    height: int | None = None
    """Rows at which pictures are edited, their aspect kept; None for their own."""
    device: str = "cpu"
    """Of torch."""
    half: bool = False
    """float16 for the networks, on CUDA only."""
    other_base: bool = False
    """Take a base with other weights than the adapter was trained on, of the same shape."""

    def __post_init__(self) -> None:
        for name in self.without:
            if name not in ABLATIONS:
                raise ArgumentError(
                    f"without: {printable(name)!r} is not one of {', '.join(ABLATIONS)}"
                )
        if self.height is not None and not 8 <= self.height <= 8192:
            raise ArgumentError(f"height must be in 8..8192 pixels or None, got {self.height!r}")
        if self.half and not self.device.startswith("cuda"):
            raise ArgumentError("half=True needs a CUDA device; leave it out on a CPU")
