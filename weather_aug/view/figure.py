"""Sheets as matplotlib figures: titles in units, and a picture wherever a notebook shows them.

Convention:
    A figure stands alone: pyplot is not imported, so no backend is chosen and no list of open
    figures grows. Everything is placed in pixels of 1/100 inch.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import finite
from weather_aug._extras import require
from weather_aug._keys import check_seed
from weather_aug.air import Air
from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError, printable
from weather_aug.render.compose import RenderedFrame
from weather_aug.scene.policy import WeatherPolicy, weather_of
from weather_aug.view.planes import PLANES, painted
from weather_aug.view.source import Source
from weather_aug.view.units import in_units, titled
from weather_aug.weather import Weather

# Without it the import below would fail with no word on which extra to install.
require("matplotlib", extra="notebook", to="draw a figure")

from matplotlib.figure import Figure  # noqa: E402

UInt8 = NDArray[np.uint8]

MOST_DRAWS = 256
TILE_WIDTH_PX = (80, 2048)
_DPI = 100
_TITLE_PX = 22
_NAME_PX = 24
_GAP_PX = 6
_FONT_PT = 10.0
_CHARACTER_EM = 0.62
"""Width of a wide text's mean character."""


class Sheet(Figure):
    """A figure that shows itself in a notebook, where pyplot was never asked for one."""

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        self.savefig(file, format="png")
        return file.getvalue()


@dataclass(frozen=True)
class Row:
    """Pictures side by side."""

    name: str
    """Written upright on the left; nothing if empty."""
    titles: Sequence[str]
    """Above each picture, or none at all."""
    pictures: Sequence[UInt8]
    """(H, W, 3) each."""


def sweep(
    source: Source,
    key: FrameKey | None,
    *,
    kinds: Sequence[str],
    severities: Sequence[str | float],
    seed: int,
    planes: Sequence[str],
    tile_width: int,
) -> Sheet:
    """Rows of weathers, columns of severities; see `weather_aug.preview.sweep`."""
    _check(planes, tile_width)
    key = key or source.keys[len(source.keys) // 2]
    clear = _tiles(source.shot(key, Weather.clear(), seed), planes, tile_width)
    rows = []
    for kind in kinds:
        titles, columns = ["clear"], [clear]
        for severity in severities:
            weather = weather_of(kind, severity)
            # The air has drifted alike in all, so that drops stay where they are.
            shot = source.shot(key, weather, seed, Air.held(weather))
            titles.append(f"{severity}: {in_units(weather)}")
            columns.append(_tiles(shot, planes, tile_width))
        rows += _rows(kind, titles, columns, planes)
    return laid_out(rows, tile_width)


def draws(
    source: Source,
    policy: WeatherPolicy,
    *,
    count: int,
    seed: int,
    columns: int,
    planes: Sequence[str],
    tile_width: int,
) -> Sheet:
    """What a policy draws; see `weather_aug.preview.draws`."""
    _check(planes, tile_width)
    finite("count", check_seed("count", count), 1, MOST_DRAWS)
    finite("columns", check_seed("columns", columns), 1, MOST_DRAWS)
    titles, tiles = [], []
    for epoch, index in items(len(source.keys), count):
        drawn = policy.draw(seed, epoch, index)
        titles.append(titled(drawn.kind, drawn.weather))
        shot = source.shot(source.keys[index], drawn.weather, drawn.seed)
        tiles.append(_tiles(shot, planes, tile_width))
    rows = []
    for first in range(0, count, columns):
        part = slice(first, first + columns)
        rows += _rows("", titles[part], tiles[part], planes)
    return laid_out(rows, tile_width)


def items(frames: int, count: int) -> list[tuple[int, int]]:
    """(epoch, index) of the items of a data set that stand for it: apart, then epoch by epoch."""
    if count < frames:
        return [(0, number * frames // count) for number in range(count)]
    return [divmod(number, frames) for number in range(count)]


def laid_out(rows: Sequence[Row], tile_width: int) -> Sheet:
    """A figure of rows; a row is as high as its highest picture.

    Args:
        rows: At least one, with a picture each.
        tile_width: Of each picture, pixels.

    Raises:
        ArgumentError: If there is nothing to show.
    """
    if not rows or not all(row.pictures for row in rows):
        raise ArgumentError("a figure needs at least one weather and one picture in each row")
    left = _NAME_PX if any(row.name for row in rows) else _GAP_PX
    above = [_TITLE_PX if row.titles else _GAP_PX for row in rows]
    heights = [max(_height(picture, tile_width) for picture in row.pictures) for row in rows]
    width = left + max(len(row.pictures) for row in rows) * (tile_width + _GAP_PX)
    height = sum(above) + sum(heights) + _GAP_PX
    figure = Sheet(figsize=(width / _DPI, height / _DPI), dpi=_DPI, facecolor="white")
    title_pt = _font_pt([title for row in rows for title in row.titles], tile_width)
    name_pt = _font_pt([row.name for row in rows], min(heights))
    y = 0
    for row, gap, row_height in zip(rows, above, heights, strict=True):
        y += gap
        for column, picture in enumerate(row.pictures):
            x = left + column * (tile_width + _GAP_PX)
            tall = _height(picture, tile_width)
            place = (x / width, 1 - (y + tall) / height, tile_width / width, tall / height)
            axes = figure.add_axes(place, xticks=[], yticks=[], frame_on=False)
            axes.imshow(picture, aspect="auto")
            if row.titles:
                axes.set_title(row.titles[column], fontsize=title_pt, pad=4, color="black")
            if column == 0:
                axes.set_ylabel(row.name, fontsize=name_pt, color="black")
        y += row_height
    return figure


def _tiles(shot: RenderedFrame, planes: Sequence[str], tile_width: int) -> list[UInt8]:
    """The planes of a shot, small: a sheet holds many shots, and a shot is large."""
    return [painted(shot, plane, tile_width) for plane in planes]


def _rows(
    name: str, titles: Sequence[str], columns: Sequence[Sequence[UInt8]], planes: Sequence[str]
) -> list[Row]:
    """The planes of some columns below each other, under one row of titles."""
    first, *others = (list(row) for row in zip(*columns, strict=True))
    below = [Row(plane, (), row) for plane, row in zip(planes[1:], others, strict=True)]
    return [Row(name, titles, first), *below]


def _height(picture: UInt8, width: int) -> int:
    return max(1, round(picture.shape[0] * width / picture.shape[1]))


def _font_pt(texts: Sequence[str], room_px: int) -> float:
    """The size at which the longest text is no longer than its picture."""
    longest = max((1, *map(len, texts)))
    return min(_FONT_PT, room_px * 72 / _DPI / _CHARACTER_EM / longest)


def _check(planes: Sequence[str], tile_width: int) -> None:
    finite("tile_width", check_seed("tile_width", tile_width), *TILE_WIDTH_PX)
    unknown = [plane for plane in planes if plane not in PLANES]
    if unknown or isinstance(planes, str) or not planes:
        raise ArgumentError(
            f"planes must be some of {', '.join(PLANES)}, such as ('image', 'label'), got "
            f"{printable(planes)}"
        )
