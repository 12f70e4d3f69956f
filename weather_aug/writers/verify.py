"""Is an export whole? Needs the export alone: neither its scenes nor a renderer."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from weather_aug import _files
from weather_aug.errors import DataError, IntegrityError, OutputError, printable
from weather_aug.writers import layout
from weather_aug.writers.source import (
    Readable,
    Source,
    contents_of,
    exists,
    lines_of,
    sha256_of,
    source_of,
)


def verify_export(out: Readable) -> list[str]:
    """Compare every file of an export with what was recorded of it.

    Args:
        out: Folder or url that `export` wrote to.

    Returns:
        One sentence for each problem: missing, changed and extra files, an unfinished job, a
        manifest that is not of this export. Empty if the export is whole.

    Raises:
        OutputError: If a url does not answer: that is no damage.
    """
    source = source_of(out)
    if not exists(source, layout.CONTENTS):
        return [_unfinished(source)]
    try:
        contents = contents_of(source)
    except (DataError, IntegrityError) as error:
        return [str(error)]
    problems: list[str] = []
    try:
        expected = {layout.CONTENTS}
        for name, stored in contents["files"].items():
            problems += _problems_of_file(source, name, stored)
            expected.add(name)
        problems += _problems_of_samples(source, contents, expected)
        problems += _extra_files(source, expected)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        problems.append(f"{source} is malformed: {type(error).__name__} {error}")
    return problems


def _unfinished(source: Source) -> str:
    if any(exists(source, name) for name in (layout.JOURNAL, layout.MARK)):
        return f"{source} is not finished; run the same export again to continue it"
    return f"{source} is not an export (no {layout.CONTENTS})"


def _problems_of_samples(source: Source, contents: dict[str, Any], expected: set[str]) -> list[str]:
    """Check every line of the manifest and the files that it names, which join `expected`."""
    problems: list[str] = []
    items_per_unit = max(1, int(contents["job"].get("items_per_unit", 1)))
    tar: dict[str, Any] | None = None
    lines = labels = 0
    for lines, line in enumerate(_lines(source), 1):
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
                problems += _problems_of_file(source, stored["path"], stored)
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


def _lines(source: Source) -> Iterator[str]:
    try:
        yield from lines_of(source, layout.MANIFEST)
    except OutputError:
        raise
    except (DataError, OSError):
        # That the manifest itself is missing has been said by its digest.
        return


def _problems_of_file(source: Source, relative: str, stored: dict[str, Any]) -> list[str]:
    try:
        size = source.size(relative)
        if size != stored["size"]:
            return [f"{printable(relative, 200)} has {size} bytes, {stored['size']} were written"]
        if sha256_of(source, relative) != stored["sha256"]:
            return [f"{printable(relative, 200)} has changed since it was written"]
    except OutputError:
        raise
    except DataError as error:
        return [str(error)]
    except OSError as error:
        return [f"{printable(relative, 200)} cannot be read: {error.strerror}"]
    return []


def _extra_files(source: Source, expected: set[str]) -> list[str]:
    """Files that nothing lists; they are reported, never removed."""
    return [
        f"{printable(relative, 200)} is not part of the export"
        for relative in source.files()
        if relative not in expected
    ]
