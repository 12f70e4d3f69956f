"""The journal: an append-only list of committed samples, trusted no further than its digests.

Line 1 is the job; every other line is a sample's line of the manifest, in the order of completion.
Each starts with the head of its own SHA-256, so that a line cut or changed by a crash is noticed.
Only the exporting process writes it; a sample is committed by its line and by nothing else.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from weather_aug import _files
from weather_aug.errors import DataError, IntegrityError, printable
from weather_aug.writers import layout
from weather_aug.writers.plan import ExportPlan
from weather_aug.writers.shards import WHOLE, Shard
from weather_aug.writers.target import Target

SYNC_EVERY = 64
"""Lines between two syncs to disk: what a power cut can cost; a killed process loses none."""

_SEAL_LENGTH = 16
_ITEM = re.compile(rb'[0-9a-f]{16} \{"item": (\d+),')


def sealed(text: str) -> bytes:
    """A line of the journal."""
    return f"{_files.sha256_of(text.encode())[:_SEAL_LENGTH]} {text}\n".encode()


def unsealed(line: bytes) -> str | None:
    """The text of a journal's line, or None if the line is not as it was written."""
    seal, _, text = line.rstrip(b"\n").partition(b" ")
    whole = line.endswith(b"\n") and seal.decode("ascii", "replace") == _files.sha256_of(text)[:16]
    return text.decode() if whole else None


def job_of(path: Path) -> Any:
    """The job that a journal belongs to.

    Raises:
        IntegrityError: If its first line is damaged.
    """
    with _files.reported(path), path.open("rb") as file:
        head = unsealed(file.readline())
    if head is None:
        raise IntegrityError(
            f"{printable(path, 200)} is damaged, so the job it belongs to is unknown; remove its "
            "export and start again"
        )
    return json.loads(head)


def write_journal(path: Path, job: dict[str, Any], lines: Iterable[str] = ()) -> None:
    """Write a journal of `job` that holds `lines` so far."""
    with _files.whole_file(path) as file:
        file.write(sealed(json.dumps(job, allow_nan=False)))
        for line in lines:
            file.write(sealed(line))


def committed_items(path: Path) -> Iterator[int]:
    """Items of a journal's lines, as far as they are complete; nothing else of them is read."""
    with path.open("rb") as file:
        file.readline()
        for line in file:
            item = _ITEM.match(line)
            if item is not None and line.endswith(b"\n"):
                yield int(item[1])


class WholeFiles:
    """Whether samples' files are there with their sizes and (`digests`) their bytes.

    Samples that follow each other in a tar ask for the same file: it is read once.
    """

    def __init__(self, target: Target, *, digests: bool) -> None:
        self._target, self._digests = target, digests
        self._last: tuple[dict[str, Any], bool] = ({}, False)

    def __call__(self, files: dict[str, Any]) -> bool:
        """Whether all files of a sample are whole."""
        return all(self._is_whole(file) for file in files.values())

    def _is_whole(self, file: dict[str, Any]) -> bool:
        if file != self._last[0]:
            whole = self._target.is_whole(file["path"], file, digests=self._digests)
            self._last = (file, whole)
        return self._last[1]


class Journal:
    """An open journal: append committed samples, read them back by item.

    It keeps one offset an item in memory, not the lines.
    """

    def __init__(
        self,
        plan: ExportPlan,
        target: Target,
        shard: Shard = WHOLE,
        others: Iterable[Path] = (),
        *,
        progress: bool = False,
    ) -> None:
        """Open the journal of an output; lines whose files are not whole are dropped from it.

        Args:
            plan: What is exported.
            target: Where to; its state holds the journal.
            shard: The part of the plan that the journal is for.
            others: Further journals of the job, whose lines are taken over; somebody may be writing
                to them.
            progress: Show a bar while files are compared.

        Raises:
            OutputError: If it cannot be written.
        """
        self.path = path = target.state / layout.JOURNAL
        self._plan = plan
        self._units = shard.units(plan)
        self._offsets = np.full(plan.count, -1, np.int64)
        self.items = shard.count(plan)
        """How many items there are to commit."""
        self.committed = 0
        """How many items are committed."""
        self._unsynced = 0
        lines = _Kept([path, *others], plan, target, shard, progress)
        write_journal(path, plan.job, lines)
        self.damaged = lines.dropped
        with _files.reported(path), ExitStack() as opened:
            # Unbuffered: a line that was appended survives the death of this process.
            self._file = opened.enter_context(path.open("ab", buffering=0))
            self._reader = opened.enter_context(path.open("rb"))
            self._index_lines()
            self._opened = opened.pop_all()

    def missing(self) -> Iterator[int]:
        """Units with an item that is not committed, in order."""
        for unit in self._units:
            items = self._plan.items_of(unit)
            if (self._offsets[items.start : items.stop] < 0).any():
                yield unit

    def append(self, unit: int, lines: Sequence[str]) -> list[str]:
        """Commit a unit; those of its items that were committed before stay as they are.

        Returns:
            The lines that are newly committed.

        Raises:
            OutputError: If a line cannot be written; its item is then not committed.
        """
        items = zip(self._plan.items_of(unit), lines, strict=True)
        new = [(index, line) for index, line in items if self._offsets[index] < 0]
        with _files.reported(self.path):
            for index, line in new:
                self._append(index, line)
        return [line for _, line in new]

    def _append(self, index: int, line: str) -> None:
        offset = self._file.tell()
        rest = memoryview(sealed(line))
        while rest:
            rest = rest[self._file.write(rest) :]
        self._offsets[index] = offset
        self.committed += 1
        self._unsynced += 1
        if self._unsynced >= SYNC_EVERY:
            self._sync()

    def line(self, index: int) -> str:
        """A committed item's line of the manifest.

        Raises:
            IntegrityError: If the journal was changed meanwhile.
        """
        self._reader.seek(int(self._offsets[index]))
        text = unsealed(self._reader.readline())
        if text is None:
            raise IntegrityError(f"{printable(self.path, 200)} was changed by another program")
        return text

    def __enter__(self) -> Journal:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            with _files.reported(self.path):
                self._sync()
        except OSError:
            # An error on the way out must not hide the one that led here.
            if error is None:
                raise
        finally:
            self._opened.close()

    def _sync(self) -> None:
        os.fsync(self._file.fileno())
        self._unsynced = 0

    def _index_lines(self) -> None:
        offset = len(self._reader.readline())
        for line in self._reader:
            text = unsealed(line)
            assert text is not None
            self._offsets[json.loads(text)["item"]] = offset
            self.committed += 1
            offset += len(line)
        self._file.seek(0, os.SEEK_END)


class _Kept:
    """The lines of interrupted journals whose files are whole, one an item; counts the others."""

    def __init__(
        self, paths: list[Path], plan: ExportPlan, target: Target, shard: Shard, progress: bool
    ) -> None:
        self._paths, self._plan, self._shard, self._progress = paths, plan, shard, progress
        self._whole = WholeFiles(target, digests=True)
        self._kept, self._damaged = np.zeros((2, plan.count), bool)
        self._unreadable = 0

    @property
    def dropped(self) -> int:
        """Lines that cannot be read, and items of which no line names whole files."""
        return self._unreadable + int((self._damaged & ~self._kept).sum())

    def __iter__(self) -> Iterator[str]:
        from tqdm.auto import tqdm

        with tqdm(desc="verify", unit="sample", disable=not self._progress) as bar:
            for path in self._paths:
                with path.open("rb") as file:
                    file.readline()
                    for line in file:
                        bar.update()
                        text = unsealed(line)
                        planned = None if text is None else self._planned(text)
                        if text is None or planned is None:
                            self._unreadable += 1
                        elif self._is_new_and_whole(*planned):
                            yield text

    def _planned(self, text: str) -> tuple[int, dict[str, Any]] | None:
        """Item and files of a line if they are the plan's."""
        try:
            entry = _files.parse_json(text, "journal")
            index, files = int(entry["item"]), entry["files"]
            paths = {part: file["path"] for part, file in files.items()}
            in_plan = 0 <= index < self._plan.count and paths == self._plan.files(index)
        except (DataError, KeyError, TypeError, ValueError, AttributeError):
            return None
        return (index, files) if in_plan else None

    def _is_new_and_whole(self, index: int, files: dict[str, Any]) -> bool:
        if self._kept[index] or not self._shard.has(self._plan, index):
            return False
        whole = self._whole(files)
        (self._kept if whole else self._damaged)[index] = True
        return whole
