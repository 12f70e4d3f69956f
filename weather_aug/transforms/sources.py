"""Where a data set's frames come from: scenes, or clips for which nothing was precomputed."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.depth_sources import DepthSource
from weather_aug.clip.types import Clip, Frame, FrameKey, Window
from weather_aug.edit.ambience import CAMERA_HEIGHT_M, Ambience, ambience_of
from weather_aug.errors import ArgumentError, printable
from weather_aug.render.compose import RenderedFrame, render
from weather_aug.render.fields import RigMotion
from weather_aug.render.options import RenderOptions
from weather_aug.scene import store
from weather_aug.scene.route import street_axes
from weather_aug.scene.scene import WeatherScene
from weather_aug.scene.viewpoint import Viewpoint
from weather_aug.weather import Weather

UInt8 = NDArray[np.uint8]
Float64 = NDArray[np.float64]

LIGHT_FRAMES = 5
"""Frames of each camera whose light and height stand for those of a clip's whole drive."""


class Known(NamedTuple):
    """What a source says of a frame before anything is drawn."""

    key: FrameKey
    size: tuple[int, int]
    """(height, width), pixels."""
    has_label: bool


class Opened(Protocol):
    """A frame that is about to be rendered; its files are read once, when they are needed."""

    @property
    def size(self) -> tuple[int, int]:
        """(height, width), pixels."""

    @property
    def label(self) -> UInt8 | None:
        """(H, W) train ids of the clear frame; None where nobody labelled it."""

    def render(
        self,
        weather: Weather,
        *,
        seed: int,
        window: Window | None,
        viewpoint: Viewpoint | None,
        options: RenderOptions,
    ) -> RenderedFrame:
        """The frame in a weather; see `WeatherScene.render`."""


class Source(Protocol):
    """Frames that can be rendered in any weather."""

    @property
    def given(self) -> WeatherScene | Clip:
        """The scene or clip."""

    @property
    def keys(self) -> Sequence[FrameKey]:
        """Of all frames."""

    def __str__(self) -> str:
        """What messages call it."""

    def recipe_head(self) -> dict[str, Any]:
        """What recipes of its frames begin with."""

    def digest(self) -> str:
        """16 hexadecimal digits that differ where the frames do, as far as can be told cheaply."""

    def known(self) -> Iterator[Known]:
        """What can be told of frames without reading all of them."""

    def open(self, key: FrameKey) -> Opened:
        """One frame."""

    def label(self, key: FrameKey) -> UInt8 | None:
        """(H, W) train ids of one frame, for statistics."""


def sources_of(given: Any, depth: DepthSource) -> tuple[Source, ...]:
    """A source for each scene or clip.

    Raises:
        ArgumentError: If there is none, or one is neither.
    """
    if isinstance(given, WeatherScene):
        raise ArgumentError("scenes must be a sequence; write WeatherDataset([scene], ...)")
    if isinstance(given, Clip):
        raise ArgumentError("scenes must be a sequence; write WeatherDataset([clip], ...)")
    each = tuple(given) if isinstance(given, Iterable) and not isinstance(given, str) else ()
    if not each or not all(isinstance(one, WeatherScene | Clip) for one in each):
        raise ArgumentError(
            "scenes must be one or more of WeatherScene.load(folder) and open_clip(address)"
        )
    return tuple(
        SceneSource(one) if isinstance(one, WeatherScene) else ClipSource(one, depth, place)
        for place, one in enumerate(each)
    )


@dataclass(frozen=True)
class SceneSource:
    """A precomputed scene: every effect, and views from beside the cameras."""

    given: WeatherScene

    def __str__(self) -> str:
        return f"scene {self.given.name}"

    @property
    def keys(self) -> Sequence[FrameKey]:
        """Of all frames."""
        return self.given.keys

    def recipe_head(self) -> dict[str, Any]:
        """The scene by name and digest, wherever it stands."""
        return {"scene": self.given.name, "scene_digest": self.given.digest}

    def digest(self) -> str:
        """Of the scene's content."""
        return self.given.digest[:16]

    def known(self) -> Iterator[Known]:
        """All frames, from the manifest."""
        for record in self.given.manifest.frames:
            size = (record.camera.height, record.camera.width)
            yield Known(record.key, size, "label" in record.files)

    def open(self, key: FrameKey) -> SceneFrame:
        """One frame."""
        return SceneFrame(self.given, key)

    def label(self, key: FrameKey) -> UInt8 | None:
        """Train ids of one frame, memory-mapped."""
        return self.open(key).label


@dataclass(frozen=True)
class SceneFrame:
    """A frame of a scene."""

    scene: WeatherScene
    key: FrameKey

    @property
    def size(self) -> tuple[int, int]:
        """(height, width), pixels."""
        return self.scene.size_of(self.key)

    @cached_property
    def label(self) -> UInt8 | None:
        """(H, W) train ids, memory-mapped."""
        record = self.scene.manifest.by_key[self.key]
        return store.read_surfaces(self.scene.path, record)[1]

    def render(
        self,
        weather: Weather,
        *,
        seed: int,
        window: Window | None,
        viewpoint: Viewpoint | None,
        options: RenderOptions,
    ) -> RenderedFrame:
        """See `WeatherScene.render`."""
        return self.scene.render(
            self.key, weather, seed=seed, window=window, viewpoint=viewpoint, options=options
        )


class DriveLight(NamedTuple):
    """What all frames of a clip's drive have in common."""

    axes_world: Float64
    """(3, 3), rows along the first heading, to the left, up."""
    airlight: Float64
    """(3,) linear RGB."""
    camera_height_m: Mapping[str, float]
    """Over the road, by camera."""


class ClipSource:
    """A clip for which nothing was precomputed: its files are read for each item.

    Convention:
        As in a scene, a drive has one street and one airlight, and unrelated pictures
        (`is_drive = False`) each their own. A drive's are the medians over a few frames of each
        camera, which are read when the source is made. A frame without depth gets it from `depth`,
        its camera standing `clip.camera_height_m` over the ground, 1.5 m if the clip does not say.
        What only a scene has is missing: bridges over the street, tracks along the way driven,
        stored backgrounds, Gaussians.

    Raises:
        ArgumentError: If the clip has no frames.
        ClipError: If a file of it cannot be read.
    """

    def __init__(self, clip: Clip, depth: DepthSource, place: int) -> None:
        self.given = clip
        self._depth = depth
        self._place = place
        self.keys: Sequence[FrameKey] = tuple(clip.keys)
        if not self.keys:
            raise ArgumentError(f"scenes holds clip {clip.name}, which has no frames")
        text = "\n".join([clip.name, *map(str, self.keys)])
        self._digest = hashlib.blake2b(text.encode(), digest_size=8).hexdigest()
        first = clip.frame(self.keys[0])
        self._first_time_s = first.time_s
        self._first = Known(first.key, _size(first), first.label is not None)
        is_drive = bool(getattr(clip, "is_drive", True))
        self._drive = self._drive_light() if is_drive else None

    def __str__(self) -> str:
        return f"clip {self.given.name}"

    def recipe_head(self) -> dict[str, Any]:
        """The clip by its place among the sources: nothing else is sure to tell two apart."""
        return {"source": self._place, "clip": self.given.name}

    def digest(self) -> str:
        """Of the clip's name and its frames' names; their content would take a pass over all."""
        return self._digest

    def known(self) -> Iterator[Known]:
        """The first frame; others are looked at when they are drawn."""
        yield self._first

    def open(self, key: FrameKey) -> ClipFrame:
        """One frame."""
        return ClipFrame(self, key)

    def label(self, key: FrameKey) -> UInt8 | None:
        """Train ids of one frame; without its picture where the clip can (`clip.label(key)`)."""
        alone = getattr(self.given, "label", None)
        if callable(alone):
            label: UInt8 | None = alone(key)
            return label
        return self.given.frame(key).label

    def read(self, key: FrameKey) -> Frame:
        """A frame with depth, its time since the clip's first."""
        frame = self.given.frame(key)
        depth_m = frame.depth_m
        if depth_m is None:
            height_m = getattr(self.given, "camera_height_m", CAMERA_HEIGHT_M)
            depth_m = self._depth.depth_m(frame.image, frame.label, frame.camera, height_m)
        return replace(frame, depth_m=depth_m, time_s=frame.time_s - self._first_time_s)

    def light_of(self, frame: Frame) -> Ambience:
        """Light and axes around a frame."""
        if self._drive is None:
            return ambience_of(frame, self._axes([frame]))
        height_m = self._drive.camera_height_m[frame.key.camera]
        own = ambience_of(frame, self._drive.axes_world)
        return replace(own, airlight=self._drive.airlight, camera_height_m=height_m)

    def rig_of(self, key: FrameKey) -> RigMotion:
        """Of the first camera, up to the moment of a frame or to the last one before it."""
        seen = [k for k in self.keys if k.camera == self.keys[0].camera]
        before = [k for k in seen if k.time_index <= key.time_index]
        now = before[-1] if before else seen[0]
        poses = (self.given.frame(k).camera.world_from_camera for k in (seen[0], now))
        return RigMotion(*poses)

    def _axes(self, frames: Sequence[Frame]) -> Float64:
        entries = [
            {"camera": f.key.camera, "world_from_camera": f.camera.world_from_camera}
            for f in frames
        ]
        return street_axes(entries, self.given.up_world)

    def _drive_light(self) -> DriveLight:
        by_camera: dict[str, list[FrameKey]] = {}
        for key in self.keys:
            by_camera.setdefault(key.camera, []).append(key)
        frames = [
            [self.read(keys[k]) for k in _evenly(len(keys), LIGHT_FRAMES)]
            for keys in by_camera.values()
        ]
        axes = self._axes(frames[0])
        lights = [[ambience_of(frame, axes) for frame in same] for same in frames]
        airlights = [light.airlight for same in lights for light in same]
        heights_m = [float(np.median([light.camera_height_m for light in same])) for same in lights]
        return DriveLight(
            axes, np.median(airlights, axis=0), dict(zip(by_camera, heights_m, strict=True))
        )


class ClipFrame:
    """A frame of a clip, read once."""

    def __init__(self, source: ClipSource, key: FrameKey) -> None:
        self._source = source
        self._key = key

    @cached_property
    def _frame(self) -> Frame:
        return self._source.read(self._key)

    @property
    def size(self) -> tuple[int, int]:
        """(height, width), pixels."""
        return _size(self._frame)

    @property
    def label(self) -> UInt8 | None:
        """(H, W) train ids."""
        return self._frame.label

    def render(
        self,
        weather: Weather,
        *,
        seed: int,
        window: Window | None,
        viewpoint: Viewpoint | None,
        options: RenderOptions,
    ) -> RenderedFrame:
        """See `weather_aug.render.compose.render`.

        Raises:
            ArgumentError: If a viewpoint is asked for; only scenes have Gaussians.
        """
        if viewpoint is not None:
            raise ArgumentError(
                f"{printable(self._source)} can be seen from its cameras only; build a scene of it"
            )
        return render(
            self._frame,
            weather,
            seed=seed,
            ambience=self._source.light_of(self._frame),
            window=window,
            rig=self._source.rig_of(self._key) if options.needs_rig else None,
            options=options,
        )


def _size(frame: Frame) -> tuple[int, int]:
    return frame.camera.height, frame.camera.width


def _evenly(count: int, most: int) -> list[int]:
    """At most `most` places of `count`, the first and the last among them."""
    return sorted(set(np.linspace(0, count - 1, min(count, most)).round().astype(int).tolist()))
