"""Frames chosen so that rare classes occur more often, by DAFormer's law over stored labels."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weather_aug import _files
from weather_aug.errors import ArgumentError
from weather_aug.scene import store
from weather_aug.scene.scene import WeatherScene
from weather_aug.taxonomy import CLASSES
from weather_aug.transforms.sampling import RareClass, RareClassPicks


@dataclass(frozen=True)
class ClassBalance:
    """How strongly frames of rare classes are preferred.

    Convention:
        An item draws a class with probability p(c) ∝ exp((1 - f_c) / temperature), where f_c is the
        class's share of all labelled pixels, then one of the frames with at least `min_pixels` of
        it, each with the same chance; see `transforms.sampling.RareClass`. Labels are those of the
        clear pictures: weather may hide some of the pixels. Frames without a label, or without
        enough pixels of any class, are never chosen.

    Raises:
        ArgumentError: If a number is outside its range.

    Source:
        Hoyer, Dai, Van Gool (2022), DAFormer, section 3.3; the defaults are its release's.
    """

    temperature: float = 0.01
    """T, in [1e-6, 1e6]: small prefers rare classes, large all classes alike."""
    min_pixels: int = 3000
    """Of the class in the stored label, 1 or more. Meant for pictures of 1 to 2 megapixels."""

    def __post_init__(self) -> None:
        law = self.law
        object.__setattr__(self, "min_pixels", law.min_pixels)

    @property
    def law(self) -> RareClass:
        """The same for data sets; an export shows whole pictures, so that no crop is tried."""
        return RareClass(self.temperature, self.min_pixels, tries=0)

    def counted(self, scenes: Sequence[WeatherScene], *, progress: bool = False) -> Balanced:
        """The balance over the frames of scenes, of which every label is read once.

        Args:
            scenes: Whose stored labels are counted.
            progress: Show a bar.

        Raises:
            ArgumentError: If no frame has `min_pixels` of any class.
            SceneError: If a label cannot be read.
        """
        frames = sum(len(scene.manifest.frames) for scene in scenes)
        try:
            picks = self.law.picks(frames, frames, _labels(scenes, frames, progress))
        except ArgumentError:
            raise ArgumentError(
                f"balance: min_pixels is {self.min_pixels}, but no frame's label has as many of a "
                "class; lower it, or export without balance"
            ) from None
        return Balanced(self, picks)


@dataclass(frozen=True, eq=False)
class Balanced:
    """A balance over counted frames; 4 bytes a frame."""

    balance: ClassBalance
    picks: RareClassPicks

    def frame(self, seed: int, item: int) -> int:
        """Frame of an item, of all scenes' frames in a row."""
        return self.picks.pick(seed, 0, item).frame

    def shares(self) -> dict[str, float]:
        """Share of the items that are chosen for each class's sake, by its name, most first."""
        pairs = zip(self.picks.train_ids, self.picks.probability(), strict=True)
        ordered = sorted(pairs, key=lambda pair: -pair[1])
        return {CLASSES[train_id]: share for train_id, share in ordered}

    def to_dict(self) -> dict[str, Any]:
        """The law, and a digest of what was counted, as JSON values."""
        counted = json.dumps([self.picks.frequency, self.picks.frames_of.tolist()])
        return {**asdict(self.balance), "counted_sha256": _files.sha256_of(counted.encode())}


def _labels(
    scenes: Sequence[WeatherScene], frames: int, progress: bool
) -> Iterator[NDArray[np.uint8]]:
    """Stored train ids of each frame, (H, W); nothing where a frame has no label."""
    from tqdm.auto import tqdm

    records = ((scene.path, record) for scene in scenes for record in scene.manifest.frames)
    bar = tqdm(records, total=frames, desc="classes", unit="label", disable=not progress)
    for path, record in bar:
        _, label = store.read_surfaces(path, record)
        yield np.empty(0, np.uint8) if label is None else label
