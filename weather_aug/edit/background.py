"""What every editor of backgrounds is to a build: pictures of a moment in, the same in a style out.

Convention:
    An editor is a pure function of (its card, the moment, the style): two calls give equal
    pictures, in any process, whatever was edited before. Its card is JSON values and holds all that
    its pictures depend on (digests of weights, options, versions), so that work that was cut short
    goes on only with the same editor. Inputs are never changed. A picture keeps the size of its
    frame and shows the surfaces of the frame where they are: labels and depth stay true.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.types import Frame
from weather_aug.edit.ambience import Ambience
from weather_aug.edit.physical.layers import Layers
from weather_aug.errors import ArgumentError

if TYPE_CHECKING:
    from weather_aug.edit.diffusion.leakage import TrainedOn

UInt8 = NDArray[np.uint8]

STYLES = ("rain", "snow", "fog")
"""Weathers that a background can be edited to; the names of types in `scene.policy`."""


@dataclass(frozen=True, eq=False)
class Moment:
    """The pictures of a rig at one time, and those just before and after.

    Raises:
        ArgumentError: If `now` is empty, or a camera stands twice at one time.
    """

    now: tuple[Frame, ...]
    """One of each camera that has a frame at this time, in the clip's order."""
    before: tuple[Frame, ...] = ()
    """Of the clip's previous time; empty at its start and where pictures are unrelated."""
    after: tuple[Frame, ...] = ()
    """Of the clip's next time; empty at its end and where pictures are unrelated."""
    look: Callable[[Frame], tuple[Layers, Ambience]] | None = None
    """What the physical editor knows of one of `now`, and the light around it; None where nobody
    looked."""

    def __post_init__(self) -> None:
        if not self.now:
            raise ArgumentError("a moment needs at least one frame")
        for frames in (self.before, self.now, self.after):
            cameras = [frame.key.camera for frame in frames]
            if len(set(cameras)) < len(cameras):
                raise ArgumentError(f"a moment has a camera twice: {', '.join(cameras)}")


@runtime_checkable
class BackgroundEditor(Protocol):
    """Gives backgrounds the look of a weather; what falls and floats is added at rendering."""

    @property
    def name(self) -> str:
        """What kind of editor it is, such as "diffusion": letters, digits, '-' and '_'."""

    @property
    def styles(self) -> tuple[str, ...]:
        """Styles it can edit to, of `STYLES`."""

    @property
    def card(self) -> Mapping[str, Any]:
        """All that its pictures depend on, as JSON values of at most 64 KiB; see the Convention."""

    def edit(self, moment: Moment, style: str) -> tuple[UInt8, ...]:
        """The frames of now in a style.

        Args:
            moment: Pictures around a time.
            style: One of `styles`.

        Returns:
            For each frame of `moment.now` (H, W, 3) sRGB of its size.

        Raises:
            ArgumentError: If the style is none of the editor's.
            DataError: If a picture cannot be edited.
        """


@runtime_checkable
class RecordedEditor(Protocol):
    """What a `BackgroundEditor` may have besides: a record of the pictures it was trained on."""

    def trained_on(self, style: str) -> TrainedOn | None:
        """What its pictures of a style were learnt from; None where nobody recorded it."""
