"""Named samples: what RandomWeather draws for them hangs on nothing but their names."""

from __future__ import annotations

import copy
import hashlib
import pickle
import random
from typing import Any

import albumentations as A
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_clip import TinyClip
from torch.utils.data import DataLoader, Dataset

from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.transforms import albumentations as ours
from weather_aug.transforms.albumentations import RandomWeather
from weather_aug.transforms.draws import Draws

POLICY = WeatherPolicy.rain().with_clear(0.0)
NO_GENERATOR: Any = None
FORK_WARNS = pytest.mark.filterwarnings(
    # Loaders fork by default on Linux; Python 3.12 warns of it wherever torch has threads.
    "ignore:This process .* is multi-threaded, use of fork:DeprecationWarning"
)

Sample = dict[str, Any]


def street(time_index: int = 0) -> Sample:
    frame = TinyClip().frame(FrameKey(time_index, "front"))
    return {"image": frame.image, "mask": frame.label, "depth": frame.depth_m}


def digest(done: Sample) -> str:
    return hashlib.sha256(done["image"].tobytes() + done["mask"].tobytes()).hexdigest()


class Named(Dataset[Any]):
    """What users write: the pipeline is made once, and each sample says its name."""

    def __init__(self, **how: Any) -> None:
        self.weather = RandomWeather(POLICY, p=0.7, **how)
        self.pipeline = A.Compose([self.weather])

    def __len__(self) -> int:
        return 8

    def __getitem__(self, index: int) -> Any:
        return index, digest(self.pipeline(**street(index % 4), sample_key=("train", index)))


def digests(dataset: Named, **loader: Any) -> dict[int, str]:
    return dict(DataLoader(dataset, batch_size=None, **loader))


@FORK_WARNS
@pytest.mark.parametrize(
    ("workers", "start"),
    [
        (1, "fork"),
        (2, "fork"),
        pytest.param(1, "spawn", marks=pytest.mark.slow),
        pytest.param(2, "spawn", marks=pytest.mark.slow),
    ],
)
def test_any_number_of_workers_gives_the_same_items(workers: int, start: str) -> None:
    expected = digests(Named())
    loader = {"num_workers": workers, "multiprocessing_context": start, "timeout": 120}
    assert digests(Named(), **loader, shuffle=True) == expected
    assert len({*expected.values()}) == 8


@FORK_WARNS
def test_without_names_the_number_of_workers_changes_the_items(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What the test above would see if the name were not used."""
    by_call = Draws.key

    def forgetful(self: Draws, picture: Any, sample: Any = None) -> int:
        return by_call(self, np.zeros((1, 1, 3)), None)

    monkeypatch.setattr(Draws, "key", forgetful)
    assert digests(Named(), num_workers=2, timeout=60) != digests(Named())


@FORK_WARNS
def test_persistent_workers_see_the_epoch() -> None:
    dataset = Named()
    loader = DataLoader(
        dataset, batch_size=None, num_workers=2, persistent_workers=True, timeout=60
    )
    epochs = []
    for epoch in (0, 1, 2):
        dataset.weather.set_epoch(epoch)
        epochs.append(dict(loader))
        assert epochs[-1] == digests(dataset)
    assert len({text for items in epochs for text in items.values()}) > 16
    dataset.weather.set_epoch(0)
    assert digests(dataset) == epochs[0]


def test_a_hundred_repeats_among_others_give_one_picture() -> None:
    pipeline = A.Compose([RandomWeather(POLICY, p=1.0)])
    seen = set()
    for other in range(100):
        seen.add(digest(pipeline(**street(), sample_key="the one")))
        if other % 10 == 0:
            pipeline(**street(), sample_key=other)
            pipeline(**street())
    assert len(seen) == 1


def test_the_seed_decides_and_the_composes_does_not() -> None:
    def one(seed: int, compose: int | None) -> str:
        pipeline = A.Compose([RandomWeather(POLICY, p=1.0, seed=seed)], seed=compose)
        return digest(pipeline(**street(), sample_key=3))

    assert one(1, 5) == one(1, 6) == one(1, None)
    assert len({one(seed, 5) for seed in (1, 2, -1, 2**64 - 1)}) == 4


def test_another_name_is_another_draw() -> None:
    weather = RandomWeather(POLICY)
    names = [0, 1, "0", "1", (0, 1), (1, 0), ("a", 1), (0, 0, 1), -1, 2**63]
    drawn = [weather.drawn({"sample_key": name}, NO_GENERATOR) for name in names]
    assert len({each.seed for each in drawn}) == len(names)


@given(st.lists(st.integers(-(2**63), 2**64 - 1) | st.text(), min_size=1, max_size=4), st.data())
def test_neither_order_nor_the_generator_matters(names: list[Any], data: st.DataObject) -> None:
    weather, again = RandomWeather(POLICY, p=0.5), RandomWeather(POLICY, p=0.5)
    expected = [(weather.decided(d, False), weather.drawn(d, NO_GENERATOR)) for d in keyed(names)]
    order = data.draw(st.permutations(range(len(names))))
    found = {k: keyed(names)[k] for k in order}
    actual = {k: (again.decided(d, False), again.drawn(d, NO_GENERATOR)) for k, d in found.items()}
    assert [actual[k] for k in range(len(names))] == expected


def keyed(names: list[Any]) -> list[Sample]:
    return [{"sample_key": (k, name)} for k, name in enumerate(names)]


def test_whether_there_is_weather_hangs_on_the_name_too() -> None:
    weather = RandomWeather(POLICY, p=0.3)
    applied = [weather.decided({"sample_key": k}, False) for k in range(2000)]
    assert applied == [weather.decided({"sample_key": k}, False) for k in range(2000)]
    assert 500 <= sum(map(bool, applied)) <= 700  # 4.9 standard deviations about 600
    # And says nothing about which weather it is.
    drawn = [weather.drawn({"sample_key": k}, NO_GENERATOR).speed_m_per_s for k in range(2000)]
    assert abs(np.corrcoef(applied, drawn)[0, 1]) < 4 / np.sqrt(2000)
    pipeline = A.Compose([weather], seed=1)
    changed = [(pipeline(**street(), sample_key=k)["image"] != street()["image"]).any() for k in R]
    assert changed == applied[: len(R)]


R = range(20)


def test_who_forces_the_weather_gets_it() -> None:
    name = next(k for k in range(99) if not RandomWeather(p=0.5).decided({"sample_key": k}, False))
    weather = RandomWeather(POLICY, p=0.5)
    assert (weather(**street(), sample_key=name)["image"] == street()["image"]).all()
    assert weather.get_applied_params() == {}
    forced = A.Compose([A.OneOf([weather], p=1.0)])(**street(), sample_key=name)
    assert (forced["image"] != street()["image"]).any()
    never = RandomWeather(POLICY, p=0.0)
    assert never(**street(), sample_key=name)["image"] is not None
    assert never.get_applied_params() == {}


@pytest.mark.parametrize("name", [1.5, True, (1, None), {"a": 1}, 2**64], ids=str)
def test_a_name_of_another_kind_is_refused(name: Any) -> None:
    with pytest.raises(ArgumentError, match="sample_key must be an integer"):
        RandomWeather(POLICY, p=1.0)(**street(), sample_key=name)


def test_copies_go_on_as_the_original_does() -> None:
    """Mid-use, by name and by the generator, and epochs of copies are their own."""
    original = A.Compose([RandomWeather(POLICY, p=1.0, seed=4)], seed=9)
    original(**street())
    original.transforms[0].set_epoch(3)
    copies = [copy.deepcopy(original), pickle.loads(pickle.dumps(original))]
    for more in ({}, {"sample_key": 5}, {}):
        expected = digest(original(**street(), **more))
        assert [digest(each(**street(), **more)) for each in copies] == [expected] * 2
    original.transforms[0].set_epoch(4)
    assert [each.transforms[0].draws.epoch for each in copies] == [3, 3]


def states() -> tuple[Any, ...]:
    numpy_state = np.random.get_state()  # noqa: NPY002 - the global state is what is tested
    return (
        random.getstate(),
        numpy_state[1].tobytes(),
        numpy_state[2],
        torch.get_rng_state().numpy().tobytes(),
    )


def seed_all(seed: int) -> None:
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002
    torch.manual_seed(seed)


@pytest.mark.parametrize("more", [{}, {"sample_key": 5}], ids=["unnamed", "named"])
def test_global_generators_are_neither_read_nor_moved(more: Sample) -> None:
    found = set()
    for seed in range(10):
        seed_all(seed)
        pipeline = A.Compose([RandomWeather(POLICY, p=0.999)], seed=1)
        before = states()
        found.add(digest(pipeline(**street(), **more)))
        assert states() == before
    assert len(found) == 1


def test_reading_a_global_generator_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ours, "worker_seed", lambda: random.getrandbits(32))
    with pytest.raises(AssertionError):
        test_global_generators_are_neither_read_nor_moved({})
