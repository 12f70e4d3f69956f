"""Weather of one sample of a host's pipeline: with a probability, with a scene or without one."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

from numpy.typing import NDArray

from weather_aug._checks import finite
from weather_aug._keys import uniforms
from weather_aug.clip.types import Camera
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.transforms.draws import Draws
from weather_aug.transforms.picture import Weathered, Weathering
from weather_aug.transforms.shelf import Shelf


class SampleWeather:
    """What the transforms of hosts do to one sample that bring no random numbers of their own.

    Convention:
        Whether there is weather, and which, is one keyed draw (see `Draws`). Pickles: to workers
        the epoch stays shared, scenes go as paths.

    Args:
        domain: Of the draws; at most 16 bytes.
        policy: Which weather how often, or its `to_dict` form; the default policy if None.
        p: Probability of any weather, in [0, 1].
        seed: Of all draws, in [-2**63, 2**64).
        scenes: Folders of scenes that a scene key looks a picture up in.
        how: Further arguments of `Weathering.of`.

    Raises:
        ArgumentError: If a value is outside its range, or a name in `how` is unknown.
    """

    def __init__(
        self,
        domain: str,
        policy: WeatherPolicy | dict[str, Any] | None,
        *,
        p: float,
        seed: int,
        scenes: Sequence[str | os.PathLike[str]],
        how: dict[str, Any],
    ) -> None:
        self.weathering = Weathering.of(policy, **how)
        self.p = finite("p", p, 0, 1)
        self.draws = Draws(domain, seed)
        self.shelf = Shelf(scenes)

    def __call__(
        self,
        image: NDArray[Any],
        *,
        mask: NDArray[Any] | None = None,
        depth: NDArray[Any] | None = None,
        camera: Camera | None = None,
        scene_key: Any = None,
        sample: Any = None,
    ) -> Weathered | None:
        """The picture in its weather; None where none was drawn.

        Args:
            image: (H, W, 3) RGB, uint8 or float32 in [0, 1], any layout.
            mask: (H, W) ids, or None.
            depth: (H, W) float z-depth in metres, or None.
            camera: Of the picture; a level one if None.
            scene_key: The picture's frame of a scene (see `SceneKey`), which knows its own depth
                and camera; None if there is no scene.
            sample: What the sample is called, for its draw; None if nothing.

        Raises:
            ArgumentError: As `Weathering.render` and `Shelf.render` do.
            DataError: If the mask holds an id that its taxonomy does not declare.
        """
        key = self.draws.key(image, sample)
        # The first number of this key is the speed's.
        if uniforms(key, 2)[1] >= self.p:
            return None
        drawn = self.weathering.draw(key)
        if scene_key is None:
            return self.weathering.render(image, drawn, mask=mask, depth=depth, camera=camera)
        shot = self.shelf.render(scene_key, image, drawn, self.weathering.options)
        return self.weathering.handed_back(image, mask, shot)
