"""Rounds over the frames of a clip, or over other steps, that go on where they were cut short."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from weather_aug import _files

Record = dict[str, Any]
"""Of a step that is done: `entry` is what the manifest says of it, `files` the size and digest of
each of its files by relative path."""


@dataclass(frozen=True)
class Round:
    """One thing that is made of every frame, or by other named steps, in the order of `keys`."""

    title: str
    """Beside the bar."""
    journal: str
    """Name of the file that lists what is done."""
    head: dict[str, Any]
    """What all of it depends on; work of another head is thrown away. JSON values."""
    keys: Sequence[Any]
    """Of the frames, or names of the steps; their texts differ."""
    make: Callable[[Any], tuple[dict[str, Any], dict[str, bytes]]]
    """The manifest's entry for a step, and bytes by relative path: always the same."""
    clean: Callable[[Path], None]
    """Make the work folder as it is before the round."""
    tries_first: bool = True
    """Make the first finished step once more, to see what the head cannot tell. Not for steps of
    many minutes whose head tells it all."""


def make_all(task: Round, work: Path, progress: bool) -> dict[str, Record]:
    """Make what is not made yet; all records by key.

    Raises:
        OutputError: If the work folder cannot be written.
    """
    from tqdm.auto import tqdm

    done = _finished(task, work)
    with _files.reported(work), (work / task.journal).open("a", encoding="utf-8") as journal:
        for key in tqdm(task.keys, desc=task.title, unit="frame", disable=not progress):
            if str(key) in done:
                continue
            record, parts = _made(task, key)
            for relative, data in parts.items():
                _files.write_whole(work / relative, data)
            done[str(key)] = record
            journal.write(json.dumps({"key": str(key), **record}) + "\n")
            journal.flush()
    return done


def digest_record(data: bytes) -> dict[str, Any]:
    """Size and digest of a file, as the manifest lists them."""
    return {"size": len(data), "sha256": _files.sha256_of(data)}


def _made(task: Round, key: Any) -> tuple[Record, dict[str, bytes]]:
    entry, parts = task.make(key)
    files = {relative: digest_record(data) for relative, data in parts.items()}
    return {"entry": entry, "files": files}, parts


def _finished(task: Round, work: Path) -> dict[str, Record]:
    """What interrupted work of this round has finished; else a clean work folder."""
    done = _read(task, work)
    # The head may not tell all that the steps depend on; a step made again can.
    first = next((key for key in task.keys if str(key) in done), None)
    if first is not None and task.tries_first:
        record, _ = _made(task, first)
        done = done if json.dumps(record) == json.dumps(done[str(first)]) else {}
    if not done:
        with _files.reported(work):
            task.clean(work)
    lines = [task.head, *({"key": key, **record} for key, record in done.items())]
    _files.write_whole(work / task.journal, "".join(json.dumps(x) + "\n" for x in lines).encode())
    return done


def _read(task: Round, work: Path) -> dict[str, Record]:
    """Records of an interrupted round of this head, by key, whose files are whole."""
    path = work / task.journal
    if not path.is_file():
        return {}
    records = _readable_prefix(path.read_text(encoding="utf-8", errors="replace").splitlines())
    if not records or records[0] != task.head:
        return {}
    return {
        record["key"]: {"entry": record["entry"], "files": record["files"]}
        for record in records[1:]
        if all(_is_whole(work / path, file) for path, file in record["files"].items())
    }


def _is_whole(path: Path, file: dict[str, Any]) -> bool:
    return path.is_file() and _files.sha256_of_file(path) == file["sha256"]


def _readable_prefix(lines: list[str]) -> list[dict[str, Any]]:
    """The journal's lines before the one that a crash cut."""
    records = []
    for line in lines:
        try:
            records.append(json.loads(line))
        except ValueError:
            break
    return records
