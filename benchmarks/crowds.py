"""Many particles at 1080 x 1920: in units of the fog pass, and nanoseconds a particle.

Of the air alone, with no effect on background, glass and camera; beside it whole renders.
"""

from __future__ import annotations

from functools import partial
from typing import Any

from benchmarks.drawn import drawn
from benchmarks.overlays import FOG, RAIN, SNOW, air_only
from benchmarks.report import Row, show
from benchmarks.scene import street
from benchmarks.stages import stage_ms
from benchmarks.timing import interleaved
from weather_aug.render.background import looked_at
from weather_aug.render.compose import render
from weather_aug.render.options import RenderOptions
from weather_aug.weather import Weather

HEIGHT, WIDTH = 1080, 1920
CROWD = 100_000
KINDS = {"rain": RAIN, "snow": SNOW}
"""The overlays' weathers: at their rates more than 500,000 particles are above the threshold."""
EXTREMES = {"rain": Weather.rain("extreme"), "snow": Weather.snow("extreme")}
"""With all that comes with it, on the ground, the glass and the camera."""
MADE = ("enumerate", "shelter", "sort", "project")


def measure() -> dict[str, Any]:
    """Print what 100,000 particles cost."""
    frame, ambience = street(HEIGHT, WIDTH)
    call = partial(render, frame, seed=1, ambience=ambience, layers=looked_at(frame, ambience))

    def run(weather: Weather, budget: int) -> Any:
        return partial(call, weather, options=air_only(budget))

    def whole(weather: Weather) -> Any:
        return partial(call, weather, options=RenderOptions(CROWD))

    runs = {kind: run(weather, CROWD) for kind, weather in KINDS.items()}
    wholes = {f"whole {kind}": whole(weather) for kind, weather in EXTREMES.items()}
    ms = interleaved({"fog": run(FOG, 0)} | runs | wholes)
    rows, counts = [], {}
    for kind, call in runs.items():
        count = drawn(call, HEIGHT, WIDTH)
        counts[kind] = count._asdict()
        spent = stage_ms(call)
        made_ms = sum(spent[name] for name in MADE)
        rows += [
            Row(f"fog + 100k {kind} / fog", ms[kind] / ms["fog"], "x", at_most=12),
            Row(f"  {kind}: drawn", count.particles, "particles"),
            Row(f"  {kind}: fragments", count.fragments, "pixels"),
            Row(f"  {kind}: generation", 1e6 * spent["enumerate"] / count.particles, "ns/particle"),
            Row(
                f"  {kind}: generation + projection",
                1e6 * made_ms / count.particles,
                "ns/particle",
            ),
            Row(
                f"  {kind}: all that particles add",
                1e6 * (ms[kind] - ms["fog"]) / count.particles,
                "ns/particle",
            ),
        ]
    rows += [Row(f"{name} (extreme, 100k) / fog", ms[name] / ms["fog"], "x") for name in wholes]
    title = f"{CROWD} particles at {HEIGHT} x {WIDTH}"
    return show(title, rows) | {"ms": ms, "drawn": counts}


if __name__ == "__main__":
    measure()
