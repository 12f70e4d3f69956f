"""What a data set hands out: planes as arrays or tensors, and the recipe they were made by."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from weather_aug.clip.types import FrameKey, Window
from weather_aug.render.compose import RenderedFrame
from weather_aug.render.options import RenderOptions
from weather_aug.scene.policy import WeatherDraw
from weather_aug.scene.viewpoint import Viewpoint
from weather_aug.transforms.sources import Opened
from weather_aug.weather import Weather

Sample = dict[str, Any]
Output = Literal["dict", "tuple"]


class Asked(NamedTuple):
    """How a frame is rendered, but for its weather."""

    window: Window | None
    viewpoint: Viewpoint | None
    options: RenderOptions


def rendered(opened: Opened, weather: Weather, seed: int, asked: Asked) -> RenderedFrame:
    """A frame as it is asked for."""
    return opened.render(weather, seed=seed, **asked._asdict())


def clear_of(opened: Opened, shot: RenderedFrame, asked: Asked) -> NDArray[np.uint8]:
    """(H, W, 3) sRGB: what a render shows, without weather."""
    if asked.viewpoint is not None:
        return rendered(opened, Weather.clear(), 0, asked).image
    top, left, rows, columns = shot.window
    return np.array(shot.frame.image[top : top + rows, left : left + columns], order="C")


def sample_of(shot: RenderedFrame, recipe: str) -> Sample:
    """Planes of an item as numpy arrays, and its recipe."""
    sample: Sample = {
        "image": shot.image,
        "invalid": shot.invalid,
        "transmittance": shot.transmittance,
        "depth": shot.depth,
        "recipe": recipe,
    }
    if shot.label is not None:
        sample |= {"label": shot.label, "label_full": shot.label_full}
    return sample


def tensors_of(sample: Sample) -> Sample:
    """The same with tensors: pictures (3, H, W), labels int64."""
    tensors = {
        name: torch.from_numpy(value) if isinstance(value, np.ndarray) else value
        for name, value in sample.items()
    }
    for name in ("image", "clear"):
        if name in tensors:
            tensors[name] = tensors[name].permute(2, 0, 1).contiguous()
    for name in ("label", "label_full"):
        if name in tensors:
            tensors[name] = tensors[name].long()
    return tensors


def tuple_of(tensors: Sample) -> tuple[torch.Tensor, ...]:
    """(image, label), and the clear picture if there is one."""
    return tuple(tensors[name] for name in ("image", "label", "clear") if name in tensors)


def recipe_of(head: Mapping[str, Any], key: FrameKey, draw: WeatherDraw, asked: Asked) -> str:
    """A JSON text from which the item can be rendered again.

    Args:
        head: What names the frame's source.
        key: Of the frame.
        draw: Its weather and particles.
        asked: The rest.
    """
    recipe = {
        **head,
        "time_index": key.time_index,
        "camera": key.camera,
        "weather": draw.weather.to_dict(),
        "seed": draw.seed,
        "window": asked.window,
        "options": asked.options.to_dict(),
    }
    if asked.viewpoint is not None:
        recipe["viewpoint"] = asked.viewpoint.to_dict()
    return json.dumps(recipe)


def rendered_again(opened: Opened, recipe: Mapping[str, Any]) -> RenderedFrame:
    """The item of a recipe.

    Args:
        opened: Its frame.
        recipe: As JSON values.
    """
    window, viewpoint = recipe.get("window"), recipe.get("viewpoint")
    asked = Asked(
        None if window is None else tuple(window),
        None if viewpoint is None else Viewpoint.from_dict(viewpoint),
        RenderOptions(**recipe["options"]),
    )
    return rendered(opened, Weather.from_dict(recipe["weather"]), recipe["seed"], asked)
