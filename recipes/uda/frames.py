"""Which frames play which role, and what each arm does to the labelled ones."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader

import weather_aug as wa
from weather_aug._keys import key_of, uniforms
from weather_aug.transforms.sampler import WeatherSampler
from weather_aug.transforms.sampling import RareClass

os.environ.setdefault("NO_ALBUMENTATIONS_UPDATE", "1")
import albumentations as A

Clips = Sequence[Any]
SHARE = 0.75  # Of the source pictures that an arm of weathers puts into weather.
CLEAR = wa.WeatherPolicy(types={"clear": 1})
WEATHERS = wa.WeatherPolicy(types={"rain": 1, "snow": 1, "fog": 1}, severity=(0.25, 1.0))
ITEMS = 24  # Of an epoch: whole batches of 2, 3, 4, 6, 8 or 12.


def camvid(folder: Path) -> list[Clips]:
    """Source, target and validation: the halves of `train`, which hardly share a drive, and `val`.

    Depth comes from the labels, of targets too; the student sees pictures only.
    """
    half = len(list((folder / "train").glob("*.png"))) // 2
    address = "folder:{0}?images={1}&labels={1}annot&taxonomy=camvid11&frames={2}".format
    parts = (("train", f":{half}"), ("train", f"{half}:"), ("val", ":"))
    return [[wa.open_clip(address(folder, *part))] for part in parts]


def streets(folder: Path, count: int, width: int, height: int) -> list[Clips]:
    """The same of procedural streets, `count` for each role; their scenes stay in the folder."""
    scenes = []
    for seed in range(3 * count):
        path = folder / f"street-{seed}-{width}x{height}"
        if not path.exists():
            address = f"street:?frames=1&width={width}&height={height}&seed={seed}"
            wa.WeatherScene.build(wa.open_clip(address), path)
        scenes.append(wa.WeatherScene.load(path))
    return [scenes[:count], scenes[count : 2 * count], scenes[2 * count :]]


def loaders(source: Clips, target: Clips, arm: str, seed: int, batch: int, px: int) -> list[Any]:
    """Of square crops: the source's, of the same places in all arms, and the target's."""
    pixels = source[0].frame(source[0].keys[0]).image[..., 0].size
    # The trainers' 3,000 pixels are of 2 megapixels.
    rare = RareClass(min_pixels=max(1, pixels // 700))
    policy = WEATHERS.with_clear(1 - SHARE) if arm == "weather_aug" else CLEAR
    ways = ((source, policy, {"sampling": rare}), (target, WEATHERS, {"balanced_weathers": True}))
    made = []
    for role, (clips, weathers, more) in enumerate(ways):
        key = key_of("uda role", seed, role) % 2**63
        items = wa.WeatherDataset(clips, weathers, seed=key, crop=(px, px), length=ITEMS, **more)
        # A loader without a generator of its own draws from the global one.
        own = {"sampler": WeatherSampler(items), "generator": torch.Generator()}
        made.append(DataLoader(items, batch, **own))
    return made


def endless(loader: DataLoader[Any]) -> Iterator[Any]:
    """Batches, epoch after epoch; the loader's sampler knows where it stands."""
    while True:
        yield from loader.sampler.follow(loader)
        loader.sampler.set_epoch(loader.sampler.epoch + 1)


def augmented(arm: str, pictures: torch.Tensor, key: int) -> torch.Tensor:
    """(B, 3, H, W) uint8 pictures as an arm changes them by hand; `key` decides how."""
    each = enumerate(pictures.permute(0, 2, 3, 1).contiguous().numpy())
    changed = [_changed(arm, image, key_of("uda picture", key % 2**63, i)) for i, image in each]
    return torch.from_numpy(np.stack(changed)).permute(0, 3, 1, 2)


def _changed(arm: str, image: Any, key: int) -> Any:
    applies, kind, veil, half, jitters, blurs = uniforms(key, 6)
    steps = []
    if arm == "mixed-2d" and applies < SHARE and kind < 1 / 3:
        # The same share of airlight everywhere: fog that knows no depth.
        veil = 0.2 + 0.6 * veil
        image = (image * (1 - veil) + 200 * veil).round().astype(np.uint8)
    elif arm in ("albumentations", "mixed-2d") and applies < SHARE:
        steps.append((A.RandomFog, A.RandomRain, A.RandomSnow)[int(3 * kind)](p=1))
    if arm == "photometric" or (arm == "mixed-2d" and half < 0.5):
        # As in DACS: colours four times in five, blur every second time.
        steps += [A.ColorJitter(*[(0.8, 1.2)] * 3, (-0.2, 0.2), p=1)] * int(jitters < 0.8)
        steps += [A.GaussianBlur(0, (0.15, 1.15), p=1)] * int(blurs < 0.5)
    for place, step in enumerate(steps):
        step.set_random_seed(key_of("uda transform", key % 2**63, place))
        image = step(image=image)["image"]
    return image
