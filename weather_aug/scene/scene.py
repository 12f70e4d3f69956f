"""WeatherScene: a precomputed clip that renders any weather of any of its frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from weather_aug.clip.types import Clip, Frame, FrameKey, Window
from weather_aug.edit.ambience import Ambience
from weather_aug.edit.physical.layers import Layers
from weather_aug.errors import ArgumentError, IntegrityError, printable
from weather_aug.gaussians.types import Reconstruction
from weather_aug.particles.shelter import Shelter
from weather_aug.render.compose import RenderedFrame, render
from weather_aug.render.fields import RigMotion
from weather_aug.render.options import DEFAULT_OPTIONS, RenderOptions
from weather_aug.scene import store
from weather_aug.scene.layers import Street, layers_seen
from weather_aug.scene.reconstruction import read_reconstruction
from weather_aug.scene.records import FrameRecord, Manifest, streets
from weather_aug.timeline import WeatherTimeline
from weather_aug.weather import Weather

if TYPE_CHECKING:
    from weather_aug.air import Air


class WeatherScene:
    """A clip precomputed for weather: pictures, depth, labels, cameras and light on disk.

    Convention:
        A scene is immutable and holds only its folder's path: it opens lazily, and pickles to a
        worker as the path. Pictures are decoded per call; depth, labels and layers are
        memory-mapped, which trusts the storage not to shrink a file while it is open. Rendering is
        a pure function of (scene, key, weather, seed, window, options). A scene that was built
        before layers were stored finds them out at each render, to the same picture; building it
        again makes that time free.
    """

    def __init__(self, path: Path) -> None:
        """Use `WeatherScene.load` or `WeatherScene.build`."""
        self.path = path

    @classmethod
    def load(cls, path: str | Path, *, verify: bool = False) -> WeatherScene:
        """Open a scene folder.

        Args:
            path: Folder that `build` wrote.
            verify: Read every file and compare digests, not only sizes.

        Raises:
            SceneError: If the folder is not a scene this version reads.
            IntegrityError: If a file is missing, has another size or (verify) other bytes.
        """
        scene = cls(Path(path).absolute())
        problems = store.damaged_files(scene.path, scene.manifest) if verify else []
        if problems:
            raise IntegrityError("; ".join(problems[:3]))
        scene.manifest  # noqa: B018 - a scene that cannot be used says so when it is opened
        return scene

    @classmethod
    def build(
        cls,
        clip: Clip,
        out: str | Path,
        *,
        editor: str = "physical",
        weathers: Sequence[str] = ("rain", "snow", "fog"),
        progress: bool = False,
        overwrite: bool = False,
    ) -> WeatherScene:
        """Precompute `clip` into the folder `out`; see `weather_aug.scene.build.build`."""
        from weather_aug.scene.build import build

        build(clip, Path(out), editor, weathers, progress=progress, overwrite=overwrite)
        return cls.load(out)

    @cached_property
    def manifest(self) -> Manifest:
        """The table of contents, read on first use."""
        return store.read_manifest(self.path)

    @property
    def name(self) -> str:
        """Name of the clip."""
        return self.manifest.name

    @property
    def digest(self) -> str:
        """SHA-256 that names the scene's content."""
        return self.manifest.digest

    @cached_property
    def keys(self) -> tuple[FrameKey, ...]:
        """Keys of all frames, by time, then camera."""
        return tuple(record.key for record in self.manifest.frames)

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(dict.fromkeys(record.key.camera for record in self.manifest.frames))

    def frame(self, key: FrameKey) -> Frame:
        """The recorded frame with its depth and label.

        Raises:
            ArgumentError: If the scene has no such frame.
            SceneError: If a file of it cannot be read any more.
        """
        return store.read_frame(self.path, self._record(key))

    def ambience(self, key: FrameKey) -> Ambience:
        """Light around a frame; the axes are the clip's.

        The airlight is the clip's too if it is a drive: fog does not flicker. Of unrelated pictures
        each has its own.
        """
        key = FrameKey(*key)
        light = dict(self._record(key).light)
        if self.manifest.airlight is not None:
            light["airlight"] = self.manifest.airlight
        height_m = self.manifest.camera_height_m(key.camera)
        return Ambience(self.manifest.axes_world, **light, camera_height_m=height_m)

    @cached_property
    def shelter(self) -> Shelter | None:
        """Bridges and roofs over the street; None where the sky is open everywhere.

        Raises:
            SceneError: If the map's file cannot be read any more.
        """
        return store.read_shelter(self.path, self.manifest)

    @cached_property
    def reconstruction(self) -> Reconstruction | None:
        """The drive as Gaussians, memory-mapped; None if the scene was built without.

        Raises:
            SceneError: If a file of it cannot be read any more, or holds what no scene can.
        """
        record = self.manifest.reconstruction
        return None if record is None else read_reconstruction(self.path, record)

    def layers(self, key: FrameKey) -> Layers:
        """What the editor knows of a frame: read from the scene, or found out if it is of before.

        Raises:
            ArgumentError: If the scene has no such frame.
            SceneError: If a file of it cannot be read any more.
        """
        record = self._record(key)
        if record.layers is None:
            return self._layers_of(self.frame(key))
        _, label = store.read_surfaces(self.path, record)
        layers = store.read_layers(self.path, record, label)
        assert layers is not None
        return layers

    def _layers_of(self, frame: Frame) -> Layers:
        stored = store.read_layers(self.path, self._record(frame.key), frame.label)
        return stored or layers_seen(frame, self._streets[frame.key.camera])

    @cached_property
    def _streets(self) -> dict[str, Street]:
        manifest = self.manifest
        is_drive = manifest.airlight is not None
        return streets(manifest.frames, manifest.axes_world, is_drive=is_drive)

    def render(
        self,
        key: FrameKey,
        weather: Weather | WeatherTimeline,
        *,
        seed: int = 0,
        window: Window | None = None,
        air: Air | None = None,
        options: RenderOptions = DEFAULT_OPTIONS,
    ) -> RenderedFrame:
        """Render one frame in a weather; see `weather_aug.render.compose.render`.

        Args:
            key: Which frame, one of `keys`.
            weather: State of air and ground, or how it changes with the time since the first frame.
            seed: Which particles fall.
            window: (top, left, height, width); the whole picture if None.
            air: How the air moves and has moved since the clip's start; if None, as the weather
                tells.
            options: Choices besides the weather.
        """
        if not isinstance(options, RenderOptions):
            raise ArgumentError(f"options must be RenderOptions, got {type(options).__name__}")
        frame = self.frame(key)
        frame = replace(frame, time_s=frame.time_s - self.manifest.frames[0].time_s)
        if isinstance(weather, WeatherTimeline):
            air = air or weather.air(frame.time_s, seed)
            weather = weather.at(frame.time_s)
        # A clear picture is returned as it is, and what is no weather is refused.
        is_seen = isinstance(weather, Weather) and not weather.is_clear
        return render(
            frame,
            weather,
            seed=seed,
            ambience=self.ambience(key),
            window=window,
            air=air,
            shelter=self.shelter,
            rig=self._rig_motion(frame.key) if options.needs_rig else None,
            layers=self._layers_of(frame) if is_seen else None,
            options=options,
        )

    def _rig_motion(self, key: FrameKey) -> RigMotion:
        """Of the clip's first camera up to the moment of a frame, or to the last one before it."""
        first = self.manifest.frames[0]
        seen = [r for r in self.manifest.frames if r.key.camera == first.key.camera]
        before = [r for r in seen if r.key.time_index <= key.time_index]
        now = before[-1] if before else seen[0]
        return RigMotion(first.camera.world_from_camera, now.camera.world_from_camera)

    def damaged_files(self) -> list[str]:
        """Compare every file with its digest; one sentence for each that has changed."""
        return store.damaged_files(self.path, self.manifest)

    def size_of(self, key: FrameKey) -> tuple[int, int]:
        """(height, width) of a frame, pixels, without reading it."""
        camera = self._record(key).camera
        return camera.height, camera.width

    def _record(self, key: FrameKey) -> FrameRecord:
        try:
            record = self.manifest.by_key.get(FrameKey(*key))
        except TypeError:
            raise ArgumentError(
                f"a frame is named by FrameKey(time_index, camera), got {printable(key)!r}; "
                "scene.keys lists them"
            ) from None
        if record is None:
            raise ArgumentError(
                f"scene {self.name} has no frame {printable(key)}; it has {len(self.keys)} frames "
                f"of cameras {', '.join(self.cameras)}"
            )
        return record

    def __reduce__(self) -> tuple[Any, ...]:
        return (WeatherScene, (self.path,))

    def __repr__(self) -> str:
        return f"WeatherScene({str(self.path)!r})"
