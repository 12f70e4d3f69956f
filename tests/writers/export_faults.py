"""Worker processes that fail on purpose; importable from a worker, which a test is not."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import Any

from weather_aug.errors import OutputError
from weather_aug.writers import worker

DEADLY_ITEM = 4
write_sample = worker.write_sample


def die_on_one_item(plan: Any, out: Path, pipe: Any) -> None:
    """Be killed at DEADLY_ITEM, each time."""

    def deadly(plan: Any, out: Path, index: int) -> str:
        if index == DEADLY_ITEM:
            os.kill(os.getpid(), signal.SIGKILL)
        return write_sample(plan, out, index)

    worker.write_sample = deadly
    worker.work(plan, out, pipe)


def die_after_writing_once(plan: Any, out: Path, pipe: Any) -> None:
    """Write the files of DEADLY_ITEM and be killed before saying so, the first time."""

    def deadly(plan: Any, out: Path, index: int) -> str:
        line = write_sample(plan, out, index)
        mark = out.parent / "died"
        if index == DEADLY_ITEM and not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGSEGV)
        return line

    worker.write_sample = deadly
    worker.work(plan, out, pipe)


def find_the_disk_full(plan: Any, out: Path, pipe: Any) -> None:
    """Fail to write DEADLY_ITEM."""

    def full(plan: Any, out: Path, index: int) -> str:
        if index == DEADLY_ITEM:
            raise OutputError(f"cannot write {out}: No space left on device")
        return write_sample(plan, out, index)

    worker.write_sample = full
    worker.work(plan, out, pipe)


def run_out_of_memory(plan: Any, out: Path, pipe: Any) -> None:
    """Raise MemoryError at DEADLY_ITEM, each time."""

    def large(plan: Any, out: Path, index: int) -> str:
        if index == DEADLY_ITEM:
            raise MemoryError
        return write_sample(plan, out, index)

    worker.write_sample = large
    worker.work(plan, out, pipe)


def sleep_on_one_item(plan: Any, out: Path, pipe: Any) -> None:
    """Be busy with DEADLY_ITEM for longer than any test."""

    def slow(plan: Any, out: Path, index: int) -> str:
        if index == DEADLY_ITEM:
            time.sleep(60)
        return write_sample(plan, out, index)

    worker.write_sample = slow
    worker.work(plan, out, pipe)


def end_at_once(plan: Any, out: Path, pipe: Any) -> None:
    """Never become ready."""
