"""Grids of samples: what stands where, at which size."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from weather_aug.edit.diffusion.samples import GAP_PX, STRIP_PX, WIDTH_PX, Row, grid, picture_of
from weather_aug.errors import ArgumentError


def plain(value: int, height: int, width: int) -> np.ndarray:
    return np.full((height, width, 3), value, np.uint8)


@pytest.mark.parametrize(("height", "width"), [(32, 48), (8, 192), (40, 640), (512, 512)])
def test_each_picture_stands_in_its_place(height: int, width: int) -> None:
    rows = [
        Row("rain", *(plain(value, height, width) for value in (10, 20, 30)), aligned=True),
        Row("snow", *(plain(value, height, width) for value in (40, 50, 60)), aligned=False),
    ]
    picture = grid(rows)
    shown_width = (picture.shape[1] - 2 * GAP_PX) // 3
    shown_height = picture.shape[0] // 2 - STRIP_PX - GAP_PX
    assert WIDTH_PX[0] <= shown_width <= WIDTH_PX[1]
    assert shown_height / shown_width == pytest.approx(height / width, rel=0.02)
    for row in range(2):
        for column in range(3):
            top = row * (STRIP_PX + shown_height + GAP_PX) + STRIP_PX
            left = column * (shown_width + GAP_PX)
            part = picture[top : top + shown_height, left : left + shown_width]
            assert (part == 10 * (3 * row + column + 1)).all()
    strips = [picture[:STRIP_PX], picture[picture.shape[0] // 2 :][:STRIP_PX]]
    assert all(strip.min() < 128 for strip in strips)
    assert not np.array_equal(*strips)


def test_no_row_is_no_grid() -> None:
    with pytest.raises(ArgumentError, match="at least one row"):
        grid([])


def test_pictures_are_cut_to_what_can_be_shown() -> None:
    tensor = torch.tensor([-2.0, -1.0, 0.0, 1.0, 7.0])[None, None].expand(3, 1, 5)
    assert picture_of(tensor)[0, :, 0].tolist() == [0, 0, 128, 255, 255]
