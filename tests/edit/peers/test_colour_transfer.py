"""Colour transfer: the clip gets the picture's mean and spread, by one map for all its frames."""

import cv2
import numpy as np
import pytest
from peer_contract import check_is_an_editor, check_is_pure
from tiny_clip import TinyClip

from weather_aug.clip.types import FrameKey
from weather_aug.edit.background import Moment
from weather_aug.edit.peers import colour_transfer
from weather_aug.edit.peers.colour_transfer import (
    ColourStatistics,
    ColourTransfer,
    lab_of,
    measured,
    moved,
    sampled,
)
from weather_aug.edit.peers.options import PeerOptions
from weather_aug.errors import ArgumentError

CLIP = TinyClip(width=97, height=53)
GREYISH = ColourStatistics((60.0, 0.0, -4.0), (12.0, 2.0, 3.0))
"""Within what sRGB can show."""


def frames():
    return [CLIP.frame(key) for key in CLIP.keys]


def edited(editor, style="snow"):
    return [editor.edit(Moment(now=(frame,)), style)[0] for frame in frames()]


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pictures")
    image = np.random.default_rng(1).integers(150, 250, (20, 30, 3)).astype(np.uint8)
    for style in ("rain", "snow"):
        cv2.imwrite(str(folder / f"{style}.png"), image // (2 if style == "rain" else 1))
    return folder


@pytest.fixture(scope="module")
def editor(pictures):
    return ColourTransfer.load(PeerOptions(pictures=pictures), CLIP)


def test_it_is_an_editor(editor, pictures, moment):
    assert editor.styles == ("rain", "snow")
    check_is_an_editor(editor, moment)
    check_is_pure(editor, ColourTransfer.load(PeerOptions(pictures=pictures), CLIP), moment)


def test_the_clip_gets_the_pictures_statistics():
    clip = measured(frame.image for frame in frames())
    after = measured(edited(ColourTransfer(clip, {"snow": GREYISH})))
    assert after.mean == pytest.approx(GREYISH.mean, abs=0.2)  # 8 bits
    assert after.spread == pytest.approx(GREYISH.spread, abs=0.3)


def test_statistics_are_those_of_all_pixels_together():
    pixels = np.concatenate([lab_of(frame.image).reshape(-1, 3) for frame in frames()])
    ours = measured(frame.image for frame in frames())
    assert ours.mean == pytest.approx(pixels.astype(float).mean(axis=0), abs=1e-4)
    assert ours.spread == pytest.approx(pixels.astype(float).std(axis=0), abs=1e-4)
    with pytest.raises(ArgumentError, match="no picture"):
        measured([])


def test_its_own_statistics_change_nothing():
    clip = measured(frame.image for frame in frames())
    for frame, picture in zip(frames(), edited(ColourTransfer(clip, {"snow": clip})), strict=True):
        assert np.abs(picture.astype(int) - frame.image).max() <= 1


def check_one_map_for_all(pictures):
    """A colour becomes the same colour wherever and whenever it stands."""
    became = {}
    for frame, picture in zip(frames(), pictures, strict=True):
        given = frame.image.reshape(-1, 3).tolist()
        for old, new in zip(map(tuple, given), picture.reshape(-1, 3).tolist(), strict=True):
            assert became.setdefault(old, new) == new


def test_one_map_for_all():
    clip = measured(frame.image for frame in frames())
    check_one_map_for_all(edited(ColourTransfer(clip, {"snow": GREYISH})))


def test_statistics_of_each_frame_are_caught(monkeypatch):
    clip = measured(frame.image for frame in frames())

    def of_the_frame(lab, given, wanted):
        mean, spread = lab.mean(axis=(0, 1)), lab.std(axis=(0, 1))
        return moved(lab, ColourStatistics(tuple(mean), tuple(spread)), wanted)

    monkeypatch.setattr(colour_transfer, "moved", of_the_frame)
    with pytest.raises(AssertionError):
        check_one_map_for_all(edited(ColourTransfer(clip, {"snow": GREYISH})))


def test_one_grey_is_not_torn_apart():
    grey = ColourStatistics((50.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    lab = np.full((2, 2, 3), (50.0, 0.0, 0.0), np.float32)
    lab[0, 0, 1] = 0.01
    assert np.abs(moved(lab, grey, GREYISH) - GREYISH.mean).max() < 0.02


def test_what_it_needs(pictures):
    with pytest.raises(ArgumentError, match="give clip="):
        ColourTransfer.load(PeerOptions(pictures=pictures))
    with pytest.raises(ArgumentError, match="no option steps"):
        ColourTransfer.load(PeerOptions(pictures=pictures, steps=3), CLIP)


def test_long_clips_are_sampled_with_all_their_cameras():
    keys = [FrameKey(t, camera) for t in range(100) for camera in ("a", "b", "c")]
    some = sampled(keys)
    assert 32 <= len(some) <= 64
    assert {key.camera for key in some} == {"a", "b", "c"}
    assert len(set(np.diff(sorted({key.time_index for key in some})))) == 1
    assert sampled(keys[:6]) == tuple(keys[:6])
