"""Figure 7: contrast and visibility, fog that thins with height, the paper's optical depth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure
from scipy.integrate import quad

from physics_figures import scenes
from physics_figures.style import BLUE, GREEN, ORANGE, formula, measured, panels
from weather_aug.colour import linear_from_srgb
from weather_aug.render.compose import render
from weather_aug.render.froxels import even_fog
from weather_aug.render.medium import optical_depth
from weather_aug.render.options import RenderOptions
from weather_aug.render.stage import medium_of, optics_of
from weather_aug.weather import Weather

HAZE_PER_M = 0.1 / 40
"""Extinction that the release's settings seem to mean: 0.1 over the width of its box."""


def fog(quick: bool) -> tuple[Figure, dict[str, float]]:
    """Three checks of the fog: Koschmieder, quadrature, and WeatherEdit's release."""
    figure, axes = panels(3, height_in=3.3)
    return figure, _contrast(axes[0]) | _height(axes[1]) | _published(axes[2], quick)


def _contrast(axes: scenes.Any) -> dict[str, float]:
    cam = scenes.camera(8, 8, 6000.0)
    shares = np.array([0.1, 0.25, 0.5, 0.75, 1.0, 1.25])
    s = np.linspace(0, 1.4, 60)
    formula(axes, s, 0.05**s, "0.05$^{d/V}$")
    at_range = {}
    looks = ((600.0, BLUE, "o"), (150.0, GREEN, "s"), (50.0, ORANGE, "^"))
    for visibility_m, colour, marker in looks:
        contrast = []
        for share in shares:
            contrast.append(_step_contrast(cam, visibility_m, visibility_m * share))
        at_range[visibility_m] = contrast[4]
        measured(
            axes, shares, contrast, f"V = {visibility_m:g} m", color=colour, marker=marker, ms=4.5
        )
    axes.axhline(0.05, color="#888888", lw=0.8, ls=":")
    axes.axvline(1, color="#888888", lw=0.8, ls=":")
    axes.set(yscale="log", ylim=(0.015, 1.2), xlabel="distance / visibility V")
    axes.set(ylabel="contrast, black to white", title="Contrast of the 8-bit picture")
    axes.legend(loc="lower left")
    worst = max(at_range.values(), key=lambda c: abs(c - 0.05))
    return {"fog: contrast at the visibility, farthest from 0.05": worst}


def _step_contrast(cam: scenes.Camera, visibility_m: float, depth_m: float) -> float:
    """Linear light of white less that of black, over the clear one; mean over 24 airlights.

    One airlight alone would measure the rounding to 8 bits.
    """
    step = np.zeros((8, 8), np.uint8)
    step[:, 4:] = 255
    frame, weather = scenes.wall(cam, depth_m, step), Weather(visibility_m=visibility_m)
    contrasts = []
    for airlight in np.linspace(0.3, 0.8, 24):
        ambience = replace(scenes.AMBIENCE, airlight=np.full(3, airlight))
        shot = render(frame, weather, seed=0, ambience=ambience, options=scenes.AIR_ONLY)
        light = linear_from_srgb(shot.image / 255.0)
        contrasts.append(light[:, 4:].mean() - light[:, :4].mean())
    return float(np.mean(contrasts))


def _height(axes: scenes.Any) -> dict[str, float]:
    """Optical depth to 200 m along rays of several elevations, against adaptive quadrature."""
    cam = scenes.camera(1, 601, 500.0)
    optics = optics_of(cam, scenes.UP)
    depth = np.full((601, 1), 200.0, np.float32)
    slope = -(np.arange(601) - 300) / 500.0
    elevation = np.degrees(np.arctan(slope))
    worst = 0.0
    for height_m, colour in ((60.0, GREEN), (25.0, BLUE), (10.0, ORANGE)):
        weather = Weather(visibility_m=150.0, fog_scale_height_m=height_m)
        medium = medium_of(weather, [], scenes.AMBIENCE)
        carried = scenes.NOTHING_RESOLVED
        tau = optical_depth(depth, scenes.whole(cam), optics, medium, carried, even_fog())[:, 0]
        beta = np.log(20) / 150.0
        rows = np.arange(100, 336, 5)
        exact = np.array([beta * _layer_m(slope[i], height_m) for i in rows])
        inside = (exact < 60) & (200 * slope[rows] / height_m > -8)
        worst = max(worst, float(np.abs(tau[rows] / exact - 1)[inside].max()))
        formula(axes, elevation[rows], exact)
        few = rows[::4]
        measured(axes, elevation[few], tau[few], f"H = {height_m:g} m", color=colour, ms=4)
    axes.set(yscale="log", xlabel="elevation of the ray, degrees", ylabel="optical depth to 200 m")
    axes.set(title="Fog that thins with height", ylim=(0.3, 30), xlim=(-5, 23))
    axes.legend(loc="upper right")
    return {"height fog: largest deviation from quadrature, %": 100 * worst}


def _layer_m(slope: float, height_m: float) -> float:
    """Metres of fog as dense as at the camera along 200 m of depth of a ray that climbs."""
    along = quad(lambda z: np.exp(-z * slope / height_m), 0, 200)[0]
    return float(np.sqrt(1 + slope**2) * along)


def _published(axes: scenes.Any, quick: bool) -> dict[str, float]:
    """Optical depth of the release's fog, drawn by our kernels, and of ours, by depth."""
    cam = scenes.camera(96, 64, 200.0)
    z = np.array([5.0, 10, 15, 20, 25, 30])
    release, ours = [], []
    weather = Weather(visibility_m=np.log(20) / HAZE_PER_M)
    for depth_m in z:
        frame = scenes.wall(cam, depth_m)
        shots = [
            scenes.through(frame, weather, seed, options=RenderOptions(preset="weatheredit"))
            for seed in range(1 if quick else 4)
        ]
        release.append(-np.log(np.mean(shots)))
        ours.append(-np.log(scenes.through(frame, weather).mean()))
    d = np.linspace(0, 32, 80)
    # Its rasteriser, as ours, cuts a splat where its opacity falls to 1/255.
    per_m2 = 200_000 / (40 * 80 * 40) * 2 * np.pi * 0.7**2
    local = [
        per_m2 * quad(lambda t: max(-np.expm1(-HAZE_PER_M * t) - 1 / 255, 0), 0, v)[0] for v in d
    ]
    formula(axes, d, local, "n 2πσ² ∫ (1−e$^{-βz}$−1/255) dz", ls="--")
    formula(axes, d, HAZE_PER_M * d, "β z")
    measured(axes, z, release, "WeatherEdit's release", color=ORANGE, marker="s")
    measured(axes, z, ours, "ours, equal β")
    axes.set(xlabel="distance, m", ylabel="optical depth", ylim=(-0.1, 7.2), xlim=(0, 32))
    axes.set(title="β = 0.1 / 40 m")
    axes.legend(loc="upper left", fontsize=9)
    exponent = np.polyfit(np.log(z), np.log(release), 1)[0]
    slope = np.polyfit(np.log(z), np.log(ours), 1)[0]
    return {
        "release's fog: exponent of the optical depth in the distance": float(exponent),
        "our fog: the same exponent": float(slope),
        "release's fog: optical depth at 20 m": float(release[3]),
        "our fog: optical depth at 20 m": float(ours[3]),
    }
