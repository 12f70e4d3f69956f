"""How good an edited clip is: steady over time and between views, and near what it should show."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import image_uint8, like_image
from weather_aug.clip.types import Frame, FrameKey
from weather_aug.colour import LUMINANCE
from weather_aug.errors import ArgumentError, printable
from weather_aug.scores.colour import Steadiness, steadiness
from weather_aug.scores.neighbours import Pair, between_views, over_time
from weather_aug.scores.warp import Correspondence, WarpError, correspondence
from weather_aug.taxonomy import IGNORE

Float64 = NDArray[np.float64]
UInt8 = NDArray[np.uint8]
Images = Mapping[FrameKey, UInt8]

MIN_SHARE = 0.01
"""Pictures that have less than 1 % of their pixels in common do not overlap."""
NO_CONTRAST = 1e-9
"""Of the clear pictures' contrast: rounding, in pictures of one colour; one pixel of a million that
is one level brighter has more."""


@dataclass(frozen=True, eq=False)
class Neighbours:
    """Which pictures of a clip are compared, and where each shows the other's surfaces.

    Of one clip it is found once and serves all editors: their errors then are of the same pixels.
    """

    time: Mapping[Pair, Correspondence]
    """Consecutive frames of a camera."""
    view: Mapping[Pair, Correspondence]
    """Cameras of one moment."""


@dataclass(frozen=True)
class WarpScore:
    """Warp errors of a clip's pairs; see `scores.warp` for what is compared."""

    absolute: float
    """Mean over the pairs of the mean absolute difference, sRGB in [0, 1]; NaN without pairs."""
    ratio: float
    """`absolute` over that of the clear pictures: 1 is as steady as the recording."""
    ratio_per_contrast: float
    """`ratio`, both errors over the contrast of their pictures: whatever takes contrast away, as
    fog or a blur does, takes error away and is no steadier for it."""
    pairs: int


@dataclass(frozen=True)
class TargetScore:
    """How near pictures are to what they should be, and how near the clear ones were."""

    l1: float
    """Mean absolute difference of edited pictures and targets, sRGB in [0, 1]."""
    l1_clear: float
    """Of clear pictures and targets."""
    statistics: float
    """Mean of `statistics_gap` of edited pictures and targets, sRGB in [0, 1]."""
    statistics_clear: float
    """Of clear pictures and targets."""


@dataclass(frozen=True)
class EditScores:
    """All that is measured of an edited clip; NaN where there was nothing to measure."""

    warp_time: WarpScore
    warp_view: WarpScore
    colour: Steadiness
    """Bhattacharyya distances of the edited pictures."""
    colour_clear: Steadiness
    """Of the clear ones, of the same pairs."""
    target: TargetScore | None


def neighbours_of(frames: Mapping[FrameKey, Frame]) -> Neighbours:
    """Find consecutive frames of each camera, cameras that overlap, and their common surfaces.

    Args:
        frames: Frames with depth, by key.

    Raises:
        ArgumentError: If a frame has no depth.
    """

    def found(pairs: Iterable[Pair]) -> dict[Pair, Correspondence]:
        all_of = {(a, b): correspondence(frames[a], frames[b]) for a, b in pairs}
        return {pair: same for pair, same in all_of.items() if same.share >= MIN_SHARE}

    return Neighbours(found(over_time(frames)), found(between_views(frames)))


def edit_scores(
    clear: Mapping[FrameKey, Frame],
    edited: Images,
    *,
    targets: Images | None = None,
    neighbours: Neighbours | None = None,
) -> EditScores:
    """Measure an edited clip against the clear one.

    Args:
        clear: The recorded frames, by key.
        edited: (H, W, 3) uint8 sRGB of each of them.
        targets: What each should look like, such as the physical editor's picture; or none.
        neighbours: Of `clear`; found if None, which needs depth.

    Raises:
        ArgumentError: If there are no frames, a picture is missing or of another size, or a frame
            has no depth.
    """
    if not clear:
        raise ArgumentError("clear has no frames; give at least one")
    _check_images("edited", edited, clear)
    if neighbours is None:
        neighbours = neighbours_of(clear)
    recorded = {key: frame.image for key, frame in clear.items()}
    return EditScores(
        _warp_score(neighbours.time, recorded, edited),
        _warp_score(neighbours.view, recorded, edited),
        steadiness({key: edited[key] for key in clear}, views=neighbours.view),
        steadiness(recorded, views=neighbours.view),
        None if targets is None else _target_score(clear, edited, targets),
    )


def statistics_gap(image: UInt8, target: UInt8, label: UInt8 | None = None) -> float:
    """How far the colours of each class are from a target's, wherever its pixels lie.

    Of each class, mean and standard deviation of red, green, blue and luma are compared; the gap is
    the mean of these eight absolute differences, and over the classes by their share of the pixels.
    Unlike an L1 it does not ask that texture stand where the target's does.

    Args:
        image: (H, W, 3) uint8 sRGB.
        target: Likewise.
        label: (H, W) train ids of both; 255 is left out. The whole picture is one class if None,
            or if nothing in it is labelled.

    Returns:
        In sRGB of [0, 1].

    Raises:
        ArgumentError: If an argument does not fit.
    """
    image, target = image_uint8("image", image), image_uint8("target", target)
    like_image("target", target[..., 0], (image.shape[0], image.shape[1]))
    classes = np.zeros(image.shape[:2], np.int64)
    if label is not None:
        like_image("label", label, (image.shape[0], image.shape[1]))
        if (label != IGNORE).any():
            classes = label.astype(np.int64)
    known = (classes != IGNORE).reshape(-1)
    index = np.unique(classes.reshape(-1)[known], return_inverse=True)[1]
    counts = np.bincount(index)
    off = np.abs(_statistics(image, known, index) - _statistics(target, known, index))
    return float((off.mean(axis=0) * counts).sum() / counts.sum())


def _statistics(image: UInt8, known: NDArray[np.bool_], index: NDArray[np.int64]) -> Float64:
    """(8, N): means of red, green, blue and luma of each class, then standard deviations."""
    rgb = image.reshape(-1, 3)[known] / 255.0
    counts = np.bincount(index)
    means, deviations = [], []
    for channel in (*rgb.T, rgb @ LUMINANCE):
        mean = np.bincount(index, channel) / counts
        deviations.append(np.sqrt(np.bincount(index, np.square(channel - mean[index])) / counts))
        means.append(mean)
    return np.stack(means + deviations)


def _warp_score(pairs: Mapping[Pair, Correspondence], clear: Images, edited: Images) -> WarpScore:
    if not pairs:
        return WarpScore(math.nan, math.nan, math.nan, 0)

    def errors(images: Images) -> list[WarpError]:
        return [same.error(images[a], images[b]) for (a, b), same in pairs.items()]

    before, after = errors(clear), errors(edited)
    error, contrast = _ratio(_absolute, before, after), _ratio(_contrast, before, after)
    return WarpScore(
        absolute=math.fsum(map(_absolute, after)) / len(after),
        ratio=error,
        ratio_per_contrast=error / contrast if contrast > NO_CONTRAST else math.nan,
        pairs=len(after),
    )


def _absolute(error: WarpError) -> float:
    return error.absolute


def _contrast(error: WarpError) -> float:
    return error.contrast


def _ratio(
    of: Callable[[WarpError], float], before: list[WarpError], after: list[WarpError]
) -> float:
    base = math.fsum(map(of, before))
    return math.fsum(map(of, after)) / base if base > 0 else math.nan


def _target_score(clear: Mapping[FrameKey, Frame], edited: Images, targets: Images) -> TargetScore:
    _check_images("targets", targets, clear)
    rows = [
        (
            _l1(edited[key], targets[key]),
            _l1(frame.image, targets[key]),
            statistics_gap(edited[key], targets[key], frame.label),
            statistics_gap(frame.image, targets[key], frame.label),
        )
        for key, frame in clear.items()
    ]
    return TargetScore(*(math.fsum(column) / len(rows) for column in zip(*rows, strict=True)))


def _l1(image: UInt8, target: UInt8) -> float:
    return float(np.abs(image.astype(np.int16) - target).mean() / 255.0)


def _check_images(name: str, images: Images, clear: Mapping[FrameKey, Frame]) -> None:
    for key, frame in clear.items():
        if key not in images:
            raise ArgumentError(f"{name} has no picture of frame {printable(key)}")
        image = image_uint8(f"{name}[{printable(key)}]", images[key])
        height, width = frame.image.shape[:2]
        like_image(f"{name}[{printable(key)}]", image[..., 0], (height, width))
