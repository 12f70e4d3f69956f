"""Weather in a pipeline of mmsegmentation 0.x or 1.x, or of DAFormer, HRDA and MIC.

python recipes/09_mmsegmentation.py

In a config it is two lines; nothing of mmseg is needed to run the transform itself:

    custom_imports = dict(imports=["weather_aug.transforms.mmseg"], allow_failed_imports=False)
    ...
    dict(type="RandomWeather", policy=dict(types=dict(rain=2, snow=2, fog=1)), p=0.7),
"""

from __future__ import annotations

import numpy as np

import weather_aug as wa
from weather_aug.errors import MissingExtraError
from weather_aug.transforms.mmseg import RandomWeather, register

WEATHER = dict(
    type="RandomWeather",
    policy=dict(types=dict(rain=2, snow=2, fog=1), severity=(0.5, 1.0)),
    p=0.7,
)


class Load:
    """In place of LoadImageFromFile and LoadAnnotations: frames of a street, as 1.x hands them."""

    def __init__(self, clip: wa.Clip) -> None:
        self.clip = clip

    def __call__(self, results: dict) -> dict:
        """BGR, as cv2 reads files."""
        frame = self.clip.frame(self.clip.keys[results["sample_idx"]])
        shape = frame.image.shape[:2]
        return results | {
            "img": np.ascontiguousarray(frame.image[..., ::-1]),
            "gt_seg_map": frame.label,
            "img_shape": shape,
            "ori_shape": shape,
            "seg_fields": ["gt_seg_map"],
        }


def crop_left_half(results: dict) -> dict:
    """In place of RandomCrop: weather comes before it."""
    half = results["img"].shape[1] // 2
    cut = {name: results[name][:, :half] for name in ("img", "gt_seg_map")}
    return results | cut | {"img_shape": cut["img"].shape[:2]}


def main(frames: int = 4, width: int = 320, height: int = 180) -> None:
    """Send a few frames through a pipeline, and say where configs find the transform."""
    try:
        print(f"registered as {WEATHER['type']!r} in {register()}")
    except MissingExtraError:
        print("no mmseg here: the transform runs all the same")

    clip = wa.open_clip(f"street:?frames={frames}&width={width}&height={height}")
    weather = RandomWeather(**{name: value for name, value in WEATHER.items() if name != "type"})
    for index in range(frames):
        results = {"sample_idx": index}
        for step in (Load(clip), weather, crop_left_half):
            results = step(results)
        hidden = (results["gt_seg_map"] == 255).mean()
        print(f"sample {index}: img {results['img'].shape}, {hidden:.1%} of the label ignored")


if __name__ == "__main__":
    main()
