"""The torch renderer against the compiled one at 512 x 1024; on CUDA too where there is one.

`python -m benchmarks.batch`. "batch" draws particles with the compiled kernels, as it does on a CPU
if not told otherwise; "torch" with torch alone. All draw what a batch draws (no lamps, glass and
sensor) and are given what the editor knows of the picture, as from a scene. On a CPU `render` is
the one to use; a batch is for pictures that live on a GPU and for gradients.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch

from benchmarks.overlays import CASES, HEIGHT, WIDTH
from benchmarks.scene import street
from benchmarks.timing import interleaved
from weather_aug.clip.types import Frame
from weather_aug.edit.ambience import Ambience
from weather_aug.edit.physical.layers import Layers
from weather_aug.render.background import looked_at
from weather_aug.render.batch import BATCH_OPTIONS, RenderedBatch, render_batch
from weather_aug.render.compose import render
from weather_aug.render.options import RenderOptions
from weather_aug.weather import Weather

BATCH = 4


def main() -> None:
    """Print milliseconds a frame and their ratios to the compiled renderer."""
    torch.set_num_threads(1)
    frame, ambience = street(HEIGHT, WIDTH)
    layers = looked_at(frame, ambience)
    print(f"\n{HEIGHT} x {WIDTH}, one core, medians of interleaved rounds, ms a frame")
    for name, (weather, count) in CASES.items():
        options = replace(BATCH_OPTIONS, max_particles=count)
        batch = partial(_batch, frame, layers, weather, ambience, options)
        alone = {"ambience": ambience, "layers": layers, "options": options}
        runs: dict[str, Callable[[], object]] = {
            "render": partial(render, frame, weather, seed=1, **alone),
            "batch": batch("cpu", 1),
            "torch": batch("cpu", 1, splatting="torch"),
        }
        ms = interleaved(runs)
        if torch.cuda.is_available():
            ms["cuda"] = _wall_ms(batch("cuda", BATCH)) / BATCH
        times = "".join(f"  {way} {time_ms:6.1f}" for way, time_ms in ms.items())
        ratios = "".join(
            f"  {way} {time_ms / ms['render']:5.2f}"
            for way, time_ms in ms.items()
            if way != "render"
        )
        print(f"  {name:16s}{times}   over render:{ratios}", flush=True)


def _batch(
    frame: Frame,
    layers: Layers,
    weather: Weather,
    ambience: Ambience,
    options: RenderOptions,
    device: str,
    count: int,
    splatting: str = "auto",
) -> Callable[[], RenderedBatch]:
    image = torch.from_numpy(frame.image).permute(2, 0, 1).float() / 255
    planes = (image, torch.from_numpy(frame.depth_m), torch.from_numpy(frame.label))
    images, depth_m, labels = (torch.stack([plane] * count).to(device) for plane in planes)
    return partial(
        render_batch,
        images,
        depth_m,
        cameras=[frame.camera] * count,
        weathers=[weather] * count,
        seeds=[1] * count,
        ambiences=[ambience] * count,
        times_s=[frame.time_s] * count,
        layers=[layers] * count,
        labels=labels,
        options=options,
        splatting=splatting,
    )


def _wall_ms(run: Callable[[], object], rounds: int = 20) -> float:
    run()
    torch.cuda.synchronize()
    start = time.perf_counter()
    for _ in range(rounds):
        run()
    torch.cuda.synchronize()
    return 1e3 * (time.perf_counter() - start) / rounds


if __name__ == "__main__":
    main()
