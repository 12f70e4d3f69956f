"""What all rooms' tests share: the tiny street, and the scene built of it."""

from __future__ import annotations

import os

# Read at the import of albumentations, which else asks the network for a newer version.
os.environ.setdefault("NO_ALBUMENTATIONS_UPDATE", "1")

import numpy as np
import pytest
from hypothesis import settings
from tiny_clip import TinyClip

from weather_aug.edit.ambience import Ambience
from weather_aug.scene.scene import WeatherScene

# Time limits for single examples fail on a busy machine, not on a fault.
settings.register_profile("patient", deadline=None)
settings.load_profile("patient")


@pytest.fixture(scope="session")
def tiny_clip() -> TinyClip:
    return TinyClip()


@pytest.fixture(scope="session")
def tiny_scene(tiny_clip: TinyClip, tmp_path_factory: pytest.TempPathFactory) -> WeatherScene:
    """Built once; tests that harm a scene copy its folder."""
    return WeatherScene.build(tiny_clip, tmp_path_factory.mktemp("tiny") / "scene")


@pytest.fixture(scope="session")
def unlabelled_scene(tmp_path_factory: pytest.TempPathFactory) -> WeatherScene:
    """The same street where nobody labelled it."""
    folder = tmp_path_factory.mktemp("unlabelled") / "scene"
    return WeatherScene.build(TinyClip(name="unlabelled", labelled=False), folder)


@pytest.fixture
def ambience() -> Ambience:
    return Ambience(
        np.eye(3),
        sky=np.array([0.6, 0.65, 0.7]),
        middle=np.full(3, 0.2),
        ground=np.full(3, 0.12),
        airlight=np.array([0.55, 0.56, 0.57]),
    )


@pytest.fixture(scope="session")
def gaussian_scene(tmp_path_factory: pytest.TempPathFactory) -> WeatherScene:
    """The tiny street of Gaussians with the styles rain, snow and fog; not to be harmed."""
    from gaussian_clip import built

    return built(tmp_path_factory.mktemp("gaussians") / "scene")
