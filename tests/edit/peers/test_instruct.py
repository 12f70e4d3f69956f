"""InstructPix2Pix end to end on a tiny random model of its shape."""

import sys

import numpy as np
import pytest
from peer_contract import check_is_an_editor, check_is_pure, check_noise_is_keyed, one, one_style

from weather_aug.edit.peers import instruct
from weather_aug.edit.peers.draws import generator_of
from weather_aug.edit.peers.instruct import InstructPix2Pix, unit_tensor
from weather_aug.edit.peers.options import PeerOptions
from weather_aug.errors import ArgumentError, DataError, MissingExtraError


@pytest.fixture(scope="module")
def load(tiny_instruct):
    def loaded(**options):
        return InstructPix2Pix.load(
            PeerOptions(**{"base": str(tiny_instruct), "steps": 2, **options})
        )

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
        instruct, "generator_of", lambda seed, _, style: generator_of(seed, key, style)
    )
    with pytest.raises(AssertionError, match="time"):
        check_noise_is_keyed(lambda **o: load(prompts=one_style("weather"), **o), moment)


def test_defaults_are_the_authors(tiny_instruct):
    card = InstructPix2Pix.load(PeerOptions(base=str(tiny_instruct))).card
    assert (card["guidance"], card["image_guidance"], card["steps"]) == (7.5, 1.5, 100)
    assert card["prompts"]["snow"] == "make it snowy"


@pytest.mark.parametrize(
    "choice",
    [{"guidance": 2.0}, {"image_guidance": 3.0}, {"steps": 3}, {"prompts": {"snow": "blizzard"}}],
)
def test_every_choice_changes_picture_and_card(editor, load, moment, choice):
    other = load(**choice)
    assert other.card != editor.card
    assert (one(other, moment.now[0]) != one(editor, moment.now[0])).mean() > 0.2


def test_the_sampler_is_the_authors(editor):
    assert type(editor._pipeline.scheduler).__name__ == "EulerAncestralDiscreteScheduler"


def test_a_model_of_another_shape_is_refused(tiny_sd):
    with pytest.raises(DataError, match="takes 4 channels, InstructPix2Pix's takes 8"):
        InstructPix2Pix.load(PeerOptions(base=str(tiny_sd)))


def test_missing_weights_and_packages_say_what_to_do(monkeypatch):
    with pytest.raises(DataError, match="hf download timbrooks/instruct-pix2pix"):
        InstructPix2Pix.load(PeerOptions())
    with pytest.raises(ArgumentError, match="no option strength"):
        InstructPix2Pix.load(PeerOptions(strength=0.5))
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(MissingExtraError, match=r"weather-aug\[edit\]"):
        InstructPix2Pix.load(PeerOptions())


def test_files_that_are_no_model_are_refused(tiny_instruct, tmp_path):
    for path in tiny_instruct.rglob("*"):
        if path.is_file():
            copy = tmp_path / "broken" / path.relative_to(tiny_instruct)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(path.read_bytes())
    weights = tmp_path / "broken" / "unet" / "diffusion_pytorch_model.safetensors"
    weights.write_bytes(weights.read_bytes()[:1000])
    with pytest.raises(DataError, match="no model that can be read"):
        InstructPix2Pix.load(PeerOptions(base=str(tmp_path / "broken")))
    weights.unlink()
    with pytest.raises(DataError, match="no model that can be read"):
        InstructPix2Pix.load(PeerOptions(base=str(tmp_path / "broken")))


def test_a_tensor_is_in_unit_range_and_channels_first():
    image = np.zeros((2, 3, 3), np.uint8)
    image[1, 2] = (255, 51, 0)
    tensor = unit_tensor(image)
    assert tensor.shape == (1, 3, 2, 3)
    assert tensor[0, :, 1, 2].tolist() == pytest.approx([1.0, 0.2, 0.0])
