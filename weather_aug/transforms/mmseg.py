"""RandomWeather for mmsegmentation 0.x and 1.x, and the forks of DAFormer, HRDA and MIC."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weather_aug.errors import ArgumentError, ConflictError, MissingExtraError, printable
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.transforms.sampled import SampleWeather

LABELS = ("gt_seg_map", "gt_semantic_seg")
"""Where 1.x and 0.x keep the label."""
NAMES = ("sample_idx", "ori_filename", "filename", "img_path")
"""What tells samples apart: the first that there is."""
REGISTRIES = (("mmseg.registry", "TRANSFORMS"), ("mmseg.datasets.builder", "PIPELINES"))
"""Of 1.x and of 0.x."""

Results = dict[str, Any]


class RandomWeather:
    """Rain, snow or fog drawn from a policy, as one line of a pipeline.

    Convention:
        A plain callable `results -> results`: no mmcv, mmengine or mmseg is needed to use it. `img`
        is (H, W, 3), uint8 or float32 in [0, 1]; the label, `gt_seg_map` or `gt_semantic_seg`, is
        (H, W) integers and comes back with `ignore_index` where the weather hides the surface. Both
        are new arrays in a new dict; whatever else is in `results` (`valid_pseudo_mask`,
        `gt_depth_map`, …) stays the same object. The label counts as it is in `results`, after
        `reduce_zero_label` and `label_map`.

        Depth is `results[depth_key]` where there is one, else what `Weathering` finds from the
        label or, in pipelines without labels, from the picture alone. `results["camera"]` may hold
        a `weather_aug.Camera`, `results["scene_key"]` the picture's frame in one of `scenes`.

        Put it after the loading, before crops, flips, padding and `Normalize`: depth and camera
        belong to the whole picture. A `Resize` alone may come first (it then costs less), but not
        with depth, camera or scene of the picture in its first size.

        Draws hang on `seed`, the worker's seed and the number of the call, so no two are alike.
        With `keyed` they hang on `seed`, `set_epoch` and the sample's name (`sample_idx`, else its
        file) alone: the same weather in each pass, as a test set wants it. No global generator is
        read or moved.

    Args:
        policy: Which weather how often, or its `to_dict` form, such as `dict(types=dict(rain=1))`.
        p: Probability of any weather, in [0, 1].
        seed: Of all draws.
        keyed: Whether a sample's name decides its weather.
        scenes: Folders of scenes for `scene_key`.
        channel_order: Of `img`: "bgr", as mmseg loads it, or "rgb".
        depth_key: Key of an (H, W) float z-depth in metres.
        how: `speed_m_per_s`, `camera_height_m`, `hfov_deg`, `options`, `taxonomy`, `ignore_index`,
            `unknown_ids`, `depth_cache`, `depth_network`: see `Weathering.of`.

    Raises:
        ArgumentError: If an argument is outside its range, or at a call `results` has no `img` or
            one that was cropped, padded, flipped or normalised before, or there is no name to key
            the draw by.
        DataError: If the label holds an id that its taxonomy does not declare.
    """

    def __init__(
        self,
        policy: WeatherPolicy | dict[str, Any] | None = None,
        p: float = 0.5,
        *,
        seed: int = 0,
        keyed: bool = False,
        scenes: Sequence[str | os.PathLike[str]] = (),
        channel_order: str = "bgr",
        depth_key: str = "depth",
        **how: Any,
    ) -> None:
        if channel_order not in ("bgr", "rgb"):
            raise ArgumentError(
                f"channel_order must be 'bgr' or 'rgb', got {printable(channel_order)!r}"
            )
        self._sample = SampleWeather("mmseg", policy, p=p, seed=seed, scenes=scenes, how=how)
        self.keyed = keyed
        self.channel_order = channel_order
        self.depth_key = depth_key

    def __call__(self, results: Results) -> Results:
        """The same as `transform`, which is what 1.x calls it."""
        return self.transform(results)

    def transform(self, results: Results) -> Results:
        """Weather of one sample; `results` is not changed."""
        _check_whole(results)
        label = next((name for name in LABELS if results.get(name) is not None), None)
        done = self._sample(
            self._swapped(results["img"]),
            mask=None if label is None else results[label],
            depth=results.get(self.depth_key),
            camera=results.get("camera"),
            scene_key=results.get("scene_key"),
            sample=_name(results) if self.keyed else None,
        )
        if done is None:
            return dict(results)
        weathered = results | {"img": np.ascontiguousarray(self._swapped(done.image))}
        if label is not None:
            weathered[label] = done.mask
        return weathered

    def set_epoch(self, epoch: int) -> None:
        """Draw the weather of another epoch, in this process and in all workers."""
        self._sample.draws.set_epoch(epoch)

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({self._sample.weathering.policy}, p={self._sample.p}, "
            f"seed={self._sample.draws.seed}, keyed={self.keyed})"
        )

    def _swapped(self, image: NDArray[Any]) -> NDArray[Any]:
        return image[..., ::-1] if self.channel_order == "bgr" else image


def register(name: str = "RandomWeather") -> str:
    """Let configs of mmseg say `dict(type="RandomWeather", ...)`; a second time does nothing.

    Importing this module does it, too, so in a config it is enough to write
    `custom_imports = dict(imports=["weather_aug.transforms.mmseg"])`.

    Args:
        name: What configs call it.

    Returns:
        The registry: "mmseg.registry.TRANSFORMS" (1.x) or "mmseg.datasets.builder.PIPELINES" (0.x).

    Raises:
        MissingExtraError: If there is no mmseg.
        ConflictError: If the name is another's.
        Exception: Whatever mmseg raises where it is installed but cannot be imported.
    """
    for module, attribute in REGISTRIES:
        try:
            registry = getattr(import_module(module), attribute)
        except ModuleNotFoundError as error:
            if error.name is None or not f"{module}.".startswith(f"{error.name}."):
                raise
            continue
        known = registry.module_dict.get(name)
        if known is None:
            registry.register_module(name=name, module=RandomWeather)
        elif known is not RandomWeather:
            raise ConflictError(
                f"{module}.{attribute} has another {printable(name)!r} ({known.__module__}); "
                "choose a name: weather_aug.transforms.mmseg.register('WeatherAug')"
            )
        return f"{module}.{attribute}"
    raise MissingExtraError(
        "mmseg is needed to register RandomWeather for configs; install mmsegmentation, or put "
        "the transform itself into the pipeline, which needs neither"
    )


def _register_quietly() -> None:
    """As far as possible: who has no mmseg needs no registry; who has a broken one is told."""
    try:
        register()
    except MissingExtraError:
        return
    # mmseg's own checks of versions are assertions.
    except Exception as error:
        warnings.warn(
            f"RandomWeather is not registered with mmseg ({type(error).__name__}: "
            f"{printable(error, 300)}); when that is mended call "
            "weather_aug.transforms.mmseg.register()",
            stacklevel=2,
        )


def _check_whole(results: Results) -> None:
    """Refuse a picture that is only a part or a mirror image of what the camera took."""
    image = results.get("img")
    if not isinstance(image, np.ndarray) or image.ndim != 3:
        found = image.shape if isinstance(image, np.ndarray) else type(image).__name__
        raise ArgumentError(
            f"results['img'] must be an (H, W, 3) array, got {found}: put RandomWeather after "
            "LoadImageFromFile and before formatting"
        )
    if results.get("flip"):
        raise ArgumentError("results['img'] has been flipped: put RandomWeather before RandomFlip")
    if "ori_shape" not in results:
        return
    # 0.x: a number or (w, h, w, h); 1.x: (w, h).
    scale = np.atleast_1d(np.asarray(results.get("scale_factor", 1.0), float))
    whole = np.array(results["ori_shape"][:2]) * (scale[min(1, scale.size - 1)], scale[0])
    if np.abs(whole - image.shape[:2]).max() > 1:
        raise ArgumentError(
            f"results['img'] is {image.shape[:2]}, but ori_shape {tuple(results['ori_shape'][:2])} "
            f"scaled by {results.get('scale_factor', 1.0)} is another size: put RandomWeather "
            "before crops and padding, after at most one Resize"
        )


def _name(results: Results) -> Any:
    for key in NAMES:
        if results.get(key) is not None:
            return results[key]
    raise ArgumentError(f"keyed=True needs a sample's name: results has none of {', '.join(NAMES)}")


_register_quietly()
