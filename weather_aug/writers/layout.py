"""What an export's files are called; checkers need it too, so it imports nothing heavy.

Samples stand where their layout says (see `LAYOUTS`); at the root stand

sample_class_stats.json  sample_class_stats_dict.json  samples_with_class.json    where trainers ask
manifest.jsonl                                              one line a sample, in item order
export.json                                                 the job, counts, digests
.export/                                                    lock and journal, until it is done
.export/shards/                                             those of each shard
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from weather_aug import _files
from weather_aug.errors import ArgumentError, DataError, IntegrityError, printable

FORMAT = "weather_aug export"
VERSION = 2

CONTENTS = "export.json"
MANIFEST = "manifest.jsonl"
CLASS_STATS = "sample_class_stats.json"
CLASS_STATS_DICT = "sample_class_stats_dict.json"
SAMPLES_WITH_CLASS = "samples_with_class.json"

STATE = ".export"
JOURNAL = f"{STATE}/journal"
QUARANTINE = f"{STATE}/quarantine.jsonl"
SHARDS = f"{STATE}/shards"
"""Each folder in it is the state of a shard, which looks as the export's own."""
MARK = f"{STATE}/job.json"
"""At a url, the job that is being written there."""

PARTS = ("image", "label", "invalid", "transmittance", "depth")
"""What a sample may consist of; label, invalid and depth where the scene knows them."""


@dataclass(frozen=True)
class Layout:
    """Where the parts of a sample stand, for whom."""

    name: str
    paths: Mapping[str, str]
    """Path of each part, of `{split}`, `{scene}` (folders) and `{base}` (unique in the export);
    the name of its member where samples stand in tars."""
    parts: tuple[str, ...]
    """Parts that are written if nobody chooses."""
    has_class_stats: bool = False
    """Whether the files of rare-class sampling are written, too."""
    tar: str | None = None
    """Path of a unit's tar, of `{split}` and `{unit}`; None where each part is a file."""
    items_per_unit: int = 1
    """Samples that are committed together: 1, or the samples of a tar."""

    def path(self, part: str, *, split: str, scene: str, base: str) -> str:
        """Path of a sample's part, relative to the export, or the name of its member."""
        return self.paths[part].format(split=split, scene=scene, base=base)

    @property
    def roots(self) -> tuple[str, ...]:
        """Top folders that samples stand in."""
        paths = self.paths.values() if self.tar is None else (self.tar,)
        return tuple(dict.fromkeys(path.split("/")[0] for path in paths))


LAYOUTS = {
    layout.name: layout
    for layout in (
        Layout(
            "cityscapes",
            {
                "image": "leftImg8bit/{split}/{scene}/{base}_leftImg8bit.png",
                "label": "gtFine/{split}/{scene}/{base}_gtFine_labelTrainIds.png",
                "invalid": "gtFine/{split}/{scene}/{base}_gtFine_invIds.png",
                "transmittance": "transmittance/{split}/{scene}/{base}_transmittance.png",
                "depth": "depth/{split}/{scene}/{base}_depth.png",
            },
            ("image", "label"),
            has_class_stats=True,
        ),
        Layout(
            "acdc",
            {
                "image": "rgb_anon/{split}/{scene}/{base}_rgb_anon.png",
                "label": "gt/{split}/{scene}/{base}_gt_labelTrainIds.png",
                "invalid": "gt/{split}/{scene}/{base}_gt_invIds.png",
                "transmittance": "transmittance/{split}/{scene}/{base}_transmittance.png",
                "depth": "depth/{split}/{scene}/{base}_depth.png",
            },
            ("image", "label", "invalid"),
        ),
        Layout(
            "gta",
            {
                "image": "images/{base}.png",
                "label": "labels/{base}_labelTrainIds.png",
                "invalid": "invalid/{base}.png",
                "transmittance": "transmittance/{base}.png",
                "depth": "depth/{base}.png",
            },
            ("image", "label"),
            has_class_stats=True,
        ),
        Layout(
            "folders",
            {
                "image": "images/{scene}/{base}.png",
                "label": "labels/{scene}/{base}.png",
                "invalid": "invalid/{scene}/{base}.png",
                "transmittance": "transmittance/{scene}/{base}.png",
                "depth": "depth/{scene}/{base}.png",
            },
            ("image", "label"),
        ),
        Layout(
            "webdataset",
            {part: f"{{base}}.{part}.png" for part in PARTS},
            ("image", "label"),
            tar="shards/{split}-{unit:06d}.tar",
            # A tar is made in memory: 32 samples of 1920 x 1080 are about 130 MB.
            items_per_unit=32,
        ),
    )
}
"""By name.

cityscapes   a labelled source for DAFormer, HRDA and MIC; label files are matched by base name
acdc         a target for them; the split comes first, as where their README restructures ACDC
gta          a labelled source without folders: the rare-class sampling of its data set class looks
             for the last part of a label's path, so that labels in folders would not be found
folders      equal stems everywhere, as `clip.folder` pairs them (taxonomy=train_ids)
webdataset   tars of samples `<base>.<part>.png` and `<base>.json`, the recipe; see `writers.tars`

An export is one split; gta and folders have no folder for it.
"""


def layout_called(name: str) -> Layout:
    """The layout of a name.

    Raises:
        ArgumentError: If there is none.
    """
    if name not in LAYOUTS:
        raise ArgumentError(f"layout {printable(name)!r} is not one of {', '.join(LAYOUTS)}")
    return LAYOUTS[name]


def parts_of(entry: Mapping[str, Any]) -> Mapping[str, Any]:
    """The parts of a manifest's entry by name: members of its tar, or files."""
    parts: Mapping[str, Any] = entry.get("members", entry["files"])
    return parts


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
        return checked_contents(file.read(_files.MAX_JSON_BYTES + 1), str(path))


def checked_contents(data: bytes, path: str) -> dict[str, Any]:
    """The fields of an `export.json`; see `read_contents`."""
    if len(data) > _files.MAX_JSON_BYTES:
        raise DataError(f"{printable(path, 200)} is larger than {_files.MAX_JSON_BYTES} bytes")
    contents = _files.parse_json(data.decode(errors="replace"), path)
    if not isinstance(contents, dict) or contents.get("format") != FORMAT:
        raise IntegrityError(f"{printable(path, 200)} is not of a {FORMAT}")
    contents.pop("sha256", None)
    if data != sealed_contents(contents):
        raise IntegrityError(f"{printable(path, 200)} has changed since it was written")
    return contents
