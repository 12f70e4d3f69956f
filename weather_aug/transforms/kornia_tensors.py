"""What callers give in tensors: checked, one picture at a time as numpy, and masks marked."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from weather_aug.errors import ArgumentError


def check_pictures(images: Tensor) -> None:
    """Refuse what is no batch of colour pictures.

    Raises:
        ArgumentError: If it is not (B, 3, H, W) with sides above 0.
    """
    shape = tuple(images.shape)
    if images.ndim != 4 or shape[1] != 3 or 0 in shape[2:]:
        raise ArgumentError(f"input must have shape (B, 3, H, W) or (3, H, W), got {shape}")


def unit_range(images: Tensor) -> Tensor:
    """Pictures cut to [0, 1], with the gradient of what was inside.

    Raises:
        ArgumentError: If they leave it by more than rounding.
    """
    # Blending of neighbours, in a rotation before, leaves the range by a rounding of its type.
    slack = torch.finfo(images.dtype).eps
    low, high = (float(bound) for bound in torch.aminmax(images.detach()))
    if not (low >= -slack and high <= 1 + slack):
        raise ArgumentError(
            f"input must be finite and in [0, 1], got [{low:g}, {high:g}]; divide 8-bit values by "
            "255, and put RandomWeather before normalisation"
        )
    inside = images.detach().clamp(0, 1)
    # The slope of torch.clamp at its bounds is not that of the inside.
    return torch.where(inside == images, images, inside)


def picture(image: Tensor) -> NDArray[np.float32]:
    """(H, W, 3) float32 of a (3, H, W) tensor of any type and device."""
    return np.ascontiguousarray(image.detach().permute(1, 2, 0).float().cpu().numpy())


def planes(
    name: str, given: Tensor | Sequence[Tensor], count: int, shape: tuple[int, int]
) -> list[Tensor]:
    """One (H, W) tensor for each picture, of a mask or depth in any layout of kornia's.

    Args:
        name: For messages.
        given: (B, 1, H, W), (B, H, W), or (H, W) for a batch of one; or B of (1, H, W) or (H, W).
        count: B.
        shape: (H, W).

    Raises:
        ArgumentError: If it has another shape.
    """
    if isinstance(given, Tensor) and given.ndim == 2:
        given = given[None]
    each = list(given)
    for tensor in each:
        if not isinstance(tensor, Tensor):
            raise ArgumentError(f"{name} must be a torch tensor, got {type(tensor).__name__}")
    if len(each) != count or any(
        tensor.shape[-2:] != shape or tensor.numel() != shape[0] * shape[1] for tensor in each
    ):
        raise ArgumentError(
            f"{name} must have shape {(count, 1, *shape)} or {(count, *shape)}, got "
            f"{tuple(given.shape) if isinstance(given, Tensor) else [tuple(t.shape) for t in each]}"
        )
    return [tensor.detach().reshape(shape) for tensor in each]


def whole_ids(mask: Tensor) -> NDArray[Any]:
    """(H, W) integer ids of a mask; containers make floats of them.

    Raises:
        ArgumentError: If they are no whole numbers.
    """
    if mask.is_floating_point():
        _check_whole(mask)
        mask = mask.to(torch.int64)
    return mask.cpu().numpy()


def metres(depth: Tensor) -> NDArray[Any]:
    """(H, W) float depth.

    Raises:
        ArgumentError: If it is no float tensor.
    """
    if not depth.is_floating_point():
        raise ArgumentError(f"depth must be floating point, in metres, got {depth.dtype}")
    # numpy has no bfloat16.
    return (depth.float() if depth.dtype == torch.bfloat16 else depth).cpu().numpy()


def marked(mask: Tensor, hidden: Tensor, ignore_index: int) -> Tensor:
    """A mask with `ignore_index` where it is hidden, of its shape and type.

    Args:
        mask: (B, C, H, W) ids, or (B, H, W) or (H, W) of as many pixels as `hidden`.
        hidden: (B, 1, H, W) bool.
        ignore_index: An id that the mask's type can hold.

    Raises:
        ArgumentError: If the mask is none of these, or holds no ids.
    """
    if mask.is_floating_point():
        _check_whole(mask)
        held = float(mask.new_tensor(ignore_index)) == ignore_index
    elif mask.dtype == torch.bool:
        held = False
    else:
        limits = torch.iinfo(mask.dtype)
        held = limits.min <= ignore_index <= limits.max
    if not held:
        raise ArgumentError(
            f"mask is {mask.dtype}, which cannot hold ignore_index {ignore_index}; choose another "
            "ignore_index or convert the mask"
        )
    if mask.ndim < 4 and mask.numel() == hidden.numel():
        hidden = hidden.reshape(mask.shape)
    if mask.shape[-2:] != hidden.shape[-2:] or mask.shape[0] != hidden.shape[0]:
        raise ArgumentError(
            f"mask must be of the pictures' size {tuple(hidden.shape)}, got {tuple(mask.shape)}"
        )
    return mask.masked_fill(hidden.to(mask.device), ignore_index)


def _check_whole(mask: Tensor) -> None:
    if not bool((mask.isfinite() & (mask == mask.round())).all()):
        raise ArgumentError(
            "mask must hold whole numbers, the ids of classes, and does not: resize masks with "
            "nearest neighbours; a depth may go along with AugmentationSequential of "
            "weather_aug.transforms.kornia, in a dictionary, as 'mask_depth'"
        )
