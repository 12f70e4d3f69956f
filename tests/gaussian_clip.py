"""A drive through the tiny street of Gaussians, and a scene built of it without a fit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_reconstruction import tiny_reconstruction

from weather_aug.clip.types import Box, Float64, Frame, FrameKey, check_key
from weather_aug.gaussians.draw import view
from weather_aug.gaussians.fit import Fitted
from weather_aug.gaussians.types import Reconstruction
from weather_aug.scene.scene import WeatherScene

SPEED_M_PER_S = 5.0


@lru_cache(maxsize=1)
def street() -> Reconstruction:
    return tiny_reconstruction(styles=("rain", "snow", "fog"))


@dataclass(frozen=True)
class GaussianClip:
    """What the cameras of the tiny street of Gaussians see, with the box of its car."""

    name: str = "gaussians"
    labelled: bool = True
    cameras: tuple[str, ...] = ("front",)
    up_world: Float64 = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))

    @property
    def keys(self) -> tuple[FrameKey, ...]:
        return tuple(street().cameras)

    def frame(self, key: FrameKey) -> Frame:
        key = check_key(self, key)
        scene = street()
        (car,) = scene.actors
        time_s = float(car.times_s[key.time_index])
        velocity = np.array([SPEED_M_PER_S, 0.0, 0.0])
        camera = replace(scene.cameras[key], velocity_m_per_s=velocity)
        shown = view(scene, camera, time_s, want=("image", "depth", "label"))
        pose = car.world_from_actor[key.time_index]
        box = Box(car.track_id, car.class_name, pose, car.size_m, velocity)
        label = shown.label if self.labelled else None
        assert shown.image is not None
        return Frame(key, time_s, camera, shown.image, label, shown.depth_m, boxes=(box,))


def known_fit(frames: Sequence[Frame], options: Any, **_: Any) -> Fitted:
    """What a perfect fit of a `GaussianClip` gives, at once."""
    cameras = {frame.key: frame.camera for frame in frames}
    found = replace(street(), cameras=cameras, styles={}, support=np.zeros(0, np.float32))
    return Fitted(found, {"psnr_db": 99.0, "ssim": 1.0, "minutes": 0.01, "curve": [[1, 0.1, 9.0]]})


def known_styles(
    scene: Reconstruction, edited: Mapping[str, Sequence[Frame]], **_: Any
) -> Reconstruction:
    """With the tiny street's own styles, whatever the frames show."""
    return replace(scene, styles={name: street().styles[name] for name in edited})


@contextmanager
def known() -> Iterator[pytest.MonkeyPatch]:
    """Within it, builds of a `GaussianClip` find its Gaussians without a fit."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("weather_aug.gaussians.fit.fit", known_fit)
        patch.setattr("weather_aug.gaussians.styles.fit_styles", known_styles)
        yield patch


def built(out: Path, **choices: Any) -> WeatherScene:
    """A scene of a `GaussianClip` with its Gaussians."""
    with known():
        return WeatherScene.build(GaussianClip(), out, reconstruct=True, **choices)
