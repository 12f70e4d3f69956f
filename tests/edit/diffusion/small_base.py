"""A small SD-Turbo-shaped base for tests of the diffusion editor, and pictures for it."""

from __future__ import annotations

from pathlib import Path

import torch

from weather_aug.edit.diffusion.adapted import AdaptedModel
from weather_aug.edit.diffusion.base import load_base
from weather_aug.edit.diffusion.spec import AdapterSpec


def adapted(folder: Path, spec: AdapterSpec | None = None, seed: int = 0) -> AdaptedModel:
    """An untrained adapter on the base of a folder."""
    return AdaptedModel(load_base(str(folder)), spec or AdapterSpec(unet_rank=2), seed=seed)


def perturbed(model: AdaptedModel, seed: int) -> AdaptedModel:
    """The same model with every trained tensor moved away from zero."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in model.trained().values():
            parameter.add_(torch.randn(parameter.shape, generator=generator), alpha=0.05)
    return model


def pictures(
    count: int = 1, height: int = 32, width: int = 48
) -> tuple[torch.Tensor, torch.Tensor]:
    """(count, 3, height, width) in [-1, 1] and labels."""
    generator = torch.Generator().manual_seed(11)
    image = torch.rand(count, 3, height, width, generator=generator) * 2 - 1
    label = torch.randint(0, 19, (count, height, width), generator=generator)
    return image, label
