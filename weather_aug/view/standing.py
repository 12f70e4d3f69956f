"""What stands in a browser besides what falls: the street, its sky, what moves in it, cameras."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.types import Camera, FrameKey
from weather_aug.colour import srgb_from_linear
from weather_aug.gaussians.gather import sky_of
from weather_aug.gaussians.rotations import quaternions_of
from weather_aug.gaussians.types import Reconstruction
from weather_aug.scene.scene import WeatherScene
from weather_aug.view import splats
from weather_aug.weather import Weather

MOST_FRUSTUMS = 120
MOST_POINTS = 300_000
THUMBNAIL_PX = 192
LEAST_SPAN_S = 10.0
"""Of the time's slider, for a clip of a single moment."""
SKY_M = 4000.0
CLIP_M = (0.05, 12_000.0)
"""Nearest and farthest that a browser draws."""
LOOK_AHEAD_M = 15.0
"""Around what a browser's camera turns."""


class Standing:
    """What stands in the browser besides what falls."""

    def __init__(self, server: Any, scene: WeatherScene) -> None:
        self.server, self.scene = server, scene
        self.reconstruction = scene.reconstruction
        records = scene.manifest.frames
        self.first_s = records[0].time_s
        self.span_s = max(max(r.time_s for r in records) - self.first_s, LEAST_SPAN_S)
        cameras = {} if self.reconstruction is None else self.reconstruction.cameras
        self._cameras = {r.key: cameras.get(r.key, r.camera) for r in records}
        self._seen_s = {r.key: r.time_s for r in records}
        front = [r.key for r in records if r.key.camera == records[0].key.camera]
        start = front[len(front) // 2]
        self.camera: Camera = self._cameras[start]
        self.light = scene.ambience(start)
        self._actors: Any = None
        self._alone: Reconstruction | None = None
        self._moment: tuple[object, ...] = ()
        self._wanted: tuple[str | None, float] = (None, 0.0)
        self._styled: tuple[str | None, float] = self._wanted
        self._fog: tuple[object, ...] = (None,)
        self._look_from(self.camera)
        self._frustums = self._add_cameras()
        self._background = self._add_background()
        self._sky = self._add_sky()
        self._add_actors()

    @property
    def parts(self) -> dict[str, list[Any]]:
        """What can be hidden, by its name."""
        named = {"scene": [self._background], "sky": self._sky, "cameras": self._frustums}
        return {name: handles for name, handles in named.items() if handles}

    @property
    def tracks(self) -> dict[int, str]:
        """Class names by track, of what moves."""
        actors = () if self.reconstruction is None else self.reconstruction.actors
        return {actor.track_id: actor.class_name for actor in actors}

    def show_parts(self, ticked: Mapping[str, bool]) -> None:
        """Hide what is not ticked."""
        for name, handles in self.parts.items():
            for handle in handles:
                handle.visible = ticked[name]

    def show_actors(self, drive_s: float, hidden: set[int]) -> None:
        """Put what moves where it is at a time of the drive."""
        moment = (drive_s, frozenset(hidden), *self._styled)
        if self._alone is None or moment == self._moment:
            return
        self._moment = moment
        time_s = self.first_s + drive_s
        nearest = min(self._seen_s, key=lambda key: abs(self._seen_s[key] - time_s))
        style, amount = self._styled
        found = splats.actor_splats(
            self._alone, time_s, self._cameras[nearest].centre_world, style, amount, hidden
        ).padded(len(self._alone.actor_gaussians))
        if self._actors is None:
            self._actors = self.server.scene.add_gaussian_splats("/actors", *found)
        else:
            self._actors.set_gaussians(*found)

    def show_weather(self, weather: Weather, kind: str, severity: float) -> None:
        """Colours of the weather's style where there is one, and its fog."""
        styles = {} if self.reconstruction is None else self.reconstruction.styles
        wanted: tuple[str | None, float] = (kind, severity) if kind in styles else (None, 0.0)
        # All colours are sent anew: not before the slider rests.
        if wanted == self._wanted and wanted != self._styled:
            self._styled = wanted
            self._show_style(*wanted)
        self._wanted = wanted
        end_m = splats.fog_end_m(weather)
        level = srgb_from_linear(np.clip(self.light.under(weather.overcast).airlight, 0, 1))
        colour = tuple(splats.levels(level).tolist())
        fog = (end_m,) if end_m is None else (end_m, colour)
        if fog != self._fog:
            self._fog = fog
            self.server.scene.configure_fog(
                0.0, end_m or CLIP_M[1], color=colour, enabled=end_m is not None
            )

    def _show_style(self, style: str | None, amount: float) -> None:
        assert self.reconstruction is not None
        cameras = list(self._cameras.values())
        found = splats.background_splats(self.reconstruction, cameras, style, amount)
        self._background.set_gaussians(*found)
        for handle, face in zip(
            self._sky, sky_of(self.reconstruction, style, amount).faces, strict=True
        ):
            handle.image = splats.levels(face)

    def _look_from(self, camera: Camera) -> None:
        """Where a new browser's camera is."""
        up = self.scene.manifest.axes_world[2]
        self.server.scene.set_up_direction(up)
        start = self.server.initial_camera
        start.position = camera.centre_world
        start.look_at = camera.centre_world + LOOK_AHEAD_M * camera.world_from_camera[:3, 2]
        start.up = up
        start.fov = _vertical_fov_rad(camera)
        start.near, start.far = CLIP_M

    def _add_cameras(self) -> list[Any]:
        """Frustums with their pictures; a click looks from there. The lens's middle is left out."""
        keys = splats.spread(list(self._cameras), MOST_FRUSTUMS)
        return [self._add_camera(key) for key in keys]

    def _add_camera(self, key: FrameKey) -> Any:
        camera = self._cameras[key]
        wxyz = quaternions_of(camera.world_from_camera[:3, :3])
        frustum = self.server.scene.add_camera_frustum(
            f"/cameras/{key}",
            _vertical_fov_rad(camera),
            camera.width / camera.height,
            scale=0.25,
            thickness=0.005,
            color=(230, 120, 30),
            image=_thumbnail(self.scene.frame(key).image),
            wxyz=wxyz,
            position=camera.centre_world,
            visible=False,
        )

        @frustum.on_click
        def _(event: Any) -> None:
            with event.client.atomic():
                event.client.camera.position = camera.centre_world
                event.client.camera.look_at = (
                    camera.centre_world + LOOK_AHEAD_M * camera.world_from_camera[:3, 2]
                )

        return frustum

    def _add_background(self) -> Any:
        if self.reconstruction is not None:
            found = splats.background_splats(self.reconstruction, list(self._cameras.values()))
            return self.server.scene.add_gaussian_splats("/scene", *found)
        keys = splats.spread(self.scene.keys, MOST_FRUSTUMS)
        pixels = sum(math.prod(self.scene.size_of(key)) for key in keys)
        step_px = max(1, math.ceil(math.sqrt(pixels / MOST_POINTS)))
        clouds = [splats.depth_points(self.scene.frame(key), step_px) for key in keys]
        points, colours = (np.concatenate(arrays) for arrays in zip(*clouds, strict=True))
        return self.server.scene.add_point_cloud(
            "/scene",
            points,
            colours,
            point_size=0.04,
            point_shape="circle",
            point_shading="flat",
            precision="float32",
        )

    def _add_sky(self) -> list[Any]:
        """The cube map as six pictures far away; one colour behind everything if there is none."""
        if self.reconstruction is None:
            colour = splats.levels(srgb_from_linear(np.clip(self.light.sky, 0, 1)))
            self.server.scene.set_background_image(np.tile(colour, (4, 4, 1)))
            return []
        return [
            self.server.scene.add_image(
                f"/sky/{face}",
                splats.levels(picture),
                2 * SKY_M,
                2 * SKY_M,
                wxyz=splats.sky_face_wxyz(face),
                position=self.camera.centre_world + SKY_M * splats.sky_face_direction(face),
            )
            for face, picture in enumerate(self.reconstruction.sky.faces)
        ]

    def _add_actors(self) -> None:
        if self.reconstruction is not None and len(self.reconstruction.actor_gaussians):
            self._alone = splats.actors_alone(self.reconstruction)
            self.show_actors(0.0, set())


def _vertical_fov_rad(camera: Camera) -> float:
    return 2 * math.atan(0.5 * camera.height / camera.focal_px[1])


def _thumbnail(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = image.shape[:2]
    size = (THUMBNAIL_PX, max(1, round(height * THUMBNAIL_PX / width)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
