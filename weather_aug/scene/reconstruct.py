"""Rounds of a build: the stored frames → Gaussians and their classes; with layers, weather styles.

Each step stands in a journal of its own, with all that it depends on: geometry on the frames and
the options, classes on the geometry, styles on the geometry, on the layers, which the physical
editor needs, and on the backgrounds that another editor stored. A build that was cut short goes on
after the last whole step, and within the fit from its last checkpoint.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from weather_aug import __version__, _files
from weather_aug.clip.types import Frame
from weather_aug.edit.physical.edit import edited
from weather_aug.errors import ArgumentError, printable
from weather_aug.scene import store
from weather_aug.scene.backdrop import read_background
from weather_aug.scene.journal import Round, make_all
from weather_aug.scene.policy import TYPES
from weather_aug.scene.reconstruction import (
    encode_geometry,
    encode_labels,
    encode_style,
    joined,
    read_reconstruction,
)
from weather_aug.scene.reconstruction_record import GAUSSIANS, parse_reconstruction
from weather_aug.scene.records import FrameRecord, Manifest, StoredFile
from weather_aug.scene.styles import style_weather

if TYPE_CHECKING:
    from weather_aug.gaussians.options import FitOptions
    from weather_aug.gaussians.types import Reconstruction

FITTING = "fitting"
"""Folder of journals and checkpoints in a work folder; a finished scene has none."""
TIMINGS = ("minutes",)
"""What the fit tells of itself and differs from one run to the next; a scene's bytes do not."""

Made = tuple[dict[str, Any], dict[str, bytes]]


class Wanted(NamedTuple):
    """What is to be reconstructed."""

    options: FitOptions
    styles: tuple[str, ...]
    """Names of weathers."""


class StoredFrames(Sequence[Frame]):
    """Frames of a scene folder, read each time they are asked for.

    Args:
        folder: With the frames' files.
        records: Of the frames, in their order.
        change: What becomes of each frame.
    """

    def __init__(
        self,
        folder: Path,
        records: Sequence[FrameRecord],
        change: Callable[[FrameRecord, Frame], Frame] = lambda record, frame: frame,
    ) -> None:
        self.folder, self.records, self.change = folder, records, change

    def __len__(self) -> int:
        return len(self.records)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return StoredFrames(self.folder, self.records[index], self.change)
        record = self.records[index]
        return self.change(record, store.read_frame(self.folder, record))


def wanted_of(options: FitOptions | None, styles: Sequence[str]) -> Wanted:
    """Checked choices.

    Raises:
        ArgumentError: If the options are none, or a style is no weather or stands twice.
    """
    from weather_aug.gaussians.options import FitOptions

    options = FitOptions() if options is None else options
    if not isinstance(options, FitOptions):
        raise ArgumentError(f"reconstruction must be FitOptions, got {type(options).__name__}")
    if isinstance(styles, str):
        raise ArgumentError(f'styles must be a sequence of names; write styles=("{styles}",)')
    known = [name for name in TYPES if name != "clear"]
    for name in styles:
        if name not in known:
            raise ArgumentError(f"style {printable(name)!r} is not one of {', '.join(known)}")
    if len(set(styles)) < len(styles):
        raise ArgumentError("styles names one of them twice")
    return Wanted(options, tuple(styles))


class Built(NamedTuple):
    """What is reconstructed so far."""

    entries: tuple[dict[str, Any], ...]
    """For the manifest, to be joined; of each step."""
    files: dict[str, Any]
    """Sizes and digests by relative path."""
    scene: Reconstruction

    @property
    def entry(self) -> dict[str, Any]:
        """The manifest's."""
        return joined(self.entries)

    @property
    def digest(self) -> str:
        """Of all files."""
        return _digest_of(self.files)


def write_geometry(
    work: Path, manifest: Manifest, files: Mapping[str, Any], wanted: Wanted, *, progress: bool
) -> Built:
    """Reconstruct the frames in `work`: geometry, and its classes.

    Args:
        work: Folder with all frames.
        manifest: That names them.
        files: Their sizes and digests.
        wanted: What to reconstruct.
        progress: Show bars.

    Raises:
        SceneError: If what was fitted cannot be stored.
        OutputError: If the work folder cannot be written.
    """
    with _files.reported(work):
        (work / FITTING).mkdir(exist_ok=True)
        (work / GAUSSIANS).mkdir(exist_ok=True)
    # The result does not depend on threads.
    options = asdict(wanted.options) | {"threads": 0}
    head = {"frames": _digest_of(files), "options": _digest_of(options)}
    entry, made = _done(
        work, "geometry", head, lambda: _geometry(work, manifest, wanted.options, progress)
    )
    bare = _read(work, entry, made)
    head = {"geometry": _digest_of(made)} | head
    classes, more = _done(
        work, "labels", head, lambda: _labels(work, manifest, wanted.options, bare, progress)
    )
    entries, written = (entry, classes), made | more
    return Built(entries, written, _read(work, joined(entries), written))


def write_styles(
    work: Path,
    manifest: Manifest,
    files: Mapping[str, Any],
    built: Built,
    wanted: Wanted,
    *,
    progress: bool,
) -> Built:
    """Give what was built the colours of the weathers wanted.

    Args:
        work: Folder with all frames, their layers, backgrounds if there are any, and the geometry.
        manifest: That names them.
        files: Their sizes and digests.
        built: By `write_geometry`.
        wanted: What to reconstruct.
        progress: Show bars.

    Raises:
        SceneError: If what was fitted cannot be stored.
        OutputError: If the work folder cannot be written.
    """
    entries, written = built.entries, dict(built.files)
    if wanted.styles:
        names = list(wanted.styles)
        head = {"frames": _digest_of(files), "geometry": built.digest, "styles": names}
        entry, made = _done(
            work, "styles", head, lambda: _styles(work, manifest, wanted, built.scene, progress)
        )
        entries, written = (*entries, entry), written | made
    # What is built can be read.
    return Built(entries, written, _read(work, joined(entries), written))


def _done(
    work: Path, step: str, head: dict[str, Any], make: Callable[[], Made]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """A step's entry and files; made only if it is not there already, for the same head."""
    head = {"step": step, "version": __version__, **head}
    task = Round(
        *(step, f"{FITTING}/{step}.jsonl", head, (step,), lambda _: make(), lambda _: None),
        tries_first=False,
    )
    record = make_all(task, work, progress=False)[step]
    return record["entry"], record["files"]


def _geometry(work: Path, manifest: Manifest, options: FitOptions, progress: bool) -> Made:
    from weather_aug.gaussians.fit import fit

    # The fit knows its own checkpoints from others.
    folder = work / FITTING / "checkpoints"
    with _files.reported(folder):
        folder.mkdir(exist_ok=True)
    frames = StoredFrames(work, manifest.frames)
    fitted = fit(frames, options, checkpoints=folder, progress=progress)
    entry, parts = encode_geometry(fitted.reconstruction)
    told = {
        name: float(value)
        for name, value in fitted.record.items()
        if isinstance(value, int | float) and name not in TIMINGS
    }
    return entry | {"fit": told}, parts


def _labels(
    work: Path, manifest: Manifest, options: FitOptions, scene: Reconstruction, progress: bool
) -> Made:
    """Class scores where frames have labels, and what the frames showed in any case."""
    from weather_aug.gaussians.frames import resized
    from weather_aug.gaussians.labels import fit_labels, recorded_support

    def smaller(_: FrameRecord, frame: Frame) -> Frame:
        return resized(frame, options.scale)

    frames = list(StoredFrames(work, manifest.frames, smaller))
    if any(frame.label is not None for frame in frames):
        labelled = fit_labels(scene, frames, threads=options.threads, progress=progress)
        return encode_labels(labelled)
    support = recorded_support(scene, frames, threads=options.threads, progress=progress)
    return encode_labels(replace(scene, support=support))


def _styles(
    work: Path, manifest: Manifest, wanted: Wanted, scene: Reconstruction, progress: bool
) -> Made:
    """Colours of all styles at once: they share the work of drawing."""
    from weather_aug.gaussians.frames import resized
    from weather_aug.gaussians.styles import fit_styles

    def frames_in(style: str) -> StoredFrames:
        def edit(record: FrameRecord, frame: Frame) -> Frame:
            return resized(styled_frame(work, manifest, record, frame, style), options.scale)

        return StoredFrames(work, manifest.frames, edit)

    options = wanted.options
    edited_by_style = {name: frames_in(name) for name in wanted.styles}
    styled = fit_styles(scene, edited_by_style, threads=options.threads, progress=progress)
    made = [encode_style(name, styled.styles[name]) for name in wanted.styles]
    parts = {path: data for _, files in made for path, data in files.items()}
    return joined(entry for entry, _ in made), parts


def styled_frame(
    work: Path, manifest: Manifest, record: FrameRecord, frame: Frame, style: str
) -> Frame:
    """A stored frame in a style: its stored background where there is one.

    Else as the physical editor shows it in the style's weather, with nothing in the air.

    Args:
        work: Folder with the frame's files.
        manifest: Of all frames, and of the backgrounds.
        record: Of the frame, with its layers.
        frame: As it was recorded.
        style: Name of a weather.
    """
    if style in manifest.styles:
        return replace(frame, image=read_background(work, record, style))
    layers = store.read_layers(work, record, frame.label)
    weather = style_weather(style)
    assert layers is not None and weather is not None
    window = (0, 0, *frame.image.shape[:2])
    image = edited(frame, layers, weather, manifest.ambience(record), window)
    return replace(frame, image=image)


def _read(work: Path, entry: dict[str, Any], files: dict[str, Any]) -> Reconstruction:
    listed = {path: StoredFile(file["size"], file["sha256"]) for path, file in files.items()}
    record = parse_reconstruction(json.loads(json.dumps(entry)), listed)
    assert record is not None
    return read_reconstruction(work, record)


def _digest_of(value: Any) -> str:
    return _files.sha256_of(json.dumps(value, default=str, sort_keys=True).encode())
