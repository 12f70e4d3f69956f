"""The ground's noise: evenly spread, everywhere alike, without repetition; and faults that are not.

Each check takes a function (along, left, size) -> noise in [0, 1]; the faults are other functions.
"""

from itertools import pairwise

import numba
import numpy as np
import pytest
from oracles import reference_edit as reference

from weather_aug.edit.physical.noise import (
    CELL_M,
    COARSE_SHARE,
    LEVELS,
    PERIOD_M,
    TILE_CELLS,
    ground_noise,
    noise_tile,
)

FINE_PERIOD_M = CELL_M * TILE_CELLS
NEAR_M = 0.02
FEW = 20_000


@numba.njit(error_model="numpy")
def _each(tile, along, left, size_m, offset_m, out):
    for i in range(along.shape[0]):
        out[i] = ground_noise(tile, along[i], left[i], size_m[i], offset_m)


def noise(along, left, size_m=NEAR_M, offset_m=0.0):
    """The package's noise at places (N,)."""
    arrays = np.broadcast_arrays(along, left, size_m)
    out = np.empty(arrays[0].shape, np.float32)
    _each(noise_tile(), *(a.astype(np.float32) for a in arrays), np.float32(offset_m), out)
    return out.astype(float)


def places(count=FEW, seed=0):
    return np.random.default_rng(seed).uniform(0, PERIOD_M, (2, count))


def not_evened(along, left, size_m=NEAR_M):
    """The sum of both looks, which is often middling."""
    value = noise(along, left, size_m)
    levels = np.linspace(0, 1, 2001)
    return np.interp(value, reference.evenly(levels), levels)


def fine_look_alone(along, left, size_m=NEAR_M):
    level = reference.levels()[0]
    return reference.look_up(level, along / CELL_M, left / CELL_M)


def with_a_trend(along, left, size_m=NEAR_M):
    return np.clip(noise(along, left, size_m) + 0.15 * (along / PERIOD_M - 0.5), 0, 1)


def check_even(function, size_m=NEAR_M, within=0.012):
    """Kolmogorov and Smirnov's distance to the even distribution."""
    value = np.sort(function(*places(), size_m))
    assert value.min() >= 0
    assert value.max() <= 1
    assert np.abs(value - (np.arange(FEW) + 0.5) / FEW).max() < within


def check_stationary(function):
    """In each of 16 squares of the period the same mean and spread."""
    along, left = places(160_000)
    value = function(along, left)
    square = (4 * along / PERIOD_M).astype(int) * 4 + (4 * left / PERIOD_M).astype(int)
    for k in range(16):
        assert abs(value[square == k].mean() - 0.5) < 0.03
        assert abs(value[square == k].std() - 12**-0.5) < 0.02


def check_no_repetition(function):
    """From the size of its patches, 60 m, to 400 m no step brings the street back.

    The fine look repeats every 31 m along and left; in the sum that is a correlation of 0.3.
    """
    along, left = places(4_000)
    first = function(along, left)
    for direction in (0.0, 0.5 * np.pi, np.arctan2(0.6, 0.8), 1.1):
        for step in np.append(np.arange(60.0, 400.0, 3.7), FINE_PERIOD_M * np.arange(2, 14)):
            moved = along + step * np.cos(direction), left + step * np.sin(direction)
            assert np.corrcoef(first, function(*moved))[0, 1] < 0.4


def check_steps_between_copies(function):
    """What is farther off is the same street: the copies differ by little."""
    along, left = places()
    sizes = NEAR_M * 2.0 ** np.arange(11)
    seen = np.array([function(along, left, size) for size in sizes])
    assert np.abs(np.diff(seen, axis=0)).mean(axis=1).max() < 0.07
    assert np.abs(seen.mean(axis=1) - 0.5).max() < 0.01


def test_it_is_evenly_spread():
    check_even(noise)


@pytest.mark.parametrize(("size_m", "within"), [(0.3, 0.02), (1.0, 0.03), (3.0, 0.06)])
def test_it_stays_nearly_even_far_away(size_m, within):
    check_even(noise, size_m, within)


def test_a_plain_sum_is_found():
    with pytest.raises(AssertionError):
        check_even(not_evened)


def test_it_is_alike_everywhere():
    check_stationary(noise)


def test_a_trend_is_found():
    with pytest.raises(AssertionError):
        check_stationary(with_a_trend)


def test_it_does_not_repeat_within_a_street():
    check_no_repetition(noise)


def test_a_small_tile_is_found():
    with pytest.raises(AssertionError):
        check_no_repetition(fine_look_alone)


def test_far_copies_show_the_same_street():
    check_steps_between_copies(noise)


def test_another_tile_for_each_copy_is_found():
    def other(along, left, size_m):
        return noise(along + 7.0 * np.log2(size_m / NEAR_M), left, size_m)

    with pytest.raises(AssertionError):
        check_steps_between_copies(other)


def test_copies_keep_the_mean():
    copies = reference.levels()
    assert len(copies) == LEVELS
    assert len(copies[0]) == TILE_CELLS
    for copy in copies:
        assert abs(copy.mean() / 255 - 0.5) < 0.5 / 255
    # Copies of the largest of four would not.
    assert np.maximum(copies[0][::2], copies[0][1::2]).mean() / 255 - 0.5 > 0.5 / 255


def test_each_copy_is_the_mean_of_the_one_before():
    copies = reference.levels()
    for fine, coarse in pairwise(copies):
        four = fine.reshape(len(coarse), 2, len(coarse), 2).mean(axis=(1, 3))
        assert np.abs(four - coarse).max() <= 1.0


@pytest.mark.parametrize("size_m", [0.01, 0.08, 0.3, 1.0, 4.0, 50.0])
@pytest.mark.parametrize("offset_m", [0.0, 11.3])
def test_it_is_that_of_the_reference(size_m, offset_m):
    along, left = places(2_000)
    expected = reference.noise(along, left, np.full(2_000, size_m), offset_m)
    # Places far out are float32: 0.1 mm.
    np.testing.assert_allclose(noise(along, left, size_m, offset_m), expected, atol=4e-3)


def test_its_period_changes_nothing_and_any_other_step_does():
    along, left = places(2_000)
    here = noise(along, left)
    for steps in ((1, 0), (0, 1), (-1, 1)):
        there = noise(along + steps[0] * PERIOD_M, left + steps[1] * PERIOD_M)
        assert np.abs(there - here).max() < 0.01
    assert np.abs(noise(along + FINE_PERIOD_M, left) - here).mean() > 0.1


def test_offsets_choose_another_place():
    along, left = places()
    pair = noise(along, left), noise(along, left, offset_m=11.3)
    assert abs(np.corrcoef(pair)[0, 1]) < 0.1


def test_the_tile_is_shared_and_cannot_be_written():
    tile = noise_tile()
    assert tile is noise_tile()
    assert not tile.flags.writeable
    assert tile.dtype == np.uint8


def test_the_shares_are_those_of_the_reference():
    assert reference.SHARES == (COARSE_SHARE, pytest.approx(1 - COARSE_SHARE))
