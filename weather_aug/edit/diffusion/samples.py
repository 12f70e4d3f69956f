"""Grids of pictures that show how far a training has come: clear, edited, target."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from weather_aug.edit.diffusion.adapted import AdaptedModel
from weather_aug.errors import ArgumentError

UInt8 = NDArray[np.uint8]

WIDTH_PX = (192, 512)
"""Of a grid's pictures; smaller ones are enlarged by whole factors, larger ones shrunk."""
STRIP_PX = 22
"""Height of the strip with names above each row."""
GAP_PX = 4
PAPER, INK = 255, 32


class Row(NamedTuple):
    """One pair in a grid."""

    style: str
    clear: UInt8
    """(H, W, 3) sRGB."""
    edited: UInt8
    target: UInt8
    aligned: bool
    """Whether the target shows the place of the others."""


def picture_of(tensor: torch.Tensor) -> UInt8:
    """(H, W, 3) sRGB of a (3, H, W) tensor in [-1, 1]; what is outside is cut."""
    pixels = (tensor.detach().float().clamp(-1, 1) + 1) * 127.5
    return pixels.round().to(torch.uint8).permute(1, 2, 0).cpu().contiguous().numpy()


def edited(
    model: AdaptedModel, source: torch.Tensor, label: torch.Tensor, style: str
) -> torch.Tensor:
    """A (3, H, W) picture in [-1, 1] with its (H, W) train ids, in a style; neither is changed."""
    with torch.no_grad():
        out: torch.Tensor = model(
            source[None].to(model.device), label[None].to(model.device), style
        )
    return out[0]


def grid(rows: Sequence[Row]) -> UInt8:
    """A picture with one row for each pair, and the names of what is shown.

    Args:
        rows: At least one; all pictures of one size.

    Returns:
        (rows * (STRIP_PX + h + GAP_PX), 3 * (w + GAP_PX) - GAP_PX, 3) sRGB, where w is in
        `WIDTH_PX`.

    Raises:
        ArgumentError: If there is no row.
    """
    if not rows:
        raise ArgumentError("a grid of samples needs at least one row")
    return np.concatenate([_row(row) for row in rows])


def _row(row: Row) -> UInt8:
    elsewhere = "" if row.aligned else ", elsewhere"
    names = ("clear", f"{row.style}: edited", f"{row.style}: target{elsewhere}")
    pictures = [_shown(picture) for picture in (row.clear, row.edited, row.target)]
    height, width = pictures[0].shape[:2]
    columns = 3 * (width + GAP_PX) - GAP_PX
    canvas = np.full((STRIP_PX + height + GAP_PX, columns, 3), PAPER, np.uint8)
    for index, (name, picture) in enumerate(zip(names, pictures, strict=True)):
        left = index * (width + GAP_PX)
        canvas[STRIP_PX : STRIP_PX + height, left : left + width] = picture
        cv2.putText(
            canvas,
            name,
            (left + 4, STRIP_PX - 7),
            cv2.FONT_HERSHEY_SIMPLEX,
            0.42,
            (INK, INK, INK),
            1,
            cv2.LINE_AA,
        )
    return canvas


def _shown(picture: UInt8) -> UInt8:
    """At a width in `WIDTH_PX`."""
    height, width = picture.shape[:2]
    least, most = WIDTH_PX
    if width > most:
        size = (most, round(height * most / width))
        return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
    factor = -(-least // width)
    return picture.repeat(factor, 0).repeat(factor, 1)
