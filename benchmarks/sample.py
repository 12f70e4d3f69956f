"""The share of a dataloader's sample that weather costs, for PNG and for JPEG pictures.

A sample is: decode a 1024 x 2048 picture, cut 512 x 512 of it and of the label, make tensors. With
weather it is the same with depth read from the scene and rain, snow or fog of all severities
rendered over the crop: the air alone, or with all that weather does to ground, glass and camera. A
scene stores PNG, because it is lossless; for JPEG the dataset decodes the same picture at quality
95 in its place.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.report import Row, show
from benchmarks.scene import street
from benchmarks.timing import interleaved_turns
from weather_aug.clip.types import Frame, FrameKey
from weather_aug.render.options import DEFAULT_OPTIONS, EFFECTS, RenderOptions
from weather_aug.scene import store
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.scene.scene import WeatherScene
from weather_aug.transforms.dataset import WeatherDataset

HEIGHT, WIDTH, CROP = 1024, 2048, 512
JPEG_QUALITY = 95
ROUNDS = 41
MOST_SHARE_PERCENT = {"png": 6.0, "jpg": 10.0}
"""What the air of the default policy may cost; the rest of the weather has no target yet."""
AIR_ONLY = RenderOptions(without=EFFECTS)
AIR = "default policy, the air alone"
WEATHERS = {
    AIR: (WeatherPolicy(), AIR_ONLY),
    "default policy": (WeatherPolicy(), DEFAULT_OPTIONS),
    "always fog": (WeatherPolicy({"fog": 1}), DEFAULT_OPTIONS),
    "always rain, falling": (WeatherPolicy({"rain": 1}, falling=1.0), DEFAULT_OPTIONS),
    "always snow, falling": (WeatherPolicy({"snow": 1}, falling=1.0), DEFAULT_OPTIONS),
}
PLAIN = "no weather"


@dataclass(frozen=True)
class OneFrameClip:
    """The benchmark's street as a clip."""

    name: str = "bench"
    cameras: tuple[str, ...] = ("bench",)
    keys: tuple[FrameKey, ...] = (FrameKey(0, "bench"),)
    up_world: tuple[float, float, float] = (0.0, -1.0, 0.0)

    def frame(self, key: FrameKey) -> Frame:
        """The frame, driving at 10 m/s."""
        return replace(street(HEIGHT, WIDTH, speed_m_per_s=10.0)[0], key=key)


def measure() -> list[dict[str, Any]]:
    """Time samples with and without weather in turns, and print what weather adds."""
    results = []
    with tempfile.TemporaryDirectory() as folder:
        scene = WeatherScene.build(OneFrameClip(), Path(folder) / "scene")
        png = scene.path / scene.manifest.frames[0].files["image"]
        jpg = Path(folder) / "bench.jpg"
        quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
        cv2.imwrite(str(jpg), decoded(png)[..., ::-1], quality)
        for path in (png, jpg):
            with patch.object(store, "_picture", lambda *_, path=path: decoded(path)):
                turns = interleaved_turns(_contenders(scene, path), ROUNDS)
            results.append(_shown(path, turns))
    return results


def decoded(path: Path) -> NDArray[np.uint8]:
    """The picture (H, W, 3), RGB; both kinds of sample decode alike."""
    data = np.frombuffer(path.read_bytes(), np.uint8)
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR_RGB))


def _contenders(scene: WeatherScene, path: Path) -> dict[str, Callable[[], object]]:
    label_path = scene.path / scene.manifest.frames[0].files["label"]
    draw = np.random.default_rng(0)

    def plain() -> object:
        top, left = (int(v) for v in draw.integers((HEIGHT - CROP, WIDTH - CROP)))
        part = (slice(top, top + CROP), slice(left, left + CROP))
        tensor = torch.from_numpy(decoded(path)[part]).permute(2, 0, 1).contiguous()
        label = np.load(label_path, mmap_mode="r")
        return tensor, torch.from_numpy(np.array(label[part])).long()

    def weathered(policy: WeatherPolicy, options: RenderOptions) -> Callable[[], object]:
        dataset = WeatherDataset([scene], policy, crop=(CROP, CROP), options=options)

        def run() -> object:
            dataset.set_epoch(dataset.epoch + 1)
            return dataset[0]

        return run

    return {PLAIN: plain} | {name: weathered(*how) for name, how in WEATHERS.items()}


def _shown(path: Path, turns: dict[str, list[float]]) -> dict[str, Any]:
    """Means, because a loader waits for the dear draws too, over the middle nine tenths."""
    ms = {name: _trimmed_mean(values) for name, values in turns.items()}
    kind = path.suffix[1:]
    rows = []
    for name in WEATHERS:
        share = 100 * (ms[name] / ms[PLAIN] - 1)
        target = MOST_SHARE_PERCENT[kind] if name == AIR else None
        rows.append(Row(name, share, "% more", at_most=target))
    title = f"a sample of a {HEIGHT} x {WIDTH} {kind.upper()}, crop {CROP} x {CROP}"
    title += f" ({ms[PLAIN]:.2f} ms without weather)"
    return show(title, rows) | {"kind": kind, "ms": ms}


def _trimmed_mean(values: list[float]) -> float:
    cut = len(values) // 20
    return fmean(sorted(values)[cut : len(values) - cut])


if __name__ == "__main__":
    measure()
