"""Print all ratios: `make bench`. Interleaved medians of processor time in one process on one core.

The DataLoader's and the export's of workers are of the time on the wall, with two workers of one
thread each.
"""

from __future__ import annotations

import os

os.environ.setdefault("NO_ALBUMENTATIONS_UPDATE", "1")

from pathlib import Path

import cv2
import numba
import torch

from benchmarks import (
    crowds,
    editing,
    export,
    fidelity,
    gaussians,
    gaussians_plot,
    growth,
    loader,
    overlays,
    plot,
    sample,
    stages,
)
from benchmarks.report import write_results

OUT = Path("out/bench")


def main() -> None:
    """Run every benchmark on one thread; write the numbers and the plots of the growth."""
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    results = {
        "overlays": overlays.measure(),
        "editing": editing.measure(),
        "crowds": crowds.measure(),
        "fidelity": fidelity.measure(),
        "sample": sample.measure(),
        "loader": loader.measure(),
        "export": export.measure(),
        "stages": stages.measure(),
        "growth": growth.measure(),
        "gaussians": gaussians.measure(),
    }
    write_results(OUT / "results.json", results)
    plot.draw(results["growth"], OUT / "scaling.png")
    gaussians_plot.draw(results["gaussians"], OUT / "gaussians.png")
    pictures = f"{OUT / 'scaling.png'}, {OUT / 'gaussians.png'}"
    print(f"\nall numbers: {OUT / 'results.json'}; growth of the cost: {pictures}")


if __name__ == "__main__":
    main()
