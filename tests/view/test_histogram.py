"""Class histograms: bars as long as the classes' shares, in the palette's colours."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from weather_aug.errors import ArgumentError
from weather_aug.taxonomy import CLASSES, PALETTE, ROAD, SKY, TRAIN_ID
from weather_aug.view.histogram import class_bars, class_histogram, percent, pixel_shares


def counts(**pixels: int) -> np.ndarray:
    table = np.zeros(256, np.int64)
    for name, number in pixels.items():
        table[255 if name == "ignored" else TRAIN_ID[name]] = number
    return table


def test_shares_sum_to_one_and_name_the_ignored() -> None:
    shares = pixel_shares(counts(road=70, sky=20, ignored=10))
    assert list(shares) == [*CLASSES, "ignored"]
    assert (shares["road"], shares["sky"], shares["ignored"]) == (0.7, 0.2, 0.1)
    assert sum(shares.values()) == pytest.approx(1)


@pytest.mark.parametrize("wrong", [np.zeros(256, np.int64), np.ones(19, np.int64)])
def test_counts_of_nothing_are_refused(wrong: np.ndarray) -> None:
    with pytest.raises(ArgumentError, match="256 numbers"):
        pixel_shares(wrong)


def test_bars_of_the_picture_are_logarithmic_and_coloured() -> None:
    picture = class_histogram(pixel_shares(counts(road=9_000, sky=900, car=90, rider=10)))
    lengths = {}
    for name in ("road", "sky", "car", "rider", "train"):
        painted = (picture == PALETTE[TRAIN_ID[name]]).all(axis=-1)
        lengths[name] = painted.sum(axis=1).max()
    assert lengths["train"] == 0
    tenfold = (960 - 120 - 84) / 5
    assert lengths["road"] - lengths["sky"] == pytest.approx(tenfold, abs=2)
    assert lengths["sky"] - lengths["car"] == pytest.approx(tenfold, abs=2)
    assert lengths["sky"] - lengths["rider"] == pytest.approx(tenfold * math.log10(90), abs=2)
    assert ROAD != SKY


def test_bars_of_text_leave_out_what_does_not_occur() -> None:
    lines = class_bars(pixel_shares(counts(road=999, sky=1)), columns=50)
    assert [line.split()[0] for line in lines] == ["road", "sky"]
    assert [line.count("█") for line in lines] == [50, 20]
    assert "\x1b" not in "".join(lines)
    (road, _) = class_bars(pixel_shares(counts(road=999, sky=1)), colour=True)
    assert "\x1b[38;2;128;64;128m" in road
    assert road.endswith("\x1b[0m")


@pytest.mark.parametrize(
    ("share", "text"),
    [(1, "100 %"), (0.25, "25 %"), (0.0667, "6.7 %"), (0.00012, "0.012 %"), (1e-7, "<0.001 %")],
)
def test_percent_has_two_digits_that_count(share: float, text: str) -> None:
    assert percent(share) == text
    assert percent(0.0) == "none"


@settings(max_examples=25)
@given(st.lists(st.integers(0, 10**12), min_size=256, max_size=256).filter(any))
def test_any_counts_can_be_drawn(numbers: list[int]) -> None:
    shares = pixel_shares(np.array(numbers))
    assert class_histogram(shares, width=480).dtype == np.uint8
    assert all(line.isprintable() for line in class_bars(shares))
