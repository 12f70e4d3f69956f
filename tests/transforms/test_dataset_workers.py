"""Items with all choices on are the same on any number of workers, however they are started."""

from __future__ import annotations

from typing import Any

import pytest
from test_dataset import digest_of, digests, forks
from tiny_clip import TinyClip
from torch.utils.data import DataLoader, get_worker_info

from weather_aug.scene.policy import WeatherPolicy
from weather_aug.scene.scene import WeatherScene
from weather_aug.transforms.curriculum import SeverityCurriculum
from weather_aug.transforms.dataset import WeatherDataset
from weather_aug.transforms.draws import SharedEpoch
from weather_aug.transforms.sampler import WeatherSampler
from weather_aug.transforms.sampling import RareClass

POLICY = WeatherPolicy({"clear": 1, "rain": 1, "snow": 1, "fog": 1})
TIMEOUT_S = 200
many = pytest.mark.filterwarnings("ignore:This DataLoader will create:UserWarning")


def dataset_of(scene: WeatherScene, length: int) -> WeatherDataset:
    return WeatherDataset(
        [scene, TinyClip()],
        POLICY,
        seed=3,
        crop=(16, 20),
        sampling=RareClass(min_pixels=40),
        length=length,
        balanced_weathers=True,
        curriculum=SeverityCurriculum(((0, (0.1, 0.3)), (4, (0.2, 1.0)))),
        with_clear=True,
    )


def expected_of(scene: WeatherScene, length: int, epochs: int) -> list[list[str]]:
    dataset = dataset_of(scene, length)
    found = []
    for epoch in range(epochs):
        dataset.set_epoch(epoch)
        found.append([digest_of(dataset[index]) for index in range(length)])
    return found


@pytest.fixture(scope="module")
def five_epochs(tiny_scene: WeatherScene) -> list[list[str]]:
    return expected_of(tiny_scene, 13, 5)


@pytest.fixture(scope="module")
def long_epochs(tiny_scene: WeatherScene) -> list[list[str]]:
    return expected_of(tiny_scene, 500, 2)


def check(
    scene: WeatherScene,
    expected: list[list[str]],
    workers: int,
    method: str | None,
    **how: Any,
) -> None:
    """Compare a loader's items of each epoch, in the sampler's order, with those drawn here."""
    dataset = dataset_of(scene, len(expected[0]))
    sampler = WeatherSampler(dataset)
    loader = DataLoader(
        dataset,
        sampler=sampler,
        num_workers=workers,
        multiprocessing_context=method,
        timeout=TIMEOUT_S if workers else 0,
        **how,
    )
    for epoch, items in enumerate(expected):
        sampler.set_epoch(epoch)
        order = list(sampler)
        assert digests(loader) == [items[index] for index in order], epoch


@many
@forks
@pytest.mark.parametrize(
    ("workers", "method", "persistent", "prefetch"),
    [(1, "fork", False, 4), (3, "fork", True, 1), (1, "spawn", True, 4)],
)
def test_workers_draw_the_same(
    tiny_scene: WeatherScene,
    five_epochs: list[list[str]],
    workers: int,
    method: str,
    persistent: bool,
    prefetch: int,
) -> None:
    """D3 and D9: five epochs; persistent workers hear of each."""
    assert len({item for epoch in five_epochs for item in epoch}) == 5 * 13
    how: dict[str, Any] = {"persistent_workers": persistent, "prefetch_factor": prefetch}
    check(tiny_scene, five_epochs, workers, method, batch_size=4, **how)


@pytest.mark.parametrize("batch_size", [1, 3, 8, 17])
def test_batches_do_not_matter(
    tiny_scene: WeatherScene, five_epochs: list[list[str]], batch_size: int
) -> None:
    """D4."""
    check(tiny_scene, five_epochs[:2], 0, None, batch_size=batch_size)


@forks
def test_a_private_epoch_would_be_seen(
    tiny_scene: WeatherScene, five_epochs: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """An epoch that workers do not share stays at the one in which they were started."""

    def private(self: SharedEpoch, epoch: int = 0) -> None:
        self._cell = [epoch]  # type: ignore[assignment]

    monkeypatch.setattr(SharedEpoch, "__init__", private)
    monkeypatch.setattr(
        SharedEpoch, "value", property(lambda s: s._cell[0], lambda s, e: s._cell.__setitem__(0, e))
    )
    how: dict[str, Any] = {"batch_size": 4, "persistent_workers": True}
    with pytest.raises(AssertionError):
        check(tiny_scene, five_epochs[:2], 1, "fork", **how)


@forks
def test_draws_of_a_workers_own_would_be_seen(
    tiny_scene: WeatherScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A crop that hangs on the worker's number, as generators of workers do."""

    def window(self: WeatherDataset, *_: Any) -> tuple[int, ...]:
        info = get_worker_info()
        return (0 if info is None else info.id, 0, 16, 20)

    monkeypatch.setattr(WeatherDataset, "_window", window)
    expected = expected_of(tiny_scene, 13, 1)
    check(tiny_scene, expected, 1, "fork", batch_size=4)
    with pytest.raises(AssertionError):
        check(tiny_scene, expected, 2, "fork", batch_size=4)


@pytest.mark.slow
@many
@forks
@pytest.mark.parametrize("method", ["fork", "spawn", "forkserver"])
@pytest.mark.parametrize("workers", [1, 2, 3, 4, 8])
@pytest.mark.parametrize(("persistent", "prefetch"), [(False, 1), (True, 4)])
def test_workers_draw_the_same_500_items(
    tiny_scene: WeatherScene,
    long_epochs: list[list[str]],
    workers: int,
    method: str,
    persistent: bool,
    prefetch: int,
) -> None:
    """D3: 500 items of two epochs."""
    how: dict[str, Any] = {"persistent_workers": persistent, "prefetch_factor": prefetch}
    check(tiny_scene, long_epochs, workers, method, batch_size=8, **how)
