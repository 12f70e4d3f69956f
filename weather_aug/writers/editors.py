"""Which editors made the backgrounds of an export's scenes, and what trained them."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from weather_aug import _files
from weather_aug.scene import store
from weather_aug.scene.backgrounds_record import TRAINED_ON
from weather_aug.scene.records import Manifest
from weather_aug.scene.scene import WeatherScene

RECORD = re.compile(r"trained_on_[0-9a-f]{16}\.txt")
"""Name of a record at the root of an export or a merge; the digits are of its SHA-256."""


def editors_of(scenes: Iterable[WeatherScene]) -> list[dict[str, Any]]:
    """Editors of the scenes' stored backgrounds, each once, as JSON values.

    Each has its `card`; `trained_on`, the name of the record at the root, where there is one; and
    `unrecorded`, styles of which that record does not tell, where there are any.
    """
    made: list[dict[str, Any]] = []
    for scene in scenes:
        record = scene.manifest.backgrounds
        if record is None:
            continue
        editor: dict[str, Any] = {"editor": scene.manifest.editor, "card": dict(record.card)}
        if record.recorded:
            editor["trained_on"] = _name(scene.manifest)
            if record.unrecorded:
                editor["unrecorded"] = list(record.unrecorded)
        if editor not in made:
            made.append(editor)
    return made


def write_records(scenes: Iterable[WeatherScene], out: Path) -> list[str]:
    """Write what trained the scenes' editors to a root, each record once; their names.

    Raises:
        DataError: If a scene's record cannot be read.
        IntegrityError: If it has changed since the scene was built.
        OutputError: If it cannot be written.
    """
    names: dict[str, None] = {}
    for scene in scenes:
        trained_on = store.read_trained_on(scene.path, scene.manifest)
        if trained_on is not None and (name := _name(scene.manifest)) not in names:
            _files.write_whole(out / name, trained_on.as_bytes())
            names[name] = None
    return list(names)


def _name(manifest: Manifest) -> str:
    return f"trained_on_{manifest.files[TRAINED_ON].sha256[:16]}.txt"
