"""What weather costs an export: each sample against the same files written without making them.

The export renders a sample of a 1024 x 2048 scene, encodes picture and label as PNG, writes them
durably and hashes them. Its peer decodes the same clear picture, reads the same label, encodes the
very pixels that the export made by the same encoder, and writes and hashes the same bytes in the
same way; it plans nothing, counts no classes and writes no line of the manifest. A scene holds its
labels uncompressed: the peer has to decode no PNG of them, which would make weather's share less.

Both take turns, item by item, on one thread. An item's time is its median over the rounds, a kind's
the mean over its items; of a whole policy the kinds count by their shares. Weather's share is what
the export takes longer, of the time of the export. It is taken twice: of the whole job, and of what
happens in memory, before the first byte is written.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from statistics import fmean, median
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.editor_rows import Physical
from benchmarks.report import Row, show
from benchmarks.sample import HEIGHT, WIDTH, OneFrameClip
from weather_aug import _files
from weather_aug._png import png_bytes
from weather_aug.edit.background import STYLES
from weather_aug.scene import store
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.scene.scene import WeatherScene
from weather_aug.writers.plan import ExportPlan, plan_export
from weather_aug.writers.sample import rendered, write_sample
from weather_aug.writers.target import LocalFolder

MOST_SHARE_PERCENT = 25.0
ROUNDS = 3
PLANNED = 4096
"""Samples of the plan that items of each kind are looked for in."""
DEFAULT = "default policy"
EXPORT, PEER = "export", "peer"
PARTS = MEMORY, JOB = "in memory", "whole job"


class Dressed(Physical):
    """The physical editor as one that stores backgrounds; its own name means that none are."""

    name = "dressed"


class Clocks(NamedTuple):
    """Two clocks at one moment."""

    cpu_s: float
    """Of this thread."""
    wall_s: float


Spent = Mapping[str, tuple[float, float]]
"""Processor and wall milliseconds of a call: until it began to write, and in all."""


def now() -> Clocks:
    """Both clocks."""
    return Clocks(time.thread_time(), time.perf_counter())


@dataclass(frozen=True)
class ClockedFolder(LocalFolder):
    """A folder that notes when the first byte of a sample is about to be written."""

    begun: list[Clocks] = field(default_factory=list)

    def write_whole(self, relative: str, data: bytes) -> None:
        """As a folder does."""
        self.begun.append(now())
        super().write_whole(relative, data)


class Peer:
    """Decoding, encoding and writing of the same pictures and labels."""

    def __init__(self, plan: ExportPlan, items: Sequence[int]) -> None:
        """Render the items once, to have their pixels.

        Args:
            plan: Of a labelled scene.
            items: All that will be asked for; they stand in memory.
        """
        self._clear = {item: _clear_files(plan, item) for item in items}
        self._paths = {item: plan.paths(item) for item in items}
        self._pixels = {item: _pixels(rendered(plan, item)[1]) for item in items}

    def encoded(self, item: int) -> dict[str, bytes]:
        """What the export has when it begins to write."""
        image, label, camera = self._clear[item]
        store.read_picture(image, camera)
        np.array(np.load(label, mmap_mode="r"))
        return {part: png_bytes(pixels) for part, pixels in self._pixels[item].items()}

    def write(self, target: LocalFolder, item: int) -> list[str]:
        """The files of an item; their SHA-256."""
        digests = []
        for part, data in self.encoded(item).items():
            target.write_whole(self._paths[item][part], data)
            digests.append(_files.sha256_of(data))
        return digests


def _clear_files(plan: ExportPlan, item: int) -> tuple[Path, Path, Any]:
    chosen = plan.item(item)
    scene = plan.scenes[chosen.scene_index]
    record = scene.manifest.by_key[chosen.key]
    return scene.path / record.files["image"], scene.path / record.files["label"], record.camera


def _pixels(parts: Mapping[str, bytes]) -> dict[str, NDArray[Any]]:
    flags = {"image": cv2.IMREAD_COLOR_RGB, "label": cv2.IMREAD_UNCHANGED}
    return {
        part: np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), flags[part]))
        for part, data in parts.items()
    }


def measure(layers: WeatherScene) -> list[dict[str, Any]]:
    """Print what weather costs an export, of a scene with stored layers and with backgrounds.

    Args:
        layers: The benchmark's scene as the physical editor's, which dresses while it renders.
    """
    with tempfile.TemporaryDirectory() as folder:
        stored = WeatherScene.build(OneFrameClip(), Path(folder) / "stored", editor=Dressed())
        return [
            _measured(layers, WeatherPolicy(), 4, "stored layers"),
            # A clear picture has no background.
            _measured(stored, WeatherPolicy(dict.fromkeys(STYLES, 1)), 2, "stored backgrounds"),
        ]


def _measured(
    scene: WeatherScene, policy: WeatherPolicy, per_kind: int, title: str
) -> dict[str, Any]:
    plan = plan_export([scene], policy, count=PLANNED, seed=0)
    items = items_by_kind(plan, per_kind)
    ms = milliseconds(plan, items, ROUNDS)
    where = f"export of {HEIGHT} x {WIDTH} PNG, {title}"
    shown = show(f"{where}: weather's share of the time", rows_of(ms, plan.choice.shares()))
    return shown | {"scene": title, "rounds": ROUNDS, "items": items, "ms": ms}


def items_by_kind(plan: ExportPlan, per_kind: int) -> dict[str, list[int]]:
    """The first items of each kind of weather that a plan draws."""
    items: dict[str, list[int]] = {kind: [] for kind in plan.choice.shares()}
    for item in plan:
        if len(items[item.draw.kind]) < per_kind:
            items[item.draw.kind].append(item.item)
        if all(len(some) == per_kind for some in items.values()):
            break
    return items


Times = dict[str, dict[str, dict[str, tuple[float, float]]]]
"""Processor and wall milliseconds of a sample, by kind, then side, then part of the job."""


def milliseconds(plan: ExportPlan, items: Mapping[str, Sequence[int]], rounds: int) -> Times:
    """Time both sides in turns."""
    every = [item for some in items.values() for item in some]
    turns: dict[tuple[str, int], list[Spent]] = {}
    with two_folders(plan) as (ours, theirs):
        peer = Peer(plan, every)
        for _ in range(rounds):
            for item in every:
                ours_now = _spent(partial(write_sample, plan, ours, item), ours)
                theirs_now = _spent(partial(peer.write, theirs, item), theirs)
                turns.setdefault((EXPORT, item), []).append(ours_now)
                turns.setdefault((PEER, item), []).append(theirs_now)

    def mean(side: str, kind: str, part: str) -> tuple[float, float]:
        cpu, wall = (
            fmean(median(spent[part][clock] for spent in turns[side, item]) for item in items[kind])
            for clock in (0, 1)
        )
        return cpu, wall

    return {
        kind: {side: {part: mean(side, kind, part) for part in PARTS} for side in (EXPORT, PEER)}
        for kind in items
    }


def _spent(run: Callable[[], object], target: ClockedFolder) -> Spent:
    target.begun.clear()
    start = now()
    run()
    end = now()
    return {
        part: (1e3 * (until.cpu_s - start.cpu_s), 1e3 * (until.wall_s - start.wall_s))
        for part, until in zip(PARTS, (target.begun[0], end), strict=True)
    }


@contextmanager
def two_folders(plan: ExportPlan) -> Iterator[tuple[ClockedFolder, ClockedFolder]]:
    """Two places on one disk, for as long as the block."""
    with tempfile.TemporaryDirectory() as folder:
        places = tuple(ClockedFolder(Path(folder) / side) for side in (EXPORT, PEER))
        for place in places:
            place.path.mkdir()
            place.make_folders(plan.folders())
        yield places[0], places[1]


def rows_of(ms: Times, shares: Mapping[str, float]) -> list[Row]:
    """Shares in percent of both clocks, samples per second on the wall; `shares` by kind."""
    whole = {
        side: {part: _weighted(ms, shares, side, part) for part in PARTS} for side in (EXPORT, PEER)
    }
    name = "all kinds" if "clear" not in shares else DEFAULT
    most = MOST_SHARE_PERCENT if name == DEFAULT else None
    rows = [
        Row(f"{name}, whole job", _percent(whole, JOB, 0), "% of processor", at_most=most),
        Row(f"{name}, in memory", _percent(whole, MEMORY, 0), "% of processor", at_most=most),
        Row(f"{name}, whole job", _percent(whole, JOB, 1), "% on the wall"),
    ]
    for kind, sides in ms.items():
        rows += [
            Row(f"  {kind}, {part}", _percent(sides, part, 0), "% of processor")
            for part in (JOB, MEMORY)
        ]
    return rows + [
        Row(f"{name}, {side}", 1e3 / whole[side][JOB][1], "frames/s") for side in (EXPORT, PEER)
    ]


def _weighted(ms: Times, shares: Mapping[str, float], side: str, part: str) -> tuple[float, float]:
    cpu, wall = (
        sum(share * ms[kind][side][part][clock] for kind, share in shares.items())
        for clock in (0, 1)
    )
    return cpu, wall


def _percent(
    sides: Mapping[str, Mapping[str, tuple[float, float]]], part: str, clock: int
) -> float:
    ours, theirs = (sides[side][part][clock] for side in (EXPORT, PEER))
    return 100 * (ours - theirs) / ours
