"""Sheets of labelled pictures: sweeps, states, contact sheets, all cameras of a moment."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from weather_aug import _files
from weather_aug._checks import finite
from weather_aug._png import png_bytes
from weather_aug.air import Air
from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError
from weather_aug.render.compose import RenderedFrame
from weather_aug.render.options import DEFAULT_OPTIONS, RenderOptions
from weather_aug.scene.policy import weather_of
from weather_aug.scene.scene import WeatherScene
from weather_aug.taxonomy import coloured
from weather_aug.timeline import WeatherTimeline
from weather_aug.weather import Weather

UInt8 = NDArray[np.uint8]

KINDS = ("rain", "snow", "fog")
SEVERITIES = ("light", "moderate", "heavy", "extreme")
STATES = {
    "wet road, no rain": Weather.rain("heavy", falling=False, puddles=0.45),
    "fresh snow, clear air": Weather.snow(
        "heavy", falling=False, road_snow_cover=0.75, snow_depth_m=0.12
    ),
    "dense fog, lamps on": Weather.fog(visibility_m=70.0, lamps=1.0),
    "heavy rain, wet glass": Weather.rain("heavy", lens_drops=90.0, wipers=0.0),
}
"""What a filter over the picture cannot draw: light, ground, air, and the glass before the lens."""
_MARGIN_PX = 4
_HEADER_PX = 26
_PAPER, _INK = 250, 30


def sweep(
    scene: WeatherScene,
    key: FrameKey | None = None,
    *,
    kinds: Sequence[str] = KINDS,
    severities: Sequence[str | float] = SEVERITIES,
    seed: int = 0,
    tile_width: int = 480,
    options: RenderOptions = DEFAULT_OPTIONS,
) -> UInt8:
    """One labelled picture: a row per weather, a column per severity, the clear frame first.

    Args:
        scene: Scene to render from.
        key: Which frame; the middle one if None.
        kinds: Weather types.
        severities: Names or numbers in [0, 1].
        seed: Of the particles.
        tile_width: Width of each picture, pixels.
        options: Choices besides the weather.

    Returns:
        (H, W, 3) uint8.
    """
    key = key or _middle(scene)
    clear = scene.render(key, Weather.clear(), seed=seed).image
    rows = []
    for kind in kinds:
        shots = [_shot(scene, key, weather_of(kind, s), seed, options).image for s in severities]
        rows.append([clear, *shots])
    return grid(rows, kinds, ["clear", *(str(s) for s in severities)], tile_width)


def states(
    scene: WeatherScene,
    key: FrameKey | None = None,
    *,
    seed: int = 0,
    tile_width: int = 640,
    options: RenderOptions = DEFAULT_OPTIONS,
) -> UInt8:
    """One frame as recorded and in the four weathers of `STATES`, three by two.

    The sixth picture is what the fog leaves of the label, or the transmittance where nobody
    labelled.

    Args:
        scene: Scene to render from.
        key: Which frame; the middle one if None.
        seed: Of the particles.
        tile_width: Width of each picture, pixels.
        options: Choices besides the weather.

    Returns:
        (H, W, 3) uint8.
    """
    key = key or _middle(scene)
    shots = {name: _shot(scene, key, w, seed, options) for name, w in STATES.items()}
    pictures = {"recorded": scene.frame(key).image}
    pictures |= {name: shot.image for name, shot in shots.items()}
    fog = shots["dense fog, lamps on"]
    if fog.label is None:
        pictures["transmittance of the fog"] = transmittance_picture(fog.transmittance)
    else:
        pictures["label in the fog, black is ignored"] = coloured(fog.label)
    names = list(pictures)
    halves = (names[:3], names[3:])
    return np.concatenate(
        [grid([[pictures[name] for name in half]], [""], half, tile_width) for half in halves]
    )


def contact_sheet(
    scene: WeatherScene,
    keys: Sequence[FrameKey],
    *,
    severities: Sequence[str | float] = ("light", "heavy"),
    seed: int = 0,
    tile_width: int = 480,
    options: RenderOptions = DEFAULT_OPTIONS,
) -> UInt8:
    """The states and severities of some frames, with label and transmittance below each picture.

    Args:
        scene: Scene to render from.
        keys: One block of rows for each.
        severities: Names or numbers in [0, 1].
        seed: Of the particles.
        tile_width: Width of each picture, pixels.
        options: Choices besides the weather.

    Returns:
        (H, W, 3) uint8; columns are clear, `STATES`, then each of `KINDS` at each severity.
    """
    weathers = {"clear": Weather.clear(), **STATES}
    weathers |= {f"{s} {kind}": weather_of(kind, s) for kind in KINDS for s in severities}
    rows: list[list[UInt8]] = []
    names: list[str] = []
    for key in keys:
        shots = [_shot(scene, key, w, seed, options) for w in weathers.values()]
        rows.append([shot.image for shot in shots])
        names.append(key.camera)
        if shots[0].label is not None:
            rows.append([coloured(_label(shot)) for shot in shots])
            names.append("label")
        rows.append([transmittance_picture(shot.transmittance) for shot in shots])
        names.append("transmittance")
    return grid(rows, names, list(weathers), tile_width)


def rig_still(
    scene: WeatherScene,
    time_index: int,
    weather: Weather | WeatherTimeline,
    *,
    seed: int = 0,
    tile_width: int = 640,
) -> UInt8:
    """All cameras of a moment side by side, from left to right as they look.

    Cameras of a rig see the same particles, so that a flake between two views stands in both.

    Args:
        scene: Scene to render from.
        time_index: Which moment.
        weather: State of air and ground, or how it changes with the time since the first frame.
        seed: Of the particles.
        tile_width: Width of each picture, pixels.

    Returns:
        (H, W, 3) uint8.

    Raises:
        ArgumentError: If the scene has no frame of this moment.
    """
    keys = [key for key in scene.keys if key.time_index == time_index]
    if not keys:
        raise ArgumentError(
            f"scene {scene.name} has no frame at time index {time_index}; it has "
            f"{scene.keys[0].time_index} to {scene.keys[-1].time_index}"
        )
    keys = left_to_right(scene, keys)
    images = [scene.render(key, weather, seed=seed).image for key in keys]
    return grid([images], [f"time {time_index}"], [key.camera for key in keys], tile_width)


def left_to_right(scene: WeatherScene, keys: Sequence[FrameKey]) -> list[FrameKey]:
    """Keys by where their cameras look, from left to right.

    Headings lie on a circle, so the row is cut where two neighbours are farthest apart: behind a
    rig that looks ahead, whichever way the street has turned.
    """
    along, left, _ = scene.manifest.axes_world
    ahead = [scene.manifest.by_key[key].camera.world_from_camera[:3, 2] for key in keys]
    yaws = np.array([np.arctan2(axis @ left, axis @ along) for axis in ahead])
    order = np.argsort(-yaws, kind="stable")
    gaps = (yaws[np.roll(order, 1)] - yaws[order]) % (2 * np.pi)
    # Two cameras that look the same way have a gap of 0, one camera alone has no other.
    first = int(np.argmax(gaps))
    return [keys[i] for i in np.roll(order, -first)]


def transmittance_picture(transmittance: NDArray[np.float32]) -> UInt8:
    """Paint transmittance (H, W) in [0, 1] with a perceptually even colour map, (H, W, 3)."""
    levels = np.round(255 * np.clip(transmittance, 0, 1)).astype(np.uint8)
    painted: UInt8 = cv2.cvtColor(
        cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS), cv2.COLOR_BGR2RGB
    )
    return painted


def grid(
    rows: Sequence[Sequence[UInt8]],
    row_names: Sequence[str],
    column_names: Sequence[str],
    tile_width: int,
) -> UInt8:
    """Rows of pictures on paper, each column with a heading, each row with its name.

    Pictures are scaled to one width; a row is as high as its first picture.

    Raises:
        ArgumentError: If there are no pictures, or `tile_width` is not in [1, 4096].
    """
    if not rows or not all(rows):
        raise ArgumentError("a sheet needs at least one weather and one picture in each row")
    finite("tile_width", tile_width, 1, 4096)
    tiles = [[_scaled(image, tile_width) for image in row] for row in rows]
    columns = max(len(row) for row in tiles)
    left = _HEADER_PX
    width = left + columns * (tile_width + _MARGIN_PX)
    height = _HEADER_PX + sum(row[0].shape[0] + _MARGIN_PX for row in tiles)
    sheet = Image.new("RGB", (width, height), (_PAPER,) * 3)
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(size=16)
    for column, name in enumerate(column_names):
        draw.text((left + column * (tile_width + _MARGIN_PX), 4), name, fill=(_INK,) * 3, font=font)
    y = _HEADER_PX
    for row, name in zip(tiles, row_names, strict=True):
        row_height = row[0].shape[0]
        sheet.paste(_upright(name, row_height, font), (0, y))
        for column, tile in enumerate(row):
            sheet.paste(Image.fromarray(tile), (left + column * (tile_width + _MARGIN_PX), y))
        y += row_height + _MARGIN_PX
    return np.asarray(sheet)


def write_png(path: Path, image: UInt8) -> None:
    """Write an (H, W, 3) picture or an (H, W) label, whole or not at all; its folder is made.

    Raises:
        ArgumentError: If it is no such picture.
        OutputError: If it cannot be written.
    """
    png = png_bytes(image)
    with _files.reported(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    _files.write_whole(path, png)


def _middle(scene: WeatherScene) -> FrameKey:
    return scene.keys[len(scene.keys) // 2]


def _shot(
    scene: WeatherScene, key: FrameKey, weather: Weather, seed: int, options: RenderOptions
) -> RenderedFrame:
    """One picture of a sheet; the air has drifted alike in all, so that drops stay."""
    return scene.render(key, weather, seed=seed, air=Air.held(weather), options=options)


def _label(shot: RenderedFrame) -> UInt8:
    assert shot.label is not None
    return shot.label


def _scaled(image: UInt8, width: int) -> UInt8:
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    way = cv2.INTER_AREA if width < image.shape[1] else cv2.INTER_LINEAR
    scaled: UInt8 = cv2.resize(image, (width, height), interpolation=way)
    return scaled


def _upright(
    text: str, height: int, font: ImageFont.FreeTypeFont | ImageFont.ImageFont
) -> Image.Image:
    strip = Image.new("RGB", (height, _HEADER_PX), (_PAPER,) * 3)
    ImageDraw.Draw(strip).text((4, 4), text, fill=(_INK,) * 3, font=font)
    return strip.rotate(90, expand=True)
