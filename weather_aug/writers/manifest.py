"""The files at the root of a finished export; `export.json`, the last of them, makes it one."""

from __future__ import annotations

import json
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

from weather_aug import _files
from weather_aug.errors import DataError
from weather_aug.writers import layout
from weather_aug.writers.cityscapes import ClassStats
from weather_aug.writers.editors import editors_of, write_records
from weather_aug.writers.journal import Journal, WholeFiles
from weather_aug.writers.plan import ExportPlan
from weather_aug.writers.target import Target


def finish(
    plan: ExportPlan, target: Target, journal: Journal, *, progress: bool = False
) -> dict[str, Any]:
    """Write manifest, class statistics and `export.json` from a journal of all items.

    Args:
        plan: What was exported.
        target: Where to.
        journal: Which holds every item.
        progress: Show bars if it takes more than a moment.

    Returns:
        The fields of `export.json`.

    Raises:
        IntegrityError: If a scene's record of what trained its editor has changed.
        OutputError: If a file cannot be written.
    """
    from tqdm.auto import tqdm

    out = target.state
    stats = ClassStats(plan.count)
    counts: Counter[str] = Counter()
    kinds: Counter[str] = Counter()
    items = tqdm(range(plan.count), desc="manifest", unit="sample", delay=1.0, disable=not progress)
    with _label_paths(journal.path.parent) as labels:
        with _files.whole_file(out / layout.MANIFEST) as file:
            for index in items:
                line = journal.line(index)
                file.write(f"{line}\n".encode())
                entry = json.loads(line)
                stats.add(index, entry["class_pixels"])
                kinds[entry["recipe"]["kind"]] += 1
                parts = layout.parts_of(entry)
                labels.append(entry["files"].get("label", {}).get("path"))
                counts["labelled"] += "label" in parts
                counts["bytes"] += sum(part["size"] for part in parts.values())
        names = [layout.MANIFEST]
        if counts["labelled"] and plan.layout.has_class_stats:
            names += stats.write(out, labels, progress=progress)
    contents = {
        "format": layout.FORMAT,
        "version": layout.VERSION,
        "job": plan.job,
        "samples": plan.count,
        **counts,
        "samples_by_kind": dict(sorted(kinds.items())),
        "classes": list(stats.kept),
        "dropped_classes": list(stats.dropped),
        "editors": editors_of(plan.scenes),
        "files": {name: _stored(out / name) for name in names + write_records(plan.scenes, out)},
    }
    _files.write_whole(out / layout.CONTENTS, layout.sealed_contents(contents))
    return contents


class _LabelPaths:
    """Paths of labels by item, in a file: to plan them anew takes minutes, a list 200 MB."""

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def append(self, path: str | None) -> None:
        """The next item's; None where it has no label."""
        self._file.write(f"{path or ''}\n")

    def __call__(self) -> Iterator[str | None]:
        """All of them, in order; one who asks again must have had them all."""
        self._file.seek(0)
        return (line.rstrip("\n") or None for line in self._file)


@contextmanager
def _label_paths(folder: Path) -> Iterator[_LabelPaths]:
    """An empty list of them in a nameless file, which is gone after the block.

    Raises:
        OutputError: If it cannot be written.
    """
    with (
        _files.reported(folder),
        tempfile.TemporaryFile("w+", encoding="utf-8", dir=folder) as file,
    ):
        yield _LabelPaths(file)


def is_finished_whole(
    target: Target, contents: dict[str, Any], *, digests: bool, progress: bool = False
) -> bool:
    """Whether all files of a finished export are there with their sizes and (`digests`) bytes.

    The few files at the root are compared by digest in any case.
    """
    from tqdm.auto import tqdm

    out = target.state
    if not all(_root_is_whole(out, name, file) for name, file in contents["files"].items()):
        return False
    lines = tqdm(
        manifest_lines(out),
        total=contents["samples"],
        desc="verify",
        unit="sample",
        disable=not progress,
    )
    whole = WholeFiles(target, digests=digests)
    return all(whole(json.loads(line)["files"]) for line in lines)


def usable_lines(out: Path, contents: dict[str, Any]) -> Iterator[str]:
    """Lines of a finished export's manifest, none if the manifest itself was changed."""
    if _root_is_whole(out, layout.MANIFEST, contents["files"][layout.MANIFEST]):
        yield from manifest_lines(out)


def manifest_lines(out: Path) -> Iterator[str]:
    """Lines of the manifest, without line ends."""
    with (out / layout.MANIFEST).open(encoding="utf-8") as file:
        for line in file:
            yield line.rstrip("\n")


def _stored(path: Path) -> dict[str, Any]:
    with _files.reported(path):
        return {"size": path.stat().st_size, "sha256": _files.sha256_of_file(path)}


def _root_is_whole(out: Path, name: str, stored: dict[str, Any]) -> bool:
    try:
        path = _files.file_inside(out, name)
        return _files.sha256_of_file(path) == stored["sha256"]
    except (DataError, OSError):
        return False
