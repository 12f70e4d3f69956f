"""Rain, snow and fog for driving images, with physical severity and honest labels.

Names are loaded on first use, so that importing the package costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_HOMES = {
    "Weather": "weather_aug.weather",
    "Camera": "weather_aug.clip.types",
    "Clip": "weather_aug.clip.types",
    "Frame": "weather_aug.clip.types",
    "FrameKey": "weather_aug.clip.types",
    "FitOptions": "weather_aug.gaussians.options",
    "open_clip": "weather_aug.clip.open",
    "RenderOptions": "weather_aug.render.options",
    "RenderedFrame": "weather_aug.render.compose",
    "Viewpoint": "weather_aug.scene.viewpoint",
    "ViewpointJitter": "weather_aug.scene.viewpoint",
    "WeatherScene": "weather_aug.scene.scene",
    "WeatherPolicy": "weather_aug.scene.policy",
    "WeatherTimeline": "weather_aug.timeline",
    "WeatherDataset": "weather_aug.transforms.dataset",
    "RareClass": "weather_aug.transforms.sampling",
    "SeverityCurriculum": "weather_aug.transforms.curriculum",
    "Uniform": "weather_aug.transforms.sampling",
    "WeatherSampler": "weather_aug.transforms.sampler",
    "WeatherAugError": "weather_aug.errors",
}

__all__ = [*sorted(_HOMES), "__version__"]

if TYPE_CHECKING:
    from weather_aug.clip.open import open_clip as open_clip
    from weather_aug.clip.types import Camera as Camera
    from weather_aug.clip.types import Clip as Clip
    from weather_aug.clip.types import Frame as Frame
    from weather_aug.clip.types import FrameKey as FrameKey
    from weather_aug.errors import WeatherAugError as WeatherAugError
    from weather_aug.gaussians.options import FitOptions as FitOptions
    from weather_aug.render.compose import RenderedFrame as RenderedFrame
    from weather_aug.render.options import RenderOptions as RenderOptions
    from weather_aug.scene.policy import WeatherPolicy as WeatherPolicy
    from weather_aug.scene.scene import WeatherScene as WeatherScene
    from weather_aug.scene.viewpoint import Viewpoint as Viewpoint
    from weather_aug.scene.viewpoint import ViewpointJitter as ViewpointJitter
    from weather_aug.timeline import WeatherTimeline as WeatherTimeline
    from weather_aug.transforms.curriculum import SeverityCurriculum as SeverityCurriculum
    from weather_aug.transforms.dataset import WeatherDataset as WeatherDataset
    from weather_aug.transforms.sampler import WeatherSampler as WeatherSampler
    from weather_aug.transforms.sampling import RareClass as RareClass
    from weather_aug.transforms.sampling import Uniform as Uniform
    from weather_aug.weather import Weather as Weather


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'weather_aug' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return __all__
