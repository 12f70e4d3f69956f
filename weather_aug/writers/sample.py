"""One unit of work: samples rendered from their recipes, encoded, written whole."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
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
from weather_aug.writers.target import Target
from weather_aug.writers.tars import Tar

DEPTH_STEPS_PER_M = 256.0

Encoded = dict[str, bytes]
"""Bytes of each part of a sample, by name."""


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


def encoded_parts(shot: RenderedFrame, parts: Sequence[str] = ("image", "label")) -> Encoded:
    """PNG bytes of each part; no `label` where the frame has none.

    image          RGB, 8 bits
    label          train ids, 8 bits; 255 is ignored
    invalid        8 bits; 1 where a surface cannot be told, else 0, as ACDC's
    transmittance  16 bits; the share of light that arrives, times 65535, to within 1/131070
    depth          16 bits, KITTI's convention, which `clip.folder` reads: z-depth in 1/256 m, to
                   within 1/512 m; 0, "unknown", for the sky and from 256 m on

    A reader of depth tells the sky from what is far by the label of the clear picture.
    """
    made = {}
    for part in parts:
        plane = None if part == "label" and shot.label is None else _PLANES[part](shot)
        if plane is not None:
            made[part] = png_bytes(plane)
    return made


def _transmittance_16(shot: RenderedFrame) -> NDArray[np.uint16]:
    return np.rint(shot.transmittance * np.float32(65535)).astype(np.uint16)


def _depth_16(shot: RenderedFrame) -> NDArray[np.uint16]:
    steps = np.rint(shot.depth.astype(np.float32) * np.float32(DEPTH_STEPS_PER_M))
    return np.where(steps <= 65535, steps, 0).astype(np.uint16)


_PLANES: dict[str, Callable[[RenderedFrame], Any]] = {
    "image": lambda shot: shot.image,
    "label": lambda shot: shot.label,
    "invalid": lambda shot: shot.invalid,
    "transmittance": _transmittance_16,
    "depth": _depth_16,
}


def write_unit(plan: ExportPlan, target: Target, unit: int) -> list[str]:
    """Render the items of a unit, write their files, and give their lines of the manifest.

    The files are durable when this returns, but they count only once the lines are in the journal.

    Raises:
        SceneError: If the scene cannot be read.
        OutputError: If a file cannot be written.
    """
    if plan.layout.tar is not None:
        return _write_tar(plan, target, unit)
    return [write_sample(plan, target, index) for index in plan.items_of(unit)]


def _write_tar(plan: ExportPlan, target: Target, unit: int) -> list[str]:
    """As `write_unit`; the unit's samples are the members of one tar, in item order."""
    tar, entries = Tar(), []
    for index in plan.items_of(unit):
        entry, parts = rendered(plan, index)
        members = {part: tar.add(name, parts[part]) for part, name in plan.paths(index).items()}
        tar.add(f"{plan.base(index)}.json", json.dumps(entry["recipe"], allow_nan=False).encode())
        entries.append(entry | {"members": members})
    (path,) = set(plan.files(plan.items_of(unit).start).values())
    data = tar.closed()
    target.write_whole(path, data)
    files = {"tar": _stored(path, data)}
    return [json.dumps(entry | {"files": files}, allow_nan=False) for entry in entries]


def write_sample(plan: ExportPlan, target: Target, index: int) -> str:
    """Render an item, write its files, and give its line of the manifest; see `write_unit`."""
    entry, parts = rendered(plan, index)
    for part, path in plan.paths(index).items():
        data = parts[part]
        target.write_whole(path, data)
        entry["files"][part] = _stored(path, data)
    return json.dumps(entry, allow_nan=False)


def _stored(path: str, data: bytes) -> dict[str, Any]:
    return {"path": path, "size": len(data), "sha256": _files.sha256_of(data)}


def rendered(plan: ExportPlan, index: int) -> tuple[dict[str, Any], Encoded]:
    """An item's entry of the manifest, without files yet, and the bytes of its parts."""
    recipe = plan.recipe(index)
    shot = render_recipe(plan.scenes[plan.item(index).scene_index], recipe)
    entry = {
        "item": index,
        "recipe": recipe,
        "files": {},
        "class_pixels": {} if shot.label is None else class_pixels(shot.label),
    }
    return entry, encoded_parts(shot, plan.parts)


def class_pixels(label: NDArray[np.uint8]) -> dict[str, int]:
    """Number of pixels of each class that occurs, by train id as text."""
    counts = np.bincount(label.ravel(), minlength=len(CLASSES))[: len(CLASSES)]
    return {str(train_id): int(n) for train_id, n in enumerate(counts) if n}
