"""What a scene's manifest says of stored backgrounds, as checked values: editor and styles."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from weather_aug.clip.types import FrameKey
from weather_aug.edit.background import STYLES
from weather_aug.errors import printable
from weather_aug.scene.records import FrameRecord, StoredFile

BACKGROUNDS = "backgrounds"
MOST_CARD_BYTES = 64 * 1024
"""Of an editor's card as JSON text; see `edit.background.BackgroundEditor`."""


@dataclass(frozen=True, eq=False)
class BackgroundsRecord:
    """What the manifest says of the backgrounds."""

    card: Mapping[str, Any]
    """Of the editor that made them, JSON values: all that the pictures depend on."""
    styles: tuple[str, ...]
    """Every frame has a picture in each."""


def background_path(style: str, key: FrameKey) -> str:
    """Relative path of a frame's picture in a style."""
    return f"{BACKGROUNDS}/{style}/{key}.png"


def parse_backgrounds(
    entry: Any, frames: Iterable[FrameRecord], files: Mapping[str, StoredFile]
) -> BackgroundsRecord | None:
    """A record from the manifest's entry, None of None; whatever is malformed raises."""
    if entry is None:
        return None
    card, styles = entry["card"], entry["styles"]
    if not isinstance(card, dict) or len(json.dumps(card)) > MOST_CARD_BYTES:
        raise ValueError(f"an editor's card must be an object of {MOST_CARD_BYTES} bytes at most")
    if not isinstance(styles, list) or not styles or len(set(styles)) < len(styles):
        raise ValueError("backgrounds must have a list of styles, each once")
    for style in styles:
        if style not in STYLES:
            raise ValueError(f"style {printable(style)} of backgrounds is none")
    for record in frames:
        for style in styles:
            if background_path(style, record.key) not in files:
                raise ValueError(f"frame {record.key} has no background in {style}")
    return BackgroundsRecord(card, tuple(styles))
