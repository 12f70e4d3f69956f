"""WeatherSampler: an epoch's order, its parts for several ranks, and going on in its middle."""

from __future__ import annotations

import copy
import json
import pickle
import random
import time
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from test_dataset import digest_of, digests, forks
from tiny_clip import TinyClip
from torch.utils.data import DataLoader

from weather_aug.errors import ArgumentError, ConflictError
from weather_aug.render.options import RenderOptions
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.scene.scene import WeatherScene
from weather_aug.transforms.curriculum import SeverityCurriculum
from weather_aug.transforms.dataset import WeatherDataset
from weather_aug.transforms.sampler import WeatherSampler
from weather_aug.transforms.sampling import RareClass

POLICY = WeatherPolicy({"rain": 1, "snow": 1, "fog": 1})
TIMEOUT_S = 120
SHORT = 11
"""Items of an epoch that is rendered, six batches of two."""
RESTORE_S = 0.05
many = pytest.mark.filterwarnings("ignore:This DataLoader will create:UserWarning")


def dataset_of(scene: WeatherScene, length: int = 23, **choices: Any) -> WeatherDataset:
    given = {"seed": 4, "crop": (8, 8), "length": length}
    return WeatherDataset([scene], POLICY, **(given | choices))


@pytest.fixture
def dataset(tiny_scene: WeatherScene) -> WeatherDataset:
    return dataset_of(tiny_scene)


def test_an_epoch_has_every_item_once_in_an_order_of_its_own(dataset: WeatherDataset) -> None:
    sampler = WeatherSampler(dataset)
    orders = []
    for epoch in range(4):
        sampler.set_epoch(epoch)
        assert sampler.epoch == dataset.epoch == epoch
        orders.append(tuple(sampler))
        assert list(sampler) == list(orders[-1])
        assert len(sampler) == len(orders[-1])
        assert sorted(orders[-1]) == list(range(23))
    assert len(set(orders)) == 4
    dataset.set_epoch(2)
    assert tuple(sampler) == orders[2]


def test_unshuffled_it_counts(dataset: WeatherDataset) -> None:
    assert list(WeatherSampler(dataset, shuffle=False)) == list(range(23))


def test_seeds_differ_and_are_the_datasets_by_default(tiny_scene: WeatherScene) -> None:
    orders = {
        tuple(WeatherSampler(dataset_of(tiny_scene, seed=seed), seed=own))
        for seed, own in ((4, None), (5, None), (4, -1), (4, 2**64 - 1))
    }
    assert len(orders) == 4
    again = WeatherSampler(dataset_of(tiny_scene, seed=5), seed=4)
    assert tuple(again) in orders


def test_global_generators_are_neither_read_nor_moved(dataset: WeatherDataset) -> None:
    before = (random.getstate(), torch.get_rng_state().tolist())
    numpy_before = np.random.get_state()[1].tolist()  # noqa: NPY002 - what is tested
    order = list(WeatherSampler(dataset))
    assert (random.getstate(), torch.get_rng_state().tolist()) == before
    assert np.random.get_state()[1].tolist() == numpy_before  # noqa: NPY002
    torch.manual_seed(3)
    assert list(WeatherSampler(dataset)) == order


@pytest.mark.parametrize("ranks", [1, 2, 4, 5, 40])
@pytest.mark.parametrize("shuffle", [True, False])
def test_ranks_share_an_epoch(dataset: WeatherDataset, ranks: int, shuffle: bool) -> None:
    """D8: all ranks together have the one-rank epoch, and what is declared as padding."""
    samplers = [WeatherSampler(dataset, shuffle=shuffle, rank=r, ranks=ranks) for r in range(ranks)]
    parts = [list(sampler) for sampler in samplers]
    assert {len(part) for part in parts} == {len(samplers[0])} == {-(-23 // ranks)}
    declared = samplers[0].padding
    assert all(sampler.padding == declared for sampler in samplers)
    assert len(declared) == -23 % ranks
    everything = Counter(item for part in parts for item in part)
    assert everything == Counter(range(23)) + Counter(declared)


def test_undeclared_padding_would_be_seen(dataset: WeatherDataset) -> None:
    """The comparison above is one of multisets."""
    parts = [list(WeatherSampler(dataset, rank=r, ranks=4)) for r in range(4)]
    assert Counter(item for part in parts for item in part) != Counter(range(23))


def moved(state: dict[str, Any]) -> dict[str, Any]:
    """A state as it comes out of a JSON file."""
    text = json.dumps(state, allow_nan=False)
    assert len(text.encode()) <= 4096
    return json.loads(text)


@pytest.mark.parametrize("ranks", [1, 2, 3])
def test_every_position_goes_on_exactly(tiny_scene: WeatherScene, ranks: int) -> None:
    """D7, of the order: after k samples of each rank the same samples follow as without a stop."""
    for rank in range(ranks):
        sampler = WeatherSampler(dataset_of(tiny_scene, 100), rank=rank, ranks=ranks)
        sampler.set_epoch(3)
        order, padding = list(sampler), sampler.padding
        again = WeatherSampler(dataset_of(tiny_scene, 100), rank=rank, ranks=ranks)
        for k in range(len(order) + 1):
            state = moved(sampler.state_dict(done=k))
            again.load_state_dict(state)
            assert list(again) == order[k:], k
            assert len(again) == len(order) - k
            assert again.epoch == 3
            assert again.padding == (padding if k < len(order) else ())


@pytest.fixture(scope="module")
def day(tiny_scene: WeatherScene) -> WeatherDataset:
    return dataset_of(tiny_scene, 24)


stops = st.lists(st.tuples(st.sampled_from([1, 2, 3, 4]), st.floats(0, 1)), max_size=5)


@given(stops)
def test_a_training_is_stopped_again_and_again(
    day: WeatherDataset, stops: list[tuple[int, float]]
) -> None:
    """However often, and on other numbers of ranks each time: no item comes twice or never."""
    used: Counter[int] = Counter()
    state = WeatherSampler(day).state_dict()
    for ranks, share in [*stops, (2, 1.0)]:
        samplers = [WeatherSampler(day, rank=r, ranks=ranks) for r in range(ranks)]
        for sampler in samplers:
            sampler.load_state_dict(state)
        done = int(share * len(samplers[0]))
        for sampler in samplers:
            used.update(list(sampler)[:done])
        if done == len(samplers[0]):
            used.subtract(samplers[0].padding)
        state = moved(samplers[0].state_dict(done))
    assert state["used"] == 24
    assert +used == Counter(range(24))


def resumable(scene: WeatherScene, workers: int, **how: Any) -> tuple[WeatherSampler, Any]:
    sampler = WeatherSampler(dataset_of(scene, SHORT))
    loader = DataLoader(
        sampler.dataset,
        batch_size=2,
        sampler=sampler,
        num_workers=workers,
        multiprocessing_context="fork" if workers else None,
        timeout=TIMEOUT_S if workers else 0,
        **how,
    )
    return sampler, loader


@pytest.fixture(scope="module")
def uninterrupted(tiny_scene: WeatherScene) -> list[str]:
    """Digests of two epochs' samples in their order, drawn here."""
    sampler = WeatherSampler(dataset_of(tiny_scene, SHORT))
    found = []
    for epoch in (0, 1):
        sampler.set_epoch(epoch)
        found += [digest_of(sampler.dataset[item]) for item in sampler]
    return found


def train(scene: WeatherScene, workers: int, stop: int, state: Any) -> tuple[list[str], Any]:
    """A training loop over two epochs that is cut after `stop` batches; what it saw, its state."""
    sampler, loader = resumable(scene, workers)
    if state is not None:
        sampler.load_state_dict(state)
    seen: list[str] = []
    batches = 0
    for epoch in range(sampler.epoch, 2):
        sampler.set_epoch(epoch)
        for batch in sampler.follow(loader):
            seen += digests([batch])
            batches += 1
            if batches == stop:
                return seen, moved(sampler.state_dict())
    return seen, moved(sampler.state_dict())


def test_every_stop_of_a_training_loop_goes_on(
    tiny_scene: WeatherScene, uninterrupted: list[str]
) -> None:
    """D7, of the samples: 12 batches of two epochs, cut after each."""
    for stop in range(1, 13):
        first, state = train(tiny_scene, 0, stop, None)
        second, _ = train(tiny_scene, 0, 99, state)
        assert first + second == uninterrupted, stop


@many
@forks
@pytest.mark.parametrize(("before", "after", "stop"), [(2, 2, 3), (2, 0, 4), (1, 3, 8)])
def test_prefetching_workers_do_not_count(
    tiny_scene: WeatherScene, uninterrupted: list[str], before: int, after: int, stop: int
) -> None:
    """D7 with the same number of workers and another; they have drawn more than was used."""
    first, state = train(tiny_scene, before, stop, None)
    second, _ = train(tiny_scene, after, 99, state)
    assert first + second == uninterrupted


@pytest.mark.slow
@many
@forks
@pytest.mark.parametrize("workers", [(2, 2), (3, 1)])
def test_every_stop_goes_on_with_workers(
    tiny_scene: WeatherScene, uninterrupted: list[str], workers: tuple[int, int]
) -> None:
    for stop in range(1, 13):
        first, state = train(tiny_scene, workers[0], stop, None)
        second, _ = train(tiny_scene, workers[1], 99, state)
        assert first + second == uninterrupted, stop


@forks
def test_counting_what_was_drawn_would_be_seen(
    tiny_scene: WeatherScene, uninterrupted: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sampler that counts what it has given to workers, as many do, leaves samples out."""
    given = []

    def counted(self: WeatherSampler) -> Iterator[int]:
        for item in plain(self):
            given.append(item)
            yield item

    plain = WeatherSampler.__iter__
    monkeypatch.setattr(WeatherSampler, "__iter__", counted)
    monkeypatch.setattr(WeatherSampler, "_counted_now", lambda self: min(len(given), len(self)))
    first, state = train(tiny_scene, 2, 2, None)
    second, _ = train(tiny_scene, 0, 99, state)
    assert first + second != uninterrupted


def test_the_caller_may_count(tiny_scene: WeatherScene, uninterrupted: list[str]) -> None:
    sampler, loader = resumable(tiny_scene, 0)
    seen = []
    for step, batch in enumerate(loader, start=1):
        seen += digests([batch])
        if step == 4:
            break
    state = moved(sampler.state_dict(done=4 * 2))
    assert seen + train(tiny_scene, 0, 99, state)[0] == uninterrupted


def test_numbers_count_from_where_the_loop_began(tiny_scene: WeatherScene) -> None:
    """A training that was resumed numbers its steps from 0 again."""
    sampler = WeatherSampler(dataset_of(tiny_scene))
    order = list(sampler)
    sampler.load_state_dict(sampler.state_dict(done=5))
    sampler.set_epoch(0)
    assert list(sampler) == order[5:]
    sampler.load_state_dict(sampler.state_dict(done=7))
    assert sampler.start == 12
    assert list(sampler) == order[12:]
    sampler.set_epoch(1)
    assert (sampler.start, len(sampler)) == (0, 23)
    assert sampler.state_dict()["used"] == 0


def test_a_loop_that_nobody_counted_is_told(tiny_scene: WeatherScene) -> None:
    """A state of the epoch's beginning would silently repeat what was used."""
    sampler, loader = resumable(tiny_scene, 0)
    assert sampler.state_dict()["used"] == 0
    next(iter(loader))
    with pytest.raises(ArgumentError, match=r"loop over sampler\.follow\(loader\), or give done="):
        sampler.state_dict()


def test_dropped_and_single_samples_are_counted(tiny_scene: WeatherScene) -> None:
    sampler = WeatherSampler(dataset_of(tiny_scene))
    whole = DataLoader(sampler.dataset, batch_size=5, sampler=sampler, drop_last=True)
    assert len(list(sampler.follow(whole))) == 4
    assert sampler.state_dict()["used"] == 20
    single = DataLoader(sampler.dataset, batch_size=None, sampler=sampler)
    for _ in zip(range(3), sampler.follow(single), strict=False):
        pass
    assert sampler.state_dict()["used"] == 3


def test_a_loader_of_others_is_not_followed(dataset: WeatherDataset) -> None:
    sampler = WeatherSampler(dataset)
    with pytest.raises(ArgumentError, match="loader must have this sampler"):
        sampler.follow(DataLoader(dataset))


@pytest.mark.parametrize("done", [-1, 24, 1.5, "3", True])
def test_more_than_there_is_was_not_used(dataset: WeatherDataset, done: Any) -> None:
    with pytest.raises(ArgumentError, match="done"):
        WeatherSampler(dataset).state_dict(done)


OTHERS: dict[str, dict[str, Any]] = {
    "policy": {"policy": WeatherPolicy({"rain": 1})},
    "seed": {"seed": 5},
    "crop": {"crop": None},
    "options": {"options": RenderOptions(max_particles=9)},
    "sampling": {"sampling": RareClass(min_pixels=9)},
    "length": {"length": 24},
    "balanced_weathers": {"balanced_weathers": True},
    "curriculum": {"curriculum": SeverityCurriculum(((0, (0, 1)),))},
}


@pytest.mark.parametrize("name", OTHERS)
def test_a_state_of_another_training_is_refused(tiny_scene: WeatherScene, name: str) -> None:
    state = WeatherSampler(dataset_of(tiny_scene)).state_dict(done=3)
    changes = dict(OTHERS[name])
    policy = changes.pop("policy", POLICY)
    choices = {"seed": 4, "crop": (8, 8), "length": 23} | changes
    other = WeatherDataset([tiny_scene], policy, **choices)
    for loads in (WeatherSampler(other), other):
        with pytest.raises(ConflictError, match=f"with another {name}: other samples would"):
            loads.load_state_dict(state)
    assert other.epoch == 0


def test_a_state_of_another_scene_or_order_is_refused(
    tiny_scene: WeatherScene, dataset: WeatherDataset
) -> None:
    state = WeatherSampler(dataset).state_dict()
    clip = WeatherDataset([TinyClip()], POLICY, seed=4, crop=(8, 8), length=23)
    with pytest.raises(ConflictError, match="another scenes"):
        WeatherSampler(clip).load_state_dict(state)
    with pytest.raises(ConflictError, match="another shuffle"):
        WeatherSampler(dataset, shuffle=False).load_state_dict(state)
    with pytest.raises(ConflictError, match="another order seed"):
        WeatherSampler(dataset, seed=9).load_state_dict(state)


@pytest.mark.parametrize(
    "change",
    [
        *({"version": 2}, {"epoch": -1}, {"epoch": None}, {"fingerprint": None}),
        *({"used": value} for value in (99, -1, "3")),
    ],
    ids=str,
)
def test_a_damaged_state_is_refused(dataset: WeatherDataset, change: dict[str, Any]) -> None:
    sampler = WeatherSampler(dataset)
    with pytest.raises(ArgumentError, match=r"state|epoch"):
        sampler.load_state_dict(sampler.state_dict() | change)
    assert (sampler.start, sampler.epoch) == (0, 0)


@pytest.mark.parametrize("state", [None, 3, [], {}, "state"])
def test_what_is_no_state_is_refused(dataset: WeatherDataset, state: Any) -> None:
    for loads in (WeatherSampler(dataset), dataset):
        with pytest.raises(ArgumentError, match="is no state_dict of a"):
            loads.load_state_dict(state)


@pytest.mark.parametrize("arguments", [{"rank": 1}, {"rank": -1}, {"ranks": 0}, {"seed": 0.5}])
def test_bad_arguments_are_refused(dataset: WeatherDataset, arguments: dict[str, Any]) -> None:
    with pytest.raises(ArgumentError, match=next(iter(arguments))):
        WeatherSampler(dataset, **arguments)
    with pytest.raises(ArgumentError, match="dataset must be a WeatherDataset, got list"):
        WeatherSampler([1, 2, 3])  # type: ignore[arg-type]


def test_a_datasets_state_is_its_epoch(tiny_scene: WeatherScene, dataset: WeatherDataset) -> None:
    dataset.set_epoch(7)
    other = dataset_of(tiny_scene)
    other.load_state_dict(moved(dataset.state_dict()))
    assert other.epoch == 7
    assert digest_of(other[3]) == digest_of(dataset[3])


def test_going_on_takes_no_time(tiny_scene: WeatherScene) -> None:
    """D7: at most 50 ms of work up to the first item, wherever in a long epoch."""
    sampler = WeatherSampler(dataset_of(tiny_scene, 100_000))
    for k in (0, 50_000, 99_999):
        state = sampler.state_dict(done=k) | {"epoch": 10 + k}
        took_s = []
        for epoch in range(3):
            state["epoch"] += epoch
            again = WeatherSampler(sampler.dataset)
            start = time.process_time()
            again.load_state_dict(state)
            next(iter(again))
            took_s.append(time.process_time() - start)
        assert min(took_s) <= RESTORE_S


def test_copies_go_on_alike(dataset: WeatherDataset) -> None:
    sampler = WeatherSampler(dataset, rank=1, ranks=2)
    sampler.load_state_dict(sampler.state_dict(done=4))
    for other in (copy.deepcopy(sampler), pickle.loads(pickle.dumps(sampler))):
        assert list(other) == list(sampler)
        assert other.state_dict(done=2) == sampler.state_dict(done=2)
