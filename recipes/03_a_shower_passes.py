"""A shower comes, falls and leaves a wet road: weather as a function of time, as a video.

python recipes/03_a_shower_passes.py out/shower     (without a folder nothing is kept)
"""

from __future__ import annotations

import sys
import tempfile
from itertools import chain, islice
from pathlib import Path

import weather_aug as wa
from weather_aug.timeline import WeatherTimeline
from weather_aug.view.video import clip_fps, drive_frames, parked_frames, write_video


def main(folder: Path, frames: int = 3, width: int = 320, height: int = 180) -> None:
    """Drive into the shower, stop at the last frame, and wait there until it is over."""
    clip = wa.open_clip(f"street:?frames={frames}&width={width}&height={height}")
    scene = wa.WeatherScene.build(clip, folder / "street", overwrite=True)

    rain = wa.Weather.rain("heavy")
    shower = WeatherTimeline(
        (
            (0.0, wa.Weather.clear()),
            (1.0, rain),
            (1.5, rain),
            (2.5, wa.Weather.rain("heavy", falling=False)),
        )
    )
    for time_s in (0.0, 0.5, 1.2, 2.5):
        now = shower.at(time_s)
        print(f"{time_s:.1f} s: {now.rain_mm_per_h:4.1f} mm/h, road wet to {now.wetness:.0%}")

    camera = "front"
    fps = clip_fps(scene, camera)
    last = [key for key in scene.keys if key.camera == camera][-1]
    drive = drive_frames(scene, camera, shower, seed=1)
    # The first parked picture is of the drive's last moment.
    wait = islice(parked_frames(scene, last, shower, fps=fps, duration_s=2.6, seed=1), 1, None)
    path = folder / "shower.mp4"
    count = write_video(path, chain(drive, wait), fps)
    print(f"{count} frames, {count / fps:.1f} s, in {path}")

    # A timeline is a value. As a file it goes to `weather-aug render SCENE --timeline FILE`.
    file = folder / "shower.json"
    file.write_text(shower.to_json(), encoding="utf-8")
    assert WeatherTimeline.from_json(file.read_text(encoding="utf-8")) == shower


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as temporary:
            main(Path(temporary))
