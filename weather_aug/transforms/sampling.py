"""Which frame an item of an epoch shows: all in turn, or rare classes more often."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from itertools import accumulate
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import finite
from weather_aug._keys import key_of, uniforms
from weather_aug.errors import ArgumentError, printable
from weather_aug.taxonomy import CLASSES
from weather_aug.transforms.permutation import permutation

UInt8 = NDArray[np.uint8]


class Choice(NamedTuple):
    """What an item shows."""

    frame: int
    """Its place among all frames."""
    train_id: int | None = None
    """The class for whose sake it was chosen; None if for none."""
    more: float = 0.0
    """A crop will do that holds more pixels of the class than this."""
    tries: int = 0
    """How often another crop is drawn in place of one that will not do."""


class Picks(Protocol):
    """A strategy, once it knows the data set's frames; small to pickle."""

    def pick(self, seed: int, epoch: int, item: int) -> Choice:
        """The choice for an item: a function of these three alone."""


@runtime_checkable
class Sampling(Protocol):
    """A strategy: frozen, of JSON values."""

    @property
    def reads_labels(self) -> bool:
        """Whether `picks` needs labels."""

    def picks(self, frames: int, length: int, labels: Iterable[UInt8]) -> Picks:
        """The strategy for a data set of so many frames and items an epoch.

        Args:
            frames: Above 0.
            length: Items of an epoch, above 0.
            labels: (H, W) train ids of each frame, read one after another; none if `reads_labels`
                is false.
        """

    def to_dict(self) -> dict[str, Any]:
        """Fields and the strategy's name as JSON values."""


@dataclass(frozen=True)
class Uniform:
    """Every frame equally often: item i is frame i.

    Convention:
        Of an epoch that is longer or shorter than there are frames, whole rounds are in the frames'
        order, and what is left over is drawn without repeats, anew in each epoch.
    """

    @property
    def reads_labels(self) -> bool:
        """No."""
        return False

    def picks(self, frames: int, length: int, labels: Iterable[UInt8]) -> UniformPicks:
        """See `Sampling.picks`."""
        return UniformPicks(frames, length)

    def to_dict(self) -> dict[str, Any]:
        """The strategy's name."""
        return {"strategy": "uniform"}


class UniformPicks(NamedTuple):
    """`Uniform` over so many frames."""

    frames: int
    length: int

    def pick(self, seed: int, epoch: int, item: int) -> Choice:
        """See `Picks.pick`."""
        rounds, place = divmod(item, self.frames)
        if (rounds + 1) * self.frames <= self.length:
            return Choice(place)
        return Choice(int(permutation("left-over frames", seed, epoch, self.frames)[place]))


@dataclass(frozen=True)
class RareClass:
    """Frames of rare classes more often, and crops that show them.

    Convention:
        An item draws a class with probability p(c) ∝ exp((1 - f_c) / temperature), where f_c is the
        class's share of all labelled pixels, among the classes of which some frame has at least
        `min_pixels`; then one of those frames, each with the same chance; then, where the data set
        crops, a crop anew up to `tries` times until it holds more than `min_crop_ratio *
        min_pixels` pixels of the class in the clear label. The last crop is taken as it is. All
        three are functions of (seed, epoch, item).

    Raises:
        ArgumentError: If a number is outside its range.

    Source:
        Hoyer, Dai, Van Gool (2022), DAFormer: Improving Network Architectures and Training
        Strategies for Domain-Adaptive Semantic Segmentation, section 3.3; the defaults are its
        release's.
    """

    temperature: float = 0.01
    """T, in [1e-6, 1e6]: small prefers rare classes, large all classes alike."""
    min_pixels: int = 3000
    """Of the class in the frame as it is stored, 1 or more. Meant for pictures of 1 to 2
    megapixels; in smaller ones small things never have as many."""
    min_crop_ratio: float = 0.5
    """In [0, 1e3]; HRDA takes 2."""
    tries: int = 10
    """In 0..1000."""

    def __post_init__(self) -> None:
        finite("temperature", self.temperature, 1e-6, 1e6)
        finite("min_crop_ratio", self.min_crop_ratio, 0, 1e3)
        for name, low, high in (("min_pixels", 1, 2**40), ("tries", 0, 1000)):
            if finite(name, getattr(self, name), low, high) != int(getattr(self, name)):
                raise ArgumentError(f"{name} must be whole, got {getattr(self, name)!r}")
            object.__setattr__(self, name, int(getattr(self, name)))

    @property
    def reads_labels(self) -> bool:
        """Yes: pixels of all classes are counted once."""
        return True

    def picks(self, frames: int, length: int, labels: Iterable[UInt8]) -> RareClassPicks:
        """See `Sampling.picks`.

        Raises:
            ArgumentError: If no class has `min_pixels` in any frame.
        """
        total = np.zeros(len(CLASSES), np.int64)
        most = total.copy()
        frames_of = np.zeros(frames, np.uint32)
        for frame, label in enumerate(labels):
            pixels = np.bincount(label.ravel(), minlength=len(CLASSES))[: len(CLASSES)]
            total += pixels
            most = np.maximum(most, pixels)
            shown = np.flatnonzero(pixels >= self.min_pixels)
            frames_of[frame] = np.bitwise_or.reduce(1 << shown, initial=0)
        if most.max() < self.min_pixels:
            raise ArgumentError(
                f"min_pixels is {self.min_pixels}, but no frame has more than {most.max()} pixels "
                "of a class; lower it: RareClass(min_pixels=...)"
            )
        frequency = tuple((total / total.sum()).tolist())
        train_ids = tuple(np.flatnonzero(most >= self.min_pixels).tolist())
        return RareClassPicks(self, frequency, train_ids, frames_of)

    def to_dict(self) -> dict[str, Any]:
        """Fields and the strategy's name as JSON values."""
        return {"strategy": "rare_class", **asdict(self)}


class RareClassPicks(NamedTuple):
    """`RareClass` over frames whose labels were counted; 4 bytes a frame."""

    law: RareClass
    frequency: tuple[float, ...]
    """Share of each of the 19 classes in all labelled pixels."""
    train_ids: tuple[int, ...]
    """The classes that are drawn."""
    frames_of: NDArray[np.uint32]
    """(frames,) bit c is set where the frame has enough pixels of class c."""

    def probability(self) -> list[float]:
        """Of each of `train_ids`."""
        rarity = [1 - self.frequency[c] for c in self.train_ids]
        weights = [math.exp((r - max(rarity)) / self.law.temperature) for r in rarity]
        return [weight / sum(weights) for weight in weights]

    def pick(self, seed: int, epoch: int, item: int) -> Choice:
        """See `Picks.pick`."""
        which, where = uniforms(key_of("rare-class", seed, epoch, item), 2).tolist()
        bounds = [*accumulate(self.probability())]
        # The sum of the probabilities may end below 1 by a rounding.
        train_id = self.train_ids[min(bisect_right(bounds, which), len(bounds) - 1)]
        frames = np.flatnonzero(self.frames_of & np.uint32(1 << train_id))
        more = self.law.min_crop_ratio * self.law.min_pixels
        return Choice(int(frames[int(where * len(frames))]), train_id, more, self.law.tries)


_STRATEGIES: dict[str, type[Uniform] | type[RareClass]] = {
    "uniform": Uniform,
    "rare_class": RareClass,
}


def sampling_from_dict(state: Mapping[str, Any]) -> Uniform | RareClass:
    """The inverse of a strategy's `to_dict`.

    Raises:
        ArgumentError: If there is no such strategy, or it has no such field.
    """
    name = state.get("strategy") if isinstance(state, Mapping) else None
    if name not in _STRATEGIES:
        raise ArgumentError(f"strategy must be one of {', '.join(_STRATEGIES)}, got {name!r}")
    strategy = _STRATEGIES[name]
    values = {field: value for field, value in state.items() if field != "strategy"}
    unknown = sorted(set(values) - {field.name for field in fields(strategy)}, key=str)
    if unknown:
        raise ArgumentError(f"strategy {name} has no field {printable(unknown[0])}")
    return strategy(**values)
