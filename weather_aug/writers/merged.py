"""`merge.json`, which makes a folder a merge; readers need no more of `merge` than this."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from weather_aug import _files
from weather_aug.errors import DataError, IntegrityError, printable
from weather_aug.writers import layout

FORMAT = "weather_aug merge"
CONTENTS = "merge.json"


def is_merge(out: Path) -> bool:
    """Whether a folder says that it is a merge, of whatever version."""
    try:
        contents = _files.read_json(out / CONTENTS)
    except DataError:
        return False
    return isinstance(contents, dict) and contents.get("format") == FORMAT


def read_merge(out: Path) -> dict[str, Any]:
    """Read and check a merge's `merge.json`.

    Raises:
        DataError: If it is not a merge's.
        IntegrityError: If its own digest does not match.
    """
    path = out / CONTENTS
    contents = _files.read_json(path)
    if not isinstance(contents, dict) or contents.get("format") != FORMAT:
        raise DataError(f"{printable(path, 200)} is not of a {FORMAT}; run the merge again")
    contents.pop("sha256", None)
    if path.read_bytes() != layout.sealed_contents(contents):
        raise IntegrityError(
            f"{printable(path, 200)} has changed since it was written, or is of an earlier "
            "version; run the merge again"
        )
    return contents
