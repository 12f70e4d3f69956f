"""Figures 8 and 9: a field that stays even, and air that carries it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure
from scipy.integrate import cumulative_simpson

from physics_figures import scenes
from physics_figures.style import BLUE, GREEN, ORANGE, formula, measured, panels
from weather_aug.particles import statistics
from weather_aug.timeline import WeatherTimeline
from weather_aug.weather import Weather

BOX_M = 4.0


def stationarity(quick: bool) -> tuple[Figure, dict[str, float]]:
    """Heights after 60 frames, and what a drive meets again one box later."""
    figure, (left, right) = panels(2)
    bins = 80
    ours = _heights(2 if quick else 6)
    paper = _recycled(len(ours), BOX_M, 3.0, 0.1, 60)
    centres = (np.arange(bins) + 0.5) / bins * BOX_M
    even = len(ours) / bins
    counts = {}
    for heights, colour, name in ((paper, ORANGE, "paper's recycling"), (ours, BLUE, "ours")):
        counts[name] = np.histogram(heights, bins, (0, BOX_M))[0]
        share = counts[name] / even
        if name == "ours":
            left.step(centres, share, where="mid", color=colour, label=name)
        else:
            left.bar(centres, share, BOX_M / bins, color=colour, label=name)
    left.axhline(1, color="#222222", lw=1.1)
    left.set(xlabel="height in the box, m", ylabel="particles / even share", ylim=(0, 8.4))
    left.set(title="Heights after 60 frames")
    left.legend(loc="upper center", ncols=2)
    lags_m, wrapped, endless = _repetition(40 if quick else 260)
    right.plot(lags_m, wrapped, color=ORANGE, label="periodic box of 40 m")
    right.plot(lags_m, endless, color=BLUE, label="ours, endless")
    right.axhline(0, color="#222222", lw=1.1)
    right.set(xlabel="distance driven between two frames, m", ylabel="correlation of the layer")
    right.set(title="Does a drive meet the same flakes?", ylim=(-0.5, 1.35))
    right.legend(loc="upper center", ncols=2)
    at_box = int(np.argmin(np.abs(lags_m - 40.0)))
    chi2 = {name: float(((c - even) ** 2 / even).sum() / (bins - 1)) for name, c in counts.items()}
    return figure, {
        "heights, ours: chi-squared per degree of freedom": chi2["ours"],
        "heights, paper's recycling: chi-squared per degree of freedom": chi2["paper's recycling"],
        "heights, ours: particles": float(len(ours)),
        "heights, paper's recycling: peak over the mean": float(
            counts["paper's recycling"].max() / even
        ),
        "heights, paper's recycling: share of empty bins, %": 100
        * float((counts["paper's recycling"] == 0).mean()),
        "repetition after 40 m, periodic box": float(wrapped[at_box]),
        "repetition after 40 m, ours": float(endless[at_box]),
    }


def _heights(seeds: int) -> scenes.Float:
    """Heights of flakes in a box of air before the camera, after 6 s of falling."""
    cam = scenes.camera(400, 400, 200.0)
    found = []
    for seed in range(seeds):
        flakes = scenes.field(statistics.snow(4.0), seed)
        resolved = flakes.resolve(cam, 1_000)
        resolved = replace(resolved, reach_m=np.full_like(resolved.reach_m, 8.0))
        places = flakes.particles(cam, 6.0, resolved, scenes.whole(cam))[:, :3]
        inside = (np.abs(places[:, 0]) < 2) & (places[:, 2] > 3) & (places[:, 2] < 7)
        height = 0.5 * BOX_M - places[inside, 1]
        found.append(height[(height > 0) & (height < BOX_M)])
    return np.concatenate(found)


def _recycled(
    count: int, box_m: float, speed_m_per_s: float, step_s: float, steps: int
) -> scenes.Float:
    """The paper's rule: what has left below starts again at the top, its overshoot forgotten."""
    height = np.random.default_rng(1).uniform(0, box_m, count)
    for _ in range(steps):
        height -= speed_m_per_s * step_s
        height[height < 0] = box_m
    return height


def _repetition(frames: int) -> tuple[scenes.Float, scenes.Float, scenes.Float]:
    """Autocorrelation of a driving camera's layer of flakes, in a periodic and in our air."""
    step_m, lags = 2.0, 31
    layers = []
    for wraps in (True, False):
        layer = []
        for k in range(frames):
            x = k * step_m
            cam = scenes.camera(160, 96, 120.0, 15.0)
            pose = np.array(cam.world_from_camera)
            pose[0, 3] = x % 40.0 if wraps else x
            cam = replace(cam, world_from_camera=pose)
            flakes = scenes.field(statistics.snow(2.0), 1)
            seen = flakes.particles(cam, 0.0, flakes.resolve(cam, 600), scenes.whole(cam))
            layer.append(float((seen[:, 12] * seen[:, 6] / seen[:, 2] ** 2).sum()))
        values = np.array(layer) - np.mean(layer)
        layers.append(
            np.array(
                [
                    (values[lag:] * values[: frames - lag]).mean() / values.var()
                    for lag in range(lags)
                ]
            )
        )
    return np.arange(lags) * step_m, layers[0], layers[1]


def gusts(quick: bool) -> tuple[Figure, dict[str, float]]:
    """Wind and drift of a timeline, against the wind added up in steps of a millisecond."""
    figure, (left, middle, right) = panels(3, height_in=3.2)
    storm = WeatherTimeline(
        (
            (0.0, Weather.clear()),
            (10.0, Weather.rain("moderate")),
            (25.0, Weather.rain("extreme", wind_m_per_s=(4.0, 10.0, 0.0))),
            (40.0, Weather.snow("moderate", snow_wetness=0.6)),
        )
    )
    seed, end_s = 3, 60.0
    t = np.linspace(0, end_s, 6_001 if quick else 60_001)
    airs = [storm.air(v, seed) for v in t]
    wind = np.array([air.wind_m_per_s for air in airs])
    drift = np.array([air.drift_m for air in airs])
    added = cumulative_simpson(wind, x=t, axis=0, initial=0)
    mean = np.array([storm.at(v).wind_m_per_s for v in t])
    left.plot(t, wind[:, 1], color=BLUE, lw=1.2, label="to the left")
    left.plot(t, wind[:, 0], color=GREEN, lw=1.2, label="along")
    formula(left, t, mean[:, 1], "mean, to the left", ls="--")
    left.set(xlabel="time, s", ylabel="wind, m/s", title="Wind with gusts", ylim=(-1, 22))
    left.legend(loc="upper left")
    every = slice(None, None, len(t) // 16)
    formula(middle, t, added[:, 1], "wind added up")
    formula(middle, t, added[:, 0])
    measured(middle, t[every], drift[every, 1], "drift, left", color=BLUE, ms=4)
    measured(middle, t[every], drift[every, 0], "drift, along", color=GREEN, ms=4)
    middle.plot(t, wind[:, 1] * t, color=ORANGE, lw=1, label="wind now × time")
    middle.set(xlabel="time, s", ylabel="m", title="Drift", ylim=(-15, 680))
    middle.legend(loc="upper left")
    error = np.abs(drift - added).max(axis=1)
    right.plot(t[1:], np.maximum(error[1:], 1e-13), color=BLUE, lw=1)
    right.set(yscale="log", xlabel="time, s", ylabel="m", title="Closed form − added up")
    right.set(ylim=(1e-14, 1e-2))
    wet_s = np.array([air.wet_s for air in airs])
    wetness = np.array(
        [w.snow_wetness if w.snow_mm_per_h > 0 else 0 for w in (storm.at(v) for v in t)]
    )
    added_wet_s = cumulative_simpson(wetness, x=t, initial=0)
    return figure, {
        "drift: largest deviation from the wind added up, m": float(error.max()),
        "drift: distance covered, m": float(np.linalg.norm(drift[-1])),
        "wetness: deviation of its integral after 60 s, s": float(abs(wet_s[-1] - added_wet_s[-1])),
        "wind now x time: largest leap in 10 ms, m": float(
            np.abs(np.diff((wind[:, 1] * t)[:: max(1, len(t) // 6000)])).max()
        ),
    }
