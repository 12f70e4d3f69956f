"""Densification by gradient: who is copied, split, taken away, and what each keeps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_densify import pool_of
from test_pool import same, train

from weather_aug.errors import ArgumentError, DataError
from weather_aug.gaussians import splitting
from weather_aug.gaussians.pool import Pool
from weather_aug.gaussians.splitting import Splitting

ROUND = 600
SMALL, BIG = 0.05, 0.5
"""Standard deviations, metres; the radius is 10 m, so that 0.1 m lies between."""


def strategy_of(**options: float) -> Splitting:
    return Splitting(**{"cap": 1000, "radius_m": 10.0, **options})  # type: ignore[arg-type]


def sized(opacities: list[float], sizes_m: list[float]) -> Pool:
    gaussians = pool_of(opacities).gaussians()
    scales = np.log(np.array(sizes_m, np.float32))[:, None] + np.array([0, -1, -1], np.float32)
    owners = np.arange(len(opacities), dtype=np.int32)
    return Pool.of(replace(gaussians, log_scales=scales), owners=owners)


def note(strategy: Splitting, pool: Pool, pulls: list[float], **more: object) -> None:
    """One picture of 200 x 100 pixels that pulls so hard to the right, in its coordinates."""
    grad = torch.tensor([[pull / 100.0, 0.0] for pull in pulls])
    radii = torch.tensor(more.get("radii", [5.0] * len(pulls)))
    strategy.after_backward(pool, 550, centres_grad_px=grad, radii_px=radii, width=200, height=100)


def test_small_ones_are_copied_in_place_and_share_their_opacity() -> None:
    pool, strategy = sized([0.8, 0.5], [SMALL, SMALL]), strategy_of()
    before = pool.gaussians()
    note(strategy, pool, [1e-3, 1e-5])
    strategy.after_step(pool, ROUND)
    assert pool.constants["owners"].tolist() == [0, 1, 0]
    assert torch.equal(pool.parameters["means_m"][2], torch.tensor(before.means_m[0]))
    assert torch.equal(pool.parameters["log_scales"][2], torch.tensor(before.log_scales[0]))
    assert float((1 - pool.opacities.detach()[[0, 2]]).prod()) == pytest.approx(0.2, rel=1e-5)
    assert float(pool.opacities.detach()[1]) == pytest.approx(0.5)


def test_big_ones_become_two_smaller_ones_drawn_from_them() -> None:
    count = 3000
    pool, strategy = sized([0.8] * count, [BIG] * count), strategy_of(cap=10**6)
    before = pool.gaussians()
    note(strategy, pool, [1e-3] * count)
    strategy.after_step(pool, ROUND)
    assert len(pool) == 2 * count
    owners = pool.constants["owners"].long()
    assert bool((torch.bincount(owners) == 2).all())
    shrunk = before.log_scales[owners] - np.log(1.6)
    assert np.allclose(pool.gaussians().log_scales, shrunk, atol=1e-5)
    offsets = (pool.gaussians().means_m - before.means_m[owners]).astype(float)
    quaternions = torch.tensor(before.quaternions[owners]).double()
    local = splitting.turned(torch.tensor(offsets), quaternions, back=True).numpy()
    expected = BIG * np.exp([0, -1, -1])
    assert np.allclose(local.std(axis=0), expected, rtol=0.05)
    assert np.abs(local.mean(axis=0)).max() < 0.03 * BIG
    for value in pool.parameters.values():
        assert not pool._adam.state[value]["exp_avg"].any()


def test_the_faded_and_the_too_large_are_taken_away() -> None:
    pool, strategy = sized([0.8, 0.004, 0.006, 0.8], [BIG] * 4), strategy_of()
    note(strategy, pool, [0.0, 0.0, 0.0, 0.0], radii=[29.0, 5.0, 5.0, 31.0])
    strategy.after_step(pool, ROUND)
    assert pool.constants["owners"].tolist() == [0, 2]


def test_pulls_are_means_over_the_pictures_that_show_a_gaussian() -> None:
    for hard, times, hidden, grown in ((3e-4, 1, 5, 1), (3e-4, 1, 0, 1), (1e-4, 9, 0, 0)):
        pool, strategy = sized([0.5], [SMALL]), strategy_of()
        for _ in range(times):
            note(strategy, pool, [hard])
        for _ in range(hidden):
            note(strategy, pool, [hard], radii=[0.0])
        strategy.after_step(pool, ROUND)
        assert len(pool) == 1 + grown


def test_pulls_count_in_normalised_coordinates() -> None:
    for grad, grown in (((2.1e-6, 0.0), 1), ((0.0, 2.1e-6), 0), ((0.0, 4.1e-6), 1)):
        pool, strategy = sized([0.5], [SMALL]), strategy_of()
        strategy.after_backward(
            pool,
            0,
            centres_grad_px=torch.tensor([grad]),
            radii_px=torch.tensor([3.0]),
            width=200,
            height=100,
        )
        strategy.after_step(pool, ROUND)
        assert len(pool) == 1 + grown


def test_under_a_cap_the_hardest_pulled_go_first() -> None:
    pool, strategy = sized([0.5] * 5, [SMALL, BIG] * 2 + [SMALL]), strategy_of(cap=7)
    note(strategy, pool, [3e-4, 9e-4, 4e-4, 3e-4, 8e-4])
    strategy.after_step(pool, ROUND)
    assert sorted(pool.constants["owners"].tolist()) == [0, 1, 1, 2, 3, 4, 4]
    full = strategy_of(cap=3)
    note(full, pool, [1e-3] * 7)
    full.after_step(pool, ROUND)
    assert len(pool) == 7


def test_opacities_are_lowered_and_adam_forgets_them_alone() -> None:
    pool, strategy = sized([0.8, 0.007], [SMALL, SMALL]), strategy_of()
    train(pool, 2)
    before = pool.state()
    strategy.after_step(pool, 3000)
    after = pool.state()
    assert float(pool.opacities.detach()[0]) == pytest.approx(0.01)
    assert after["parameters.logit_opacities"][1] == before["parameters.logit_opacities"][1]
    assert not after["exp_avg.logit_opacities"].any() and after["exp_avg.means_m"].any()


def test_nothing_happens_out_of_time() -> None:
    strategy = strategy_of(stop=5000)
    for step in (0, 500, 650, 5000, 6000):
        pool = sized([0.5, 0.001], [SMALL, BIG])
        note(strategy, pool, [1e-3, 1e-3])
        before = pool.state()
        strategy.after_step(pool, step)
        assert same(before, pool.state()), step


def test_notes_start_anew_after_a_round_and_survive_a_restart() -> None:
    pools, states = [], []
    for broken in (False, True):
        pool, strategy = sized([0.5, 0.5], [SMALL, BIG]), strategy_of()
        note(strategy, pool, [1e-3, 1e-4])
        strategy.after_step(pool, ROUND)
        note(strategy, pool, [0.0, 1e-3, 0.0])
        if broken:
            state = strategy.state()
            strategy = strategy_of()
            strategy.restore(state)
        note(strategy, pool, [0.0, 0.0, 1e-3])
        strategy.after_step(pool, 700)
        pools.append(pool)
        states.append(pool.state())
    assert same(*states) and len(pools[0]) == 5
    with pytest.raises(DataError, match="another strategy"):
        strategy_of().restore({"x": torch.zeros(1)})


def test_copies_that_do_not_share_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """A planted fault: the released 3DGS's copies, which make the picture more opaque."""

    def plain(self: Splitting, pool: Pool, rows: torch.Tensor) -> None:
        pool.append(*splitting.rows_of(pool, rows))

    monkeypatch.setattr(Splitting, "_copy", plain)
    with pytest.raises(AssertionError):
        test_small_ones_are_copied_in_place_and_share_their_opacity()


def test_what_does_not_fit_is_refused() -> None:
    pool, strategy = sized([0.5], [SMALL]), strategy_of()
    with pytest.raises(ArgumentError, match="must have 1 rows"):
        note(strategy, pool, [1e-3, 1e-3])
    note(strategy, pool, [1e-3])
    with pytest.raises(ArgumentError, match="after_step alone"):
        note(strategy, sized([0.5, 0.5], [SMALL, SMALL]), [1e-3, 1e-3])
    for wrong in ({"cap": 0}, {"threshold": -1.0}, {"large_share": 0.0}, {"reset_every": 0}):
        with pytest.raises(ArgumentError, match=next(iter(wrong))):
            strategy_of(**wrong)
