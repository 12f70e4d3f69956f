"""The pool of parameters: rows carry all that belongs to them, and a fit goes on to the bit."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from weather_aug.errors import ArgumentError, DataError
from weather_aug.gaussians.pool import FIRST_POSITION_RATE, RATES, Pool, position_rate
from weather_aug.gaussians.types import Gaussians


def some_gaussians(count: int = 7, coefficients: int = 4, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)

    def draw(*shape: int) -> np.ndarray:
        return rng.standard_normal((count, *shape)).astype(np.float32)

    return Gaussians(
        draw(3), draw(4), draw(3), draw(), draw(coefficients, 3), np.zeros((count, 0), np.float16)
    )


def some_pool(count: int = 7, seed: int = 0) -> Pool:
    return Pool.of(
        some_gaussians(count, seed=seed),
        {"offsets_m": 1e-3},
        more={"offsets_m": np.zeros((count, 5, 3), np.float32)},
        owners=np.arange(count, dtype=np.int32),
    )


def train(pool: Pool, steps: int, first: int = 0) -> None:
    """Steps along gradients that depend on values and step alone."""
    for step in range(first, first + steps):
        pool.zero_grad()
        pool.set_rate("means_m", position_rate(step, 20, 3.0))
        values = (pool.sh, pool.scales_m, pool.opacities, *pool.parameters.values())
        sum((torch.sin((1.0 + step) * value)).sum() for value in values).backward()
        pool.step()


def same(one: dict[str, Tensor], other: dict[str, Tensor]) -> bool:
    return one.keys() == other.keys() and all(
        one[name].dtype == other[name].dtype and torch.equal(one[name], other[name]) for name in one
    )


def test_gaussians_come_back_as_they_went_in() -> None:
    gaussians = some_gaussians()
    back = Pool.of(gaussians).gaussians()
    for name in ("means_m", "quaternions", "log_scales", "logit_opacities", "sh", "class_scores"):
        assert np.array_equal(getattr(gaussians, name), getattr(back, name)), name
    assert back.means_m.dtype == np.float32


def test_the_arrays_given_are_never_written_to() -> None:
    gaussians = some_gaussians()
    before = gaussians.means_m.copy()
    pool = Pool.of(gaussians)
    train(pool, 2)
    copied = pool.gaussians().means_m
    kept = copied.copy()
    train(pool, 1)
    assert np.array_equal(before, gaussians.means_m) and np.array_equal(copied, kept)


def test_steps_are_those_of_plain_adam() -> None:
    pool = some_pool()
    values = {name: value.detach().double().clone() for name, value in pool.parameters.items()}
    moments = {name: (torch.zeros_like(v), torch.zeros_like(v)) for name, v in values.items()}
    for step in range(1, 6):
        pool.zero_grad()
        sum((value**2).sum() for value in pool.parameters.values()).backward()
        pool.step()
        for name, value in values.items():
            first, second = moments[name]
            slope = 2 * value
            first.mul_(0.9).add_(0.1 * slope)
            second.mul_(0.999).add_(0.001 * slope**2)
            size = (second / (1 - 0.999**step)).sqrt() + 1e-15
            value -= pool.rates[name] * first / (1 - 0.9**step) / size
    for name, value in values.items():
        torch.testing.assert_close(pool.parameters[name].double(), value, rtol=1e-4, atol=1e-6)


def test_a_restored_pool_goes_on_to_the_bit() -> None:
    straight, broken = some_pool(), some_pool()
    train(straight, 9)
    train(broken, 4)
    state = broken.state()
    assert all(value.device.type == "cpu" and not value.requires_grad for value in state.values())
    fresh, other = Pool.of_state(state), some_pool(3, seed=5)
    other.restore(state)
    for pool in (fresh, other):
        train(pool, 5, first=4)
        assert same(straight.state(), pool.state())
    train(broken, 1)
    assert same(state, Pool.of_state(state).state()), "the state hangs on the pool"


@pytest.mark.parametrize("lost", ["exp_avg.means_m", "step.sh_dc", "exp_avg_sq.log_scales"])
def test_continuing_without_one_of_adams_numbers_shows(lost: str) -> None:
    straight = some_pool()
    train(straight, 4)
    state = straight.state()
    forgetful = Pool.of_state({**state, lost: torch.zeros_like(state[lost])})
    for pool in (straight, forgetful):
        train(pool, 2, first=4)
    assert not same(straight.state(), forgetful.state())


def test_a_damaged_state_is_refused() -> None:
    state = some_pool().state()
    for damaged in (
        {},
        {name: value for name, value in state.items() if name != "exp_avg.sh_dc"},
        {name: value for name, value in state.items() if name != "rates.means_m"},
        {**state, "exp_avg.means_m": torch.zeros(1, 3)},
        {**state, "constants.owners": torch.zeros(2)},
        {**state, "rates.means_m": torch.tensor(-1.0)},
    ):
        with pytest.raises(DataError, match="start the fit anew"):
            Pool.of_state(damaged)


@given(st.lists(st.booleans(), min_size=7, max_size=7))
@settings(max_examples=20)
def test_kept_rows_are_trained_as_if_the_others_had_never_been(kept: list[bool]) -> None:
    mask = torch.tensor(kept)
    pool = some_pool()
    train(pool, 3)
    whole = pool.state()
    pool.keep(mask)
    assert len(pool) == int(mask.sum())
    rowless = ("step.", "rates.")
    for name, value in pool.state().items():
        assert torch.equal(value, whole[name] if name.startswith(rowless) else whole[name][mask])
    twin = Pool.of_state(whole)
    for each in (pool, twin):
        train(each, 2, first=3)
    for name in pool.parameters:
        torch.testing.assert_close(
            pool.parameters[name], twin.parameters[name][mask], rtol=1e-6, atol=1e-7
        )


def test_appended_rows_start_without_a_memory_and_leave_the_others_alone() -> None:
    pool, rows = some_pool(), torch.tensor([4, 1, 4])
    train(pool, 3)
    before = pool.state()
    pool.append(
        {name: value[rows] for name, value in pool.parameters.items()},
        {name: value[rows] for name, value in pool.constants.items()},
    )
    after = pool.state()
    assert len(pool) == 10 and pool.constants["owners"].tolist() == [*range(7), 4, 1, 4]
    assert pool.constants["owners"].dtype == torch.int32
    for name, value in pool.parameters.items():
        assert value.is_leaf and value.requires_grad
        assert torch.equal(value[7:], value[rows])
        for moment in ("exp_avg", "exp_avg_sq"):
            assert torch.equal(after[f"{moment}.{name}"][:7], before[f"{moment}.{name}"])
            assert not after[f"{moment}.{name}"][7:].any()
    train(pool, 1)
    assert not torch.equal(pool.parameters["means_m"][7:], after["parameters.means_m"][7:])


def test_replaced_rows_forget_what_was_there() -> None:
    pool, rows = some_pool(), torch.tensor([5, 2])
    train(pool, 3)
    before = pool.state()
    new = torch.full((2, 3), 9.0)
    pool.replace(rows, {"means_m": new}, {"owners": torch.tensor([40, 41])})
    after = pool.state()
    untouched = torch.ones(7, dtype=torch.bool)
    untouched[rows] = False
    assert torch.equal(after["parameters.means_m"][rows], new)
    assert after["constants.owners"].tolist() == [0, 1, 41, 3, 4, 40, 6]
    for name, value in after.items():
        if name in ("exp_avg.means_m", "exp_avg_sq.means_m"):
            assert not value[rows].any() and before[name][rows].any()
        if name.endswith("means_m") and value.ndim:
            assert torch.equal(value[untouched], before[name][untouched])
        elif not name.endswith(("means_m", "owners")):
            assert torch.equal(value, before[name]), name


def test_pools_may_be_empty() -> None:
    pool = Pool.of(some_gaussians(0, coefficients=1))
    train(pool, 2)
    assert len(pool) == 0 and len(pool.gaussians()) == 0
    bare = Pool.of(some_gaussians(3, coefficients=1))
    train(bare, 2)
    assert bare.sh.shape == (3, 1, 3)


@given(st.integers(0, 100), st.floats(0.1, 1e3))
def test_the_rate_of_places_falls_evenly_in_its_logarithm(step: int, radius_m: float) -> None:
    rate = position_rate(step, 100, radius_m)
    assert rate == pytest.approx(radius_m * 1.6e-4 * 10 ** (-2 * step / 100), rel=1e-9)
    assert position_rate(100 + step, 100, radius_m) == pytest.approx(radius_m * 1.6e-6)


def test_defaults_are_the_documented_rates() -> None:
    assert RATES["means_m"] == FIRST_POSITION_RATE == 1.6e-4
    assert (RATES["sh_dc"], RATES["sh_rest"], RATES["logit_opacities"]) == (2.5e-3, 1.25e-4, 0.05)
    assert (RATES["log_scales"], RATES["quaternions"]) == (5e-3, 1e-3)


def test_what_does_not_fit_is_refused() -> None:
    pool, rows = some_pool(), torch.tensor([0])
    cases = [
        (lambda: pool.set_rate("colours", 1.0), "no parameter 'colours'"),
        (lambda: pool.set_rate("means_m", -1.0), "rate must be"),
        (lambda: pool.keep(torch.ones(3, dtype=torch.bool)), "mask must be"),
        (lambda: pool.keep(torch.ones(7)), "mask must be"),
        (lambda: pool.replace(rows, {"sh": torch.zeros(1, 4, 3)}), "values must be of"),
        (lambda: pool.replace(rows, {"means_m": torch.zeros(3)}), "means_m must have shape"),
        (lambda: pool.append({"means_m": torch.zeros(1, 3)}), "values must be of"),
        (lambda: pool.append(dict(pool.parameters)), "values must be of"),
        (lambda: Pool.of(some_gaussians(), {"offsets_m": 1.0}), "rates must name"),
        (lambda: Pool.of(some_gaussians(), more={"x": np.zeros(7)}), "rates must name"),
        (lambda: Pool.of(some_gaussians(), owners=np.zeros(3)), "owners must have 7 rows"),
        (lambda: Pool.of(some_gaussians(), sh_dc=np.zeros(7)), "each name may be used once"),
        (lambda: position_rate(-1, 10, 1.0), "step must be"),
        (lambda: position_rate(1, 0, 1.0), "steps must be"),
        (lambda: position_rate(1, 1, 0.0), "radius_m must be"),
    ]
    for call, message in cases:
        with pytest.raises(ArgumentError, match=message):
            call()
