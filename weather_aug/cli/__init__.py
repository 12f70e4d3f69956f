"""The command line: what `Command` lists, from demo to train-editor."""

from __future__ import annotations

import json
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from weather_aug import __version__, _files
from weather_aug.cli.build import Build
from weather_aug.cli.export import Export
from weather_aug.cli.inspect import Inspect
from weather_aug.cli.merge import Merge
from weather_aug.cli.pairs import ListPairs
from weather_aug.cli.render import Render
from weather_aug.cli.terminal import check_folder, complain, say, to_people
from weather_aug.cli.train import TrainEditor
from weather_aug.cli.view import View
from weather_aug.errors import ArgumentError, WeatherAugError, printable
from weather_aug.taxonomy import IGNORE

DEMO_WIDTH_PX = (32, 4096)
"""Narrower, a picture of nine sixteenths its width has too few rows for the street."""
DEMO_STREET = 3
"""Seed of a street on which a car comes with its lamps on in the middle of the drive."""


@dataclass(frozen=True)
class Sweep:
    """Make one labelled picture of all weathers and severities, or of four states."""

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
    states: bool = False
    """Show a wet road without rain, fresh snow under clear air, dense fog with lamps, and heavy
    rain through wet glass instead."""
    without: tuple[str, ...] = ()
    """Effects to leave out, such as mirror lamps drops; see `RenderOptions.without`."""

    def run(self) -> None:
        """Render the grid and name its file."""
        from weather_aug.clip.types import FrameKey
        from weather_aug.render.options import RenderOptions
        from weather_aug.scene.scene import WeatherScene
        from weather_aug.view.sheet import states, sweep, write_png

        options = RenderOptions(without=self.without)
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
        draw = states if self.states else sweep
        sheet = draw(scene, key, seed=self.seed, tile_width=self.tile_width, options=options)
        write_png(self.out, sheet)
        say(str(self.out))


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
        from weather_aug.view.sheet import contact_sheet, states, write_png

        start = time.perf_counter()
        low, high = DEMO_WIDTH_PX
        if not low <= self.width <= high:
            raise ArgumentError(f"width must be in [{low}, {high}] pixels, got {self.width}")
        height = self.width * 9 // 16
        clip = open_clip(
            f"street:?seed={DEMO_STREET}&frames={self.frames}&width={self.width}&height={height}"
        )
        check_folder(self.out)
        say("1/3 build a scene of the procedural street, three cameras (the first run compiles)")
        with _files.reported(self.out):
            self.out.mkdir(parents=True, exist_ok=True)
        scene = WeatherScene.build(clip, self.out / "scene", progress=to_people(), overwrite=True)
        say("2/3 draw weather on the fly, as a training loop does")
        dataset = WeatherDataset([scene], seed=10)
        for index in range(0, len(dataset), max(1, len(dataset) // 3)):
            sample = dataset[index]
            ignored = (sample["label"] == IGNORE).float().mean()
            say(f"    {_state(sample['recipe'])}; {ignored:.1%} of the label ignored")
        say("3/3 render four states of the street, then rain, snow and fog by severity")
        middle = scene.keys[len(scene.keys) // 2].time_index
        keys = [key for key in scene.keys if key.time_index == middle]
        front = next(key for key in keys if key.camera == "front")
        write_png(self.out / "states.png", states(scene, front))
        sheet = self.out / "contact_sheet.png"
        write_png(sheet, contact_sheet(scene, keys))
        say(f"done in {time.perf_counter() - start:.0f} s; look at")
        say(str(self.out / "states.png"))
        say(str(sheet))


Command = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Build, tyro.conf.subcommand("build")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[Sweep, tyro.conf.subcommand("sweep")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Merge, tyro.conf.subcommand("merge")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[Inspect, tyro.conf.subcommand("inspect")]
    | Annotated[ListPairs, tyro.conf.subcommand("list-pairs")]
    | Annotated[TrainEditor, tyro.conf.subcommand("train-editor")]
)


def main(arguments: list[str] | None = None) -> None:
    """Run one command; an error is one line and an exit code (see `weather_aug.errors`)."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments == ["--version"]:
        say(f"weather-aug {__version__}")
        return
    command = tyro.cli(
        Command,
        prog="weather-aug",
        description="Rain, snow and fog for driving images; --version prints the version.",
        args=arguments,
    )
    try:
        command.run()
    except WeatherAugError as error:
        complain(str(error))
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        goes_on = isinstance(command, Build | Export | TrainEditor)
        cure = "; run the same command again to continue" if goes_on else ""
        complain(f"interrupted{cure}")
        sys.exit(130)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _state(recipe: str) -> str:
    """One line of a sample's recipe for people: the frame, and what is not zero in its weather."""
    sample = json.loads(recipe)
    weather = sample["weather"].items()
    state = ", ".join(
        f"{name} {value:.3g}" for name, value in weather if isinstance(value, float) and value
    )
    return f"{sample['camera']} {sample['time_index']}: {state or 'clear'}"
