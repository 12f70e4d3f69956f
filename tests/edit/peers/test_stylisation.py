"""Stylisation with the real style networks, where they are, and what is said where they are not."""

import os
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from peer_contract import assert_equal, check_is_an_editor, check_is_pure, one

from weather_aug.edit.peers.options import PeerOptions
from weather_aug.edit.peers.stylisation import StyleReader, Stylisation, style_pictures
from weather_aug.errors import ArgumentError, DataError, MissingExtraError

SHARED = Path(__file__).resolve().parents[3] / ".." / "shared" / "data"
WEIGHTS = Path(os.environ.get("WEATHER_AUG_WEIGHTS", SHARED / "weights"))
needs_networks = pytest.mark.skipif(
    not any(WEIGHTS.glob("*transfer*.tflite")), reason="the shared style networks are not here"
)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """Snow is white with blue shade, rain dark and grey, and they have grains of their own."""
    folder = tmp_path_factory.mktemp("pictures")
    rng = np.random.default_rng(0)
    for style, colour, grain in (("snow", (222, 228, 238), 9), ("rain", (70, 76, 82), 25)):
        noise = cv2.GaussianBlur(rng.normal(0, grain, (90, 160, 3)), (0, 0), 2)
        image = np.clip(np.array(colour) + 3 * noise, 0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / f"{style}.png"), image[..., ::-1])
    return folder


@pytest.fixture(scope="module")
def load(pictures):
    pytest.importorskip("ai_edge_litert")

    def loaded(**options):
        return Stylisation.load(PeerOptions(weights=WEIGHTS, pictures=pictures, **options))

    return loaded


@pytest.fixture(scope="module")
def editor(load):
    return load()


@needs_networks
def test_it_is_an_editor(editor, load, moment):
    assert editor.styles == ("rain", "snow")
    check_is_an_editor(editor, moment)
    check_is_an_editor(load(height=40), moment)


@needs_networks
def test_it_is_pure(editor, load, moment):
    check_is_pure(editor, load(), moment)


@needs_networks
def test_sizes_may_change_from_frame_to_frame(editor, load, moment):
    """Networks that were resized for another picture paint this one as before."""
    frame = moment.now[0]
    first = one(editor, frame)
    camera = frame.camera.resized(64, 40)
    small = replace(
        frame, camera=camera, image=frame.image[:40, :64].copy(), label=None, depth_m=None
    )
    assert one(editor, small).shape == (40, 64, 3)
    assert_equal((first,), (one(editor, frame),))


def check_it_takes_the_pictures_tone(editor, frame):
    snow, rain = one(editor, frame, "snow"), one(editor, frame, "rain")
    assert snow.mean() > rain.mean() + 40


@needs_networks
def test_it_takes_the_pictures_tone(editor, moment):
    check_it_takes_the_pictures_tone(editor, moment.now[0])


@needs_networks
def test_one_style_for_all_pictures_is_caught(load, moment, monkeypatch):
    monkeypatch.setattr(StyleReader, "style_of", lambda *_: np.zeros(100, np.float32))
    with pytest.raises(AssertionError):
        check_it_takes_the_pictures_tone(load(), moment.now[0])


@needs_networks
def test_the_style_is_read_from_the_middle_square(pictures):
    pytest.importorskip("ai_edge_litert")
    reader = StyleReader(next(WEIGHTS.glob("*predict*.tflite")))
    wide = cv2.imread(str(pictures / "snow.png"))[..., ::-1].copy()
    square = wide[:, 35:125].copy()
    wide[:, :35] = wide[:, 125:] = 0
    assert np.array_equal(reader.style_of(wide), reader.style_of(square))
    assert reader.style_of(square).shape == (100,)


def test_pictures_are_found_by_their_names(pictures, tmp_path):
    assert list(style_pictures(pictures)) == ["rain", "snow"]
    with pytest.raises(ArgumentError, match="pictures=FOLDER"):
        style_pictures(None)
    with pytest.raises(DataError, match="holds no picture of a weather"):
        style_pictures(tmp_path)
    for name in ("fog.png", "fog.jpg"):
        (tmp_path / name).write_bytes(b"")
    with pytest.raises(DataError, match="two pictures of fog"):
        style_pictures(tmp_path)


@pytest.mark.parametrize("given", [False, True])
def test_missing_networks_say_what_to_do(pictures, tmp_path, given):
    options = PeerOptions(weights=tmp_path if given else None, pictures=pictures)
    with pytest.raises(DataError) as caught:
        Stylisation.load(options)
    said = str(caught.value)
    for part in ("Apache-2.0", "curl -O https://", "editor='physical', which needs no weights"):
        assert part in said


def test_a_file_that_is_no_network_is_refused(pictures, tmp_path):
    pytest.importorskip("ai_edge_litert")
    for name in ("style_predict.tflite", "style_transfer.tflite"):
        (tmp_path / name).write_bytes(b"nothing")
    with pytest.raises(DataError, match="no model that can be read"):
        Stylisation.load(PeerOptions(weights=tmp_path, pictures=pictures))


def test_a_missing_package_is_named(pictures, tmp_path, monkeypatch):
    for name in ("style_predict.tflite", "style_transfer.tflite"):
        (tmp_path / name).write_bytes(b"nothing")
    monkeypatch.setitem(sys.modules, "ai_edge_litert", None)
    monkeypatch.setitem(sys.modules, "ai_edge_litert.interpreter", None)
    with pytest.raises(MissingExtraError, match=r"weather-aug\[stylisation\]"):
        Stylisation.load(PeerOptions(weights=tmp_path, pictures=pictures))
