"""Honest labels of one picture of a batch: those of `render`, from the light that torch drew.

Rules that look along columns, at blobs and along borders are no rows of vectors: they run on the
CPU, in the kernels of `render`. Three planes go there and two come back.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from weather_aug.clip.types import Camera, Frame, FrameKey
from weather_aug.render.label import (
    DOUBTFUL_TRANSMITTANCE,
    HAZY_TRANSMITTANCE,
    Sight,
    kept_labels,
    readable_labels,
)
from weather_aug.render.label_runs import small_things
from weather_aug.render.label_snow import buried_borders, covered_faces, snow_limits
from weather_aug.render.options import RenderOptions
from weather_aug.taxonomy import IGNORE, SKY
from weather_aug.weather import Weather


def frame_of(
    image: Tensor, depth_m: Tensor, label: Tensor | None, camera: Camera, time_s: float
) -> Frame:
    """A picture in tensors as a frame on the CPU, in whole levels.

    Args:
        image: (3, H, W) sRGB in [0, 1].
        depth_m: (H, W), `inf` for what is far.
        label: (H, W) train ids; what is outside [0, 255] becomes 255.
        camera: Of the picture.
        time_s: Seconds.
    """
    levels = (image.detach() * 255.0).round().to(torch.uint8).permute(1, 2, 0)
    train_ids = None
    if label is not None:
        known = (label >= 0) & (label <= IGNORE)
        train_ids = label.masked_fill(~known, IGNORE).to(torch.uint8).cpu().numpy()
    picture = np.ascontiguousarray(levels.cpu().numpy())
    depth = depth_m.float().cpu().numpy()
    return Frame(FrameKey(0, "batch"), time_s, camera, picture, train_ids, depth)


@torch.no_grad()
def honest(
    label: Tensor | None,
    frame: Frame,
    through: Tensor,
    distinct: Tensor,
    covered: Tensor,
    weather: Weather,
    options: RenderOptions,
) -> tuple[Tensor | None, Tensor]:
    """Label for training (H, W) and invalid mask (H, W) uint8, by the rules of `render.label`.

    Args:
        label: (H, W) train ids of the clear picture, or None.
        frame: The same picture.
        through: (H, W) share of the surface's light that reaches the pixel.
        distinct: (H, W) bool, where it still differs visibly from the airlight.
        covered: (H, W) bool, where a large particle hides the surface.
        weather: State of air and ground.
        options: `labels` says what becomes of a label whose surface cannot be seen.
    """
    sight = _sight(frame, through, distinct, covered)
    lost = None
    if frame.label is not None:
        sight = _under_snow(sight, frame, weather, options)
        lost = kept_labels(frame.label, sight.unseen, options.labels) != frame.label
    device = through.device
    invalid = torch.from_numpy(sight.invalid).to(device)
    if label is None or lost is None:
        return None, invalid
    return label.masked_fill(torch.from_numpy(lost).to(device), IGNORE), invalid


def _sight(frame: Frame, through: Tensor, distinct: Tensor, covered: Tensor) -> Sight:
    """What can be seen through the air and the particles."""
    assert frame.depth_m is not None
    kinds = frame.label
    if kinds is None:
        kinds = np.where(np.isinf(frame.depth_m), np.uint8(SKY), np.uint8(IGNORE))
    share = through.float().cpu().numpy()
    hidden = covered.to(torch.uint8).cpu().numpy()
    surface = kinds != SKY
    hazy = surface & (share < HAZY_TRANSMITTANCE)
    if not (hazy.any() or hidden.any() or share.min() < DOUBTFUL_TRANSMITTANCE):
        return Sight(*np.zeros((2, *kinds.shape), np.uint8))
    seen = distinct.to(torch.uint8).cpu().numpy() * surface.view(np.uint8)
    window = (0, 0, *kinds.shape)
    return readable_labels(kinds, share, share, seen, hidden, small_things(frame, window))


def _under_snow(sight: Sight, frame: Frame, weather: Weather, options: RenderOptions) -> Sight:
    """What cannot be told because of the snow that lies, besides what cannot be seen."""
    limits = snow_limits(weather, options)
    if limits is None:
        return sight
    window = (0, 0, frame.camera.height, frame.camera.width)
    unseen = sight.unseen | buried_borders(frame, window, limits)
    return Sight(unseen, sight.invalid | unseen | covered_faces(frame, window, limits))
