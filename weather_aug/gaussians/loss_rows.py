"""Sums of losses and their slopes, in one pass each. Compiled.

Sums are kept by lane, so that they vectorise without changing their order.
"""

from __future__ import annotations

import numpy as np

from weather_aug._compiled import compiled

_LANES = 1024
_ROUNDS = 64
"""How many probabilities, none below 1e-4, one product in float64 may take."""


@compiled
def cross_entropy(opacity, is_sky, is_known, least, slopes):
    """Sum of -log p of what is known, and its slopes in the opacity (n,).

    p is the opacity, of sky one less the opacity. Below `least` the logarithm goes on straight.
    The logarithm of a product is taken, because one of each number costs more than all the rest.
    """
    one = np.float32(1)
    products, straight = np.ones(_LANES), np.zeros(_LANES)
    total, rounds = 0.0, 0
    for first in range(0, opacity.shape[0], _LANES):
        last = min(first + _LANES, opacity.shape[0])
        opacities, sky, known = opacity[first:last], is_sky[first:last], is_known[first:last]
        out = slopes[first:last]
        for i in range(np.uint64(last - first)):
            p = one - opacities[i] if sky[i] else opacities[i]
            held = least if p < least else p
            products[i] *= np.float64(held) if known[i] else 1.0
            straight[i] += np.float64((held - p) / held) if known[i] else 0.0
            sign = one if sky[i] else -one
            out[i] = sign / held if known[i] else np.float32(0)
        rounds += 1
        if rounds == _ROUNDS:
            total -= np.log(products).sum()
            products[:] = 1.0
            rounds = 0
    return total - np.log(products).sum() + straight.sum()


@compiled
def relative_error(depth_m, weight, measured_m, least_m, most_m, cap, slopes):
    """Weighted sum of min(|z - m| / m, cap), how many m there are, and the slopes in z (n,)."""
    zero, one = np.float32(0), np.float32(1)
    totals, counts = np.zeros(_LANES), np.zeros(_LANES, np.int64)
    for first in range(0, depth_m.shape[0], _LANES):
        last = min(first + _LANES, depth_m.shape[0])
        depths, weights, measured = depth_m[first:last], weight[first:last], measured_m[first:last]
        out = slopes[first:last]
        for i in range(np.uint64(last - first)):
            is_measured = (measured[i] >= least_m) & (measured[i] <= most_m)
            inverse = one / (measured[i] if is_measured else one)
            off = (depths[i] - measured[i]) * inverse
            error = abs(off)
            share = weights[i] if is_measured else zero
            totals[i] += np.float64(share * (cap if error > cap else error)) if is_measured else 0.0
            counts[i] += np.int64(1) if is_measured else np.int64(0)
            slope = share * inverse if off > zero else -share * inverse
            out[i] = slope if (error < cap) & (error > zero) else zero
    return totals.sum(), counts.sum()


@compiled
def excess_length(log_scales, least, slopes):
    """Sum over Gaussians of how far largest less smallest exceeds `least`, and its slopes.

    Of equal scales the first counts as largest and as smallest.
    """
    zero, one = np.float32(0), np.float32(1)
    total = 0.0
    for i in range(np.uint64(log_scales.shape[0])):
        a, b, c = log_scales[i, 0], log_scales[i, 1], log_scales[i, 2]
        excess = max(max(a, b), c) - min(min(a, b), c) - least
        # Comparisons pass over NaN; a sum does not.
        excess += zero * (a + b + c)
        pull = one if excess > zero else zero
        total += np.float64(zero if excess <= zero else excess)
        up_a, down_a = (a >= b) & (a >= c), (a <= b) & (a <= c)
        up_b, down_b = (b > a) & (b >= c), (b < a) & (b <= c)
        up_c, down_c = (c > a) & (c > b), (c < a) & (c < b)
        slopes[i, 0] = (pull if up_a else zero) - (pull if down_a else zero)
        slopes[i, 1] = (pull if up_b else zero) - (pull if down_b else zero)
        slopes[i, 2] = (pull if up_c else zero) - (pull if down_c else zero)
    return total
