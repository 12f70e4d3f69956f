"""Scenes that a transform looks a picture up in: the full effect where a clip was precomputed."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError, printable
from weather_aug.render.compose import RenderedFrame
from weather_aug.render.options import DEFAULT_OPTIONS, RenderOptions
from weather_aug.scene.scene import WeatherScene
from weather_aug.transforms.given import rgb_uint8
from weather_aug.transforms.picture import Drawn

MOST_DIFFERENCE = 8.0
"""Mean over a coarse grid, in 8-bit levels, up to which a picture is that of the scene: decoders of
JPEG differ by about one."""
_STRIDE = 8

SceneKey = str | Sequence[Any]
"""A frame of a scene: `FrameKey`, (time index, camera), its text "000012_front", or with the
scene's name before it where there are several: (name, time index, camera)."""


class Shelf:
    """Scenes by name, opened on first use; pickles as paths.

    Args:
        paths: Folders of scenes.
    """

    def __init__(self, paths: Sequence[str | os.PathLike[str]]) -> None:
        given = None if isinstance(paths, str) or not isinstance(paths, Iterable) else tuple(paths)
        if given is None or not all(isinstance(path, str | os.PathLike) for path in given):
            raise ArgumentError("scenes must be a sequence of folders; write scenes=[folder]")
        self.paths = tuple(os.fspath(path) for path in given)

    @cached_property
    def by_name(self) -> dict[str, WeatherScene]:
        """All scenes.

        Raises:
            SceneError: If a folder is no scene.
            ArgumentError: If two have one name.
        """
        found: dict[str, WeatherScene] = {}
        for path in self.paths:
            scene = WeatherScene.load(path)
            if scene.name in found:
                raise ArgumentError(f"scenes has two of the name {printable(scene.name)!r}")
            found[scene.name] = scene
        return found

    def __getstate__(self) -> dict[str, Any]:
        return {"paths": self.paths}

    def render(
        self,
        scene_key: Any,
        image: NDArray[Any],
        drawn: Drawn,
        options: RenderOptions = DEFAULT_OPTIONS,
    ) -> RenderedFrame:
        """A frame of a scene in the weather that was drawn for it.

        Args:
            scene_key: Which frame; see `SceneKey`.
            image: (H, W, 3) RGB, the frame's own picture, uncropped and unchanged.
            drawn: Its weather; the speed is the scene's.
            options: Choices besides the weather.

        Raises:
            ArgumentError: If there is no such frame, or the picture is another one.
            SceneError: If a file of the scene cannot be read.
        """
        scene, key = self.find(scene_key)
        recorded = scene.frame(key).image
        picture = rgb_uint8(image)
        if picture.shape != recorded.shape:
            raise ArgumentError(
                f"image is {picture.shape[:2]}, frame {key} of scene {scene.name} is "
                f"{recorded.shape[:2]}: put RandomWeather before crops and resizing, and build the "
                "scene without scale="
            )
        grid = (slice(None, None, _STRIDE), slice(None, None, _STRIDE))
        difference = np.abs(picture[grid].astype(np.int16) - recorded[grid]).mean()
        if difference > MOST_DIFFERENCE:
            raise ArgumentError(
                f"image is not the picture of frame {key} of scene {scene.name} (they differ by "
                f"{difference:.0f} levels): put RandomWeather before flips and colour, or correct "
                "scene_key"
            )
        return scene.render(key, drawn.weather, seed=drawn.seed, options=options)

    def find(self, scene_key: Any) -> tuple[WeatherScene, FrameKey]:
        """The scene and the frame that a key names.

        Raises:
            ArgumentError: If there is none.
        """
        if not self.paths:
            raise ArgumentError("scene_key needs scenes: RandomWeather(..., scenes=[folder])")
        if not isinstance(scene_key, Sequence):
            raise ArgumentError(
                "scene_key must be a frame's text, (time index, camera), or (scene's name, time "
                f"index, camera), got {type(scene_key).__name__}"
            )
        parts = (scene_key,) if isinstance(scene_key, str) else tuple(scene_key)
        if len(parts) == 3:
            name, *frame = parts
            if not isinstance(name, str) or name not in self.by_name:
                raise ArgumentError(
                    f"there is no scene {printable(name)!r}; there are {', '.join(self.by_name)}"
                )
            return self._frame(self.by_name[name], tuple(frame), scene_key)
        if len(self.by_name) != 1:
            raise ArgumentError(
                "with several scenes scene_key must be (scene's name, time index, camera), got "
                f"{printable(scene_key)!r}"
            )
        return self._frame(next(iter(self.by_name.values())), parts, scene_key)

    def _frame(
        self, scene: WeatherScene, parts: tuple[Any, ...], scene_key: Any
    ) -> tuple[WeatherScene, FrameKey]:
        for key in scene.keys:
            if parts in ((str(key),), tuple(key)):
                return scene, key
        raise ArgumentError(
            f"scene {scene.name} has no frame {printable(scene_key)!r}; it has {len(scene.keys)}, "
            f"the first is {str(scene.keys[0])!r}"
        )
