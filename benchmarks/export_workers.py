"""Samples per second of an export with one and with two workers, and the memory of a worker.

The plan is of a million samples; a run is stopped when enough of them are done. With one worker the
export renders in its own process, as `weather-aug export` does; with two it starts two. The first
samples do not count: until they are done, workers start and load their kernels.

    python -m benchmarks.export_workers SCENE

prints what was measured as JSON. It is run in a process of its own, because workers import what
their parent's script imports.
"""

from __future__ import annotations

import json
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import cv2

from benchmarks.export_process import resident_mib
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.scene.scene import WeatherScene
from weather_aug.writers.export import export
from weather_aug.writers.plan import ExportPlan, plan_export

PLANNED = 1_000_000
SETTLING, COUNTED = 8, 14
ROUNDS = 2
WORKERS = (1, 2)


class _EnoughError(Exception):
    """Raised to stop an export."""


def times_of(plan: ExportPlan, workers: int, samples: int, look: Callable[[], None]) -> list[float]:
    """Seconds from the start of an export to each of its first samples, in the order of completion.

    Args:
        plan: Of at least as many.
        workers: Processes.
        samples: After so many the export is stopped.
        look: Called after each.
    """
    done: list[float] = []

    def note(_: dict[str, Any]) -> None:
        done.append(time.perf_counter() - start_s)
        look()
        if len(done) == samples:
            raise _EnoughError

    with tempfile.TemporaryDirectory() as folder:
        start_s = time.perf_counter()
        try:
            export(plan, Path(folder) / "out", workers=workers, on_sample=note)
        except _EnoughError:
            pass
    return done


def samples_per_s(times: list[float], settling: int) -> float:
    """Rate after the first `settling` samples."""
    return (len(times) - settling) / (times[-1] - times[settling - 1])


def idle_mib(plan: ExportPlan) -> float:
    """Peak of a worker that imported what workers import, and was given the plan, in MiB."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_idle, args=(plan, theirs))
    process.start()
    peak: float = ours.recv()
    process.join()
    return peak


def _idle(plan: ExportPlan, pipe: Connection) -> None:
    from weather_aug.writers import worker

    assert callable(worker.work)
    pipe.send(resident_mib("VmHWM"))


def measured(
    plan: ExportPlan, *, rounds: int = ROUNDS, settling: int = SETTLING, counted: int = COUNTED
) -> dict[str, Any]:
    """Rates of each round by number of workers, and the greatest peak of any worker in MiB."""
    peaks = [0.0]

    def look() -> None:
        for process in multiprocessing.active_children():
            try:
                peaks.append(resident_mib("VmHWM", process.pid))
            except (OSError, ValueError):
                # It has just left.
                continue

    rates: dict[str, list[float]] = {str(workers): [] for workers in WORKERS}
    first_s: dict[str, list[float]] = {str(workers): [] for workers in WORKERS}
    for _ in range(rounds):
        for workers in WORKERS:
            times = times_of(plan, workers, settling + counted, look)
            rates[str(workers)].append(samples_per_s(times, settling))
            first_s[str(workers)].append(times[0])
    return {
        "planned": plan.count,
        "counted": counted,
        "samples_per_s": rates,
        "first_sample_s": first_s,
        "worker_over_import_mib": max(peaks) - idle_mib(plan),
    }


def main(arguments: list[str]) -> None:
    """Measure a scene's export, and print what was found."""
    cv2.setNumThreads(1)
    scene = WeatherScene(Path(arguments[0]))
    plan = plan_export([scene], WeatherPolicy(), count=PLANNED, seed=0)
    print(json.dumps(measured(plan)))


if __name__ == "__main__":
    main(sys.argv[1:])
