"""The export: what weather costs it, how it grows with workers, and how much memory it takes.

`make bench` leads an export of `SOME` samples and prints how its memory grows with them;
`python -m benchmarks.export --million` leads one of a million, which takes minutes.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import numba

from benchmarks import export_parent, export_share, export_workers
from benchmarks.export_process import alone
from benchmarks.report import Row, show
from benchmarks.sample import OneFrameClip
from weather_aug.scene.scene import WeatherScene

MOST_MIB = 256.0
MILLION = 1_000_000
FEW, SOME = 2_000, 20_000


def measure(counts: Sequence[int] = (FEW, SOME)) -> dict[str, Any]:
    """Print everything.

    Args:
        counts: Samples of the exports that are led without rendering; they rise.
    """
    with tempfile.TemporaryDirectory() as folder:
        scene = WeatherScene.build(OneFrameClip(), Path(folder) / "scene")
        shares = export_share.measure(scene)
        workers = alone(export_workers.__name__, scene.path)
        parents = alone(export_parent.__name__, scene.path, *counts)
    return {
        "shares": shares,
        "workers": show("export, from 1 to 2 workers", worker_rows(workers)) | workers,
        "parent": show(_title(parents), parent_rows(parents)) | {"runs": parents},
    }


def worker_rows(found: Mapping[str, Any]) -> list[Row]:
    """Of what `export_workers` measured; ratios are taken within a round."""
    rates = found["samples_per_s"]
    ratio = median(two / one for one, two in zip(rates["1"], rates["2"], strict=True))
    start_s = median(found["first_sample_s"]["2"])
    return [
        Row("2 workers / 1, start-up left out (2 is ideal)", ratio, "x"),
        Row("efficiency", 100 * ratio / 2, "%"),
        Row("first sample of 2 workers after", start_s, "s"),
        Row(
            f"worker over imports, plan of {found['planned']:,} samples",
            found["worker_over_import_mib"],
            "MiB at peak",
            at_most=MOST_MIB,
        ),
    ]


def parent_rows(found: Sequence[Mapping[str, Any]]) -> list[Row]:
    """Of what `export_parent` measured: the last run, and how much more it took than the first."""
    last = found[-1]
    target = MOST_MIB if last["samples"] >= MILLION else None
    rows = [
        Row("parent over imports", last["over_import_mib"], "MiB at peak", at_most=target),
        Row("whole export without rendering", last["seconds"], "s"),
        Row("  of it root files", last["finish_s"], "s"),
    ]
    if len(found) > 1:
        more_mib = last["over_import_mib"] - found[0]["over_import_mib"]
        grown = 2**20 * more_mib / (last["samples"] - found[0]["samples"])
        most = 2**20 * MOST_MIB / MILLION
        rows.append(Row("parent grows by", grown, "bytes/sample", at_most=most))
    return rows


def _title(found: Sequence[Mapping[str, Any]]) -> str:
    return f"export of {found[-1]['samples']:,} samples, led without rendering"


if __name__ == "__main__":
    cv2.setNumThreads(1)
    numba.set_num_threads(1)
    given = argparse.ArgumentParser(description=__doc__)
    given.add_argument("--million", action="store_true", help="lead an export of a million samples")
    measure((FEW, MILLION) if given.parse_args().million else (FEW, SOME))
