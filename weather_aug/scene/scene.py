"""WeatherScene: a precomputed clip that renders any weather of any of its frames."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import finite
from weather_aug.clip.types import Camera, Clip, Frame, FrameKey, Window
from weather_aug.edit.ambience import Ambience
from weather_aug.edit.background import BackgroundEditor
from weather_aug.edit.physical.layers import Layers
from weather_aug.errors import ArgumentError, IntegrityError, printable
from weather_aug.gaussians.types import Reconstruction
from weather_aug.particles.shelter import Shelter
from weather_aug.render.compose import RenderedFrame
from weather_aug.render.options import DEFAULT_OPTIONS, RenderOptions
from weather_aug.scene import store
from weather_aug.scene.backdrop import read_background
from weather_aug.scene.layers import Street, layers_seen
from weather_aug.scene.reconstruction import read_reconstruction
from weather_aug.scene.records import FrameRecord, Manifest, streets
from weather_aug.scene.rendering import Asked, Drive, dressed, over_stored
from weather_aug.scene.styles import PHYSICAL, carried_options, lying_in, weights_asked, weights_of
from weather_aug.scene.viewpoint import raised_height_m
from weather_aug.timeline import WeatherTimeline
from weather_aug.weather import Weather

if TYPE_CHECKING:
    from weather_aug.air import Air
    from weather_aug.gaussians.gather import Weights
    from weather_aug.gaussians.options import FitOptions
    from weather_aug.scene.novel import NovelFrame, Poses
    from weather_aug.scene.viewpoint import Viewpoint


class WeatherScene:
    """A clip precomputed for weather: pictures, depth, labels, backgrounds, Gaussians on disk.

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
        editor: str | BackgroundEditor = PHYSICAL,
        editor_options: Any = None,
        weathers: Sequence[str] | None = None,
        progress: bool = False,
        overwrite: bool = False,
        reconstruct: bool = False,
        reconstruction: FitOptions | None = None,
        styles: Sequence[str] = ("rain", "snow", "fog"),
    ) -> WeatherScene:
        """Precompute `clip` into the folder `out`; see `weather_aug.scene.build.build`.

        Args:
            clip: The drive; every frame needs depth.
            out: Folder to make.
            editor: How backgrounds get their weather: "physical" while rendering; a
                `BackgroundEditor`, or the name of one in `edit.editors.EDITORS`, now.
            editor_options: Of an editor that is named, such as `DiffusionOptions`.
            weathers: Types the scene is meant for, and which backgrounds of an editor are stored;
                all that it knows if None.
            progress: Show bars.
            overwrite: Replace `out` if it is a scene already.
            reconstruct: Turn the frames into Gaussians as well, so that they can be rendered from
                elsewhere; takes minutes, and goes on from its last checkpoint.
            reconstruction: How; the default options if None.
            styles: Weathers whose colours the Gaussians learn; see `scene.styles.style_weather`.

        Raises:
            ArgumentError: If `reconstruction` is given without `reconstruct`, or a choice is none.
        """
        from weather_aug.scene.build import build
        from weather_aug.scene.reconstruct import wanted_of

        if reconstruction is not None and not reconstruct:
            raise ArgumentError("reconstruction means nothing without reconstruct=True")
        wanted = wanted_of(reconstruction, styles) if reconstruct else None
        build(
            *(clip, Path(out), editor, weathers),
            progress=progress,
            overwrite=overwrite,
            wanted=wanted,
            editor_options=editor_options,
        )
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

    def background(self, key: FrameKey, style: str) -> NDArray[np.uint8]:
        """(H, W, 3) sRGB of a recorded frame in a style, as the scene's editor made it.

        Raises:
            ArgumentError: If the scene has no such frame, or no backgrounds in that style.
            SceneError: If its file cannot be read any more.
        """
        weights_of(style, 1.0, self.manifest.styles)
        return read_background(self.path, self._record(key), style)

    def ambience(self, key: FrameKey) -> Ambience:
        """Light around a frame; the axes are the clip's.

        The airlight is the clip's too if it is a drive: fog does not flicker. Of unrelated pictures
        each has its own.
        """
        return self.manifest.ambience(self._record(key))

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
            return self._looked_at(self.frame(key))
        _, label = store.read_surfaces(self.path, record)
        layers = store.read_layers(self.path, record, label)
        assert layers is not None
        return layers

    def _layers_of(self, frame: Frame) -> Layers:
        stored = store.read_layers(self.path, self._record(frame.key), frame.label)
        return stored or self._looked_at(frame)

    def _looked_at(self, frame: Frame, *, novel: bool = False) -> Layers:
        street = self._streets[frame.key.camera]
        height_m = raised_height_m(street.camera_height_m, self.manifest.raised_m(frame))
        mirrored = None
        if self.reconstruction is not None:
            # Loads torch.
            from weather_aug.scene.geometry import seen_in_road

            mirrored = partial(seen_in_road, self.reconstruction, novel=novel)
        return layers_seen(frame, street._replace(camera_height_m=height_m), mirrored)

    @cached_property
    def _streets(self) -> dict[str, Street]:
        manifest = self.manifest
        return streets(manifest.frames, manifest.axes_world, is_drive=manifest.is_drive)

    def render(
        self,
        key: FrameKey,
        weather: Weather | WeatherTimeline,
        *,
        seed: int = 0,
        window: Window | None = None,
        air: Air | None = None,
        viewpoint: Viewpoint | None = None,
        style: str | Weights | None = None,
        amount: float = 1.0,
        without_actors: Collection[int] = (),
        poses: Poses | None = None,
        options: RenderOptions = DEFAULT_OPTIONS,
    ) -> RenderedFrame:
        """Render one frame in a weather; see `weather_aug.render.compose.render`.

        A viewpoint, a style that is not stored, or actors that are left out or put elsewhere make
        it a frame that was never recorded, drawn from the scene's Gaussians (see `frame_from`):
        what no recorded frame showed has the label 255, and is invalid.

        There are two ways to the background. In a scene of the physical editor, and with
        `style="physical"` in any, that editor dresses the picture. A style shows its weather
        already: the effects on surfaces (`scene.styles.CARRIED`) are left out, whatever the weather
        says of the ground; air, particles, light on them, spray, lamps, glass and sensor follow the
        weather, and labels are buried under the style's snow. Where another editor stored
        backgrounds, the weather itself tells how much of each style is shown, by
        `scene.styles.style_amounts`: of the stored pictures in linear light, or of the Gaussians
        that were fitted to them. What none of the styles shows is then not on the ground.

        Args:
            key: Which frame, one of `keys`.
            weather: State of air and ground, or how it changes with the time since the first frame.
            seed: Which particles fall.
            window: (top, left, height, width); the whole picture if None.
            air: How the air moves and has moved since the clip's start; if None, as the weather
                tells.
            viewpoint: Where the camera stands, from the recorded one.
            style: A weather whose stored background is shown, or whose colours the Gaussians take;
                weights of several; or "physical". If None, as the weather asks.
            amount: In 0..1, of the style, or of the styles that the weather asks for: 0 leaves the
                recorded picture, and only its air is weather's.
            without_actors: Track ids of moving objects to leave out.
            poses: (4, 4) `world_from_actor` by track id: moving objects put elsewhere.
            options: Choices besides the weather.

        Raises:
            ArgumentError: If an argument is none, or Gaussians are needed and the scene has none.
            SceneError: If a file of the scene cannot be read any more.
        """
        if not isinstance(options, RenderOptions):
            raise ArgumentError(f"options must be RenderOptions, got {type(options).__name__}")
        asked = Asked(weather, seed, window, air, options)
        drive = Drive(self.path, self.manifest, self.shelter, self._layers_of)
        stored = () if style == PHYSICAL else self.manifest.styles
        style = None if style == PHYSICAL else style
        time_s = self._record(key).time_s - self.manifest.frames[0].time_s
        if viewpoint is None and not without_actors and not poses:
            names = {style} if isinstance(style, str) else set(style or ())
            if stored and (names <= set(stored) or self.reconstruction is None):
                weights = weights_asked(weather, time_s, style, amount, stored)
                return over_stored(drive, self.frame(key), weights, asked)
            if style is None:
                return dressed(drive, self.frame(key), asked)
        fitted = [name for name in stored if name in self._gaussians().styles]
        if style is None and fitted:
            style, amount = weights_asked(weather, time_s, None, amount, fitted), 1.0
        # Loads torch.
        from weather_aug.scene.novel import honest

        shown = dict(style=style, amount=amount, without=without_actors, poses=poses)
        # A style has its snow already; the physical editor asks where surfaces face up.
        novel = self._novel(key, viewpoint, None, None, normals=style is None, **shown)
        dressing = options if style is None else carried_options(options)
        drive = drive._replace(look=partial(self._looked_at, novel=True))
        shot = dressed(drive, novel.frame, asked._replace(options=dressing))
        return honest(shot, novel, lying_in(style, amount), options)

    def frame_from(
        self,
        key: FrameKey,
        viewpoint: Viewpoint | None = None,
        *,
        camera: Camera | None = None,
        time_s: float | None = None,
        style: str | Weights | None = None,
        amount: float = 1.0,
        without: Collection[int] = (),
        poses: Poses | None = None,
        normals: bool = True,
    ) -> NovelFrame:
        """A frame that nobody recorded, drawn from the scene's Gaussians.

        Args:
            key: The recorded frame that it starts from: its camera's lens, its exposure, the boxes
                of what stands, and its moment.
            viewpoint: Where the camera stands, from the recorded one; at its place if None.
            camera: Any camera instead.
            time_s: Another moment, in seconds since the first frame, of what moves.
            style: A weather's colours, or weights of several.
            amount: In 0..1, of the style.
            without: Track ids of moving objects to leave out.
            poses: (4, 4) `world_from_actor` by track id: moving objects put elsewhere.
            normals: Whether the frame has them; they take time.

        Returns:
            The frame with depth, label where the scene is labelled, and boxes, and which of its
            pixels recorded frames showed.

        Raises:
            ArgumentError: If the scene has no Gaussians or no such frame, both viewpoint and camera
                are given, or a style or a track is unknown.
            SceneError: If a file of the scene cannot be read any more.
        """
        if camera is not None and viewpoint is not None:
            raise ArgumentError("give a viewpoint or a camera, not both")
        shown = dict(style=style, amount=amount, without=without, poses=poses)
        return self._novel(key, viewpoint, camera, time_s, normals=normals, **shown).masked()

    def _novel(
        self,
        key: FrameKey,
        viewpoint: Viewpoint | None,
        camera: Camera | None,
        time_s: float | None,
        *,
        normals: bool,
        **shown: Any,
    ) -> NovelFrame:
        """`frame_from` with the most likely label where nothing was seen."""
        from weather_aug.scene.novel import PLANES, novel_camera, novel_frame

        reconstruction = self._gaussians()
        recorded = store.read_frame(self.path, self._record(key))
        place = (self.manifest.axes_world, viewpoint)
        camera = camera or novel_camera(reconstruction, recorded, *place)
        time_s = recorded.time_s if time_s is None else finite("time_s", time_s)
        want = PLANES if normals else PLANES[:-1]
        return novel_frame(reconstruction, recorded, camera, time_s, want=want, **shown)

    def _gaussians(self) -> Reconstruction:
        if self.reconstruction is None:
            raise ArgumentError(
                f"scene {self.name} has no Gaussians to be seen from elsewhere; build it again "
                "with reconstruct=True (weather-aug build … --reconstruct)"
            )
        return self.reconstruction

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
