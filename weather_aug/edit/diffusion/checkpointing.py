"""Gradients with less memory: activations are computed again, under the styles they came from."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from torch import nn
from torch.utils.checkpoint import checkpoint

from weather_aug.edit.diffusion.adapted import AdaptedModel


def enable_checkpointing(model: AdaptedModel) -> None:
    """Keep only what goes into the blocks of the VAE and of the UNet; gradients stay the same.

    The UNet's blocks run again during the backward pass, when other styles may act than did
    before: each runs under its own again. Of a blend's weights the last ones chosen count, so
    lower losses of single styles, as `objectives` does.

    Args:
        model: Changed.
    """
    # The library's own function would run a block again under whatever style acts by then.
    model.checkpointing = True
    model.unet.enable_gradient_checkpointing(gradient_checkpointing_func=_styled_checkpoint)


def _styled_checkpoint(block: nn.Module, *inputs: Any) -> Any:
    layers: list[Any] = [layer for layer in block.modules() if hasattr(layer, "lora_A")]
    acting = [layer.active_adapters for layer in layers]

    def run(*inputs: Any) -> Any:
        with _acting(layers, acting):
            return block(*inputs)

    return checkpoint(run, *inputs, use_reentrant=False)


@contextmanager
def _acting(layers: Sequence[Any], names: Sequence[list[str]]) -> Iterator[None]:
    before = [layer.active_adapters for layer in layers]
    _set(layers, names)
    try:
        yield
    finally:
        _set(layers, before)


def _set(layers: Sequence[Any], names: Sequence[list[str]]) -> None:
    for layer, active in zip(layers, names, strict=True):
        # peft's set_adapter would also freeze the other sets, in the middle of a backward pass.
        layer._active_adapter = list(active)
