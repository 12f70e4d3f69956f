"""Colour transfer: the clip's colours get the mean and spread of a picture of the weather.

The oldest stylisation, and the only one without weights: each channel of an opponent colour space
is shifted and scaled so that its mean and standard deviation become those of the style's picture.
They are taken over the whole clip, so that one map of colours holds for all of its pictures and
nothing flickers.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug._files import sha256_of_file
from weather_aug.clip.images import read_image
from weather_aug.clip.types import Clip, FrameKey
from weather_aug.edit.background import STYLES, Moment
from weather_aug.edit.peers.options import PeerOptions, check_style
from weather_aug.edit.peers.pictures import levels
from weather_aug.edit.peers.stylisation import style_pictures
from weather_aug.errors import ArgumentError

UInt8 = NDArray[np.uint8]
Float32 = NDArray[np.float32]

MOST_FRAMES = 64
"""Of a clip that are measured, if no more cameras than that are at one time."""
LEAST_SPREAD = 1.0
"""Standard deviation below which a channel is taken for one colour, of 100."""


@dataclass(frozen=True)
class ColourStatistics:
    """Mean and standard deviation of L*, a* and b* (CIELAB, D65) over some pictures."""

    mean: tuple[float, float, float]
    spread: tuple[float, float, float]


class ColourTransfer:
    """A `BackgroundEditor` that moves the clip's colours to those of a picture of each weather.

    Options: `pictures` (folder with rain, snow, fog, each .png or .jpg).

    Convention:
        As `BackgroundEditor`. Nothing is random. The clip's statistics are part of the card.

    Source:
        Reinhard et al., "Color Transfer between Images", IEEE CG&A 2001; in CIELAB where they have
        l-alpha-beta, whose logarithm has no bottom at black.
    """

    name = "colour-transfer"

    def __init__(
        self,
        clip: ColourStatistics,
        pictures: Mapping[str, ColourStatistics],
        card: Mapping[str, Any] | None = None,
    ) -> None:
        self._clip, self._pictures, self._card = clip, dict(pictures), dict(card or {})

    @classmethod
    def load(cls, options: PeerOptions, clip: Clip | None = None) -> ColourTransfer:
        """Measure a clip and the pictures of the weathers.

        Args:
            options: Whose `pictures` is a folder.
            clip: That will be edited; some 64 of its frames are read.

        Raises:
            ArgumentError: If an option is not of this peer, or folder or clip are not given.
            DataError: If the folder holds no picture of a weather, or one cannot be read.
        """
        options = options.of(cls.name, pictures=None)
        paths = style_pictures(options.pictures)
        if clip is None:
            raise ArgumentError("colour-transfer measures the clip that it edits; give clip=...")
        keys = sampled(clip.keys)
        pictures = {style: measured([read_image(path)]) for style, path in paths.items()}
        digests = {style: sha256_of_file(path) for style, path in paths.items()}
        return cls(
            measured(clip.frame(key).image for key in keys), pictures, {"pictures_sha256": digests}
        )

    @property
    def styles(self) -> tuple[str, ...]:
        """Weathers that there is a picture of."""
        return tuple(style for style in STYLES if style in self._pictures)

    @property
    def card(self) -> Mapping[str, Any]:
        """Statistics of clip and pictures."""
        statistics = {style: asdict(one) for style, one in self._pictures.items()}
        return {
            "editor": self.name,
            "clip": asdict(self._clip),
            "pictures": statistics,
            **self._card,
        }

    def edit(self, moment: Moment, style: str) -> tuple[UInt8, ...]:
        """The frames of now in a style; see `BackgroundEditor.edit`."""
        check_style(style, self.styles)
        wanted = self._pictures[style]
        out = []
        for frame in moment.now:
            lab = moved(lab_of(frame.image), self._clip, wanted)
            out.append(levels(cv2.cvtColor(lab, cv2.COLOR_LAB2RGB), frame.key))
        return tuple(out)


def sampled(keys: Sequence[FrameKey]) -> tuple[FrameKey, ...]:
    """At most `MOST_FRAMES` keys, of times evenly spaced and of all their cameras."""
    times = sorted({key.time_index for key in keys})
    cameras = -(-len(keys) // len(times))
    kept = set(times[:: -(-len(times) // max(1, MOST_FRAMES // cameras))])
    return tuple(key for key in keys if key.time_index in kept)


def measured(pictures: Iterable[UInt8]) -> ColourStatistics:
    """Statistics of all pixels of pictures (H, W, 3), read one after another.

    Raises:
        ArgumentError: If there is no picture.
    """
    count, total, squares = 0, np.zeros(3), np.zeros(3)
    for image in pictures:
        lab = lab_of(image).reshape(-1, 3).astype(np.float64)
        count += len(lab)
        total += lab.sum(axis=0)
        squares += np.square(lab).sum(axis=0)
    if count == 0:
        raise ArgumentError("there is no picture whose colours could be measured")
    mean = total / count
    spread = np.sqrt(np.maximum(squares / count - mean**2, 0.0))
    return ColourStatistics(_three(mean), _three(spread))


def moved(lab: Float32, given: ColourStatistics, wanted: ColourStatistics) -> Float32:
    """Colours (H, W, 3) with given statistics, moved to wanted ones; spread is matched, too.

    A channel that is one colour already keeps its spread: nothing can be scaled to another.
    """
    gain = np.array(wanted.spread) / np.maximum(given.spread, LEAST_SPREAD)
    gain = np.where(np.array(given.spread) < LEAST_SPREAD, 1.0, gain)
    shift = np.array(wanted.mean) - gain * np.array(given.mean)
    return lab * gain.astype(np.float32) + shift.astype(np.float32)


def lab_of(image: UInt8) -> Float32:
    """CIELAB (H, W, 3) of sRGB: L* in [0, 100], a* and b* in about [-128, 127]."""
    return np.asarray(cv2.cvtColor(image.astype(np.float32) / 255, cv2.COLOR_RGB2LAB), np.float32)


def _three(values: NDArray[np.float64]) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
