"""Who renders the samples: this process, or worker processes that may die without harm.

An engine gives (unit, manifest lines) in the order of completion; it writes samples, never the
journal. Workers are started afresh (spawn), take one unit at a time, and are told apart by their
pipes, so that one that dies is noticed at once and costs at most the unit it had. Workers on other
machines are those of `ray_engine`.
"""

from __future__ import annotations

import json
import multiprocessing
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from multiprocessing import connection
from typing import Any

from weather_aug import _files
from weather_aug.errors import IntegrityError, WeatherAugError
from weather_aug.render.compose import warm_up
from weather_aug.writers import layout
from weather_aug.writers.plan import ExportPlan
from weather_aug.writers.sample import write_unit
from weather_aug.writers.target import Target
from weather_aug.writers.worker import DONE, FAILED, READY, work

MAX_RETRIES = 2
"""How often a unit whose worker died is given to a fresh one."""
MAX_QUARANTINED = 8
"""Units lost after which it is the machine that is at fault, and the run ends."""
MAX_FAILED_STARTS = 3
LISTEN_S = 2.0
STOP_WAIT_S = 5.0

Finished = tuple[int, list[str]]
"""A unit, and its items' lines of the manifest."""
Engine = Callable[[ExportPlan, Target, Iterator[int]], Generator[Finished, None, None]]
"""Renders units of a plan to a target."""


def run_inline(
    plan: ExportPlan, target: Target, units: Iterator[int]
) -> Generator[Finished, None, None]:
    """Render units one after the other in this process."""
    for unit in units:
        yield unit, write_unit(plan, target, unit)


def run_processes(
    plan: ExportPlan, target: Target, units: Iterator[int], workers: int
) -> Generator[Finished, None, None]:
    """Render units in `workers` processes.

    Raises:
        IntegrityError: After all other units, if one killed three workers; it names its items.
        WeatherAugError: If workers cannot be started, or the first error of a worker.
    """
    warm_up()
    crew = _Crew(plan, target, units)
    try:
        for _ in range(workers):
            crew.start(None)
        while crew.members:
            yield from crew.finished()
    finally:
        crew.stop()
    crew.losses.settle()


class Losses:
    """The units that killed their workers, and those given up for it."""

    def __init__(self, plan: ExportPlan, target: Target) -> None:
        self._plan, self._target = plan, target
        self._deaths: Counter[int] = Counter()
        self._lost: list[int] = []

    def may_try_again(self, unit: int) -> bool:
        """Count a worker's death against the unit it had; whether a fresh one may get it.

        Raises:
            IntegrityError: If so many are lost that it is the machine that is at fault.
        """
        self._deaths[unit] += 1
        if self._deaths[unit] <= MAX_RETRIES:
            return True
        self._lost.append(unit)
        if len(self._lost) >= MAX_QUARANTINED:
            self._raise_if_any()
        return False

    def settle(self) -> None:
        """Remove what dead workers half wrote, and name the items that none of them survived.

        Call it when no worker writes any more.

        Raises:
            IntegrityError: If there are such items.
        """
        if self._deaths:
            self._target.remove_leftovers(self._plan.layout)
        self._raise_if_any()

    def _raise_if_any(self) -> None:
        if not self._lost:
            return
        items = [index for unit in self._lost for index in self._plan.items_of(unit)]
        lines = [json.dumps({"item": k, "recipe": self._plan.recipe(k)}) for k in items]
        path = self._target.state / layout.QUARANTINE
        _files.write_whole(path, ("\n".join(lines) + "\n").encode())
        raise IntegrityError(
            f"{len(lines)} item(s) killed {MAX_RETRIES + 1} workers each and are missing: "
            f"{', '.join(str(index) for index in items)} (recipes in {path}); the first is "
            f"{lines[0]}; free memory or use fewer workers, then run it again to continue"
        )


@dataclass(eq=False)
class _Member:
    """A worker, as its parent sees it."""

    process: Any
    pipe: connection.Connection
    unit: int | None
    """The unit that it has, or gets as soon as it is ready."""
    ready: bool = False


class _Crew:
    """The workers at one output and the units still to be given to them."""

    def __init__(self, plan: ExportPlan, target: Target, units: Iterator[int]) -> None:
        self.members: list[_Member] = []
        self._plan, self._target, self._units = plan, target, units
        self._context = multiprocessing.get_context("spawn")
        self.losses = Losses(plan, target)
        self._failed_starts = 0

    def start(self, unit: int | None) -> None:
        """Start a worker that gets `unit`, or the next one if None; none if nothing is left."""
        unit = next(self._units, None) if unit is None else unit
        if unit is None:
            return
        ours, theirs = self._context.Pipe()
        process = self._context.Process(
            target=work, args=(self._plan, self._target, theirs), daemon=True, name="export worker"
        )
        process.start()
        # The worker's copy must be the only one, or its death would not close the pipe.
        theirs.close()
        self.members.append(_Member(process, ours, unit))

    def finished(self) -> Iterator[Finished]:
        """Wait until a worker says something or dies; give the units that were finished."""
        heard = connection.wait([member.pipe for member in self.members], LISTEN_S)
        for member in self.members.copy():
            if member.pipe not in heard:
                # A process forked by another thread may hold a dead worker's pipe open.
                if not member.process.is_alive() and not member.pipe.poll():
                    self._bury(member)
                continue
            try:
                kind, value = member.pipe.recv()
            except (EOFError, OSError):
                self._bury(member)
                continue
            if kind == FAILED:
                raise with_note(*value)
            done = member.unit
            if kind == READY:
                member.ready, self._failed_starts = True, 0
            else:
                assert kind == DONE
                member.unit = next(self._units, None)
            self._assign(member)
            if kind == DONE and done is not None:
                yield done, value

    def stop(self) -> None:
        """End the workers that are left, whatever they do."""
        for member in self.members:
            member.pipe.close()
            member.process.kill()
        for member in self.members:
            member.process.join(STOP_WAIT_S)
        self.members.clear()

    def _assign(self, member: _Member) -> None:
        """Hand a worker its unit; one without any goes home."""
        try:
            member.pipe.send(member.unit)
        except OSError:
            # It died just now: its pipe says so in the next round, with the unit still its own.
            return
        if member.unit is None:
            self._dismiss(member)

    def _dismiss(self, member: _Member) -> None:
        member.process.join(STOP_WAIT_S)
        member.pipe.close()
        self.members.remove(member)

    def _bury(self, member: _Member) -> None:
        """Replace a worker that died, and count its death against the unit that it had."""
        self._dismiss(member)
        unit = member.unit
        if not member.ready:
            self._failed_starts += 1
            if self._failed_starts >= MAX_FAILED_STARTS:
                raise WeatherAugError(
                    f"export workers end while they start (exit code {member.process.exitcode}); "
                    "a script that exports must stand under `if __name__ == '__main__':`; with "
                    "workers=1 it runs without them"
                )
        elif unit is not None and not self.losses.may_try_again(unit):
            unit = None
        self.start(unit)


def with_note(error: Exception, trace: str) -> Exception:
    """A worker's error; one that is not ours keeps the place where it happened."""
    if not isinstance(error, WeatherAugError):
        error.add_note(f"in an export worker:\n{trace}")
    return error
