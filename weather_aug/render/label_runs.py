"""How tall things are in a picture, by the runs of a class in its columns."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled
from weather_aug.clip.types import Frame, Window

UInt8 = NDArray[np.uint8]

LEAST_HEIGHT_PX = 12
"""Beyond the optical range, what is less tall cannot be made out."""


def small_things(frame: Frame, window: Window) -> UInt8 | None:
    """Where a class stands less than 12 pixels tall in its column.

    A run of one class stands for an object: cars one behind the other count as one, and a car
    behind a pole as itself, since a run is looked for in columns only.

    Args:
        frame: Recorded frame.
        window: (top, left, height, width) in its picture.

    Returns:
        (H, W) uint8, 1 where it is; the same in any window. None where nobody labelled, so that
        nobody knows.
    """
    if frame.label is None:
        return None
    top, left, height, width = window
    first = max(top - LEAST_HEIGHT_PX + 1, 0)
    stop = min(top + height + LEAST_HEIGHT_PX - 1, frame.label.shape[0])
    label = np.array(frame.label[first:stop, left : left + width], order="C")
    out = np.empty(label.shape, np.uint8)
    _short_runs(label, np.uint8(LEAST_HEIGHT_PX), out)
    return out[top - first : top - first + height]


@compiled
def _short_runs(label: Any, least: Any, out: Any) -> None:
    """1 where a column's run of equal ids (H, W) is shorter than `least` rows."""
    height, width = label.shape
    one = np.uint8(1)
    above = np.empty((height, width), np.uint8)
    for y in range(height):
        for x in range(width):
            run = np.uint8(1)
            if y > 0 and label[y, x] == label[y - 1, x]:
                longer = np.uint8(above[y - 1, x] + one)
                run = longer if longer < least else least
            above[y, x] = run
    below = np.ones(width, np.uint8)
    for y in range(height - 1, -1, -1):
        for x in range(width):
            run = np.uint8(1)
            if y + 1 < height and label[y, x] == label[y + 1, x]:
                longer = np.uint8(below[x] + one)
                run = longer if longer < least else least
            below[x] = run
            out[y, x] = np.uint8(1) if above[y, x] + run <= least else np.uint8(0)
