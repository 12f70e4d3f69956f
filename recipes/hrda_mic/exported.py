"""What an export or a merge holds, and whether HRDA and MIC can train on it.

Convention:
    Everything that a trainer would only find out while it runs is looked at here, file by file:
    names, sizes, PNG headers, class statistics. Pixels are not: `weather-aug inspect` compares
    every byte with its digest.
"""

from __future__ import annotations

import hashlib
import json
import os
import struct
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from refused import Refused

FORMAT, NEWEST_VERSION = "weather_aug export", 2
STATS, BY_CLASS = "sample_class_stats.json", "samples_with_class.json"
MIN_PIXELS = 3000
"""Rare-class sampling counts a file for a class if it has more pixels of it than this."""

PNG_HEAD_BYTES = 26
GREY, RGB = 0, 2


class Size(NamedTuple):
    """Of a picture, pixels."""

    width: int
    height: int

    def __str__(self) -> str:
        return f"{self.width}x{self.height}"


class Reader(NamedTuple):
    """The data set class that reads a layout, and the names that it is tied to."""

    type: str
    img_dir: str
    ann_dir: str
    img_suffix: str
    seg_map_suffix: str


READERS = {
    layout: Reader(*names.split())
    for layout, names in {
        "cityscapes": "CityscapesDataset leftImg8bit/{split} gtFine/{split} "
        "_leftImg8bit.png _gtFine_labelTrainIds.png",
        "acdc": "ACDCDataset rgb_anon/{split} gt/{split} _rgb_anon.png _gt_labelTrainIds.png",
        "gta": "GTADataset images labels .png _labelTrainIds.png",
    }.items()
}


class Listed(NamedTuple):
    """A sample's files, relative to the data; bytes where they were recorded."""

    image: str
    image_bytes: int | None
    label: str | None
    label_bytes: int | None


class Exported(NamedTuple):
    """A finished export, or exports merged with Cityscapes."""

    root: Path
    layout: str
    reader: Reader
    """With the split filled in."""
    samples: int
    sizes: dict[Size, int]
    """Pictures of each size."""
    dropped: list[int]
    """Train ids that occur, but in no file often enough to be sampled."""
    editors: list[Any] | None
    """Editors of backgrounds, and what they were trained on; None where it was not recorded."""


def read_export(root: Path, *, labelled: bool) -> Exported:
    """Check a finished export, or a merge of some, for a trainer.

    Args:
        root: Folder of the export or of the merge.
        labelled: Whether labels and class statistics are needed, as a source does.

    Raises:
        Refused: If a trainer could not load it.
    """
    if (root / "merge.json").is_file():
        return _read_merge(root, labelled)
    contents = _contents(root)
    layout, split = contents["job"]["layout"], contents["job"]["split"]
    if layout not in READERS:
        raise Refused(
            f"{root} has the layout {layout!r}, which no data set class of HRDA or MIC reads; "
            f"export it again as {' or '.join(READERS)}"
        )
    reader = _reader(layout, split)
    if labelled and contents["labelled"] < contents["samples"]:
        unlabelled = contents["samples"] - contents["labelled"]
        raise Refused(
            f"{unlabelled} of {contents['samples']} samples in {root} have no label, and a source "
            "is trained on labels; export labelled scenes only, or use it as a target"
        )
    _check_root_file(root, contents, "manifest.jsonl")
    sizes = _check_samples(root, reader, _manifest(root), labelled)
    if labelled:
        for name in (STATS, BY_CLASS):
            _check_root_file(root, contents, name)
        _check_class_stats(root, reader)
    dropped, editors = contents["dropped_classes"], contents.get("editors")
    return Exported(root, layout, reader, contents["samples"], dict(sizes), dropped, editors)


def _read_merge(root: Path, labelled: bool) -> Exported:
    """Cityscapes and exports, linked into one source; its statistics are written last."""
    if not labelled:
        raise Refused(f"{root} is a merge, which is a source; give an export as a target")
    if not (root / BY_CLASS).is_file():
        raise Refused(f"{root} is not finished; run the same merge again")
    reader = _reader("cityscapes", "train")
    sizes = _check_samples(root, reader, _linked(root, reader), labelled)
    _check_class_stats(root, reader)
    editors: list[Any] | None = []
    for export in _json(root / "merge.json")["exports"]:
        found = _contents(root / export).get("editors")
        editors = None if editors is None or found is None else editors + found
    return Exported(root, "merge", reader, sum(sizes.values()), dict(sizes), [], editors)


def _reader(layout: str, split: str) -> Reader:
    reader = READERS[layout]
    return reader._replace(
        img_dir=reader.img_dir.format(split=split), ann_dir=reader.ann_dir.format(split=split)
    )


def _contents(root: Path) -> dict[str, Any]:
    """The fields of `export.json`, which is written last and seals itself."""
    path = root / "export.json"
    if not path.is_file():
        if (root / ".export").is_dir():
            raise Refused(f"{root} is not finished; run the same export again to continue it")
        raise Refused(f"{root} is no export (no export.json); make one with `weather-aug export`")
    try:
        contents = json.loads(path.read_text(encoding="utf-8"))
        seal = contents.pop("sha256")
        whole = hashlib.sha256(json.dumps(contents).encode()).hexdigest() == seal
    except (ValueError, KeyError, AttributeError):
        whole = False
    if not whole or contents.get("format") != FORMAT:
        raise Refused(f"{path} has changed since it was written; run the same export again")
    if contents["version"] > NEWEST_VERSION:
        raise Refused(
            f"{path} has version {contents['version']}, this recipe knows {NEWEST_VERSION} and "
            "older; take the recipe of the weather_aug that wrote it"
        )
    return contents


def _check_samples(
    root: Path, reader: Reader, samples: Iterable[Listed], labelled: bool
) -> Counter[Size]:
    """Every file that the loaders will open; how many pictures there are of each size."""
    sizes: Counter[Size] = Counter()
    image_by_name: dict[str, str] = {}
    for image, image_bytes, label, label_bytes in samples:
        size = _checked_png(root / image, image_bytes, RGB)
        sizes[size] += 1
        name = image.rsplit("/", 1)[-1]
        if name in image_by_name:
            raise Refused(
                f"{image} and {image_by_name[name]} in {root} have one base name, by which the "
                "trainers tell labels apart; export again, without renaming or merging by hand"
            )
        image_by_name[name] = image
        if labelled:
            if label is None or label != _label_of(image, reader):
                raise Refused(
                    f"{label} in {root} is not where {reader.type} looks for the label of {image}; "
                    "export again, files must not be renamed"
                )
            if _checked_png(root / label, label_bytes, GREY) != size:
                raise Refused(f"{image} in {root} and its label differ in size; export again")
    _check_scan(root / reader.img_dir)
    found = sum(1 for _ in scanned(root / reader.img_dir, reader.img_suffix))
    if found != len(image_by_name):
        raise Refused(
            f"{root / reader.img_dir} holds {found} pictures, the export made "
            f"{len(image_by_name)}, and the loaders take all that they find; remove what is not of "
            "the export"
        )
    return sizes


def _check_scan(folder: Path) -> None:
    """What is hidden, or a link that leads nowhere, mmcv 1.3.7 takes for a folder, and stops."""
    for below, _, names in os.walk(str(folder), followlinks=True):
        for name in names:
            path = Path(below) / name
            if name.startswith("."):
                raise Refused(f"{path} is a hidden file, at which the loaders stop; remove it")
            if not path.is_file():
                raise Refused(
                    f"{path} is a link that leads nowhere, at which the loaders stop; remove it"
                )


def scanned(folder: Path, suffix: str) -> Iterator[str]:
    """Files below a folder by suffix, of any depth; links are followed, as the loaders do."""
    for below, _, names in os.walk(str(folder), followlinks=True):
        for name in names:
            if name.endswith(suffix) and not name.startswith("."):
                yield (Path(below) / name).relative_to(folder).as_posix()


def _manifest(root: Path) -> Iterator[Listed]:
    with (root / "manifest.jsonl").open(encoding="utf-8") as lines:
        for line in lines:
            files = json.loads(line)["files"]
            image, label = files["image"], files.get("label", {})
            yield Listed(image["path"], image["size"], label.get("path"), label.get("size"))


def _linked(root: Path, reader: Reader) -> Iterator[Listed]:
    for name in scanned(root / reader.img_dir, reader.img_suffix):
        image = f"{reader.img_dir}/{name}"
        yield Listed(image, None, _label_of(image, reader), None)


def _label_of(image: str, reader: Reader) -> str:
    """Where a loader looks for a label: the suffix replaced, wherever it occurs in the path."""
    relative = image[len(reader.img_dir) + 1 :]
    return f"{reader.ann_dir}/{relative.replace(reader.img_suffix, reader.seg_map_suffix)}"


def _checked_png(path: Path, recorded_bytes: int | None, colours: int) -> Size:
    """Size of a PNG of 8 bits, from its header."""
    try:
        with path.open("rb") as file:
            head = file.read(PNG_HEAD_BYTES)
            whole = recorded_bytes in (None, file.seek(0, os.SEEK_END))
    except OSError as error:
        raise Refused(
            f"{path} cannot be read ({error.strerror}); run the same export again, it repairs"
        ) from None
    if not whole or len(head) < PNG_HEAD_BYTES or head[:8] != b"\x89PNG\r\n\x1a\n":
        raise Refused(f"{path} is not whole; run the same export again, it repairs")
    width, height, bits, found = struct.unpack(">IIBB", head[16:26])
    if (bits, found) != (8, colours):
        what = "label of one channel" if colours == GREY else "picture in RGB"
        raise Refused(f"{path} is no {what} with 8 bits; run the same export again, it repairs")
    return Size(width, height)


def _check_class_stats(root: Path, reader: Reader) -> None:
    """What rare-class sampling asserts when the training starts, minutes into it."""
    classes = {int(c) for row in _json(root / STATS) for c in row if c != "file"}
    if not classes:
        raise Refused(
            f"no class in {root} has {MIN_PIXELS} pixels in one picture, so that rare-class "
            "sampling has nothing to draw; export larger pictures"
        )
    files = {int(c): rows for c, rows in _json(root / BY_CLASS).items()}
    scan = scanned(root / reader.ann_dir, reader.seg_map_suffix)
    labels = {path.rsplit("/", 1)[-1] for path in scan}
    for train_id in sorted(classes):
        rare = [path for path, pixels in files.get(train_id, []) if pixels > MIN_PIXELS]
        if not rare:
            raise Refused(
                f"class {train_id} is in {root / STATS} but has no file with more than "
                f"{MIN_PIXELS} pixels, where the trainers stop; run the same export again"
            )
        lost = [path for path in rare if path.rsplit("/", 1)[-1] not in labels]
        if lost:
            raise Refused(f"{root / BY_CLASS} names {lost[0]}, which is not there; export again")


def _check_root_file(root: Path, contents: dict[str, Any], name: str) -> None:
    stored = contents["files"].get(name)
    if stored is None:
        raise Refused(
            f"{root} has no {name}, which the trainers read of a source; export it with a layout "
            "that has class statistics (cityscapes, gta) from labelled scenes"
        )
    digest = hashlib.sha256()
    try:
        with (root / name).open("rb") as file:
            for chunk in iter(lambda: file.read(1 << 20), b""):
                digest.update(chunk)
    except OSError as error:
        raise Refused(
            f"{root / name} cannot be read ({error.strerror}); run the same export again"
        ) from None
    if digest.hexdigest() != stored["sha256"]:
        raise Refused(f"{root / name} has changed since it was written; run the same export again")


def _json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))
