"""The recorded frames as a fit looks at them: smaller, as tensors, some held out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from weather_aug.clip.types import Frame
from weather_aug.errors import ArgumentError
from weather_aug.gaussians.ssim import SsimTarget
from weather_aug.taxonomy import SKY


class Target(NamedTuple):
    """What a frame asks of the scene."""

    frame: Frame
    picture: SsimTarget
    """sRGB in 0..1."""
    depth_m: Tensor
    """(H, W) float32; 0 where nothing was measured."""
    is_sky: Tensor
    """(H, W) bool."""
    is_known: Tensor
    """(H, W) bool: whether `is_sky` means anything."""


def resized(frame: Frame, scale: float) -> Frame:
    """The same frame with sides `scale` times as long, at most as large; normals are left out.

    Colours are means over areas. Labels and depth are those of the nearest pixel, since a mean of
    two surfaces' depths is no surface's.

    Raises:
        ArgumentError: If the scale is not in (0, 1], or leaves less than 8 pixels of a side.
    """
    if not 0 < scale <= 1:
        raise ArgumentError(f"scale must be in (0, 1], got {scale!r}")
    if scale == 1:
        return frame
    width, height = round(frame.camera.width * scale), round(frame.camera.height * scale)
    if min(width, height) < 8:
        raise ArgumentError(f"scale {scale:g} leaves {width}x{height} pixels of a frame")
    image = cv2.resize(frame.image, (width, height), interpolation=cv2.INTER_AREA)
    return replace(
        frame,
        camera=frame.camera.resized(width, height),
        image=np.asarray(image, np.uint8),
        label=_nearest(frame.label, height, width),
        depth_m=_nearest(frame.depth_m, height, width),
        normals_world=None,
    )


def _nearest(plane: NDArray[Any] | None, height: int, width: int) -> NDArray[Any] | None:
    if plane is None:
        return None
    rows = ((np.arange(height) + 0.5) * (plane.shape[0] / height)).astype(int)
    columns = ((np.arange(width) + 0.5) * (plane.shape[1] / width)).astype(int)
    return np.ascontiguousarray(plane[rows[:, None], columns])


def target_of(frame: Frame, device: torch.device | str = "cpu") -> Target:
    """A frame as tensors on a device."""
    shape = frame.image.shape[:2]
    image = torch.from_numpy(frame.image.astype(np.float32)) / 255.0
    if frame.depth_m is None:
        depth = np.zeros(shape, np.float32)
        is_known = np.zeros(shape, bool)
        is_sky = np.zeros(shape, bool)
    else:
        depth = np.array(frame.depth_m, np.float32)
        is_known = np.ones(shape, bool)
        is_sky = np.isinf(depth)
        depth[is_sky] = 0.0
    if frame.label is not None:
        is_sky = np.asarray(frame.label == SKY)
        is_known = np.asarray(frame.label != 255)
    return Target(
        frame,
        SsimTarget(image.to(device)),
        torch.from_numpy(depth).to(device),
        torch.from_numpy(is_sky).to(device),
        torch.from_numpy(is_known).to(device),
    )


def split(frames: Sequence[Frame], every: int) -> tuple[list[Frame], list[Frame]]:
    """Frames to learn from, and every n-th time step, held out with all of its cameras.

    Args:
        frames: Of one clip.
        every: Which time steps are held out: the middle one of each run of `every`; none if 0.

    Raises:
        ArgumentError: If `every` is 1 or negative, or nothing is left to learn from.
    """
    if every == 0:
        return list(frames), []
    if every < 2:
        raise ArgumentError(f"held_out must be 0, or at least 2 time steps, got {every}")
    times = sorted({frame.key.time_index for frame in frames})
    held = set(times[every // 2 :: every])
    learnt = [frame for frame in frames if frame.key.time_index not in held]
    if not learnt:
        raise ArgumentError("nothing is left to learn from; hold out fewer time steps")
    return learnt, [frame for frame in frames if frame.key.time_index in held]
