"""Videos: the frames of a moving clip in weather, or of one recorded frame while time runs on.

Convention:
    A frame of a video is a pure function of (scene, pose, time, weather, seed): the generators hold
    no state, and particles are where they are at that time, not one step on.

    A clip has pictures at its recorded moments only, and a picture cannot be interpolated without
    inventing what it hides. So there are two kinds of video, and both show what was there:

    `drive_frames`   one video frame for each recorded one. Played at the clip's own rate this is
                     real time; played slower it is slow motion. It never runs backwards, because
                     rain does not rise.
    `parked_frames`  one recorded picture is held while the air moves on at any rate, for any time,
                     as if the car and the street had stopped. The camera's velocity is 0 then, so
                     that streaks and paths tell of wind and fall alone, as the picture does.

    To hold each recorded picture for several video frames of a moving car is neither: particles
    would pass at the car's speed through a street that stands still.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug import _files
from weather_aug._checks import finite, image_uint8
from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError, ConflictError, OutputError, printable
from weather_aug.render.compose import render
from weather_aug.render.options import DEFAULT_OPTIONS, RenderOptions
from weather_aug.scene.scene import WeatherScene
from weather_aug.timeline import WeatherTimeline
from weather_aug.view.sheet import write_png
from weather_aug.weather import Weather

UInt8 = NDArray[np.uint8]

FPS = (0.1, 240.0)
"""Slowest and fastest frame rate of a video, 1/s."""
LONGEST_S = 3600.0


def drive_frames(
    scene: WeatherScene,
    camera: str,
    weather: Weather | WeatherTimeline,
    *,
    seed: int = 0,
    options: RenderOptions = DEFAULT_OPTIONS,
    **elsewhere: Any,
) -> Iterator[UInt8]:
    """Every recorded frame of a camera in weather, in the order of time.

    Args:
        scene: Scene to render from.
        camera: One of its cameras.
        weather: State of air and ground, or how it changes with the time since the first frame.
        seed: Which particles fall and which gusts blow.
        options: Choices besides the weather.
        **elsewhere: `viewpoint`, `style`, `amount` and `without_actors`, as of
            `WeatherScene.render`.

    Returns:
        (H, W, 3) sRGB pictures, rendered as they are asked for.

    Raises:
        ArgumentError: If the scene has no such camera.
    """
    keys = keys_of(scene, camera)
    choices = {"seed": seed, "options": options, **elsewhere}
    return (scene.render(key, weather, **choices).image for key in keys)


def parked_frames(
    scene: WeatherScene,
    key: FrameKey,
    weather: Weather | WeatherTimeline,
    *,
    fps: float,
    duration_s: float,
    seed: int = 0,
    options: RenderOptions = DEFAULT_OPTIONS,
) -> Iterator[UInt8]:
    """One recorded frame while time runs on, its camera at rest.

    The first picture is of the frame's own moment, so that a drive up to `key` may go before it;
    what moves in the recorded picture stands still too.

    Args:
        scene: Scene to render from.
        key: Which frame is held.
        weather: State of air and ground, or how it changes with the time since the first frame.
        fps: Pictures per second, in [0.1, 240].
        duration_s: Length, in [0, 3600] s; there is always one picture.
        seed: Which particles fall and which gusts blow.
        options: Choices besides the weather.

    Returns:
        (H, W, 3) sRGB pictures, rendered as they are asked for.

    Raises:
        ArgumentError: If the scene has no such frame, or a number is outside its range.
    """
    count = parked_count(fps, duration_s)
    held = scene.frame(key)
    still = replace(
        held.camera, velocity_m_per_s=np.zeros(3), angular_velocity_rad_per_s=np.zeros(3)
    )
    held = replace(held, camera=still)
    start_s, _ = shown_s(scene, [key])
    ambience = scene.ambience(key)

    def picture(index: int) -> UInt8:
        time_s = start_s + index / fps
        if isinstance(weather, WeatherTimeline):
            now, air = weather.at(time_s), weather.air(time_s, seed)
        else:
            now, air = weather, None
        return render(
            replace(held, time_s=time_s),
            now,
            seed=seed,
            ambience=ambience,
            air=air,
            shelter=scene.shelter,
            options=options,
        ).image

    return (picture(index) for index in range(count))


def parked_count(fps: float, duration_s: float) -> int:
    """How many pictures `parked_frames` gives: one at the least.

    Raises:
        ArgumentError: If a number is outside its range.
    """
    fps = finite("fps", fps, *FPS)
    return max(1, round(finite("duration_s", duration_s, 0, LONGEST_S) * fps))


def shown_s(scene: WeatherScene, keys: Sequence[FrameKey]) -> tuple[float, float]:
    """Times of the first and the last of some frames, seconds since the scene's first frame.

    Raises:
        ArgumentError: If the scene has no such frame.
    """
    by_key = scene.manifest.by_key
    unknown = [key for key in keys if key not in by_key]
    if unknown:
        raise ArgumentError(f"scene {scene.name} has no frame {printable(unknown[0])}")
    times_s = [by_key[key].time_s - scene.manifest.frames[0].time_s for key in keys]
    return min(times_s), max(times_s)


def keys_of(scene: WeatherScene, camera: str) -> list[FrameKey]:
    """Keys of one camera's frames, in the order of time.

    Raises:
        ArgumentError: If the scene has no such camera.
    """
    keys = [key for key in scene.keys if key.camera == camera]
    if not keys:
        raise ArgumentError(
            f"scene {scene.name} has no camera {printable(camera)!r}; it has "
            f"{', '.join(scene.cameras)}"
        )
    return keys


def clip_fps(scene: WeatherScene, camera: str) -> float:
    """Rate at which a drive of this camera is played in real time, 1/s: of the median step.

    Raises:
        ArgumentError: If the scene has no such camera, or one frame of it only.
    """
    records = scene.manifest.by_key
    times_s = [records[key].time_s for key in keys_of(scene, camera)]
    steps_s = [after - before for before, after in pairwise(times_s)]
    if not steps_s or not np.median(steps_s) > 0:
        raise ArgumentError(
            f"camera {camera} of scene {scene.name} has no frame rate of its own "
            f"({len(times_s)} frames); give fps"
        )
    # A rate of 9.648 from times in whole milliseconds is written as what it is.
    return float(np.clip(round(1.0 / float(np.median(steps_s)), 3), *FPS))


def write_video(path: Path, frames: Iterable[UInt8], fps: float) -> int:
    """Write frames as an MP4 file, or without loss as a folder of PNG files.

    The MP4 (MPEG-4 part 2, written by the FFmpeg in OpenCV) appears when it is whole or not at all.
    Its sides are even: the last row or column of an odd picture is left out. A folder holds
    000000.png and so on; `fps` is checked, but PNG files do not know it.

    Args:
        path: Ends with .mp4, or has no suffix: the folder, absent or empty. Its parent is made.
        frames: (H, W, 3) uint8 sRGB, all of one size; taken one at a time.
        fps: Pictures per second, in [0.1, 240].

    Returns:
        How many frames were written.

    Raises:
        ArgumentError: If the path has another suffix, there are no frames, or one has another size.
        ConflictError: If the folder holds something.
        OutputError: If this OpenCV has no encoder, or the file cannot be written.
    """
    fps = finite("fps", fps, *FPS)
    check_video_path(path)
    frames = _of_one_size(frames)
    if path.suffix.lower() == ".mp4":
        with _files.reported(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        return _write_mp4(path, frames, fps)
    count = 0
    for count, image in enumerate(frames, start=1):
        write_png(path / f"{count - 1:06d}.png", image)
    return count


def check_video_path(path: Path) -> None:
    """Refuse what `write_video` would refuse of a path, before any work is done for it."""
    suffix = path.suffix.lower()
    if suffix not in (".mp4", ""):
        raise ArgumentError(
            f"a video is a file that ends with .mp4 or a folder (no suffix) of PNG files, got "
            f"{printable(path, 200)}"
        )
    with _files.reported(path):
        is_folder = path.is_dir()
        taken = path.exists() and not is_folder if not suffix else is_folder
        filled = is_folder and not suffix and any(path.iterdir())
    if taken:
        raise OutputError(
            f"{printable(path, 200)} is a {'folder' if suffix else 'file'}; choose another name"
        )
    if filled:
        raise ConflictError(f"{printable(path, 200)} is not empty; choose a new folder")


def _write_mp4(path: Path, frames: Iterable[UInt8], fps: float) -> int:
    """Encode beside the place, then move into it: OpenCV wants a name, and reports no full disk."""
    with (
        _files.whole_file(path) as whole,
        tempfile.TemporaryDirectory(dir=path.parent, prefix=".video-") as folder,
    ):
        draft = Path(folder) / "video.mp4"
        count = _encode(draft, frames, fps)
        stored = _frame_count(draft)
        if stored != count:
            raise OutputError(
                f"cannot write {printable(path, 200)}: {stored} of {count} frames were stored; "
                "free some space and run it again"
            )
        with draft.open("rb") as encoded:
            shutil.copyfileobj(encoded, whole)
    return count


def _of_one_size(frames: Iterable[UInt8]) -> Iterator[UInt8]:
    """The frames, at least one, each of the size of the first; or an error that says which not."""
    first: tuple[int, ...] = ()
    for index, image in enumerate(frames):
        image = image_uint8(f"frame {index}", image)
        first = first or image.shape
        if image.shape != first:
            raise ArgumentError(
                f"frame {index} is {image.shape[0]}x{image.shape[1]}, the first is "
                f"{first[0]}x{first[1]}; a video has one size"
            )
        yield image
    if not first:
        raise ArgumentError("a video needs at least one frame")


def _encode(draft: Path, frames: Iterable[UInt8], fps: float) -> int:
    """Write frames without their odd last row or column; return how many were handed over."""
    writer: Any = None
    count = 0
    try:
        for image in frames:
            height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
            writer = writer or _opened(draft, width, height, fps)
            writer.write(cv2.cvtColor(image[:height, :width], cv2.COLOR_RGB2BGR))
            count += 1
    finally:
        if writer is not None:
            writer.release()
    return count


def _opened(draft: Path, width: int, height: int, fps: float) -> Any:
    if not width or not height:
        raise ArgumentError("a video needs pictures of 2x2 pixels or more")
    code = cv2.VideoWriter.fourcc(*"mp4v")
    writer = cv2.VideoWriter(str(draft), cv2.CAP_FFMPEG, code, fps, (width, height))
    if not writer.isOpened():
        raise OutputError(
            "this OpenCV cannot encode MP4 (no FFmpeg with mp4v); install "
            "opencv-contrib-python-headless, or name a folder for PNG files instead"
        )
    return writer


def _frame_count(video: Path) -> int:
    reader = cv2.VideoCapture(str(video), cv2.CAP_FFMPEG)
    try:
        return int(reader.get(cv2.CAP_PROP_FRAME_COUNT)) if reader.isOpened() else 0
    finally:
        reader.release()
