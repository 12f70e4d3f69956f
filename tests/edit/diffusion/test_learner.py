"""One step of training: what moves, what does not, and that memory is saved without a trace."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from pair_folder import write_pair_folder
from small_base import perturbed
from torch.utils.checkpoint import checkpoint

from weather_aug.edit.diffusion import learner as learner_module
from weather_aug.edit.diffusion import train_state
from weather_aug.edit.diffusion.adapted import SET, AdaptedModel
from weather_aug.edit.diffusion.base import load_base
from weather_aug.edit.diffusion.learner import DISCRIMINATOR, Learner
from weather_aug.edit.diffusion.objectives import CycleWeights, EpsilonWeights
from weather_aug.edit.diffusion.pairs import read_pairs
from weather_aug.edit.diffusion.train import accelerated
from weather_aug.edit.diffusion.train_batches import batches
from weather_aug.edit.diffusion.train_options import TrainOptions
from weather_aug.errors import ArgumentError, DataError, MissingExtraError

OPTIONS = TrainOptions(
    steps=4, batch_size=2, size=(32, 48), unet_rank=2, vae_rank=2, learning_rate=1e-2, warm_up=0
)
STYLES = ("rain", "snow")


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Of torch: threads that wait for each other make small sums slow."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_pair_folder(tmp_path_factory.mktemp("pairs") / "list", train=2, styles=STYLES)


@pytest.fixture
def learner(small_base: Path) -> Iterator[Learner]:
    with learning(small_base, OPTIONS) as made:
        yield made


@contextmanager
def learning(base: Path, options: TrainOptions) -> Iterator[Learner]:
    with accelerated(options) as accelerator:
        yield Learner(load_base(str(base)), options.styles or STYLES, options, accelerator)


def batch_of(pairs: Path, style: str, options: TrainOptions = OPTIONS) -> dict[str, Any]:
    return next(b for b in batches(read_pairs(pairs), options) if b["style"] == style)


def parameters(learner: Learner) -> dict[str, torch.Tensor]:
    """A copy of all that is learnt, and of the moments, by name."""
    _, tensors = learner.state(0)
    return {name: tensor.detach().clone() for name, tensor in tensors.items()}


def moved(before: dict[str, torch.Tensor], after: dict[str, torch.Tensor]) -> set[str]:
    return {name for name in after if name not in before or not before[name].equal(after[name])}


def test_only_the_sets_of_the_style_move(
    learner: Learner, pairs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither weight decay nor the moments of an earlier step move the set of another style."""
    base = {
        name: tensor.clone()
        for name, tensor in learner.model.state_dict().items()
        if name not in learner.model.trained()
    }
    learner.step(0, batch_of(pairs, "rain"))
    after_rain = parameters(learner)
    learner.step(1, batch_of(pairs, "snow"))
    after_snow = parameters(learner)
    changed = moved(after_rain, after_snow)
    snow, rain = SET.format("snow"), SET.format("rain")
    assert any(snow in name for name in changed)
    assert any("vae" in name for name in changed)
    assert not any(rain in name for name in changed)
    state = learner.model.state_dict()
    assert all(torch.equal(state[name], tensor) for name, tensor in base.items())

    # With gradients of zero in the place of none they would move.
    for parameter in learner.model.trained().values():
        parameter.grad = torch.zeros_like(parameter)
    learner.step(2, batch_of(pairs, "snow"))
    assert any(rain in name for name in moved(after_snow, parameters(learner)))


@pytest.mark.parametrize("conditioning", ["groups", "embedding", "gray", "none"])
def test_every_conditioning_learns(small_base: Path, pairs: Path, conditioning: str) -> None:
    options = replace(OPTIONS, conditioning=conditioning, styles=("rain",))  # type: ignore[arg-type]
    with learning(small_base, options) as learner:
        before = parameters(learner)
        learner.step(0, batch_of(pairs, "rain"))
        stem = {name for name in moved(before, parameters(learner)) if ".parameter/stem." in name}
        assert bool(stem) == (conditioning != "none")


def test_the_parts_of_a_batch_add_up(small_base: Path, pairs: Path) -> None:
    found = []
    for accumulate in (1, 2):
        options = replace(OPTIONS, accumulate=accumulate, styles=("rain",))
        with learning(small_base, options) as learner:
            entry = learner.step(0, batch_of(pairs, "rain"))
            found.append((entry["gradient"], entry["losses"]))
    assert found[0][0] == pytest.approx(found[1][0], rel=1e-4)
    assert found[0][1] == pytest.approx(found[1][1], rel=1e-4)


CYCLE = replace(
    OPTIONS, objective="cycle", styles=("rain",), batch_size=1, discriminator_learning_rate=1e-3
)
SECOND = replace(OPTIONS, batch_size=1, styles=STYLES)
"""Of a style that does not act when gradients are computed."""


@pytest.mark.parametrize("options", [SECOND, CYCLE])
def test_checkpointing_gives_the_same_gradients(
    small_base: Path, pairs: Path, options: TrainOptions
) -> None:
    kept, again = both_gradients(small_base, pairs, options)
    assert kept.keys() == again.keys()
    assert all(torch.allclose(kept[name], again[name], rtol=1e-9, atol=1e-12) for name in kept)


def test_that_test_sees_the_wrong_style_in_the_way_back(
    small_base: Path, pairs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The library's own checkpointing computes again with the style that acts by then."""

    def unaware(model: AdaptedModel) -> None:
        model.unet.enable_gradient_checkpointing(
            lambda module, *args: checkpoint(module, *args, use_reentrant=False)
        )

    monkeypatch.setattr(learner_module, "enable_checkpointing", unaware)
    try:
        kept, again = both_gradients(small_base, pairs, CYCLE)
    except torch.utils.checkpoint.CheckpointError:
        return
    assert kept.keys() != again.keys() or not all(
        torch.allclose(kept[name], again[name], rtol=1e-3) for name in kept
    )


def both_gradients(
    base: Path, pairs: Path, options: TrainOptions
) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
    """Of an adapter that is not zero, in float64: activations kept, and computed again."""
    batch = batch_of(pairs, "rain" if options is CYCLE else "snow", options)
    batch |= {name: batch[name].double() for name in ("source", "target")}
    found = []
    for checkpointing in (False, True):
        with learning(base, replace(options, gradient_checkpointing=checkpointing)) as learner:
            model = perturbed(learner.model, seed=3).double()
            for part in learner.updates[0].parts(batch, torch.Generator()):
                part.total.backward()
            found.append(
                {name: p.grad for name, p in model.trained().items() if p.grad is not None}
            )
    return found[0], found[1]


def test_cycles_teach_both_ways_and_go_on_to_the_bit(small_base: Path, pairs: Path) -> None:
    batch = batch_of(pairs, "rain", CYCLE)
    with learning(small_base, CYCLE) as learner:
        assert learner.model.spec.styles == ("clear", "rain")
        before = parameters(learner)
        entry = learner.step(0, batch)
        assert set(entry["losses"]) == {*CycleWeights.__dataclass_fields__, "fake", "real"}
        state = train_state.State(*learner.state(1))
        state = train_state.State(state.head, {k: v.clone() for k, v in state.tensors.items()})
        changed = moved(before, state.tensors)
        for part in (SET.format("clear"), SET.format("rain"), f"{DISCRIMINATOR}.buffer/"):
            assert any(part in name for name in changed)
        learner.judged(batch, 0)
        assert not moved(state.tensors, parameters(learner))
        learner.step(1, batch)
        expected = parameters(learner)
    with learning(small_base, CYCLE) as other:
        other.load(state)
        other.step(1, batch)
        assert not moved(expected, parameters(other))
        broken = {name: t for name, t in state.tensors.items() if "buffer" not in name}
        with pytest.raises(DataError, match="does not fit"):
            other.load(train_state.State(state.head, broken))


def test_terms_without_a_weight_cost_no_update(small_base: Path, pairs: Path) -> None:
    weights = CycleWeights(adversarial=0.0, identity_l1=0.0, identity_perceptual=0.0)
    with learning(small_base, replace(CYCLE, cycle=weights)) as learner:
        assert len(learner.updates) == 1
        entry = learner.step(0, batch_of(pairs, "rain", CYCLE))
    assert set(entry["losses"]) == {"cycle_l1", "cycle_perceptual"}


def test_the_noise_hangs_on_the_step(small_base: Path, pairs: Path) -> None:
    options = replace(
        OPTIONS,
        objective="epsilon",
        styles=("rain",),
        epsilon=EpsilonWeights(latent=1.0),
        learning_rate=1e-12,
    )
    batch = batch_of(pairs, "rain")
    with learning(small_base, options) as learner:
        first, second, again = (learner.step(step, batch)["losses"] for step in (0, 1, 0))
        assert first["epsilon"] == pytest.approx(again["epsilon"], rel=1e-5)
        assert first["epsilon"] != pytest.approx(second["epsilon"], rel=1e-5)
        assert learner.judged(batch, 0) == learner.judged(batch, 0)


def test_half_precision_on_a_cpu(small_base: Path, pairs: Path) -> None:
    with pytest.raises(ArgumentError, match="needs a GPU"):
        replace(OPTIONS, mixed_precision="fp16")
    options = replace(OPTIONS, mixed_precision="bf16", styles=("rain",))
    batch = batch_of(pairs, "rain")
    with learning(small_base, options) as learner:
        half = learner.judged(batch, 0)
        entry = learner.step(0, batch)
        assert all(p.dtype == torch.float32 for p in learner.model.trained().values())
    assert entry["losses"] == pytest.approx(half, rel=1e-6)
    with learning(small_base, replace(options, mixed_precision="no")) as learner:
        whole = learner.judged(batch, 0)
    assert half == pytest.approx(whole, rel=0.1)
    assert half != whole


def test_what_is_no_number_ends_the_training(learner: Learner, pairs: Path) -> None:
    batch = batch_of(pairs, "rain")
    batch["target"] = torch.full_like(batch["target"], torch.nan)
    with pytest.raises(ArgumentError, match=r"step 3 \(rain\) is nan.*learning_rate below 0.01"):
        learner.step(2, batch)


def test_the_learning_rate_rises_then_stays(learner: Learner, pairs: Path) -> None:
    shares = [replace(OPTIONS, steps=9, warm_up=4).learning_rate_share(step) for step in range(6)]
    assert shares == [0.25, 0.5, 0.75, 1.0, 1.0, 1.0]
    falling = replace(OPTIONS, steps=6, warm_up=1, cool_down=3)
    shares = [falling.learning_rate_share(step) for step in range(6)]
    assert shares == [1.0, 1.0, 1.0, 0.75, 0.5, 0.25]
    entry = learner.step(0, batch_of(pairs, "rain"))
    assert entry["learning_rate"] == OPTIONS.learning_rate


def test_the_optimiser_in_eight_bits_says_what_it_needs(
    small_base: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learner_module, "AdaptedModel", _Nothing)
    options = replace(OPTIONS, objective="epsilon", device="cuda", optimiser="adamw8bit")
    with (
        accelerated(OPTIONS) as accelerator,
        pytest.raises(MissingExtraError, match="bitsandbytes"),
    ):
        Learner(load_base(str(small_base)), STYLES, options, accelerator)


class _Nothing:
    """A model that learns nothing."""

    def __init__(self, *_: Any, **__: Any) -> None: ...

    def to(self, *_: Any) -> None: ...

    def trained(self) -> dict[str, Any]:
        return {}
