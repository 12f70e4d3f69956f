"""Edit-friendly inversion in a few steps, with TurboEdit's shifted noise and pseudo-guidance.

The picture's latent x0 is noised for every step with noise of its own, not along one path; what the
model then misses of the next of these latents is kept (z), and added when the model runs under
another text. With the text unchanged the picture comes back as it was, whatever the guidance.

Source:
    Huberman-Spiegelglas, Kulikov and Michaeli, "An Edit Friendly DDPM Noise Space", CVPR 2024, for
    the inversion. Deutch, Gal, Garibi, Patashnik and Cohen-Or, "TurboEdit: Text-Based Image Editing
    Using Few-Step Diffusion Models", SIGGRAPH Asia 2024, for the shift, the guidance and the bound.
    Numbers (steps 799 to 199, shift 200, weight 1.5, norm 15.5) are those of the authors' program.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from weather_aug.errors import ArgumentError

Predict = Callable[[torch.Tensor, int, torch.Tensor], torch.Tensor]
"""The model: noise (N, C, h, w) in latents (N, C, h, w) at a step, under texts (N, tokens, width).
"""

FIRST_STEP, LAST_STEP = 799, 199
"""Of 1000: the first of five steps is left out, so that the picture is never all noise."""
SHIFT = 200
"""Steps by which the latents' noise is earlier than what the model is told: independent noise makes
the z of a step as strong as the schedule's own some 200 steps later."""
MOST_Z = 15.5 / (4 * 64 * 64) ** 0.5
"""Largest root mean square of the last step's z: the authors' bound on its norm, at 512 pixels."""


@dataclass(frozen=True)
class Schedule:
    """Which steps the model is told, and how much noise the latents really have."""

    steps: tuple[int, ...]
    """Falling, of 1000."""
    noise_steps: tuple[int, ...]
    """The same, earlier by the shift; at 0 and below there is no noise at all."""


def schedule(count: int, shift: int = SHIFT) -> Schedule:
    """Evenly spaced steps.

    Args:
        count: The authors use 3 and 4.
        shift: Steps.

    Raises:
        ArgumentError: If there are fewer than 2 steps, or more than lie in the range.
    """
    if not 2 <= count <= FIRST_STEP - LAST_STEP + 1:
        raise ArgumentError(f"steps must be in 2..{FIRST_STEP - LAST_STEP + 1}, got {count!r}")
    span = FIRST_STEP - LAST_STEP
    steps = tuple(round(FIRST_STEP - span * index / (count - 1)) for index in range(count))
    return Schedule(steps, tuple(step - shift for step in steps))


def noised(
    latent: torch.Tensor, noise: torch.Tensor, plan: Schedule, alpha_bars: torch.Tensor
) -> tuple[torch.Tensor, ...]:
    """The latent with each step's noise, and last the latent itself.

    Args:
        latent: (1, C, h, w).
        noise: (steps, C, h, w) standard normal.
        plan: Its noise steps say how much.
        alpha_bars: (1000,) cumulative products of the training schedule.

    Returns:
        steps + 1 of (1, C, h, w).
    """
    out = []
    for step, one in zip(plan.noise_steps, noise.split(1), strict=True):
        kept = float(alpha_bars[step]) if step > 0 else 1.0
        out.append(kept**0.5 * latent + (1 - kept) ** 0.5 * one)
    return (*out, latent)


def posterior_mean(
    sample: torch.Tensor,
    noise: torch.Tensor,
    step: int,
    following: int | None,
    alpha_bars: torch.Tensor,
) -> torch.Tensor:
    """Where a step of DDPM goes without its own noise (Ho et al. 2020, equation 7).

    Args:
        sample: (N, C, h, w) at `step`.
        noise: What the model predicts in it.
        step: The model's.
        following: The step that it leads to; None is the picture itself.
        alpha_bars: As in `noised`.
    """
    kept = float(alpha_bars[step])
    kept_after = 1.0 if following is None else float(alpha_bars[following])
    clean = (sample - (1 - kept) ** 0.5 * noise) / kept**0.5
    ratio = kept / kept_after
    of_clean = kept_after**0.5 * (1 - ratio) / (1 - kept)
    of_sample = ratio**0.5 * (1 - kept_after) / (1 - kept)
    return of_clean * clean + of_sample * sample


def edited_latent(
    latent: torch.Tensor,
    noise: torch.Tensor,
    predict: Predict,
    texts: tuple[torch.Tensor, torch.Tensor],
    plan: Schedule,
    alpha_bars: torch.Tensor,
    *,
    weight: float,
    most_z: float | None = MOST_Z,
) -> torch.Tensor:
    """The latent of the picture as a second text has it.

    Every step adds three things: the step of the source's inversion; what the edit's trajectory
    already changed under the source's text; and `weight` times what the target's text changes.

    Args:
        latent: (1, C, h, w) of the picture.
        noise: (steps, C, h, w) standard normal, independent for every step.
        predict: The model.
        texts: (1, tokens, width) of the source and of the target.
        plan: Steps.
        alpha_bars: As in `noised`.
        weight: 1 is the plain inversion, more is pseudo-guidance, 0 gives the picture back.
        most_z: Bound on the root mean square of the last step's z, against artefacts; with None the
            picture comes back exactly when both texts are the same.

    Returns:
        (1, C, h, w).
    """
    source, target = texts
    path = noised(latent, noise, plan, alpha_bars)
    embeddings = torch.cat([source, source, target])
    edit = path[0]
    for index, step in enumerate(plan.steps):
        last = index + 1 == len(plan.steps)
        following = None if last else plan.steps[index + 1]
        samples = torch.cat([path[index], edit, edit])
        means = posterior_mean(
            samples, predict(samples, step, embeddings), step, following, alpha_bars
        )
        recorded, kept, wanted = means.split(1)
        z = path[index + 1] - recorded
        if last and most_z is not None:
            z = _bounded(z, most_z)
        edit = z + kept + weight * (wanted - kept)
    return edit


def _bounded(z: torch.Tensor, most: float) -> torch.Tensor:
    size = float(z.square().mean().sqrt())
    return z * (most / size) if size > most else z


def draw(steps: Sequence[int], shape: Sequence[int], generator: torch.Generator) -> torch.Tensor:
    """(steps, *shape) standard normal numbers of a generator on the CPU."""
    return torch.randn(len(steps), *shape, generator=generator)
