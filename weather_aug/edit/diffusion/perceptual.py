"""How far apart two pictures are as a network sees them, with a network that is there anyway.

LPIPS compares activations of a VGG that has to be fetched; the base model's own VAE encoder is on
the machine whenever anything is trained, and what it was trained for is to keep what a picture
shows. LPIPS itself can be chosen where its package and weights are installed.
"""

from __future__ import annotations

import copy
import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from torch import nn
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

from weather_aug.errors import ArgumentError, DataError, MissingExtraError, printable

Perceptual = Literal["vae", "lpips", "none"]

PerceptualDistance = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
"""Of (B, 3, H, W) pictures in [-1, 1] and their references: (B,), 0 for equal pictures. Gradients
reach the pictures, not the references."""

VGG_FILE = "vgg16-397923af.pth"
"""Weights that lpips builds on, as torchvision names them in torch's cache."""
VGG_URL = f"https://download.pytorch.org/models/{VGG_FILE}"
_SMALL = 1e-6
"""An activation vector that is no longer than this has no direction."""


def perceptual_distance(
    kind: Perceptual, vae: Any, *, checkpointing: bool = False
) -> PerceptualDistance | None:
    """The distance of a name.

    Args:
        kind: "vae" for `VaeFeatures`, "lpips" for `Lpips`, "none" for None.
        vae: AutoencoderKL of the base; an adapter in it is left out.
        checkpointing: See `VaeFeatures`.

    Raises:
        ArgumentError: If the name is none.
        MissingExtraError: If lpips is not installed.
        DataError: If its weights are not on this machine.
    """
    if kind not in get_args(Perceptual):
        raise ArgumentError(
            f"perceptual {printable(kind)!r} is not one of {', '.join(get_args(Perceptual))}"
        )
    if kind == "none":
        return None
    return Lpips() if kind == "lpips" else VaeFeatures(vae, checkpointing=checkpointing)


class BaseEncoder(nn.Module):
    """The base's encoder without the adapter that was added to it, for `skips.encode`.

    Convention:
        Its layers are its own, their weights are the base's very tensors: it takes no memory,
        follows them to another device, and asking it changes nothing in the adapted model.

    Args:
        vae: AutoencoderKL, with an adapter or without.
    """

    def __init__(self, vae: Any) -> None:
        super().__init__()
        self.encoder = _without_adapter(vae.encoder)
        self.quant_conv = None if vae.quant_conv is None else _without_adapter(vae.quant_conv)
        self.config = vae.config


class VaeFeatures(nn.Module):
    """Distance of the activations of the base's VAE encoder, before each of its blocks.

    At every pixel of every activation the vectors over the channels are made unit vectors u, v;
    the distance is |u - v|^2, averaged over pixels, then over the activations: in [0, 4]. That is
    LPIPS (Zhang et al., "The Unreasonable Effectiveness of Deep Features", 2018) without weights
    of channels.

    Args:
        vae: AutoencoderKL; an adapter in it is left out. Costs no memory of its own.
        checkpointing: Compute activations again for the gradient instead of keeping them.
    """

    def __init__(self, vae: Any, *, checkpointing: bool = False) -> None:
        super().__init__()
        self.base = BaseEncoder(vae)
        self.checkpointing = checkpointing

    def forward(self, image: torch.Tensor, reference: torch.Tensor) -> torch.Tensor:
        """See `PerceptualDistance`; sides are multiples of the VAE's factor."""
        with torch.no_grad():
            wanted = self.activations(reference)
        pairs = zip(self.activations(image), wanted, strict=True)
        return torch.stack([_apart(ours, theirs) for ours, theirs in pairs]).mean(0)

    def activations(self, image: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """(B, C, h, w) before each block, from the finest on; the last is before the middle."""
        encoder = self.base.encoder
        hidden = encoder.conv_in(image)
        found = [hidden]
        for block in encoder.down_blocks:
            if self.checkpointing and torch.is_grad_enabled():
                hidden = checkpoint(block, hidden, use_reentrant=False)
            else:
                hidden = block(hidden)
            found.append(hidden)
        return tuple(found)


class Lpips(nn.Module):
    """LPIPS with VGG-16, as the release trains with, of the package lpips.

    Raises:
        MissingExtraError: If the package is not installed.
        DataError: If the weights of its VGG are not in torch's cache; they are never fetched here.
    """

    def __init__(self) -> None:
        super().__init__()
        try:
            lpips = importlib.import_module("lpips")
        except ImportError as error:
            raise MissingExtraError(
                "lpips is needed to compare pictures by LPIPS; install it with: pip install lpips, "
                "or choose perceptual 'vae', which needs nothing"
            ) from error
        path = Path(torch.hub.get_dir()) / "checkpoints" / VGG_FILE
        if not path.is_file():
            raise DataError(
                "the VGG-16 that lpips builds on (licence: BSD-3-Clause) is not on this machine; "
                f"fetch it with `curl --create-dirs -o {printable(path, 200)} {VGG_URL}`, or "
                "choose perceptual 'vae', which needs nothing"
            )
        self.net = lpips.LPIPS(net="vgg", verbose=False).eval().requires_grad_(False)

    def forward(self, image: torch.Tensor, reference: torch.Tensor) -> torch.Tensor:
        """See `PerceptualDistance`."""
        out: torch.Tensor = self.net(image, reference.detach()).flatten()
        return out


def _apart(ours: torch.Tensor, theirs: torch.Tensor) -> torch.Tensor:
    """(B,) mean squared distance of (B, C, h, w) unit vectors."""
    u, v = (functional.normalize(part.float(), dim=1, eps=_SMALL) for part in (ours, theirs))
    return (u - v).square().sum(1).mean((1, 2))


def _without_adapter(module: Any) -> Any:
    """The same layers over the same weights, each adapted one replaced by what it adapts."""
    memo: dict[int, Any] = {id(t): t for t in (*module.parameters(), *module.buffers())}
    for layer in module.modules():
        if hasattr(layer, "base_layer"):
            memo[id(layer)] = copy.deepcopy(layer.base_layer, memo)
    return copy.deepcopy(module, memo)
