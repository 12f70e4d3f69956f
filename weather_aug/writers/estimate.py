"""How large an export will be and how long it will take, from a few samples rendered to memory."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path

from weather_aug.errors import DataError, IntegrityError
from weather_aug.render.compose import warm_up
from weather_aug.writers import layout
from weather_aug.writers.plan import ExportPlan
from weather_aug.writers.sample import rendered
from weather_aug.writers.spread import spread_items

MOST_SAMPLES = 8
BUDGET_S = 2.0
"""No further sample is begun when the first ones have taken as long."""


@dataclass(frozen=True)
class Estimate:
    """What an export will cost, by the mean of its measured samples."""

    samples: int
    """In the plan."""
    measured: int
    bytes_per_sample: float
    """Encoded; without manifest, class statistics and what a file system rounds up to."""
    seconds_per_sample: float
    """Of one process: rendering and encoding, without writing to disk."""

    @property
    def bytes(self) -> int:
        """Of all samples."""
        return round(self.samples * self.bytes_per_sample)

    def seconds(self, workers: int = 1, samples: int | None = None) -> float:
        """Time of so many samples, all if None, on as many processes as there are cores for."""
        processes = max(1, min(workers, len(os.sched_getaffinity(0))))
        return (self.samples if samples is None else samples) * self.seconds_per_sample / processes


def estimate(plan: ExportPlan, *, most: int = MOST_SAMPLES, budget_s: float = BUDGET_S) -> Estimate:
    """Render and encode a few samples of a plan as an export does, write nothing, and measure.

    They are spread over the plan by its digest. Before the first all kernels are compiled or loaded
    and it is rendered once more, which opens files; neither is counted.

    Args:
        plan: What would be exported.
        most: Samples to measure at most, 1 or more; no more than the plan has.
        budget_s: No further sample is begun after as many seconds.

    Raises:
        SceneError: If a scene cannot be read.
    """
    items = spread_items("export-estimate", plan.digest, plan.count, most)
    warm_up()
    rendered(plan, items[0])
    size = measured = 0
    start_s = time.perf_counter()
    for item in items:
        _, parts = rendered(plan, item)
        size += sum(len(data) for data in parts.values())
        measured += 1
        if time.perf_counter() - start_s >= budget_s:
            break
    seconds = time.perf_counter() - start_s
    return Estimate(plan.count, measured, size / measured, seconds / measured)


def committed(out: Path) -> int:
    """How many samples an export holds so far, as its journal or its `export.json` says.

    Files are not looked at: some may turn out damaged. What cannot be read counts as nothing;
    `export` says why.
    """
    contents, journal = out / layout.CONTENTS, out / layout.JOURNAL
    try:
        if contents.exists():
            return int(layout.read_contents(out)["samples"])
        if not journal.exists():
            return 0
        with journal.open("rb") as file:
            return max(0, sum(line.endswith(b"\n") for line in file) - 1)
    except (DataError, IntegrityError, OSError, KeyError):
        return 0
