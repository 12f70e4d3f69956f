"""One sample: rendered from its recipe, encoded, written whole."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weather_aug import _files
from weather_aug._png import png_bytes
from weather_aug.clip.types import FrameKey
from weather_aug.errors import SceneError, printable
from weather_aug.render.compose import RenderedFrame
from weather_aug.render.options import RenderOptions
from weather_aug.scene.scene import WeatherScene
from weather_aug.scene.viewpoint import Viewpoint
from weather_aug.taxonomy import CLASSES
from weather_aug.weather import Weather
from weather_aug.writers.plan import ExportPlan


def render_recipe(scene: WeatherScene, recipe: Mapping[str, Any]) -> RenderedFrame:
    """Render the sample that a recipe of an export's manifest or of a data set describes.

    A recipe's `window`, (top, left, height, width) in pixels, may be null or absent: the whole
    picture; its `viewpoint`, an object of lengths and angles, may be too: the recorded one.

    Raises:
        SceneError: If the scene is not the recipe's, or a file of it cannot be read.
    """
    if scene.digest != recipe["scene_digest"]:
        raise SceneError(
            f"{printable(scene.path, 200)} is not the scene of this recipe: its digest is "
            f"{scene.digest[:12]}…, the recipe's {printable(recipe['scene_digest'], 12)}"
        )
    key = FrameKey(recipe["time_index"], recipe["camera"])
    window, viewpoint = recipe.get("window"), recipe.get("viewpoint")
    return scene.render(
        key,
        Weather.from_dict(recipe["weather"]),
        seed=recipe["seed"],
        window=None if window is None else tuple(window),
        viewpoint=None if viewpoint is None else Viewpoint.from_dict(viewpoint),
        options=RenderOptions(**recipe["options"]),
    )


def encoded_parts(shot: RenderedFrame) -> dict[str, bytes]:
    """PNG bytes of each part: `image`, and `label` where the frame is labelled."""
    parts = {"image": png_bytes(shot.image)}
    if shot.label is not None:
        parts["label"] = png_bytes(shot.label)
    return parts


def write_sample(plan: ExportPlan, out: Path, index: int) -> str:
    """Render an item, write its files, and give its line of the manifest.

    The files are durable when this returns, but they count only once the line is in the journal.

    Raises:
        SceneError: If the scene cannot be read.
        OutputError: If a file cannot be written.
    """
    recipe = plan.recipe(index)
    shot = render_recipe(plan.scenes[plan.item(index).scene_index], recipe)
    parts = encoded_parts(shot)
    files = {}
    for part, path in plan.paths(index).items():
        data = parts[part]
        _files.write_whole(out / path, data)
        files[part] = {"path": path, "size": len(data), "sha256": _files.sha256_of(data)}
    entry = {
        "item": index,
        "recipe": recipe,
        "files": files,
        "class_pixels": {} if shot.label is None else class_pixels(shot.label),
    }
    return json.dumps(entry, allow_nan=False)


def class_pixels(label: NDArray[np.uint8]) -> dict[str, int]:
    """Number of pixels of each class that occurs, by train id as text."""
    counts = np.bincount(label.ravel(), minlength=len(CLASSES))[: len(CLASSES)]
    return {str(train_id): int(n) for train_id, n in enumerate(counts) if n}
