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
TRAINED_ON = f"{BACKGROUNDS}/trained_on.txt"
"""Digests of all pictures that trained the editor, where that is known; see
`edit.diffusion.leakage`."""
MOST_CARD_BYTES = 64 * 1024
"""Of an editor's card as JSON text; see `edit.background.BackgroundEditor`."""


@dataclass(frozen=True, eq=False)
class BackgroundsRecord:
    """What the manifest says of the backgrounds."""

    card: Mapping[str, Any]
    """Of the editor that made them, JSON values: all that the pictures depend on."""
    styles: tuple[str, ...]
    """Every frame has a picture in each."""
    recorded: tuple[str, ...] = ()
    """Of them, those of which TRAINED_ON tells what the editor learnt them from; none in a scene of
    before that was kept, and where nobody recorded it."""

    @property
    def unrecorded(self) -> tuple[str, ...]:
        """Styles of which nobody can tell what the editor learnt them from."""
        return tuple(style for style in self.styles if style not in self.recorded)


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
    return BackgroundsRecord(card, tuple(styles), _recorded(entry.get("recorded"), styles, files))


def _recorded(recorded: Any, styles: list[str], files: Mapping[str, StoredFile]) -> tuple[str, ...]:
    if recorded is None:
        return ()
    if not isinstance(recorded, list) or not recorded or len(set(recorded)) < len(recorded):
        raise ValueError("backgrounds must have a list of recorded styles, each once, or none")
    if not set(recorded) <= set(styles) or TRAINED_ON not in files:
        raise ValueError(f"recorded styles of backgrounds need {TRAINED_ON} and backgrounds")
    return tuple(recorded)
