"""Compiled loops of `edges`: two sides for each pixel near a jump, and the choice between them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled, inlined
from weather_aug.taxonomy import IGNORE

Float32 = NDArray[np.float32]
Bools = NDArray[np.bool_]

COLOUR_VARIANCE = np.float32(3 * 4.0**2)
OTHER_LABEL = np.float32(1e-3)
STAY = np.float32(1.5)
MIN_ALIKE = 2
MAX_LEAN = np.float32(2.0)
MAX_MISMATCH = np.float32(40.0)
MISMATCH_PER_NAT = np.float32(27.0)
AGREE_PX = 3
BINS = 24


@inlined
def _likeness(colours: Float32, row: int, column: int, other: int, beside: int) -> np.float32:
    """How alike two pixels' colours are, 0..1."""
    square = np.float32(0.0)
    for channel in range(3):
        off = colours[row, column, channel] - colours[other, beside, channel]
        square += off * off
    # The tail is long, so that a colour that neither side has goes to the more similar one.
    share = np.float32(1.0) / (np.float32(1.0) + square / COLOUR_VARIANCE)
    return share * share


@inlined
def _parted_by_label(
    classes: NDArray[np.uint8], row: int, column: int, other: int, beside: int
) -> bool:
    """Whether two pixels are known to be of two classes."""
    one, two = classes[row, column], classes[other, beside]
    return bool(one != two and one != IGNORE and two != IGNORE)


@compiled
def sides(
    inverse: Float32,
    colours: Float32,
    classes: NDArray[np.uint8],
    belief: Float32,
    trust: Float32,
    band: Bools,
    min_jump: np.float32,
    offsets: NDArray[np.int64],
    closeness: Float32,
) -> tuple[Float32, Float32, Float32]:
    """Inverse depth of the near and the far side of each pixel in the band, and its lean.

    The lean is the logarithm of how much more the pixel looks like the near side; pixels with one
    side only have near = far = -1.
    """
    height, width = inverse.shape
    near = np.full((height, width), np.float32(-1.0))
    far = np.full((height, width), np.float32(-1.0))
    lean = np.zeros((height, width), np.float32)
    count = len(offsets)
    values = np.zeros(count, np.float32)
    masses = np.zeros(count, np.float32)
    votes = np.zeros(count, np.float32)
    nearby = np.zeros(count, np.float32)
    for place in range(count):
        square = offsets[place, 0] * offsets[place, 0] + offsets[place, 1] * offsets[place, 1]
        nearby[place] = np.float32(1.0) / np.float32(1 + square)
    for row in range(height):
        for column in range(width):
            if not band[row, column]:
                continue
            low, high = inverse[row, column], inverse[row, column]
            for place in range(count):
                other = min(max(row + offsets[place, 0], 0), height - 1)
                beside = min(max(column + offsets[place, 1], 0), width - 1)
                values[place] = inverse[other, beside]
                masses[place] = trust[other, beside]
                low = min(low, values[place])
                high = max(high, values[place])
            if high == low or (high - low <= min_jump and low > 0):
                continue
            threshold = _between(values, masses, low, high)
            for place in range(count):
                other = min(max(row + offsets[place, 0], 0), height - 1)
                beside = min(max(column + offsets[place, 1], 0), width - 1)
                masses[place] *= closeness[place]
                votes[place] = masses[place] * _likeness(colours, row, column, other, beside)
                if _parted_by_label(classes, row, column, other, beside):
                    votes[place] *= OTHER_LABEL
            mass_near, mass_far = np.float32(1e-6), np.float32(1e-6)
            like_near, like_far = np.float32(0.0), np.float32(0.0)
            best_near, best_far = np.float32(-1.0), np.float32(-1.0)
            for place in range(count):
                # The nearest alike pixel gives the depth; a mean would bend the ground.
                choice = votes[place] * nearby[place]
                if values[place] > threshold:
                    mass_near += masses[place]
                    like_near += votes[place]
                    if choice > best_near:
                        best_near = choice
                        near[row, column] = values[place]
                else:
                    mass_far += masses[place]
                    like_far += votes[place]
                    if choice > best_far:
                        best_far = choice
                        far[row, column] = values[place]
            if best_near < 0 or best_far < 0:
                near[row, column] = np.float32(-1.0)
                far[row, column] = np.float32(-1.0)
                continue
            tiny = np.float32(1e-3)
            stay = STAY if inverse[row, column] > threshold else -STAY
            odds = (like_near / mass_near + tiny) / (like_far / mass_far + tiny)
            lean[row, column] = min(max(np.log(odds), -MAX_LEAN), MAX_LEAN)
            lean[row, column] += stay * belief[row, column]
    return near, far, lean


@compiled
def _between(values: Float32, masses: Float32, low: np.float32, high: np.float32) -> np.float32:
    """The inverse depth that parts a window's two surfaces best (Otsu's threshold)."""
    weights = np.zeros(BINS, np.float32)
    scale = np.float32(BINS - 1) / (high - low)
    total = np.float32(0.0)
    moment = np.float32(0.0)
    for index in range(len(values)):
        place = min(max(int((values[index] - low) * scale + np.float32(0.5)), 0), BINS - 1)
        weights[place] += masses[index]
        total += masses[index]
        moment += masses[index] * np.float32(place)
    best = np.float32(-1.0)
    cut_first, cut_last = 0, 0
    below = np.float32(0.0)
    below_moment = np.float32(0.0)
    for place in range(BINS - 1):
        below += weights[place]
        below_moment += weights[place] * np.float32(place)
        above = total - below
        if below <= 0 or above <= np.float32(1e-5):
            continue
        if weights[place] == 0:
            # Nothing lies here; the threshold is the middle of the gap.
            if cut_last == place - 1:
                cut_last = place
            continue
        off = below_moment / below - (moment - below_moment) / above
        between = below * above * off * off
        if between > best:
            best, cut_first, cut_last = between, place, place
    return low + (np.float32(0.5) * np.float32(cut_first + cut_last + 1)) / scale


@compiled
def add_mismatch(
    lean: Float32,
    near: Float32,
    far: Float32,
    colours: Float32,
    right: Float32,
    focal_baseline: np.float32,
) -> None:
    """Lean to the side at whose disparity the right picture shows the pixel's colour."""
    height, width = near.shape
    for row in range(height):
        for column in range(width):
            if near[row, column] < 0:
                continue
            off_near = _mismatch(colours, right, row, column, near[row, column] * focal_baseline)
            off_far = _mismatch(colours, right, row, column, far[row, column] * focal_baseline)
            lean[row, column] += (off_far - off_near) / MISMATCH_PER_NAT


@inlined
def _mismatch(
    colours: Float32, right: Float32, row: int, column: int, disparity_px: np.float32
) -> np.float32:
    """Grey levels, summed over the channels, between a pixel and its place in the right picture.

    The smallest within half a pixel, so that sampling does not count (Birchfield and Tomasi 1998).
    """
    width = colours.shape[1]
    place = np.float32(column) - disparity_px
    if place < 0:
        return np.float32(0.5) * MAX_MISMATCH
    first = min(int(place), width - 2)
    share = place - np.float32(first)
    total = np.float32(0.0)
    for channel in range(3):
        one, other = right[row, first, channel], right[row, first + 1, channel]
        middle = one + share * (other - one)
        half = np.float32(0.5) * abs(other - one)
        total += max(abs(colours[row, column, channel] - middle) - half, np.float32(0.0))
    return min(total, MAX_MISMATCH)


@compiled
def chosen(
    inverse: Float32,
    colours: Float32,
    classes: NDArray[np.uint8],
    near: Float32,
    far: Float32,
    lean: Float32,
) -> Float32:
    """Every pixel at one of its sides; pixels of one colour next to each other decide together."""
    height, width = inverse.shape
    result = inverse.copy()
    for row in range(height):
        for column in range(width):
            if near[row, column] < 0:
                continue
            nearer, farther = near[row, column], far[row, column]
            total = np.float32(0.0)
            for other in range(max(0, row - AGREE_PX), min(height, row + AGREE_PX + 1)):
                for beside in range(max(0, column - AGREE_PX), min(width, column + AGREE_PX + 1)):
                    # Another pair of surfaces has nothing to say about these two.
                    apart = near[other, beside] <= farther or far[other, beside] >= nearer
                    if near[other, beside] >= 0 and not apart:
                        alike = _likeness(colours, row, column, other, beside)
                        if _parted_by_label(classes, row, column, other, beside):
                            continue
                        # Squared, or the many pixels around a post would outvote it.
                        total += alike * alike * lean[other, beside]
            here = inverse[row, column]
            margin = np.float32(0.25) * (nearer - farther)
            if total > 0:
                if here < nearer - margin:
                    result[row, column] = nearer
            elif here > farther + margin:
                result[row, column] = farther
    return result


@compiled
def unspecked(inverse: Float32, near: Float32, far: Float32) -> Float32:
    """Give a pixel that hardly any neighbour goes with to the other side; lines stay."""
    height, width = inverse.shape
    clean = inverse.copy()
    for row in range(1, height - 1):
        for column in range(1, width - 1):
            if near[row, column] < 0:
                continue
            middle = np.float32(0.5) * (near[row, column] + far[row, column])
            mine = inverse[row, column] > middle
            alike = -1
            for other in range(row - 1, row + 2):
                for beside in range(column - 1, column + 2):
                    alike += (inverse[other, beside] > middle) == mine
            if alike < MIN_ALIKE:
                clean[row, column] = far[row, column] if mine else near[row, column]
    return clean
