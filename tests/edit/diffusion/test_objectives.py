"""What a training lowers: formulas, whose gradients, which labels, and that it goes down."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from small_base import adapted, perturbed, pictures

from weather_aug.edit.diffusion import objectives
from weather_aug.edit.diffusion.adapted import SET, AdaptedModel
from weather_aug.edit.diffusion.checkpointing import enable_checkpointing
from weather_aug.edit.diffusion.discriminator import (
    Discriminators,
    PatchDiscriminator,
    discriminator_loss,
    generator_loss,
)
from weather_aug.edit.diffusion.objectives import (
    CycleWeights,
    EpsilonWeights,
    PairedWeights,
    base_latent,
    discriminator_losses,
    epsilon_losses,
    generator_losses,
    generator_parts,
    paired_losses,
    weighted_sum,
)
from weather_aug.edit.diffusion.perceptual import VaeFeatures
from weather_aug.edit.diffusion.spec import CLEAR, AdapterSpec
from weather_aug.errors import ArgumentError

SPEC = AdapterSpec(
    prompts={"rain": "rain", "snow": "snow", CLEAR: "clear"},
    unet_rank=2,
    unet_targets=("to_q", "conv1"),
    vae_rank=2,
    vae_targets=("conv1", "conv_out"),
)
"""Rain comes first, so it acts where nobody chooses; few layers, so that tests are quick."""
Run = Callable[[AdaptedModel], torch.Tensor]


@pytest.fixture
def model(small_base: Path) -> AdaptedModel:
    """In float64, as if trained: no gradient is zero because a factor is."""
    return perturbed(adapted(small_base, SPEC), seed=3).double()


@pytest.fixture
def judges() -> Discriminators:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(8)
        made = {s: PatchDiscriminator(width=4, scales=1).double().eval() for s in SPEC.styles}
    return Discriminators(dict(made))


def a_batch(style: str = "snow", **changes: Any) -> dict[str, Any]:
    images, labels = pictures(4, 16, 16)
    batch = {
        "source": images[:2].double(),
        "target": images[2:].double() * 0.5,
        "source_label": labels[:2],
        "target_label": labels[2:],
        "style": style,
        "aligned": True,
    }
    return batch | changes


def seeded(seed: int = 1) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def learners(model: AdaptedModel) -> set[str]:
    """Everything that a backward pass gave a gradient, of the whole model."""
    return {name for name, p in model.named_parameters() if p.grad is not None}


def sets_of(model: AdaptedModel, *styles: str) -> set[str]:
    names = [f".{SET.format(style)}." for style in styles]
    return {name for name in model.trained() if any(part in name for part in names)}


def shared(model: AdaptedModel) -> set[str]:
    return set(model.trained()) - sets_of(model, *SPEC.styles)


def paired(model: AdaptedModel) -> torch.Tensor:
    weights = PairedWeights()
    return weighted_sum(paired_losses(model, a_batch(), weights, VaeFeatures(model.vae)), weights)


def epsilon(model: AdaptedModel) -> torch.Tensor:
    weights = EpsilonWeights(latent=1.0)
    return weighted_sum(epsilon_losses(model, a_batch(), weights, seeded()), weights)


def cycle(judges: Discriminators) -> Run:
    def run(model: AdaptedModel) -> torch.Tensor:
        weights = CycleWeights()
        features = VaeFeatures(model.vae)
        return weighted_sum(generator_losses(model, a_batch(), weights, features, judges), weights)

    return run


@pytest.mark.parametrize("kind", [PairedWeights, EpsilonWeights, CycleWeights])
def test_weights_are_checked(kind: Any) -> None:
    with pytest.raises(ArgumentError, match=r"epsilon|cycle_l1"):
        kind(-1.0)
    with pytest.raises(ArgumentError, match="nothing to lower"):
        kind(**dict.fromkeys(kind.__dataclass_fields__, 0.0))


def test_the_sum_is_weighted() -> None:
    losses = {"l1": torch.tensor(2.0), "perceptual": torch.tensor(3.0)}
    assert float(weighted_sum(losses, PairedWeights(l1=10, perceptual=0.5))) == 21.5


class TestPaired:
    def test_is_the_error_of_the_latent_and_of_the_picture(self, model: AdaptedModel) -> None:
        self.check(model)

    def check(self, model: AdaptedModel) -> None:
        batch, features = a_batch(), VaeFeatures(model.vae)
        found = paired_losses(model, batch, PairedWeights(), features)
        with torch.no_grad():
            encoded = model.encode(batch["source"], batch["source_label"])
            with model.styled("snow") as prompt:
                latent = model.latent_of(encoded.latent, model.noise(encoded.latent, prompt))
            image = model(batch["source"], batch["source_label"], "snow")
            error = (latent - base_latent(model, batch["target"])).square().mean()
        assert found["epsilon"].item() == pytest.approx(error.item(), rel=1e-5)
        assert found["l1"].item() == pytest.approx((image - batch["target"]).abs().mean().item())
        assert found["perceptual"].item() == pytest.approx(
            features(image, batch["target"]).mean().item()
        )

    def test_sees_alpha_bar_swapped(
        self, model: AdaptedModel, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        right = objectives.noise_of_latent
        monkeypatch.setattr(objectives, "noise_of_latent", lambda z, x, a: right(z, x, 1 - a))
        with pytest.raises(AssertionError):
            self.check(model)

    def test_is_nothing_where_the_model_arrives(
        self, model: AdaptedModel, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        batch = a_batch()
        with torch.no_grad():
            batch["target"] = model(batch["source"], batch["source_label"], "snow")
            wanted = base_latent(model, batch["target"])
        features = VaeFeatures(model.vae)
        found = paired_losses(model, batch, PairedWeights(epsilon=0), features)
        assert found.keys() == {"l1", "perceptual"}
        assert max(loss.item() for loss in found.values()) < 1e-9

        def exact(latent: torch.Tensor, *_: Any) -> torch.Tensor:
            return objectives.noise_of_latent(latent, wanted, model.base.alpha_bar)

        monkeypatch.setattr(model, "noise", exact)
        found = paired_losses(model, batch, PairedWeights(l1=0, perceptual=0))
        assert found.keys() == {"epsilon"}
        assert found["epsilon"].item() < 1e-12

    def test_wants_aligned_pairs_and_a_distance(self, model: AdaptedModel) -> None:
        with pytest.raises(ArgumentError, match="needs aligned pairs"):
            paired_losses(model, a_batch(aligned=False), PairedWeights(perceptual=0))
        with pytest.raises(ArgumentError, match="perceptual distance is 5"):
            paired_losses(model, a_batch(), PairedWeights())

    def test_a_batch_of_clear_pictures_teaches_the_identity(self, model: AdaptedModel) -> None:
        batch = a_batch(CLEAR)
        batch["target"] = batch["source"]
        weights = PairedWeights(perceptual=0)
        weighted_sum(paired_losses(model, batch, weights), weights).backward()
        assert learners(model) == shared(model) | sets_of(model, CLEAR)


class TestEpsilon:
    def check_optimum(self, model: AdaptedModel, monkeypatch: pytest.MonkeyPatch) -> None:
        batch = a_batch()
        with torch.no_grad():
            z0 = model.encode(batch["target"], batch["target_label"]).latent
        bars = model.base.alpha_bars.clone()

        def exact(noisy: torch.Tensor, _: Any, time: torch.Tensor) -> torch.Tensor:
            bar = bars[time][:, None, None, None]
            return (noisy - bar.sqrt() * z0) / (1 - bar).sqrt()

        monkeypatch.setattr(model, "noise", exact)
        for seed in range(3):
            found = epsilon_losses(model, batch, EpsilonWeights(), seeded(seed))
            assert found.keys() == {"epsilon"}
            assert found["epsilon"].item() < 1e-10

    def test_who_knows_the_noise_pays_nothing(
        self, model: AdaptedModel, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        self.check_optimum(model, monkeypatch)

    def test_alpha_bar_swapped_is_seen(
        self, model: AdaptedModel, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        right = torch.Tensor.sqrt
        # Both roots are taken of the schedule's rows: each for the other is a swap.
        monkeypatch.setattr(
            torch.Tensor, "sqrt", lambda x: right(1 - x) if x.shape == (2, 1, 1, 1) else right(x)
        )
        noisy: list[torch.Tensor] = []
        monkeypatch.setattr(model, "noise", lambda z, *_: noisy.append(z) or z)
        epsilon_losses(model, a_batch(), EpsilonWeights(), seeded())
        swapped = noisy.pop()
        monkeypatch.setattr(torch.Tensor, "sqrt", right)
        assert not torch.allclose(swapped, self.noisy_by_hand(model))
        epsilon_losses(model, a_batch(), EpsilonWeights(), seeded())
        assert torch.allclose(noisy.pop(), self.noisy_by_hand(model), rtol=1e-12)

    def noisy_by_hand(self, model: AdaptedModel) -> torch.Tensor:
        batch, generator = a_batch(), seeded()
        with torch.no_grad():
            z0 = model.encode(batch["target"], batch["target_label"]).latent
        times = torch.randint(1000, (2,), generator=generator).tolist()
        noise = torch.randn(z0.shape, generator=generator).double()
        bars = [float(model.base.alpha_bars[time]) for time in times]
        rows = [b**0.5 * z + (1 - b) ** 0.5 * e for b, z, e in zip(bars, z0, noise, strict=True)]
        return torch.stack(rows)

    def test_the_generator_alone_decides(self, model: AdaptedModel) -> None:
        weights, drawn = EpsilonWeights(), torch.random.get_rng_state()
        with torch.no_grad():
            one, same, other = (
                epsilon_losses(model, a_batch(), weights, seeded(s))["epsilon"].item()
                for s in (1, 1, 2)
            )
        assert one == same != other
        assert torch.equal(torch.random.get_rng_state(), drawn)

    def test_times_are_uniform(self, model: AdaptedModel, monkeypatch: pytest.MonkeyPatch) -> None:
        times: list[torch.Tensor] = []
        monkeypatch.setattr(model, "noise", lambda z, _, time: times.append(time) or z)
        latent = torch.zeros(4000, 1, 1, 1)
        monkeypatch.setattr(model, "encode", lambda *_: Seen(latent))
        epsilon_losses(model, a_batch(), EpsilonWeights(), seeded())
        (found,) = times
        assert 0 <= int(found.min()) < 5
        assert 994 < int(found.max()) <= 999
        tenths = torch.bincount(found // 100, minlength=10)
        # 400 each, with a standard deviation of 19.
        assert int((tenths - 400).abs().max()) < 80


class Seen:
    """What a model's `encode` returns, as far as the objective looks."""

    def __init__(self, latent: torch.Tensor) -> None:
        self.latent = latent


class TestGradients:
    """Who learns: the sets of the styles that acted and what all share, nobody else."""

    def check(self, model: AdaptedModel, run: Run, *styles: str) -> None:
        run(model).backward()
        assert learners(model) == shared(model) | sets_of(model, *styles)

    def test_paired(self, model: AdaptedModel) -> None:
        self.check(model, paired, "snow")

    def test_cycle(self, model: AdaptedModel, judges: Discriminators) -> None:
        self.check(model, cycle(judges), "snow", CLEAR)
        assert all(parameter.grad is None for parameter in judges.parameters())

    def test_epsilon_leaves_the_decoder(self, model: AdaptedModel) -> None:
        epsilon(model).backward()
        late = {name for name in model.trained() if name.startswith(("skips.", "vae.decoder."))}
        assert late
        assert learners(model) == (shared(model) - late) | sets_of(model, "snow")

    def test_a_style_that_is_not_switched_to_is_seen(
        self, model: AdaptedModel, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        right = model.styled
        monkeypatch.setattr(model, "styled", lambda _: right("rain"))
        with pytest.raises(AssertionError):
            self.check(model, paired, "snow")

    def test_discriminators_learn_alone(self, model: AdaptedModel, judges: Discriminators) -> None:
        self.check_discriminators(model, judges)

    def test_edited_pictures_that_lead_back_into_the_model_are_seen(
        self, model: AdaptedModel, judges: Discriminators, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(objectives.torch, "no_grad", contextlib.nullcontext)
        with pytest.raises(AssertionError):
            self.check_discriminators(model, judges)

    def check_discriminators(self, model: AdaptedModel, judges: Discriminators) -> None:
        sum(discriminator_losses(model, a_batch(), judges).values()).backward()  # type: ignore[union-attr]
        assert not learners(model)
        assert all(parameter.grad is not None for parameter in judges["snow"].parameters())
        assert all(parameter.grad is not None for parameter in judges[CLEAR].parameters())
        assert all(parameter.grad is None for parameter in judges["rain"].parameters())


class TestCycle:
    def test_is_the_sum_of_both_directions(
        self, model: AdaptedModel, judges: Discriminators
    ) -> None:
        batch, features = a_batch(), VaeFeatures(model.vae)
        a, b, of_a, of_b = (batch[k] for k in ("source", "target", "source_label", "target_label"))
        with torch.no_grad():
            found = generator_losses(model, batch, CycleWeights(), features, judges)
            judged = discriminator_losses(model, batch, judges)
            snowy, cleared = model(a, of_a, "snow").clamp(-1, 1), model(b, of_b, CLEAR).clamp(-1, 1)
            back = model(snowy, of_a, CLEAR), model(cleared, of_b, "snow")
            same = model(a, of_a, CLEAR), model(b, of_b, "snow")
            wanted = {
                "cycle_l1": (back[0] - a).abs().mean() + (back[1] - b).abs().mean(),
                "cycle_perceptual": (features(back[0], a) + features(back[1], b)).mean(),
                "identity_l1": (same[0] - a).abs().mean() + (same[1] - b).abs().mean(),
                "identity_perceptual": (features(same[0], a) + features(same[1], b)).mean(),
                "adversarial": generator_loss(judges["snow"](snowy))
                + generator_loss(judges[CLEAR](cleared)),
            }
            sides = (
                discriminator_loss(judges["snow"](b), judges["snow"](snowy)),
                discriminator_loss(judges[CLEAR](a), judges[CLEAR](cleared)),
            )
        assert found.keys() == wanted.keys()
        for name, loss in found.items():
            assert loss.item() == pytest.approx(wanted[name].item(), rel=1e-5), name
        for name, loss in judged.items():
            halves = (sides[0][name] + sides[1][name]) / 2
            assert loss.item() == pytest.approx(halves.item(), rel=1e-5), name

    def test_parts_add_up_and_so_do_their_gradients(
        self, model: AdaptedModel, judges: Discriminators
    ) -> None:
        weights, features = CycleWeights(), VaeFeatures(model.vae)
        cycle(judges)(model).backward()
        whole = {name: model.get_parameter(name).grad for name in sorted(learners(model))}
        model.zero_grad()
        parts = generator_parts(model, a_batch(), weights, features, judges)
        names = []
        for part in parts:
            names.append(tuple(part))
            weighted_sum(part, weights).backward()
        there = ("cycle_l1", "cycle_perceptual", "adversarial")
        assert names == [there, there, *[("identity_l1", "identity_perceptual")] * 2]
        assert learners(model) == set(whole)
        for name, grad in whole.items():
            assert grad is not None
            assert torch.allclose(model.get_parameter(name).grad, grad, rtol=1e-4, atol=1e-7), name

    def test_checkpoints_give_the_same_gradients(self, model: AdaptedModel) -> None:
        weights = CycleWeights(cycle_perceptual=0, identity_perceptual=0, adversarial=0)
        found = []
        for _ in range(2):
            model.zero_grad()
            losses = generator_losses(model, a_batch(), weights, None, None)
            weighted_sum(losses, weights).backward()
            found.append({name: model.get_parameter(name).grad for name in learners(model)})
            enable_checkpointing(model)
        assert found[0].keys() == found[1].keys()
        for name, grad in found[0].items():
            assert torch.allclose(found[1][name], grad, rtol=1e-6, atol=1e-9), name

    def test_the_librarys_own_checkpoints_do_not(self, model: AdaptedModel) -> None:
        """What `enable_checkpointing` is for: blocks that run again under another style."""
        weights = CycleWeights(cycle_perceptual=0, identity_perceptual=0, adversarial=0)
        found = []
        for _ in range(2):
            model.zero_grad()
            losses = generator_losses(model, a_batch(), weights, None, None)
            weighted_sum(losses, weights).backward()
            found.append({name: model.get_parameter(name).grad for name in learners(model)})
            model.unet.enable_gradient_checkpointing()
        assert not all(
            torch.allclose(found[1][name], grad, rtol=1e-6, atol=1e-9)
            for name, grad in found[0].items()
            if name in found[1]
        )

    def test_what_is_missing_is_named(self, model: AdaptedModel, judges: Discriminators) -> None:
        features = VaeFeatures(model.vae)

        def run(batch: dict[str, Any], judges: Discriminators | None, distance: Any) -> None:
            generator_losses(model, batch, CycleWeights(), distance, judges)

        with pytest.raises(ArgumentError, match="got clear"):
            run(a_batch(CLEAR), judges, features)
        with pytest.raises(ArgumentError, match="style 'fog'"):
            run(a_batch("fog"), judges, features)
        with pytest.raises(ArgumentError, match="no discriminators"):
            run(a_batch(), None, features)
        with pytest.raises(ArgumentError, match="perceptual distance is 10"):
            run(a_batch(), judges, None)
        with pytest.raises(ArgumentError, match="style 'snow'"):
            run(a_batch(), Discriminators({CLEAR: judges[CLEAR]}), features)


class TestLabels:
    """A picture goes with its own label, and so does what became of it."""

    def used(self, model: AdaptedModel, run: Run) -> list[str]:
        batch, right, found = a_batch(), model.encode, []

        def encode(image: torch.Tensor, label: torch.Tensor) -> Any:
            kinds = ("source", "target")
            whose = [kind for kind in kinds if torch.equal(label, batch[f"{kind}_label"])]
            what = [kind for kind in kinds if torch.equal(image, batch[kind])] or ["edited"]
            found.append(f"{what[0]} with {whose[0]}'s")
            return right(image, label)

        with torch.no_grad(), pytest.MonkeyPatch.context() as patch:
            patch.setattr(model, "encode", encode)
            run(model)
        return found

    def test_each_goes_with_its_own(self, model: AdaptedModel, judges: Discriminators) -> None:
        assert self.used(model, paired) == ["source with source's"]
        assert self.used(model, epsilon) == ["target with target's"]
        self.check_cycle(model, judges)

    def test_a_wrong_pictures_label_is_seen(
        self, model: AdaptedModel, judges: Discriminators, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        right = objectives._directions

        def swapped(batch: Any) -> Any:
            one, other = right(batch)
            return (*one[:3], other[3]), (*other[:3], one[3])

        monkeypatch.setattr(objectives, "_directions", swapped)
        with pytest.raises(AssertionError):
            self.check_cycle(model, judges)

    def check_cycle(self, model: AdaptedModel, judges: Discriminators) -> None:
        own = ["source with source's", "target with target's"]
        assert self.used(model, cycle(judges)) == [
            *(own[0], "edited with source's", own[1], "edited with target's"),
            *own,
        ]


def test_the_gradient_of_a_cycle_is_its_slope(model: AdaptedModel, judges: Discriminators) -> None:
    run = cycle(judges)
    run(model).backward()
    gradient = {name: model.get_parameter(name).grad for name in learners(model)}
    squared = sum(float(grad.square().sum()) for grad in gradient.values() if grad is not None)
    step, ends = 1e-6 / squared**0.5, []
    with torch.no_grad():
        for way in (step, -2 * step):
            for name, grad in gradient.items():
                assert grad is not None
                model.get_parameter(name).add_(grad, alpha=way)
            ends.append(run(model).item())
    # The perceptual distance is computed in float32.
    assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(squared, rel=1e-2)


def thirty_steps(run: Run, model: AdaptedModel, rate: float) -> list[float]:
    optimiser = torch.optim.AdamW(model.trained().values(), lr=rate)
    found = []
    for _ in range(30):
        loss = run(model)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        found.append(loss.item())
    return found


@pytest.mark.parametrize("run", [paired, epsilon])
def test_thirty_steps_lower_it(run: Run, small_base: Path) -> None:
    found = thirty_steps(run, adapted(small_base, SPEC).double(), rate=2e-3)
    assert found[-1] < 0.8 * found[0]


@pytest.mark.slow
def test_thirty_steps_lower_a_cycle(small_base: Path, judges: Discriminators) -> None:
    """Of pictures alone: features of a random encoder hardly move in so few steps."""
    weights = CycleWeights(cycle_perceptual=0, identity_perceptual=0)

    def run(model: AdaptedModel) -> torch.Tensor:
        return weighted_sum(generator_losses(model, a_batch(), weights, None, judges), weights)

    found = thirty_steps(run, adapted(small_base, SPEC).double(), rate=5e-4)
    assert found[-1] < 0.98 * found[0]
