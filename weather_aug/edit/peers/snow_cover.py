"""Snow cover alone: white lies where snow settles, under the recorded light and sky.

What ClimateNeRF does to a scene with metaballs, the physical editor does with its snow: this peer
is that snow and nothing else, so that comparisons show what the rest of the weather is worth. It
is anchored to the world: the same place is white in every picture.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.types import Frame
from weather_aug.edit.ambience import Ambience
from weather_aug.edit.background import Moment
from weather_aug.edit.peers.options import PeerOptions, check_style
from weather_aug.edit.physical.edit import dressed
from weather_aug.edit.physical.layers import Layers
from weather_aug.edit.physical.look import look_of
from weather_aug.errors import ArgumentError
from weather_aug.weather import Weather

UInt8 = NDArray[np.uint8]

SEVERITY = 1.0
WITHOUT = ("relight", "sky", "film", "mirror", "puddles", "ripples", "tracks")
"""Effects of the physical editor that are left out: all but the snow."""


class SnowCover:
    """A `BackgroundEditor` for snow that needs no weights and no text.

    Options: `severity` (1): how much lies, on the scale of `Weather.snow`.

    Convention:
        As `BackgroundEditor`. Nothing is random. Pixels without snow keep their bytes: there is no
        relighting, and the camera's exposure stays as it was.

    Source:
        Li et al., "ClimateNeRF: Extreme Weather Synthesis in Neural Radiance Fields", ICCV 2023,
        for what is compared with; docs/editing.md for the snow.
    """

    name = "snow-cover"
    styles = ("snow",)

    def __init__(self, severity: float = SEVERITY) -> None:
        deep = Weather.snow(severity, falling=False)
        self.weather = Weather(
            snow_cover=deep.snow_cover,
            road_snow_cover=deep.road_snow_cover,
            snow_depth_m=deep.snow_depth_m,
        )

    @classmethod
    def load(cls, options: PeerOptions) -> SnowCover:
        """From options.

        Raises:
            ArgumentError: If an option is not of this peer.
        """
        options = options.of(cls.name, severity=SEVERITY)
        return cls(SEVERITY if options.severity is None else options.severity)

    @property
    def card(self) -> Mapping[str, Any]:
        """What lies."""
        return {
            "editor": self.name,
            "snow_cover": self.weather.snow_cover,
            "road_snow_cover": self.weather.road_snow_cover,
            "snow_depth_m": self.weather.snow_depth_m,
        }

    def edit(self, moment: Moment, style: str) -> tuple[UInt8, ...]:
        """The frames of now under snow; see `BackgroundEditor.edit`.

        Raises:
            ArgumentError: If the style is not "snow", or nobody looked at the frames.
        """
        check_style(style, self.styles)
        if moment.look is None:
            raise ArgumentError(
                "snow-cover needs to know what the surfaces are; give the moment a look"
            )
        return tuple(snowed(frame, *moment.look(frame), self.weather) for frame in moment.now)


def snowed(frame: Frame, layers: Layers, ambience: Ambience, weather: Weather) -> UInt8:
    """A frame (H, W, 3) under the snow of a weather, and nothing else of it."""
    look = look_of(weather, ambience, layers.illumination, frame.time_s, WITHOUT)
    # The physical editor's camera darkens all else between white fields.
    look = look._replace(exposure=np.float32(1.0))
    window = (0, 0, *frame.image.shape[:2])
    return dressed(frame, layers, ambience, window, look, overcast=0.0)
