"""The command line: build | render | sweep | export | inspect | demo."""

from __future__ import annotations

import json
import os
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from weather_aug import _files
from weather_aug.errors import ArgumentError, DataError, IntegrityError, WeatherAugError, printable
from weather_aug.taxonomy import IGNORE


@dataclass(frozen=True)
class Build:
    """Precompute a clip into a scene folder; run again to continue interrupted work."""

    clip: Positional[str]
    """Clip, "scheme:path?option=value&…" (kitti-odometry, kitti-raw, dgp, folder, street)."""
    out: Path
    """Scene folder to make."""
    editor: str = "physical"
    """How backgrounds get their weather."""
    weathers: tuple[str, ...] = ("rain", "snow", "fog")
    """Types the scene is meant for."""
    overwrite: bool = False
    """Replace the scene that stands in `out`."""

    def run(self) -> None:
        """Build and say what was made."""
        from weather_aug.clip.open import open_clip
        from weather_aug.scene.scene import WeatherScene

        clip = open_clip(self.clip)
        scene = WeatherScene.build(
            clip,
            self.out,
            editor=self.editor,
            weathers=self.weathers,
            progress=_to_people(),
            overwrite=self.overwrite,
        )
        _say(f"{len(scene.keys)} frames of {', '.join(scene.cameras)} in {self.out}")


@dataclass(frozen=True)
class Render:
    """Render frames of a scene in one weather, as PNG files."""

    scene: Positional[Path]
    """Scene folder."""
    weather: str = "rain"
    """Weather type: clear, rain, snow, fog."""
    severity: str = "heavy"
    """light, moderate, heavy, extreme, or a number in [0, 1]."""
    falling: bool = True
    """Whether it rains or snows, or only did."""
    out: Path = Path("out/render")
    """Folder for the pictures."""
    camera: str | None = None
    """Only this camera."""
    seed: int = 0
    """Which particles fall."""
    max_particles: int = 30_000
    """Expected number of resolved particles in a picture at the most."""
    labels: bool = False
    """Write the remapped labels and the invalid mask too."""

    def run(self) -> None:
        """Render and name the folder."""
        from tqdm.auto import tqdm

        from weather_aug.render.compose import RenderOptions
        from weather_aug.scene.policy import weather_of
        from weather_aug.scene.scene import WeatherScene
        from weather_aug.view.sheet import write_png

        scene = WeatherScene.load(self.scene)
        keys = [k for k in scene.keys if self.camera in (None, k.camera)]
        if not keys:
            raise ArgumentError(
                f"scene {scene.name} has no camera {printable(self.camera)!r}; it has "
                f"{', '.join(scene.cameras)}"
            )
        weather = weather_of(self.weather, _severity(self.severity), falling=self.falling)
        options = RenderOptions(self.max_particles)
        for key in tqdm(keys, desc="render", unit="frame", disable=not _to_people()):
            shot = scene.render(key, weather, seed=self.seed, options=options)
            write_png(self.out / f"{key}.png", shot.image)
            if self.labels and shot.label is not None:
                write_png(self.out / f"{key}_labelTrainIds.png", shot.label)
                write_png(self.out / f"{key}_invIds.png", shot.invalid)
        _say(f"{len(keys)} pictures in {self.out}")


@dataclass(frozen=True)
class Sweep:
    """Make one labelled picture of all weathers and severities."""

    scene: Positional[Path]
    """Scene folder."""
    out: Path = Path("out/sweep.png")
    """Picture to write."""
    camera: str | None = None
    """Camera to show; the first if not given."""
    time: int | None = None
    """Time index to show; the middle one if not given."""
    seed: int = 0
    """Which particles fall."""
    tile_width: int = 480
    """Width of each picture, pixels."""

    def run(self) -> None:
        """Render the grid and name its file."""
        from weather_aug.clip.types import FrameKey
        from weather_aug.scene.scene import WeatherScene
        from weather_aug.view.sheet import sweep, write_png

        scene = WeatherScene.load(self.scene)
        camera = self.camera or scene.cameras[0]
        times = [k.time_index for k in scene.keys if k.camera == camera]
        if not times:
            raise ArgumentError(
                f"scene {scene.name} has no camera {printable(camera)!r}; it has "
                f"{', '.join(scene.cameras)}"
            )
        time_index = times[len(times) // 2] if self.time is None else self.time
        key = FrameKey(time_index, camera)
        write_png(self.out, sweep(scene, key, seed=self.seed, tile_width=self.tile_width))
        _say(str(self.out))


@dataclass(frozen=True)
class Export:
    """Write an offline data set in the Cityscapes layout; run again to continue."""

    scenes: Positional[tuple[Path, ...]]
    """Scene folders."""
    out: Path
    """Folder of the data set."""
    count: int = 1000
    """Samples to write."""
    types: dict[str, float] = field(
        default_factory=lambda: {"clear": 1.0, "rain": 2.0, "snow": 2.0, "fog": 1.0}
    )
    """Weight of each weather type."""
    severity: tuple[float, float] = (0.1, 1.0)
    """Range of severities."""
    falling: float = 0.8
    """Share of rain and snow that falls."""
    seed: int = 0
    """Of all draws."""
    workers: int = 1
    """Processes; the result does not depend on it."""

    def run(self) -> None:
        """Export and say what was written."""
        from weather_aug.scene.policy import WeatherPolicy
        from weather_aug.scene.scene import WeatherScene
        from weather_aug.writers.export import export
        from weather_aug.writers.plan import plan_export

        scenes = [WeatherScene.load(path) for path in self.scenes]
        policy = WeatherPolicy(self.types, self.severity, self.falling)
        plan = plan_export(scenes, policy, count=self.count, seed=self.seed)
        export(plan, self.out, workers=self.workers, progress=_to_people())
        _say(f"{self.count} samples in {self.out}")


@dataclass(frozen=True)
class Inspect:
    """Say what a scene or an export holds, and whether every byte is the one written."""

    path: Positional[Path]
    """Scene or export folder."""

    def run(self) -> None:
        """Print the contents, then verify; damage ends with exit code 4."""
        problems = _inspected(self.path)
        for problem in problems[1:]:
            _say(problem)
        if problems:
            raise IntegrityError(problems[0])
        _say("every file is whole")


@dataclass(frozen=True)
class Demo:
    """Go the whole way on the procedural street; ends with a contact sheet to look at."""

    out: Path = Path("out/demo")
    """Folder of the scene and the sheet."""
    frames: int = 6
    """Time steps of the street, at 10 Hz."""
    width: int = 960
    """Width of its pictures, pixels; the height is nine sixteenths of it."""

    def run(self) -> None:
        """Build the street, draw samples, and make the sheet."""
        from weather_aug.clip.open import open_clip
        from weather_aug.scene.scene import WeatherScene
        from weather_aug.transforms.dataset import WeatherDataset
        from weather_aug.view.sheet import contact_sheet, write_png

        start = time.perf_counter()
        _say("1/3 build a scene of the procedural street, three cameras (the first run compiles)")
        with _files.reported(self.out):
            self.out.mkdir(parents=True, exist_ok=True)
        height = self.width * 9 // 16
        clip = open_clip(f"street:?frames={self.frames}&width={self.width}&height={height}")
        scene = WeatherScene.build(clip, self.out / "scene", progress=_to_people(), overwrite=True)
        _say("2/3 draw weather on the fly, as a training loop does")
        dataset = WeatherDataset([scene], seed=1)
        for index in range(0, len(dataset), max(1, len(dataset) // 3)):
            sample = dataset[index]
            ignored = (sample["label"] == IGNORE).float().mean()
            _say(f"    {_state(sample['recipe'])}; {ignored:.1%} of the label ignored")
        _say("3/3 render rain, snow and fog at three severities")
        middle = scene.keys[len(scene.keys) // 2].time_index
        keys = [key for key in scene.keys if key.time_index == middle]
        sheet = self.out / "contact_sheet.png"
        write_png(sheet, contact_sheet(scene, keys))
        _say(f"done in {time.perf_counter() - start:.0f} s; look at")
        _say(str(sheet))


Command = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Build, tyro.conf.subcommand("build")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[Sweep, tyro.conf.subcommand("sweep")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Inspect, tyro.conf.subcommand("inspect")]
)


def main(arguments: list[str] | None = None) -> None:
    """Run one command; an error is one line and an exit code (see `weather_aug.errors`)."""
    command = tyro.cli(
        Command,
        prog="weather-aug",
        description="Rain, snow and fog for driving images.",
        args=arguments,
    )
    try:
        command.run()
    except WeatherAugError as error:
        print(f"weather-aug: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        print("weather-aug: interrupted; run the same command again to continue", file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _inspected(path: Path) -> list[str]:
    from weather_aug.scene import store
    from weather_aug.writers import layout
    from weather_aug.writers.verify import verify_export

    if (path / store.MANIFEST).is_file():
        return _inspect_scene(path)
    if any((path / name).exists() for name in (layout.CONTENTS, layout.JOURNAL)):
        return verify_export(path)
    raise DataError(
        f"{printable(path, 200)} is neither a scene (no {store.MANIFEST}) nor an export (no "
        f"{layout.CONTENTS})"
    )


def _inspect_scene(path: Path) -> list[str]:
    from weather_aug.scene.scene import WeatherScene

    scene = WeatherScene.load(path)
    manifest = scene.manifest
    labelled = sum("label" in record.files for record in manifest.frames)
    size_mib = sum(stored.size for stored in manifest.files.values()) / 2**20
    _say(f"scene {scene.name}, digest {scene.digest[:12]}, editor {manifest.editor}")
    _say(f"{len(scene.keys)} frames ({labelled} labelled) of {', '.join(scene.cameras)}")
    _say(f"{len(manifest.files)} files, {size_mib:.1f} MiB")
    return scene.damaged_files()


def _state(recipe: str) -> str:
    """One line of a sample's recipe for people: the frame, and what is not zero in its weather."""
    sample = json.loads(recipe)
    weather = sample["weather"].items()
    state = ", ".join(
        f"{name} {value:.3g}" for name, value in weather if isinstance(value, float) and value
    )
    return f"{sample['camera']} {sample['time_index']}: {state or 'clear'}"


def _severity(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def _say(text: str) -> None:
    print(text, flush=True)


def _to_people() -> bool:
    return sys.stderr.isatty()


if __name__ == "__main__":
    main()
