"""ExportPlan: which frame gets which weather, item by item, without a list of them."""

from __future__ import annotations

import json
import re
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import weather_aug
from weather_aug import _files
from weather_aug._keys import check_seed
from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError, ConflictError, printable
from weather_aug.render.options import DEFAULT_OPTIONS, RenderOptions
from weather_aug.scene import store
from weather_aug.scene.policy import WeatherDraw, WeatherPolicy
from weather_aug.scene.scene import WeatherScene
from weather_aug.weather import Weather
from weather_aug.writers import png
from weather_aug.writers.balance import ClassBalance
from weather_aug.writers.choices import Choice, FromGrid, FromPolicy, weathers_by_name
from weather_aug.writers.layout import PARTS, VERSION, Layout, layout_called
from weather_aug.writers.listed import read_list

MAX_COUNT = 100_000_000
MAX_SEEDS = 1_000_000


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
        Item i depends on (scenes, choice, i) alone. Items are committed in units: each on its own,
        or, where a layout packs them, as many as a pack holds.
    """

    scenes: tuple[WeatherScene, ...]
    choice: Choice
    count: int
    options: RenderOptions
    layout: Layout
    parts: tuple[str, ...]
    """Of `layout.PARTS`, in their order."""
    split: str
    """Folder such as train or val."""
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
            "layout": self.layout.name,
            "parts": list(self.parts),
            "items_per_unit": self.layout.items_per_unit,
            "split": self.split,
            "format_version": VERSION,
            "package_version": weather_aug.__version__,
            "encoder": png.ENCODER,
            "scenes": scenes,
            **self.choice.to_dict(),
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
        scene_index, record, draw = self._chosen(index)
        return PlannedItem(index, scene_index, record.key, draw)

    def base(self, index: int) -> str:
        """What the names of an item's parts begin with.

        It carries the job's digest and the item, so that it stays unique when exports of several
        jobs are merged or two scenes share a name.
        """
        scene_index, record, _ = self._chosen(index)
        return self._base(index, self.scenes[scene_index].name, record.key)

    def files(self, index: int) -> dict[str, str]:
        """Relative paths of the files that hold an item: one a part, or the tar of its unit."""
        if self.layout.tar is None:
            return self.paths(index)
        unit = index // self.layout.items_per_unit
        return {"tar": self.layout.tar.format(split=self.split, unit=unit)}

    def paths(self, index: int) -> dict[str, str]:
        """Relative path of each part of an item; there is no `label` where its frame has none.

        Where items stand in tars, names of members.
        """
        scene_index, record, _ = self._chosen(index)
        scene = self.scenes[scene_index].name
        base = self._base(index, scene, record.key)
        return {
            part: self.layout.path(part, split=self.split, scene=scene, base=base)
            for part in self.parts
            if part != "label" or "label" in record.files
        }

    @property
    def units(self) -> int:
        """How many units of work there are."""
        return -(-self.count // self.layout.items_per_unit)

    def items_of(self, unit: int) -> range:
        """The items that are committed together as one unit."""
        size = self.layout.items_per_unit
        return range(unit * size, min((unit + 1) * size, self.count))

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
            "format_version": VERSION,
        }

    def folders(self) -> list[str]:
        """Relative folders that the samples stand in."""
        if self.layout.tar is not None:
            return [self.layout.tar.rpartition("/")[0]]
        found: dict[str, None] = {}
        for scene in self.scenes:
            labelled = any("label" in record.files for record in scene.manifest.frames)
            for part in self.parts:
                if part != "label" or labelled:
                    path = self.layout.path(part, split=self.split, scene=scene.name, base="_")
                    found[path.rpartition("/")[0]] = None
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

    def _base(self, index: int, scene: str, key: FrameKey) -> str:
        return f"{scene}_{self.digest[:8]}_{index:06d}_{key}"

    def _chosen(self, index: int) -> tuple[int, store.FrameRecord, WeatherDraw]:
        if not 0 <= index < self.count:
            raise ArgumentError(f"item must be in [0, {self.count}), got {index}")
        frame, draw = self.choice.item(index, self._starts[-1])
        scene_index = bisect_right(self._starts, frame) - 1
        offset = frame - self._starts[scene_index]
        return scene_index, self.scenes[scene_index].manifest.frames[offset], draw

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
    layout: str = "cityscapes",
    parts: Sequence[str] | None = None,
    split: str = "train",
    balance: ClassBalance | None = None,
    progress: bool = False,
) -> ExportPlan:
    """Plan `count` samples of `scenes` in weathers drawn from `policy`.

    Args:
        scenes: At least one; two may share a name.
        policy: Item i gets `policy.draw(seed, 0, i)`.
        count: Number of samples, less or more than there are frames.
        seed: Of the order and the weathers.
        options: Budget of a rendering.
        layout: Where files stand, a name of `layout.LAYOUTS`.
        parts: What a sample consists of, of `layout.PARTS`; the layout's own if None.
        split: Folder such as train or val.
        balance: Prefer frames of rare classes; every frame equally often if None. All labels of the
            scenes are read once.
        progress: Show a bar while they are.

    Raises:
        ArgumentError: If there are no scenes, or an argument is out of range.
        SceneError: If a scene cannot be read.
    """
    balanced = balance.counted(_some(scenes), progress=progress) if balance else None
    choice = FromPolicy(policy, check_seed("seed", seed), balanced)
    return planned(scenes, choice, count, options, layout, parts, split)


def plan_grid(
    scenes: Sequence[WeatherScene],
    weathers: Mapping[str, Weather] | Sequence[str],
    seeds: Sequence[int] = (0,),
    *,
    keys: Sequence[FrameKey] | None = None,
    options: RenderOptions = DEFAULT_OPTIONS,
    layout: str = "cityscapes",
    parts: Sequence[str] | None = None,
    split: str = "train",
) -> ExportPlan:
    """Plan every frame of `scenes` in every one of `weathers` with every one of `seeds`.

    Seeds run fastest, then weathers, then frames by scene, time and camera.

    Args:
        scenes: At least one; two may share a name.
        weathers: By name, or texts such as "rain=0.3"; see `choices.weathers_by_name`. A sample's
            kind in the manifest is the name, its severity is None.
        seeds: Of the particles, each in [-2**63, 2**64).
        keys: Frames of each scene; those that it does not have are left out. All if None.
        options: Budget of a rendering.
        layout: Where files stand, a name of `layout.LAYOUTS`.
        parts: What a sample consists of, of `layout.PARTS`; the layout's own if None.
        split: Folder such as train or val.

    Raises:
        ArgumentError: If there is no scene, weather or seed, one of them stands twice, no scene has
            a frame that `keys` names, or an argument is out of range.
        SceneError: If a scene cannot be read.
    """
    scenes = _some(scenes)
    if not 1 <= len(seeds) <= MAX_SEEDS:
        raise ArgumentError(f"seeds must be 1 to {MAX_SEEDS} numbers, got {len(seeds)}")
    numbers = tuple(check_seed("seeds", seed) for seed in seeds)
    if len(set(numbers)) != len(numbers):
        raise ArgumentError("seeds must hold no seed twice")
    records = [record.key for scene in scenes for record in scene.manifest.frames]
    choice = FromGrid(weathers_by_name(weathers), numbers, _chosen_frames(records, keys))
    count = choice.count(len(records))
    return planned(scenes, choice, count, options, layout, parts, split)


def plan_list(
    scenes: Sequence[WeatherScene],
    path: Path,
    *,
    options: RenderOptions = DEFAULT_OPTIONS,
    layout: str = "cityscapes",
    parts: Sequence[str] | None = None,
    split: str = "train",
) -> ExportPlan:
    """Plan the samples that a JSONL file lists, in its order.

    Args:
        scenes: At least one, all that the file names.
        path: File of lines as `listed` describes; lines of an export's manifest will do.
        options: Budget of a rendering; not what a manifest's line says.
        layout: Where files stand, a name of `layout.LAYOUTS`.
        parts: What a sample consists of, of `layout.PARTS`; the layout's own if None.
        split: Folder such as train or val.

    Raises:
        ArgumentError: If there are no scenes, or an argument is out of range.
        DataError: If the file is no such list.
        SceneError: If a scene cannot be read.
    """
    scenes = _some(scenes)
    choice = read_list(Path(path), scenes)
    return planned(scenes, choice, len(choice.samples), options, layout, parts, split)


def _chosen_frames(
    records: Sequence[FrameKey], keys: Sequence[FrameKey] | None
) -> tuple[int, ...] | None:
    if keys is None:
        return None
    wanted = {FrameKey(*key) for key in keys}
    missing = sorted(wanted - set(records))
    if missing or not wanted:
        which = f"no scene has a frame {missing[0]}" if missing else "it is empty"
        raise ArgumentError(f"keys: {which}; give keys of the scenes' frames (scene.keys)")
    return tuple(index for index, key in enumerate(records) if key in wanted)


def planned(
    scenes: Sequence[WeatherScene],
    choice: Choice,
    count: int,
    options: RenderOptions,
    layout: str,
    parts: Sequence[str] | None,
    split: str,
) -> ExportPlan:
    """A plan of checked arguments; see `plan_export`."""
    scenes = _some(scenes)
    if not 1 <= check_seed("count", count) <= MAX_COUNT:
        raise ArgumentError(f"count must be in [1, {MAX_COUNT}], got {count!r}")
    digests = tuple(scene.digest for scene in scenes)
    chosen = layout_called(layout)
    return ExportPlan(
        *(scenes, choice, int(count), options, chosen, _parts_of(parts, chosen)),
        *(_folder_name("split", split), digests),
    )


def _some(scenes: Sequence[WeatherScene]) -> tuple[WeatherScene, ...]:
    if not scenes:
        raise ArgumentError("scenes is empty; give at least one scene to export")
    return tuple(scenes)


def _parts_of(parts: Sequence[str] | None, layout: Layout) -> tuple[str, ...]:
    wanted = set(layout.parts if parts is None else parts)
    unknown = sorted(wanted - set(layout.paths), key=str)
    if unknown:
        raise ArgumentError(
            f"parts: {printable(unknown[0])!r} is no part of layout {layout.name}; there are "
            f"{', '.join(layout.paths)}"
        )
    if "image" not in wanted:
        raise ArgumentError("parts must hold 'image'")
    return tuple(part for part in PARTS if part in wanted)


def _folder_name(name: str, value: str) -> str:
    if not isinstance(value, str) or not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}", value):
        raise ArgumentError(
            f"{name} must be a plain folder name such as train, got {printable(value)!r}"
        )
    return value
