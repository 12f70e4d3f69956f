"""How often each class occurs, as a picture or as lines of text, in the palette's colours."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from weather_aug._checks import finite
from weather_aug.errors import ArgumentError
from weather_aug.taxonomy import CLASSES, IGNORE, PALETTE

UInt8 = NDArray[np.uint8]

IGNORED = "ignored"
_COLOURS = {**dict(zip(CLASSES, PALETTE, strict=True)), IGNORED: (0, 0, 0)}
_LEAST = 1e-5
"""Share of pixels at the left end of the logarithmic scale: 0.001 %."""
_TICKS = (1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0)
_ROW_PX, _FONT_PX, _NAME_PX, _NUMBER_PX, _HEADER_PX = 22, 15, 120, 84, 52
_PAPER, _INK, _RULE = (250,) * 3, (30,) * 3, (214,) * 3


def pixel_shares(counts: Sequence[int] | NDArray[np.int64]) -> dict[str, float]:
    """Share of all pixels by class name, and of what is ignored, of (256,) counts by train id.

    Raises:
        ArgumentError: If there are not 256 counts, or no pixel at all.
    """
    counts = np.asarray(counts, np.int64)
    if counts.shape != (256,) or counts.sum() <= 0:
        raise ArgumentError(f"counts must be 256 numbers of pixels above 0, got {counts.shape}")
    total = int(counts.sum())
    shares = {name: int(counts[train_id]) / total for train_id, name in enumerate(CLASSES)}
    return {**shares, IGNORED: int(counts[IGNORE]) / total}


def class_histogram(shares: dict[str, float], *, width: int = 960, title: str = "") -> UInt8:
    """A bar for each class on a logarithmic scale from 0.001 % to all pixels.

    Args:
        shares: As of `pixel_shares`.
        width: Of the picture, pixels, in [480, 16384].
        title: Above it.

    Returns:
        (H, W, 3) uint8.

    Raises:
        ArgumentError: If the width is outside its range.
    """
    finite("width", width, 480, 16_384)
    height = _HEADER_PX + len(shares) * _ROW_PX + 8
    sheet = Image.new("RGB", (int(width), height), _PAPER)
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(size=_FONT_PX)
    draw.text((4, 4), title, fill=_INK, font=font)
    left, right = _NAME_PX, int(width) - _NUMBER_PX
    for tick in _TICKS:
        x = left + _place(tick) * (right - left)
        draw.line((x, _HEADER_PX - 4, x, height - 8), fill=_RULE)
        draw.text((x, _HEADER_PX - 6), f"{100 * tick:g} %", fill=_INK, font=font, anchor="ms")
    for row, (name, share) in enumerate(shares.items()):
        top = _HEADER_PX + row * _ROW_PX
        middle = top + _ROW_PX / 2
        draw.text((left - 8, middle), name, fill=_INK, font=font, anchor="rm")
        end = left + _place(share) * (right - left)
        if end > left:
            draw.rectangle((left, top + 3, end, top + _ROW_PX - 4), fill=_COLOURS[name])
        draw.text((right + 8, middle), percent(share), fill=_INK, font=font, anchor="lm")
    return np.asarray(sheet)


def class_bars(shares: dict[str, float], *, columns: int = 40, colour: bool = False) -> list[str]:
    """The same as lines of text, without classes that do not occur.

    Args:
        shares: As of `pixel_shares`.
        columns: Of the longest bar, characters.
        colour: Paint bars in the palette's colours, for terminals of 24-bit colours.
    """
    lines = []
    for name, share in shares.items():
        if share:
            bar = "█" * max(1, round(_place(share) * columns))
            red, green, blue = _COLOURS[name]
            painted = f"\x1b[38;2;{red};{green};{blue}m{bar}\x1b[0m" if colour else bar
            lines.append(f"{name:>13} {percent(share):>8} {painted}")
    return lines


def percent(share: float) -> str:
    """A share in percent to two digits that count, at least 0.001 %."""
    if share <= 0:
        return "none"
    if share < _LEAST:
        return "<0.001 %"
    return f"{100 * share:.{max(0, 1 - math.floor(math.log10(100 * share)))}f} %"


def _place(share: float) -> float:
    """Where a share stands on the scale, in [0, 1]."""
    return 1 - math.log(max(share, _LEAST)) / math.log(_LEAST)
