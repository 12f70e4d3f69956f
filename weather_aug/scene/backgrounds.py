"""Round of a build: the stored frames of each time → their pictures in each style of an editor."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from weather_aug import _files
from weather_aug._png import png_bytes
from weather_aug.clip.types import Clip, Frame
from weather_aug.edit.ambience import Ambience
from weather_aug.edit.background import STYLES, BackgroundEditor, Moment, RecordedEditor
from weather_aug.edit.diffusion.leakage import TrainedOn
from weather_aug.edit.editors import editor_of
from weather_aug.edit.physical.layers import Layers
from weather_aug.errors import ArgumentError, printable
from weather_aug.scene import store
from weather_aug.scene.backgrounds_record import (
    BACKGROUNDS,
    MOST_CARD_BYTES,
    TRAINED_ON,
    background_path,
)
from weather_aug.scene.journal import Round, digest_record, make_all
from weather_aug.scene.records import FrameRecord, Manifest
from weather_aug.scene.styles import PHYSICAL

JOURNAL = "backgrounds.jsonl"

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")


class Editing(NamedTuple):
    """Which editor makes backgrounds of which styles."""

    editor: BackgroundEditor
    styles: tuple[str, ...]
    card: dict[str, Any]
    """Of the editor, as JSON reads it back."""
    records: dict[str, TrainedOn]
    """What the editor was trained on, by style; only of styles of which it can tell."""


def editing_of(
    editor: str | BackgroundEditor, options: Any, weathers: Sequence[str] | None, clip: Clip
) -> Editing | None:
    """Checked choices; None for the physical editor, which edits while rendering.

    Args:
        editor: One, or the name of one in `edit.editors.EDITORS`, or "physical".
        options: Of an editor that is named.
        weathers: Types the backgrounds are to be edited to; all that the editor knows if None.
        clip: To be edited.

    Raises:
        ArgumentError: If there is no such editor, it cannot edit to a weather, or is none; if
            options are given that it does not take.
        DataError: If its weights, or a record of what it was trained on, cannot be read.
        MissingExtraError: If a package that it needs is not installed.
    """
    if isinstance(editor, str) and editor != PHYSICAL:
        editor = editor_of(editor, options, clip)
    elif options is not None:
        raise ArgumentError(
            "editor_options are for editors that are named, and the physical editor has none; "
            "leave them out"
        )
    if isinstance(editor, str):
        return None
    if not isinstance(editor, BackgroundEditor):
        raise ArgumentError(
            f"editor must be a name or a BackgroundEditor, got {type(editor).__name__}"
        )
    if not _NAME.fullmatch(str(editor.name)) or editor.name == PHYSICAL:
        raise ArgumentError(
            f"an editor may not be called {printable(editor.name)!r}; take letters, digits, '-' "
            "and '_'"
        )
    known = tuple(editor.styles)
    if not known or set(known) - set(STYLES) or len(set(known)) < len(known):
        raise ArgumentError(
            f"editor {editor.name} has the styles {printable(known)}; they must be of "
            f"{', '.join(STYLES)}, each once"
        )
    styles = _styles_wanted(editor.name, known, weathers)
    return Editing(editor, styles, _card_of(editor), _records_of(editor, styles))


def _styles_wanted(
    name: str, known: tuple[str, ...], weathers: Sequence[str] | None
) -> tuple[str, ...]:
    """Styles of these weathers, each once; a clear one needs none."""
    wanted = [
        weather
        for weather in dict.fromkeys(known if weathers is None else weathers)
        if weather != "clear"
    ]
    for weather in wanted:
        if weather not in known:
            raise ArgumentError(
                f"editor {name} cannot edit to {weather}, only to {', '.join(known)}; choose "
                "weathers of these, or leave weathers out"
            )
    if not wanted:
        raise ArgumentError(
            f"weathers name no style that editor {name} edits to; choose of {', '.join(known)}"
        )
    return tuple(wanted)


def _card_of(editor: BackgroundEditor) -> dict[str, Any]:
    try:
        text = json.dumps(dict(editor.card), allow_nan=False)
    except (TypeError, ValueError, RecursionError) as error:
        raise ArgumentError(
            f"editor {editor.name}: its card is not of JSON values: {printable(error)}"
        ) from None
    if len(text) > MOST_CARD_BYTES:
        raise ArgumentError(
            f"editor {editor.name}: its card has {len(text)} bytes, more than {MOST_CARD_BYTES}"
        )
    card: dict[str, Any] = json.loads(text)
    return card


def _records_of(editor: BackgroundEditor, styles: tuple[str, ...]) -> dict[str, TrainedOn]:
    if not isinstance(editor, RecordedEditor):
        return {}
    found = {style: editor.trained_on(style) for style in styles}
    for style, record in found.items():
        if not isinstance(record, TrainedOn | None):
            raise ArgumentError(
                f"editor {editor.name}: trained_on({style!r}) must be TrainedOn or None, got "
                f"{type(record).__name__}"
            )
    return {style: record for style, record in found.items() if record is not None}


class Moments:
    """Moments of the frames in a scene folder; of their frames it holds those of the last one.

    Args:
        folder: With the frames' files.
        manifest: Of all frames, with their layers.
        cameras: Of the clip, in its order.
    """

    def __init__(self, folder: Path, manifest: Manifest, cameras: Sequence[str]) -> None:
        self._folder, self._manifest = folder, manifest
        self._records: dict[int, list[FrameRecord]] = {}
        for record in sorted(manifest.frames, key=lambda r: cameras.index(r.key.camera)):
            self._records.setdefault(record.key.time_index, []).append(record)
        self.times = tuple(sorted(self._records))
        self._place = {time: place for place, time in enumerate(self.times)}
        self._held: dict[int, tuple[Frame, ...]] = {}

    def at(self, time_index: int) -> Moment:
        """The pictures at a time index, and of a drive those just before and after."""
        before = self._neighbour(time_index, -1)
        after = self._neighbour(time_index, +1)
        # Dropped before others are read: a rig's pictures are large.
        near = (before, time_index, after)
        self._held = {time: frames for time, frames in self._held.items() if time in near}
        return Moment(
            self._frames(time_index), self._frames(before), self._frames(after), self._look
        )

    def _neighbour(self, time_index: int, step: int) -> int | None:
        place = self._place[time_index] + step
        if not self._manifest.is_drive or not 0 <= place < len(self.times):
            return None
        return self.times[place]

    def _frames(self, time_index: int | None) -> tuple[Frame, ...]:
        if time_index is None:
            return ()
        if time_index not in self._held:
            records = self._records[time_index]
            frames = tuple(store.read_frame(self._folder, record) for record in records)
            for frame in frames:
                # The next moment has them, too.
                frame.image.flags.writeable = False
            self._held[time_index] = frames
        return self._held[time_index]

    def _look(self, frame: Frame) -> tuple[Layers, Ambience]:
        record = self._manifest.by_key[frame.key]
        layers = store.read_layers(self._folder, record, frame.label)
        assert layers is not None
        return layers, self._manifest.ambience(record)


def write_backgrounds(
    work: Path,
    manifest: Manifest,
    depends_on: Any,
    editing: Editing,
    cameras: Sequence[str],
    *,
    progress: bool,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Edit the frames in `work`; the manifest's entry, and each file's size and digest.

    A step is a time: a whole rig, in all styles. No more than three moments are in memory.

    Args:
        work: Folder with all frames and their layers.
        manifest: That names them.
        depends_on: All that the manifest and the files hold, as JSON values.
        editing: By whom, and to what.
        cameras: Of the clip, in its order.
        progress: Show a bar.

    Raises:
        ArgumentError: If the editor returns what are no pictures of its frames.
        DataError: If the editor cannot edit a frame.
        OutputError: If the work folder cannot be written.
    """
    moments = Moments(work, manifest, cameras)

    def made(time_index: int) -> tuple[dict[str, Any], dict[str, bytes]]:
        moment = moments.at(time_index)
        parts = {}
        for style in editing.styles:
            pictures = _edited(editing.editor, moment, style)
            for frame, picture in zip(moment.now, pictures, strict=True):
                parts[background_path(style, frame.key)] = png_bytes(np.ascontiguousarray(picture))
        return {}, parts

    def clean(folder: Path) -> None:
        """Without pictures of other frames, or of another editor."""
        if (folder / BACKGROUNDS).exists():
            shutil.rmtree(folder / BACKGROUNDS)
        for style in editing.styles:
            (folder / BACKGROUNDS / style).mkdir(parents=True)

    head = {
        "editor": editing.editor.name,
        "card": editing.card,
        "styles": list(editing.styles),
        "frames": _files.sha256_of(json.dumps([list(cameras), depends_on]).encode()),
    }
    task = Round("backgrounds", JOURNAL, head, moments.times, made, clean)
    done = make_all(task, work, progress)
    files = {
        path: file for time in moments.times for path, file in done[str(time)]["files"].items()
    }
    entry: dict[str, Any] = {"card": editing.card, "styles": list(editing.styles)}
    if editing.records:
        data = TrainedOn.union(editing.records.values()).as_bytes()
        _files.write_whole(work / TRAINED_ON, data)
        files[TRAINED_ON] = digest_record(data)
        entry["recorded"] = list(editing.records)
    return entry, files


def _edited(editor: BackgroundEditor, moment: Moment, style: str) -> Sequence[NDArray[np.uint8]]:
    """The frames of now in a style; what are no pictures of them is refused."""
    pictures = editor.edit(moment, style)
    if len(pictures) != len(moment.now):
        raise ArgumentError(
            f"editor {editor.name} gave {len(pictures)} pictures of {len(moment.now)} frames"
        )
    for frame, picture in zip(moment.now, pictures, strict=True):
        found = (getattr(picture, "dtype", None), getattr(picture, "shape", None))
        if found != (np.uint8, frame.image.shape):
            raise ArgumentError(
                f"editor {editor.name} gave no picture of frame {frame.key} in {style}: {found[0]} "
                f"{found[1]}, the frame is uint8 {frame.image.shape}"
            )
    return pictures
