"""What an adapter is made of: styles, prompts, ranks, targets, how it hears of labels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from types import MappingProxyType
from typing import Any, Literal, get_args

from weather_aug.errors import ArgumentError, DataError, printable

Conditioning = Literal["groups", "embedding", "gray", "none"]

CLEAR = "clear"
"""The style of the pictures that are edited; where an adapter knows it, blends fade to it."""

PROMPTS: Mapping[str, str] = MappingProxyType(
    {
        "rain": "Picture of a rainy weather scene",
        "snow": "Picture of a snowy weather scene",
        "fog": "Picture of a foggy weather scene",
        CLEAR: "Picture of a normal weather scene",
    }
)
"""Of WeatherEdit."""

UNET_TARGETS = (
    *("to_q", "to_k", "to_v", "to_out.0", "conv1", "conv2", "conv_shortcut", "conv_out"),
    *("proj_in", "proj_out", "ff.net.0.proj", "ff.net.2"),
)
"""Layers of the UNet with a low-rank set for each style, as in CycleGAN-Turbo; `conv_in` is trained
in full instead."""
VAE_TARGETS = (
    *("conv_in", "conv1", "conv2", "conv_shortcut", "conv", "conv_out"),
    *("to_q", "to_k", "to_v", "to_out.0"),
)
"""Layers of the VAE with a low-rank set that all styles share."""

MOST_RANK = 1024
MOST_PROMPT = 300


@dataclass(frozen=True)
class AdapterSpec:
    """The parts of an adapter; with a base model it tells every tensor's name and shape.

    Convention:
        A layer computes `h = W0 x + sum_i w_i L_i x`: W0 is the base's and never changes, L_i is
        the low-rank set of style i, its weight w_i is chosen at each call. The VAE's set, the
        skips, the label's convolution and the UNet's first convolution are shared by all styles.
        Everything is zero at first, so an untrained adapter is the base model.

    Raises:
        ArgumentError: If a choice is none.
    """

    prompts: Mapping[str, str] = field(default_factory=lambda: dict(PROMPTS))
    """By style, whose names are its keys; "clear" among them if the adapter can return pictures as
    they are."""
    unet_rank: int = 128
    vae_rank: int = 4
    vae_scale: float = 2.0
    """Of the VAE's low-rank set: alpha over rank."""
    unet_targets: tuple[str, ...] = UNET_TARGETS
    vae_targets: tuple[str, ...] = VAE_TARGETS
    conditioning: Conditioning = "groups"
    """How the label enters the VAE's encoder; see `conditioning.LabelStem`."""
    skips: bool = True
    """Whether the decoder sees the encoder's activations, through a 1x1 convolution each."""

    def __post_init__(self) -> None:
        if not self.prompts:
            raise ArgumentError("an adapter needs at least one style with its prompt")
        for style, prompt in self.prompts.items():
            if not (isinstance(style, str) and style.isidentifier() and len(style) <= 32):
                raise ArgumentError(f"style {printable(style)!r} must be a short plain word")
            if not isinstance(prompt, str) or not 0 < len(prompt) <= MOST_PROMPT:
                raise ArgumentError(f"the prompt of {style} must have 1..{MOST_PROMPT} characters")
        object.__setattr__(self, "prompts", dict(self.prompts))
        for name in ("unet_rank", "vae_rank"):
            rank = getattr(self, name)
            if isinstance(rank, bool) or not isinstance(rank, int) or not 1 <= rank <= MOST_RANK:
                raise ArgumentError(f"{name} must be in 1..{MOST_RANK}, got {printable(rank)}")
        if not isinstance(self.vae_scale, float | int) or not 0 < self.vae_scale <= 100:
            raise ArgumentError(f"vae_scale must be in (0, 100], got {printable(self.vae_scale)}")
        if self.conditioning not in get_args(Conditioning):
            raise ArgumentError(
                f"conditioning {printable(self.conditioning)!r} is not one of "
                f"{', '.join(get_args(Conditioning))}"
            )
        for name in ("unet_targets", "vae_targets"):
            targets = getattr(self, name)
            if not targets or not all(isinstance(t, str) and 0 < len(t) <= 64 for t in targets):
                raise ArgumentError(f"{name} must name layers, got {printable(targets)}")
        if "conv_in" in self.unet_targets:
            raise ArgumentError(
                "unet_targets names conv_in, which is trained in full; leave it out"
            )

    @property
    def styles(self) -> tuple[str, ...]:
        """Names of the low-rank sets."""
        return tuple(self.prompts)

    def as_json(self) -> dict[str, Any]:
        """JSON values, read back by `parse_spec`."""
        values = asdict(self)
        return values | {name: list(values[name]) for name in ("unet_targets", "vae_targets")}


def parse_spec(value: Any) -> AdapterSpec:
    """The spec of these JSON values.

    Raises:
        DataError: If they are none.
    """
    try:
        values: dict[str, Any] = dict(value)
        for name in ("unet_targets", "vae_targets"):
            values[name] = tuple(values[name])
        return AdapterSpec(**values)
    except (TypeError, ValueError, KeyError, AttributeError) as error:
        raise DataError(f"no description of an adapter: {printable(error, 200)}") from None
