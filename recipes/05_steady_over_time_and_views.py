"""Is the edited background as steady as the recorded one, over time and between cameras?

python recipes/05_steady_over_time_and_views.py scenes/kitti02 scenes/ddad02

Prints the warp error of the clear clip, of its weathers, and their ratio. What moves by nature is
left out: particles, rings on water, spray, what is on the glass and in the sensor; --without alone
leaves out only the particles. Without scenes a small procedural street is built.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np

import weather_aug as wa
from weather_aug.render.options import EFFECTS
from weather_aug.scores.warp import WarpError, correspondence

PROMISE, MIN_SHARE = 1.1, 0.01
"""An edited background's error is at the most 1.1 times the clear one's; cameras that have less
than 1 % in common do not overlap."""
MOVING = ("ripples", "spray", "drops", "wipers", "lens_veil", "noise", "glare", "compression")
"""Not of the street: these move with time, the glass or the sensor."""
WEATHERS = {
    "wet road": lambda s: wa.Weather.rain(s, falling=False),
    "fresh snow": lambda s: wa.Weather.snow(s, falling=False),
    "overcast": lambda s: wa.Weather(overcast=wa.Weather.rain(s).overcast),
    "fog": wa.Weather.fog,
    "rain": wa.Weather.rain,
    "snowfall": wa.Weather.snow,
}

Pair = tuple[wa.FrameKey, wa.FrameKey]


def over_time(scene: wa.WeatherScene) -> Iterator[Pair]:
    """Consecutive frames of each camera."""
    for camera in scene.cameras:
        yield from pairwise(key for key in scene.keys if key.camera == camera)


def between_cameras(scene: wa.WeatherScene) -> Iterator[Pair]:
    """All pairs of cameras at each moment."""
    yield from (pair for pair in combinations(scene.keys, 2) if pair[0][0] == pair[1][0])


def errors(
    scene: wa.WeatherScene,
    pairs: Sequence[Pair],
    weathers: dict[str, wa.Weather],
    sky: str,
    options: wa.RenderOptions,
) -> dict[str, list[WarpError]]:
    """Warp errors of each weather, the clear one first, all of the same pixels."""
    found: dict[str, list[WarpError]] = {name: [] for name in ("clear", *weathers)}
    for pair in pairs:
        frames = [scene.frame(key) for key in pair]
        same = correspondence(*frames, sky=sky)
        if same.share < MIN_SHARE:
            continue
        found["clear"].append(same.error(*(frame.image for frame in frames)))
        for name, weather in weathers.items():
            shots = (scene.render(key, weather, options=options).image for key in pair)
            found[name].append(same.error(*shots))
    return found


def report(found: dict[str, list[WarpError]]) -> dict[str, float]:
    """Print a table; the ratio edited / clear of the mean absolute error, by weather."""
    clear = found["clear"]
    mean = {
        name: [np.mean([getattr(e, what) for e in each]) for what in ("absolute", "squared")]
        for name, each in found.items()
    }
    contrast = {name: np.mean([e.contrast for e in each]) for name, each in found.items()}
    print(f"  {len(clear)} pairs, {np.mean([e.share for e in clear]):.0%} of the pixels compared")
    print(f"  {'':16}absolute  ratio  per contrast  squared  ratio")
    ratios = {}
    for name in found:
        ratio, squared = (a / b for a, b in zip(mean[name], mean["clear"], strict=True))
        relative = ratio * contrast["clear"] / contrast[name]
        row = f"  {name:16}{mean[name][0]:8.4f}{ratio:7.2f}{relative:14.2f}"
        kept = "" if name == "clear" else "   held" if ratio <= PROMISE else "   NOT HELD"
        print(f"{row}{mean[name][1]:9.5f}{squared:7.2f}{kept}")
        ratios[name] = float(ratio)
    return ratios


def main() -> None:
    """Report on the scenes given, or on a small street."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", type=Path, nargs="*")
    parser.add_argument("--weathers", nargs="+", choices=WEATHERS, default=list(WEATHERS))
    parser.add_argument("--severity", default="heavy")
    parser.add_argument("--without", nargs="*", choices=EFFECTS, default=MOVING)
    parser.add_argument("--sky", choices=["out", "rotation"], default="out")
    parser.add_argument("--times", type=int, nargs="*", help="first time indices; all if not given")
    given = parser.parse_args()
    weathers = {name: WEATHERS[name](given.severity) for name in given.weathers}
    options = wa.RenderOptions(max_particles=0, without=tuple(given.without))
    with tempfile.TemporaryDirectory() as folder:
        scenes = [wa.WeatherScene.load(path) for path in given.scenes]
        if not scenes:
            clip = wa.open_clip("street:?frames=2&width=320&height=180")
            scenes = [wa.WeatherScene.build(clip, Path(folder) / "street")]
        for scene in scenes:
            for name, pairs in (("over time", over_time), ("between cameras", between_cameras)):
                chosen = [p for p in pairs(scene) if not given.times or p[0][0] in given.times]
                found = errors(scene, chosen, weathers, given.sky, options)
                print(f"{scene.name}, {name}")
                report(found) if found["clear"] else print("  nothing that two pictures share")


if __name__ == "__main__":
    main()
