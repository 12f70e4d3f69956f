"""How large an export will be and how long it will take, from a few samples rendered to memory."""

from __future__ import annotations

import json
import os
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from weather_aug.errors import DataError, IntegrityError
from weather_aug.render.compose import warm_up
from weather_aug.writers import layout
from weather_aug.writers.journal import committed_items, job_of
from weather_aug.writers.plan import ExportPlan
from weather_aug.writers.sample import rendered
from weather_aug.writers.shards import WHOLE, Shard, shard_journals
from weather_aug.writers.spread import spread_items

MOST_SAMPLES = 32
BUDGET_S = 2.0
"""No further sample is begun when the first ones have taken as long."""
_CANDIDATES = 256
"""Items among which each weather is looked for; of fewer items the weathers are counted."""


@dataclass(frozen=True)
class Estimate:
    """What an export will cost, by its measured samples."""

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

    Samples are spread over the plan by its digest, weathers in turn, and each weather counts by its
    share, of a small plan by how often it comes: a snowfall is several times as large and as slow
    as a clear day. Before the first all kernels are compiled or loaded and it is rendered once
    more, which opens files; neither is counted.

    Args:
        plan: What would be exported.
        most: Samples to measure at most, 1 or more; no more than the plan has.
        budget_s: No further sample is begun after as many seconds, but each weather had one.

    Raises:
        SceneError: If a scene cannot be read.
    """
    turns = _in_turn(plan)
    items = turns[:most]
    kinds = {kind for _, kind in items}
    warm_up()
    rendered(plan, items[0][0])
    costs: dict[str, list[tuple[int, float]]] = {}
    start_s = time.perf_counter()
    for item, kind in items:
        if len(costs) == len(kinds) and time.perf_counter() - start_s >= budget_s:
            break
        costs.setdefault(kind, []).append(_cost(plan, item))
    shares = plan.choice.shares() if plan.count > _CANDIDATES else Counter(k for _, k in turns)
    means = [np.mean(some, axis=0) for some in costs.values()]
    size, seconds = np.average(means, axis=0, weights=[shares[kind] for kind in costs])
    measured = sum(map(len, costs.values()))
    return Estimate(plan.count, measured, float(size), float(seconds))


def _in_turn(plan: ExportPlan) -> list[tuple[int, str]]:
    """Some items and their weathers: one of each weather, then a second of each, and so on."""
    seen: Counter[str] = Counter()
    turns = []
    for item in spread_items("export-estimate", plan.digest, plan.count, _CANDIDATES):
        kind = plan.item(item).draw.kind
        turns.append((seen[kind], item, kind))
        seen[kind] += 1
    return [(item, kind) for _, item, kind in sorted(turns, key=lambda turn: turn[0])]


def _cost(plan: ExportPlan, item: int) -> tuple[int, float]:
    """Bytes and seconds of one sample."""
    start_s = time.perf_counter()
    _, parts = rendered(plan, item)
    return sum(len(data) for data in parts.values()), time.perf_counter() - start_s


def committed(state: Path, plan: ExportPlan, shard: Shard = WHOLE) -> int:
    """How many samples an export holds so far, as its journals or its `export.json` say.

    Files are not looked at: some may turn out damaged. What cannot be read, or is of another job,
    counts as nothing; `export` says why.

    Args:
        state: Folder of the export, or the state of one at a url.
        plan: What is exported.
        shard: Of which samples are counted.
    """
    try:
        if (state / layout.CONTENTS).exists():
            ours = _is_ours(layout.read_contents(state)["job"], plan)
            return shard.count(plan) if ours else 0
        items = np.zeros(plan.count, bool)
        for journal in (state / layout.JOURNAL, *shard_journals(state)):
            if journal.exists() and _is_ours(job_of(journal), plan):
                for item in committed_items(journal):
                    if item < plan.count and shard.has(plan, item):
                        items[item] = True
        return int(items.sum())
    except (DataError, IntegrityError, OSError, KeyError):
        return 0


def _is_ours(job: Any, plan: ExportPlan) -> bool:
    """Whether a job that was read back is the plan's."""
    return json.dumps(job) == json.dumps(plan.job)
