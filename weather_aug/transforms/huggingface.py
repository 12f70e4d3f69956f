"""RandomWeather for Hugging Face datasets: a function of batches, for `with_transform` or `map`."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from weather_aug.errors import ArgumentError, printable
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.transforms.sampled import SampleWeather

MASK_MODES = ("L", "P", "I;16", "I")
"""Kinds of pictures whose pixels are ids."""
COLOURS = 256

Batch = Mapping[str, Any]


class RandomWeather:
    """Rain, snow or fog drawn from a policy, over the pictures and label masks of a batch.

    Convention:
        Called with a batch (columns as lists) or with one row, as `with_transform`, `set_transform`
        and `map` do. Pictures are RGB, of PIL or (H, W, 3) arrays, uint8 or float32 in [0, 1];
        masks are PIL pictures of `MASK_MODES` or (H, W) integer arrays, and come back with
        `ignore_index` where the weather hides the surface. What comes as PIL goes back as PIL of
        the same mode (a palette is kept, and filled up with black so that files of it can hold
        `ignore_index`), what comes as an array goes back as one of its dtype. Other columns are
        handed on as they are; nothing given is changed.

        A row's mask may be None; depth is then found from the picture alone.

        Draws hang on `seed`, the worker's seed and the number of the call, so no two are alike.
        With `sample` they hang on `seed`, `set_epoch` and that column alone: the same weather for
        any number of workers. No global generator is read or moved.

    Args:
        policy: Which weather how often, or its `to_dict` form.
        p: Probability of any weather for a row, in [0, 1].
        image: Column of pictures.
        mask: Column of label masks; None if nobody labelled.
        depth: Column of z-depths in metres: (H, W) float arrays, or PIL pictures of mode F.
        scene_key: Column of the pictures' frames in one of `scenes`; see `SceneKey`.
        sample: Column of integers or strings, different in each row, that decides its weather.
        seed: Of all draws.
        scenes: Folders of scenes for `scene_key`.
        how: `speed_m_per_s`, `camera_height_m`, `hfov_deg`, `options`, `taxonomy`, `ignore_index`,
            `unknown_ids`, `depth_cache`, `depth_network`: see `Weathering.of`.

    Raises:
        ArgumentError: If an argument is outside its range, or at a call a column is missing or
            holds anything else than stated.
        DataError: If a mask holds an id that its taxonomy does not declare.
    """

    def __init__(
        self,
        policy: WeatherPolicy | dict[str, Any] | None = None,
        p: float = 0.5,
        *,
        image: str = "image",
        mask: str | None = "label",
        depth: str | None = None,
        scene_key: str | None = None,
        sample: str | None = None,
        seed: int = 0,
        scenes: Sequence[str | os.PathLike[str]] = (),
        **how: Any,
    ) -> None:
        self._sample = SampleWeather("huggingface", policy, p=p, seed=seed, scenes=scenes, how=how)
        self.image = image
        self.mask = mask
        named = {"mask": mask, "depth": depth, "scene_key": scene_key, "sample": sample}
        self.columns = {"picture": image} | {name: c for name, c in named.items() if c is not None}

    def __call__(self, batch: Batch) -> dict[str, Any]:
        """The batch, or the row, in its weathers."""
        for column in self.columns.values():
            if column not in batch:
                raise ArgumentError(
                    f"there is no column {printable(column)!r}; there are "
                    f"{printable(', '.join(batch), 300)}: name yours, as in RandomWeather(..., "
                    "image='image', mask='annotation'), or mask=None if there are no labels"
                )
        one = not isinstance(batch[self.image], list)
        columns = [[batch[column]] if one else batch[column] for column in self.columns.values()]
        rows = [dict(zip(self.columns, row, strict=True)) for row in zip(*columns, strict=True)]
        done = [self._row(**row) for row in rows]
        # `map` gives a lazy mapping, and what it does not get back it keeps as it is on disk.
        weathered = dict(batch) if isinstance(batch, dict) else {}
        for k, column in enumerate((self.image,) if self.mask is None else (self.image, self.mask)):
            values = [row[k] for row in done]
            weathered[column] = values[0] if one else values
        return weathered

    def set_epoch(self, epoch: int) -> None:
        """Draw the weather of another epoch, in this process and in all workers."""
        self._sample.draws.set_epoch(epoch)

    def _row(
        self,
        picture: Any,
        mask: Any = None,
        depth: Any = None,
        scene_key: Any = None,
        sample: Any = None,
    ) -> tuple[Any, Any]:
        done = self._sample(
            _pixels(picture),
            mask=None if mask is None else _ids(mask),
            depth=np.asarray(depth) if isinstance(depth, Image.Image) else depth,
            scene_key=scene_key,
            sample=sample,
        )
        if done is None:
            return _as_it_was(picture), _as_it_was(mask)
        return _like(done.image, picture), _like(done.mask, mask)


def _pixels(picture: Any) -> NDArray[Any]:
    if not isinstance(picture, Image.Image):
        return _array("image", picture)
    if picture.mode != "RGB":
        raise ArgumentError(
            f"image is a PIL picture of mode {picture.mode}, it must be RGB: "
            "dataset.cast_column('image', datasets.Image(mode='RGB'))"
        )
    return np.asarray(picture)


def _ids(mask: Any) -> NDArray[Any]:
    if not isinstance(mask, Image.Image):
        return _array("mask", mask)
    if mask.mode not in MASK_MODES:
        raise ArgumentError(
            f"mask is a PIL picture of mode {mask.mode}, it must hold ids ({', '.join(MASK_MODES)})"
        )
    return np.asarray(mask)


def _array(name: str, value: Any) -> NDArray[Any]:
    if not isinstance(value, np.ndarray):
        raise ArgumentError(
            f"{name} must be a PIL picture or a numpy array, got {type(value).__name__}; a dataset "
            "gives pictures where the column is an Image feature"
        )
    return value


def _as_it_was(value: Any) -> Any:
    """Without the file it was read from: `map` would write a JPEG as another one, with losses."""
    return value.copy() if isinstance(value, Image.Image) else value


def _like(pixels: NDArray[Any] | None, given: Any) -> Any:
    if not isinstance(given, Image.Image) or pixels is None:
        return pixels
    done = Image.fromarray(pixels)
    if given.mode == "P":
        # A PNG of few colours has few bits a pixel, too few for most values of ignore_index.
        palette = given.getpalette("RGB") or []
        done.putpalette(palette + [0] * (3 * COLOURS - len(palette)))
    return done
