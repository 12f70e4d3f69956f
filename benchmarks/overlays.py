"""Weather of a frame with depth against the 2D weather of albumentations 2.0.8, at 512 x 1024.

Ours is depth-correct, in linear light, and returns transmittance, depth, labels and an invalid
mask; the peers return a picture. "20k" is the number of particles that are visible and drawn
(`max_particles`), in rain and snow dense enough to need that many; of 20k particles in a box around
the camera about 6.5k would be in view.
"""

from __future__ import annotations

from functools import partial

import albumentations as A
import numpy as np

from benchmarks.scene import street
from benchmarks.timing import interleaved
from weather_aug.render.compose import render
from weather_aug.render.options import RenderOptions
from weather_aug.weather import Weather

HEIGHT, WIDTH = 512, 1024
FOG = Weather(visibility_m=300.0)
RAIN = Weather.mix(FOG, Weather(rain_mm_per_h=75.0))
SNOW = Weather.mix(FOG, Weather(snow_mm_per_h=2.0))
CASES = {
    "fog": (FOG, 0),
    "fog + rain 6.5k": (RAIN, 6_500),
    "fog + rain 20k": (RAIN, 20_000),
    "fog + snow 20k": (SNOW, 20_000),
}
PEERS = {
    "RandomRain (heavy)": A.RandomRain(rain_type="heavy", p=1),
    "RandomSnow (texture)": A.RandomSnow(method="texture", p=1),
    "RandomFog (0.5-0.8)": A.RandomFog(fog_coef_range=(0.5, 0.8), p=1),
    "RandomFog + RandomRain": A.Compose(
        [A.RandomFog(fog_coef_range=(0.5, 0.8), p=1), A.RandomRain(rain_type="heavy", p=1)]
    ),
}
PAIRS = (
    ("fog", "RandomFog (0.5-0.8)", ""),
    ("fog + rain 6.5k", "RandomRain (heavy)", ""),
    ("fog + rain 20k", "RandomRain (heavy)", "first target: at most 1.0"),
    ("fog + rain 20k", "RandomFog + RandomRain", ""),
    ("fog + snow 20k", "RandomSnow (texture)", ""),
    ("fog", "copy of the frame", ""),
)


def main() -> None:
    """Time ours and theirs in turns and print the ratios."""
    frame, ambience = street(HEIGHT, WIDTH)
    image = frame.image
    target = np.empty_like(image)
    contenders = {
        name: partial(
            render,
            frame,
            weather,
            seed=1,
            ambience=ambience,
            options=RenderOptions(budget),
        )
        for name, (weather, budget) in CASES.items()
    }
    contenders |= {name: partial(peer, image=image) for name, peer in PEERS.items()}
    contenders["copy of the frame"] = partial(np.copyto, target, image)
    ms = interleaved(contenders)
    print(f"\n{HEIGHT} x {WIDTH}, one core, medians of interleaved rounds")
    for name, value in ms.items():
        print(f"  {name:26s} {value:8.2f} ms")
    print("ratios (ours / peer)")
    for ours, peer, note in PAIRS:
        ratio = ms[ours] / max(ms[peer], 1e-3)
        print(f"  {ours:16s} / {peer:24s} {ratio:8.3f}  {note}")


if __name__ == "__main__":
    main()
