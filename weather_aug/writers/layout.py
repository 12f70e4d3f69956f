"""What an export's files are called; checkers need it too, so it imports nothing heavy.

leftImg8bit/train/<scene>/<base>_leftImg8bit.png            the picture in weather
gtFine/train/<scene>/<base>_gtFine_labelTrainIds.png        train ids, where there are labels
sample_class_stats.json  sample_class_stats_dict.json  samples_with_class.json
manifest.jsonl                                              one line a sample, in item order
export.json                                                 the job, counts, digests
.export/                                                    lock and journal, until it is done
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from weather_aug import _files
from weather_aug.errors import DataError, IntegrityError, printable

FORMAT = "weather_aug export"
VERSION = 1
LAYOUT = "cityscapes"

CONTENTS = "export.json"
MANIFEST = "manifest.jsonl"
CLASS_STATS = "sample_class_stats.json"
CLASS_STATS_DICT = "sample_class_stats_dict.json"
SAMPLES_WITH_CLASS = "samples_with_class.json"

STATE = ".export"
JOURNAL = f"{STATE}/journal"
QUARANTINE = f"{STATE}/quarantine.jsonl"

PART_FOLDERS = {"image": "leftImg8bit/train", "label": "gtFine/train"}
PART_SUFFIXES = {"image": "_leftImg8bit.png", "label": "_gtFine_labelTrainIds.png"}
SAMPLE_ROOTS = tuple(folder.split("/")[0] for folder in PART_FOLDERS.values())


def part_path(part: str, scene_name: str, base_name: str) -> str:
    """Path of a sample's `image` or `label`, relative to the export."""
    return f"{PART_FOLDERS[part]}/{scene_name}/{base_name}{PART_SUFFIXES[part]}"


def sealed_contents(contents: dict[str, Any]) -> bytes:
    """`export.json` as it stands on disk, with its own digest as the last field."""
    seal = {"sha256": _files.sha256_of(json.dumps(contents, allow_nan=False).encode())}
    return (json.dumps(contents | seal, indent=1, allow_nan=False) + "\n").encode()


def read_contents(out: Path) -> dict[str, Any]:
    """Read and check an export's `export.json`.

    Raises:
        DataError: If it is too large or not JSON.
        IntegrityError: If it is not an export's, or its own digest does not match.
        OSError: If it cannot be read.
    """
    path = out / CONTENTS
    with path.open("rb") as file:
        data = file.read(_files.MAX_JSON_BYTES + 1)
    if len(data) > _files.MAX_JSON_BYTES:
        raise DataError(f"{printable(path, 200)} is larger than {_files.MAX_JSON_BYTES} bytes")
    contents = _files.parse_json(data.decode(errors="replace"), str(path))
    if not isinstance(contents, dict) or contents.get("format") != FORMAT:
        raise IntegrityError(f"{printable(path, 200)} is not of a {FORMAT}")
    contents.pop("sha256", None)
    if data != sealed_contents(contents):
        raise IntegrityError(f"{printable(path, 200)} has changed since it was written")
    return contents
