"""The share of a dataloader's sample that weather costs.

A sample is: decode a 1024 x 2048 PNG, cut 512 x 512 of it and of the label, make tensors. With
weather it is the same with depth read from the scene and rain, snow or fog of all severities
rendered over the crop.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch

from benchmarks.scene import street
from benchmarks.timing import interleaved
from weather_aug.clip.types import Frame, FrameKey
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.scene.scene import WeatherScene
from weather_aug.transforms.dataset import WeatherDataset

HEIGHT, WIDTH, CROP = 1024, 2048, 512
ROUNDS = 41
WEATHERS = {
    "default policy": WeatherPolicy(),
    "always fog": WeatherPolicy({"fog": 1}),
    "always rain, falling": WeatherPolicy({"rain": 1}, falling=1.0),
    "always snow, falling": WeatherPolicy({"snow": 1}, falling=1.0),
}


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


def main() -> None:
    """Time samples with and without weather in turns and print the shares."""
    with tempfile.TemporaryDirectory() as folder:
        scene = WeatherScene.build(OneFrameClip(), Path(folder) / "scene")
        record = scene.manifest.frames[0]
        image_path = scene.path / record.files["image"]
        label_path = scene.path / record.files["label"]
        draw = np.random.default_rng(0)

        def plain() -> object:
            top, left = (int(v) for v in draw.integers((HEIGHT - CROP, WIDTH - CROP)))
            part = (slice(top, top + CROP), slice(left, left + CROP))
            image = cv2.imdecode(
                np.frombuffer(image_path.read_bytes(), np.uint8), cv2.IMREAD_COLOR_RGB
            )
            label = np.load(label_path, mmap_mode="r")
            tensor = torch.from_numpy(image[part]).permute(2, 0, 1).contiguous()
            return tensor, torch.from_numpy(np.array(label[part])).long()

        def weathered(policy: WeatherPolicy) -> object:
            dataset = WeatherDataset([scene], policy, crop=(CROP, CROP))

            def run() -> object:
                dataset.set_epoch(dataset.epoch + 1)
                return dataset[0]

            return run

        contenders = {"no weather": plain}
        contenders |= {name: weathered(policy) for name, policy in WEATHERS.items()}
        ms = interleaved(contenders, ROUNDS)
    print(f"\nsample: {HEIGHT} x {WIDTH} PNG, crop {CROP} x {CROP}")
    for name, value in ms.items():
        share = value / ms["no weather"] - 1
        print(f"  {name:22s} {value:7.2f} ms  {share:+7.1%}")
    print("  first target: at most +10 % under the default policy")


if __name__ == "__main__":
    main()
