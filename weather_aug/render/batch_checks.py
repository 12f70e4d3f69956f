"""What `render_batch` refuses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from weather_aug.clip.types import Camera
from weather_aug.edit.physical.layers import Layers
from weather_aug.errors import ArgumentError
from weather_aug.render.options import DEFAULT_OPTIONS, RenderOptions

NOT_DRAWN = ("preset", "multiple_scattering")
"""Options that `render` knows and a batch does not: it takes their default only."""
UNDRAWN = (
    *("lamps", "spray", "drops", "wipers", "lens_veil"),
    *("noise", "glare", "compression"),
)
"""Effects that a batch does not draw; `without` must name them, so that nothing differs silently.
"spray" is what single vehicles raise: the layer of spray over the road is drawn."""
BATCH_OPTIONS = RenderOptions(without=UNDRAWN)
"""All that a batch draws; `dataclasses.replace` makes others of it."""


def check_tensors(images: Any, depth_m: Any, labels: Any) -> None:
    """Refuse tensors of a wrong type, shape, dtype, device or range.

    Raises:
        ArgumentError: If one is.
    """
    for name, tensor in (("images", images), ("depth_m", depth_m), ("labels", labels)):
        if not isinstance(tensor, Tensor) and not (name == "labels" and tensor is None):
            raise ArgumentError(f"{name} must be a torch tensor, got {type(tensor).__name__}")
    _check_images(images)
    _check_depth(depth_m, images)
    if labels is not None:
        _check_labels(labels, images)
    for name, tensor in (("depth_m", depth_m), ("labels", labels)):
        if tensor is not None and tensor.device != images.device:
            raise ArgumentError(
                f"{name} must be on the images' device {images.device}, got {tensor.device}"
            )
    low, high = (float(v) for v in torch.aminmax(images.detach()))
    if not (low >= 0.0 and high <= 1.0):
        raise ArgumentError(f"images must be in [0, 1], got [{low:g}, {high:g}]; clamp or rescale")


def _check_images(images: Tensor) -> None:
    shape = tuple(images.shape)
    if images.ndim != 4 or shape[1] != 3 or 0 in shape:
        raise ArgumentError(f"images must have shape (B, 3, H, W) without zeros, got {shape}")
    if not images.dtype.is_floating_point:
        raise ArgumentError(f"images must be floating point in [0, 1], got {images.dtype}")
    if images.device.type not in ("cpu", "cuda"):
        raise ArgumentError(f"images must be on a CPU or CUDA device, got {images.device}")


def _check_depth(depth_m: Tensor, images: Tensor) -> None:
    count, _, height, width = images.shape
    if tuple(depth_m.shape) not in ((count, height, width), (count, 1, height, width)):
        raise ArgumentError(
            f"depth_m must have shape {(count, height, width)}, with or without an axis of 1 after "
            f"the first, got {tuple(depth_m.shape)}; crop and resize it together with the images"
        )
    if not depth_m.dtype.is_floating_point:
        raise ArgumentError(f"depth_m must be floating point, in metres, got {depth_m.dtype}")


def _check_labels(labels: Tensor, images: Tensor) -> None:
    count, _, height, width = images.shape
    if tuple(labels.shape) != (count, height, width):
        raise ArgumentError(
            f"labels must have shape {(count, height, width)}, got {tuple(labels.shape)}"
        )
    if labels.dtype not in (torch.uint8, torch.int16, torch.int32, torch.int64):
        raise ArgumentError(f"labels must be uint8 or a wider integer, got {labels.dtype}")


def one_each(
    name: str, values: Any, kind: type, count: int, *, optional: bool = False
) -> list[Any]:
    """`values` as a list of `count` items of `kind`; where optional, None stands for all or one.

    Raises:
        ArgumentError: If it is no such sequence.
    """
    if values is None and optional:
        return [None] * count
    try:
        items = list(values)
    except TypeError:
        raise ArgumentError(f"{name} must be a sequence, one item a picture") from None
    if len(items) != count:
        raise ArgumentError(
            f"{name} must have one item for each of {count} pictures, got {len(items)}"
        )
    for item in items:
        if not isinstance(item, kind) and not (optional and item is None):
            raise ArgumentError(
                f"{name} must hold {kind.__name__} objects, got {type(item).__name__}"
            )
    return items


def check_cameras(cameras: Sequence[Camera], images: Tensor) -> None:
    """Refuse cameras of another size than the images'.

    Raises:
        ArgumentError: If one is.
    """
    height, width = images.shape[2:]
    for camera in cameras:
        if (camera.height, camera.width) != (height, width):
            raise ArgumentError(
                f"cameras must be of the images' size {height}x{width}, got "
                f"{camera.height}x{camera.width}; use Camera.resized"
            )


def check_layers(layers: list[Layers | None], images: Tensor) -> list[Layers | None]:
    """The layers, refused if one is of a picture of another size.

    Raises:
        ArgumentError: If one is.
    """
    size = tuple(images.shape[2:])
    for known in layers:
        if known is not None and known.classes.shape != size:
            raise ArgumentError(
                f"layers must be of pictures of the images' size {size}, got "
                f"{known.classes.shape}; look at the cropped and resized pictures, or pass None"
            )
    return layers


def check_options(options: Any) -> None:
    """Refuse what would be left out, because a silent difference from `render` is worse.

    Raises:
        ArgumentError: If the options are none, or ask for what only `render` draws.
    """
    if not isinstance(options, RenderOptions):
        raise ArgumentError(f"options must be RenderOptions, got {type(options).__name__}")
    for name in NOT_DRAWN:
        if getattr(options, name) != getattr(DEFAULT_OPTIONS, name):
            raise ArgumentError(
                f"options.{name} = {getattr(options, name)!r} is not drawn in a batch; use render"
            )
    asked = [effect for effect in UNDRAWN if options.has(effect)]
    if asked:
        raise ArgumentError(
            f"options.without must name what a batch does not draw; add {', '.join(asked)}, start "
            "from weather_aug.render.batch.BATCH_OPTIONS, or use render"
        )
