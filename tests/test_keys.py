"""Keys and uniforms: distinct, even, and independent of everything but their arguments."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats

from weather_aug._keys import check_seed, key_of, uniforms
from weather_aug.errors import ArgumentError

SEEDS = [0, -1, 1, 2**31, 2**32, 2**63, 2**64 - 1, -(2**63)]


def test_keys_of_items_and_epochs_are_distinct() -> None:
    keys = {key_of("test", 0, epoch, item) for epoch in range(3) for item in range(100_000)}
    assert len(keys) == 300_000


def test_wide_and_negative_seeds_are_distinct() -> None:
    assert len({key_of("test", seed) for seed in SEEDS}) == len(SEEDS)
    drawn = {tuple(uniforms(key_of("test", seed), 4).tolist()) for seed in SEEDS}
    assert len(drawn) == len(SEEDS)


def test_fields_do_not_run_into_each_other() -> None:
    lists = [(), (0,), (0, 0), (1,), (1, 0), (0, 1), (256,), (0, 256), (1, 1), (257,)]
    assert len({key_of("test", *fields) for fields in lists}) == len(lists)
    assert key_of("test", 1) != key_of("other", 1)


def test_keys_are_these_in_every_process() -> None:
    """Data sets are drawn again from their seeds for years: the keys are part of the format."""
    assert key_of("test", 1, -2, 3) == 0xF38FFEB84EB67670A062146C588B0B4D
    assert uniforms(7, 3).tolist() == [0.8720734548204873, 0.29536538151378355, 0.4200976785072422]


@pytest.mark.parametrize(
    "value", [2**64, -(2**63) - 1, True, 1.0, "1", None, np.array([1, 2]), int]
)
def test_what_is_no_seed_is_refused_by_name(value: Any) -> None:
    with pytest.raises(ArgumentError, match="seed"):
        check_seed("seed", value)
    with pytest.raises(ArgumentError):
        key_of("test", value)


@pytest.mark.parametrize("value", [5, np.int64(5), np.uint8(5), torch.tensor(5)])
def test_integers_of_all_kinds_are_seeds(value: Any) -> None:
    seed = check_seed("seed", value)
    assert (type(seed), seed) == (int, 5)


def test_uniforms_are_even_within_a_key_and_over_keys() -> None:
    within = uniforms(key_of("test", 1), 100_000)
    over = np.array([uniforms(key_of("test", item), 1)[0] for item in range(20_000)])
    for sample in (within, over):
        assert sample.min() >= 0
        assert sample.max() < 1
        assert stats.kstest(sample, "uniform").pvalue >= 1e-6
        counts = np.histogram(sample, bins=64, range=(0, 1))[0]
        assert stats.chisquare(counts).pvalue >= 1e-6
        # Neighbours do not know of each other.
        assert abs(np.corrcoef(sample[:-1], sample[1:])[0, 1]) <= 4 / np.sqrt(len(sample))


def test_uniforms_begin_alike_at_any_count() -> None:
    assert (uniforms(9, 5) == uniforms(9, 50)[:5]).all()


def test_global_generators_are_neither_read_nor_moved() -> None:
    def drawn() -> list[float]:
        return uniforms(key_of("test", 3), 8).tolist()

    random.seed(0)
    np.random.seed(0)  # noqa: NPY002 - the global state is what is tested
    torch.manual_seed(0)
    states = (random.getstate(), np.random.get_state()[1].tolist(), torch.get_rng_state().tolist())  # noqa: NPY002
    first = drawn()
    after = (random.getstate(), np.random.get_state()[1].tolist(), torch.get_rng_state().tolist())  # noqa: NPY002
    assert states == after
    random.seed(1)
    np.random.seed(1)  # noqa: NPY002
    torch.manual_seed(1)
    assert drawn() == first
