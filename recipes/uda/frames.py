"""Which frames play which role, and what each arm does to the labelled ones."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch.utils.data import DataLoader

import weather_aug as wa
from weather_aug._keys import key_of, uniforms
from weather_aug.transforms.sampler import WeatherSampler
from weather_aug.transforms.sampling import RareClass

os.environ.setdefault("NO_ALBUMENTATIONS_UPDATE", "1")
import albumentations as A

Arm = Literal["none", "photometric", "albumentations", "mixed-2d", "weather_aug"]
SHARE = 0.75  # Of the source pictures that an arm of weathers puts into weather.
CLEAR = wa.WeatherPolicy(types={"clear": 1})
WEATHERS = wa.WeatherPolicy(types={"rain": 1, "snow": 1, "fog": 1}, severity=(0.25, 1.0))


def camvid(folder: Path) -> list[list[Any]]:
    """Source, target, validation: halves of `train`, `val`. Depth comes from the labels of all."""
    half = len(list((folder / "train").glob("*.png"))) // 2
    address = "folder:{0}?images={1}&labels={1}annot&taxonomy=camvid11&frames={2}".format
    parts = (folder, "train", f":{half}"), (folder, "train", f"{half}:"), (folder, "val", ":")
    return [[wa.open_clip(address(*part))] for part in parts]


def streets(folder: Path, count: int, width: int, height: int) -> list[list[Any]]:
    """The same of procedural streets, `count` for each role; their scenes stay in the folder."""
    scenes = []
    for seed in range(3 * count):
        path = folder / f"street-{seed}-{width}x{height}"
        if not path.exists():
            address = f"street:?frames=1&width={width}&height={height}&seed={seed}"
            wa.WeatherScene.build(wa.open_clip(address), path, progress=True)
        scenes.append(wa.WeatherScene.load(path))
    return [scenes[:count], scenes[count : 2 * count], scenes[2 * count :]]


def loaders(source: list[Any], target: list[Any], arm: str, seed: int, method: Any) -> list[Any]:
    """Of a training's crops: the source's, of the same places in all arms, and the target's."""
    pixels = source[0].frame(source[0].keys[0]).image[..., 0].size
    rare = RareClass(0.1, max(1, pixels // 700))  # Trainers: 0.01, and 3,000 of 2 million pixels.
    policy = WEATHERS.with_clear(1 - SHARE) if arm == "weather_aug" else CLEAR
    keys = [key_of("uda role", seed, role) % 2**63 for role in (0, 1)]
    length, crop = method.iterations * method.batch, (method.crop_px, method.crop_px)
    items = (
        wa.WeatherDataset(source, policy, seed=keys[0], crop=crop, sampling=rare, length=length),
        wa.WeatherDataset(target, WEATHERS, seed=keys[1], crop=crop, length=length),
    )
    own = {"batch_size": method.batch, "generator": torch.Generator()}  # Else the global one.
    return [DataLoader(each, sampler=WeatherSampler(each), **own) for each in items]


def augmented(arm: str, pictures: torch.Tensor, key: int) -> torch.Tensor:
    """(B, 3, H, W) uint8 pictures as an arm changes them by hand; `key` decides how."""
    changed = []
    for place, image in enumerate(pictures.permute(0, 2, 3, 1).contiguous().numpy()):
        own = key_of("uda picture", key % 2**63, place)
        applies, kind, veil, half, jitters, blurs = uniforms(own, 6).tolist()
        steps: list[Any] = []
        if arm == "mixed-2d" and applies < SHARE and kind < 1 / 3:
            veil = 0.2 + 0.6 * veil  # The same everywhere: fog that knows no depth.
            image = (image * (1 - veil) + 200 * veil).round().astype(np.uint8)
        elif arm in ("albumentations", "mixed-2d") and applies < SHARE:
            steps = [(A.RandomFog, A.RandomRain, A.RandomSnow)[int(3 * kind)](p=1)]
        if arm == "photometric" or (arm == "mixed-2d" and half < 0.5):
            steps += [A.ColorJitter(*[(0.8, 1.2)] * 3, (-0.2, 0.2), p=1)] * (jitters < 0.8)
            steps += [A.GaussianBlur(0, (0.15, 1.15), p=1)] * (blurs < 0.5)
        for number, step in enumerate(steps):
            step.set_random_seed(key_of("uda transform", own % 2**63, number))
            image = step(image=image)["image"]
        changed.append(image)
    return torch.from_numpy(np.stack(changed)).permute(0, 3, 1, 2)
