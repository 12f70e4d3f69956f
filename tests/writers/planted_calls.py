"""Faults planted at the n-th call that touches an output: open, write, fsync, rename and others."""

from __future__ import annotations

import io
import json
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from tiny_export import tree_of

from weather_aug import _files
from weather_aug.writers.export import export
from weather_aug.writers.plan import ExportPlan
from weather_aug.writers.verify import verify_export

FAULTY = [(os, "fsync"), (os, "open"), (os, "ftruncate"), (os, "pwrite"), (Path, "replace")]
FAULTY += [(Path, "mkdir"), (Path, "unlink")]

Fault = Callable[[], Any]


class Calls:
    """The calls that touched an output so far; the one numbered `at` fails by `fault`."""

    def __init__(self, at: int, fault: Fault) -> None:
        self.by_name: Counter[str] = Counter()
        self._at, self._fault = at, fault

    @property
    def total(self) -> int:
        return self.by_name.total()

    def fails(self, name: str) -> bool:
        """Count a call; whether it is the one that fails."""
        self.by_name[name] += 1
        return self.total == self._at

    def fail(self) -> None:
        self._fault()


def refusing(code: int) -> Fault:
    """The system's refusal with an error number."""

    def refuse() -> None:
        raise OSError(code, os.strerror(code))

    return refuse


def killing() -> None:
    """Gone without a trace."""
    os._exit(9)


@contextmanager
def failing_at(call: int, out: Path, fault: Fault) -> Iterator[Calls]:
    """Call `fault` before the `call`-th call that touches `out`; a write is done by half then."""
    calls = Calls(call, fault)

    class Raw(io.FileIO):
        """A file of which each write(2) is seen."""

        def write(self, data: Any) -> int:
            if calls.fails("write"):
                super().write(memoryview(data)[: len(data) // 2])
                calls.fail()
            return super().write(data)

    def opening(real: Callable[..., Any]) -> Callable[..., Any]:
        def wrapper(path: Path, mode: str = "r", buffering: int = -1, **rest: Any) -> Any:
            if not path.is_relative_to(out):
                return real(path, mode, buffering, **rest)
            if calls.fails("Path.open"):
                calls.fail()
            if set(mode) <= {"r", "b", "t"}:
                return real(path, mode, buffering, **rest)
            assert "b" in mode, "text would be written past the eyes of this test"
            raw = Raw(path, mode.replace("b", ""))
            return raw if buffering == 0 else io.BufferedWriter(raw)

        return wrapper

    def counted(name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def wrapper(*args: Any, **kwargs: Any) -> Any:
            touches = isinstance(args[0], int) or Path(args[0]).is_relative_to(out)
            if touches and calls.fails(name):
                calls.fail()
            return real(*args, **kwargs)

        return wrapper

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Path, "open", opening(Path.open))
        for owner, name in FAULTY:
            patch.setattr(owner, name, counted(name, getattr(owner, name)))
        yield calls


def status_of_fork(work: Callable[[], int]) -> int:
    """What `work` returns in a child of this process, or how that ended."""
    child = os.fork()
    if child == 0:
        status = 99
        try:
            status = work()
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def kill_at(plan: ExportPlan, out: Path, call: int) -> int:
    """Export in a child that is gone at the `call`-th call; 0 if it got through."""

    def work() -> int:
        with failing_at(call, out, killing):
            export(plan, out)
        return 0

    return status_of_fork(work)


def kill_at_each_call(
    plan: ExportPlan, tree: Mapping[str, str], folder: Path, *, every: int, damaged: str | None
) -> int:
    """Kill exports to new folders at each `every`-th call, and continue each; how many kills.

    Args:
        plan: What to export.
        tree: What must come out.
        folder: Of the outputs.
        every: Steps between the calls.
        damaged: File that is missing from a finished export, whose repair is killed; if None,
            exports from nothing are.
    """
    call, kills = 1, 0
    while True:
        out = folder / str(call)
        if damaged is not None:
            export(plan, out)
            (out / damaged).unlink()
        status = kill_at(plan, out, call)
        assert status in (0, 9)
        if damaged is None:
            assert_committed_verifies(out)
            assert_nothing_partial(out, tree)
        export(plan, out)
        assert tree_of(out) == tree
        if status == 0:
            return kills
        call, kills = call + every, kills + 1


def committed_entries(out: Path) -> list[dict[str, Any]]:
    """Entries of the journal, without a last line that a full disk cut."""
    journal = out / ".export" / "journal"
    lines = journal.read_text().splitlines(keepends=True)[1:] if journal.exists() else []
    if lines and not lines[-1].endswith("\n"):
        lines.pop()
    return [json.loads(line.partition(" ")[2]) for line in lines]


def assert_committed_verifies(out: Path) -> None:
    """What the journal or the finished manifest lists is there, whole."""
    if (out / "export.json").exists():
        # Only the state folder may be left over beside a finished export.
        assert [p for p in verify_export(out) if ".export/" not in p] == []
        return
    for entry in committed_entries(out):
        for file in entry["files"].values():
            assert _files.sha256_of_file(out / file["path"]) == file["sha256"]


def assert_nothing_partial(out: Path, tree: Mapping[str, str]) -> None:
    """What stands under the name of a file of the finished export is that file."""
    found = tree_of(out)
    for name in found:
        if not name.startswith(".export/") and not name.endswith(_files.TEMPORARY_SUFFIX):
            assert found[name] == tree[name], f"{name} is partial, or no part of the export"
