"""Videos: the right moments in the right weather, and files that are whole or absent."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from tiny_clip import RATE_HZ, TinyClip

from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError, ConflictError, OutputError, WeatherAugError
from weather_aug.render.compose import render
from weather_aug.scene.scene import WeatherScene
from weather_aug.timeline import WeatherTimeline
from weather_aug.view import video
from weather_aug.view.video import clip_fps, drive_frames, parked_frames, shown_s, write_video
from weather_aug.weather import Weather

UInt8 = NDArray[np.uint8]

SNOW = Weather.snow("heavy")
SHOWER = WeatherTimeline.transition(Weather.clear(), Weather.rain("heavy"), 0.15, 0.25)
HELD = FrameKey(2, "front")


def moving_bar(count: int, height: int, width: int) -> list[UInt8]:
    """Frames one can tell apart after lossy coding: a red bar that moves over blue."""
    frames = []
    for index in range(count):
        frame = np.full((height, width, 3), (20, 20, 200), np.uint8)
        frame[:, 8 * index : 8 * index + 8] = (220, 20, 20)
        frames.append(frame)
    return frames


def read(path: Path) -> tuple[list[UInt8], float]:
    """All frames of a video, RGB, and its frame rate."""
    reader = cv2.VideoCapture(str(path))
    assert reader.isOpened()
    fps = reader.get(cv2.CAP_PROP_FPS)
    frames = []
    while True:
        there, frame = reader.read()
        if not there:
            return frames, fps
        frames.append(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB))


@pytest.mark.parametrize("weather", [SNOW, SHOWER], ids=["snow", "shower"])
def test_a_drive_is_each_recorded_frame_of_the_camera_in_weather(
    tiny_scene: WeatherScene, weather: Weather | WeatherTimeline
) -> None:
    frames = list(drive_frames(tiny_scene, "right", weather, seed=3))
    keys = [FrameKey(t, "right") for t in range(4)]
    assert len(frames) == len(keys)
    for key, image in zip(keys, frames, strict=True):
        assert np.array_equal(tiny_scene.render(key, weather, seed=3).image, image)


def test_frames_are_rendered_as_they_are_asked_for(
    tiny_scene: WeatherScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    whole = WeatherScene.render

    def counted(self: WeatherScene, key: FrameKey, *args: Any, **named: Any) -> Any:
        asked.append(key)
        return whole(self, key, *args, **named)

    monkeypatch.setattr(WeatherScene, "render", counted)
    frames = drive_frames(tiny_scene, "front", SNOW)
    assert asked == []
    next(frames)
    assert asked == [FrameKey(0, "front")]


@pytest.mark.parametrize("weather", [SNOW, SHOWER], ids=["snow", "shower"])
def test_a_parked_car_sees_time_run_on_over_one_picture(
    tiny_scene: WeatherScene, weather: Weather | WeatherTimeline
) -> None:
    """Each frame by an own call of the renderer, with a camera that rests where it was."""
    held = tiny_scene.frame(HELD)
    still = replace(held.camera, velocity_m_per_s=np.zeros(3))
    frames = list(parked_frames(tiny_scene, HELD, weather, fps=40.0, duration_s=0.1, seed=3))
    assert len(frames) == 4
    for index, image in enumerate(frames):
        time_s = 2 / RATE_HZ + index / 40.0
        expected = render(
            replace(held, camera=still, time_s=time_s),
            weather.at(time_s) if isinstance(weather, WeatherTimeline) else weather,
            seed=3,
            ambience=tiny_scene.ambience(HELD),
            air=weather.air(time_s, 3) if isinstance(weather, WeatherTimeline) else None,
        )
        assert np.array_equal(expected.image, image), index
    assert not np.array_equal(frames[0], frames[1])


def test_streaks_of_a_parked_car_do_not_tell_of_its_drive(tiny_scene: WeatherScene) -> None:
    """The same drops in the same places as in the drive, but other streaks."""
    parked = next(parked_frames(tiny_scene, HELD, SNOW, fps=10, duration_s=0))
    driven = tiny_scene.render(HELD, SNOW).image
    assert not np.array_equal(parked, driven)
    assert np.abs(parked.astype(float).mean() - driven.mean()) < 3


def test_clear_weather_is_the_recorded_video(tiny_scene: WeatherScene) -> None:
    clear = Weather.clear()
    for key, image in zip(
        (FrameKey(t, "front") for t in range(4)),
        drive_frames(tiny_scene, "front", clear),
        strict=True,
    ):
        assert np.array_equal(tiny_scene.frame(key).image, image)
    for image in parked_frames(tiny_scene, HELD, clear, fps=10, duration_s=0.3):
        assert np.array_equal(tiny_scene.frame(HELD).image, image)


def test_a_drive_goes_on_parked_without_a_jump_in_time(tiny_scene: WeatherScene) -> None:
    """A shower whose rain is over in the frame after: only the first parked picture sees it."""
    now_s = 2 / RATE_HZ
    over = WeatherTimeline.transition(Weather.rain("heavy"), Weather.clear(), now_s, now_s + 0.01)
    first, second = parked_frames(tiny_scene, HELD, over, fps=10, duration_s=0.2)
    recorded = tiny_scene.frame(HELD).image
    assert (np.array_equal(first, recorded), np.array_equal(second, recorded)) == (False, True)


def test_the_rate_of_a_drive_is_the_clips(tiny_scene: WeatherScene) -> None:
    assert clip_fps(tiny_scene, "right") == RATE_HZ
    assert shown_s(tiny_scene, [FrameKey(1, "front"), FrameKey(3, "right")]) == (0.1, 0.3)


def test_one_frame_has_no_rate(tmp_path: Path) -> None:
    scene = WeatherScene.build(TinyClip(frames=1), tmp_path / "one")
    with pytest.raises(ArgumentError, match="give fps"):
        clip_fps(scene, "front")
    assert len(list(drive_frames(scene, "front", SNOW))) == 1


@pytest.mark.parametrize(
    ("named", "says"),
    [
        ({"fps": 0}, "fps"),
        ({"fps": float("nan")}, "fps"),
        ({"duration_s": -1}, "duration_s"),
        ({"duration_s": 1e9}, "duration_s"),
        ({"key": FrameKey(9, "front")}, "no frame"),
    ],
    ids=str,
)
def test_wrong_arguments_are_refused_before_the_first_picture(
    tiny_scene: WeatherScene, named: dict[str, Any], says: str
) -> None:
    arguments = {"key": HELD, "fps": 10, "duration_s": 1} | named
    with pytest.raises(ArgumentError, match=says):
        parked_frames(tiny_scene, weather=SNOW, **arguments)


def test_an_unknown_camera_is_refused(tiny_scene: WeatherScene) -> None:
    with pytest.raises(ArgumentError, match="no camera 'rear'"):
        drive_frames(tiny_scene, "rear", SNOW)
    with pytest.raises(ArgumentError, match="no frame"):
        shown_s(tiny_scene, [FrameKey(0, "rear")])


@pytest.mark.parametrize("fps", [10.0, 9.64, 30.0])
@pytest.mark.parametrize("size", [(48, 64), (47, 65)])
def test_an_mp4_reads_back(tmp_path: Path, fps: float, size: tuple[int, int]) -> None:
    frames = moving_bar(7, *size)
    path = tmp_path / "new" / "bar.mp4"
    assert write_video(path, iter(frames), fps) == 7
    back, rate = read(path)
    assert [frame.shape for frame in back] == [(size[0] // 2 * 2, size[1] // 2 * 2, 3)] * 7
    assert rate == pytest.approx(fps, rel=1e-3)
    for index, frame in enumerate(back):
        # Chroma has half the resolution, so that the bar's edges bleed.
        assert np.abs(frame[8:40, 8 * index + 3].astype(int) - (220, 20, 20)).max() < 40
        assert np.abs(frame[8:40, (8 * index + 30) % 64].astype(int) - (20, 20, 200)).max() < 40
    assert [p.name for p in path.parent.iterdir()] == ["bar.mp4"]


def test_a_folder_of_png_files_is_without_loss(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    frames = list(rng.integers(0, 256, (3, 15, 17, 3), dtype=np.uint8))
    (tmp_path / "frames").mkdir()
    assert write_video(tmp_path / "frames", iter(frames), 10) == 3
    names = sorted(path.name for path in (tmp_path / "frames").iterdir())
    assert names == ["000000.png", "000001.png", "000002.png"]
    for name, frame in zip(names, frames, strict=True):
        back = cv2.imread(str(tmp_path / "frames" / name), cv2.IMREAD_COLOR_RGB)
        assert np.array_equal(back, frame)


def broken(frames: list[UInt8]) -> Iterator[UInt8]:
    yield from islice(frames, 2)
    raise KeyboardInterrupt


def test_a_video_is_whole_or_absent(tmp_path: Path) -> None:
    frames = moving_bar(4, 48, 64)
    path = tmp_path / "bar.mp4"
    with pytest.raises(KeyboardInterrupt):
        write_video(path, broken(frames), 10)
    assert list(tmp_path.iterdir()) == []
    write_video(path, frames, 10)
    before = path.read_bytes()
    with pytest.raises(KeyboardInterrupt):
        write_video(path, broken(frames), 10)
    assert [p.name for p in tmp_path.iterdir()] == ["bar.mp4"]
    assert path.read_bytes() == before


def test_frames_that_were_not_stored_are_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """OpenCV drops frames without a word, for example when the disk is full."""

    class Forgetful:
        def __init__(self, *arguments: Any) -> None:
            self.writer = whole(*arguments)
            self.count = 0

        def __getattr__(self, name: str) -> Any:
            return getattr(self.writer, name)

        def write(self, frame: UInt8) -> None:
            self.count += 1
            if self.count != 3:
                self.writer.write(frame)

    whole = cv2.VideoWriter
    Forgetful.fourcc = whole.fourcc  # type: ignore[attr-defined]
    monkeypatch.setattr(video.cv2, "VideoWriter", Forgetful)
    with pytest.raises(OutputError, match="4 of 5 frames"):
        write_video(tmp_path / "bar.mp4", moving_bar(5, 48, 64), 10)
    assert list(tmp_path.iterdir()) == []


def test_no_encoder_is_an_output_error_with_a_way_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(video.cv2.VideoWriter, "isOpened", lambda self: False, raising=False)
    with pytest.raises(OutputError, match="folder for PNG files"):
        write_video(tmp_path / "bar.mp4", moving_bar(2, 48, 64), 10)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("path", "frames", "fps", "error", "says"),
    [
        ("a.avi", 1, 10, ArgumentError, "ends with .mp4"),
        ("a.mp4", 1, 0, ArgumentError, "fps"),
        ("a.mp4", 1, 1e9, ArgumentError, "fps"),
        ("a.mp4", 0, 10, ArgumentError, "at least one frame"),
        ("a", 0, 10, ArgumentError, "at least one frame"),
        ("full", 1, 10, ConflictError, "not empty"),
        ("file", 1, 10, OutputError, "is a file"),
        ("folder.mp4", 1, 10, OutputError, "is a folder"),
        ("file/a.mp4", 1, 10, OutputError, "cannot write"),
    ],
)
def test_what_cannot_be_a_video_is_refused(
    tmp_path: Path, path: str, frames: int, fps: float, error: type[WeatherAugError], says: str
) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.png").write_text("mine")
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder.mp4").mkdir()
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(error, match=says):
        write_video(tmp_path / path, moving_bar(frames, 16, 16), fps)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    "second", [np.zeros((16, 18, 3), np.uint8), np.zeros((16, 16, 3)), np.zeros((16, 16), np.uint8)]
)
@pytest.mark.parametrize("name", ["a.mp4", "a"])
def test_frames_of_another_kind_are_refused(tmp_path: Path, name: str, second: Any) -> None:
    with pytest.raises(ArgumentError, match="frame"):
        write_video(tmp_path / name, [np.zeros((16, 16, 3), np.uint8), second], 10)
    assert not (tmp_path / "a.mp4").exists()
