"""What a draw for a batch hangs on: names, epochs, workers and ranks, and no global generator."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

import kornia.augmentation as K
import numpy as np
import pytest
import torch
from kornia_street import MIXED, depths, masks, pictures
from torch.utils.data import DataLoader, Dataset

from weather_aug.transforms.kornia import AugmentationSequential, RandomWeather

torch.set_num_threads(1)


def weathers(weather: RandomWeather, count: int = 4, names: Any = None) -> list[tuple[float, ...]]:
    params = weather.forward_parameters((count, 3, 8, 8), names)
    columns = (params["batch_prob"][:, None], params["weather"], params["seed"][:, None])
    return [tuple(row) for row in torch.cat(columns, dim=1).tolist()]


def untouched(call: Callable[[], Any]) -> bool:
    """Whether a call leaves all global generators as they are, and does not hang on them."""
    results = []
    for seed in (1, 2):
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002 - the global state is what is tested
        torch.manual_seed(seed)
        before = random.getstate(), str(np.random.get_state()), torch.get_rng_state()  # noqa: NPY002
        results.append(call())
        after = random.getstate(), str(np.random.get_state()), torch.get_rng_state()  # noqa: NPY002
        if before[:2] != after[:2] or not torch.equal(before[2], after[2]):
            return False
    return torch.equal(*results)


@pytest.mark.parametrize("same_on_batch", [False, True])
def test_no_global_generator_is_read_or_moved(same_on_batch: bool) -> None:
    def call() -> Any:
        weather = RandomWeather(MIXED, p=0.5, same_on_batch=same_on_batch)
        return AugmentationSequential(weather, data_keys=["input", "mask"])(pictures(), masks())[0]

    assert untouched(call)


def test_the_check_would_notice_kornias_own_gate(monkeypatch: pytest.MonkeyPatch) -> None:
    own = RandomWeather.forward_parameters

    def gated(self: Any, shape: Any, names: Any = None) -> Any:
        gate = self.__batch_prob_generator__(shape, self.p, self.p_batch, self.same_on_batch)
        return own(self, shape, names) | {"batch_prob": gate}

    monkeypatch.setattr(RandomWeather, "forward_parameters", gated)
    assert not untouched(lambda: RandomWeather(MIXED)(pictures(), depth=depths()))
    assert not untouched(lambda: K.RandomHorizontalFlip()(pictures()))


def test_draws_hang_on_the_seed_and_the_call() -> None:
    runs = []
    for seed in (1, 1, 2):
        weather = RandomWeather(MIXED, seed=seed)
        runs.append(weathers(weather) + weathers(weather))
    assert runs[0] == runs[1]
    assert len({*runs[0], *runs[2]}) == 16


def test_named_samples_do_not_hang_on_batches_or_calls() -> None:
    weather = RandomWeather(MIXED, seed=1)
    names = ["a", "b", ("b", 1), 4]
    first = weathers(weather, names=names)
    weathers(weather)
    assert weathers(weather, names=names) == first
    assert weathers(weather, names=names[::-1]) == first[::-1]
    assert weathers(RandomWeather(MIXED, seed=1), 1, names[2:3]) == first[2:3]
    assert len({*first}) == 4


def test_named_pictures_do_not_hang_on_batches() -> None:
    weather = RandomWeather(MIXED, p=0.7, seed=1)
    whole, mask = weather(pictures(), mask=masks(), sample_keys=[1, 2, 3])
    for row in range(3):
        one, one_mask = weather(pictures(1), mask=masks(1), sample_keys=[row + 1])
        assert torch.equal(one[0], whole[row])
        assert torch.equal(one_mask[0], mask[row])


def test_epochs_differ() -> None:
    weather = RandomWeather(MIXED)
    first = weathers(weather, names=[1, 2, 3, 4])
    weather.set_epoch(1)
    second = weathers(weather, names=[1, 2, 3, 4])
    weather.set_epoch(0)
    assert not {*first} & {*second}
    assert weathers(weather, names=[1, 2, 3, 4]) == first


def test_the_gate_does_not_decide_the_weather() -> None:
    rare, sure = (RandomWeather(MIXED, p=p).forward_parameters((50, 3, 8, 8)) for p in (0.2, 1.0))
    assert torch.equal(rare["weather"], sure["weather"])
    through = rare["batch_prob"] == 1
    assert 2 <= through.sum() <= 25
    assert rare["speed_m_per_s"][through].std() > 1, "speed and gate are numbers of their own"


def test_ranks_draw_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    first = weathers(RandomWeather(MIXED))
    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.distributed, "get_rank", lambda: 0)
    assert weathers(RandomWeather(MIXED)) == first
    monkeypatch.setattr(torch.distributed, "get_rank", lambda: 1)
    assert not {*weathers(RandomWeather(MIXED))} & {*first}


class Drawing(Dataset[Any]):
    """What users write who augment in workers."""

    def __init__(self) -> None:
        self.weather = RandomWeather(MIXED)

    def __len__(self) -> int:
        return 8

    def __getitem__(self, index: int) -> Any:
        return self.weather.forward_parameters((1, 3, 8, 8))["weather"]


@pytest.mark.filterwarnings(
    # Loaders fork by default on Linux; Python 3.12 warns of it wherever torch has threads.
    "ignore:This process .* is multi-threaded, use of fork:DeprecationWarning"
)
def test_workers_draw_their_own() -> None:
    loader = DataLoader(Drawing(), batch_size=None, num_workers=2, timeout=60)
    assert len({tuple(row.flatten().tolist()) for row in loader}) == 8
