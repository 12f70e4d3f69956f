"""Exports beside a Cityscapes root, by links: one labelled source for a trainer, without a copy.

    OUT/leftImg8bit  OUT/gtFine                  links to every file of the root and the exports
    OUT/sample_class_stats.json and two others   statistics of all training labels together
    OUT/trained_on_….txt                         links to what trained the exports' editors, if any
    OUT/merge.json                               what was merged; it makes the folder a merge

Links are relative, so that they hold where root, exports and merge are moved or mounted together.
The statistics are written last: a merge that was cut short has none, and a trainer that needs them
says so. Root and exports are only read.
"""

from __future__ import annotations

import errno
import filecmp
import json
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from weather_aug import _files, _lock
from weather_aug.clip.images import read_label
from weather_aug.errors import (
    ArgumentError,
    ConflictError,
    DataError,
    IntegrityError,
    OutputError,
    printable,
)
from weather_aug.taxonomy import CLASSES
from weather_aug.writers import layout
from weather_aug.writers.cityscapes import ClassStats
from weather_aug.writers.editors import RECORD
from weather_aug.writers.manifest import usable_lines
from weather_aug.writers.merged import CONTENTS, FORMAT, is_merge, read_merge
from weather_aug.writers.sample import class_pixels
from weather_aug.writers.target import LocalFolder

SPLIT = "train"
"""The split that exports join and that statistics count, as the trainers' converter does."""
CONVERTER = "python tools/convert_datasets/cityscapes.py"
"""Of the trainers' repositories; it makes train ids and statistics of Cityscapes' polygons."""
MAX_STATS_BYTES = 256 * 2**20

_LOCK = ".merge.lock"
_STATS = (layout.CLASS_STATS, layout.CLASS_STATS_DICT, layout.SAMPLES_WITH_CLASS)
_OWN = {CONTENTS, _LOCK, *_STATS}
_IMAGE, _LABEL = "_leftImg8bit.png", "_gtFine_labelTrainIds.png"


@dataclass(frozen=True)
class MergeReport:
    """What a merge holds now, and what this run did for it."""

    out: Path
    samples: int
    """Labelled training pictures."""
    exported: int
    """Of them, those of the exports."""
    counted: int
    """Labels of the root that its own statistics did not know, and that were counted."""
    linked: int
    """Links made by this run; the others were there."""
    removed: int
    """Links of an earlier run that are no longer part of the merge."""
    classes: tuple[int, ...]
    """Train ids in the class statistics."""
    dropped_classes: tuple[int, ...]
    """Train ids that occur, but never with enough pixels for rare-class sampling."""
    seconds: float


class _Source(NamedTuple):
    """A root or an export, as it will stand in the merge."""

    files: dict[str, Path]
    """What each relative path links to."""
    labels: dict[str, Mapping[str, int]]
    """Class pixels of each training label, by relative path."""
    editors: list[Any] | None
    """Of an export's backgrounds, see `writers.editors`; None where nobody noted them."""
    records: dict[str, Mapping[str, Any]]
    """Size and digest of each record of what trained them, by name."""
    counted: int = 0


def merge_cityscapes(
    root: Path,
    exports: Sequence[Path],
    out: Path,
    *,
    hard: bool = False,
    progress: bool = False,
) -> MergeReport:
    """Make `out` a Cityscapes root that holds `root` and `exports`, all by links.

    Running it again repairs what is missing; with other exports it adds and removes links. A root's
    own statistics are believed; labels that they do not know are counted. Classes of which no label
    in the union has more than `cityscapes.MIN_PIXELS` pixels are left out of the statistics.

    Args:
        root: Cityscapes as the trainers have it, converted to train ids, or an export.
        exports: Finished exports in the layout cityscapes, split train, all samples labelled.
        out: Folder to make, or an earlier merge.
        hard: Make hard links, for tools that do not follow symbolic ones; one disk has to hold all.
        progress: Show a bar while labels are counted.

    Raises:
        ArgumentError: If an export has another layout or split, or samples without a label.
        ConflictError: If two labels have one base name, which the trainers match files by, or
            `out` holds files that are not the merge's, or another process merges into it.
        DataError: If the root is none, or is not converted to train ids; if an export is not
            finished.
        IntegrityError: If an export is damaged.
        OutputError: If `out` lies inside a source or cannot be written.
    """
    start_s = time.monotonic()
    root, exports = Path(root).resolve(), [Path(export).resolve() for export in exports]
    out = _checked_out(Path(out), [root, *exports])
    is_export = (root / layout.CONTENTS).exists()
    first = _source_of_export(root) if is_export else _source_of_root(root, progress)
    merged = _united([first, *map(_source_of_export, exports)])
    busy = f"{printable(out, 200)} is being merged"
    with _lock.exclusive(out / _LOCK, busy), _files.reported(out):
        try:
            _files.remove_temporaries(out)
            foreign = _foreign_file(out, merged.files)
            if foreign is not None:
                raise ConflictError(
                    f"{printable(foreign, 200)} is not of this merge; move it away, or choose an "
                    "empty or new folder"
                )
            for name in _STATS:
                (out / name).unlink(missing_ok=True)
            _files.write_whole(out / CONTENTS, _contents(out, root, exports, merged))
            removed = _removed(out, merged.files)
            linked = sum(_linked(out / path, to, hard) for path, to in merged.files.items())
            stats = _written_stats(out, merged.labels)
        finally:
            (out / _LOCK).unlink(missing_ok=True)
    return MergeReport(
        out=out,
        samples=len(merged.labels),
        exported=len(merged.labels) - len(first.labels),
        counted=merged.counted,
        linked=linked,
        removed=removed,
        classes=stats.kept,
        dropped_classes=stats.dropped,
        seconds=time.monotonic() - start_s,
    )


def _checked_out(out: Path, sources: list[Path]) -> Path:
    """Return `out` resolved, if it is new, empty, or a merge, and outside all sources."""
    with _files.reported(out):
        out = out.resolve()
        for source in sources:
            if out.is_relative_to(source):
                raise OutputError(
                    f"{printable(out, 200)} lies inside {printable(source, 200)}, which is only "
                    "read; choose a folder outside it"
                )
        if out.exists() and not out.is_dir():
            raise OutputError(f"{printable(out, 200)} is not a folder; choose another output")
        found = {path.name for path in out.iterdir()} - {_LOCK} if out.exists() else set()
    if found and not is_merge(out):
        raise ConflictError(
            f"{printable(out, 200)} is no merge, but holds {printable(sorted(found)[0])}; choose "
            "an empty or new folder"
        )
    return out


def _source_of_root(root: Path, progress: bool) -> _Source:
    """Every file of a Cityscapes root, and the class pixels of its training labels."""
    from tqdm.auto import tqdm

    files = dict(_files_below(root, "leftImg8bit")) | dict(_files_below(root, "gtFine"))
    images = [p for p in files if p.startswith(f"leftImg8bit/{SPLIT}/") and p.endswith(_IMAGE)]
    if not images:
        raise DataError(
            f"{printable(root, 200)} is no Cityscapes root: leftImg8bit/{SPLIT} holds no "
            f"*{_IMAGE}; check the path"
        )
    names = [image.removeprefix("leftImg8bit").removesuffix(_IMAGE) for image in images]
    paths = [f"gtFine{name}{_LABEL}" for name in names]
    missing = [path for path in paths if path not in files]
    if missing:
        raise DataError(
            f"{printable(root, 200)} is not converted to train ids: {len(missing)} of {len(paths)} "
            f"training pictures have no label ({printable(missing[0], 160)} first); run "
            f"`{CONVERTER} {printable(root, 200)}` in a checkout of HRDA or of MIC's seg"
        )
    known = _known_stats(root)
    unknown = [path for path in paths if Path(path).name not in known]
    counted = {
        path: _counted(files[path])
        for path in tqdm(unknown, desc="count", unit="label", disable=not progress)
    }
    labels: dict[str, Mapping[str, int]] = {
        path: counted[path] if path in counted else known[Path(path).name] for path in paths
    }
    if not (root / CONTENTS).exists():
        # Nobody edited recorded pictures.
        return _Source(files, labels, [], {}, len(unknown))
    # A merge has exports in it.
    contents = read_merge(root)
    files |= {name: (root / name).resolve() for name in contents["files"]}
    return _Source(files, labels, contents["editors"], contents["files"], len(unknown))


def _files_below(root: Path, part: str) -> Iterator[tuple[str, Path]]:
    """Relative path and place of each file of a tree, in order; links within it are followed."""
    for folder, below, names in os.walk(root / part, followlinks=True):
        below.sort()
        for name in sorted(names):
            path = Path(folder, name)
            yield path.relative_to(root).as_posix(), path.resolve()


def _counted(label: Path) -> dict[str, int]:
    ids = read_label(label)
    if ids.dtype != np.uint8:
        raise DataError(f"{printable(label, 200)} has 16 bits; train ids have 8")
    return class_pixels(ids.astype(np.uint8))


def _known_stats(root: Path) -> dict[str, dict[str, int]]:
    """Class pixels by base name of a label, as the trainers' converter left them."""
    path = root / layout.CLASS_STATS
    if not path.exists():
        return {}
    rows = _files.read_json(path, MAX_STATS_BYTES)
    try:
        if not isinstance(rows, list):
            raise TypeError
        known = {Path(row["file"]).name: _checked_pixels(row) for row in rows}
    except (KeyError, TypeError, ValueError, AttributeError):
        raise DataError(
            f"{printable(path, 200)} is not a list of pixels by train id and a file; remove it, "
            "then labels are counted"
        ) from None
    return known


def _checked_pixels(row: Mapping[str, Any]) -> dict[str, int]:
    pixels = {str(int(train_id)): n for train_id, n in row.items() if train_id != "file"}
    if not all(int(train_id) in range(len(CLASSES)) for train_id in pixels):
        raise ValueError
    if not all(type(n) is int and 0 <= n < 2**32 for n in pixels.values()):
        raise ValueError
    return pixels


def _source_of_export(export: Path) -> _Source:
    """Every file of a finished export, and the class pixels that its manifest tells."""
    shown = printable(export, 200)
    try:
        contents = layout.read_contents(export)
    except OSError as error:
        raise DataError(
            f"{shown} is no finished export ({layout.CONTENTS}: {error.strerror}); run it to its "
            "end, or check the path"
        ) from None
    job = contents["job"]
    for name, wanted in (("layout", "cityscapes"), ("split", SPLIT)):
        if (found := job.get(name)) != wanted:
            raise ArgumentError(
                f"{shown} has the {name} {printable(found)}; a labelled source needs {wanted}"
            )
    if contents["labelled"] != contents["samples"]:
        raise ArgumentError(
            f"{shown} has {contents['samples'] - contents['labelled']} samples without a label; "
            "export scenes that have labels"
        )
    files: dict[str, Path] = {}
    labels: dict[str, Mapping[str, int]] = {}
    folder = LocalFolder(export)
    for line in usable_lines(export, contents):
        entry = json.loads(line)
        for stored in entry["files"].values():
            if not folder.is_whole(stored["path"], stored, digests=False):
                raise _damaged(export, stored["path"])
            files[stored["path"]] = export / stored["path"]
        labels[entry["files"]["label"]["path"]] = entry["class_pixels"]
    if len(labels) != contents["samples"]:
        raise _damaged(export, layout.MANIFEST)
    records = {name: stored for name, stored in contents["files"].items() if RECORD.fullmatch(name)}
    for name, stored in records.items():
        if not folder.is_whole(name, stored, digests=True):
            raise _damaged(export, name)
        files[name] = export / name
    return _Source(files, labels, contents.get("editors"), records)


def _damaged(export: Path, path: str) -> IntegrityError:
    return IntegrityError(
        f"{printable(export, 200)} is damaged: {printable(path, 160)} is not as it was written; "
        "run the same export again with --verify to repair it"
    )


def _united(sources: Sequence[_Source]) -> _Source:
    """All sources as one.

    Raises:
        ConflictError: If two labels have one base name.
    """
    files: dict[str, Path] = {}
    labels: dict[str, Mapping[str, int]] = {}
    places: dict[str, Path] = {}
    editors: list[Any] | None = []
    records: dict[str, Mapping[str, Any]] = {}
    for source in sources:
        for path, pixels in source.labels.items():
            name, place = Path(path).name, source.files[path]
            if name in places:
                raise ConflictError(
                    f"{printable(places[name], 200)} and {printable(place, 200)} have one base "
                    "name, by which trainers tell labels apart; give each export once"
                )
            labels[path], places[name] = pixels, place
        # Records of one name are the same record.
        files = source.files | files
        records |= source.records
        if editors is not None and source.editors is not None:
            editors += [editor for editor in source.editors if editor not in editors]
        else:
            editors = None
    return _Source(files, labels, editors, records, sum(source.counted for source in sources))


def _contents(out: Path, root: Path, exports: Sequence[Path], merged: _Source) -> bytes:
    """`merge.json`: where the sources are, seen from the merge, and what trained their editors."""
    fields = {
        "format": FORMAT,
        "root": os.path.relpath(root, out),
        "exports": [os.path.relpath(export, out) for export in exports],
        "editors": merged.editors,
        "files": merged.records,
    }
    return layout.sealed_contents(fields)


def _entries(out: Path) -> Iterator[tuple[str, Path]]:
    """Relative path and place of every file and link of a merge, its own files left out."""
    for folder, below, names in os.walk(out):
        links = [name for name in below if Path(folder, name).is_symlink()]
        for name in (*names, *links):
            path = Path(folder, name)
            relative = path.relative_to(out).as_posix()
            if relative not in _OWN:
                yield relative, path


def _foreign_file(out: Path, files: Mapping[str, Path]) -> Path | None:
    """A file in `out` that is neither a link nor the same file as one that shall be linked to."""
    for relative, path in _entries(out):
        if not path.is_symlink() and not (relative in files and _is(path, files[relative])):
            return path
    return None


def _is(path: Path, to: Path) -> bool:
    """Whether a file is a hard link to another, or the same record from another export."""
    return path.samefile(to) or (
        RECORD.fullmatch(path.name) is not None and filecmp.cmp(path, to, shallow=False)
    )


def _removed(out: Path, files: Mapping[str, Path]) -> int:
    """Remove links that are no longer part of the merge, and folders that are empty then."""
    stale = [path for relative, path in _entries(out) if relative not in files]
    for path in stale:
        path.unlink()
    for folder, _, _ in os.walk(out, topdown=False):
        if folder != str(out) and not any(Path(folder).iterdir()):
            Path(folder).rmdir()
    return len(stale)


def _linked(link: Path, to: Path, hard: bool) -> bool:
    """Make a link unless it is there; whether it was made."""
    target = os.path.relpath(to, link.parent)
    if hard and not link.is_symlink() and link.exists():
        return False
    if not hard and link.is_symlink() and str(link.readlink()) == target:
        return False
    link.parent.mkdir(parents=True, exist_ok=True)
    link.unlink(missing_ok=True)
    if not hard:
        link.symlink_to(target)
        return True
    try:
        link.hardlink_to(to)
    except OSError as error:
        if error.errno != errno.EXDEV:
            raise
        raise OutputError(
            f"{printable(to, 200)} is on another disk than the merge, so it cannot be linked to by "
            "a hard link; make symbolic links instead"
        ) from None
    return True


def _written_stats(out: Path, labels: Mapping[str, Mapping[str, int]]) -> ClassStats:
    paths = list(labels)
    stats = ClassStats(len(paths))
    for index, pixels in enumerate(labels.values()):
        stats.add(index, pixels)
    stats.write(out, lambda: paths)
    return stats
