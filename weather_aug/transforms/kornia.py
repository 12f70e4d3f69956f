"""For kornia: RandomWeather over batches, and the container that shows it masks first."""

from __future__ import annotations

from weather_aug.transforms.kornia_sequential import AugmentationSequential
from weather_aug.transforms.kornia_weather import RandomWeather

__all__ = ["AugmentationSequential", "RandomWeather"]
