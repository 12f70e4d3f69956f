"""Bhattacharyya distance of colour histograms: how alike the colours of two pictures are.

WeatherEdit (Qian et al.) reports it as consistency, over neighbours in time and between views, but
publishes neither the histogram nor which of two distances it is. Here the distance is OpenCV's, as
nearly all code that says "Bhattacharyya" means it: sqrt(1 - BC), which is Hellinger's distance; the
statistician's -ln(BC) is given beside it. A value depends on the number of bins, so it is compared
with values of the same bins only.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import finite, image_uint8, like_image
from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError, printable
from weather_aug.scores.neighbours import Pair, between_views, over_time

Float64 = NDArray[np.float64]
Mask = NDArray[np.bool_]
Kind = Literal["joint", "channels"]

BINS = 8
"""By channel: 8 x 8 x 8 bins are the usual choice for a joint histogram; with many more, bins
hold a pixel or two, and all pictures are far apart."""
MOST_BINS = 256
_TOLERANCE = 1e-9
"""By which a histogram's sum may be off 1."""


@dataclass(frozen=True)
class Steadiness:
    """Mean distances of a clip's pictures, each in [0, 1]; lower is steadier, 0 has equal colours.

    Neighbours of a drive do not show the same street, so the clear pictures are not at 0 either.
    A weather that takes the colours away takes distance away with them.
    """

    time: float
    """Mean of `bhattacharyya` over neighbours in time of one camera; NaN where there are none."""
    view: float
    """Mean over pairs of cameras at one time; NaN where there are none."""
    time_pairs: int
    """Pairs that `time` is the mean of."""
    view_pairs: int
    """Pairs that `view` is the mean of."""


def colour_histogram(
    image: NDArray[np.uint8],
    bins: int = BINS,
    *,
    kind: Kind = "joint",
    mask: Mask | None = None,
) -> Float64:
    """Shares of a picture's pixels by colour.

    In RGB: hue, which other code takes, means nothing on a grey road.

    Args:
        image: (H, W, 3) uint8 sRGB.
        bins: Equal parts of 0..255 in each channel, 1..256.
        kind: "joint" counts colours, in bins^3 bins; "channels" counts red, green and blue apart,
            a third of the sum each, so that the coefficient of two is the mean of three.
        mask: (H, W) bool; only these pixels count. All if None.

    Returns:
        (bins^3,) with blue fastest, or (3 * bins,); sums to 1.

    Raises:
        ArgumentError: If an argument does not fit, or the mask holds no pixel.
    """
    if kind not in get_args(Kind):
        raise ArgumentError(f"kind must be 'joint' or 'channels', got {printable(kind)!r}")
    if int(finite("bins", bins, 1, MOST_BINS)) != bins:
        raise ArgumentError(f"bins must be a whole number, got {bins!r}")
    bins = int(bins)
    pixels = image_uint8("image", image).reshape(-1, 3)
    if mask is not None:
        pixels = pixels[_checked_mask(mask, image.shape[:2]).reshape(-1)]
    # floor(value * bins / 256) is the bin of OpenCV's calcHist over [0, 256).
    red, green, blue = (pixels.astype(np.int64) * bins >> 8).T
    if kind == "joint":
        counts = np.bincount((red * bins + green) * bins + blue, minlength=bins**3)
    else:
        counts = np.concatenate([np.bincount(c, minlength=bins) for c in (red, green, blue)])
    return counts / counts.sum()


def coefficient(histogram_a: Float64, histogram_b: Float64) -> float:
    """Bhattacharyya coefficient of two histograms, sum sqrt(a b): 1 if equal, 0 if apart.

    Args:
        histogram_a: (N,) shares, not negative, with the sum 1.
        histogram_b: Likewise.

    Raises:
        ArgumentError: If they are no such histograms, or of different size.

    Source:
        Bhattacharyya, "On a measure of divergence between two statistical populations defined by
        their probability distributions" (1943).
    """
    a, b = _shares("histogram_a", histogram_a), _shares("histogram_b", histogram_b)
    if a.shape != b.shape:
        raise ArgumentError(
            f"histogram_b must have the {len(a)} bins of histogram_a, got {len(b)}; make both with "
            "equal bins= and kind="
        )
    # Rounding must not make equal histograms more than equal.
    return min(1.0, math.fsum(np.sqrt(a * b)))


def bhattacharyya(histogram_a: Float64, histogram_b: Float64) -> float:
    """Distance sqrt(1 - BC) of two histograms in [0, 1], as `cv2.compareHist` computes it.

    It is Hellinger's distance, a metric. Computed as sqrt(sum (sqrt(a) - sqrt(b))^2 / 2), which is
    the same and keeps its digits near 0.

    Args:
        histogram_a: (N,) shares, not negative, with the sum 1.
        histogram_b: Likewise.

    Raises:
        ArgumentError: If they are no such histograms, or of different size.
    """
    coefficient(histogram_a, histogram_b)
    off = np.sqrt(histogram_a) - np.sqrt(histogram_b)
    return min(1.0, math.sqrt(math.fsum(off * off) / 2))


def bhattacharyya_log(histogram_a: Float64, histogram_b: Float64) -> float:
    """The distance by Bhattacharyya's own definition, -ln(BC), in [0, inf].

    Args:
        histogram_a: (N,) shares, not negative, with the sum 1.
        histogram_b: Likewise.

    Raises:
        ArgumentError: If they are no such histograms, or of different size.
    """
    overlap = coefficient(histogram_a, histogram_b)
    return -math.log(overlap) + 0.0 if overlap > 0 else math.inf


def steadiness(
    images: Mapping[FrameKey, NDArray[np.uint8]],
    *,
    views: Collection[Pair] | None = None,
    bins: int = BINS,
    kind: Kind = "joint",
) -> Steadiness:
    """How steady a clip's colours are, over time and between its cameras.

    Args:
        images: (H, W, 3) uint8 sRGB of each frame; sizes may differ.
        views: Pairs of one time that are compared, such as those that see a common surface; all
            pairs of cameras if None.
        bins: See `colour_histogram`.
        kind: See `colour_histogram`.

    Raises:
        ArgumentError: If there are no pictures, or a pair is of pictures that are not given.
    """
    if not images:
        raise ArgumentError("images is empty; give at least one picture")
    keys = tuple(FrameKey(*key) for key in images)
    pairs = between_views(keys) if views is None else tuple(views)
    unknown = sorted({key for pair in pairs for key in pair} - set(keys))
    if unknown:
        raise ArgumentError(f"views: there is no picture of frame {printable(unknown[0])}")
    histograms = {key: colour_histogram(images[key], bins, kind=kind) for key in keys}

    def distances(of: Collection[Pair]) -> list[float]:
        return [bhattacharyya(histograms[a], histograms[b]) for a, b in of]

    time, view = distances(over_time(keys)), distances(pairs)
    return Steadiness(_mean(time), _mean(view), len(time), len(view))


def _mean(values: list[float]) -> float:
    return math.fsum(values) / len(values) if values else math.nan


def _checked_mask(mask: Any, shape: tuple[int, ...]) -> Mask:
    if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
        raise ArgumentError("mask must be a bool array, True where pixels count")
    like_image("mask", mask, (shape[0], shape[1]))
    if not mask.any():
        raise ArgumentError("mask holds no pixel, so there are no colours to count")
    return mask


def _shares(name: str, histogram: Any) -> Float64:
    if not isinstance(histogram, np.ndarray) or histogram.ndim != 1:
        raise ArgumentError(f"{name} must be a one-dimensional array; colour_histogram gives one")
    shares = np.asarray(histogram, np.float64)
    if not ((shares >= 0).all() and abs(shares.sum() - 1) < _TOLERANCE):
        raise ArgumentError(f"{name} must be shares, not negative and with the sum 1")
    return shares
