"""TurboEdit end to end on a tiny random model of SD-Turbo's shape."""

import pytest
from peer_contract import check_is_an_editor, check_is_pure, check_noise_is_keyed, one, one_style
from tiny_diffusion import build_tiny_sd

from weather_aug.edit.peers import turboedit
from weather_aug.edit.peers.draws import generator_of
from weather_aug.edit.peers.options import PeerOptions
from weather_aug.edit.peers.turboedit import TurboEdit
from weather_aug.errors import ArgumentError, DataError


@pytest.fixture(scope="module")
def load(tiny_sd):
    def loaded(**options):
        return TurboEdit.load(PeerOptions(**{"base": str(tiny_sd), "steps": 3, **options}))

    return loaded


@pytest.fixture(scope="module")
def editor(load):
    return load()


def test_it_is_an_editor(editor, load, moment):
    check_is_an_editor(editor, moment)
    check_is_an_editor(load(height=40), moment)


def test_it_is_pure(editor, load, moment):
    check_is_pure(editor, load(), moment)


def test_noise_is_keyed(load, moment):
    check_noise_is_keyed(lambda **o: load(prompts=one_style("weather"), **o), moment)


def test_noise_that_forgets_the_frame_is_caught(load, moment, monkeypatch):
    key = moment.now[0].key
    monkeypatch.setattr(
        turboedit, "generator_of", lambda seed, _, style: generator_of(seed, key, style)
    )
    with pytest.raises(AssertionError, match="time"):
        check_noise_is_keyed(lambda **o: load(prompts=one_style("weather"), **o), moment)


@pytest.mark.parametrize(
    "choice",
    [
        {"guidance": 4.0},
        {"steps": 4},
        {"prompts": {"snow": "blizzard"}},
        {"source_prompt": "a beach at noon"},
    ],
)
def test_every_choice_changes_picture_and_card(editor, load, moment, choice):
    other = load(**choice)
    assert other.card != editor.card
    assert (one(other, moment.now[0]) != one(editor, moment.now[0])).mean() > 0.02


def test_defaults_are_the_authors(tiny_sd):
    card = TurboEdit.load(PeerOptions(base=str(tiny_sd))).card
    assert card["timesteps"] == [799, 599, 399, 199] and card["guidance"] == 1.5


def test_a_vae_with_fewer_levels_is_padded_to_its_own_step(moment, tmp_path):
    folder = build_tiny_sd(tmp_path / "three", seed=4, vae_levels=3)
    picture = one(TurboEdit.load(PeerOptions(base=str(folder), steps=2)), moment.now[0])
    assert picture.shape == (53, 97, 3)


def test_missing_weights_say_what_to_do():
    with pytest.raises(DataError, match="hf download stabilityai/sd-turbo"):
        TurboEdit.load(PeerOptions())
    with pytest.raises(ArgumentError, match="no option condition"):
        TurboEdit.load(PeerOptions(condition="canny"))
