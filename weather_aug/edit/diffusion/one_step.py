"""One step from a clear latent to the weather's: SD-Turbo at its last time step.

The clean latent goes to the network as if it were pure noise, at t = 999, and the step's estimate
of the noise-free latent is the edited picture (Parmar et al., "One-Step Image Translation with
Text-to-Image Models", 2024).
"""

from __future__ import annotations

import torch

LAST_STEP = 999


def latent_of_noise(latent: torch.Tensor, noise: torch.Tensor, alpha_bar: float) -> torch.Tensor:
    """The noise-free latent that a prediction of the noise means: (z - sqrt(1-a) e) / sqrt(a)."""
    return (latent - (1 - alpha_bar) ** 0.5 * noise) / alpha_bar**0.5


def noise_of_latent(latent: torch.Tensor, target: torch.Tensor, alpha_bar: float) -> torch.Tensor:
    """The prediction that would lead from `latent` to `target`; the inverse of the above."""
    return (latent - alpha_bar**0.5 * target) / (1 - alpha_bar) ** 0.5
