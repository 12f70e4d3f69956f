"""The peers by name."""

import pytest

from weather_aug.edit.peers.named import PEERS, load_peer
from weather_aug.edit.peers.options import PeerOptions
from weather_aug.errors import ArgumentError, DataError

ON_WEIGHTS = {
    "instruct-pix2pix": "hf download timbrooks/instruct-pix2pix",
    "controlnet": "hf download stable-diffusion-v1-5/stable-diffusion-v1-5",
    "turboedit": "hf download stabilityai/sd-turbo",
}


def test_a_peer_that_needs_nothing_is_loaded_by_its_name():
    assert load_peer("snow-cover", PeerOptions()).name == "snow-cover"


@pytest.mark.parametrize("name", [name for name in PEERS if name not in ON_WEIGHTS])
def test_a_peer_bears_its_name(name):
    from importlib import import_module

    module, kind = PEERS[name].split(":")
    assert getattr(import_module(f"weather_aug.edit.peers.{module}"), kind).name == name


@pytest.mark.parametrize("name", ON_WEIGHTS)
def test_missing_weights_say_what_to_do(name):
    with pytest.raises(DataError, match=ON_WEIGHTS[name]):
        load_peer(name, PeerOptions())


def test_another_name_is_refused():
    with pytest.raises(ArgumentError, match="'sdedit' is not one of instruct-pix2pix"):
        load_peer("sdedit", PeerOptions())
