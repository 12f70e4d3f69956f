"""Where the time of a render goes, stage by stage."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import wraps
from statistics import median
from typing import Any
from unittest.mock import patch

import cv2

from benchmarks.overlays import CASES, SIZES, renders
from benchmarks.scene import street
from weather_aug.particles.field import ParticleField
from weather_aug.render import compose, fields, stage

STAGES: dict[str, tuple[Any, str]] = {
    "read": (compose, "surface_of"),
    "air": (compose, "air_of"),
    "look at the frame": (compose, "looked_at"),
    "background": (compose, "background_of"),
    "resolve": (ParticleField, "resolve"),
    "enumerate": (ParticleField, "particles"),
    "shelter": (fields, "exposed"),
    "sort": (fields, "sorted_in_blocks"),
    "project": (fields, "project"),
    "split": (stage, "split_by_band"),
    "shade": (stage, "shade"),
    "merge": (cv2, "merge"),
    "glass and sensor": (compose, "taken"),
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
    def watching(self) -> Iterator[None]:
        """Time the stages while the block runs."""
        with ExitStack() as stack:
            for name, (owner, attribute) in STAGES.items():
                original = getattr(owner, attribute)
                stack.enter_context(patch.object(owner, attribute, self.timed(name, original)))
            yield


def stage_ms(run: Callable[[], object], rounds: int = ROUNDS) -> dict[str, float]:
    """Median milliseconds of each stage of a call of `render`, and of all else."""
    run()
    spent: dict[str, list[float]] = {name: [] for name in (*STAGES, REST)}
    for _ in range(rounds):
        clock = StageClock()
        with clock.watching():
            clock.timed(REST, run)()
        for name, values in spent.items():
            values.append(1e3 * clock.seconds[name])
    return {name: median(values) for name, values in spent.items()}


def measure() -> list[dict[str, Any]]:
    """Print the stages of each case at both sizes."""
    results = []
    for height, width in SIZES:
        table = {name: stage_ms(run) for name, run in renders(*street(height, width)).items()}
        print(f"\n{height} x {width}: where the time goes, ms")
        print(" " * 36 + "".join(f"{name:>18s}" for name in CASES))
        for stage_name in (*STAGES, REST):
            values = "".join(f"{table[case][stage_name]:18.2f}" for case in CASES)
            print(f"  {stage_name:34s}{values}")
        whole = "".join(f"{sum(table[case].values()):18.2f}" for case in CASES)
        print(f"  {'sum':34s}{whole}", flush=True)
        results.append({"size": [height, width], "ms": table})
    return results


if __name__ == "__main__":
    measure()
