"""A clip whose missing labels come from a segmentation network of the caller's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.images import read_only
from weather_aug.clip.types import Clip, Float64, Frame, FrameKey
from weather_aug.errors import ArgumentError
from weather_aug.taxonomy import CLASSES, IGNORE

Teacher = Callable[[NDArray[np.uint8]], Any]


class LabelledClip:
    """`clip` with labels for the frames that have none.

    Args:
        clip: Any clip. Labels that it has are kept.
        teacher: Takes the picture (H, W, 3) uint8 RGB and returns (H, W) uint8 train ids, 255 for
            ignore. Use it on clear weather, where networks can be trusted. To send the clip to
            another process the teacher must be picklable.
    """

    def __init__(self, clip: Clip, teacher: Teacher) -> None:
        if not callable(teacher):
            raise ArgumentError(f"teacher must be callable, got {type(teacher).__name__}")
        self._clip = clip
        self._teacher = teacher

    @property
    def name(self) -> str:
        """Name of the clip."""
        return self._clip.name

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return self._clip.cameras

    @property
    def keys(self) -> tuple[FrameKey, ...]:
        """Keys of all frames."""
        return self._clip.keys

    @property
    def is_drive(self) -> bool:
        """Whether the clip is one drive under one light."""
        return bool(getattr(self._clip, "is_drive", True))

    @property
    def up_world(self) -> Float64:
        """(3,) unit vector against gravity."""
        return self._clip.up_world

    def frame(self, key: FrameKey) -> Frame:
        """Read one frame; see `Clip.frame`.

        Raises:
            ArgumentError: If the teacher returns anything but (H, W) uint8 train ids.
        """
        frame = self._clip.frame(key)
        if frame.label is not None:
            return frame
        # A copy, so that a teacher that normalises in place does not spoil the frame.
        label = checked_train_ids(self._teacher(frame.image.copy()), frame.image.shape[:2])
        return replace(frame, label=read_only(label.copy()))


def checked_train_ids(label: Any, shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Return a teacher's `label`, or refuse what is not (H, W) uint8 train ids."""
    if not isinstance(label, np.ndarray) or label.dtype != np.uint8 or label.shape != shape:
        got = f"{label.dtype} {label.shape}" if isinstance(label, np.ndarray) else type(label)
        raise ArgumentError(f"teacher must return a uint8 array of shape {shape}, got {got}")
    unknown = label[(label >= len(CLASSES)) & (label != IGNORE)]
    if unknown.size:
        raise ArgumentError(f"teacher returned {int(unknown[0])}, which is no train id")
    return label
