"""What a training lowers: for aligned pairs, for the paper's noise, for pictures of other places.

Convention:
    A batch is a mapping: `source` and `target` (B, 3, H, W) in [-1, 1], a clear picture and one in
    the weather; `source_label` and `target_label` (B, H, W) long train ids, 255 where unknown;
    `style`, one for the batch; `aligned`, whether both show one place pixel by pixel. A picture
    goes with its own label; an edited one shows what it showed, so it keeps its label.

    A loss function returns terms without weights, each a mean over the batch, by the names of the
    fields of its weights; a term of weight 0 is not computed. `weighted_sum` is what to lower.
    Nothing draws from a stream of torch's own.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch.nn import functional

from weather_aug._checks import finite
from weather_aug.edit.diffusion.adapted import AdaptedModel
from weather_aug.edit.diffusion.discriminator import (
    Discriminators,
    discriminator_loss,
    generator_loss,
    judged,
)
from weather_aug.edit.diffusion.one_step import noise_of_latent
from weather_aug.edit.diffusion.perceptual import BaseEncoder, PerceptualDistance
from weather_aug.edit.diffusion.skips import encode
from weather_aug.edit.diffusion.spec import CLEAR
from weather_aug.errors import ArgumentError, printable

# Of each model one: making it costs as much as a small picture's encoding.
_BASE_ENCODERS: WeakKeyDictionary[AdaptedModel, BaseEncoder] = WeakKeyDictionary()

Batch = Mapping[str, Any]
Losses = dict[str, torch.Tensor]


@dataclass(frozen=True)
class _Weights:
    def __post_init__(self) -> None:
        values = [finite(field.name, getattr(self, field.name), 0) for field in fields(self)]
        if not any(values):
            raise ArgumentError("every weight is 0, so there is nothing to lower")


@dataclass(frozen=True)
class PairedWeights(_Weights):
    """Of the terms of `paired_losses`.

    Raises:
        ArgumentError: If one is negative or all are 0.
    """

    epsilon: float = 1.0
    """Of the squared error of the noise, in units of the latent."""
    l1: float = 1.0
    """Of the mean absolute error of the picture in [-1, 1]."""
    perceptual: float = 5.0
    """Of the perceptual distance; 5 times the picture's, as in pix2pix-Turbo."""


@dataclass(frozen=True)
class EpsilonWeights(_Weights):
    """Of the terms of `epsilon_losses`.

    Raises:
        ArgumentError: If one is negative or all are 0.
    """

    epsilon: float = 1.0
    """Of the squared error of the noise: the paper's objective, alone."""
    latent: float = 0.0
    """Of the squared distance of E(target, M) from the base's latent of the target."""


@dataclass(frozen=True)
class CycleWeights(_Weights):
    """Of the terms of `generator_losses`; the release's.

    Raises:
        ArgumentError: If one is negative or all are 0.
    """

    cycle_l1: float = 1.0
    """Of a picture's mean absolute error after the way there and back."""
    cycle_perceptual: float = 10.0
    """Of its perceptual distance."""
    identity_l1: float = 1.0
    """Of a picture's mean absolute error after an edit into what it shows already."""
    identity_perceptual: float = 1.0
    """Of its perceptual distance."""
    adversarial: float = 0.5
    """Of not passing for a picture of the style."""


def weighted_sum(losses: Losses, weights: _Weights) -> torch.Tensor:
    """The scalar to lower: every term times its weight."""
    terms = [getattr(weights, name) * loss for name, loss in losses.items()]
    return torch.stack(terms).sum()


def paired_losses(
    model: AdaptedModel,
    batch: Batch,
    weights: PairedWeights,
    perceptual: PerceptualDistance | None = None,
    generator: torch.Generator | None = None,
) -> Losses:
    """One step at t = 999 from the source against the target that lies under it.

    With z = E(source, M), a = alpha_bar at 999 and z* = the base's latent of the target, the noise
    that leads to z* is e* = (z - sqrt(a) z*) / sqrt(1-a). "epsilon" is (1-a)/a * mean |e - e*|^2,
    which is the mean squared error of the latent that the step arrives at, mean |z0 - z*|^2: of
    order 1, where the plain error of the noise would be 1/213 of it for SD-Turbo. e* moves with z,
    so the encoder learns from it too. "l1" and "perceptual" compare the decoded picture, which is
    not cut to [-1, 1]. A batch of the style "clear", whose target is its source, teaches to leave
    a picture as it is.

    Args:
        model: To train.
        batch: Aligned pairs; `target_label` is not looked at.
        weights: Of the terms.
        perceptual: Of `perceptual.perceptual_distance`; needed if its weight is not 0.
        generator: Not used, nothing is drawn; the other objectives have one.

    Returns:
        "epsilon", "l1", "perceptual".

    Raises:
        ArgumentError: If the pairs are not aligned, or there is no perceptual distance.
    """
    if not batch["aligned"]:
        raise ArgumentError(
            "the objective paired needs aligned pairs; train on these with cycle or epsilon"
        )
    perceptual = _given(perceptual, weights.perceptual)
    source, target, style = batch["source"], batch["target"], batch["style"]
    encoded = model.encode(source, batch["source_label"])
    with model.styled(style) as prompt:
        noise = model.noise(encoded.latent, prompt)
    losses: Losses = {}
    if weights.epsilon > 0:
        a = model.base.alpha_bar
        wanted = noise_of_latent(encoded.latent, base_latent(model, target), a)
        losses["epsilon"] = (1 - a) / a * functional.mse_loss(noise.float(), wanted.float())
    if weights.l1 > 0 or perceptual is not None:
        image = model.decode(model.latent_of(encoded.latent, noise), encoded.skips)
        if weights.l1 > 0:
            losses["l1"] = functional.l1_loss(image.float(), target.float())
        if perceptual is not None:
            losses["perceptual"] = perceptual(image, target).mean()
    return losses


def epsilon_losses(
    model: AdaptedModel, batch: Batch, weights: EpsilonWeights, generator: torch.Generator
) -> Losses:
    """The paper's objective: the noise in a latent of the target, under its label and prompt.

    z0 = E(target, M); t uniform in 0..999; e ~ N(0, 1); z_t = sqrt(a_t) z0 + sqrt(1 - a_t) e;
    "epsilon" is mean |e - e_theta(z_t, t, prompt)|^2. M enters through E alone, so gradients go
    through z0 into the encoder; the decoder and the skips get none. An encoder that may move can
    also lower this by making z0 easier to tell from noise, which "latent" holds against:
    mean |z0 - z*|^2 with z* the base's latent of the target.

    Args:
        model: To train.
        batch: `source` and `source_label` are not looked at, so pairs need not be aligned.
        weights: Of the terms.
        generator: On the CPU, whatever the device: t first, then e.

    Returns:
        "epsilon", "latent".
    """
    target, style = batch["target"], batch["style"]
    latent = model.encode(target, batch["target_label"]).latent
    bars = model.base.alpha_bars
    time = torch.randint(len(bars), (len(latent),), generator=generator)
    noise = torch.randn(latent.shape, generator=generator).to(latent)
    bar = bars[time][:, None, None, None]
    noisy = bar.sqrt().to(latent) * latent + (1 - bar).sqrt().to(latent) * noise
    losses: Losses = {}
    if weights.epsilon > 0:
        with model.styled(style) as prompt:
            found = model.noise(noisy, prompt, time.to(latent.device))
        losses["epsilon"] = functional.mse_loss(found.float(), noise.float())
    if weights.latent > 0:
        wanted = base_latent(model, target)
        losses["latent"] = functional.mse_loss(latent.float(), wanted.float())
    return losses


def generator_losses(
    model: AdaptedModel,
    batch: Batch,
    weights: CycleWeights,
    perceptual: PerceptualDistance | None,
    discriminators: Discriminators | None,
    generator: torch.Generator | None = None,
) -> Losses:
    """CycleGAN-Turbo's losses of the model, for pictures of other places.

    The source goes into the style and back to clear, the target to clear and back into the style
    ("cycle_"); the target into the style and the source to clear must stay ("identity_"); what
    either way arrives at must pass for real ("adversarial"). Each term is the sum of both
    directions. CycleGAN-Turbo has a VAE for each direction, here one serves all styles; the UNet's
    direction is the set of the style, "clear" for the way back. Edited pictures are cut to [-1, 1]
    before another network sees them, as in the release.

    Args:
        model: To train; one of its styles is "clear".
        batch: Of any style but "clear"; pairs need not be aligned.
        weights: Of the terms.
        perceptual: Needed if one of its weights is not 0.
        discriminators: Needed if the weight of "adversarial" is not 0; get no gradients.
        generator: Not used, nothing is drawn; the other objectives have one.

    Returns:
        By the names of the weights. Memory is that of six passes; `generator_parts` needs two.

    Raises:
        ArgumentError: If the model has no style "clear", the batch is of it, or a network that a
            weight asks for is missing.
    """
    losses: Losses = {}
    for part in generator_parts(model, batch, weights, perceptual, discriminators, generator):
        for name, loss in part.items():
            losses[name] = losses[name] + loss if name in losses else loss
    return losses


def generator_parts(
    model: AdaptedModel,
    batch: Batch,
    weights: CycleWeights,
    perceptual: PerceptualDistance | None,
    discriminators: Discriminators | None,
    generator: torch.Generator | None = None,
) -> Iterator[Losses]:
    """`generator_losses` in parts that sum to them, one direction of one kind after the other.

    Backward passes of each part before the next is asked for add up to the same gradients, with
    the memory of two passes.
    """
    _check_cycle(model, batch, discriminators)
    if weights.adversarial > 0 and discriminators is None:
        raise ArgumentError(
            f"the weight of adversarial is {weights.adversarial:g}, but there are no "
            "discriminators; give some or set it to 0"
        )
    for there, back, image, label in _directions(batch):
        cycle = _there_and_back(
            model, image, label, (there, back), weights, perceptual, discriminators
        )
        if cycle:
            yield cycle
    if weights.identity_l1 > 0 or weights.identity_perceptual > 0:
        for _, own, image, label in _directions(batch):
            pair = weights.identity_l1, weights.identity_perceptual
            part = _compared("identity", model(image, label, own), image, pair, perceptual)
            yield part


def discriminator_losses(
    model: AdaptedModel,
    batch: Batch,
    discriminators: Discriminators,
    generator: torch.Generator | None = None,
) -> Losses:
    """Of the discriminators of the batch's style and of "clear", which get all the gradients.

    Args:
        model: Edits, without gradients.
        batch: As `generator_losses`.
        discriminators: To train.
        generator: Not used, nothing is drawn.

    Returns:
        "fake" and "real", to be added; each is half the sum of both discriminators', as in the
        release.

    Raises:
        ArgumentError: If the model or the discriminators lack a style, or the batch is of "clear".
    """
    _check_cycle(model, batch, discriminators)
    losses: list[Losses] = []
    reals = {batch["style"]: batch["target"], CLEAR: batch["source"]}
    for there, _, image, label in _directions(batch):
        with torch.no_grad():
            fake = model(image, label, there).clamp(-1, 1)
        judge = discriminators[there]
        losses.append(discriminator_loss(judge(reals[there]), judge(fake)))
    return {name: (losses[0][name] + losses[1][name]) / 2 for name in ("fake", "real")}


def base_latent(model: AdaptedModel, image: torch.Tensor) -> torch.Tensor:
    """(B, 4, h, w) of (B, 3, H, W) by the base's own encoder: no adapter, label or gradient."""
    if model not in _BASE_ENCODERS:
        _BASE_ENCODERS[model] = BaseEncoder(model.vae)
    with torch.no_grad():
        return encode(_BASE_ENCODERS[model], image).latent


def _directions(batch: Batch) -> tuple[tuple[str, str, torch.Tensor, torch.Tensor], ...]:
    """(way there, way back, picture, its label), from the source and from the target.

    The way back is also the style that the picture has.
    """
    style = batch["style"]
    return (
        (style, CLEAR, batch["source"], batch["source_label"]),
        (CLEAR, style, batch["target"], batch["target_label"]),
    )


def _there_and_back(
    model: AdaptedModel,
    image: torch.Tensor,
    label: torch.Tensor,
    ways: tuple[str, str],
    weights: CycleWeights,
    perceptual: PerceptualDistance | None,
    discriminators: Discriminators | None,
) -> Losses:
    there, back = ways
    returns = weights.cycle_l1 > 0 or weights.cycle_perceptual > 0
    if not returns and weights.adversarial == 0:
        return {}
    edited = model(image, label, there).clamp(-1, 1)
    losses: Losses = {}
    if returns:
        losses = _compared(
            "cycle",
            model(edited, label, back),
            image,
            (weights.cycle_l1, weights.cycle_perceptual),
            perceptual,
        )
    if weights.adversarial > 0 and discriminators is not None:
        losses["adversarial"] = generator_loss(judged(discriminators[there], edited))
    return losses


def _compared(
    name: str,
    image: torch.Tensor,
    reference: torch.Tensor,
    weights: tuple[float, float],
    perceptual: PerceptualDistance | None,
) -> Losses:
    """`name`_l1 and `name`_perceptual, those whose weight is not 0."""
    losses: Losses = {}
    if weights[0] > 0:
        losses[f"{name}_l1"] = functional.l1_loss(image.float(), reference.float())
    distance = _given(perceptual, weights[1])
    if distance is not None:
        losses[f"{name}_perceptual"] = distance(image, reference).mean()
    return losses


def _given(perceptual: PerceptualDistance | None, weight: float) -> PerceptualDistance | None:
    if weight == 0:
        return None
    if perceptual is None:
        raise ArgumentError(
            f"a weight of the perceptual distance is {weight:g}, but there is no distance; choose "
            "one or set the weight to 0"
        )
    return perceptual


def _check_cycle(model: AdaptedModel, batch: Batch, discriminators: Discriminators | None) -> None:
    style = batch["style"]
    if style == CLEAR:
        raise ArgumentError('a cycle goes from "clear" to another style and back, got clear')
    known = [set(model.spec.styles)]
    if discriminators is not None:
        known.append(set(discriminators.styles))
    for name in (style, CLEAR):
        if not all(name in styles for styles in known):
            raise ArgumentError(
                f"a cycle needs the style {printable(name)!r}, of the adapter and with a "
                "discriminator; add it or train with paired or epsilon"
            )
