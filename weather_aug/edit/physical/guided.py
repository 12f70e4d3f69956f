"""The guided filter on a small grid, to be evaluated with the picture's own detail."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug.errors import ArgumentError

Float32 = NDArray[np.float32]

LEAST_WEIGHT = 1e-3
"""A window that weighs less, in cells, says nothing."""


def guided_coefficients(
    guide: Float32, target: Float32, weight: Float32, radius_cells: int, epsilon: float
) -> tuple[Float32, Float32]:
    """Local lines that best foretell `target` from `guide`: target = slope * guide + offset.

    Each window of (2 r + 1)² cells, cut at the border, has one line, fitted by weighted least
    squares; a cell takes the mean of the lines of all windows that hold it, each as heavy as its
    cells. Cells without weight still have a line where a window reaches them.

    Args:
        guide: (h, w) float32, finite, about [0, 1].
        target: (h, w) float32, finite where weighed or not.
        weight: (h, w) float32, at least 0; 0 where the target means nothing.
        radius_cells: Of the windows, at least 1.
        epsilon: Variance of the guide that counts as none, above 0: windows whose guide varies
            less have nearly level lines.

    Returns:
        Slope and offset, (h, w) float32; both 0 where no window weighs anything. Evaluate with the
        guide of any size; bilinear interpolation of both between cells is what the source does.

    Raises:
        ArgumentError: If the planes differ in shape, or the radius or epsilon is out of range.

    Source:
        He and Sun, "Fast Guided Filter", arXiv:1505.00996; weights after He, Sun and Tang, "Guided
        Image Filtering", section 3.
    """
    if not guide.shape == target.shape == weight.shape or guide.ndim != 2:
        raise ArgumentError(
            "guide, target and weight must be planes of one shape (h, w), got "
            f"{guide.shape}, {target.shape}, {weight.shape}"
        )
    if radius_cells < 1 or not epsilon > 0:
        raise ArgumentError(
            f"radius_cells must be at least 1 and epsilon above 0, got {radius_cells}, {epsilon}"
        )
    weighed_guide = weight * guide
    total = box_sum(weight, radius_cells)
    share: Float32 = np.divide(1.0, total, out=np.zeros_like(total), where=total > LEAST_WEIGHT)
    mean_guide = box_sum(weighed_guide, radius_cells) * share
    mean_target = box_sum(weight * target, radius_cells) * share
    variance = box_sum(weighed_guide * guide, radius_cells) * share - mean_guide * mean_guide
    covariance = box_sum(weighed_guide * target, radius_cells) * share - mean_guide * mean_target
    slope: Float32 = covariance / (np.maximum(variance, np.float32(0)) + np.float32(epsilon))
    offset: Float32 = mean_target - slope * mean_guide
    heavy = box_sum(total, radius_cells)
    share = np.divide(1.0, heavy, out=np.zeros_like(heavy), where=heavy > LEAST_WEIGHT)
    return box_sum(slope * total, radius_cells) * share, box_sum(
        offset * total, radius_cells
    ) * share


def box_sum(plane: Float32, radius_cells: int) -> Float32:
    """(h, w) sums over the square of (2 r + 1)² cells around each, nothing beyond the border."""
    side = 2 * radius_cells + 1
    summed: Float32 = cv2.boxFilter(
        plane, -1, (side, side), normalize=False, borderType=cv2.BORDER_CONSTANT
    )
    return summed


def box_mean(plane: Float32, weight: Float32, radius_cells: int, *, empty: float) -> Float32:
    """(h, w) weighted means over the same squares; `empty` where nothing weighs."""
    total = box_sum(weight, radius_cells)
    mean = np.full_like(total, empty)
    return np.divide(box_sum(plane * weight, radius_cells), total, mean, where=total > LEAST_WEIGHT)
