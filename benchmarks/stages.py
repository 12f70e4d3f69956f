"""Where the time of a render goes, stage by stage."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import wraps
from statistics import median
from typing import Any
from unittest.mock import patch

import cv2

from benchmarks.overlays import SIZES, renders, whole_renders
from benchmarks.scene import street
from weather_aug.particles.field import ParticleField
from weather_aug.render import background, compose, fields, stage, taken
from weather_aug.render.background import looked_at

Stages = Mapping[str, tuple[Any, str]]
STAGES: Stages = {
    "air": (compose, "air_of"),
    "look at the frame": (compose, "looked_at"),
    "edit": (background, "edited"),
    "read": (background, "surface_of"),
    "resolve": (ParticleField, "resolve"),
    "enumerate": (ParticleField, "particles"),
    "shelter": (fields, "exposed"),
    "sort": (fields, "sorted_in_blocks"),
    "project": (fields, "project"),
    "split": (stage, "split_by_band"),
    "shade": (stage, "shade"),
    "merge": (cv2, "merge"),
    "vehicles": (compose, "traffic_of"),
    "shrunken picture": (taken, "_whole"),
    "glass": (taken, "through_glass"),
    "sensor": (taken, "exposed"),
    "labels": (compose, "readable_labels"),
}
"""Functions whose time is taken where `render` looks them up; the first are called first."""
REST = "rest (Python, allocation, copies)"
ROUNDS = 15


class StageClock:
    """Processor time inside named functions, without that of other named ones they call."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._inner_s: list[float] = []

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """`function`, whose time is added up under `name`."""

        @wraps(function)
        def run(*args: Any, **kwargs: Any) -> Any:
            self._inner_s.append(0.0)
            start = time.thread_time()
            result = function(*args, **kwargs)
            whole_s = time.thread_time() - start
            self.seconds[name] += whole_s - self._inner_s.pop()
            if self._inner_s:
                self._inner_s[-1] += whole_s
            return result

        return run

    @contextmanager
    def watching(self, stages: Stages = STAGES) -> Iterator[None]:
        """Time the stages while the block runs."""
        with ExitStack() as stack:
            for name, (owner, attribute) in stages.items():
                original = getattr(owner, attribute)
                stack.enter_context(patch.object(owner, attribute, self.timed(name, original)))
            yield


def stage_ms(
    run: Callable[[], object], rounds: int = ROUNDS, stages: Stages = STAGES
) -> dict[str, float]:
    """Median milliseconds of each stage of a call, such as of `render`, and of all else."""
    run()
    spent: dict[str, list[float]] = {name: [] for name in (*stages, REST)}
    for _ in range(rounds):
        clock = StageClock()
        with clock.watching(stages):
            clock.timed(REST, run)()
        for name, values in spent.items():
            values.append(1e3 * clock.seconds[name])
    return {name: median(values) for name, values in spent.items()}


def measure() -> list[dict[str, Any]]:
    """Print the stages of each case of the air at both sizes, and those of whole renders."""
    results = []
    for height, width in SIZES:
        frame, ambience = street(height, width)
        layers = looked_at(frame, ambience)
        for kind, calls in (
            ("the air alone", renders(frame, ambience, layers)),
            ("whole renders", whole_renders(frame, ambience, None)),
        ):
            table = {name: stage_ms(run) for name, run in calls.items()}
            show_table(f"{height} x {width}, {kind}: where the time goes, ms", table)
            results.append({"size": [height, width], "kind": kind, "ms": table})
    return results


def show_table(title: str, table: Mapping[str, Mapping[str, float]]) -> None:
    """Print milliseconds by column and row, and their sums; rows that cost nothing are left out."""
    print(f"\n{title}")
    print(" " * 36 + "".join(f"{name:>20s}" for name in table))
    for row in next(iter(table.values())):
        if any(column[row] >= 0.005 for column in table.values()):
            print(f"  {row:34s}" + "".join(f"{column[row]:20.2f}" for column in table.values()))
    whole = "".join(f"{sum(column.values()):20.2f}" for column in table.values())
    print(f"  {'sum':34s}{whole}", flush=True)


if __name__ == "__main__":
    measure()
