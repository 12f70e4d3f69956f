"""The command that writes an offline data set: what it will be, how it goes, what it became."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

from weather_aug.cli.terminal import complain, say, to_people
from weather_aug.cli.values import check_local, numbers_by_name
from weather_aug.errors import ArgumentError, DataError, IntegrityError, OutputError, printable

if TYPE_CHECKING:
    from weather_aug.scene.scene import WeatherScene
    from weather_aug.writers.balance import ClassBalance
    from weather_aug.writers.plan import ExportPlan
    from weather_aug.writers.shards import Shard

COUNT = 1000
RARE_SHOWN = 5
_OF_DRAWS = ("count", "types", "severity", "falling", "balance")
_AGAINST = {"weather": _OF_DRAWS, "list": ("weather", *_OF_DRAWS, "seed"), "shard": ("verify",)}


@dataclass(frozen=True)
class Export:
    """Write an offline data set; run again to continue.

    Says first what it will be, its size and how long it takes (the first run on a machine compiles
    for a minute or two before that); ends with a contact sheet beside the folder (of a url, in the
    working directory) and the classes of what was written.
    """

    scenes: Positional[tuple[Path, ...]]
    """Scene folders."""
    out: str
    """Folder of the data set, or a url that fsspec knows, such as s3://bucket/rainy; credentials
    and other options of a url come from fsspec's configuration (files in ~/.config/fsspec,
    variables FSSPEC_…) and from what its file system reads by itself."""
    state: Path | None = None
    """For a url, folder of lock, journal and root files, by which a second run continues;
    .weather-aug-export in the working directory if not given."""
    count: int | None = None
    """Samples to write of weathers that are drawn; 1000 if not given."""
    types: tuple[str, ...] = ("clear=1", "rain=1", "snow=1", "fog=1")
    """Weather types and how often each is drawn, "type=weight"; "rain+fog=1" is both at once."""
    severity: tuple[float, float] = (0.1, 1.0)
    """Range of severities."""
    falling: float = 0.8
    """Share of rain and snow that falls."""
    balance: tuple[str, ...] | None = None
    """Prefer frames of rare classes, as DAFormer's sampling does; the law's numbers may follow,
    "temperature=0.01" and "min_pixels=3000"."""
    weather: tuple[str, ...] = ()
    """Every frame in each of these instead of drawn weathers: a type and its severity, "clear",
    "rain=0.3", "rain+fog=heavy"."""
    list: Path | None = None
    """Exactly the samples of this JSONL file instead, such as chosen lines of a manifest.jsonl; see
    `weather_aug.writers.listed`."""
    seeds: int = 1
    """With --weather: how often, each time with other particles; from --seed on."""
    seed: int = 0
    """Of all draws."""
    layout: str = "cityscapes"
    """Where files stand: cityscapes, acdc, gta, folders, or webdataset."""
    parts: tuple[str, ...] | None = None
    """What a sample consists of: image, label, invalid, transmittance, depth; the layout's choice
    if not given."""
    split: str = "train"
    """Folder such as train or val."""
    workers: int = 1
    """Processes, or actors of Ray; the result does not depend on it."""
    engine: Literal["process", "inline", "ray"] = "process"
    """Who renders: processes of this machine, this process alone, or Ray."""
    address: str | None = None
    """Of a Ray cluster, which must see --out; without one Ray starts on this machine."""
    shard: str | None = None
    """Render a part only, "3/16" the third of sixteen, counted from 1 as array jobs are, beside
    machines that render the others into the same --out; finish with the same command without it."""
    verify: bool = False
    """Compare every byte of what is there already, not only sizes, and repair what differs."""
    dry_run: bool = False
    """Say what would be written, and write nothing."""
    quiet: bool = False
    """Neither summary nor progress, sheet or classes."""

    def run(self) -> None:
        """Say what will be written, export, and show what was."""
        from weather_aug.writers.export import export, export_target
        from weather_aug.writers.source import source_of

        self._check()
        shard = None if self.shard is None else parsed_shard(self.shard)
        plan = self.plan()
        if not self.dry_run:
            # Before anything is measured for a place that will be refused.
            export_target(plan, self.out, self.state)
        if not self.quiet or self.dry_run:
            self._summarise(plan, shard)
        if self.dry_run:
            return
        report = export(
            plan,
            self.out,
            workers=self.workers,
            engine=self.engine,
            address=self.address,
            shard=None if shard is None else (shard.number, shard.of),
            state=self.state,
            progress=to_people() and not self.quiet,
            verify=self.verify,
        )
        out = source_of(self.out)
        if shard is None:
            say(f"{report.samples} samples in {out}")
        elif report.finished:
            say(f"{out} is finished already, {report.samples} samples; {shard} has nothing to do")
            return
        else:
            say(
                f"{report.samples} samples of {shard} are committed in {out}; when all shards are "
                "done, the same command without --shard finishes the export"
            )
        unlabelled = report.samples - report.labelled
        if unlabelled and "label" in plan.parts:
            complain(f"warning: {unlabelled} of {report.samples} samples have no label")
        if shard is None and not self.quiet:
            self._show()

    def plan(self) -> ExportPlan:
        """What the flags ask for.

        Raises:
            ArgumentError: If a flag's value is none.
            DataError: If a list or a scene cannot be read.
        """
        from weather_aug.scene.policy import WeatherPolicy
        from weather_aug.writers.plan import plan_export, plan_grid, plan_list

        where: dict[str, Any] = {
            "layout": self.layout,
            "parts": self.parts,
            "split": self.split,
        }
        if self.list is not None:
            return plan_list(self._scenes(), self.list, **where)
        if self.weather:
            seeds = range(self.seed, self.seed + self.seeds)
            return plan_grid(self._scenes(), self.weather, seeds, **where)
        policy = WeatherPolicy(parsed_types(self.types), self.severity, self.falling)
        balance = None if self.balance is None else parsed_balance(self.balance)
        return plan_export(
            *(self._scenes(), policy),
            count=COUNT if self.count is None else self.count,
            seed=self.seed,
            balance=balance,
            progress=to_people() and not self.quiet,
            **where,
        )

    def _scenes(self) -> Sequence[WeatherScene]:
        from weather_aug.scene.scene import WeatherScene

        return [WeatherScene.load(path) for path in self.scenes]

    def _check(self) -> None:
        """Refuse flags that mean nothing together, and urls where there can be none."""
        check_local(*self.scenes, *(path for path in (self.list, self.state) if path is not None))
        for name, others in _AGAINST.items():
            if getattr(self, name) == getattr(Export, name):
                continue
            clash = [other for other in others if getattr(self, other) != getattr(Export, other)]
            if clash:
                raise ArgumentError(f"--{name} does not go with --{clash[0]}")
        if self.address is not None and self.engine != "ray":
            raise ArgumentError("--address is of a Ray cluster; give --engine ray with it")
        if self.seeds != Export.seeds and not self.weather:
            raise ArgumentError("--seeds needs --weather; --count says how many samples are drawn")

    def _summarise(self, plan: ExportPlan, shard: Shard | None) -> None:
        from weather_aug.writers.choices import FromPolicy
        from weather_aug.writers.estimate import committed, estimate
        from weather_aug.writers.export import state_of
        from weather_aug.writers.shards import WHOLE

        frames = sum(len(scene.keys) for scene in plan.scenes)
        of = "scene" if len(plan.scenes) == 1 else "scenes"
        say(f"plan     {plan.count} samples of {frames} frames in {len(plan.scenes)} {of}")
        say(f"weather  {_shares(plan.choice.shares())}")
        if isinstance(plan.choice, FromPolicy) and plan.choice.balance is not None:
            rare = list(plan.choice.balance.shares().items())[:RARE_SHOWN]
            say(f"classes  frames are chosen for {_shares(dict(rare))}")
        engine = "this process" if self.workers <= 1 else f"{self.workers} processes"
        if self.engine == "ray":
            engine = f"{self.workers} actors of Ray"
        say(f"layout   {plan.layout.name}, {plan.split}: {', '.join(plan.parts)}; by {engine}")
        part = WHOLE if shard is None else shard
        count = part.count(plan)
        if shard is not None:
            say(f"shard    {shard.number} of {shard.of}: {count} samples")
        done = committed(state_of(self.out, self.state), plan, part)
        if done == count:
            say("time     all samples are there already")
            return
        cost = estimate(plan)
        there = f"; {done} samples are there already" if done else ""
        size = told_bytes(count * cost.bytes_per_sample)
        say(f"size     about {size}, {told_bytes(cost.bytes_per_sample)} a sample")
        say(
            f"time     about {told_seconds(cost.seconds(self.workers, count - done))}, "
            f"{cost.seconds_per_sample:.2g} s a sample ({cost.measured} measured){there}"
        )

    def _show(self) -> None:
        """Classes and a contact sheet of what was written."""
        from weather_aug.view.histogram import class_bars
        from weather_aug.view.sheet import write_png
        from weather_aug.writers.written import read_written, written_sheet

        sheet = sheet_of(self.out)
        try:
            written = read_written(self.out)
            picture = written_sheet(self.out, written)
            write_png(sheet, picture)
        except (DataError, IntegrityError) as error:
            complain(f"warning: {error}; run the same export again with --verify to repair it")
            return
        except OutputError as error:
            # The data set itself is whole; its folder may be all that can be written.
            complain(f"warning: no contact sheet: {error}")
            return
        if written.shares is not None:
            labels = f"{written.counted} of {written.labelled} labels"
            say(f"share of pixels by class, {labels}; bars are logarithmic:")
            for line in class_bars(written.shares, colour=sys.stdout.isatty()):
                say(line)
        say("look at")
        say(str(sheet))


def sheet_of(out: str) -> Path:
    """Where the contact sheet goes: beside a folder; of a url, into the working directory."""
    from weather_aug.writers.place import Place
    from weather_aug.writers.source import is_url

    if is_url(out):
        return Path(f"{Place(out).name}.png")
    path = Path(out) if Path(out).name else Path(out).absolute()
    return path.with_name(f"{path.name}.png")


def parsed_shard(text: str) -> Shard:
    """The shard of a text "i/n".

    Raises:
        ArgumentError: If there is no such shard.
    """
    from weather_aug.writers.shards import Shard

    numbers = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text)
    if numbers is None:
        raise ArgumentError(f"--shard takes i/n, such as 3/16, got {printable(text)!r}")
    return Shard(int(numbers[1]), int(numbers[2]))


def parsed_types(items: tuple[str, ...]) -> dict[str, float]:
    """Weights by weather type of texts "type=weight"; what a type is, `WeatherPolicy` decides.

    Raises:
        ArgumentError: If a text is no type and number, or a type stands twice.
    """
    return numbers_by_name("--types", "type=weight, such as rain=2 rain+fog=1", items)


def parsed_balance(items: tuple[str, ...]) -> ClassBalance:
    """The balance of texts "name=number"; none stands for the defaults.

    Raises:
        ArgumentError: If a text is no name and number, or there is no such name.
    """
    from weather_aug.writers.balance import ClassBalance

    form = "temperature=0.01 and min_pixels=3000"
    numbers = numbers_by_name("--balance", form, items)
    if not set(numbers) <= {"temperature", "min_pixels"}:
        raise ArgumentError(f"--balance takes {form}, got {', '.join(numbers)}")
    return ClassBalance(**numbers)  # type: ignore[arg-type]


def told_bytes(count: float) -> str:
    """A size in the unit, of 1000s, that people would take, to three digits."""
    units = ["B", "kB", "MB", "GB", "TB"]
    while count >= 999.5 and units[1:]:
        count, units = count / 1000, units[1:]
    return f"{count:.3g} {units[0]}"


def told_seconds(seconds: float) -> str:
    """A time in the unit that people would take, to two digits."""
    for unit, size in (("days", 86_400), ("h", 3600), ("min", 60)):
        value = seconds / size
        if value >= 2:
            return f"{value:.0f} {unit}" if value >= 9.95 else f"{value:.1f} {unit}"
    return f"{max(1, round(seconds))} s"


def _shares(shares: dict[str, float]) -> str:
    from weather_aug.view.histogram import percent

    return ", ".join(f"{name} {percent(share)}" for name, share in shares.items())
