"""Pre-train the small model on pictures of streets, and write it in the layout of diffusers."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from small_editor.model import SD_TURBO_SCHEDULE, Parts, Sizes, fresh
from torch.nn import functional

from weather_aug._files import write_whole
from weather_aug._keys import key_of
from weather_aug.clip.images import read_image
from weather_aug.edit.diffusion.one_step import LAST_STEP, latent_of_noise
from weather_aug.edit.diffusion.spec import PROMPTS

ARRIVED, ARRIVED_COPY = 0.05, 0.5
"""Weights of the squared error of the latent that one step arrives at, from noise and from a
copy."""
CARD = "model_card.json"
NOTE = (
    "A small stand-in of SD-Turbo's shape, pre-trained on procedural streets by "
    "recipes/07_small_diffusion_editor.py. It knows no real picture and is of use only to show "
    "that training and editing work."
)


@dataclass(frozen=True)
class Schedule:
    """How long, on how much."""

    vae_steps: int = 4000
    unet_steps: int = 3000
    batch: int = 8
    crop_px: tuple[int, int] = (48, 80)
    """(height, width) of what the VAE sees of a picture."""
    vae_rate: float = 2e-3
    unet_rate: float = 1e-3
    divergence: float = 1e-4
    """Weight of the VAE's KL term, per number of the latent."""
    tints: float = 4.0
    """Weight of the VAE's error of colours: most of a street is grey, and a small network that is
    not asked for the rest leaves it away."""
    one_step: float = 0.125
    """Share of the UNet's items that start from pure noise."""
    copied: float = 0.25
    """Share of the UNet's items that see at the last time step, in place of noise, the very latent
    that they are to arrive at: what one-step editing starts from. SD-Turbo can copy by its size;
    a small model has to practise it, as the step enlarges its errors fifteen times."""


@dataclass(frozen=True, eq=False)
class Pictures:
    """All pictures of a folder of pairs, with what they show."""

    images: torch.Tensor
    """(N, 3, H, W) uint8 sRGB."""
    styles: tuple[str, ...]
    """Of each."""


def read_pictures(root: Path, split: str = "train", limit: int | None = None) -> Pictures:
    """Pictures of all weathers in `{clear,rain,snow,fog}/SPLIT`."""
    images, styles = [], []
    for style in PROMPTS:
        for path in sorted((root / style / split).glob("*.png"))[:limit]:
            images.append(torch.from_numpy(np.array(read_image(path))).permute(2, 0, 1))
            styles.append(style)
    return Pictures(torch.stack(images), tuple(styles))


def small_model(
    folder: Path,
    pictures: Pictures,
    *,
    sizes: Sizes | None = None,
    schedule: Schedule | None = None,
    seed: int = 0,
) -> Path:
    """Build and pre-train a model, and save it.

    Args:
        folder: To write to, in the layout of diffusers, with a card that says what it is.
        pictures: To learn from.
        sizes: Of the networks.
        schedule: How long.
        seed: Of weights and draws.

    Returns:
        The folder.
    """
    sizes, schedule = sizes or Sizes(), schedule or Schedule()
    parts = fresh(sizes, seed)
    reconstruction = train_vae(parts, pictures, schedule, seed)
    parts.vae.eval().requires_grad_(False)
    latents = encoded(parts.vae, pictures.images)
    scale = float(1 / latents.std())
    parts.vae.register_to_config(scaling_factor=scale)
    noise = train_unet(parts, latents * scale, pictures.styles, schedule, seed)
    _save(parts, folder)
    card = {
        "what": NOTE,
        "parameters": parts.parameters(),
        "sizes": asdict(sizes),
        "schedule": asdict(schedule),
        "seed": seed,
        "pictures": len(pictures.styles),
        "vae_l1_sRGB": reconstruction,
        "unet_noise_mse": noise,
        "licence": "as this library's",
    }
    write_whole(folder / CARD, json.dumps(card, indent=1).encode() + b"\n")
    return folder


def train_vae(parts: Parts, pictures: Pictures, schedule: Schedule, seed: int) -> float:
    """Teach the VAE to give pictures back; mean error of the last steps, in [0, 1]."""
    generator = torch.Generator().manual_seed(key_of("small.vae", seed) % 2**63)
    recent = 0.0
    parts.vae.to(memory_format=torch.channels_last)
    for step, optimiser in _steps([parts.vae], schedule.vae_steps, schedule.vae_rate):
        images = _crops(pictures.images, schedule, generator)
        posterior = parts.vae.encode(images).latent_dist
        spread = torch.randn(posterior.mean.shape, generator=generator)
        out = parts.vae.decode(posterior.mean + posterior.std * spread).sample
        error = functional.l1_loss(out, images)
        divergence = posterior.kl().mean() / posterior.mean[0].numel()
        loss = (
            error
            + _slopes(out, images)
            + 4 * _tints(out, images)
            + schedule.divergence * divergence
        )
        _descend(loss, optimiser, [parts.vae])
        recent += 0.02 * (error.item() / 2 - recent) if step else error.item() / 2
        _report("vae", step, schedule.vae_steps, f"L1 {recent:.4f}")
    return recent


def train_unet(
    parts: Parts, latents: torch.Tensor, styles: Sequence[str], schedule: Schedule, seed: int
) -> float:
    """Teach the UNet, with its text encoder, to see the noise in latents; last steps' error."""
    generator = torch.Generator().manual_seed(key_of("small.unet", seed) % 2**63)
    alpha_bars = _alpha_bars()
    alpha_bar = float(alpha_bars[LAST_STEP])
    tokens = _tokens(parts, [PROMPTS[style] for style in PROMPTS])
    rows = torch.tensor([list(PROMPTS).index(style) for style in styles])
    trained = [parts.unet, parts.text_encoder]
    recent = copy = 0.0
    copies = torch.tensor(0.0)
    for step, optimiser in _steps(trained, schedule.unet_steps, schedule.unet_rate):
        chosen = torch.randint(len(latents), (schedule.batch,), generator=generator)
        clean = _mirrored(latents[chosen], generator)
        times = torch.randint(LAST_STEP + 1, (schedule.batch,), generator=generator)
        draw = torch.rand(schedule.batch, generator=generator)
        once = draw < schedule.one_step + schedule.copied
        copied = draw < schedule.copied
        times = torch.where(once, LAST_STEP, times)
        noise = torch.randn(clean.shape, generator=generator)
        share = alpha_bars[times][:, None, None, None].float()
        seen = share.sqrt() * clean + (1 - share).sqrt() * noise
        seen = torch.where(copied[:, None, None, None], clean, seen)
        noise = (seen - share.sqrt() * clean) / (1 - share).sqrt()
        hidden = parts.text_encoder(tokens)[0][rows[chosen]]
        found = parts.unet(seen, times, encoder_hidden_states=hidden).sample
        loss = error = functional.mse_loss(found, noise)
        if once.any():
            off = latent_of_noise(seen[once], found[once], alpha_bar) - clean[once]
            weight = torch.where(copied[once], ARRIVED_COPY, ARRIVED)[:, None, None, None]
            loss = loss + (weight * off.square()).mean() * once.sum() / schedule.batch
            copies = (off.square().mean((1, 2, 3)) * copied[once]).sum() / copied.sum().clamp(min=1)
        _descend(loss, optimiser, trained)
        recent += 0.02 * (error.item() - recent) if step else error.item()
        copy += 0.05 * (copies.item() - copy)
        text = f"noise MSE {recent:.4f}, latent MSE of a copy {copy:.4f}"
        _report("unet", step, schedule.unet_steps, text)
    return recent


@torch.inference_mode()
def encoded(vae: Any, images: torch.Tensor) -> torch.Tensor:
    """(N, 4, h, w) means of the latents of (N, 3, H, W) uint8 pictures."""
    parts = [vae.encode(_tensor(part)).latent_dist.mean for part in images.split(16)]
    return torch.cat(parts).contiguous().clone()


def _steps(
    networks: Sequence[Any], count: int, rate: float
) -> Iterator[tuple[int, torch.optim.Optimizer]]:
    """Numbers of steps with an optimiser whose rate rises, then falls as a cosine."""
    parameters = [p for network in networks for p in network.train().parameters()]
    optimiser = torch.optim.AdamW(parameters, lr=rate, weight_decay=1e-3)
    for step in range(count):
        rise = min(1.0, (step + 1) / min(100, count))
        fall = 0.5 * (1 + math.cos(math.pi * step / count))
        for group in optimiser.param_groups:
            group["lr"] = rate * rise * fall
        yield step, optimiser


def _descend(loss: torch.Tensor, optimiser: torch.optim.Optimizer, networks: Sequence[Any]) -> None:
    optimiser.zero_grad()
    loss.backward()
    parameters = [p for network in networks for p in network.parameters()]
    torch.nn.utils.clip_grad_norm_(parameters, 1.0)
    optimiser.step()


def _crops(images: torch.Tensor, schedule: Schedule, generator: torch.Generator) -> torch.Tensor:
    """(batch, 3, h, w) parts of pictures drawn at random, in [-1, 1]."""
    height, width = schedule.crop_px
    _, _, rows, columns = images.shape
    shape = (schedule.batch,)
    picks = torch.randint(len(images), shape, generator=generator).tolist()
    tops = torch.randint(rows - height + 1, shape, generator=generator).tolist()
    lefts = torch.randint(columns - width + 1, shape, generator=generator).tolist()
    parts = [
        images[pick, :, top : top + height, left : left + width]
        for pick, top, left in zip(picks, tops, lefts, strict=True)
    ]
    return _mirrored(_tensor(torch.stack(parts)), generator)


def _mirrored(batch: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    turned = torch.rand(len(batch), generator=generator) < 0.5
    return torch.where(turned[:, None, None, None], batch.flip(3), batch)


def _slopes(out: torch.Tensor, images: torch.Tensor) -> torch.Tensor:
    """How far differences between neighbouring pixels are off: L1 alone leaves outlines soft."""
    across = functional.l1_loss(out.diff(dim=3), images.diff(dim=3))
    return across + functional.l1_loss(out.diff(dim=2), images.diff(dim=2))


def _tints(out: torch.Tensor, images: torch.Tensor) -> torch.Tensor:
    """How far colours are off, lightness left out."""
    off = functional.avg_pool2d(out - images, 4)
    return (off - off.mean(1, keepdim=True)).abs().mean()


def _tensor(images: torch.Tensor) -> torch.Tensor:
    return (images.float() / 127.5 - 1).contiguous(memory_format=torch.channels_last)


def _alpha_bars() -> torch.Tensor:
    from diffusers import DDPMScheduler

    keep = {k: v for k, v in SD_TURBO_SCHEDULE.items() if k.startswith(("beta", "num", "pred"))}
    return DDPMScheduler(**keep).alphas_cumprod.double()


def _tokens(parts: Parts, prompts: Sequence[str]) -> torch.Tensor:
    found = parts.tokenizer(
        list(prompts),
        padding="max_length",
        max_length=parts.tokenizer.model_max_length,
        truncation=True,
        return_tensors="pt",
    )
    ids: torch.Tensor = found.input_ids
    return ids


def _save(parts: Parts, folder: Path) -> None:
    from diffusers import EulerDiscreteScheduler, StableDiffusionPipeline

    parts = replace(parts, vae=parts.vae.to(memory_format=torch.contiguous_format))
    pipeline = StableDiffusionPipeline(
        vae=parts.vae.eval(),
        text_encoder=parts.text_encoder.eval(),
        tokenizer=parts.tokenizer,
        unet=parts.unet.eval(),
        scheduler=EulerDiscreteScheduler(**SD_TURBO_SCHEDULE),
        safety_checker=None,
        feature_extractor=None,
        requires_safety_checker=False,
    )
    pipeline.save_pretrained(folder, safe_serialization=True)


def _report(what: str, step: int, count: int, text: str) -> None:
    if (step + 1) % 100 == 0 or step + 1 == count:
        print(f"{what} {step + 1}/{count}: {text}", flush=True)
