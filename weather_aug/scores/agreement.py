"""Agreement of two labels: what a network says of an edited picture, against the clear one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import like_image
from weather_aug.errors import ArgumentError
from weather_aug.taxonomy import CLASSES, IGNORE

Int64 = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Agreement:
    """How two labels agree; agreements of several pictures add up.

    Raises:
        ArgumentError: If the confusion is not (19, 19) counts.
    """

    confusion: Int64
    """(19, 19) counts of pixels: row as in label a, column as in label b; read-only."""

    def __post_init__(self) -> None:
        confusion = np.array(self.confusion)
        size = len(CLASSES)
        if confusion.shape != (size, size) or confusion.dtype.kind not in "iu":
            raise ArgumentError(
                f"confusion must be whole numbers of shape {(size, size)}, got {confusion.dtype} "
                f"{confusion.shape}"
            )
        if (confusion < 0).any():
            raise ArgumentError("confusion must count pixels, but holds a negative number")
        confusion = confusion.astype(np.int64)
        confusion.flags.writeable = False
        object.__setattr__(self, "confusion", confusion)

    def __add__(self, other: Agreement) -> Agreement:
        if not isinstance(other, Agreement):
            return NotImplemented
        return Agreement(self.confusion + other.confusion)

    @property
    def count(self) -> int:
        """Pixels compared."""
        return int(self.confusion.sum())

    @property
    def pixel_agreement(self) -> float:
        """Share of pixels with the same class in both, in [0, 1]; NaN if none was compared."""
        return float(np.trace(self.confusion) / self.count) if self.count else float("nan")

    @property
    def flipped(self) -> float:
        """Share of pixels whose class differs, 1 - `pixel_agreement`."""
        return 1 - self.pixel_agreement

    @property
    def iou(self) -> NDArray[np.float64]:
        """(19,) intersection over union of each class; NaN where neither label has it."""
        both = np.diag(self.confusion)
        either = self.confusion.sum(axis=0) + self.confusion.sum(axis=1) - both
        unknown = np.full(len(CLASSES), np.nan)
        return np.divide(both, either, out=unknown, where=either > 0)

    @property
    def miou(self) -> float:
        """Mean of `iou` over the classes that either label has; NaN if none was compared."""
        iou = self.iou
        known = ~np.isnan(iou)
        return float(iou[known].mean()) if known.any() else float("nan")


def agreement(
    label_a: NDArray[np.uint8],
    label_b: NDArray[np.uint8],
    *,
    mask: NDArray[np.bool_] | None = None,
) -> Agreement:
    """Compare two labels of one picture, pixel by pixel.

    Pixels that either label ignores (255) are not compared. If one label is to be held as the
    truth, it is a; IoU and agreement do not depend on that.

    Args:
        label_a: (H, W) uint8 train ids, such as a network's on the clear picture.
        label_b: (H, W) uint8 train ids, such as the same network's on the edited picture.
        mask: (H, W) bool; only these pixels are compared. All if None.

    Raises:
        ArgumentError: If shapes or types differ, or a label holds what is no train id.
    """
    a, b = _checked("label_a", label_a), _checked("label_b", label_b)
    like_image("label_b", b, (a.shape[0], a.shape[1]))
    compared = (a != IGNORE) & (b != IGNORE)
    if mask is not None:
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
            raise ArgumentError("mask must be a bool array, True where to compare")
        like_image("mask", mask, (a.shape[0], a.shape[1]))
        compared &= mask
    size = len(CLASSES)
    pairs = a[compared].astype(np.int64) * size + b[compared]
    return Agreement(np.bincount(pairs, minlength=size**2).reshape(size, size))


def _checked(name: str, label: Any) -> NDArray[np.uint8]:
    if not isinstance(label, np.ndarray) or label.dtype != np.uint8 or label.ndim != 2:
        got = f"{label.dtype} {label.shape}" if isinstance(label, np.ndarray) else type(label)
        raise ArgumentError(f"{name} must be a uint8 array of shape (H, W), got {got}")
    unknown = label[(label >= len(CLASSES)) & (label != IGNORE)]
    if unknown.size:
        raise ArgumentError(
            f"{name} holds {int(unknown[0])}, which is no train id; map it with "
            "weather_aug.taxonomy first"
        )
    return label
