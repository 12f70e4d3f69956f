"""ControlNet end to end on tiny random models; what it is shown of a frame."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from peer_contract import check_is_an_editor, check_is_pure, check_noise_is_keyed, one, one_style
from tiny_diffusion import build_tiny_sd

from weather_aug.edit.peers import controlnet
from weather_aug.edit.peers.conditions import ADE20K, PUBLISHED, condition_of, palette_of
from weather_aug.edit.peers.controlnet import ControlNet
from weather_aug.edit.peers.options import CONDITIONS, PeerOptions
from weather_aug.errors import ArgumentError, DataError
from weather_aug.taxonomy import CLASSES, IGNORE, PALETTE, ROAD, SKY, TRAIN_ID


@pytest.fixture(scope="module")
def load(tiny_sd, tiny_control):
    def loaded(**options):
        given = {"base": str(tiny_sd), "control": str(tiny_control), "steps": 3, **options}
        return ControlNet.load(PeerOptions(**given))

    return loaded


@pytest.fixture(scope="module")
def editor(load):
    return load()


def test_it_is_an_editor(editor, load, moment):
    check_is_an_editor(editor, moment)
    check_is_an_editor(load(height=40), moment)


@pytest.mark.parametrize("condition", CONDITIONS)
def test_every_condition_runs(load, moment, condition):
    assert one(load(condition=condition), moment.now[0]).shape == (53, 97, 3)


def test_it_is_pure(editor, load, moment):
    check_is_pure(editor, load(), moment)


def test_noise_is_keyed(load, moment):
    check_noise_is_keyed(lambda **o: load(prompts=one_style("weather"), **o), moment)


@pytest.mark.parametrize(
    "choice",
    [
        {"guidance": 2.0},
        {"strength": 0.4},
        {"steps": 5},
        {"conditioning": 2.0},
        {"condition": "cityscapes"},
        {"prompts": {"snow": "blizzard"}},
    ],
)
def test_every_choice_changes_picture_and_card(editor, load, moment, choice):
    other = load(**choice)
    assert other.card != editor.card
    assert (one(other, moment.now[0]) != one(editor, moment.now[0])).mean() > 0.2


def check_the_label_leads(load, frame):
    """Another label is another picture; without its weight the label is nothing."""
    swapped = replace(frame, label=np.where(frame.label == ROAD, SKY, ROAD).astype(np.uint8))
    led, free = load(conditioning=2.0), load(conditioning=0.0)
    assert (one(led, frame) != one(led, swapped)).mean() > 0.2
    assert np.array_equal(one(free, frame), one(free, swapped))


def test_the_label_leads(load, moment):
    check_the_label_leads(load, moment.now[0])


def test_a_condition_that_shows_nothing_is_caught(load, moment, monkeypatch):
    monkeypatch.setattr(
        controlnet, "condition_of", lambda *given: np.zeros_like(condition_of(*given))
    )
    with pytest.raises(AssertionError):
        check_the_label_leads(load, moment.now[0])


def test_models_that_do_not_belong_together_are_refused(
    tiny_sd, tiny_instruct, tiny_control, tmp_path
):
    with pytest.raises(DataError, match="takes 8 channels, the ControlNet was made for 4"):
        ControlNet.load(PeerOptions(base=str(tiny_instruct), control=str(tiny_control)))
    wide = build_tiny_sd(tmp_path / "wide", seed=0, width=16)
    with pytest.raises(DataError, match="ControlNet's block_out_channels"):
        ControlNet.load(PeerOptions(base=str(wide), control=str(tiny_control)))


def test_missing_weights_say_what_to_do(tiny_sd):
    with pytest.raises(DataError, match="hf download stable-diffusion-v1-5/stable-diffusion-v1-5"):
        ControlNet.load(PeerOptions())
    for condition, model_id in PUBLISHED.items():
        with pytest.raises(DataError, match=f"hf download {model_id}"):
            ControlNet.load(PeerOptions(base=str(tiny_sd), condition=condition))
    with pytest.raises(ArgumentError, match="'cityscapes' has no published ControlNet"):
        ControlNet.load(PeerOptions(base=str(tiny_sd), condition="cityscapes"))


def test_what_is_to_be_shown_must_be_there(editor, load, moment):
    frame = replace(moment.now[0], label=None, depth_m=None)
    for condition in ("ade20k", "cityscapes", "depth"):
        with pytest.raises(DataError, match="000001_front has no"):
            condition_of(frame, condition, None)
    assert condition_of(frame, "canny", None).any()
    with pytest.raises(DataError, match="condition='canny'"):
        one(editor, frame)


@pytest.mark.parametrize("rows", [None, 30, 80])
@pytest.mark.parametrize("kind", CONDITIONS)
def test_a_condition_has_the_fitted_pictures_size(moment, kind, rows):
    from weather_aug.edit.peers.pictures import fitted

    frame = moment.now[0]
    assert condition_of(frame, kind, rows).shape == fitted(frame.image, rows).shape


@pytest.mark.parametrize("rows", [None, 30, 80])
@pytest.mark.parametrize("kind", ["ade20k", "cityscapes"])
def test_colours_are_those_of_classes_and_never_mixed(moment, kind, rows):
    frame = moment.now[0]
    shown = condition_of(frame, kind, rows)
    known = {tuple(colour) for colour in palette_of(kind)[np.unique(frame.label)].tolist()}
    assert {tuple(pixel) for pixel in shown.reshape(-1, 3).tolist()} <= known
    if rows is None:
        assert np.array_equal(shown[:53, :97], palette_of(kind)[frame.label])


def test_palettes():
    assert set(ADE20K) == set(CLASSES)
    ade, cityscapes = palette_of("ade20k"), palette_of("cityscapes")
    assert ade[ROAD].tolist() == [140, 140, 140] and ade[SKY].tolist() == [6, 230, 230]
    assert ade[TRAIN_ID["car"]].tolist() == [0, 102, 200]
    assert np.array_equal(cityscapes[: len(CLASSES)], PALETTE)
    assert not ade[len(CLASSES) :].any() and not cityscapes[IGNORE].any()
    # Two pairs share what ADE20K does not tell apart: people, and a train, which it has not.
    assert len({tuple(colour) for colour in ade[: len(CLASSES)].tolist()}) == len(CLASSES) - 2


def test_near_is_white_and_the_sky_is_black(moment):
    frame = moment.now[0]
    shown = condition_of(frame, "depth", None)[:53, :97, 0]
    sky = ~np.isfinite(frame.depth_m)
    assert sky.any() and not shown[sky].any()
    assert shown.max() == 255 == shown.flat[np.argmin(frame.depth_m)]
    finite = frame.depth_m[~sky].astype(np.float64)
    assert np.abs(shown[~sky] - 255 * finite.min() / finite).max() <= 0.51
    blind = replace(frame, depth_m=np.full((53, 97), np.inf, np.float32))
    with pytest.raises(DataError, match="shows no surface"):
        condition_of(blind, "depth", None)


def test_edges_are_where_the_picture_steps():
    image = np.zeros((16, 24, 3), np.uint8)
    image[:, 12:] = 200
    from weather_aug.edit.peers.conditions import canny

    edges = canny(image)
    assert edges[:, 11:13].any() and not edges[:, :10].any() and not edges[:, 14:].any()
    assert np.array_equal(edges[..., 0], cv2.Canny(image[..., 0].copy(), 100, 200))


def test_a_strength_that_leaves_no_step_is_refused(load):
    with pytest.raises(ArgumentError, match="runs none"):
        load(steps=1, strength=0.8)
