"""The growth of the rasteriser's cost as a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.gaussians import BOTH, FORWARD, THEIRS, Growth
from benchmarks.plot import BLUE, GREEN, OUR_STYLE, PEER_STYLE, VERMILION

LOOKS = {
    FORWARD: ("ours, forward", BLUE, "o", OUR_STYLE),
    BOTH: ("ours, forward + backward", VERMILION, "s", OUR_STYLE),
    THEIRS: ("plain torch, forward + backward", GREEN, "^", PEER_STYLE),
}


def draw(measured: Mapping[str, Any], path: Path) -> None:
    """Save both growths side by side, log-log, with fits and the peer beside them."""
    figure = Figure(figsize=(12.5, 5.6), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    gaussians, pixels = measured["gaussians"], measured["pixels"]
    width, height = gaussians["size"]
    _curves(left, gaussians["counts"], gaussians["curves"], "n")
    left.set_title(f"More Gaussians, {width} x {height} pixels")
    left.set_xlabel("Gaussians (dashed: fits)")
    counts = [5_000, 10_000, 30_000, 100_000, 300_000]
    left.set_xticks(counts, [f"{count // 1000}k" for count in counts])
    _curves(right, pixels["megapixels"], pixels["curves"], "p")
    right.set_title(f"More pixels, {pixels['count']:,} Gaussians")
    right.set_xlabel("megapixels")
    ticks = [0.01, 0.03, 0.1, 0.3]
    right.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    left.set_ylabel("processor time of one core, ms a picture")
    for axes in (left, right):
        axes.set_xticks([], minor=True)
        axes.grid(which="major", color="0.85", linewidth=0.8)
        axes.grid(which="minor", color="0.94", linewidth=0.5)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


def _curves(axes: Axes, x: Sequence[float], curves: Mapping[str, Any], name: str) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    for key, curve in curves.items():
        label, colour, marker, style = LOOKS[key]
        fit = Growth(**curve["fit"])
        text = f"{label}: {fit.fixed:.0f} ms + c {name}$^{{{fit.exponent:.2f}}}$"
        axes.plot(x, curve["ms"], color=colour, marker=marker, label=text, **style)
        along = np.geomspace(min(x), max(x), 50)
        axes.plot(along, fit.at(along), "--", color=colour, linewidth=1)
    axes.legend(frameon=False, fontsize=9, loc="upper left")
