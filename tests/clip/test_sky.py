"""The sky heuristic on drawn pictures and on a real one with labels."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from weather_aug.clip import sky
from weather_aug.clip.open import open_clip
from weather_aug.clip.sky import sky_mask
from weather_aug.taxonomy import IGNORE, SKY

DATA = Path(__file__).resolve().parents[2] / ".." / "shared" / "data" / "camvid-dev"
BLUE, OVERCAST, TREE = (90, 140, 220), (215, 217, 222), (40, 60, 30)


def _scene(colour: tuple[int, int, int]) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Sky over a noisy tree line; the picture and where the sky is."""
    rng = np.random.default_rng(3)
    truth = np.zeros((120, 200), bool)
    truth[:70] = True
    truth[30:, 60:110] = False
    image = np.where(truth[..., None], colour, TREE) + rng.integers(-3, 4, (120, 200, 1))
    image[~truth] += rng.integers(-30, 31, (int((~truth).sum()), 3))
    return image.clip(0, 255).astype(np.uint8), truth


@pytest.mark.parametrize("colour", [BLUE, OVERCAST])
def test_sky_is_found_to_its_border(colour: tuple[int, int, int]) -> None:
    image, truth = _scene(colour)
    assert (sky_mask(image) != truth).mean() < 0.02


def test_sky_behind_a_wire_is_sky() -> None:
    image, truth = _scene(OVERCAST)
    image[20:22], truth[20:22] = 30, False
    mask = sky_mask(image)
    assert mask[40, 20] and mask[5, 20] and not mask[20:22].any()


def test_bright_things_below_are_no_sky() -> None:
    image, _ = _scene(BLUE)
    image[85:110, 20:80] = 230
    assert not sky_mask(image)[85:110].any()


def test_a_grey_lorry_up_to_the_top_is_no_sky() -> None:
    image, _ = _scene((250, 250, 252))
    image[:90, 150:] = (150, 152, 150)
    assert not sky_mask(image)[:90, 156:].any()


def test_a_tunnel_has_no_sky() -> None:
    image = np.full((60, 80, 3), 45, np.uint8)
    assert not sky_mask(image).any()


@pytest.mark.skipif(not DATA.is_dir(), reason="no shared CamVid data")
def test_real_skies_agree_with_their_labels() -> None:
    clip = open_clip(f"folder:{DATA}?images=train&labels=trainannot&taxonomy=camvid11")
    both = either = 0
    for key in clip.keys[::8]:
        frame = clip.frame(key)
        assert frame.label is not None
        known, truth = frame.label != IGNORE, frame.label == SKY
        found = sky_mask(frame.image)
        both += int((found & truth & known).sum())
        either += int(((found | truth) & known).sum())
    assert both / either > 0.75


def test_a_lamp_before_the_sky_is_no_sky() -> None:
    image, _ = _scene(BLUE)
    image = np.kron(image, np.ones((1, 4, 1), np.uint8))
    image[10:60, 150:152] = (190, 200, 220)
    mask = sky_mask(image)
    assert not mask[12:58, 150:152].any()
    assert mask[12:58, 140:146].all() and mask[12:58, 156:162].all()


def _wood_with(colour: tuple[int, int, int]) -> NDArray[np.bool_]:
    """What is sky at small marks of a colour within a dark wood beside the blue sky."""
    image, _ = _scene(BLUE)
    image[:, 60:] = np.random.default_rng(5).integers(15, 50, (120, 140, 1))
    marks = np.zeros((120, 200), bool)
    marks[10:60:12, 80:110:10] = True
    marks = cv2.dilate(marks.astype(np.uint8), np.ones((3, 3))) > 0
    image[marks] = colour
    return np.asarray(sky_mask(image)[marks])


def test_sky_between_leaves_is_found_dimmed_and_other_colours_are_not() -> None:
    assert _wood_with(BLUE).mean() > 0.95
    assert _wood_with((63, 98, 154)).mean() > 0.95
    assert not _wood_with((200, 160, 60)).any()
    assert not _wood_with((230, 230, 230)).any()


def test_without_slivers_the_gaps_are_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """Planted fault: only sky that is connected or as bright as the open sky close by."""
    monkeypatch.setattr(sky, "_slivers", lambda image, mask, colour: np.zeros_like(mask))
    assert _wood_with((63, 98, 154)).mean() < 0.5
