"""Figures 5 and 6: resolution, and extinction by rate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure
from scipy.integrate import quad

from physics_figures import scenes
from physics_figures.style import BLUE, GREEN, ORANGE, PURPLE, formula, measured, panels
from weather_aug.colour import linear_from_srgb
from weather_aug.particles import statistics
from weather_aug.render.compose import render
from weather_aug.weather import Weather

DISCS_TAU = 0.05


def resolution(quick: bool) -> tuple[Figure, dict[str, float]]:
    """The same particles at several resolutions, with and without the compensation."""
    figure, (left, right) = panels(2)
    full = scenes.camera(480, 288, 360.0, aperture_m=0.0)
    scales = np.array([0.25, 0.5, 1.0] if quick else [0.25, 0.5, 1.0, 2.0])
    discs = _discs(full)
    expected = -np.log(np.exp(-DISCS_TAU * scenes.slants(full)).mean())
    means: dict[bool, list[float]] = {True: [], False: []}
    for scale in scales:
        cam = full.resized(round(480 * scale), round(288 * scale))
        for compensate in means:
            means[compensate].append(
                -np.log(scenes.transmittance(discs, cam, compensate=compensate).mean()) / expected
            )
    left.axhline(1, color="#222222", lw=1.1, label="n π/4 D² r")
    measured(left, scales, means[True], "compensated (ours)")
    measured(left, scales, means[False], "dilated only (stock splat)", color=ORANGE, marker="s")
    left.set(ylabel="optical depth / n π/4 D² r", yscale="log", ylim=(0.5, 500))
    left.set(title="6 mm discs from 1 to 12 m")
    left.set_yticks([1, 3, 10, 30, 100, 300], ["1", "3", "10", "30", "100", "300"])
    left.legend(loc="upper right")
    looks = ((BLUE, "o"), (GREEN, "s"), (PURPLE, "x"))
    rendered = _rendered(scales, 1 if quick else 4)
    for (name, values), (colour, marker) in zip(rendered.items(), looks, strict=True):
        measured(right, scales, values / values[-1], name, color=colour, marker=marker)
    right.axhline(1, color="#222222", lw=1.1)
    right.set(ylabel="relative to the finest", ylim=(0.98, 1.02), title="Snow 4 mm/h, `render`")
    right.legend(loc="upper right")
    for axes in (left, right):
        axes.set(xscale="log", xlabel="resolution")
        axes.set_xticks(scales, [f"{s:g}×" for s in scales])
        axes.minorticks_off()
    return figure, {
        "resolution, compensated discs: spread of the optical depth, %": 100
        * float(np.ptp(means[True])),
        "resolution, compensated discs: largest deviation from n pi/4 D^2 r, %": 100
        * float(np.abs(np.array(means[True]) - 1).max()),
        "resolution, dilated only: smallest optical depth over the true one": min(means[False]),
        "resolution, dilated only: largest optical depth over the true one": max(means[False]),
    } | {
        f"resolution, {name}: spread, %": 100 * float(np.ptp(v) / v[-1])
        for name, v in rendered.items()
    }


def _discs(cam: scenes.Camera) -> scenes.Float:
    near_m, far_m, diameter_m, tau = 1.0, 12.0, 0.006, DISCS_TAU
    per_m3 = tau / (np.pi / 4 * diameter_m**2 * (far_m - near_m))
    (fx, fy), (cx, cy) = cam.focal_px, cam.principal_px
    frustum_m3 = (cam.width + 8) * (cam.height + 8) / (fx * fy) * (far_m**3 - near_m**3) / 3
    rng = np.random.default_rng(1)
    count = rng.poisson(per_m3 * frustum_m3)
    z = (near_m**3 + rng.random(count) * (far_m**3 - near_m**3)) ** (1 / 3)
    x = (rng.uniform(-4.5, cam.width + 3.5, count) - cx) / fx * z
    y = (rng.uniform(-4.5, cam.height + 3.5, count) - cy) / fy * z
    return scenes.balls(np.column_stack([x, y, z]), np.zeros((count, 3)), diameter_m)


def _rendered(scales: scenes.Float, seeds: int) -> dict[str, scenes.Float]:
    """Means of a grey wall behind snow, at each resolution."""
    full = scenes.camera(480, 288, 360.0, 8.0, exposure_s=0.005)
    weather = Weather(snow_mm_per_h=4.0)
    # 0.45 (sky + ground) is the airlight: flakes and veil look the same.
    alike = replace(scenes.AMBIENCE, sky=np.full(3, 0.9), ground=np.full(3, 0.6 / 0.45 - 0.9))
    names = ("mean transmittance", "mean linear light", "the same, flakes as airlight")
    found: dict[str, list[float]] = {name: [] for name in names}
    for scale in scales:
        cam = full.resized(round(480 * scale), round(288 * scale))
        frame = scenes.wall(cam, 25.0, _ramp(cam))
        plain, matched = (
            [
                render(frame, weather, seed=s, ambience=light, options=scenes.AIR_ONLY)
                for s in range(seeds)
            ]
            for light in (scenes.AMBIENCE, alike)
        )
        found[names[0]].append(np.mean([s.transmittance for s in plain]))
        for name, shots in ((names[1], plain), (names[2], matched)):
            light = [linear_from_srgb(s.image / 255.0).mean() for s in shots]
            found[name].append(np.mean(light))
    return {name: np.array(values) for name, values in found.items()}


def _ramp(cam: scenes.Camera) -> scenes.Float:
    """Levels from 40 to 160 across the picture: an even wall would measure the rounding."""
    return np.asarray(40 + 120 * (np.arange(cam.width) + 0.5) / cam.width)


def extinction(quick: bool) -> tuple[Figure, dict[str, float]]:
    """Extinction read off rendered walls against published laws."""
    figure, (left, right) = panels(2, height_in=3.5)
    cam = scenes.camera(160, 96, 120.0, exposure_s=0.002)
    rates = np.array([1.0, 2.5, 5, 10, 25, 50, 100, 200])
    r = np.geomspace(0.8, 250, 60)
    rain = np.array([_rendered_extinction(cam, "rain_mm_per_h", rate, quick) for rate in rates])
    laws = {
        "LOWTRAN 7: 0.365 R$^{0.63}$": 0.365 * r**0.63,
        "Ulbrich, Atlas: 0.334 R$^{0.64}$": 0.334 * r**0.64,
        "Weber: 0.312 R$^{0.67}$": 0.312 * r**0.67,
        "Carbonneau: 0.248 R$^{0.67}$": 0.248 * r**0.67,
    }
    for (name, law), look in zip(laws.items(), ("-", "--", ":", "-."), strict=True):
        formula(left, r, law, name, ls=look)
    measured(left, rates, 2e3 * rain, "rendered × 2 (Q = 2)")
    measured(left, rates, 1e3 * rain, "rendered (Q = 1)", color=ORANGE, marker="s")
    left.set(xscale="log", yscale="log", xlabel="rain rate, mm/h", ylabel="extinction, 1/km")
    left.set(title="Rain", ylim=(0.12, 120))
    left.legend(loc="upper left", fontsize=8.6)
    rates_s = np.array([0.4, 1.0, 2.0, 4.0, 10.0])
    s = np.geomspace(0.3, 12, 40)
    formula(right, s, 2.45 * s, "Rasmussen, dry: 2.45 S")
    formula(right, s, 0.29 * s, "Rasmussen, wet: 0.29 S", ls="--")
    law = np.array([_size_law_per_km(v) for v in s])
    right.plot(s, law, color=GREEN, lw=1.1, ls=":", label="size law, cut at 6 mm")
    dry, wet = (
        np.array([_rendered_extinction(cam, "snow_mm_per_h", v, quick, wetness) for v in rates_s])
        for wetness in (0.0, 1.0)
    )
    measured(right, rates_s, 1e3 * dry, "rendered, dry (Q = 1)")
    measured(right, rates_s, 1e3 * wet, "rendered, wet (Q = 1)", color=ORANGE, marker="s")
    right.set(xscale="log", yscale="log", xlabel="snowfall, mm/h of water", title="Snow")
    right.set(ylim=(0.06, 120))
    right.legend(loc="upper left")
    spread = 2e3 * rain / np.array([0.365 * rates**0.63, 0.312 * rates**0.67]).mean(axis=0)
    between = (0.182 * rates**0.63, 2e3 * rain / (0.248 * rates**0.67))
    return figure, {
        "rain: largest deviation of the rendered extinction from 0.182 R^0.63, %": 100
        * float(np.abs(1e3 * rain / between[0] - 1).max()),
        "rain, doubled, over the mean of LOWTRAN and Weber: smallest": float(spread.min()),
        "rain, doubled, over the mean of LOWTRAN and Weber: largest": float(spread.max()),
        "rain, doubled, over Ulbrich and Atlas at 10 mm/h": float(
            2e3 * rain[3] / (0.334 * 10**0.64)
        ),
        "rain, doubled, over Carbonneau: largest": float(between[1].max()),
        "snow, dry: smallest over 2.45 S": float((1e3 * dry / (2.45 * rates_s)).min()),
        "snow, dry: largest over 2.45 S": float((1e3 * dry / (2.45 * rates_s)).max()),
        "snow, wet: smallest over 0.29 S": float((1e3 * wet / (0.29 * rates_s)).min()),
        "snow, wet: largest over 0.29 S": float((1e3 * wet / (0.29 * rates_s)).max()),
    } | {
        f"snow, size law over 2.45 S, {name}, {v:g} mm/h": _size_law_per_km(v, end) / (2.45 * v)
        for name, end in (("cut at 6 mm", 6.0), ("whole", np.inf))
        for v in rates_s
    } | {f"snow, share of the extinction in classes, {v:g} mm/h": _in_classes(v) for v in rates_s}


def _in_classes(rate: float) -> float:
    """Share of a dry snowfall's extinction that could be drawn, and not only be veil."""
    flakes = statistics.snow(rate)
    area_m2 = (np.pi / 4 * flakes.diameters_m**2).mean(axis=1)
    return float(flakes.density_per_m3 @ area_m2 / flakes.extinction_per_m)


def _size_law_per_km(rate: float, end_mm: float = 6.0) -> float:
    """Silhouettes of dry flakes after Gunn and Marshall, pi/4 D^2 with D^2 = Dm^3 / 0.17."""
    slope, intercept = 2.55 * rate**-0.48, 3800 * rate**-0.87
    area = quad(lambda d: intercept * np.exp(-slope * d) * d**3 / 0.17, 0, end_mm)[0]
    return float(np.pi / 4 * 1e-3 * area)


def _rendered_extinction(
    cam: scenes.Camera, name: str, rate: float, quick: bool, wetness: float = 0.0
) -> float:
    weather = Weather(**{name: rate}, snow_wetness=wetness)
    frame = scenes.wall(cam, 50.0)
    frames = [(frame, weather, seed) for seed in range(1 if quick else 6)]
    return scenes.extinction_per_m(frames)
