"""What a preview shows: a frame of a scene, or a picture without one, in any weather."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from weather_aug.air import Air
from weather_aug.clip.types import Camera, Frame, FrameKey
from weather_aug.edit.ambience import Ambience
from weather_aug.errors import ArgumentError, printable
from weather_aug.render.compose import RenderedFrame, render
from weather_aug.render.options import RenderOptions
from weather_aug.scene.scene import WeatherScene
from weather_aug.transforms.picture import Drawn, Weathering, checked_options, light_of
from weather_aug.weather import Weather

Shown = WeatherScene | str | os.PathLike[str] | NDArray[Any]
"""A scene, its folder, or one (H, W, 3) picture."""


class Source(Protocol):
    """Frames that can be rendered in any weather; nothing is written."""

    @property
    def keys(self) -> tuple[FrameKey, ...]:
        """Of all frames, by time, then camera; at least one."""

    def shot(
        self, key: FrameKey, weather: Weather, seed: int, air: Air | None = None
    ) -> RenderedFrame:
        """A frame in a weather; `air` as the weather tells if None."""


@dataclass(frozen=True)
class SceneSource:
    """Frames of a scene."""

    scene: WeatherScene
    options: RenderOptions

    @property
    def keys(self) -> tuple[FrameKey, ...]:
        """Of the scene."""
        return self.scene.keys

    def shot(
        self, key: FrameKey, weather: Weather, seed: int, air: Air | None = None
    ) -> RenderedFrame:
        """See `WeatherScene.render`."""
        return self.scene.render(key, weather, seed=seed, air=air, options=self.options)


@dataclass(frozen=True)
class PictureSource:
    """One picture, whose depth was found once."""

    frame: Frame
    light: Ambience
    options: RenderOptions

    @property
    def keys(self) -> tuple[FrameKey, ...]:
        """The only one."""
        return (self.frame.key,)

    def shot(
        self, key: FrameKey, weather: Weather, seed: int, air: Air | None = None
    ) -> RenderedFrame:
        """See `weather_aug.render.compose.render`."""
        if key != self.frame.key:
            raise ArgumentError(f"a single picture has no frame {printable(key)}; leave key out")
        return render(
            self.frame, weather, seed=seed, ambience=self.light, air=air, options=self.options
        )


def source_of(
    shown: Shown,
    *,
    mask: NDArray[Any] | None = None,
    depth: NDArray[Any] | None = None,
    camera: Camera | None = None,
    options: RenderOptions | None = None,
    **how: Any,
) -> Source:
    """What a preview shows; see `weather_aug.preview.sweep`.

    Raises:
        ArgumentError: If it is none of `Shown`, or what belongs to pictures comes with a scene.
        SceneError: If a folder is no scene.
        IntegrityError: If a file of it is missing.
    """
    if isinstance(shown, np.ndarray):
        weathering = Weathering.of(options=options, **how)
        speed_m_per_s = sum(weathering.speed_m_per_s) / 2
        drawn = Drawn(Weather.clear(), 0, speed_m_per_s)
        frame = weathering.frame(shown, drawn, mask=mask, depth=depth, camera=camera)
        return PictureSource(frame, light_of(frame), weathering.options)
    given = {"mask": mask, "depth": depth, "camera": camera} | how
    for name, value in given.items():
        if value is not None:
            raise ArgumentError(f"a scene has its own; {printable(name)} is for a single picture")
    if isinstance(shown, str | os.PathLike):
        shown = WeatherScene.load(os.fspath(shown))
    if not isinstance(shown, WeatherScene):
        raise ArgumentError(
            "source must be a WeatherScene, its folder, or an (H, W, 3) picture, got "
            f"{type(shown).__name__}"
        )
    return SceneSource(shown, checked_options(options))
