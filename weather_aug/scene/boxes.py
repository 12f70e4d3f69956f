"""Tracked boxes of a frame as a file of plain JSON, checked when it is read.

    {"boxes": [{"track_id": 7, "class_name": "Car", "world_from_box": [[...], ...],
                "size_m": [4.5, 1.8, 1.5], "velocity_m_per_s": [8.0, 0.0, 0.0]}, ...]}

A file of its own, because a long drive's boxes would outgrow the manifest that every reader parses.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from weather_aug import _files
from weather_aug.clip.types import Box, FrameKey
from weather_aug.errors import DataError, SceneError, printable

MAX_BOXES = 2000
"""Of one frame."""
MAX_CLASS_NAME = 64
MAX_BOXES_BYTES = 4 * 2**20
"""More than MAX_BOXES boxes take, so that what is built can be read."""
LARGEST_M = 1e10
"""No coordinate of a drive is greater."""
_LOWEST_ID, _HIGHEST_ID = -(2**63), 2**64

_MALFORMED = (AttributeError, KeyError, TypeError, ValueError, IndexError, OverflowError)


def encode_boxes(key: FrameKey, boxes: Sequence[Box]) -> bytes:
    """The file of a frame's boxes; the same boxes give the same bytes.

    Raises:
        SceneError: If there are more than `MAX_BOXES`, or one of them cannot be stored.
    """
    if len(boxes) > MAX_BOXES:
        raise SceneError(f"frame {key} has {len(boxes)} boxes; a scene holds {MAX_BOXES} per frame")
    try:
        entries = [_entry(_checked(box)) for box in boxes]
    except _MALFORMED as error:
        raise SceneError(
            f"frame {key}: a box cannot be stored ({printable(error)}); repair the clip's boxes"
        ) from None
    return (json.dumps({"boxes": entries}, allow_nan=False) + "\n").encode()


def read_boxes(path: Path) -> tuple[Box, ...]:
    """Boxes of a file that `encode_boxes` wrote, in their order.

    Raises:
        SceneError: If the file cannot be read, is too large, or holds anything but boxes.
    """
    try:
        entries = _files.read_json(path, MAX_BOXES_BYTES)["boxes"]
        if not isinstance(entries, list) or len(entries) > MAX_BOXES:
            raise ValueError(f"expected a list of at most {MAX_BOXES} boxes")
        # A stranger's numbers overflow before they are refused.
        with np.errstate(over="ignore", invalid="ignore"):
            return tuple(_checked(_parse(entry)) for entry in entries)
    except (*_MALFORMED, DataError) as error:
        raise SceneError(
            f"{printable(path, 200)} holds no boxes: {type(error).__name__} {printable(error)}; "
            "build the scene again"
        ) from None


def _entry(box: Box) -> dict[str, Any]:
    velocity = box.velocity_m_per_s
    return {
        "track_id": int(box.track_id),
        "class_name": box.class_name,
        "world_from_box": box.world_from_box.tolist(),
        "size_m": list(box.size_m),
        "velocity_m_per_s": None if velocity is None else velocity.tolist(),
    }


def _parse(entry: Any) -> Box:
    return Box(
        entry["track_id"],
        entry["class_name"],
        entry["world_from_box"],
        entry["size_m"],
        entry["velocity_m_per_s"],
    )


def _checked(box: Box) -> Box:
    """Return a box that a scene can hold, or raise what is wrong with it."""
    name, track = box.class_name, box.track_id
    if not isinstance(name, str) or not name.isprintable() or not 0 < len(name) <= MAX_CLASS_NAME:
        raise ValueError(f"class name must be 1 to {MAX_CLASS_NAME} printable characters")
    if isinstance(track, bool) or not _LOWEST_ID <= track.__index__() < _HIGHEST_ID:
        raise ValueError("track id must be an integer in [-2**63, 2**64)")
    if max(float(np.abs(box.world_from_box).max()), *box.size_m) > LARGEST_M:
        raise ValueError(f"a place or size is beyond {LARGEST_M:g} m")
    return box
