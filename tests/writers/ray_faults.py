"""Actors that fail on purpose; importable from an actor, which a test is not."""

from __future__ import annotations

import os
import signal
import time

from export_faults import DEADLY_UNIT, half_write_once

from weather_aug.errors import OutputError
from weather_aug.writers.ray_engine import Answer, Renderer
from weather_aug.writers.worker import FAILED


class DiesOnce(Renderer):
    """Writes DEADLY_UNIT and is killed before saying so, the first time."""

    def write(self, unit: int) -> Answer:
        answer = super().write(unit)
        mark = self._target.state.parent / "died"
        if unit == DEADLY_UNIT and not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return answer


class DiesWhileWriting(Renderer):
    """Is killed while a file is half written, the first time."""

    def write(self, unit: int) -> Answer:
        half_write_once(self._target.state.parent / "died")
        return super().write(unit)


class DiesAlways(Renderer):
    """Is killed at DEADLY_UNIT, each time."""

    def write(self, unit: int) -> Answer:
        if unit == DEADLY_UNIT:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().write(unit)


class FindsTheDiskFull(Renderer):
    """Fails to write DEADLY_UNIT."""

    def write(self, unit: int) -> Answer:
        if unit == DEADLY_UNIT:
            full = OutputError(f"cannot write {self._target.state}: No space left on device")
            return FAILED, (full, "")
        return super().write(unit)


class NeverStarts(Renderer):
    """Ends while it starts."""

    def begin(self) -> Answer:
        os._exit(1)


class HasAnotherPackage(Renderer):
    """Stands on a node with another version of this package."""

    def begin(self) -> Answer:
        import weather_aug

        weather_aug.__version__ = "0.0.0"
        return super().begin()


class SeesAnotherDisk(Renderer):
    """Stands on a node that has another folder under the output's path."""

    def begin(self) -> Answer:
        self._token = "another"
        return super().begin()


class Slow(Renderer):
    """Takes its time for each unit, so that somebody can die meanwhile."""

    def write(self, unit: int) -> Answer:
        time.sleep(0.5)
        return super().write(unit)


class Steady(Renderer):
    """Takes as long as a larger picture would, so that a run outlives who kills its members."""

    def write(self, unit: int) -> Answer:
        time.sleep(0.02)
        return super().write(unit)
