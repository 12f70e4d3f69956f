"""Snowfall from where nobody drove: a flight beside the recorded way, with labels below.

python recipes/06_beside_the_driven_path.py scenes/kitti02 --lateral 1.5 --out out/beside

The scene was built with `reconstruct=True`. What no recorded frame showed is black in the label.
Writes the flight as an MP4, and a sheet of some of its frames. Without a scene a small procedural
street is built and reconstructed in a hurry, which shows the way it goes, not how well.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import weather_aug as wa
from weather_aug.taxonomy import coloured
from weather_aug.view.sheet import grid, write_png
from weather_aug.view.video import clip_fps, keys_of, write_video

UInt8 = NDArray[np.uint8]
CLEAN_GLASS = wa.RenderOptions(without=("drops", "wipers", "lens_veil"))
QUICK = wa.FitOptions(steps=100, count=5_000, sky_size=64)


def beside(
    scene: wa.WeatherScene, camera: str, lateral_m: float, weather: wa.Weather, seed: int = 0
) -> Iterator[tuple[UInt8, UInt8, float]]:
    """Each recorded moment from beside: picture, label in colours, and the share that was seen."""
    for key in keys_of(scene, camera):
        # To the left of the way, or with a negative number to its right.
        viewpoint = wa.Viewpoint(lateral_m=lateral_m)
        shot = scene.render(key, weather, seed=seed, viewpoint=viewpoint, options=CLEAN_GLASS)
        label = shot.label
        if label is None:
            yield shot.image, np.zeros_like(shot.image), float("nan")
        else:
            yield shot.image, coloured(label), float((label != 255).mean())


def small_street(folder: Path, frames: int, width: int, height: int) -> wa.WeatherScene:
    """A procedural street, reconstructed in a hurry."""
    clip = wa.open_clip(f"street:?frames={frames}&width={width}&height={height}")
    return wa.WeatherScene.build(
        clip, folder / "street", reconstruct=True, reconstruction=QUICK, styles=()
    )


def main() -> None:
    """Fly beside the way of the scene given, or of a small street."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path, nargs="?")
    parser.add_argument("--camera", help="the one ahead, or the first, if not given")
    parser.add_argument("--lateral", type=float, default=1.5, help="to the left of the way, metres")
    parser.add_argument("--severity", default="heavy")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="folder; nothing is kept if not given")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.out or Path(temporary)
        if given.scene is None:
            scene = small_street(Path(temporary), frames=3, width=160, height=96)
        else:
            scene = wa.WeatherScene.load(given.scene)
        ahead = "front" if "front" in scene.cameras else scene.cameras[0]
        camera = given.camera or ahead
        weather = wa.Weather.snow(given.severity)
        shots = list(beside(scene, camera, given.lateral, weather, given.seed))
        for (_, _, share), key in zip(shots, keys_of(scene, camera), strict=True):
            print(f"{key}: {share:.0%} of the picture has a label")

        pairs = [np.concatenate([image, label]) for image, label, _ in shots]
        path = folder / "beside.mp4"
        count = write_video(path, pairs, clip_fps(scene, camera))
        picked = np.linspace(0, len(shots) - 1, min(3, len(shots))).astype(int)
        rows = [
            [scene.frame(keys_of(scene, camera)[i]).image for i in picked],
            *([shots[i][part] for i in picked] for part in (0, 1)),
        ]
        names = ("recorded", f"{given.lateral:+g} m", "label")
        sheet = grid(rows, names, [f"frame {i}" for i in picked], rows[0][0].shape[1])
        write_png(folder / "beside.png", sheet)
        print(f"{count} frames in {path}, some of them in {folder / 'beside.png'}")


if __name__ == "__main__":
    main()
