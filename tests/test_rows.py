"""Row arithmetic: float16 as numpy rounds it, colours apart and together."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from weather_aug import _rows
from weather_aug._rows import apart_row, halves, together_row

HELD = st.floats(2.0**-14, 65504.0, width=32)


@given(st.lists(HELD, min_size=1, max_size=50), st.booleans())
def test_halves_are_numpys(values: list[float], negative: bool) -> None:
    array = np.array(values, np.float32) * np.float32(-1 if negative else 1)
    np.testing.assert_array_equal(halves(array), array.astype(np.float16))


def test_ties_go_to_even_digits() -> None:
    ties = np.float32([2049, 2051, -2049, 4098, 4102])
    np.testing.assert_array_equal(halves(ties), ties.astype(np.float16))
    # Planted fault: cutting the digits off is another rounding.
    cut = (ties.view(np.int32) & ~0x1FFF).view(np.float32)
    assert (halves(ties) != cut).any()


def test_what_float16_cannot_hold_is_its_end() -> None:
    ends = halves(np.float32([1e6, -1e6, 1e-6, 0.0]))
    np.testing.assert_array_equal(ends, np.float16([65504, -65504, 0, 0]))


def test_any_shape_and_layout() -> None:
    plane = np.arange(24, dtype=np.float32).reshape(4, 6)
    np.testing.assert_array_equal(halves(plane[::2, ::3]), plane[::2, ::3].astype(np.float16))
    assert halves(plane).shape == (4, 6)
    assert _rows.halves(np.empty((0, 3), np.float32)).shape == (0, 3)


@pytest.mark.parametrize("width", [1, 15, 16, 101])
def test_colours_apart_and_together_again(width: int) -> None:
    pixels = np.random.default_rng(width).integers(0, 256, (width, 3), dtype=np.uint8)
    rows = np.full((3, width + 9), 7, np.uint8)
    apart_row(pixels, *rows)
    np.testing.assert_array_equal(pixels.T, rows[:, :width])
    assert (rows[:, width:] == 7).all()
    out = np.zeros_like(pixels)
    together_row(*rows, out)
    np.testing.assert_array_equal(pixels, out)
