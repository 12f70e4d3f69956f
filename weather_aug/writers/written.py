"""What an export wrote, read back from where it went to be looked at: a sheet and classes."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug import _files
from weather_aug.errors import DataError, IntegrityError, printable
from weather_aug.taxonomy import coloured
from weather_aug.view.histogram import class_histogram, pixel_shares
from weather_aug.view.sheet import grid
from weather_aug.writers import layout
from weather_aug.writers.source import Readable, Source, contents_of, lines_of, source_of
from weather_aug.writers.spread import spread_items

UInt8 = NDArray[np.uint8]

SHOWN = 8
COUNTED = 256
"""Labels that are read for the histogram; of 2 megapixels they take a few seconds."""
_COLUMNS = 4
_PAPER = 250


@dataclass(frozen=True)
class Written:
    """A keyed choice of an export's samples, and the pixels of each class in their labels."""

    shown: tuple[dict[str, Any], ...]
    """Entries of the manifest, in item order."""
    pixels: NDArray[np.int64]
    """(256,) by train id."""
    counted: int
    """Labels that were read for them."""
    labelled: int
    """Labels that there are."""

    @property
    def shares(self) -> dict[str, float] | None:
        """Share of pixels by class; None where nothing is labelled."""
        return pixel_shares(self.pixels) if self.counted else None


def read_written(out: Readable, *, shown: int = SHOWN, counted: int = COUNTED) -> Written:
    """Read back some samples of a finished export, spread over it by its job.

    Args:
        out: Folder or url that `export` wrote to.
        shown: How many samples to look at.
        counted: How many labels to count the pixels of.

    Raises:
        DataError: If `export.json` or the manifest cannot be read.
        IntegrityError: If a file is missing or is none of the export's any more.
        OutputError: If a url cannot be read.
    """
    source = source_of(out)
    contents = contents_of(source)
    samples = contents["samples"]
    job = _files.sha256_of(json.dumps(contents["job"], allow_nan=False).encode())
    pictured = set(spread_items("export-shown", job, samples, shown))
    weighed = set(spread_items("export-counted", job, samples, counted))
    entries = []
    pixels = np.zeros(256, np.int64)
    labels = 0
    for index, line in enumerate(lines_of(source, layout.MANIFEST)):
        if index not in weighed and index not in pictured:
            continue
        entry = json.loads(line)
        if index in pictured:
            entries.append(entry)
        if index in weighed and "label" in layout.parts_of(entry):
            pixels += np.bincount(read_part(source, entry, "label").ravel(), minlength=256)
            labels += 1
    return Written(tuple(entries), pixels, labels, contents["labelled"])


def read_part(out: Readable, entry: dict[str, Any], part: str) -> UInt8:
    """A part of a sample as its file or its tar holds it: (H, W, 3) RGB or (H, W).

    Raises:
        IntegrityError: If its bytes are not those that were written.
        OutputError: If a url cannot be read.
    """
    source = source_of(out)
    stored = layout.parts_of(entry)[part]
    relative = entry["files"]["tar"]["path"] if "tar" in entry["files"] else stored["path"]
    name = printable(f"{source}/{relative}", 200)
    try:
        data = source.read(relative, stored.get("offset", 0), stored["size"])
    except DataError as error:
        raise IntegrityError(str(error)) from None
    if _files.sha256_of(data) != stored["sha256"]:
        raise IntegrityError(f"{name} has changed since it was written")
    flag = cv2.IMREAD_COLOR_RGB if part == "image" else cv2.IMREAD_UNCHANGED
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), flag)
    if decoded is None:
        raise IntegrityError(f"{name} holds no picture of {part}")
    picture: UInt8 = decoded
    return picture


def written_sheet(out: Readable, written: Written, *, tile_width: int = 480) -> UInt8:
    """Samples with their labels, four in a row, and the histogram of classes below them.

    Returns:
        (H, W, 3) uint8; a label that nobody gave is grey, and where none is there neither rows of
        labels nor the histogram are.

    Raises:
        IntegrityError: If a file is missing or is none of the export's any more.
        OutputError: If a url cannot be read.
    """
    source = source_of(out)
    blocks = []
    columns = min(_COLUMNS, len(written.shown))
    for start in range(0, len(written.shown), columns):
        entries = written.shown[start : start + columns]
        images = [read_part(source, entry, "image") for entry in entries]
        rows, names = [images], ["image"]
        if written.counted:
            rows.append(
                [_label(source, entry, image) for entry, image in zip(entries, images, strict=True)]
            )
            names.append("label")
        blocks.append(grid(rows, names, [_caption(entry) for entry in entries], tile_width))
    width = max(block.shape[1] for block in blocks)
    shares = written.shares
    if shares is not None:
        whose = f"{written.counted} of {written.labelled} labels"
        title = f"share of pixels by class, {whose}, read back; logarithmic"
        blocks.append(class_histogram(shares, width=max(width, 640), title=title))
    return _stacked(blocks)


def _label(source: Source, entry: dict[str, Any], image: UInt8) -> UInt8:
    if "label" in layout.parts_of(entry):
        return coloured(read_part(source, entry, "label"))
    return np.full_like(image, 128)


def _caption(entry: dict[str, Any]) -> str:
    kind, severity = entry["recipe"]["kind"], entry["recipe"]["severity"]
    # A clear day is drawn with a severity, too.
    how = "" if severity is None or kind == "clear" else f" {severity:.2f}"
    return f"{kind}{how}, item {entry['item']}"


def _stacked(blocks: list[UInt8]) -> UInt8:
    """Pictures below each other on paper as wide as the widest."""
    width = max(block.shape[1] for block in blocks)
    padded = [
        np.pad(block, ((0, 0), (0, width - block.shape[1]), (0, 0)), constant_values=_PAPER)
        for block in blocks
    ]
    return np.concatenate(padded)
