"""Rows of SSIM: blurs, similarity and gradient, in one pass over two pictures. Compiled.

A picture is read as rows of 3 W numbers, so that the blur across is a stencil of stride 3. It is
worked through in strips of columns: what the blur down still needs of a strip is eleven rows in a
ring, which the processor's cache holds. A ring holds every row twice, eleven slots apart, so that
any eleven rows that follow each other lie at fixed distances.

Inside, all values are taken from the middle of their range, those beyond the picture as well. That
moves the blurs and leaves variances and products of slopes what they are, but blurred squares less
squared blurs lose a quarter of what they would in a bright and even part of a picture.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from weather_aug._compiled import compiled, inlined

WINDOW_PX = 11
SIGMA_PX = 1.5
C1 = 0.01**2
C2 = 0.03**2


def weights() -> NDArray[np.float64]:
    """(11,) of the window along one axis, sum 1."""
    weights = np.exp(-((np.arange(WINDOW_PX) - WINDOW_PX // 2) ** 2) / (2 * SIGMA_PX**2))
    return weights / weights.sum()


_W0, _W1, _W2, _W3, _W4, _W5 = (np.float32(w) for w in weights()[: WINDOW_PX // 2 + 1])
_C1, _C2 = np.float32(C1), np.float32(C2)
_MIDDLE = np.float32(0.5)
_HALO = 3 * (WINDOW_PX // 2)
_STRIP = 480
"""Numbers of a row that are worked through at a time."""
_LINE = _STRIP + 4 * _HALO + 16
"""Room for a strip and twice the reach of the blur on both sides."""
_SLOT = 3 * _LINE


@compiled
def hold(counted, held, rows):
    """Overwrite what does not count by `held`, or by its one value."""
    one_value = held.shape[1] == 1
    for y in range(counted.shape[0]):
        for x in range(counted.shape[1]):
            if not counted[y, x]:
                for i in range(3 * x, 3 * x + 3):
                    rows[y, i] = held[0, 0] if one_value else held[y, i]


@inlined
def _blurred(values, i, step):
    """The window's mean around `values[i + 5 * step]`."""
    near = _W5 * values[i + 5 * step] + _W4 * (values[i + 4 * step] + values[i + 6 * step])
    middle = _W3 * (values[i + 3 * step] + values[i + 7 * step]) + _W2 * (
        values[i + 2 * step] + values[i + 8 * step]
    )
    far = _W1 * (values[i + step] + values[i + 9 * step]) + _W0 * (
        values[i] + values[i + 10 * step]
    )
    return near + middle + far


@compiled
def _across(lines, count, ring, slot):
    """Blur three lines across into slot `slot` of a ring and its double."""
    for k in range(3):
        line = lines[k * _LINE : (k + 1) * _LINE]
        once = ring[slot * _SLOT + k * _LINE : slot * _SLOT + (k + 1) * _LINE]
        for i in range(np.uint64(count)):
            once[i] = _blurred(line, i, np.uint64(3))
        first = (slot + WINDOW_PX) * _SLOT + k * _LINE
        ring[first : first + count] = once[:count]


@compiled
def _down(ring, slot, count, lines):
    """Blur the eleven rows that end in slot `slot` down into three lines."""
    for k in range(3):
        first = (slot + 1) * _SLOT + k * _LINE
        rows = ring[first : first + (WINDOW_PX - 1) * _SLOT + _LINE]
        line = lines[k * _LINE : (k + 1) * _LINE]
        for i in range(np.uint64(count)):
            line[i] = _blurred(rows, i, np.uint64(_SLOT))


@compiled
def _clear(slots):
    """Fill slots of three lines by what lies outside the picture: 0, from the middle."""
    for first in range(0, slots.shape[0], _SLOT):
        slots[first : first + _LINE] = -_MIDDLE
        slots[first + _LINE : first + _SLOT] = _MIDDLE * _MIDDLE


@compiled
def _load(image, target, y, first, lines):
    """Row `y` from column `first`: the image, its square, and its product with the target."""
    _clear(lines)
    height, width = image.shape
    if y >= height:
        return
    begin, end = max(first, 0), min(first + _LINE, width)
    x_row, y_row = image[y, begin:end], target[y, begin:end]
    to = begin - first
    plain = lines[to:_LINE]
    squares, products = lines[_LINE + to : 2 * _LINE], lines[2 * _LINE + to : 3 * _LINE]
    for i in range(np.uint64(end - begin)):
        x = x_row[i] - _MIDDLE
        plain[i] = x
        squares[i] = x * x
        products[i] = x * (y_row[i] - _MIDDLE)


@compiled
def _similarity(blurred, mean, variance, values, slopes):
    """SSIM of a line of pixels, and its slopes in the blurs of the image, its square, the product.

    The slope in the square is doubled, as the gradient needs it.
    """
    one, two = np.float32(1), np.float32(2)
    means, squares = blurred[:_LINE], blurred[_LINE : 2 * _LINE]
    products = blurred[2 * _LINE : 3 * _LINE]
    of_mean, of_square = slopes[:_LINE], slopes[_LINE : 2 * _LINE]
    of_product = slopes[2 * _LINE : 3 * _LINE]
    for i in range(np.uint64(mean.shape[0])):
        a, b = means[i], mean[i] - _MIDDLE
        m, n = a + _MIDDLE, mean[i]
        luminance = two * m * n + _C1
        structure = two * (products[i] - a * b) + _C2
        below_l = m * m + n * n + _C1
        below_s = (squares[i] - a * a) + variance[i] + _C2
        inverse = one / (below_l * below_s)
        value = luminance * structure * inverse
        by_product = two * luminance * inverse
        by_square = -two * value * below_l * inverse
        by_mean = two * (n * structure - m * value * below_s) * inverse
        values[i] = value
        of_mean[i] = by_mean - a * by_square - b * by_product
        of_square[i] = by_square
        of_product[i] = by_product


@compiled
def _add(values, totals):
    """Add a line to sums of columns."""
    for i in range(np.uint64(values.shape[0])):
        totals[i] += np.float64(values[i])


@compiled
def _add_distance(x_row, y_row, totals):
    """Add the absolute differences of a row to sums of columns."""
    for i in range(np.uint64(x_row.shape[0])):
        totals[i] += np.float64(abs(x_row[i] - y_row[i]))


@compiled
def _slope_row(blurred, x_row, y_row, ssim_scale, l1_scale, out):
    """Gradient of a row from the blurred slopes, and from the sign of the difference."""
    zero = np.float32(0)
    of_mean, of_square = blurred[:_LINE], blurred[_LINE : 2 * _LINE]
    of_product = blurred[2 * _LINE : 3 * _LINE]
    for i in range(np.uint64(out.shape[0])):
        x, y = x_row[i], y_row[i]
        slope = of_mean[i] + (x - _MIDDLE) * of_square[i] + (y - _MIDDLE) * of_product[i]
        up = l1_scale if x > y else zero
        down = l1_scale if x < y else zero
        out[i] = ssim_scale * slope + (up - down)


@compiled
def describe(image, mean, variance):
    """Blur, and variance under the window, of rows (H, 3 W)."""
    height, width = image.shape
    half = WINDOW_PX // 2
    lines, blurred = np.empty(_SLOT, np.float32), np.empty(_SLOT, np.float32)
    ring = np.empty(2 * WINDOW_PX * _SLOT, np.float32)
    for first in range(0, width, _STRIP):
        count = min(_STRIP, width - first)
        _clear(ring)
        for y in range(height + half):
            _load(image, image, y, first - _HALO, lines)
            _across(lines, count, ring, y % WINDOW_PX)
            if y < half:
                continue
            _down(ring, y % WINDOW_PX, count, blurred)
            for i in range(count):
                a = blurred[i]
                mean[y - half, first + i] = a + _MIDDLE
                variance[y - half, first + i] = blurred[_LINE + i] - a * a


@compiled
def compare(image, target, mean, variance, ssim_scale, l1_scale, gradient):
    """Sums of SSIM and of absolute differences over rows (H, 3 W).

    `gradient` becomes that of the two sums, each times its scale, unless it is empty.
    """
    height, width = image.shape
    wants_gradient = gradient.shape[1] > 0
    half = WINDOW_PX // 2
    lines, blurred = np.empty(_SLOT, np.float32), np.empty(_SLOT, np.float32)
    slopes, values = np.empty(_SLOT, np.float32), np.empty(_LINE, np.float32)
    ring = np.empty(2 * WINDOW_PX * _SLOT, np.float32)
    slope_ring = np.empty(2 * WINDOW_PX * _SLOT, np.float32)
    ssim_sum, distance_sum = 0.0, 0.0
    for first in range(0, width, _STRIP):
        last = min(first + _STRIP, width)
        # The gradient of a strip needs the slopes as far to both sides as the window reaches.
        begin, end = max(first - _HALO, 0), min(last + _HALO, width)
        _clear(ring)
        slope_ring[:] = np.float32(0)
        slopes[:] = np.float32(0)
        ssim_sums, distance_sums = np.zeros(last - first), np.zeros(last - first)
        for y in range(height + 2 * half):
            at = y - half
            if y < height + half:
                _load(image, target, y, begin - _HALO, lines)
                _across(lines, end - begin, ring, y % WINDOW_PX)
            if at < 0:
                continue
            if at < height:
                _down(ring, y % WINDOW_PX, end - begin, blurred)
                _similarity(
                    blurred,
                    mean[at, begin:end],
                    variance[at, begin:end],
                    values,
                    slopes[begin - (first - _HALO) :],
                )
                _add(values[first - begin : last - begin], ssim_sums)
                _add_distance(image[at, first:last], target[at, first:last], distance_sums)
            else:
                slopes[:] = np.float32(0)
            if not wants_gradient:
                continue
            _across(slopes, last - first, slope_ring, at % WINDOW_PX)
            if at < half:
                continue
            _down(slope_ring, at % WINDOW_PX, last - first, blurred)
            _slope_row(
                blurred,
                image[at - half, first:last],
                target[at - half, first:last],
                ssim_scale,
                l1_scale,
                gradient[at - half, first:last],
            )
        ssim_sum += ssim_sums.sum()
        distance_sum += distance_sums.sum()
    return ssim_sum, distance_sum
