"""ExportPlan: which frame gets which weather, item by item, without a list of them."""

from __future__ import annotations

import json
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import weather_aug
from weather_aug import _files
from weather_aug._keys import check_seed, key_of, uniforms
from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError, ConflictError, printable
from weather_aug.render.options import DEFAULT_OPTIONS, RenderOptions
from weather_aug.scene import store
from weather_aug.scene.policy import WeatherDraw, WeatherPolicy
from weather_aug.scene.scene import WeatherScene
from weather_aug.writers import layout, png

MAX_COUNT = 100_000_000


class PlannedItem(NamedTuple):
    """One sample to be made."""

    item: int
    scene_index: int
    key: FrameKey
    draw: WeatherDraw


@dataclass(frozen=True, eq=False)
class ExportPlan:
    """A fixed list of samples, as a function of the item's index; see `plan_export`.

    Convention:
        Item i depends on (scenes, policy, seed, i) alone. Items run through all frames of all
        scenes in a shuffled order, then through all of them again in another, so that any `count`
        shows every frame equally often, to within one.
    """

    scenes: tuple[WeatherScene, ...]
    policy: WeatherPolicy
    count: int
    seed: int
    options: RenderOptions
    scene_digests: tuple[str, ...]
    """As planned; a scene that is rebuilt meanwhile is noticed by them."""

    def __len__(self) -> int:
        return self.count

    def __iter__(self) -> Iterator[PlannedItem]:
        return (self.item(index) for index in range(self.count))

    @cached_property
    def job(self) -> dict[str, Any]:
        """Everything that decides the exported bytes, as JSON values; the job's fingerprint."""
        scenes = [
            {"name": scene.name, "digest": digest}
            for scene, digest in zip(self.scenes, self.scene_digests, strict=True)
        ]
        return {
            "layout": layout.LAYOUT,
            "format_version": layout.VERSION,
            "package_version": weather_aug.__version__,
            "encoder": png.ENCODER,
            "scenes": scenes,
            "policy": self.policy.to_dict(),
            "seed": self.seed,
            "count": self.count,
            "options": self.options.to_dict(),
        }

    @cached_property
    def digest(self) -> str:
        """SHA-256 of `job`."""
        return _files.sha256_of(json.dumps(self.job, allow_nan=False).encode())

    def item(self, index: int) -> PlannedItem:
        """Item `index` of the list.

        Raises:
            ArgumentError: If there is no such item.
        """
        scene_index, record = self._frame(index)
        return PlannedItem(index, scene_index, record.key, self.policy.draw(self.seed, 0, index))

    def paths(self, index: int) -> dict[str, str]:
        """Relative path of each part of an item: `image`, and `label` if its frame has one.

        Base names carry the job's digest and the item, so they stay unique when exports of several
        jobs are merged or two scenes share a name.
        """
        scene_index, record = self._frame(index)
        name = self.scenes[scene_index].name
        base = f"{name}_{self.digest[:8]}_{index:06d}_{record.key}"
        parts = ("image", "label") if "label" in record.files else ("image",)
        return {part: layout.part_path(part, name, base) for part in parts}

    def recipe(self, index: int) -> dict[str, Any]:
        """What an item is made from, as JSON values; `render_recipe` makes it again."""
        item = self.item(index)
        return {
            "scene": self.scenes[item.scene_index].name,
            "scene_digest": self.scene_digests[item.scene_index],
            "time_index": item.key.time_index,
            "camera": item.key.camera,
            "kind": item.draw.kind,
            "severity": item.draw.severity,
            "weather": item.draw.weather.to_dict(),
            "seed": item.draw.seed,
            "options": self.options.to_dict(),
            "package_version": weather_aug.__version__,
            "format_version": layout.VERSION,
        }

    def folders(self) -> list[str]:
        """Relative folders that the samples stand in."""
        found: dict[str, None] = {}
        for scene in self.scenes:
            labelled = any("label" in record.files for record in scene.manifest.frames)
            for part in ("image", "label") if labelled else ("image",):
                found[f"{layout.PART_FOLDERS[part]}/{scene.name}"] = None
        return list(found)

    def check_scenes(self) -> None:
        """Read the scenes' manifests anew; refuse those that the plan was not made for.

        Raises:
            ConflictError: If a scene was rebuilt since.
        """
        for scene, digest in zip(self.scenes, self.scene_digests, strict=True):
            if WeatherScene(scene.path).digest != digest:
                raise ConflictError(
                    f"scene {printable(scene.path, 200)} was rebuilt since the export was planned; "
                    "export it again, to another folder"
                )

    def _frame(self, index: int) -> tuple[int, store.FrameRecord]:
        if not 0 <= index < self.count:
            raise ArgumentError(f"item must be in [0, {self.count}), got {index}")
        frames = self._starts[-1]
        cycle, place = divmod(index, frames)
        frame = int(_shuffled(self.seed, cycle, frames)[place])
        scene_index = bisect_right(self._starts, frame) - 1
        offset = frame - self._starts[scene_index]
        return scene_index, self.scenes[scene_index].manifest.frames[offset]

    @cached_property
    def _starts(self) -> tuple[int, ...]:
        """Number of frames before each scene, and of all."""
        return (0, *accumulate(len(scene.manifest.frames) for scene in self.scenes))


def plan_export(
    scenes: Sequence[WeatherScene],
    policy: WeatherPolicy,
    *,
    count: int,
    seed: int,
    options: RenderOptions = DEFAULT_OPTIONS,
) -> ExportPlan:
    """Plan `count` samples of `scenes` in weathers drawn from `policy`.

    Args:
        scenes: At least one; two may share a name.
        policy: Item i gets `policy.draw(seed, 0, i)`.
        count: Number of samples, less or more than there are frames.
        seed: Of the order and the weathers.
        options: Budget of a rendering.

    Raises:
        ArgumentError: If there are no scenes, or count or seed are out of range.
        SceneError: If a scene cannot be read.
    """
    scenes = tuple(scenes)
    if not scenes:
        raise ArgumentError("scenes is empty; give at least one scene to export")
    if not 1 <= check_seed("count", count) <= MAX_COUNT:
        raise ArgumentError(f"count must be in [1, {MAX_COUNT}], got {count!r}")
    digests = tuple(scene.digest for scene in scenes)
    return ExportPlan(scenes, policy, int(count), check_seed("seed", seed), options, digests)


@lru_cache(maxsize=4)
def _shuffled(seed: int, cycle: int, frames: int) -> NDArray[np.int64]:
    order = np.argsort(uniforms(key_of("export-order", seed, cycle), frames), kind="stable")
    order.flags.writeable = False
    return order
