"""Gradients with less memory: activations are computed again, under the styles they came from."""

from __future__ import annotations

from typing import Any

from torch.utils.checkpoint import checkpoint

from weather_aug.edit.diffusion.adapted import AdaptedModel


def enable_checkpointing(model: AdaptedModel) -> None:
    """Keep only what goes into the blocks of the VAE and of the UNet; gradients stay the same.

    The library's own way would run a block again under whatever style acts by the backward pass,
    which in a cycle is another.

    Args:
        model: Changed.
    """

    def styled_checkpoint(block: Any, *inputs: Any) -> Any:
        acting = model.acting

        def run(*inputs: Any) -> Any:
            with model.styled(acting):
                return block(*inputs)

        return checkpoint(run, *inputs, use_reentrant=False)

    model.checkpointing = True
    model.unet.enable_gradient_checkpointing(gradient_checkpointing_func=styled_checkpoint)
