"""Worker processes that fail on purpose; importable from a worker, which a test is not."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import Any

from weather_aug.errors import OutputError
from weather_aug.writers import worker

DEADLY_UNIT = 4
write_unit = worker.write_unit


def die_on_one_item(plan: Any, target: Any, pipe: Any) -> None:
    """Be killed at DEADLY_UNIT, each time."""

    def deadly(plan: Any, target: Any, unit: int) -> list[str]:
        if unit == DEADLY_UNIT:
            os.kill(os.getpid(), signal.SIGKILL)
        return write_unit(plan, target, unit)

    worker.write_unit = deadly
    worker.work(plan, target, pipe)


def die_after_writing_once(plan: Any, target: Any, pipe: Any) -> None:
    """Write the files of DEADLY_UNIT and be killed before saying so, the first time."""

    def deadly(plan: Any, target: Any, unit: int) -> list[str]:
        lines = write_unit(plan, target, unit)
        mark = target.state.parent / "died"
        if unit == DEADLY_UNIT and not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGSEGV)
        return lines

    worker.write_unit = deadly
    worker.work(plan, target, pipe)


def half_write_once(mark: Any) -> None:
    """Let this process be killed in the middle of its next file, unless `mark` stands."""
    sync = os.fsync

    def deadly(descriptor: int) -> None:
        path = str(Path(f"/proc/self/fd/{descriptor}").readlink())
        if path.endswith(".tmp") and not mark.exists():
            os.ftruncate(descriptor, 100)
            mark.write_text(path)
            os.kill(os.getpid(), signal.SIGKILL)
        sync(descriptor)

    os.fsync = deadly  # type: ignore[assignment]


def die_while_writing_once(plan: Any, target: Any, pipe: Any) -> None:
    """Be killed while a file is half written, the first time."""
    half_write_once(target.state.parent / "died")
    worker.work(plan, target, pipe)


def find_the_disk_full(plan: Any, target: Any, pipe: Any) -> None:
    """Fail to write DEADLY_UNIT."""

    def full(plan: Any, target: Any, unit: int) -> list[str]:
        if unit == DEADLY_UNIT:
            raise OutputError(f"cannot write {target.state}: No space left on device")
        return write_unit(plan, target, unit)

    worker.write_unit = full
    worker.work(plan, target, pipe)


def run_out_of_memory(plan: Any, target: Any, pipe: Any) -> None:
    """Raise MemoryError at DEADLY_UNIT, each time."""

    def large(plan: Any, target: Any, unit: int) -> list[str]:
        if unit == DEADLY_UNIT:
            raise MemoryError
        return write_unit(plan, target, unit)

    worker.write_unit = large
    worker.work(plan, target, pipe)


def sleep_on_one_item(plan: Any, target: Any, pipe: Any) -> None:
    """Be busy with DEADLY_UNIT for longer than any test."""

    def slow(plan: Any, target: Any, unit: int) -> list[str]:
        if unit == DEADLY_UNIT:
            time.sleep(60)
        return write_unit(plan, target, unit)

    worker.write_unit = slow
    worker.work(plan, target, pipe)


def end_at_once(plan: Any, target: Any, pipe: Any) -> None:
    """Never become ready."""
