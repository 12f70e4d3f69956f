"""Figure 10: the severity scale."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from physics_figures import scenes
from physics_figures.style import BLUE, GREEN, GREY, ORANGE, formula, measured, panels
from weather_aug.weather import Weather


def severity(quick: bool) -> tuple[Figure, dict[str, float]]:
    """The scale: rates, extinctions, and what a surface 50 m away keeps of its light."""
    figure, axes = panels(3, height_in=3.3)
    s = np.linspace(0.02, 1, 60)
    stops = np.array([0.25, 0.5, 0.75, 1.0])
    looks = (("rain", BLUE), ("snow", GREEN), ("fog", ORANGE))
    rates = {"rain": (1.5, 5, 20, 75), "snow": (0.4, 1, 2, 4)}
    for kind, colour in looks[:2]:
        make = getattr(Weather, kind)
        axes[0].plot(s, [getattr(make(v), f"{kind}_mm_per_h") for v in s], color=colour, label=kind)
        axes[0].plot(stops, rates[kind], "k.", ms=6)
    axes[0].set(yscale="log", ylim=(0.003, 200), ylabel="mm/h of water", title="What falls")
    for kind, colour in looks:
        make = getattr(Weather, kind)
        axes[1].plot(s, [1e3 * _per_m(make(v)) for v in s], color=colour, label=kind)
    mist = [Weather.rain(v).mist_per_km for v in s]
    axes[1].plot(s, mist, color=GREY, ls="--", lw=1.2, label="mist in rain")
    axes[1].set(yscale="log", ylim=(0.003, 150), ylabel="extinction, 1/km", title="What dims")
    cam = scenes.camera(96, 64, 72.0, exposure_s=0.005)
    grid = np.linspace(0, 1, 9 if quick else 21)
    worst, rises = 0.0, 0.0
    for kind, colour in looks:
        make = getattr(Weather, kind)
        frame = scenes.wall(cam, 50.0)
        # Height and spray bend the rays' paths apart; the axis is level and has neither.
        weathers = [make(v, spray_per_km=0.0, fog_scale_height_m=np.inf) for v in grid]
        seen = np.array(
            [
                np.mean([scenes.through(frame, w, seed).mean() for seed in range(3)])
                for w in weathers
            ]
        )
        path_m = 50 * scenes.slants(cam)
        expected = np.array([np.exp(-_per_m(w) * path_m).mean() for w in weathers])
        formula(axes[2], grid, expected)
        measured(axes[2], grid, seen, kind, color=colour, ms=4)
        worst = max(worst, float(np.abs(seen - expected).max()))
        rises = max(rises, float(np.diff(seen).max()))
    axes[2].set(ylim=(0, 1.03), ylabel="transmittance", title="Left at 50 m, rendered")
    for panel, place in zip(axes, ("lower right", "lower right", "lower left"), strict=True):
        panel.set(xlabel="severity", xlim=(0, 1.02))
        panel.set_xticks([0, 0.25, 0.5, 0.75, 1], ["0", "light", "moderate", "heavy", "extreme"])
        panel.tick_params(axis="x", labelrotation=35)
        panel.legend(loc=place)
    return figure, {
        "severity: largest deviation of the rendered transmittance at 50 m": worst,
        "severity: largest rise of the transmittance from one step to the next": rises,
    }


def _per_m(weather: Weather) -> float:
    """Extinction by the published laws, written down once more."""
    rain = 0.0
    if weather.rain_mm_per_h > 0:
        x = 6 * 4.1 * weather.rain_mm_per_h**-0.21
        cut = 1 - np.exp(-x) * (x * x + 2 * x + 2) / 2
        rain = 0.1824e-3 * weather.rain_mm_per_h**0.63 * cut
    snow = 0.0
    if weather.snow_mm_per_h > 0:
        # Water that falls in an hour, in grams, over what falls past: 3600 m at 1 m/s.
        snow = 1.5e-3 * (weather.snow_mm_per_h * 1e3 / 3600) / 0.17
    return float(rain + snow + weather.mist_per_km * 1e-3 + np.log(20) / weather.visibility_m)
