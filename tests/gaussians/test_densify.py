"""Relocation: what is moved keeps the picture, the count stays under its cap, draws are keyed."""

from __future__ import annotations

from dataclasses import replace
from math import comb

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from test_pool import same, some_gaussians, train

from weather_aug.errors import ArgumentError, DataError
from weather_aug.gaussians import densify
from weather_aug.gaussians.densify import MIN_OPACITY, Relocation, perturb, shared
from weather_aug.gaussians.drawing import drawn_rows, generator_of, turned
from weather_aug.gaussians.pool import Pool

ROUND = 600
STILL = Relocation(cap=1000, radius_m=10.0, seed=3, noise=0.0)


def pool_of(opacities: list[float], seed: int = 0) -> Pool:
    gaussians = some_gaussians(len(opacities), seed=seed)
    wide = np.asarray(opacities)
    logits = np.log(wide / (1 - wide)).astype(np.float32)
    owners = np.arange(len(opacities), dtype=np.int32)
    pool = Pool.of(replace(gaussians, logit_opacities=logits), owners=owners)
    for value in pool.parameters.values():
        for moment in ("exp_avg", "exp_avg_sq"):
            pool._adam.state[value][moment].fill_(1.0)
    return pool


def light_through(opacity: float, size: float, copies: int) -> float:
    """Light that a stack of equal Gaussians takes along a line through it, by summing it up."""
    x = np.linspace(-12 * size, 12 * size, 40_001)
    stack = 1 - (1 - opacity * np.exp(-0.5 * (x / size) ** 2)) ** copies
    return float(stack.sum() * (x[1] - x[0]))


@given(st.floats(0.006, 0.995), st.integers(1, 51))
def test_a_stack_lets_through_what_the_one_did(opacity: float, copies: int) -> None:
    each, factor = shared(torch.tensor([opacity], dtype=torch.float64), torch.tensor([copies]))
    assert (1 - float(each)) ** copies == pytest.approx(1 - opacity, rel=1e-9)
    one, stack = light_through(opacity, 1.0, 1), light_through(float(each), float(factor), copies)
    assert stack == pytest.approx(one, rel=1e-6)


@given(st.floats(0.01, 0.99), st.integers(1, 51))
def test_the_factor_is_the_papers_double_sum(opacity: float, copies: int) -> None:
    each, factor = shared(torch.tensor([opacity], dtype=torch.float64), torch.tensor([copies]))
    o = float(each)
    total = sum(
        comb(i - 1, k) * (-1) ** k * o ** (k + 1) / np.sqrt(k + 1)
        for i in range(1, copies + 1)
        for k in range(i)
    )
    assert float(factor) == pytest.approx(opacity / total, rel=1e-7)


def test_copies_as_opaque_as_the_original_would_show() -> None:
    """A planted fault: 3DGS's plain copy."""
    assert light_through(0.5, 1.0, 2) > 1.2 * light_through(0.5, 1.0, 1)


def test_shares_of_many_are_those_of_each() -> None:
    opacities, copies = torch.tensor([0.2, 0.9, 0.5]), torch.tensor([51, 2, 1])
    each, factor = shared(opacities, copies)
    for i in range(3):
        alone = shared(opacities[i : i + 1], copies[i : i + 1])
        assert torch.equal(each[i : i + 1], alone[0]) and torch.equal(factor[i : i + 1], alone[1])
    assert each[2] == 0.5 and factor[2] == 1


def test_the_dead_are_gone_and_the_light_is_kept() -> None:
    pool = pool_of([0.8, 0.001, 0.4, 0.004, 0.002, 0.6, 0.005])
    before = pool.gaussians()
    replace(STILL, grow=1.0).after_step(pool, ROUND)
    assert len(pool) == 7 and bool((pool.opacities > MIN_OPACITY).all())
    # Owners tell where each stands now; the dead had 1, 3, 4 and 6.
    owners = pool.constants["owners"]
    assert set(owners.tolist()) <= {0, 2, 5}
    for owner, opacity in ((0, 0.8), (2, 0.4), (5, 0.6)):
        there = owners == owner
        assert float((1 - pool.opacities.detach()[there]).prod()) == pytest.approx(
            1 - opacity, rel=1e-5
        )
        assert bool(
            (pool.parameters["means_m"][there] == torch.tensor(before.means_m[owner])).all()
        )
        factor = (
            pool.parameters["log_scales"][there].detach() - torch.tensor(before.log_scales[owner])
        ).exp()
        _, expected = shared(torch.tensor([opacity]), there.sum()[None])
        assert torch.allclose(factor, expected.expand_as(factor), rtol=1e-4)


def test_adam_forgets_moved_rows_and_their_sources_and_no_others() -> None:
    pool = pool_of([0.8, 0.001, 0.4])
    replace(STILL, grow=1.0).after_step(pool, ROUND)
    source = int(pool.constants["owners"][1])
    other = 2 - source
    for name, value in pool.parameters.items():
        memory = pool._adam.state[value]
        for moment in ("exp_avg", "exp_avg_sq"):
            assert not memory[moment][[1, source]].any(), name
            assert bool((memory[moment][other] == 1).all()), name


@given(st.integers(1, 60), st.integers(1, 60), st.integers(0, 5))
def test_the_count_grows_by_a_twentieth_up_to_the_cap(count: int, cap: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    pool = pool_of(list(rng.uniform(0.001, 0.9, count)))
    strategy = replace(STILL, cap=cap, grow=1.05)
    for _ in range(4):
        before = len(pool)
        strategy.after_step(pool, ROUND)
        alive = bool((pool.opacities > MIN_OPACITY).any())
        expected = max(before, min(cap, int(1.05 * before))) if alive else before
        assert len(pool) == expected
        assert len(pool.constants["owners"]) == len(pool)


def test_rounds_happen_when_they_should() -> None:
    for step, happens in ((500, False), (600, True), (650, False), (900, True), (1000, False)):
        pool = pool_of([0.8, 0.001])
        replace(STILL, stop=1000).after_step(pool, step)
        assert bool((pool.opacities > MIN_OPACITY).all()) == happens, step


def test_a_pool_of_dead_alone_stays() -> None:
    pool = pool_of([0.001, 0.002])
    before = pool.state()
    STILL.after_step(pool, ROUND)
    assert same(before, pool.state())


def test_all_hangs_on_seed_and_step() -> None:
    states = []
    for seed, step in ((3, 600), (3, 600), (4, 600), (3, 700)):
        pool = pool_of([0.02] * 40 + [0.001] * 10)
        torch.rand(step)  # Draws elsewhere change nothing.
        Relocation(cap=60, radius_m=10.0, seed=seed).after_step(pool, step)
        states.append(pool.state())
    assert same(states[0], states[1])
    assert not same(states[0], states[2]) and not same(states[0], states[3])


def test_a_fit_restored_between_rounds_goes_on_to_the_bit() -> None:
    strategy = Relocation(cap=40, radius_m=10.0, start=0, every=3, grow=1.2)

    def go(pool: Pool, first: int, last: int) -> None:
        for step in range(first, last):
            train(pool, 1, first=step)
            strategy.after_step(pool, step)

    straight, broken = pool_of([0.5, 0.001] * 8), pool_of([0.5, 0.001] * 8)
    go(straight, 0, 10)
    go(broken, 0, 5)
    resumed = Pool.of_state(broken.state())
    strategy.restore(strategy.state())
    go(resumed, 5, 10)
    assert same(straight.state(), resumed.state()) and len(resumed) > 16
    with pytest.raises(DataError, match="another strategy"):
        strategy.restore({"pulls": torch.zeros(3)})


def test_noise_has_the_papers_covariance() -> None:
    count, radius, opacity = 20_000, 8.0, 0.004
    one = pool_of([opacity]).gaussians()
    many = replace(
        one,
        means_m=np.zeros((count, 3), np.float32),
        quaternions=one.quaternions.repeat(count, 0),
        log_scales=np.log(np.array([[0.5, 0.1, 0.02]], np.float32)).repeat(count, 0),
        logit_opacities=one.logit_opacities.repeat(count),
        sh=one.sh.repeat(count, 0),
        class_scores=np.zeros((count, 0), np.float16),
    )
    pool = Pool.of(many, {"means_m": 1e-3})
    perturb(pool, 5, seed=1, radius_m=radius)
    moved = pool.parameters["means_m"].detach().double().numpy()
    w, x, y, z = one.quaternions[0].astype(float) / np.linalg.norm(one.quaternions[0])
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    covariance = turn @ np.diag([0.25, 0.01, 4e-4]) @ turn.T
    gate = 1 / (1 + np.exp(-100 * (0.005 - opacity)))
    scaled = 5e5 * 1e-3 / radius**2 * gate * covariance
    assert np.allclose(
        moved.T @ moved / count, scaled @ scaled, atol=0.03 * (scaled @ scaled).max()
    )


def test_noise_stirs_the_faint_alone_and_does_not_hang_on_the_unit() -> None:
    pool = pool_of([0.003, 0.9, 0.15])
    before = pool.parameters["means_m"].detach().clone()
    perturb(pool, 5, seed=1, radius_m=10.0)
    far = (pool.parameters["means_m"].detach() - before).norm(dim=1)
    assert far[1] == 0 and far[0] > 1e3 * far[2] > 0
    small = pool_of([0.003, 0.9, 0.15])
    with torch.no_grad():
        small.parameters["means_m"] *= 0.01
        small.parameters["log_scales"] += float(np.log(0.01))
    small.set_rate("means_m", 0.01 * pool.rates["means_m"])
    perturb(small, 5, seed=1, radius_m=0.1)
    torch.testing.assert_close(100 * small.parameters["means_m"], pool.parameters["means_m"])


def test_rows_are_drawn_in_proportion() -> None:
    weights = torch.tensor([0.0, 1.0, 0.0, 3.0, 0.0])
    rows = drawn_rows(weights, 40_000, generator_of("test", 0, 0))
    counts = torch.bincount(rows, minlength=5)
    assert counts[[0, 2, 4]].sum() == 0
    assert float(counts[3]) / 40_000 == pytest.approx(0.75, abs=0.01)


def test_turning_back_undoes_turning() -> None:
    draws = generator_of("test", 1, 0)
    vectors, quaternions = (torch.randn(9, n, generator=draws).double() for n in (3, 4))
    there = turned(vectors, quaternions)
    torch.testing.assert_close(turned(there, quaternions, back=True), vectors)
    torch.testing.assert_close(turned(vectors, -3 * quaternions), there)


def test_a_plain_copy_in_relocations_place_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(densify, "shared", lambda opacities, copies: (opacities, 1 + 0 * opacities))
    with pytest.raises(AssertionError):
        test_the_dead_are_gone_and_the_light_is_kept()


@pytest.mark.parametrize(
    "wrong",
    [
        {"cap": 0},
        {"radius_m": 0.0},
        {"every": 0},
        {"grow": 0.5},
        {"min_opacity": 0.0},
        {"noise": -1},
    ],
)
def test_numbers_out_of_range_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ArgumentError, match=next(iter(wrong))):
        replace(STILL, **wrong)
