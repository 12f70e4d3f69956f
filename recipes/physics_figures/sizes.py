"""Figure 1: sizes and speeds of drawn drops."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from physics_figures import scenes
from physics_figures.style import BLUE, GREEN, GREY, ORANGE, formula, measured, panels
from weather_aug.particles import statistics
from weather_aug.particles.resolve import NEAR_M, Resolved

GUNN_KINZER_MM = np.r_[np.arange(0.4, 1.01, 0.1), np.arange(1.2, 5.81, 0.2)]
GUNN_KINZER_M_PER_S = np.r_[
    [1.62, 2.06, 2.47, 2.87, 3.27, 3.67, 4.03, 4.64, 5.17, 5.65, 6.09, 6.49, 6.90, 7.27, 7.57],
    [7.82, 8.06, 8.26, 8.44, 8.60, 8.72, 8.83, 8.92, 8.98, 9.03, 9.07, 9.09, 9.12, 9.14],
    [9.16, 9.17],
]
"""Measured speeds of drops in still air (Gunn and Kinzer 1949)."""
REACH_M = 6.0


def drops_and_flakes(quick: bool) -> tuple[Figure, dict[str, float]]:
    """Drawn drops per size against Marshall and Palmer, their paths against Gunn and Kinzer."""
    figure, (left, right) = panels(2)
    cam = scenes.camera(160, 96, 80.0)
    volume_m3 = 160 * 96 / 80.0**2 * (REACH_M**3 - NEAR_M**3) / 3
    edges = statistics.RAIN_EDGES_MM
    seeds = 1 if quick else 6
    deviations = []
    for rate, colour in ((2.5, GREEN), (10.0, BLUE), (50.0, ORANGE)):
        population = statistics.rain(rate)
        sizes = []
        for seed in range(seeds):
            # Fields of one seed are nested: other seeds, lest all rates share one luck.
            drops = scenes.field(population, seed + round(100 * rate)).particles(
                cam, 0.0, _all_of(population), scenes.whole(cam)
            )
            sizes.append(1e3 * np.sqrt(8 * scenes.in_picture(drops, cam)[:, 6].astype(float)))
        counts = np.histogram(np.concatenate(sizes), edges)[0]
        middle, width = np.sqrt(edges[1:] * edges[:-1]), np.diff(edges)
        scale = 1 / (seeds * volume_m3 * width)
        some = counts > 3
        left.errorbar(
            middle[some],
            (counts * scale)[some],
            yerr=(np.sqrt(counts) * scale)[some],
            xerr=[(middle - edges[:-1])[some], (edges[1:] - middle)[some]],
            fmt="o",
            ms=3.5,
            lw=1.1,
            color=colour,
            label=f"drawn, {rate:g} mm/h",
        )
        slope = 4.1 * rate**-0.21
        d = np.linspace(0.5, 6, 200)
        formula(left, d, 8000 * np.exp(-slope * d))
        expected = 8000 / slope * -np.diff(np.exp(-slope * edges)) * seeds * volume_m3
        deviations.append((counts - expected)[expected > 5] / np.sqrt(expected[expected > 5]))
    left.set(yscale="log", ylim=(0.02, 9000), xlim=(0.3, 6.2), xlabel="diameter, mm")
    left.set(ylabel="drops per m³ and mm", title="Sizes: N(D) = 8000 exp(−4.1 R$^{-0.21}$ D)")
    left.legend(loc="upper right")
    _speeds(right, cam)
    error = _speeds_error(cam)
    z = np.concatenate(deviations)
    return figure, {
        "sizes: chi-squared per bin (1 expected)": float((z**2).mean()),
        "sizes: bins": float(z.size),
        "speeds: largest deviation of a class from Gunn and Kinzer, %": 100 * error,
    }


def _all_of(population: statistics.Population) -> Resolved:
    """Every size up to one depth, so that the sizes seen are those in the air."""
    reach_m = np.full(population.diameters_m.shape, REACH_M, np.float32)
    return Resolved(0.0, reach_m, 1e5, np.zeros(1025, np.float32))


def _measured_speeds(cam: scenes.Camera, law: str) -> tuple[np.ndarray, np.ndarray]:
    """Speed of each class from where its drops are at two times, 5 ms apart; and its diameter."""
    population = statistics.rain(50.0, fall_speed=law)
    # Swaying is horizontal; without it the nearest drop of equal size is the same drop.
    population = replace(population, sway_m=0 * population.sway_m)
    step_s = 0.005
    resolved = _all_of(population)
    before, after = (
        scenes.field(population, 1).particles(cam, t, resolved, scenes.whole(cam))
        for t in (3.0, 3.0 + step_s)
    )
    middles, speeds = [], []
    for row in population.diameters_m.astype(np.float32):
        drops = []
        for size in row:
            variance = np.float32(0.125) * size * size
            old, new = before[before[:, 6] == variance], after[after[:, 6] == variance]
            if len(old) and len(new):
                distance, index = cKDTree(new[:, :3]).query(old[:, :3])
                kept = distance < 0.06
                drops.append((new[index, 1] - old[:, 1])[kept] / step_s)
        middles.append(1e3 * float(np.sqrt(row[0] * row[-1])))
        speeds.append(np.median(np.concatenate(drops)))
    return np.array(middles), np.array(speeds)


def _speeds(axes: Any, cam: scenes.Camera) -> None:
    axes.plot(GUNN_KINZER_MM, GUNN_KINZER_M_PER_S, "k.", ms=4, label="Gunn, Kinzer 1949: measured")
    middle, speed = _measured_speeds(cam, "brandes")
    measured(axes, middle, speed, "drawn drops (default law)", color=BLUE)
    middle, speed = _measured_speeds(cam, "atlas")
    measured(axes, middle, speed, "drawn drops (Atlas)", color=ORANGE, marker="x", mew=1.2)
    for low, high in zip(
        statistics.RAIN_EDGES_MM[:-1:2], statistics.RAIN_EDGES_MM[1::2], strict=True
    ):
        axes.axvspan(low, high, color=GREY, alpha=0.08, lw=0)
    axes.set(xlabel="diameter, mm", ylabel="fall speed, m/s", xlim=(0.3, 6.2), ylim=(0, 10))
    axes.set(title="Speeds, from places 5 ms apart")
    axes.legend(loc="lower right")


def _speeds_error(cam: scenes.Camera) -> float:
    middle, speed = _measured_speeds(cam, "brandes")
    table = np.interp(middle, GUNN_KINZER_MM, GUNN_KINZER_M_PER_S)
    return float(np.abs(speed / table - 1).max())
