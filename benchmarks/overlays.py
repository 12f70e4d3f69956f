"""Weather of a frame with depth against the 2D weather of albumentations 2.0.8.

Ours is depth-correct, in linear light, and always returns label, invalid mask, transmittance and
depth beside the picture (there is no option to leave them out); the peers return a picture. What is
meant by 20,000 particles has two readings. "In a box": of 20,000 particles in a box of 18 x 10 x
20 m in front of the camera about 6,500 are in view and drawn. "Drawn": 20,000 are in view and
drawn, in rain and snow dense enough to need that many.

The peers draw what is in the air, so these contenders do, too: every effect on background, glass
and camera is left out. Beside them stand whole renders of heavy weather with all of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from itertools import count
from typing import Any

import albumentations as A
import numpy as np
from numpy.typing import NDArray

from benchmarks.drawn import Drawn, drawn
from benchmarks.report import Row, show
from benchmarks.scene import street
from benchmarks.timing import interleaved
from weather_aug.clip.types import Frame
from weather_aug.edit.ambience import Ambience
from weather_aug.edit.physical.layers import Layers
from weather_aug.render.background import looked_at
from weather_aug.render.compose import render
from weather_aug.render.options import EFFECTS, RenderOptions
from weather_aug.weather import Weather

HEIGHT, WIDTH = 512, 1024
SIZES = ((HEIGHT, WIDTH), (1080, 1920))
FOG = Weather(visibility_m=300.0)
RAIN = Weather.mix(FOG, Weather(rain_mm_per_h=75.0))
SNOW = Weather.mix(FOG, Weather(snow_mm_per_h=2.0))
IN_BOX, IN_VIEW = 6_500, 20_000
READINGS = {IN_BOX: "20k in a box", IN_VIEW: "20k drawn"}
CASES = {
    "fog": (FOG, 0),
    "fog + rain 6.5k": (RAIN, IN_BOX),
    "fog + rain 20k": (RAIN, IN_VIEW),
    "fog + snow 6.5k": (SNOW, IN_BOX),
    "fog + snow 20k": (SNOW, IN_VIEW),
}
WHOLE = {
    "whole rain (heavy)": Weather.rain("heavy"),
    "whole snow (heavy)": Weather.snow("heavy"),
    "whole fog (heavy)": Weather.fog("heavy"),
}
"""Default renders: edited background, air, particles, lamps, spray, glass and camera."""
COPY, FAR_COPY = "copy of the frame, in cache", "copy of the frame, in memory"
FAR_BYTES = 2**27
"""Frames of this many bytes are copied in turns, so that none is still in the cache."""


def peers() -> dict[str, A.BasicTransform | A.Compose]:
    """The peers, newly seeded: they draw their own parameters in every call."""
    fog = partial(A.RandomFog, fog_coef_range=(0.5, 0.8), p=1)
    rain = partial(A.RandomRain, rain_type="heavy", p=1)
    found = {
        "RandomRain (heavy)": rain(),
        "RandomSnow (texture)": A.RandomSnow(method="texture", p=1),
        "RandomFog (0.5-0.8)": fog(),
        "RandomFog + RandomRain": A.Compose([fog(), rain()]),
    }
    for peer in found.values():
        peer.set_random_seed(0)
    return found


def air_only(max_particles: int) -> RenderOptions:
    """The medium and its particles, and nothing else that weather does to a picture."""
    return RenderOptions(max_particles, without=EFFECTS)


def renders(frame: Frame, ambience: Ambience, layers: Layers) -> dict[str, Callable[[], object]]:
    """A call of `render` for each case, of the air alone."""
    call = partial(render, frame, seed=1, ambience=ambience, layers=layers)
    return {
        name: partial(call, weather, options=air_only(budget))
        for name, (weather, budget) in CASES.items()
    }


def whole_renders(
    frame: Frame, ambience: Ambience, layers: Layers | None
) -> dict[str, Callable[[], object]]:
    """A call of `render` for each whole weather; without layers it looks at the frame itself."""
    call = partial(render, frame, seed=1, ambience=ambience, layers=layers)
    return {name: partial(call, weather) for name, weather in WHOLE.items()}


def measure() -> list[dict[str, Any]]:
    """Time ours and theirs in turns at both sizes, and print the ratios."""
    return [_measured(height, width) for height, width in SIZES]


def _measured(height: int, width: int) -> dict[str, Any]:
    frame, ambience = street(height, width)
    layers = looked_at(frame, ambience)
    ours = renders(frame, ambience, layers)
    counts = {name: drawn(run, height, width) for name, run in ours.items() if CASES[name][1] > 0}
    whole = whole_renders(frame, ambience, layers)
    others = {name: partial(peer, image=frame.image) for name, peer in peers().items()}
    others[COPY] = partial(np.copyto, np.empty_like(frame.image), frame.image)
    others[FAR_COPY] = _copies_in_turns(frame.image)
    ms = interleaved(ours | whole | others)
    print(f"\n{height} x {width}: milliseconds, and what is drawn")
    for name, value in ms.items():
        print(f"  {name:30s} {value:8.2f} ms{_count_text(counts.get(name))}")
    shown = show(f"{height} x {width}: against albumentations 2.0.8", ratios(ms))
    return shown | {
        "size": [height, width],
        "ms": ms,
        "drawn": {name: found._asdict() for name, found in counts.items()},
    }


def ratios(ms: Mapping[str, float]) -> list[Row]:
    """The ratios that have targets, particles in both readings; then whole renders, without."""
    rows = [
        Row(
            "fog against RandomFog (0.5-0.8)",
            ms["RandomFog (0.5-0.8)"] / ms["fog"],
            "x faster",
            at_least=150,
        ),
        *(Row(f"fog / {copy}", ms["fog"] / ms[copy], "x", at_most=8) for copy in (COPY, FAR_COPY)),
    ]
    for budget, reading in READINGS.items():
        many = "6.5k" if budget == IN_BOX else "20k"
        rain, snow = ms[f"fog + rain {many}"], ms[f"fog + snow {many}"]
        both, texture = ms["RandomFog + RandomRain"], ms["RandomSnow (texture)"]
        rows += [
            Row(f"fog + rain ({reading}) / RandomRain", rain / ms["RandomRain (heavy)"], "x", 0.8),
            Row(
                f"fog + rain ({reading}) against RandomFog + RandomRain",
                both / rain,
                "x faster",
                at_least=30,
            ),
            Row(
                f"fog + snow ({reading}) against RandomSnow (texture)",
                texture / snow,
                "x faster",
                at_least=10,
            ),
        ]
    slow = ms["RandomSnow (texture)"] + ms["RandomFog (0.5-0.8)"]
    rows += [Row(f"{name} / fog pass", ms[name] / ms["fog"], "x") for name in WHOLE]
    rows += [
        Row(f"{name} against RandomSnow + RandomFog", slow / ms[name], "x faster") for name in WHOLE
    ]
    return rows


def _copies_in_turns(image: NDArray[np.uint8]) -> Callable[[], object]:
    copies = -(-FAR_BYTES // image.nbytes)
    sources = np.stack([image] * copies)
    targets = np.zeros_like(sources)
    turn = count()

    def run() -> None:
        k = next(turn) % copies
        np.copyto(targets[k], sources[k])

    return run


def _count_text(found: Drawn | None) -> str:
    if found is None:
        return ""
    return (
        f"   {found.particles:6d} particles, {found.splats:6d} splats, {found.fragments:8d} "
        "fragments"
    )


if __name__ == "__main__":
    measure()
