"""A small list of procedural pairs: a street of three colours, clear and in three weathers."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug.edit.diffusion.leakage import digests_of
from weather_aug.edit.diffusion.pairs import Pair, PairList, write_pairs

HEIGHT_PX, WIDTH_PX = 32, 48
STYLES = ("clear", "rain", "snow", "fog")
SKY, BUILDING, ROAD = 10, 2, 0
"""Train ids."""

UInt8 = NDArray[np.uint8]


def write_pair_folder(
    folder: Path,
    *,
    train: int = 1,
    val: int = 1,
    styles: tuple[str, ...] = STYLES,
    aligned: bool = True,
) -> Path:
    """Write pictures, labels and their list.

    Args:
        folder: To make.
        train: Streets that each style is trained on.
        val: Others that are held out.
        styles: Of the targets.
        aligned: What the list says of the pairs.

    Returns:
        The list's file.
    """
    folder.mkdir(parents=True)
    pairs = []
    for street in range(train + val):
        clear, label = _street(street)
        _write(folder / f"label_{street}.png", label)
        for style in ("clear", *styles):
            _write(folder / f"{style}_{street}.png", in_style(clear, label, style))
        source = digests_of(folder / f"clear_{street}.png")
        for style in styles:
            target = digests_of(folder / f"{style}_{street}.png")
            pairs.append(
                Pair(
                    source=f"clear_{street}.png",
                    target=f"{style}_{street}.png",
                    source_label=f"label_{street}.png",
                    target_label=f"label_{street}.png",
                    style=style,
                    split="train" if street < train else "val",
                    aligned=aligned,
                    source_sha256=source.file,
                    target_sha256=target.file,
                    source_pixels_sha256=source.pixels,
                    target_pixels_sha256=target.pixels,
                )
            )
    path = folder / "pairs.jsonl"
    write_pairs(path, PairList("streets", folder, tuple(pairs)))
    return path


def in_style(clear: UInt8, label: UInt8, style: str) -> UInt8:
    """A street in a weather: darker in rain, white ground in snow, gray in fog."""
    picture = clear.astype(np.float64)
    if style == "rain":
        picture = 0.6 * picture
    elif style == "snow":
        picture[label == ROAD] = 240
    elif style == "fog":
        picture = 0.4 * picture + 0.6 * 200
    return picture.round().astype(np.uint8)


def _street(index: int) -> tuple[UInt8, UInt8]:
    """A clear picture (H, W, 3) and its train ids (H, W)."""
    picture = np.empty((HEIGHT_PX, WIDTH_PX, 3), np.uint8)
    label = np.empty((HEIGHT_PX, WIDTH_PX), np.uint8)
    horizon, left = 10 + 2 * index, 8 + 5 * index
    picture[:horizon], label[:horizon] = (120, 160, 210), SKY
    picture[horizon:], label[horizon:] = (90, 90, 95), ROAD
    house = np.s_[4:horizon, left : left + 14]
    picture[house], label[house] = (150 - 10 * index, 90, 60), BUILDING
    picture[horizon + 2 :: 4, 22:26] = 220
    return picture, label


def _write(path: Path, picture: UInt8) -> None:
    pixels = picture if picture.ndim == 2 else picture[:, :, ::-1]
    assert cv2.imwrite(str(path), pixels)
