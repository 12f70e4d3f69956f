"""Figure 4: how opaque streaks are, what they look like, where they point."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure

from physics_figures import scenes
from physics_figures.style import BLUE, GREEN, ORANGE, formula, measured, panels
from weather_aug.clip.street import StreetClip
from weather_aug.clip.types import FrameKey
from weather_aug.edit.ambience import ambience_of
from weather_aug.particles import statistics
from weather_aug.render.compose import render
from weather_aug.render.options import EFFECTS, RenderOptions
from weather_aug.weather import Weather

TABLE = {
    1: (0.159, 0.088, 0.038, 0.019, 0.010),
    2: (0.184, 0.104, 0.045, 0.023, 0.012),
    4: (0.245, 0.145, 0.065, 0.034, 0.017),
}
"""Mean opacity over the streak of a falling drop, by diameter in mm, at `EXPOSURES_S`."""
EXPOSURES_S = np.array([1, 2, 5, 10, 20]) * 1e-3
FOCAL_PX = 1266.0


def streaks(quick: bool) -> tuple[Figure, dict[str, float]]:
    """Opacity against exposure, profile against a shutter of 2000 instants, focus of expansion."""
    figure, axes = panels(3, height_in=3.2, width_ratios=(1, 1, 1.25))
    found = _opacities(axes[0]) | _profile(axes[1]) | _focus(axes[2], quick)
    return figure, found


def _opacities(axes: scenes.Any) -> dict[str, float]:
    worst = 0.0
    for (size_mm, table), colour in zip(TABLE.items(), (GREEN, BLUE, ORANGE), strict=True):
        speed = float(statistics.brandes_fall_speed_m_per_s(np.array([size_mm]))[0])
        diameter_m = size_mm * 1e-3
        t = np.geomspace(0.8e-3, 25e-3, 50)
        formula(axes, 1e3 * t, np.pi / 4 * diameter_m / (speed * t + diameter_m))
        means = []
        for exposure_s in EXPOSURES_S:
            cam = scenes.camera(240, 1200, FOCAL_PX, exposure_s=exposure_s, aperture_m=0.0)
            drop = scenes.balls(np.array([[0, 0, 1.0]]), np.array([[0, speed, 0]]), diameter_m)
            covered_px = (1 - scenes.transmittance(drop, cam)).sum()
            swept_px = (speed * exposure_s + diameter_m) * diameter_m * FOCAL_PX**2
            means.append(covered_px / swept_px)
        measured(axes, 1e3 * EXPOSURES_S, means, f"{size_mm} mm", color=colour)
        worst = max(worst, float(np.abs(np.array(means) - table).max()))
    axes.set(xscale="log", yscale="log", xlabel="exposure, ms", ylabel="mean opacity of a streak")
    axes.set(title="Mean: π/4 · D / (L + D)", ylim=(0.008, 0.4))
    axes.set_xticks([1, 2, 5, 10, 20], ["1", "2", "5", "10", "20"])
    axes.set_yticks([0.01, 0.03, 0.1, 0.3], ["0.01", "0.03", "0.1", "0.3"])
    axes.minorticks_off()
    axes.legend(loc="lower left")
    return {"streak opacity: largest deviation from the table": worst}


def _profile(axes: scenes.Any) -> dict[str, float]:
    """Opacity summed across the streak, along it, in units of the drop's width."""
    found = {}
    for depth_m, colour, name in ((1.5, BLUE, "one Gaussian"), (0.6, ORANGE, "in parts")):
        cam = scenes.camera(200, 200, FOCAL_PX, exposure_s=0.005, aperture_m=0.0)
        velocity, diameter_m = np.array([[0, 6.54, 0.0]]), 0.002
        drop = scenes.balls(np.array([[0, 0, depth_m]]), velocity, diameter_m)
        drawn = (1 - scenes.transmittance(drop, cam)).sum(axis=1)
        shutter = _shutter(cam, depth_m, 6.54, diameter_m).sum(axis=1)
        width_px = diameter_m * FOCAL_PX / depth_m
        length_px = 6.54 * 0.005 * FOCAL_PX / depth_m
        along = (np.arange(200) - 99.5) / length_px
        formula(axes, along, shutter / width_px, "open shutter" if colour == BLUE else None)
        axes.plot(along, drawn / width_px, color=colour, label=name)
        found[f"streak profile, {name}: L1 deviation from an open shutter, %"] = float(
            100 * np.abs(drawn - shutter).sum() / shutter.sum()
        )
        found[f"streak profile, {name}: deviation of the integral, %"] = float(
            100 * (drawn.sum() / shutter.sum() - 1)
        )
    axes.set(xlim=(-0.95, 0.95), ylim=(0, 0.098), xlabel="place along the streak, lengths")
    axes.set(ylabel="opacity across / width", title="2 mm drop, 5 ms")
    axes.legend(loc="upper left", ncols=2, columnspacing=1.0, handlelength=1.2)
    return found


def _shutter(cam: scenes.Camera, depth_m: float, speed: float, diameter_m: float) -> scenes.Float:
    """Share of the exposure for which a hard disc covers each pixel: 16 x 16 rays, 2000 times."""
    fine = 16
    side = np.arange(200 * fine) / fine - 99.5 - 0.5 + 0.5 / fine
    radius_px = 0.5 * diameter_m * FOCAL_PX / depth_m
    middle = np.linspace(-0.5, 0.5, 2000) * speed * 0.005 * FOCAL_PX / depth_m
    half2 = radius_px**2 - side**2
    # A point at height v is covered while the middle is within the chord at its distance aside.
    chord = np.sqrt(np.maximum(half2, 0))
    ordered = np.searchsorted(middle, side[:, None] + chord) - np.searchsorted(
        middle, side[:, None] - chord
    )
    share = ordered / 2000 * (half2 > 0)
    return np.asarray(share.reshape(200, fine, 200, fine).mean(axis=(1, 3)))


def _focus(axes: scenes.Any, quick: bool) -> dict[str, float]:
    """Lines along the drawn streaks of three classes, and where they should meet."""
    size = (320, 180) if quick else (640, 360)
    frame = StreetClip(frames=3, width=size[0], height=size[1]).frame(FrameKey(1, "front"))
    cam = frame.camera
    weather = Weather.rain(mm_per_h=40.0, wind_m_per_s=(0.0, 0.0, 0.0))
    ambience = ambience_of(frame, np.eye(3))
    options = RenderOptions(50_000, without=EFFECTS)
    shot = render(frame, weather, seed=2, ambience=ambience, options=options)
    axes.imshow(shot.image)
    population = statistics.rain(40.0)
    population = replace(population, sway_per_wind_s=0 * population.sway_m)
    worst, most_turned, highest = 0.0, 0.0, 0.0
    (fx, fy), (cx, cy) = cam.focal_px, cam.principal_px
    rotation = cam.world_from_camera[:3, :3]
    for k, colour in ((3, GREEN), (6, BLUE), (11, ORANGE)):
        velocity = np.array([0, 0, -population.fall_speed_m_per_s[k]]) - cam.velocity_m_per_s
        x, y, z = velocity @ rotation
        aim = np.array([cx + fx * x / z, cy + fy * y / z])
        middles, along = _drawn_lines(population, k, cam)
        meet = _meeting_point(*_drawn_lines(population, k, cam, size=0.05))
        turned = np.degrees(np.arccos(np.abs((along * _unit(aim - middles)).sum(axis=1))))
        most_turned = max(most_turned, float(np.median(turned)))
        worst = max(worst, float(np.hypot(*(meet - aim))))
        for middle, way in list(zip(middles, along, strict=True))[:: max(1, len(middles) // 7)]:
            ends = middle + np.array([[-1.0], [1.0]]) * way * 0.03 * size[0]
            axes.plot(*ends.T, color=colour, lw=1.6)
            axes.plot(*np.stack([middle, meet]).T, color=colour, lw=0.5, alpha=0.55)
        label = f"{1e3 * np.median(population.diameters_m[k]):.1f} mm"
        axes.plot(*aim, "o", color=colour, mfc="none", mew=1.6, ms=10, label=label)
        axes.plot(*meet, "+", color=colour, mew=1.4, ms=9)
        highest = min(highest, aim[1])
    axes.set(xlim=(0, size[0]), ylim=(size[1], highest - 0.12 * size[1]), xticks=[], yticks=[])
    axes.grid(visible=False)
    axes.spines[["left", "bottom"]].set_visible(False)
    axes.set(title="Aims of motion (○), of streaks (+)")
    axes.legend(loc="upper left", bbox_to_anchor=(-0.02, 1.0), handletextpad=0.2)
    return {
        "streak directions: largest distance of the two aims, px": worst,
        "streak directions: median angle of drawn drops to their aim, degrees": most_turned,
    }


def _drawn_lines(
    population: statistics.Population, k: int, cam: scenes.Camera, size: float = 1.0
) -> tuple[scenes.Float, scenes.Float]:
    """Middles and directions of one class's streaks, from the splats' covariances.

    `size` is a factor on the drops: a ball off the axis is seen stretched, which turns a short
    streak a little; a point is not.
    """
    still = replace(population, sway_m=0 * population.sway_m)
    drops = scenes.field(still, 3)
    resolved = drops.resolve(cam, 50_000)
    reach_m = np.zeros_like(resolved.reach_m)
    reach_m[k] = 6.0
    resolved = replace(resolved, reach_m=reach_m)
    records = drops.particles(cam, 0.1, resolved, scenes.whole(cam))
    records[:, 6:12] *= size**2
    # The turning of the car bends the field; the aim is that of its translation.
    cam = replace(cam, angular_velocity_rad_per_s=np.zeros(3))
    splats = scenes.splats_of(records, cam).astype(float)
    inverse = np.stack([splats[:, [2, 3]], splats[:, [3, 4]]], axis=1)
    spread, axes = np.linalg.eigh(np.linalg.inv(inverse))
    long = spread[:, 1] > 9 * spread[:, 0]
    return splats[long, :2], axes[long, :, 1]


def _unit(vectors: scenes.Float) -> scenes.Float:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _meeting_point(middles: scenes.Float, along: scenes.Float) -> scenes.Float:
    """Point nearest to all lines, least squares."""
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    return np.asarray(np.linalg.lstsq(across, (across * middles).sum(axis=1), rcond=None)[0])
