"""Time and memory of the diffusion editor at SD-Turbo's true size, with random weights.

python -m benchmarks.diffusion            one frame at 512x512, 768x512 and 1920x1080, a training
                                          step at 256x256 and 512x512; each in a process of its own
python -m benchmarks.diffusion edit 512 512
python -m benchmarks.diffusion train 512 512

Random weights cost what trained ones do. Memory is the process's peak, everything included.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from weather_aug.edit.diffusion.adapted import AdaptedModel
from weather_aug.edit.diffusion.base import Base
from weather_aug.edit.diffusion.objectives import PairedWeights, paired_losses
from weather_aug.edit.diffusion.spec import AdapterSpec

FRAMES = ((512, 512), (768, 512), (1920, 1080))
STEPS = ((256, 256), (512, 512))
UNET = dict(
    sample_size=64,
    block_out_channels=(320, 640, 1280, 1280),
    cross_attention_dim=1024,
    attention_head_dim=(5, 10, 20, 20),
    use_linear_projection=True,
)
VAE = dict(
    down_block_types=("DownEncoderBlock2D",) * 4,
    up_block_types=("UpDecoderBlock2D",) * 4,
    block_out_channels=(128, 256, 512, 512),
    layers_per_block=2,
    latent_channels=4,
    sample_size=512,
)
"""Configurations of stabilityai/sd-turbo."""
TOKENS, WIDTH = 77, 1024


@dataclass(frozen=True, eq=False)
class RandomBase(Base):
    """Of the true shape; prompts are random, since the text encoder is not there when editing."""

    def embed(self, prompts: Any) -> torch.Tensor:
        """(N, 77, 1024)."""
        return torch.randn(len(prompts), TOKENS, WIDTH)


def random_base() -> RandomBase:
    """SD-Turbo's shapes; takes half a minute."""
    from diffusers import AutoencoderKL, DDPMScheduler, UNet2DConditionModel

    torch.manual_seed(0)
    schedule = DDPMScheduler(beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear")
    return RandomBase(
        "random SD-Turbo",
        "",
        "random",
        Path(),
        UNet2DConditionModel(**UNET).eval().requires_grad_(False),
        AutoencoderKL(**VAE).eval().requires_grad_(False),
        schedule.alphas_cumprod.double(),
    )


def edit(width: int, height: int) -> None:
    """One frame alone, labels in, picture out."""
    model = AdaptedModel(random_base(), AdapterSpec()).frozen()
    factor = model.base.factor
    width, height = -(-width // factor) * factor, -(-height // factor) * factor
    image = torch.rand(1, 3, height, width) * 2 - 1
    label = torch.zeros(1, height, width, dtype=torch.long)
    before = _peak_gib()
    with torch.inference_mode():
        start, busy_s = time.perf_counter(), time.process_time()
        encoded = model.encode(image, label)
        encoded_s = time.perf_counter() - start
        with model.styled("snow") as prompt:
            noise = model.noise(encoded.latent, prompt)
        unet_s = time.perf_counter() - start - encoded_s
        model.decode(model.latent_of(encoded.latent, noise), encoded.skips)
    total_s = time.perf_counter() - start
    millions = sum(p.numel() for p in model.parameters()) / 1e6
    _say(
        f"edit {width}x{height}: {total_s:.1f} s a frame, {time.process_time() - busy_s:.1f} s of "
        f"processor (encoder {encoded_s:.1f}, UNet "
        f"{unet_s:.1f}, decoder {total_s - encoded_s - unet_s:.1f}), peak {_peak_gib():.1f} GiB "
        f"({before:.1f} before; {millions:.0f} M parameters, float32, "
        f"{torch.get_num_threads()} threads)"
    )


def train(width: int, height: int) -> None:
    """One step of the paired objective, batch of one, activations recomputed."""
    model = AdaptedModel(random_base(), AdapterSpec())
    model.checkpointing = True
    model.unet.enable_gradient_checkpointing()
    model.train()
    optimiser = torch.optim.AdamW(list(model.trained().values()), lr=5e-6)
    label = torch.zeros(1, height, width, dtype=torch.long)
    batch = {
        "source": torch.rand(1, 3, height, width) * 2 - 1,
        "target": torch.rand(1, 3, height, width) * 2 - 1,
        "source_label": label,
        "target_label": label,
        "style": "snow",
        "aligned": True,
    }
    before = _peak_gib()
    start, busy_s = time.perf_counter(), time.process_time()
    losses = paired_losses(model, batch, PairedWeights(perceptual=0), None, torch.Generator())
    torch.stack(list(losses.values())).sum().backward()
    optimiser.step()
    learnt = sum(p.numel() for p in model.trained().values()) / 1e6
    _say(
        f"train {width}x{height}: {time.perf_counter() - start:.1f} s a step, "
        f"{time.process_time() - busy_s:.1f} s of processor, peak {_peak_gib():.1f} GiB "
        f"({before:.1f} before; {learnt:.0f} M learnt in four sets of rank 128, one acts; batch 1, "
        "float32, recomputed activations)"
    )


def main() -> None:
    """Each size in a process of its own, since a peak never falls."""
    if len(sys.argv) == 4:
        {"edit": edit, "train": train}[sys.argv[1]](int(sys.argv[2]), int(sys.argv[3]))
        return
    jobs = [("edit", *size) for size in FRAMES] + [("train", *size) for size in STEPS]
    for job in jobs:
        done = subprocess.run(
            [sys.executable, "-m", "benchmarks.diffusion", *map(str, job)], env=os.environ
        )
        if done.returncode:
            _say(f"{job}: ended with {done.returncode}; most likely out of memory")


def _peak_gib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def _say(text: str) -> None:
    print(text, flush=True)


if __name__ == "__main__":
    main()
