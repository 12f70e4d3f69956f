"""What learns: an adapter, for cycles discriminators as well, their optimisers, and one step."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any, NamedTuple

import torch
from torch import nn

from weather_aug._extras import require
from weather_aug._keys import key_of
from weather_aug.edit.diffusion.adapted import AdaptedModel
from weather_aug.edit.diffusion.base import Base
from weather_aug.edit.diffusion.checkpointing import enable_checkpointing
from weather_aug.edit.diffusion.discriminator import Discriminators, make_discriminators
from weather_aug.edit.diffusion.objectives import (
    CycleWeights,
    Losses,
    discriminator_losses,
    epsilon_losses,
    generator_parts,
    paired_losses,
    weighted_sum,
)
from weather_aug.edit.diffusion.perceptual import perceptual_distance
from weather_aug.edit.diffusion.spec import CLEAR
from weather_aug.edit.diffusion.train_batches import split
from weather_aug.edit.diffusion.train_options import BETAS, WEIGHT_DECAY, TrainOptions
from weather_aug.edit.diffusion.train_state import (
    State,
    load_optimiser,
    optimiser_state,
    prefixed,
    under,
)
from weather_aug.errors import ArgumentError, DataError, MissingExtraError, printable

ADAPTER, DISCRIMINATOR = "adapter", "discriminator"
SEED_MASK = 2**63 - 1
CYCLE_UPDATES = (
    ("cycle_l1", "cycle_perceptual"),
    ("adversarial",),
    ("identity_l1", "identity_perceptual"),
)
"""Terms of each of the adapter's updates in one step with cycles, in the release's order."""

Batch = Mapping[str, Any]


class Part(NamedTuple):
    """Some terms of a loss, and what to lower of them."""

    losses: Losses
    total: torch.Tensor


Parts = Callable[[Batch, torch.Generator], Iterator[Part]]
"""Terms that add up, each to be lowered before the next is asked for."""


class Update(NamedTuple):
    """One change of a player's parameters."""

    player: str
    parts: Parts


class Player(NamedTuple):
    """Parameters and their optimiser."""

    parameters: dict[str, nn.Parameter]
    optimiser: Any
    learning_rate: float
    network: nn.Module | None = None
    """Whose buffers belong to what is learnt; None if it has none."""

    @property
    def buffers(self) -> dict[str, torch.Tensor]:
        """Estimates that go on with every pass, such as those of spectral norms."""
        if self.network is None:
            return {}
        known = self.network.state_dict()
        return {name: known[name] for name in known if name not in self.parameters}


class Learner:
    """An adapter in training.

    Convention:
        The optimiser holds the parameters of all styles. Those that a step does not use have no
        gradient, not one of zero: neither moments nor weight decay move them.

    Args:
        base: Used up.
        styles: That there are pairs of; "cycle" adds "clear", its way back.
        options: How to train.
        accelerator: Of accelerate, with the options' precision and parts.
    """

    def __init__(
        self, base: Base, styles: Sequence[str], options: TrainOptions, accelerator: Any
    ) -> None:
        self.options, self.accelerator = options, accelerator
        if options.objective == "cycle":
            styles = (CLEAR, *(style for style in styles if style != CLEAR))
        spec = options.spec(tuple(styles))
        self.model = AdaptedModel(base, spec, seed=_key("train.adapter", options.seed))
        self.model.to(accelerator.device)
        if options.gradient_checkpointing:
            enable_checkpointing(self.model)
        self.perceptual = None
        if options.objective != "epsilon":
            self.perceptual = perceptual_distance(
                options.perceptual, self.model.vae, checkpointing=options.gradient_checkpointing
            )
            if isinstance(self.perceptual, nn.Module):
                self.perceptual.to(accelerator.device)
        self.players = {ADAPTER: self._player(self.model.trained(), options.learning_rate)}
        self.discriminators: Discriminators | None = None
        if options.objective == "cycle":
            self.discriminators = make_discriminators(
                options.discriminator,
                spec.styles,
                clip=options.clip_model,
                seed=options.seed,
            ).to(accelerator.device)
            learnt = {
                name: parameter
                for name, parameter in self.discriminators.named_parameters()
                if parameter.requires_grad
            }
            self.players[DISCRIMINATOR] = self._player(
                learnt, options.discriminator_learning_rate, self.discriminators
            )
        self.updates = self._updates()

    def step(self, step: int, batch: Batch) -> dict[str, Any]:
        """Learn from a batch.

        Args:
            step: From 0 on.
            batch: Of one style; see `objectives`.

        Returns:
            JSON values for the log: number of steps done, style, share of the learning rate, norm
            of the adapter's gradient before it is clipped (the largest of the step's updates), and
            the losses without weights.

        Raises:
            ArgumentError: If a loss or a gradient is no number any more.
        """
        losses: dict[str, float] = {}
        norms: dict[str, float] = {}
        batch = self._placed(batch)
        share = self.options.learning_rate_share(step)
        for player in self.players.values():
            for group in player.optimiser.param_groups:
                group["lr"] = player.learning_rate * share
        for number, update in enumerate(self.updates):
            found, norm = self._updated(update, batch, (step, number))
            losses |= found
            norms[update.player] = max(norm, norms.get(update.player, 0.0))
            self._check(step, batch["style"], {**losses, "gradient": norm})
        return {
            "step": step + 1,
            "style": batch["style"],
            "learning_rate": self.options.learning_rate * share,
            "gradient": norms[ADAPTER],
            "losses": losses,
        }

    def judged(self, batch: Batch, *fields: int) -> dict[str, float]:
        """Losses of a batch without weights, learning nothing; draws are keyed by `fields`."""
        losses: dict[str, float] = {}
        batch = self._placed(batch)
        with torch.no_grad(), self._still():
            for number, update in enumerate(self.updates):
                generator = _generator("train.judged", self.options.seed, *fields, number)
                with self.accelerator.autocast():
                    for part in update.parts(batch, generator):
                        _add(losses, part.losses, 1)
        return losses

    @contextmanager
    def _still(self) -> Iterator[None]:
        """Inside the block the discriminators' estimates stay as they are."""
        networks = [player.network for player in self.players.values() if player.network]
        for network in networks:
            network.eval()
        try:
            yield
        finally:
            for network in networks:
                network.train()

    def state(self, step: int) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
        """Head and tensors that `load` goes on from."""
        tensors: dict[str, torch.Tensor] = {}
        values: dict[str, Any] = {}
        for name, player in self.players.items():
            known, numbers = optimiser_state(player.optimiser, tuple(player.parameters))
            tensors |= prefixed(f"{name}.parameter", player.parameters)
            tensors |= prefixed(f"{name}.buffer", player.buffers)
            tensors |= prefixed(f"{name}.moment", known)
            values |= prefixed(f"{name}.moment", numbers)
        scaler = self.accelerator.scaler
        scale = None if scaler is None else scaler.state_dict()
        return {"step": step, "values": values, "scaler": scale}, tensors

    def load(self, state: State) -> None:
        """Take the state of another learner of the same options.

        Raises:
            DataError: If it is of another one.
        """
        try:
            for name, player in self.players.items():
                saved = under(f"{name}.parameter", state.tensors)
                saved |= under(f"{name}.buffer", state.tensors)
                with torch.no_grad():
                    for key, tensor in {**player.parameters, **player.buffers}.items():
                        tensor.copy_(saved[key])
                load_optimiser(
                    player.optimiser,
                    tuple(player.parameters),
                    under(f"{name}.moment", state.tensors),
                    under(f"{name}.moment", state.head["values"]),
                )
            if state.head["scaler"] is not None:
                self.accelerator.scaler.load_state_dict(state.head["scaler"])
        except (KeyError, RuntimeError, AttributeError, TypeError) as error:
            raise DataError(
                f"the state of the unfinished training does not fit ({printable(error)}); restart "
                "(--restart) to train anew"
            ) from None

    def _updates(self) -> tuple[Update, ...]:
        """What is done in each step, in this order."""
        model, options = self.model, self.options

        def paired(batch: Batch, generator: torch.Generator) -> Iterator[Part]:
            losses = paired_losses(model, batch, options.paired, self.perceptual, generator)
            yield Part(losses, weighted_sum(losses, options.paired))

        def epsilon(batch: Batch, generator: torch.Generator) -> Iterator[Part]:
            losses = epsilon_losses(model, batch, options.epsilon, generator)
            yield Part(losses, weighted_sum(losses, options.epsilon))

        if options.objective == "paired":
            return (Update(ADAPTER, paired),)
        if options.objective == "epsilon":
            return (Update(ADAPTER, epsilon),)
        return tuple(self._cycle_updates())

    def _cycle_updates(self) -> Iterator[Update]:
        """The release's: the adapter three times, then the discriminators twice."""
        weights = asdict(self.options.cycle)
        for terms in CYCLE_UPDATES:
            chosen = {name: weights[name] if name in terms else 0.0 for name in weights}
            if any(chosen.values()):
                yield Update(ADAPTER, self._generator_update(CycleWeights(**chosen)))
        if weights["adversarial"] > 0:
            yield Update(DISCRIMINATOR, self._discriminator_update("fake"))
            yield Update(DISCRIMINATOR, self._discriminator_update("real"))

    def _generator_update(self, weights: CycleWeights) -> Parts:
        def parts(batch: Batch, generator: torch.Generator) -> Iterator[Part]:
            for losses in generator_parts(
                self.model, batch, weights, self.perceptual, self.discriminators, generator
            ):
                yield Part(losses, weighted_sum(losses, weights))

        return parts

    def _discriminator_update(self, term: str) -> Parts:
        def parts(batch: Batch, generator: torch.Generator) -> Iterator[Part]:
            assert self.discriminators is not None
            loss = discriminator_losses(self.model, batch, self.discriminators, generator)[term]
            yield Part({term: loss}, loss)

        return parts

    def _updated(
        self, update: Update, batch: Batch, fields: tuple[int, ...]
    ) -> tuple[dict[str, float], float]:
        """Change a player's parameters; its losses, and the norm of its gradient."""
        player = self.players[update.player]
        parts = self.options.accumulate
        losses: dict[str, float] = {}
        for number, micro in enumerate(split(batch, parts)):
            generator = _generator("train.noise", self.options.seed, *fields, number)
            # Divides what is lowered by the number of parts.
            with self.accelerator.accumulate():
                found = update.parts(micro, generator)
                while True:
                    with self.accelerator.autocast():
                        part = next(found, None)
                    if part is None:
                        break
                    self.accelerator.backward(part.total)
                    _add(losses, part.losses, parts)
        self.accelerator.unscale_gradients(player.optimiser)
        norm = nn.utils.clip_grad_norm_(player.parameters.values(), self.options.clip)
        player.optimiser.step()
        for other in self.players.values():
            other.optimiser.zero_grad()
        return losses, float(norm)

    def _placed(self, batch: Batch) -> dict[str, Any]:
        """The batch on the device."""
        device = self.accelerator.device
        return {
            name: value.to(device) if isinstance(value, torch.Tensor) else value
            for name, value in batch.items()
        }

    def _player(
        self,
        parameters: dict[str, nn.Parameter],
        learning_rate: float,
        network: nn.Module | None = None,
    ) -> Player:
        make = torch.optim.AdamW
        if self.options.optimiser == "adamw8bit":
            make = _eight_bit()
        optimiser = make(
            list(parameters.values()), lr=learning_rate, betas=BETAS, weight_decay=WEIGHT_DECAY
        )
        return Player(parameters, self.accelerator.prepare(optimiser), learning_rate, network)

    def _check(self, step: int, style: str, numbers: Mapping[str, float]) -> None:
        # Half precision overflows now and then; its scaler leaves such a step out.
        scaled = self.accelerator.scaler is not None
        for name, value in numbers.items():
            if not torch.tensor(value).isfinite() and not (scaled and name == "gradient"):
                raise ArgumentError(
                    f"{name} of step {step + 1} ({style}) is {value}; training came off its way: "
                    f"take a learning_rate below {self.options.learning_rate:g}, or "
                    'mixed_precision "no"'
                )


def _add(sums: dict[str, float], losses: Losses, parts: int) -> None:
    for name, loss in losses.items():
        sums[name] = sums.get(name, 0.0) + float(loss.detach()) / parts


def _key(domain: str, *fields: int) -> int:
    return key_of(domain, *fields) & SEED_MASK


def _generator(domain: str, *fields: int) -> torch.Generator:
    """A stream on the CPU that depends on the key alone."""
    return torch.Generator().manual_seed(_key(domain, *fields))


def _eight_bit() -> Any:
    try:
        return require("bitsandbytes", extra="edit", to="train").optim.AdamW8bit
    except MissingExtraError as error:
        raise MissingExtraError(
            'bitsandbytes is needed for the optimiser "adamw8bit"; install it with: pip install '
            'bitsandbytes, or take optimiser "adamw"'
        ) from error.__cause__
