"""The torch renderer against the compiled one at 512 x 1024; on CUDA too where there is one.

`python -m benchmarks.batch`. On a CPU the compiled renderer is the one to use; torch is for batches
that live on a GPU and for gradients.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import torch

from benchmarks.overlays import CASES, HEIGHT, WIDTH
from benchmarks.scene import street
from benchmarks.timing import interleaved
from weather_aug.render.batch import RenderedBatch, render_batch
from weather_aug.render.compose import render
from weather_aug.render.options import RenderOptions

BATCH = 4


def main() -> None:
    """Print milliseconds a frame and their ratios to the compiled renderer."""
    torch.set_num_threads(1)
    frame, ambience = street(HEIGHT, WIDTH)
    print(f"\n{HEIGHT} x {WIDTH}, one core, medians of interleaved rounds, ms a frame")
    for name, (weather, count) in CASES.items():
        options = RenderOptions(count)
        compiled = partial(render, frame, weather, seed=1, ambience=ambience, options=options)
        runs = {"compiled": compiled, "torch": _batch(frame, weather, ambience, options, "cpu", 1)}
        ms = interleaved(runs)
        line = f"  {name:18s} compiled {ms['compiled']:7.1f}   torch {ms['torch']:7.1f}"
        line += f"   ratio {ms['torch'] / ms['compiled']:6.2f}"
        if torch.cuda.is_available():
            on_gpu = _batch(frame, weather, ambience, options, "cuda", BATCH)
            gpu_ms = _wall_ms(on_gpu) / BATCH
            line += f"   cuda {gpu_ms:7.2f}   ratio {gpu_ms / ms['compiled']:6.2f}"
        print(line, flush=True)


def _batch(frame, weather, ambience, options, device, count) -> Callable[[], RenderedBatch]:
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
        labels=labels,
        options=options,
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
