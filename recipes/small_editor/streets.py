"""Procedural streets as pictures: clear, with wet roads, under snow, in fog, and their labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import weather_aug as wa
from weather_aug._files import write_whole
from weather_aug._png import png_bytes
from weather_aug.clip.street import StreetClip
from weather_aug.edit.diffusion.pair_lists import folder_pairs
from weather_aug.edit.diffusion.pairs import PairList, with_clear, write_pairs
from weather_aug.scene.styles import STYLE_SEVERITY, style_weather

UInt8 = NDArray[np.uint8]

STYLES = ("rain", "snow", "fog")
NOTHING_MOVING = (
    *("ripples", "lamps", "spray", "drops", "wipers", "lens_veil", "exposure", "noise", "glare"),
    "compression",
)
"""Effects that are no part of a background: they move with time, the glass or the sensor."""
BACKGROUND = wa.RenderOptions(max_particles=0, without=NOTHING_MOVING)


@dataclass(frozen=True, eq=False)
class Sparse:
    """Every `step`-th time of a street, so that pictures differ; a `Clip`."""

    street: StreetClip
    step: int

    @property
    def name(self) -> str:
        """Of the street."""
        return self.street.name

    @property
    def cameras(self) -> tuple[str, ...]:
        """Of the street."""
        return self.street.cameras

    @property
    def keys(self) -> tuple[wa.FrameKey, ...]:
        """Of the frames that are kept."""
        return tuple(key for key in self.street.keys if key.time_index % self.step == 0)

    @property
    def up_world(self) -> NDArray[np.float64]:
        """Of the street."""
        return self.street.up_world

    def frame(self, key: wa.FrameKey) -> wa.Frame:
        """One of the street's."""
        return self.street.frame(key)


def target_weather(style: str) -> wa.Weather:
    """What an editor of backgrounds is to make of a street.

    Of rain and snow it is what lies on the ground and covers the sky. Fog is nothing but the air,
    so its background is the street seen through it, under its sky, without a particle.
    """
    if style == "fog":
        return replace(wa.Weather.fog(STYLE_SEVERITY), lamps=0.0)
    weather = style_weather(style)
    if weather is None:
        raise ValueError(f"{style} is no style")
    return weather


def target(scene: wa.WeatherScene, key: wa.FrameKey, style: str) -> UInt8:
    """(H, W, 3) background of a frame as the physical editor gives it."""
    return scene.render(key, target_weather(style), options=BACKGROUND).image


def street_scene(
    folder: Path, seed: int, times: int, step: int, size_px: tuple[int, int]
) -> wa.WeatherScene:
    """The scene of a street; read if it is there already.

    Args:
        folder: Where scenes lie.
        seed: Which street.
        times: How many moments of three cameras.
        step: Tenths of a second between them.
        size_px: (width, height) of the pictures.
    """
    width, height = size_px
    path = folder / f"street-{seed}-{times}x{step}-{width}x{height}"
    if path.is_dir():
        return wa.WeatherScene.load(path)
    clip = Sparse(StreetClip((times - 1) * step + 1, width, height, seed), step)
    return wa.WeatherScene.build(clip, path)


def write_pictures(root: Path, scenes: Sequence[wa.WeatherScene], split: str) -> int:
    """Write pictures as `{clear,rain,snow,fog,labels}/SPLIT/NAME.png`; how many clear ones."""
    count = 0
    for scene in scenes:
        for key in scene.keys:
            frame = scene.frame(key)
            if frame.label is None:
                raise ValueError(f"{scene.name}: frame {key} has no label")
            pictures = {"clear": frame.image, "labels": frame.label}
            pictures |= {style: target(scene, key, style) for style in STYLES}
            for kind, picture in pictures.items():
                path = root / kind / split / f"{scene.name}_{key}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                write_whole(path, png_bytes(np.ascontiguousarray(picture)))
            count += 1
    return count


def write_list(root: Path, path: Path) -> PairList:
    """List the pairs below a folder, and each clear training picture with itself."""
    listed = with_clear(folder_pairs(root))
    write_pairs(path, listed)
    return listed
