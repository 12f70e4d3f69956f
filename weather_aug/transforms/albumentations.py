"""RandomWeather for albumentations 2.0.8 and AlbumentationsX: weather as one line of a Compose."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import finite
from weather_aug._extras import require
from weather_aug._keys import key_of, uniforms
from weather_aug.errors import ArgumentError, printable
from weather_aug.render.options import RenderOptions
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.taxonomy import IGNORE
from weather_aug.transforms.draws import Draws, worker_seed
from weather_aug.transforms.picture import Drawn, Weathered, Weathering
from weather_aug.transforms.shelf import Shelf

# Without it the import below would fail with no word on which extra to install.
require("albumentations", extra="albumentations", to="use RandomWeather in a Compose")

import albumentations as A  # noqa: E402

_PICTURES = ("image", "images", "volume", "volumes")
"""Kinds of targets that hold pictures; depth and mask belong to one of them alone."""
_OF_A_PICTURE = ("mask", "depth", "camera", "scene_key")
_OF_A_STACK = ("depths", "cameras", "scene_keys")

if hasattr(A.BasicTransform, "sample_parameters"):  # AlbumentationsX
    from albumentations.core.transform_params import SampledParams

    class _Host(A.DualTransform):
        _targets = ("image", "images", "mask", "masks", "bboxes", "keypoints")
        _supported_bbox_types = frozenset({"hbb", "obb"})

        def apply_in_invocation(
            self, invocation: Any, /, *args: Any, force_apply: bool, **data: Any
        ) -> Any:
            """Decide by its name whether a named sample gets weather."""
            applied = self.decided(data, force_apply)
            if applied is False:
                return data
            force_apply = force_apply or bool(applied)
            return super().apply_in_invocation(invocation, *args, force_apply=force_apply, **data)

        def sample_parameters(
            self, params: Any, data: dict[str, Any], targets: Any, sampling: Any
        ) -> Any:
            """Draw weather, seed and speed: JSON values only, so that a replay can store them."""
            return SampledParams(params=self.drawn(data, sampling.random_generator).to_dict())

        def apply_with_params(self, sampled_params: Any, *args: Any, **data: Any) -> dict[str, Any]:
            """Render what is a picture and hand on everything else as it is."""
            return self.weathered(sampled_params.params, data)

else:

    class _Host(A.DualTransform):  # type: ignore[no-redef]
        def __call__(self, *args: Any, force_apply: bool = False, **data: Any) -> Any:
            """Decide by its name whether a named sample gets weather."""
            applied = self.decided(data, force_apply)
            if applied is None and not (force_apply or self.replay_mode) and worker_seed():
                # Its workers would all decide alike.
                applied = self.gate(int(self.random_generator.integers(2**62)), worker_seed())
            if applied is False:
                self.params: dict[str, Any] = {}
                return data
            return super().__call__(*args, force_apply=force_apply or bool(applied), **data)

        def update_transform_params(
            self, params: dict[str, Any], data: dict[str, Any]
        ) -> dict[str, Any]:
            """Nothing to add: what depends on the data is checked and read when it is rendered."""
            return params

        def get_params_dependent_on_data(
            self, params: dict[str, Any], data: dict[str, Any]
        ) -> dict[str, Any]:
            """Draw weather, seed and speed: JSON values only, so that a replay can store them."""
            return self.drawn(data, self.random_generator).to_dict()

        def apply_with_params(
            self, params: dict[str, Any], *args: Any, **data: Any
        ) -> dict[str, Any]:
            """Render what is a picture and hand on everything else as it is."""
            return self.weathered(params, data)


class RandomWeather(_Host):
    """Rain, snow or fog drawn from a policy, over pictures and their label masks.

    Convention:
        **One picture.** `image` is (H, W, 3) RGB, uint8 or float32 in [0, 1] (worked on in 8 bits);
        `mask` is (H, W) integers and comes back with `ignore_index` where the weather hides the
        surface. Depth and camera are those of the call where given: `depth` (H, W) float, metres
        along the optical axis (NaN, 0 and below 0 count as far, as does `inf`; refused if unknown
        on more than half of the pixels outside the sky), `camera` a `weather_aug.Camera`. Else
        depth is found as `DepthSource` says, and the camera is level.

        **One frame of a scene.** With `scenes` and a `scene_key` (see `transforms.shelf.SceneKey`)
        the scene renders its frame, with its own depth, camera and light; `image` must be that
        frame's picture. The mask given is marked where the scene says that its surface is hidden.

        **A stack.** `images` (N, H, W, 3), or a list, are the pictures of one drive, `fps` of them
        a second, in one weather under one light: the same drops fly on. `masks`, `depths`,
        `cameras` and `scene_keys` then hold one for each; frames of scenes keep their own times.

        Weather moves nothing: all other targets (boxes, points, further masks, and `masks` beside
        `image`) pass through unchanged. A second picture is refused, because it would need a depth
        of its own. Put the transform before crops and flips: depth and camera belong to the whole
        picture.

        **Randomness.** A call with a `sample_key` (an integer, a string, or a tuple of these, such
        as (epoch, index)) gets what (seed, `set_epoch`, sample_key) decide, `p` included, in any
        process, in any order. `seed` is an argument, because a Compose hands its transforms a
        generator and never its seed. Two weathers in one Compose need different seeds. Without a
        key the Compose's generator is drawn from, mixed with the DataLoader worker's seed; that
        differs between numbers of workers. Global generators are neither read nor moved.

        **Writing down.** All arguments are JSON values, or become such; `A.to_dict`, `A.save` and
        `ReplayCompose` reproduce the picture. A `depth_network` that is a function is refused
        there.

    Args:
        policy: Which weather how often, or its `to_dict` form.
        speed_m_per_s: Range of the car's speed, which leans and lengthens the streaks.
        camera_height_m: Over the ground, of a camera that is not given.
        hfov_deg: Horizontal field of view of a camera that is not given.
        options: Choices besides the weather, or their fields as a dict; effects are left out by
            name, as in `RenderOptions(without=("drops", "noise"))`.
        max_particles: Budget of the renderer, instead of the one in `options`.
        taxonomy: What the mask's ids mean: a name, the train class (or None) of each id, or None.
        ignore_index: The id that hidden pixels get.
        unknown_ids: What an id is that the taxonomy does not declare: "error" or "ignore".
        depth_cache: Folder of depths by the picture's content.
        depth_network: Folder or name of a `depth-estimation` model, or a function.
        scenes: Folders of scenes for `scene_key`.
        fps: Pictures a second of a stack.
        seed: Of named samples.
        p: Probability of any weather.

    Raises:
        MissingExtraError: At import, if albumentations is not installed.
        ArgumentError: If an argument is out of range, an additional target is a picture, or at a
            call there is no picture, more than one, or one that does not fit what comes with it.
        DataError: At a call, if the mask holds an id that its taxonomy does not declare.
    """

    def __init__(
        self,
        policy: WeatherPolicy | dict[str, Any] | None = None,
        *,
        speed_m_per_s: tuple[float, float] = (0.0, 15.0),
        camera_height_m: float = 1.5,
        hfov_deg: float = 60.0,
        options: RenderOptions | dict[str, Any] | None = None,
        max_particles: int | None = None,
        taxonomy: str | Mapping[Any, str | None] | None = "train_ids",
        ignore_index: int = IGNORE,
        unknown_ids: Literal["error", "ignore"] = "error",
        depth_cache: str | None = None,
        depth_network: str | Callable[..., Any] | None = None,
        scenes: Sequence[str | os.PathLike[str]] = (),
        fps: float = 10.0,
        seed: int = 0,
        p: float = 0.5,
    ) -> None:
        super().__init__(p=finite("p", p, 0, 1))
        weathering = Weathering.of(
            policy,
            speed_m_per_s=speed_m_per_s,
            camera_height_m=camera_height_m,
            hfov_deg=hfov_deg,
            options=options,
            taxonomy=taxonomy,
            ignore_index=ignore_index,
            unknown_ids=unknown_ids,
            depth_cache=depth_cache,
            depth_network=depth_network,
        )
        if max_particles is not None:
            fewer = replace(weathering.options, max_particles=max_particles)
            weathering = replace(weathering, options=fewer)
        self.weathering = weathering
        self.shelf = Shelf(scenes)
        self.fps = finite("fps", fps, 1e-3, 1e4)
        self.draws = Draws("albumentations", seed)

    def set_epoch(self, epoch: int) -> None:
        """Draw the weather of another epoch for named samples, in this process and all workers."""
        self.draws.set_epoch(epoch)

    def decided(self, data: Mapping[str, Any], force_apply: bool) -> bool | None:
        """Whether a named sample gets weather; None leaves that to the host."""
        if data.get("sample_key") is None or force_apply or self.replay_mode:
            return None
        return self.gate(self._key(data) % 2**64)

    def gate(self, *fields: int) -> bool:
        """Whether there is weather; of a domain of its own, so that it says nothing about it."""
        return bool(uniforms(key_of("albumentations-p", *fields), 1)[0] < self.p)

    def drawn(self, data: Mapping[str, Any], generator: np.random.Generator) -> Drawn:
        """Weather, seed and speed for one call."""
        if data.get("sample_key") is not None:
            return self.weathering.draw(self._key(data))
        own = int(generator.integers(2**62))
        # Albumentations 2.0.8 gives every worker the same generator.
        return self.weathering.draw(key_of("albumentations", own, worker_seed()))

    def _key(self, data: Mapping[str, Any]) -> int:
        """The key of a named sample, which does not hang on its picture."""
        unseen: Any = None
        return self.draws.key(unseen, data["sample_key"])

    def weathered(self, params: dict[str, Any], data: dict[str, Any]) -> dict[str, Any]:
        """A call's data with its picture or stack in the weather of `Drawn.to_dict`."""
        for name in ("volume", "volumes"):
            if data.get(name) is not None:
                raise _second_picture(name)
        drawn = Drawn.from_dict(params)
        if data.get("images") is None:
            if data.get("image") is None:
                raise ArgumentError("RandomWeather needs a picture: pass image=… (H, W, 3)")
            return data | self._picture(drawn, data)
        if data.get("image") is not None:
            raise _second_picture("images")
        return data | self._stack(drawn, data)

    def _picture(self, drawn: Drawn, data: dict[str, Any]) -> dict[str, Any]:
        image, given = data["image"], data.get("mask")
        mask = _plane(given)
        if data.get("scene_key") is not None:
            done = self._of_scene(data["scene_key"], image, mask, drawn)
        else:
            depth, camera = _plane(data.get("depth")), data.get("camera")
            done = self.weathering.render(image, drawn, mask=mask, depth=depth, camera=camera)
        if done.mask is None or given is None:
            return {"image": done.image}
        return {"image": done.image, "mask": done.mask.reshape(given.shape)}

    def _stack(self, drawn: Drawn, data: dict[str, Any]) -> dict[str, Any]:
        for name in _OF_A_PICTURE:
            if data.get(name) is not None:
                raise ArgumentError(
                    f"{name} belongs to image=…; with images give {name}s, one for each picture"
                )
        for name in ("images", "masks", *_OF_A_STACK):
            if not isinstance(data.get(name), Sequence | np.ndarray | None):
                raise ArgumentError(
                    f"{name} must be a list or an array, got {type(data[name]).__name__}"
                )
        images, given, scene_keys = data["images"], data.get("masks"), data.get("scene_keys")
        masks = None if given is None else [_plane(mask) for mask in given]
        if scene_keys is None:
            depths = data.get("depths")
            done = self.weathering.render_stack(
                images,
                drawn,
                fps=self.fps,
                masks=masks,
                depths=None if depths is None else [_plane(depth) for depth in depths],
                cameras=data.get("cameras"),
            )
        else:
            done = self._stack_of_scene(scene_keys, images, masks, drawn)
        stack = {"images": _like(images, [each.image for each in done])}
        if given is not None:
            marked = [each.mask for each in done if each.mask is not None]
            pairs = zip(marked, given, strict=True)
            stack["masks"] = _like(given, [mask.reshape(own.shape) for mask, own in pairs])
        return stack

    def _stack_of_scene(
        self,
        scene_keys: Sequence[Any],
        images: Sequence[NDArray[Any]],
        masks: Sequence[NDArray[Any]] | None,
        drawn: Drawn,
    ) -> list[Weathered]:
        for name, values in (("scene_keys", scene_keys), ("masks", masks)):
            if values is not None and len(values) != len(images):
                raise ArgumentError(
                    f"{name} must hold one for each of {len(images)} pictures, got {len(values)}"
                )
        none = [None] * len(images)
        each = zip(scene_keys, images, none if masks is None else masks, strict=True)
        return [self._of_scene(key, image, mask, drawn) for key, image, mask in each]

    def _of_scene(
        self, scene_key: Any, image: Any, mask: NDArray[Any] | None, drawn: Drawn
    ) -> Weathered:
        shot = self.shelf.render(scene_key, image, drawn, self.weathering.options)
        return self.weathering.handed_back(image, mask, shot)

    def add_targets(self, additional_targets: dict[str, str]) -> None:
        """Take further targets of a Compose; refuse pictures as soon as it is made."""
        for name, kind in additional_targets.items():
            if kind in _PICTURES:
                raise _second_picture(name)
        super().add_targets(additional_targets)

    def _set_keys(self) -> None:
        super()._set_keys()
        # A strict Compose refuses what no transform of it knows.
        self._available_keys |= {*_OF_A_PICTURE, *_OF_A_STACK, "sample_key"}

    def get_transform_init_args(self) -> dict[str, Any]:
        """The constructor's arguments besides `p`, as JSON values."""
        depth = self.weathering.depth
        plain = replace(self.weathering, depth=replace(depth, network=None)).to_dict()
        own = {"scenes": list(self.shelf.paths), "fps": self.fps, "seed": self.draws.seed}
        return plain | {"depth_network": depth.network} | own

    def to_dict_private(self) -> dict[str, Any]:
        """What `A.to_dict` writes down.

        Raises:
            ArgumentError: If depth comes from a function.
        """
        self.weathering.to_dict()
        return super().to_dict_private()


class RandomRain(RandomWeather):
    """Rain alone, of a rate in a range.

    Args:
        mm_per_h: Range of rates, mm/h; see `WeatherPolicy.rain`.
        how: As `RandomWeather` takes, besides `policy`.
    """

    def __init__(self, mm_per_h: tuple[float, float] = (1.5, 75.0), **how: Any) -> None:
        super().__init__(WeatherPolicy.rain(mm_per_h), **how)
        self.mm_per_h = tuple(mm_per_h)

    def get_transform_init_args(self) -> dict[str, Any]:
        """The constructor's arguments besides `p`, as JSON values."""
        return _in_units(super().get_transform_init_args(), mm_per_h=self.mm_per_h)


class RandomSnow(RandomWeather):
    """Snow alone, of a rate in a range.

    Args:
        mm_per_h: Range of rates, mm/h of water; see `WeatherPolicy.snow`.
        how: As `RandomWeather` takes, besides `policy`.
    """

    def __init__(self, mm_per_h: tuple[float, float] = (0.4, 4.0), **how: Any) -> None:
        super().__init__(WeatherPolicy.snow(mm_per_h), **how)
        self.mm_per_h = tuple(mm_per_h)

    def get_transform_init_args(self) -> dict[str, Any]:
        """The constructor's arguments besides `p`, as JSON values."""
        return _in_units(super().get_transform_init_args(), mm_per_h=self.mm_per_h)


class RandomFog(RandomWeather):
    """Fog alone, of a visibility in a range.

    Args:
        visibility_m: Range of meteorological optical ranges, m; see `WeatherPolicy.fog`.
        how: As `RandomWeather` takes, besides `policy`.
    """

    def __init__(self, visibility_m: tuple[float, float] = (50.0, 600.0), **how: Any) -> None:
        super().__init__(WeatherPolicy.fog(visibility_m), **how)
        self.visibility_m = tuple(visibility_m)

    def get_transform_init_args(self) -> dict[str, Any]:
        """The constructor's arguments besides `p`, as JSON values."""
        return _in_units(super().get_transform_init_args(), visibility_m=self.visibility_m)


def _in_units(how: dict[str, Any], **units: tuple[float, ...]) -> dict[str, Any]:
    """Arguments with a range in place of the policy that follows from it."""
    others = {name: value for name, value in how.items() if name != "policy"}
    return {name: [float(end) for end in ends] for name, ends in units.items()} | others


def _plane(array: Any) -> Any:
    """(H, W) of a plane that AlbumentationsX, or a caller, gave a last axis of one channel."""
    channelled = isinstance(array, np.ndarray) and array.ndim == 3 and array.shape[2] == 1
    return array[..., 0] if channelled else array


def _like(given: Any, done: list[Any]) -> Any:
    """A stack in the container in which it came."""
    if not isinstance(given, np.ndarray):
        return done
    return np.stack(done) if done else given.copy()


def _second_picture(name: str) -> ArgumentError:
    return ArgumentError(
        f"RandomWeather weathers one target, image or images, and {printable(name)!r} is another "
        "picture: call the pipeline once for each, or declare what is no picture as 'mask'"
    )
