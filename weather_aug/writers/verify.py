"""Is an export on disk whole? Needs the export alone: neither its scenes nor a renderer."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from weather_aug import _files
from weather_aug.errors import DataError, IntegrityError, printable
from weather_aug.writers import layout


def verify_export(out: Path) -> list[str]:
    """Compare every file of an export with what was recorded of it.

    Args:
        out: Folder that `export` wrote.

    Returns:
        One sentence for each problem: missing, changed and extra files, an unfinished job, a
        manifest that is not of this export. Empty if the export is whole.
    """
    out = Path(out)
    if not (out / layout.CONTENTS).exists():
        return [_unfinished(out)]
    try:
        contents = layout.read_contents(out)
    except (DataError, IntegrityError) as error:
        return [str(error)]
    except OSError as error:
        return [f"{printable(out / layout.CONTENTS, 200)} cannot be read: {error.strerror}"]
    problems: list[str] = []
    try:
        expected = {layout.CONTENTS}
        for name, stored in contents["files"].items():
            problems += _problems_of_file(out, name, stored)
            expected.add(name)
        problems += _problems_of_samples(out, contents, expected)
        problems += _extra_files(out, expected)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        problems.append(f"{printable(out, 200)} is malformed: {type(error).__name__} {error}")
    return problems


def _unfinished(out: Path) -> str:
    if (out / layout.JOURNAL).exists():
        return f"{printable(out, 200)} is not finished; run the same export again to continue it"
    return f"{printable(out, 200)} is not an export (no {layout.CONTENTS})"


def _problems_of_samples(out: Path, contents: dict[str, Any], expected: set[str]) -> list[str]:
    """Check every line of the manifest and the files that it names, which join `expected`."""
    problems: list[str] = []
    items_per_unit = max(1, int(contents["job"].get("items_per_unit", 1)))
    tar: dict[str, Any] | None = None
    lines = labels = 0
    for lines, line in enumerate(_lines(out), 1):
        try:
            entry = _files.parse_json(line, f"{layout.MANIFEST}, line {lines}")
            if entry["item"] != lines - 1:
                problems.append(f"line {lines} of {layout.MANIFEST} is item {entry['item']}")
            if (lines - 1) % items_per_unit == 0:
                tar = None
            for stored in entry["files"].values():
                if stored == tar:
                    # The samples of a unit share one file, which is read once.
                    continue
                if stored["path"] in expected:
                    problems.append(f"{printable(stored['path'], 200)} is listed twice")
                expected.add(stored["path"])
                problems += _problems_of_file(out, stored["path"], stored)
            tar = entry["files"].get("tar")
            labels += "label" in layout.parts_of(entry)
        except DataError as error:
            problems.append(str(error))
        except (KeyError, TypeError, AttributeError):
            problems.append(f"line {lines} of {layout.MANIFEST} is malformed")
    for name, count in (("samples", lines), ("labelled", labels)):
        if contents[name] != count:
            problems.append(f"{layout.MANIFEST} lists {count} {name}, {contents[name]} were made")
    return problems


def _lines(out: Path) -> Iterator[str]:
    try:
        with (out / layout.MANIFEST).open(encoding="utf-8", errors="replace") as file:
            yield from file
    except OSError:
        # That the manifest itself is missing has been said by its digest.
        return


def _problems_of_file(out: Path, relative: str, stored: dict[str, Any]) -> list[str]:
    try:
        path = _files.file_inside(out, relative)
        size = path.stat().st_size
        if size != stored["size"]:
            return [f"{printable(relative, 200)} has {size} bytes, {stored['size']} were written"]
        if _files.sha256_of_file(path) != stored["sha256"]:
            return [f"{printable(relative, 200)} has changed since it was written"]
    except DataError as error:
        return [str(error)]
    except OSError as error:
        return [f"{printable(relative, 200)} cannot be read: {error.strerror}"]
    return []


def _extra_files(out: Path, expected: set[str]) -> list[str]:
    """Files that nothing lists; they are reported, never removed."""
    problems = []
    for folder, _, names in os.walk(out):
        for name in sorted(names):
            relative = (Path(folder) / name).relative_to(out).as_posix()
            if relative not in expected:
                problems.append(f"{printable(relative, 200)} is not part of the export")
    return problems
