"""Keyed orders, and numbers that are dealt out evenly."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from weather_aug.transforms.permutation import dealt, permutation


@given(st.integers(-(2**63), 2**64 - 1), st.integers(0, 2**63 - 1), st.integers(1, 300))
def test_it_holds_each_number_once(seed: int, epoch: int, count: int) -> None:
    order = permutation("test", seed, epoch, count)
    assert sorted(order.tolist()) == list(range(count))
    assert not order.flags.writeable


def test_it_is_what_it_was() -> None:
    """A training is resumed by a newer version of numpy, too."""
    assert permutation("test", 7, 2, 8).tolist() == [0, 6, 4, 1, 7, 2, 3, 5]


def test_domains_seeds_epochs_and_lengths_differ() -> None:
    calls = [("a", 0, 0), ("b", 0, 0), ("a", 1, 0), ("a", 0, 1), ("a", -1, 0), ("a", 1, 1)]
    found = {tuple(permutation(*call, 50).tolist()) for call in calls}
    assert len(found) == len(calls)


def test_all_orders_are_equally_likely() -> None:
    """Chi squared of 24 orders of 4 over 24000 epochs; 23 degrees of freedom, p = 1e-6 at 73."""
    found = Counter(tuple(permutation("test", 3, e, 4).tolist()) for e in range(24_000))
    assert len(found) == 24
    assert sum((n - 1000) ** 2 / 1000 for n in found.values()) < 73


@given(
    st.integers(0, 2**64 - 1),
    st.integers(1, 200),
    st.lists(st.floats(0.01, 1.0), min_size=1, max_size=6),
)
def test_shares_are_exact_to_less_than_one(seed: int, count: int, weights: list[float]) -> None:
    numbers = [dealt(seed, 1, item, count) for item in range(count)]
    assert 0 < min(numbers) <= max(numbers) < 1
    bounds = np.cumsum([0.0, *weights]) / sum(weights)
    found, _ = np.histogram(numbers, bounds)
    assert np.abs(found - count * np.diff(bounds)).max() < 1 + 1e-9


def test_draws_of_their_own_would_not_be_even(monkeypatch: pytest.MonkeyPatch) -> None:
    """The property above is none of independent uniforms."""
    monkeypatch.setattr(
        "weather_aug.transforms.permutation.permutation",
        lambda domain, seed, epoch, count: np.zeros(count, np.int64),
    )
    numbers = [dealt(0, 1, item, 100) for item in range(100)]
    assert max(numbers) < 0.1


def test_the_middle_of_each_item_is_anywhere() -> None:
    """One item over the epochs: uniform, by ten bins of 400 (9 degrees of freedom, p = 1e-6)."""
    numbers = [dealt(5, epoch, 3, 7) for epoch in range(4000)]
    bins = np.bincount((np.array(numbers) * 10).astype(int), minlength=10)
    assert ((bins - 400.0) ** 2 / 400).sum() < 45
