"""The growth of the cost as a picture."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.growth import Power

# Okabe and Ito's colours, told apart by every kind of eye.
BLUE, VERMILION, GREEN, ORANGE, PURPLE = "#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7"
LOOKS = {
    "rain": (BLUE, "o"),
    "snow": (VERMILION, "s"),
    "fog": ("black", "D"),
    "fog + rain 20k": (BLUE, "o"),
    "fog + snow 20k": (VERMILION, "s"),
    "RandomRain (heavy)": (GREEN, "^"),
    "RandomSnow (texture)": (ORANGE, "v"),
    "RandomFog (0.5-0.8)": (PURPLE, "P"),
}
PEER_STYLE = {"linestyle": ":", "linewidth": 1.3, "markersize": 4}
OUR_STYLE = {"linestyle": "-", "linewidth": 1.8, "markersize": 5.5}


def draw(growth: Mapping[str, Any], path: Path) -> None:
    """Save both growths side by side, log-log, with fits and the peers beside them."""
    figure = Figure(figsize=(12.5, 5.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    for axes in (left, right):
        axes.set_xscale("log")
        axes.set_yscale("log")
    _particles(left, growth["particles"])
    _pixels(right, growth["pixels"])
    for axes in (left, right):
        axes.set_ylabel("processor time of one core, ms a frame")
        axes.grid(which="major", color="0.85", linewidth=0.8)
        axes.grid(which="minor", color="0.94", linewidth=0.5)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


def _particles(axes: Axes, measured: Mapping[str, Any]) -> None:
    for kind, curve in measured["curves"].items():
        colour, marker = LOOKS[kind]
        drawn, fit = curve["drawn"], Power(**curve["fit"])
        axes.plot(
            drawn, curve["ms"], color=colour, marker=marker, label=f"fog + {kind}", **OUR_STYLE
        )
        n = np.geomspace(min(drawn), max(drawn), 100)
        text = f"{curve['ms_without']:.0f} ms + c n$^{{{fit.exponent:.2f}}}$ ({kind})"
        axes.plot(n, curve["ms_without"] + fit.at(n), "--", color=colour, linewidth=1, label=text)
    for name, value in measured["references_ms"].items():
        style = "-" if name == "fog" else ":"
        axes.axhline(value, color=LOOKS[name][0], linestyle=style, linewidth=1.3)
        text = "fog alone" if name == "fog" else name
        axes.annotate(
            text,
            (0.01, value),
            xycoords=("axes fraction", "data"),
            xytext=(0, 3),
            textcoords="offset points",
            color=LOOKS[name][0],
            fontsize=9,
        )
    height, width = measured["size"]
    axes.set_title(f"More particles, {width} x {height} pixels")
    axes.set_xlabel("particles drawn")
    axes.legend(frameon=False, fontsize=9, loc="upper center")


def _pixels(axes: Axes, measured: Mapping[str, Any]) -> None:
    megapixels = measured["megapixels"]
    for name, curve in measured["curves"].items():
        colour, marker = LOOKS[name]
        fit = Power(**curve["fit"])
        style = PEER_STYLE if name.startswith("Random") else OUR_STYLE
        label = f"{name}: p$^{{{fit.exponent:.2f}}}$"
        axes.plot(megapixels, curve["ms"], color=colour, marker=marker, label=label, **style)
        if not name.startswith("Random"):
            axes.plot(megapixels, fit.at(megapixels), "--", color=colour, linewidth=1)
    axes.set_title("More pixels, 20,000 particles")
    axes.set_xlabel("megapixels (dashed: fitted power laws; dotted: albumentations 2.0.8)")
    ticks = [0.1, 0.3, 1, 3, 8]
    axes.set_xticks(ticks, [f"{t:g}" for t in ticks])
    axes.set_xticks([], minor=True)
    axes.legend(frameon=False, fontsize=9, loc="upper left")
