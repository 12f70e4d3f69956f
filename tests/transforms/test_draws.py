"""Keys of draws: named samples are the same everywhere, unnamed ones never repeat."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.utils.data import DataLoader, Dataset

from weather_aug.errors import ArgumentError
from weather_aug.transforms import draws as draws_module
from weather_aug.transforms.draws import Draws, SharedEpoch, picture_field, sample_fields

PICTURE = np.zeros((16, 16, 3), np.uint8)
names = st.recursive(
    st.integers(-(2**63), 2**63 - 1) | st.text(max_size=8),
    lambda part: st.tuples(part, part),
    max_leaves=1,
) | st.tuples(st.integers(0, 9), st.text(max_size=3))
forks = pytest.mark.filterwarnings(
    # Loaders fork by default on Linux; Python 3.12 warns of it wherever torch has threads.
    "ignore:This process .* is multi-threaded, use of fork:DeprecationWarning"
)


class Keys(Dataset[Any]):
    """Keys that a transform would draw by; all pictures are equal, so that nothing else differs."""

    def __init__(self, draws: Draws, named: bool, length: int = 12) -> None:
        self.draws, self.named, self.length = draws, named, length

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: int) -> str:
        return str(self.draws.key(PICTURE, index if self.named else None))


def keys_of(draws: Draws, *, named: bool, workers: int, epochs: int = 1) -> list[str]:
    loader = DataLoader(
        Keys(draws, named),
        batch_size=None,
        num_workers=workers,
        persistent_workers=workers > 0,
        multiprocessing_context="fork" if workers else None,
        timeout=60 if workers else 0,
    )
    found = []
    for epoch in range(epochs):
        draws.set_epoch(epoch)
        found += list(loader)
    return found


@forks
def test_named_samples_do_not_depend_on_workers() -> None:
    runs = [keys_of(Draws("t", 3), named=True, workers=n, epochs=2) for n in (0, 1, 2)]
    assert len(set(runs[0])) == 24
    assert runs[0] == runs[1] == runs[2]


@forks
def test_unnamed_samples_never_repeat_in_workers_or_epochs() -> None:
    for workers in (0, 1, 2):
        assert len(set(keys_of(Draws("t", 3), named=False, workers=workers, epochs=2))) == 24


@forks
def test_without_the_workers_seed_they_would(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(draws_module, "worker_seed", lambda: 0)
    assert len(set(keys_of(Draws("t", 3), named=False, workers=2))) == 6


def test_seed_domain_epoch_and_name_decide() -> None:
    def key(domain: str = "t", seed: int = 1, epoch: int = 0, sample: Any = 5) -> int:
        draws = Draws(domain, seed)
        draws.set_epoch(epoch)
        return draws.key(PICTURE, sample)

    assert key() == key()
    others = {
        key(domain="u"),
        key(seed=2),
        key(epoch=1),
        key(sample=6),
        key(sample="5"),
        key(sample=(5, 5)),
        key(sample=(0, 5)),
    }
    assert len(others | {key()}) == 8


@given(names, names)
def test_different_names_have_different_fields(a: Any, b: Any) -> None:
    same = a == b or (isinstance(a, tuple) and (b,) == a) or (isinstance(b, tuple) and (a,) == b)
    assert (sample_fields(a) == sample_fields(b)) == same


@pytest.mark.parametrize("name", [1.5, None, [None], True, (1, 2.0), 2**64])
def test_what_is_no_name_is_refused(name: Any) -> None:
    with pytest.raises(ArgumentError, match="sample_key"):
        sample_fields(name)


def test_pictures_tell_processes_apart() -> None:
    """Copies of a transform in processes that are no workers count alike."""
    bright = PICTURE + np.uint8(1)
    assert Draws("t", 0).key(PICTURE) == Draws("t", 0).key(PICTURE)
    assert Draws("t", 0).key(PICTURE) != Draws("t", 0).key(bright)
    assert picture_field(PICTURE) != picture_field(bright)
    assert picture_field(PICTURE[::-1, ::2]) == picture_field(np.zeros((16, 8, 3), np.uint8))
    assert isinstance(picture_field(np.zeros((4, 16, 16, 3), np.uint8)), int)


@pytest.mark.parametrize("picture", [PICTURE[..., 0], PICTURE[0, 0], PICTURE.tolist(), None])
def test_what_is_no_picture_is_refused(picture: Any) -> None:
    with pytest.raises(ArgumentError, match="image must"):
        Draws("t", 0).key(picture)


@pytest.mark.parametrize("again", [copy.deepcopy, lambda d: pickle.loads(pickle.dumps(d))])
def test_a_copy_goes_on_alike_and_has_its_own_epoch(again: Any) -> None:
    draws = Draws("t", 4)
    draws.set_epoch(7)
    draws.key(PICTURE)
    other = again(draws)
    assert other.epoch == 7
    assert [draws.key(PICTURE) for _ in range(3)] == [other.key(PICTURE) for _ in range(3)]
    other.set_epoch(8)
    assert draws.epoch == 7
    assert draws.key(PICTURE, 1) != other.key(PICTURE, 1)


@pytest.mark.parametrize("epoch", [-1, 2**63, 1.0, "1", None])
def test_an_epoch_that_is_none_is_refused(epoch: Any) -> None:
    with pytest.raises(ArgumentError, match="epoch must be"):
        SharedEpoch().value = epoch


def test_a_seed_that_is_none_is_refused() -> None:
    with pytest.raises(ArgumentError, match="seed must be"):
        Draws("t", 2**64)


def test_no_global_generator_is_read_or_moved() -> None:
    before = torch.get_rng_state().tolist(), str(np.random.get_state())  # noqa: NPY002
    key = Draws("t", 0).key(PICTURE)
    assert (torch.get_rng_state().tolist(), str(np.random.get_state())) == before  # noqa: NPY002
    torch.manual_seed(5)
    assert Draws("t", 0).key(PICTURE) == key
