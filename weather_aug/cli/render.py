"""The command that renders: pictures or a video, one weather or a timeline of weathers."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import reduce
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import Positional

from weather_aug import _files
from weather_aug.cli.terminal import check_folder, say, to_people
from weather_aug.errors import ArgumentError, DataError, printable
from weather_aug.severity import parse_severity
from weather_aug.timeline import WeatherTimeline
from weather_aug.weather import Weather


@dataclass(frozen=True)
class Render:
    """Render a scene in a weather or a timeline of weathers, as PNG files or as a video."""

    scene: Positional[Path]
    """Scene folder."""
    weather: str = "rain"
    """Weather type: clear, rain, snow, fog, or two at once, such as rain+fog."""
    severity: str = "heavy"
    """light, moderate, heavy, extreme, or a number in [0, 1]."""
    falling: bool = True
    """Whether it rains or snows, or only did."""
    origin: Annotated[str | None, tyro.conf.arg(name="from")] = None
    """Type of the weather that `weather` replaces in the course of time; as severe, and falling."""
    start_s: float | None = None
    """When --from begins to change, seconds since the first frame; at the first picture if not
    given."""
    end_s: float | None = None
    """When --from has changed; at the last picture if not given."""
    timeline: Path | None = None
    """JSON file of a WeatherTimeline, instead of all of these."""
    out: Path = Path("out/render")
    """Folder for the pictures."""
    video: Path | None = None
    """Write a video instead: a file that ends with .mp4, or a new folder for numbered PNG files."""
    fps: float | None = None
    """Pictures per second of the video; the clip's own rate if not given. A drive played at another
    rate is in slow motion, or fast."""
    parked_s: float | None = None
    """Length of a video of one frame while time runs on, as if the car had stopped, seconds."""
    time: int | None = None
    """Time index of that frame; the middle one if not given."""
    camera: str | None = None
    """Only this camera; of a video, the first if not given."""
    seed: int = 0
    """Which particles fall."""
    max_particles: int = 20_000
    """Expected number of resolved particles in a picture at the most."""
    without: tuple[str, ...] = ()
    """Effects to leave out, such as mirror lamps drops; see `RenderOptions.without`."""
    viewpoint: tuple[float, float, float] | None = None
    """Metres to the left of the recorded camera, above it, and ahead of it; of a scene that was
    built with --reconstruct."""
    turn: tuple[float, float, float] | None = None
    """Degrees of yaw to the left, pitch upwards, and roll clockwise from the recorded camera."""
    style: str | None = None
    """Weather whose stored background is shown, or whose colours the Gaussians take, instead of
    what the weather asks for: rain, snow or fog; "physical" for the physical editor's dressing."""
    amount: float = 1.0
    """Of the style, in [0, 1]."""
    without_actors: tuple[int, ...] = ()
    """Track ids of moving objects to leave out."""
    labels: bool = False
    """Write the invalid masks too, and the remapped labels where there are labels."""

    def run(self) -> None:
        """Render and name what was written."""
        self._check()
        self._ends()
        if self.video is None:
            self._write_pictures()
        else:
            self._write_video(self.video)

    def _write_pictures(self) -> None:
        from tqdm.auto import tqdm

        from weather_aug.render.options import RenderOptions
        from weather_aug.scene.scene import WeatherScene
        from weather_aug.view.sheet import write_png
        from weather_aug.view.video import keys_of, shown_s

        options = RenderOptions(self.max_particles, without=self.without)
        check_folder(self.out)
        scene = WeatherScene.load(self.scene)
        keys = scene.keys if self.camera is None else keys_of(scene, self.camera)
        weather = self._weather(*shown_s(scene, keys))
        unlabelled = 0
        for key in tqdm(keys, desc="render", unit="frame", disable=not to_people()):
            shot = scene.render(key, weather, seed=self.seed, options=options, **self._elsewhere())
            write_png(self.out / f"{key}.png", shot.image)
            if self.labels:
                write_png(self.out / f"{key}_invIds.png", shot.invalid)
                if shot.label is not None:
                    write_png(self.out / f"{key}_labelTrainIds.png", shot.label)
            unlabelled += shot.label is None
        say(f"{len(keys)} pictures in {self.out}")
        if self.labels and unlabelled:
            say(f"{unlabelled} of them have no label; only their invalid masks were written")

    def _write_video(self, path: Path) -> None:
        from tqdm.auto import tqdm

        from weather_aug.clip.types import FrameKey
        from weather_aug.render.options import RenderOptions
        from weather_aug.scene.scene import WeatherScene
        from weather_aug.view import video

        options = RenderOptions(self.max_particles, without=self.without)
        video.check_video_path(path)
        scene = WeatherScene.load(self.scene)
        camera = self.camera or scene.cameras[0]
        keys = video.keys_of(scene, camera)
        fps = video.clip_fps(scene, camera) if self.fps is None else self.fps
        if self.parked_s is None:
            weather = self._weather(*video.shown_s(scene, keys))
            count = len(keys)
            frames = video.drive_frames(
                scene, camera, weather, seed=self.seed, options=options, **self._elsewhere()
            )
        else:
            key = FrameKey(self.time, camera) if self.time is not None else keys[len(keys) // 2]
            start_s, _ = video.shown_s(scene, [key])
            weather = self._weather(start_s, start_s + self.parked_s)
            count = video.parked_count(fps, self.parked_s)
            frames = video.parked_frames(
                scene,
                key,
                weather,
                fps=fps,
                duration_s=self.parked_s,
                seed=self.seed,
                options=options,
            )
        shown = tqdm(frames, "render", count, unit="frame", disable=not to_people())
        count = video.write_video(path, shown, fps)
        say(f"{count} frames at {fps:g} per second in {path}")

    def _elsewhere(self) -> dict[str, Any]:
        """What makes it another picture than the recorded one, for `WeatherScene.render`."""
        from weather_aug.scene.viewpoint import Viewpoint

        if self.viewpoint is None and self.turn is None:
            viewpoint = None
        else:
            none = (0.0, 0.0, 0.0)
            viewpoint = Viewpoint(*(self.viewpoint or none), *(self.turn or none))
        return {
            "viewpoint": viewpoint,
            "style": self.style,
            "amount": self.amount,
            "without_actors": self.without_actors,
        }

    def _check(self) -> None:
        """Refuse flags that would mean nothing."""
        default = Render(self.scene)
        given = {f.name for f in fields(self) if getattr(self, f.name) != getattr(default, f.name)}
        for name, needs in _NEEDS.items():
            if name in given and needs not in given:
                raise ArgumentError(f"{_flag(name)} needs {_flag(needs)}")
        for name, against in _AGAINST.items():
            clash = sorted(_flag(other) for other in given & against)
            if name in given and clash:
                raise ArgumentError(f"{_flag(name)} does not go with {', '.join(clash)}")

    def _weather(self, first_s: float, last_s: float) -> Weather | WeatherTimeline:
        """The weather of pictures from one time to another."""
        if self.timeline is not None:
            return _timeline(self.timeline)
        before, after = self._ends()
        if self.origin is None:
            return after
        start_s = first_s if self.start_s is None else self.start_s
        end_s = last_s if self.end_s is None else self.end_s
        return WeatherTimeline.transition(before, after, start_s, end_s)

    def _ends(self) -> tuple[Weather, Weather]:
        """The weather that there was first, and the one after."""
        severity = parse_severity(severity_of(self.severity))
        weather = _weather_of(self.weather, severity, self.falling)
        if not self.falling and not {"rain", "snow"} & set(self.weather.split("+")):
            raise ArgumentError(
                f"--no-falling is for rain and snow, which leave something behind; {self.weather} "
                "does not fall"
            )
        before = weather if self.origin is None else _weather_of(self.origin, severity, True)
        return before, weather


_NEEDS = {
    "fps": "video",
    "parked_s": "video",
    "time": "parked_s",
    "start_s": "origin",
    "end_s": "origin",
    "amount": "style",
}
_AGAINST = {
    "video": {"out", "labels"},
    "parked_s": {"viewpoint", "turn", "style", "amount", "without_actors"},
    "timeline": {"weather", "severity", "falling", "origin", "start_s", "end_s"},
}


def _weather_of(kinds: str, severity: float, falling: bool) -> Weather:
    """The weather of a type, or of several at once with "+" between them."""
    from weather_aug.scene.policy import weather_of

    parts = [weather_of(kind, severity, falling=falling) for kind in kinds.split("+")]
    return reduce(Weather.mix, parts)


def _flag(name: str) -> str:
    return "--" + {"origin": "from", "falling": "no-falling"}.get(name, name).replace("_", "-")


def _timeline(path: Path) -> WeatherTimeline:
    try:
        return WeatherTimeline.from_dict(_files.read_json(path))
    except ArgumentError as error:
        raise DataError(f"{printable(path, 200)}: {error}") from None


def severity_of(text: str) -> float | str:
    """A number if the text is one, else the text: the name of a stop."""
    try:
        return float(text)
    except ValueError:
        return text
