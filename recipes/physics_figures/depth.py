"""Figures 2 and 3: drawn particles and veil together, and Beer and Lambert's law."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from scipy.integrate import quad

from physics_figures import scenes
from physics_figures.style import BLACK, BLUE, GREEN, LIGHT, ORANGE, formula, measured, panels
from weather_aug.particles import statistics
from weather_aug.particles.resolve import drawn_share
from weather_aug.render.froxels import even_fog
from weather_aug.render.medium import optical_depth
from weather_aug.render.options import EFFECTS, RenderOptions
from weather_aug.render.stage import medium_of, optics_of
from weather_aug.weather import Weather

RATE_MM_PER_H = 25.0


def explicit_and_residual(quick: bool) -> tuple[Figure, dict[str, float]]:
    """Silhouettes of drawn drops plus the veil's optical depth, against the whole distribution."""
    figure, axes = panels(
        3, rows=2, height_in=2.1, sharex=True, sharey="row", height_ratios=(2.2, 1)
    )
    cam = scenes.camera(1242, 375, 721.0, 10.0, exposure_s=0.002)
    slope = 4.1 * RATE_MM_PER_H**-0.21
    beta = quad(lambda d: np.pi / 4 * 1e-6 * d * d * 8000 * np.exp(-slope * d), 0, 6)[0]
    z = np.array([1.0, 1.3, 1.7, 2.2, 3, 4, 5.5, 7, 9, 12, 16, 20, 25, 32, 40, 50, 60])
    found = {}
    for (upper, lower), budget in zip(axes.T, (1_000, 20_000, 200_000), strict=True):
        drawn, error, alpha_min = _drawn(cam, z, budget, 2 if quick else 24)
        veil = _veil(cam, z, budget)
        whole = beta * z
        upper.fill_between(z, drawn / whole, color=BLUE, alpha=0.35, lw=0, label="drawn drops")
        upper.fill_between(
            z, drawn / whole, (drawn + veil) / whole, color=LIGHT, lw=0, label="veil"
        )
        upper.axhline(1, color=BLACK, lw=1.1, label="∫ π/4 D² N(D) dD · z")
        budget_text = f"{budget:,}".replace(",", " ")
        upper.set(title=f"budget {budget_text}: $α_{{min}}$ = {alpha_min:.3f}", ylim=(0, 1.12))
        off = 100 * ((drawn + veil) / whole - 1)
        lower.axhline(0, color=BLACK, lw=1.1)
        lower.errorbar(z, off, 100 * error / whole, fmt="o", ms=3.5, mfc="white", color=BLUE, lw=1)
        lower.set(xscale="log", xlabel="depth, m", xlim=(0.9, 66), ylim=(-2.6, 2.6))
        lower.set_xticks([1, 3, 10, 30, 60], ["1", "3", "10", "30", "60"])
        lower.minorticks_off()
        name = f"explicit + residual, budget {budget}"
        found[f"{name}: largest deviation from 5 m on, %"] = float(np.abs(off[z >= 5]).max())
        found[f"{name}: chi-squared per depth"] = float(((off / 100 * whole / error) ** 2).mean())
        found[f"{name}: share drawn at 5.5 m, %"] = float(100 * (drawn / whole)[6])
        found[f"{name}: share drawn at 60 m, %"] = float(100 * (drawn / whole)[-1])
    found |= _arrivals()
    axes[0, 0].set(ylabel="share of the whole")
    axes[1, 0].set(ylabel="sum off, %")
    legend = axes[0, 0].legend(loc="center", bbox_to_anchor=(0.55, 0.62), frameon=True)
    legend.get_frame().set(alpha=1, linewidth=0)
    return figure, found


def _arrivals() -> dict[str, float]:
    """What the latest particles of cubes lack, by drawing cubes, against the closed form."""
    rng = np.random.default_rng(1)
    found, worst = {}, 0.0
    for mean in (0.01, 0.1, 1.0, 10.0, 40.0):
        count = rng.poisson(mean, round(max(1.0, 1 / mean) * 400_000))
        # All particles of a cube share one fraction, as they share one uniform number.
        fraction, width = rng.random(len(count)), 0.25 + 0.1 * mean
        opaque = 0.0
        for later in range(count.max()):
            some = count > later
            opaque += np.minimum(1.0, (later + fraction[some]) / width).sum()
        share = float(drawn_share(np.array([mean]))[0])
        worst = max(worst, abs(opaque / count.sum() / share - 1))
        found[f"arrivals: share of the opacity that is there, mean count {mean:g}, %"] = 100 * share
    return found | {"arrivals: largest deviation of drawn cubes from it, %": 100 * worst}


def _drawn(
    cam: scenes.Camera, z: scenes.Float, budget: int, seeds: int
) -> tuple[scenes.Float, scenes.Float, float]:
    """Optical depth (and its standard error) of drawn drops, by adding up their silhouettes."""
    total, square = np.zeros(len(z)), np.zeros(len(z))
    (fx, fy), area_px = cam.focal_px, cam.width * cam.height
    for seed in range(seeds):
        drops = scenes.field(statistics.rain(RATE_MM_PER_H), seed)
        resolved = drops.resolve(cam, budget)
        seen = drops.particles(cam, 0.0, resolved, scenes.whole(cam))
        seen = scenes.in_picture(seen, cam).astype(float)
        seen = seen[np.argsort(seen[:, 2])]
        share = seen[:, 12] * 2 * np.pi * seen[:, 6] * fx * fy / (seen[:, 2] ** 2 * area_px)
        upto = np.searchsorted(seen[:, 2], z)
        total += np.r_[0, share.cumsum()][upto]
        square += np.r_[0, (share**2).cumsum()][upto]
    return total / seeds, np.sqrt(square) / seeds, resolved.alpha_min


def _veil(cam: scenes.Camera, z: scenes.Float, budget: int) -> scenes.Float:
    """Optical depth that the medium's kernel adds for the rest, on the axis."""
    drops = scenes.field(statistics.rain(RATE_MM_PER_H), 0)
    carried = drops.resolve(cam, budget).optical_depth
    medium = medium_of(Weather(rain_mm_per_h=RATE_MM_PER_H), [drops], scenes.AMBIENCE)
    optics = optics_of(cam, scenes.UP)
    pixel = (cam.height // 2, cam.width // 2, 1, 1)
    planes = [np.full((1, 1), depth, np.float32) for depth in z]
    return np.array(
        [optical_depth(p, pixel, optics, medium, carried, even_fog())[0, 0] for p in planes]
    )


def beer_lambert(quick: bool) -> tuple[Figure, dict[str, float]]:
    """Mean transmittance of Poisson splats and of rendered snow, and the spread between pixels."""
    figure, (left, right) = panels(2)
    seeds = 1 if quick else 8
    tau = np.linspace(0, 4.6, 100)
    formula(left, tau, np.exp(-tau), "exp(−τ)")
    depths = np.array([0.25, 0.5, 1, 1.5, 2, 3, 4])
    means = [_disc_mean(t, 2 if quick else 12) for t in depths]
    measured(left, depths, means, "Poisson discs, drawn by the kernels")
    snow_tau, snow_mean = _rendered_snow(seeds)
    measured(
        left, snow_tau, snow_mean, "snow in front of a wall, `render`", color=ORANGE, marker="s"
    )
    left.set(yscale="log", xlabel="optical depth τ", ylabel="mean transmittance", ylim=(0.008, 1.2))
    left.set_yticks([0.01, 0.03, 0.1, 0.3, 1], ["0.01", "0.03", "0.1", "0.3", "1"])
    left.minorticks_off()
    left.set(title="Mean over pixels")
    left.legend(loc="lower left")
    off, ratio = [], []
    for opacity, colour in ((0.05, GREEN), (0.2, BLUE), (0.8, ORANGE)):
        formula(right, tau, np.sqrt(np.expm1(tau * (opacity + 2 / 255) / 2)))
        spread = [_spread(t, opacity, seeds) for t in (0.5, 1.0, 2.0, 3.0)]
        measured(
            right, [0.5, 1, 2, 3], [s[1] for s in spread], f"$α_0$ = {opacity:g}", color=colour
        )
        ratio += [s[0] - 1 for s in spread]
        off += [s[1] / s[2] - 1 for s in spread]
    right.set(
        xlabel="optical depth τ", ylabel="standard deviation / mean", xlim=(0, 3.4), ylim=(0, 1.65)
    )
    right.set(title="Spread: $\\sqrt{\\exp(τ (α_0 + 2/255) / 2) − 1}$")
    right.legend(loc="upper left")
    return figure, {
        "Beer-Lambert, discs: largest deviation of the mean, %": 100
        * float(np.abs(np.array(means) / np.exp(-depths) - 1).max()),
        "Beer-Lambert, rendered snow: largest deviation of the mean, %": 100
        * float(np.abs(snow_mean / np.exp(-snow_tau) - 1).max()),
        "Beer-Lambert, wide splats: largest deviation of the mean, %": 100
        * float(np.abs(ratio).max()),
        "Beer-Lambert, wide splats: largest deviation of the spread, %": 100
        * float(np.abs(off).max()),
    }


def _poisson(
    cam: scenes.Camera, tau: float, opacity: float, sigma_m: float, seeds: int
) -> scenes.Float:
    """Transmittance (seeds, H, W) of Poisson splats from 2 m to 10 m."""
    near_m, far_m = 2.0, 10.0
    focal = cam.focal_px[0]
    half_m = far_m * np.array([cam.width, cam.height]) / (2 * focal) + 4 * sigma_m
    per_m3 = tau / (2 * np.pi * sigma_m**2 * opacity * (far_m - near_m))
    shots = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        count = rng.poisson(per_m3 * 4 * half_m.prod() * (far_m - near_m))
        places = rng.uniform((*-half_m, near_m), (*half_m, far_m), (count, 3))
        # What is far outside at its own depth cannot touch the picture.
        reach = places[:, 2:] * (half_m - 4 * sigma_m) / far_m + 4 * sigma_m
        places = places[(np.abs(places[:, :2]) < reach).all(axis=1)]
        records = scenes.balls(places, np.zeros_like(places), sigma_m * 8**0.5, opacity)
        shots.append(scenes.transmittance(records, cam))
    return np.array(shots)


def _disc_mean(tau: float, seeds: int) -> float:
    """Mean transmittance of 3 cm discs, over what exp(-tau) makes of each pixel's own path."""
    cam = scenes.camera(96, 96, 300.0, aperture_m=0.0)
    shots = _poisson(cam, tau, 1.0, 0.03 / 8**0.5, seeds)
    expected = np.exp(-tau * scenes.slants(cam)).mean()
    return float(shots.mean() / expected * np.exp(-tau))


def _spread(tau: float, opacity: float, seeds: int) -> tuple[float, float, float]:
    """Of wide splats: mean over the expected one, standard deviation over mean, and expected."""
    cam = scenes.camera(480, 288, 600.0, aperture_m=0.0)
    shots = _poisson(cam, tau, opacity, 0.06, seeds if opacity < 0.5 else 3 * seeds)
    path = tau * scenes.slants(cam)
    relative = shots / np.exp(-path)
    # A splat of peak a + 1/255 that ends where it has fallen to 1/255 has the integral 2 pi s^2 a,
    # and its square pi s^2 a (a + 2/255).
    expected = np.sqrt(np.expm1(path * (opacity + 2 / 255) / 2).mean())
    return float(relative.mean()), float(relative.std() / relative.mean()), float(expected)


def _rendered_snow(seeds: int) -> tuple[scenes.Float, scenes.Float]:
    cam = scenes.camera(160, 96, 120.0, exposure_s=0.002)
    tau, mean = [], []
    for rate, depth_m in ((1.0, 30.0), (4.0, 30.0), (10.0, 30.0), (10.0, 60.0), (25.0, 60.0)):
        frame = scenes.wall(cam, depth_m)
        weather = Weather(snow_mm_per_h=rate)
        options = RenderOptions(40_000, without=EFFECTS)
        frames = [(frame, weather, seed) for seed in range(min(seeds, 3))]
        tau.append(_snow_per_m(rate) * depth_m)
        mean.append(np.exp(-scenes.extinction_per_m(frames, options=options) * depth_m))
    return np.array(tau), np.array(mean)


def _snow_per_m(rate: float) -> float:
    """Rasmussen's extinction: 1.5 times the mass of the water in a m3 of air, over 0.17."""
    water_g_per_m3 = rate * 1e3 / 3600 / 1.0
    return 1.5e-3 * water_g_per_m3 / 0.17
