"""One look for all figures: sober, safe for the colour-blind, readable at half width."""

from __future__ import annotations

from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

BLUE, ORANGE, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
SKY, BLACK, GREY, LIGHT = "#56B4E9", "#222222", "#888888", "#D5D5D5"
"""Okabe and Ito's colours."""

STYLE = {
    "figure.dpi": 130,
    "font.family": "DejaVu Sans",
    "font.size": 11,
    "axes.titlesize": 11,
    "axes.titlelocation": "left",
    "axes.labelsize": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#E6E6E6",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.fontsize": 9.5,
    "legend.frameon": False,
    "legend.handlelength": 1.6,
    "lines.linewidth": 1.6,
    "lines.markersize": 5,
    "savefig.facecolor": "white",
}


def panels(
    columns: int, rows: int = 1, height_in: float = 3.3, **kwargs: Any
) -> tuple[Figure, Any]:
    """A figure of 9.2 inches with its axes, in the common style."""
    matplotlib.rcParams.update(STYLE)
    return plt.subplots(
        rows, columns, figsize=(9.2, height_in * rows), layout="constrained", **kwargs
    )


def formula(axes: Axes, x: Any, y: Any, label: str | None = None, **kwargs: Any) -> None:
    """What the formula or an independent reference says: a thin dark line."""
    axes.plot(x, y, **({"color": BLACK, "lw": 1.1, "ls": "-"} | kwargs), label=label)


def measured(axes: Axes, x: Any, y: Any, label: str | None = None, **kwargs: Any) -> None:
    """What came out of the library: markers."""
    look = {"color": BLUE, "ls": "none", "marker": "o", "mfc": "white", "mew": 1.4, "zorder": 3}
    axes.plot(x, y, **(look | kwargs), label=label)
