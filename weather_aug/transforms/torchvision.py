"""RandomWeather for torchvision's transforms.v2: weather as one line of a Compose."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import PIL.Image
import torch
from numpy.typing import NDArray

from weather_aug._checks import finite
from weather_aug._keys import key_of, uniforms
from weather_aug.clip.types import Camera
from weather_aug.errors import ArgumentError, MissingExtraError, printable
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.transforms.draws import Draws, sample_fields
from weather_aug.transforms.given import rgb_uint8
from weather_aug.transforms.picture import Drawn, Weathered, Weathering
from weather_aug.transforms.shelf import Shelf

try:
    from torchvision import tv_tensors
    from torchvision.transforms import v2
except (ImportError, RuntimeError) as error:
    # A torchvision that was built for another torch fails with "operator … does not exist".
    raise MissingExtraError(
        "torchvision is needed to use RandomWeather in a v2.Compose, and could not be imported "
        f"({printable(error)}); install the release that belongs to torch {torch.__version__}, "
        "from the index that torch came from: pip install torchvision"
    ) from error


class Unmarked(tv_tensors.Mask):
    """A mask that weather leaves as it is: instance ids, say.

    Flipped, cropped and resized (nearest) by v2 as every `tv_tensors.Mask`.
    """


class Depth(Unmarked):
    """(..., H, W) or (..., 1, H, W) float z-depth in metres of the picture beside it.

    Flipped, cropped and resized (nearest) by v2 as every `tv_tensors.Mask`. Unknown depth (NaN, 0,
    below 0) counts as far, as does `inf`.
    """


@dataclass(frozen=True)
class SampleKey:
    """What the sample is called, anywhere in it: its weather then hangs on this name alone.

    Raises:
        ArgumentError: If the name is no integer, string or tuple of these.
    """

    name: int | str | tuple[int | str, ...]

    def __post_init__(self) -> None:
        sample_fields(self.name)


@dataclass(frozen=True)
class SceneKey:
    """Which frame of `scenes` the picture is, anywhere in the sample; see `shelf.SceneKey`."""

    frame: Any


class RandomWeather(v2.Transform):
    """Rain, snow or fog drawn from a policy, over a picture and its label mask.

    Convention:
        A sample holds, in any structure, one picture: a `tv_tensors.Image` or a plain tensor
        (3, H, W), uint8 or float32 in [0, 1] (which is worked on in 8 bits), or an RGB PIL image;
        at most one `tv_tensors.Mask` (H, W) or (1, H, W) of integers, which comes back with
        `ignore_index` where weather hides the surface; and optionally one `Depth`, `Camera`,
        `SampleKey` and `SceneKey`. Types, dtypes, shapes and devices are kept; rendering is done on
        the CPU, without gradients. Boxes, key points, `Unmarked` masks and everything else are
        handed on as they are.

        As everywhere in v2, a batch (..., 3, H, W) shares one draw, and plain tensors beside the
        picture are handed on; one that looks like a mask is refused where no mask is wrapped. A
        `tv_tensors.Video` (..., T, 3, H, W) is a drive: the same drops fly on, under one light.
        Masks and depth of many pictures have the same leading axes, and there is one `Camera` or
        `SceneKey` for each picture, in order.

        Put the transform before crops, flips and colours: depth, camera and scene belong to the
        whole picture as it was taken. No default collation knows `Camera` and the keys: leave them
        out of what a Dataset returns.

        No generator is read or moved. With a `SampleKey` the weather hangs on (seed, epoch, name)
        alone, whatever the number of workers; without, no two calls of a training share theirs.

    Args:
        policy: Which weather how often, or its `to_dict` form; the default policy if None.
        p: Probability of any weather.
        seed: In [-2**63, 2**64).
        fps: Pictures a second of a video.
        scenes: Folders of scenes, where a `SceneKey` looks its frame up; the scene's own depth and
            camera are then used.
        how: Further arguments of `Weathering.of`.

    Raises:
        MissingExtraError: At import, if torchvision cannot be imported.
        ArgumentError: If an argument is out of range, or a sample is not as stated.
        DataError: If a mask holds an id that its taxonomy does not declare.
        SceneError: If a scene cannot be read.
    """

    _transformed_types = (torch.Tensor, PIL.Image.Image, Camera, SampleKey, SceneKey)

    def __init__(
        self,
        policy: WeatherPolicy | dict[str, Any] | None = None,
        p: float = 0.5,
        *,
        seed: int = 0,
        fps: float = 10.0,
        scenes: Sequence[str | os.PathLike[str]] = (),
        **how: Any,
    ) -> None:
        super().__init__()
        self.p = finite("p", p, 0, 1)
        self.fps = finite("fps", fps, 1e-3, 1e4)
        self.weathering = Weathering.of(policy, **how)
        self.draws = Draws("torchvision", seed)
        self.shelf = Shelf(scenes)

    def set_epoch(self, epoch: int) -> None:
        """Draw the weather of another epoch, in this process and in all workers."""
        self.draws.set_epoch(epoch)

    def check_inputs(self, flat_inputs: list[Any]) -> None:
        """Refuse what looks like a label mask, and which v2 hands on as it is."""
        pictures = [each for each in flat_inputs if _is_picture(each)]
        # As v2 does: a plain tensor is a picture where nothing else is one, and the first alone.
        picture = ([each for each in pictures if not _is_plain(each)] or pictures or [None])[0]
        if picture is None or any(_is_label(each) for each in flat_inputs):
            return
        for each in flat_inputs:
            if each is not picture and _is_unwrapped_mask(each, _size(picture)):
                raise ArgumentError(
                    f"a plain array of shape {tuple(each.shape)} looks like a mask and would come "
                    "back unmarked: wrap it as tv_tensors.Mask, or as Unmarked if it is no label"
                )

    def make_params(self, flat_inputs: list[Any]) -> dict[str, Any]:
        """The weathered picture and mask, None where the draw leaves the sample as it is."""
        sample = _Sample.of(flat_inputs)
        key = self.draws.key(sample.pixels, sample.name)
        if uniforms(key_of("torchvision-p", key % 2**64), 1)[0] >= self.p:
            return {"picture": None, "mask": None}
        done = self._weathered(sample, self.weathering.draw(key))
        return {
            "picture": _picture_like(sample.picture, done),
            "mask": _mask_like(sample.mask, [each.mask for each in done]),
        }

    def transform(self, inpt: Any, params: dict[str, Any]) -> Any:
        """The weathered one of an input, or itself."""
        kind = "picture" if _is_picture(inpt) else "mask" if _is_label(inpt) else None
        done = None if kind is None else params[kind]
        return inpt if done is None else done

    def extra_repr(self) -> str:
        """What the printed transform says of itself."""
        return f"p={self.p}, seed={self.draws.seed}, types={dict(self.weathering.policy.types)}"

    def _weathered(self, sample: _Sample, drawn: Drawn) -> list[Weathered]:
        if sample.scene_keys is not None:
            return self._from_scenes(sample, sample.scene_keys, drawn)
        done = []
        for start in range(0, len(sample.pixels), sample.num_together):
            part = slice(start, start + sample.num_together)
            known = {name: values and values[part] for name, values in sample.known.items()}
            pictures = list(sample.pixels[part])
            done += self.weathering.render_stack(pictures, drawn, fps=self.fps, **known)
        return done

    def _from_scenes(self, sample: _Sample, keys: list[Any], drawn: Drawn) -> list[Weathered]:
        masks = sample.known["masks"] or [None] * len(keys)
        done = []
        for image, mask, key in zip(sample.pixels, masks, keys, strict=True):
            shot = self.shelf.render(key, image, drawn, self.weathering.options)
            done.append(self.weathering.handed_back(image, mask, shot))
        return done


@dataclass(frozen=True)
class _Sample:
    """What the flat inputs of one call hold."""

    picture: Any
    """As given."""
    mask: torch.Tensor | None
    """As given."""
    pixels: NDArray[Any]
    """(N, H, W, 3) uint8, all pictures."""
    num_together: int
    """How many pictures in a row are of one drive."""
    known: dict[str, list[Any] | None]
    """`masks`, `depths`, `cameras`: N of each, or None."""
    scene_keys: list[Any] | None
    name: Any
    """Of the sample."""

    @classmethod
    def of(cls, flat_inputs: list[Any]) -> _Sample:
        pictures = [each for each in flat_inputs if _is_picture(each)]
        if not pictures:
            raise ArgumentError(
                "RandomWeather needs a picture: a tv_tensors.Image or Video, an RGB PIL image, or "
                "a tensor (3, H, W)"
            )
        picture = _at_most_one(
            "picture", pictures, "call RandomWeather for each, and wrap masks as tv_tensors.Mask"
        )
        labels = [each for each in flat_inputs if _is_label(each)]
        mask = _at_most_one(
            "mask", labels, "wrap depth as Depth, what else is no label as Unmarked"
        )
        depths = [each for each in flat_inputs if isinstance(each, Depth)]
        depth = _at_most_one("depth", depths, "give that of the picture")
        names = [each.name for each in flat_inputs if isinstance(each, SampleKey)]
        cameras = [each for each in flat_inputs if isinstance(each, Camera)]
        keys = [each.frame for each in flat_inputs if isinstance(each, SceneKey)]

        pixels, leading = _pixels(picture)
        size = (*leading, *pixels.shape[1:3])
        known = {
            "masks": None if mask is None else _planes("mask", mask, size),
            "depths": None if depth is None else _planes("depth", _float32(depth), size),
            "cameras": _one_each("Camera", cameras, len(pixels)),
        }
        return cls(
            picture,
            mask,
            pixels,
            leading[-1] if isinstance(picture, tv_tensors.Video) else 1,
            known,
            _one_each("SceneKey", keys, len(pixels)),
            _at_most_one("SampleKey", names, "a sample has one name"),
        )


def _is_plain(inpt: Any) -> bool:
    return isinstance(inpt, torch.Tensor) and not isinstance(inpt, tv_tensors.TVTensor)


def _is_picture(inpt: Any) -> bool:
    wrapped = tv_tensors.Image | tv_tensors.Video | PIL.Image.Image
    return isinstance(inpt, wrapped) or _is_plain(inpt)


def _is_label(inpt: Any) -> bool:
    return isinstance(inpt, tv_tensors.Mask) and not isinstance(inpt, Unmarked)


def _is_unwrapped_mask(inpt: Any, size: tuple[int, ...]) -> bool:
    if isinstance(inpt, np.ndarray):
        return inpt.shape[-2:] == size and inpt.dtype.kind in "iu"
    return _is_plain(inpt) and inpt.shape[-2:] == size and not inpt.is_floating_point()


def _size(picture: Any) -> tuple[int, ...]:
    """(H, W)."""
    if isinstance(picture, PIL.Image.Image):
        return picture.height, picture.width
    return tuple(picture.shape[-2:])


def _at_most_one(kind: str, found: list[Any], cure: str) -> Any:
    if len(found) > 1:
        raise ArgumentError(f"a sample may hold one {kind}, got {len(found)}: {cure}")
    return found[0] if found else None


def _one_each(kind: str, found: list[Any], count: int) -> list[Any] | None:
    if found and len(found) != count:
        raise ArgumentError(
            f"a sample must hold one {kind} for each of {count} pictures, got {len(found)}"
        )
    return found or None


def _pixels(picture: Any) -> tuple[NDArray[Any], tuple[int, ...]]:
    """(N, H, W, 3) uint8 pixels of a picture or of many, and the axes that lead to them."""
    if isinstance(picture, PIL.Image.Image):
        if picture.mode != "RGB":
            raise ArgumentError(
                f"image must be an RGB picture, got mode {picture.mode}; convert it with "
                "image.convert('RGB')"
            )
        return np.asarray(picture)[None], ()
    if picture.ndim < 3 or picture.shape[-3] != 3 or 0 in picture.shape:
        raise ArgumentError(f"image must have shape (..., 3, H, W), got {tuple(picture.shape)}")
    if picture.dtype not in (torch.uint8, torch.float32):
        raise ArgumentError(
            f"image must be uint8, or float32 in [0, 1], got {picture.dtype}; put "
            "v2.ToDtype(torch.float32) before, with scale=True if it holds integers"
        )
    if picture.requires_grad and torch.is_grad_enabled():
        raise ArgumentError(
            "image must not require a gradient, which this RandomWeather cannot give: detach it, "
            "or use weather_aug.transforms.kornia"
        )
    pixels = picture.detach().cpu().movedim(-3, -1).reshape(-1, *_size(picture), 3).numpy()
    if picture.dtype == torch.float32:
        pixels = np.stack([rgb_uint8(each) for each in pixels])
    return pixels, tuple(picture.shape[:-3])


def _planes(name: str, given: torch.Tensor, size: tuple[int, ...]) -> list[NDArray[Any]]:
    """N arrays (H, W) of a mask or depth beside pictures of (leading axes, H, W)."""
    if tuple(given.shape) not in (size, (*size[:-2], 1, *size[-2:])):
        raise ArgumentError(
            f"{name} must have the picture's shape {size}, or (..., 1, H, W), got "
            f"{tuple(given.shape)}"
        )
    return list(given.detach().cpu().reshape(-1, *size[-2:]).numpy())


def _float32(depth: torch.Tensor) -> torch.Tensor:
    """A float depth in a type that numpy knows; another is refused when it is rendered."""
    return depth.float() if depth.is_floating_point() else depth


def _picture_like(given: Any, weathered: list[Weathered]) -> Any:
    images = [each.image for each in weathered]
    if isinstance(given, PIL.Image.Image):
        return PIL.Image.fromarray(images[0])
    height, width, _ = images[0].shape
    done = np.empty((len(images), 3, height, width), np.uint8)
    for place, image in zip(done, images, strict=True):
        place[...] = image.transpose(2, 0, 1)
    # torchvision's own steps between 8 bits and [0, 1], which differ from others in the last bit.
    scaled = v2.functional.to_dtype(torch.from_numpy(done), given.dtype, scale=True)
    if given.is_floating_point():
        # What the weather leaves alone keeps its finer value.
        same = np.stack([each.image == each.shot.frame.image for each in weathered])
        own = given.detach().as_subclass(torch.Tensor).cpu().reshape(scaled.shape)
        scaled = torch.where(torch.from_numpy(same).movedim(-1, 1), own, scaled).contiguous()
    return _like(given, scaled)


def _mask_like(given: torch.Tensor | None, masks: list[Any]) -> torch.Tensor | None:
    return None if given is None else _like(given, torch.from_numpy(np.stack(masks)))


def _like(given: torch.Tensor, done: torch.Tensor) -> torch.Tensor:
    """A tensor of the shape, device and class of the given one."""
    return tv_tensors.wrap(done.reshape(given.shape).to(given.device), like=given)
