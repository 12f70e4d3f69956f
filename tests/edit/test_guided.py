import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from weather_aug.edit.physical import guided
from weather_aug.edit.physical.guided import box_mean, guided_coefficients
from weather_aug.errors import ArgumentError


def in_double(guide, target, weight, radius, epsilon):
    """The guided filter by its definition, window by window."""
    height, width = guide.shape
    lines = np.zeros((height, width, 2))
    totals = np.zeros((height, width))

    def window(i, j):
        return np.s_[max(i - radius, 0) : i + radius + 1, max(j - radius, 0) : j + radius + 1]

    for i, j in np.ndindex(height, width):
        w = weight[window(i, j)].astype(float)
        totals[i, j] = w.sum()
        if totals[i, j] > 0:
            x, y = guide[window(i, j)].astype(float), target[window(i, j)].astype(float)
            mean_x, mean_y = np.average(x, weights=w), np.average(y, weights=w)
            covariance = np.average((x - mean_x) * (y - mean_y), weights=w)
            slope = covariance / (np.average((x - mean_x) ** 2, weights=w) + epsilon)
            lines[i, j] = slope, mean_y - slope * mean_x
    mean = np.zeros_like(lines)
    for i, j in np.ndindex(height, width):
        w = totals[window(i, j)]
        if w.sum() > 0:
            mean[i, j] = (lines[window(i, j)] * w[..., None]).sum((0, 1)) / w.sum()
    return mean[..., 0], mean[..., 1]


def planes(seed, shape=(13, 17)):
    rng = np.random.default_rng(seed)
    guide, target = rng.random((2, *shape)).astype(np.float32)
    weight = (rng.random(shape) > 0.4).astype(np.float32)
    weight[:7, :7] = 0
    return guide, target, weight


@settings(max_examples=10)
@given(st.integers(0, 999), st.integers(1, 4), st.sampled_from([1e-3, 0.1]))
def test_equals_the_definition_in_double(seed, radius, epsilon):
    given_planes = planes(seed)
    expected = in_double(*given_planes, radius, epsilon)
    actual = guided_coefficients(*given_planes, radius, epsilon)
    for one, other in zip(expected, actual, strict=True):
        # Differences of float32 sums, over a variance of at least epsilon.
        np.testing.assert_allclose(one, other, atol=2e-3 * 1e-3 / epsilon + 1e-4)


def test_a_forgotten_weight_is_seen(monkeypatch):
    guide, target, weight = planes(0)
    expected = in_double(guide, target, weight, 2, 1e-2)[0]
    real = guided.box_sum
    monkeypatch.setattr(guided, "box_sum", lambda plane, radius: real(plane, 1))
    assert np.abs(expected - guided_coefficients(guide, target, weight, 2, 1e-2)[0]).max() > 0.1


def test_a_line_is_found_again_and_reaches_unweighed_neighbours():
    guide, _, weight = planes(3)
    slope, offset = guided_coefficients(guide, 0.5 - 2 * guide, weight, 2, 1e-7)
    told = box_mean(weight, np.ones_like(weight), 2, empty=0.0) > 0.3
    np.testing.assert_allclose(-2, slope[told], atol=0.01)
    np.testing.assert_allclose(0.5, offset[told], atol=0.01)
    assert slope[0, 0] == offset[0, 0] == 0


def test_refuses_planes_of_different_shapes_and_windows_of_nothing():
    guide, target, weight = planes(0)
    with pytest.raises(ArgumentError, match="one shape"):
        guided_coefficients(guide, target[1:], weight, 2, 0.1)
    with pytest.raises(ArgumentError, match="radius_cells"):
        guided_coefficients(guide, target, weight, 0, 0.1)
