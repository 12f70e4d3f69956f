"""Peak memory of the process that leads an export, and the time it takes to finish one.

Nothing is rendered: a million pictures take days. The plan, the journal, the manifest, the class
statistics and `export` itself are real; what is replaced is the engine, the one function that would
render. In its place stands `unrendered`, which gives the line of each sample as `write_sample`
would, of the sample's real recipe and paths and of invented sizes, digests and class counts. No
picture is written.

    python -m benchmarks.export_parent SCENE COUNT…

exports so many samples of a scene, one count after the other, in this process alone, and prints a
list of what was measured as JSON. Counts must rise: a peak stays.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

from benchmarks.export_process import resident_mib
from weather_aug import _files
from weather_aug._keys import key_of, uniforms
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.scene.scene import WeatherScene
from weather_aug.taxonomy import CLASSES
from weather_aug.writers import export as exporting
from weather_aug.writers.engines import Finished
from weather_aug.writers.plan import ExportPlan, plan_export
from weather_aug.writers.target import Target

MOST_PIXELS = 1024 * 2048 // 8
"""Of a class in an invented label."""


def line_of(plan: ExportPlan, item: int) -> str:
    """A sample's line of the manifest, as `write_sample` gives it, without a picture."""
    drawn = uniforms(key_of("unrendered", item), 2 * len(CLASSES))
    pixels = (drawn * MOST_PIXELS).astype(int)
    files = {
        part: {"path": path, "size": int(pixels[0]), "sha256": _files.sha256_of(path.encode())}
        for part, path in plan.paths(item).items()
    }
    # In a picture of a street occur about half of the classes.
    occurring = (number for number in range(len(CLASSES)) if drawn[len(CLASSES) + number] < 0.5)
    entry = {
        "item": item,
        "recipe": plan.recipe(item),
        "files": files,
        "class_pixels": {str(number): int(pixels[number]) for number in occurring},
    }
    return json.dumps(entry, allow_nan=False)


def unrendered(
    plan: ExportPlan, target: Target, units: Iterator[int]
) -> Generator[Finished, None, None]:
    """An engine that renders nothing; see the module."""
    for unit in units:
        yield unit, [line_of(plan, item) for item in plan.items_of(unit)]


def led(scene: WeatherScene, count: int, folder: Path, before_mib: float) -> dict[str, Any]:
    """Lead an export of `count` samples, and say what it took.

    Args:
        scene: Any.
        count: Samples of the default policy.
        folder: Where to; empty.
        before_mib: Of this process, when all was imported and nothing done.
    """
    ended_s = 0.0

    def engine(*arguments: Any) -> Generator[Finished, None, None]:
        nonlocal ended_s
        yield from unrendered(*arguments)
        ended_s = time.perf_counter()

    plan = plan_export([scene], WeatherPolicy(), count=count, seed=0)
    start_s = time.perf_counter()
    with patch.object(exporting, "run_inline", engine):
        report = exporting.export(plan, folder / "out")
    end_s = time.perf_counter()
    return {
        "samples": report.samples,
        "over_import_mib": resident_mib("VmHWM") - before_mib,
        "seconds": end_s - start_s,
        "finish_s": end_s - ended_s,
    }


def main(arguments: list[str]) -> None:
    """Lead exports of a scene, and print what they took."""
    before_mib = resident_mib("VmRSS")
    scene = WeatherScene(Path(arguments[0]))
    found = []
    for count in map(int, arguments[1:]):
        with tempfile.TemporaryDirectory() as folder:
            found.append(led(scene, count, Path(folder), before_mib))
    print(json.dumps(found))


if __name__ == "__main__":
    main(sys.argv[1:])
