"""Did a picture that a network is to be scored on train the editor of what it learnt from?

Scenes, exports and merges carry the digests of all pictures that trained the editors of their
backgrounds. An editor that learnt nothing leaks nothing; of one whose record is missing nobody
knows, and unknown is not clean. What else was trained (the editor's base model, networks that gave
depth or labels) is on no record.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from weather_aug.edit.diffusion.leakage import (
    MAX_TRAINED_ON_BYTES,
    Digests,
    TrainedOn,
    digests_by_path,
    pictures_in,
)
from weather_aug.edit.editors import UNTRAINED
from weather_aug.errors import DataError, printable
from weather_aug.scene import store
from weather_aug.scene.scene import WeatherScene
from weather_aug.writers import layout, merged
from weather_aug.writers.editors import RECORD, editors_of
from weather_aug.writers.source import Source, contents_of, exists, is_url, source_of


class Leakage(NamedTuple):
    """What is known of some pictures; only where both lists are empty did none train an editor."""

    pictures: int
    """How many were looked up."""
    editors: int
    """How many editors with a record they were looked up for."""
    trained: list[str]
    """One sentence for each picture that trained an editor."""
    unrecorded: list[str]
    """One sentence for each editor of which it is not, or not fully, known what trained it."""


class _Record(NamedTuple):
    """What trained one editor."""

    editor: str
    """Its name, for people."""
    file: str
    digests: frozenset[str]


def trained_pictures(out: str | Path, pictures: Path, *, progress: bool = False) -> Leakage:
    """Look pictures up among those that trained the editors of a data set's backgrounds.

    Found are a picture's file, and its pixels in another file. A picture that was resized, cropped
    or compressed again has other pixels, and is not found.

    Args:
        out: Scene, finished export (a folder, or its url), or merge.
        pictures: Folder of pictures at any depth, such as a validation set, or one picture; they
            are read one by one.
        progress: Show a bar.

    Raises:
        DataError: If `out` is none of them or malformed, or a picture or folder cannot be read.
        IntegrityError: If a record, or the file that names it, has changed since it was written.
        OutputError: If a url does not answer.
    """
    records, unrecorded = _records(out)
    paths = list(pictures_in([Path(pictures)]))
    # Where nothing was learnt there is nothing to look up.
    looked_up = digests_by_path(paths, progress=progress) if records else ()
    trained = [
        f"{printable(path, 200)} trained {' and '.join(told)}"
        for path, digests in looked_up
        if (told := [_told(record, digests) for record in records if _is_in(record, digests)])
    ]
    return Leakage(len(paths), len(records), trained, unrecorded)


def _is_in(record: _Record, digests: Digests) -> bool:
    return not record.digests.isdisjoint(digests)


def _told(record: _Record, digests: Digests) -> str:
    what = "file is" if digests.file in record.digests else "pixels are"
    return f"the editor {record.editor} (its {what} in {record.file})"


def _records(out: str | Path) -> tuple[list[_Record], list[str]]:
    """What trained the editors, and a sentence for each of which that is not known."""
    editors, read = _editors(out)
    if editors is None:
        return [], [f"{source_of(out)} was made before exports named their editors"]
    try:
        records = [
            _Record(_shown(editor), str(editor["trained_on"]), read(editor["trained_on"]).digests)
            for editor in editors
            if "trained_on" in editor
        ]
        unrecorded = [
            f"what trained the editor {of} is on no record"
            for editor in editors
            if (of := _unknown(editor))
        ]
    except (KeyError, TypeError, AttributeError) as error:
        raise DataError(
            f"{source_of(out)}: its editors are malformed: {type(error).__name__} "
            f"{printable(error)}"
        ) from None
    return records, list(dict.fromkeys(unrecorded))


def _unknown(editor: Mapping[str, Any]) -> str:
    """An editor, or styles of it, of which nobody knows what trained it; empty if all is known."""
    if "trained_on" not in editor:
        return "" if editor["editor"] in UNTRAINED else _shown(editor)
    styles = ", ".join(map(printable, editor.get("unrecorded", ())))
    return f"{_shown(editor)} for {styles}" if styles else ""


def _editors(out: str | Path) -> tuple[Any, Callable[[Any], TrainedOn]]:
    """Editors as `editors_of` gives them, None if nobody noted them; and what reads a record."""
    if not is_url(out) and (Path(out) / store.MANIFEST).is_file():
        scene = WeatherScene.load(out)
        return editors_of([scene]), lambda name: _of_scene(scene)
    if not is_url(out) and (Path(out) / merged.CONTENTS).is_file():
        contents = merged.read_merge(Path(out))
        return contents.get("editors"), partial(_of_merge, Path(out), contents)
    source = source_of(out)
    if not exists(source, layout.CONTENTS):
        raise DataError(
            f"{source} is neither a scene nor a merge nor a finished export "
            f"(no {layout.CONTENTS}); check the path"
        )
    contents = contents_of(source)
    return contents.get("editors"), partial(_of_export, source, contents)


def _of_scene(scene: WeatherScene) -> TrainedOn:
    record = store.read_trained_on(scene.path, scene.manifest)
    assert record is not None
    return record


def _of_merge(out: Path, contents: Mapping[str, Any], name: Any) -> TrainedOn:
    """By its link; whatever that leads to must be what was written."""
    return TrainedOn.read_file(out / name, _digest(contents, name))


def _of_export(source: Source, contents: Mapping[str, Any], name: Any) -> TrainedOn:
    sha256 = _digest(contents, name)
    data = source.read(name, 0, min(source.size(name), MAX_TRAINED_ON_BYTES))
    return TrainedOn.parse(data, f"{source}/{name}", sha256)


def _digest(contents: Mapping[str, Any], name: Any) -> str:
    """Of a record, as it was noted."""
    if not isinstance(name, str) or not RECORD.fullmatch(name):
        raise DataError(f"an editor's record cannot be called {printable(name)}; export it again")
    return str(contents["files"][name]["sha256"])


def _shown(editor: Mapping[str, Any]) -> str:
    """An editor's name and, where its card tells, which adapter it was."""
    adapter = editor["card"].get("adapter_sha256")
    which = f" {printable(adapter[:12])}" if isinstance(adapter, str) else ""
    return f"{printable(editor['editor'])}{which}"
