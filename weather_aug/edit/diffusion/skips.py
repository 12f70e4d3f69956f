"""The VAE in two halves that share their activations, as in CycleGAN-Turbo.

A latent of an eighth of the picture's side loses thin poles and lettering. The encoder's activation
before each of its blocks is added, through a 1x1 convolution that is zero at first, to the
decoder's before the block of the same resolution.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import nn
from torch.utils.checkpoint import checkpoint

from weather_aug.edit.diffusion.conditioning import LabelStem


class Encoded(NamedTuple):
    """A picture as the VAE sees it."""

    latent: torch.Tensor
    """(B, 4, H/8, W/8), scaled as the UNet wants it; the mean, not a draw."""
    skips: tuple[torch.Tensor, ...]
    """Activations before each block of the encoder, from the coarsest on."""


class Skips(nn.ModuleList):
    """One 1x1 convolution for each block of the decoder, zero at first."""

    def __init__(self, vae: Any) -> None:
        encoder, decoder = vae.encoder, vae.decoder
        widths = [encoder.conv_in.out_channels]
        widths += [block.resnets[-1].out_channels for block in encoder.down_blocks[:-1]]
        convs = [
            nn.Conv2d(width, block.resnets[0].in_channels, kernel_size=1, bias=False)
            for width, block in zip(reversed(widths), decoder.up_blocks, strict=True)
        ]
        for conv in convs:
            nn.init.zeros_(conv.weight)
        super().__init__(convs)


def encode(
    vae: Any,
    image: torch.Tensor,
    label: torch.Tensor | None = None,
    stem: LabelStem | None = None,
    *,
    checkpointing: bool = False,
) -> Encoded:
    """The latent of pictures, with their labels where a stem is given both.

    Args:
        vae: AutoencoderKL.
        image: (B, 3, H, W) in [-1, 1]; sides are multiples of the VAE's factor.
        label: (B, H, W) train ids.
        stem: The label's way in.
        checkpointing: Keep no activations inside blocks for the gradient.
    """
    run = _runner(checkpointing)
    encoder = vae.encoder
    hidden = encoder.conv_in(image)
    if stem is not None and label is not None:
        hidden = hidden + stem(label)
    skips = []
    for block in encoder.down_blocks:
        skips.append(hidden)
        hidden = run(block, hidden)
    hidden = run(encoder.mid_block, hidden)
    hidden = encoder.conv_out(encoder.conv_act(encoder.conv_norm_out(hidden)))
    if vae.quant_conv is not None:
        hidden = vae.quant_conv(hidden)
    mean = hidden.chunk(2, dim=1)[0]
    return Encoded(mean * vae.config.scaling_factor, tuple(reversed(skips)))


def decode(
    vae: Any,
    latent: torch.Tensor,
    skips: Sequence[torch.Tensor] = (),
    convs: Sequence[nn.Module] = (),
    *,
    checkpointing: bool = False,
) -> torch.Tensor:
    """Pictures of latents.

    Args:
        vae: AutoencoderKL.
        latent: (B, 4, h, w), scaled as the UNet gives it.
        skips: Of `encode`; used where `convs` are given.
        convs: Of `Skips`.
        checkpointing: Keep no activations inside blocks for the gradient.

    Returns:
        (B, 3, H, W), in about [-1, 1] and not cut to it.
    """
    run = _runner(checkpointing)
    decoder = vae.decoder
    hidden = latent / vae.config.scaling_factor
    if vae.post_quant_conv is not None:
        hidden = vae.post_quant_conv(hidden)
    hidden = run(decoder.mid_block, decoder.conv_in(hidden))
    for index, block in enumerate(decoder.up_blocks):
        if convs:
            hidden = hidden + convs[index](skips[index])
        hidden = run(block, hidden)
    out: torch.Tensor = decoder.conv_out(decoder.conv_act(decoder.conv_norm_out(hidden)))
    return out


def _runner(checkpointing: bool) -> Callable[[Any, torch.Tensor], torch.Tensor]:
    def run(block: Any, hidden: torch.Tensor) -> torch.Tensor:
        if checkpointing and torch.is_grad_enabled():
            return checkpoint(block, hidden, use_reentrant=False)
        out: torch.Tensor = block(hidden)
        return out

    return run
