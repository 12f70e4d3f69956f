"""Samples per second of a DataLoader with two workers: no weather, ours, and albumentations'.

A sample is: decode a 1024 x 2048 PNG, cut 512 x 512 of it and of the label, make tensors. Pictures
and labels are read alike everywhere. What differs is the weather, which three in four samples have:

* ours over a scene: depth and light are in the scene, and only the crop is rendered;
* ours without a scene: `RandomWeather` in a Compose. It guesses depth from the label and looks at
  the light of each picture, and comes before the crop, because depth belongs to the whole picture;
* albumentations' own `RandomRain`, `RandomSnow` and `RandomFog` with their own defaults, on the
  crop alone, which is all that it needs, and before the crop, where ours stands. They know no
  depth, leave the label as it is, and change air and brightness only.

Unlike the other benchmarks this one takes two processes, of one thread each, beside one that only
waits, and the time on the wall, because a loader is as slow as its waiting. Loaders take turns,
each with workers of its own that are gone when the next one starts. What is drawn hangs on the
round and the sample alone. On a busy machine the ratios hold better than the numbers.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import Any, Protocol

import albumentations as A
import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset

from benchmarks.report import Row, show
from benchmarks.sample import CROP, HEIGHT, WIDTH, OneFrameClip, decoded
from weather_aug._keys import key_of, uniforms
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.scene.scene import WeatherScene
from weather_aug.transforms.albumentations import RandomWeather
from weather_aug.transforms.dataset import WeatherDataset

WORKERS, BATCH, QUEUED = 2, 2, 2
SETTLING = WORKERS * (QUEUED + 1)
"""Batches not counted at the start of a turn: workers start, and their queues are filled."""
ROUNDS, TURN_S, LEAST_BATCHES = 7, 2.0, 16
SAMPLES = 4096
"""Of an epoch: more than a turn can take."""
POLICY = WeatherPolicy()
WEATHERED = 1 - POLICY.types["clear"] / sum(POLICY.types.values())

PLAIN = "no weather"
OURS = "WeatherDataset over a scene"
WITHOUT_SCENE = "RandomWeather without a scene, then crop"
THEIRS_ON_CROP = "albumentations' weather on the crop"
THEIRS_ON_WHOLE = "albumentations' weather, then crop"

UInt8 = NDArray[np.uint8]


class Samples(Protocol):
    """A data set whose samples are other ones in each epoch."""

    def set_epoch(self, epoch: int) -> None:
        """Go on to an epoch."""

    def __getitem__(self, index: int) -> Any:
        """One sample."""


class Pictures(Dataset[Any]):
    """The scene's picture and label, always the same, and what a pipeline makes of them.

    Args:
        scene: Of one frame.
        pipeline: Of a picture (H, W, 3), its label (H, W), which is a memory map, and the key of
            the sample; gives a crop of both.
    """

    def __init__(
        self,
        scene: WeatherScene,
        pipeline: Callable[[UInt8, UInt8, int], tuple[UInt8, UInt8]],
    ) -> None:
        files = scene.manifest.frames[0].files
        self._image, self._label = scene.path / files["image"], scene.path / files["label"]
        self._pipeline = pipeline
        self._epoch = 0

    def __len__(self) -> int:
        return SAMPLES

    def set_epoch(self, epoch: int) -> None:
        """Other draws; workers must start after it."""
        self._epoch = epoch

    def __getitem__(self, index: int) -> tuple[torch.Tensor, torch.Tensor]:
        key = key_of("loader", self._epoch, index)
        label = np.load(self._label, mmap_mode="r")
        image, label = self._pipeline(decoded(self._image), label, key)
        tensor = torch.from_numpy(image).permute(2, 0, 1).contiguous()
        return tensor, torch.from_numpy(label).long()


def cropped(image: UInt8, label: UInt8, key: int) -> tuple[UInt8, UInt8]:
    """A random part, and nothing else."""
    down, right = uniforms(key, 2)
    top, left = int(down * (HEIGHT - CROP + 1)), int(right * (WIDTH - CROP + 1))
    part = (slice(top, top + CROP), slice(left, left + CROP))
    return image[part], np.array(label[part])


def composed(*steps: Any, crop_first: bool) -> Callable[[UInt8, UInt8, int], tuple[UInt8, UInt8]]:
    """A pipeline of albumentations, before or after the crop, seeded anew by each sample's key."""
    compose = A.Compose(steps)

    def run(image: UInt8, label: UInt8, key: int) -> tuple[UInt8, UInt8]:
        # By sample, because the workers of albumentations 2.0.8 repeat each other.
        compose.set_random_seed(key % 2**32)
        if crop_first:
            image, label = cropped(image, label, key)
            done = compose(image=np.ascontiguousarray(image), mask=label)
            return done["image"], done["mask"]
        done = compose(image=image, mask=np.array(label))
        return cropped(done["image"], done["mask"], key)

    return run


def theirs() -> A.OneOf:
    """Rain, snow or fog of albumentations, as often as the default policy draws any weather."""
    return A.OneOf([A.RandomRain(), A.RandomSnow(), A.RandomFog()], p=WEATHERED)


def contenders(scene: WeatherScene) -> dict[str, Samples]:
    """All data sets, by name."""
    ours = WeatherDataset([scene], POLICY, crop=(CROP, CROP), length=SAMPLES, output="tuple")
    weather = RandomWeather(POLICY, p=1.0)
    return {
        PLAIN: Pictures(scene, cropped),
        OURS: ours,
        WITHOUT_SCENE: Pictures(scene, composed(weather, crop_first=False)),
        THEIRS_ON_CROP: Pictures(scene, composed(theirs(), crop_first=True)),
        THEIRS_ON_WHOLE: Pictures(scene, composed(theirs(), crop_first=False)),
    }


def measure() -> dict[str, Any]:
    """Run the loaders in turns, and print how fast they are against the one without weather."""
    with one_frame_scene() as scene:
        per_s = rates(contenders(scene), ROUNDS)
    title = f"samples per second, {WORKERS} workers, {HEIGHT} x {WIDTH} PNG to {CROP} x {CROP}"
    title += f" ({median(per_s[PLAIN]):.1f} per second without weather)"
    rows = [Row(name, value, f"x {PLAIN}") for name, value in ratios(per_s).items()]
    return show(title, rows) | {"workers": WORKERS, "rounds": ROUNDS, "samples_per_s": per_s}


@contextmanager
def one_frame_scene() -> Iterator[WeatherScene]:
    """The benchmarks' street, for as long as the block."""
    with tempfile.TemporaryDirectory() as folder:
        yield WeatherScene.build(OneFrameClip(), Path(folder) / "scene")


def rates(datasets: Mapping[str, Samples], rounds: int) -> dict[str, list[float]]:
    """Samples per second of each data set's loader in each round."""
    for dataset in datasets.values():
        # Workers are forked from here, with what is compiled, loaded and kept.
        for index in range(8):
            dataset[index]
    per_s: dict[str, list[float]] = {name: [] for name in datasets}
    for turn in range(rounds):
        for name, dataset in datasets.items():
            dataset.set_epoch(turn)
            per_s[name].append(_samples_per_s(dataset))
    return per_s


def ratios(per_s: Mapping[str, list[float]]) -> dict[str, float]:
    """Median over the rounds of each rate against the one without weather in the same round."""
    return {
        name: median(own / plain for own, plain in zip(values, per_s[PLAIN], strict=True))
        for name, values in per_s.items()
    }


def _samples_per_s(dataset: Any) -> float:
    loader = DataLoader(
        dataset,
        batch_size=BATCH,
        num_workers=WORKERS,
        prefetch_factor=QUEUED,
    )
    batches = iter(loader)
    for _ in range(SETTLING):
        next(batches)
    start, count = time.perf_counter(), 0
    while count < LEAST_BATCHES or time.perf_counter() - start < TURN_S:
        next(batches)
        count += 1
    return count * BATCH / (time.perf_counter() - start)


if __name__ == "__main__":
    # Workers inherit it; to set it in them hangs where OpenCV has threads already.
    cv2.setNumThreads(1)
    measure()
