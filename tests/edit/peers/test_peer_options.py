"""Options of the peers: ranges, defaults, and choices that a peer does not have."""

import pytest

from weather_aug.edit.peers.options import CONDITIONS, PeerOptions, check_style, styles_of
from weather_aug.errors import ArgumentError


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("height", 7),
        ("steps", 0),
        ("steps", 1001),
        ("guidance", -1.0),
        ("guidance", float("nan")),
        ("image_guidance", 101.0),
        ("strength", 0.0),
        ("strength", 1.1),
        ("conditioning", 2.1),
        ("severity", 1.5),
        ("condition", "pose"),
        ("prompts", {"hail": "hail"}),
        ("seed", 0.5),
        ("half", True),
    ],
)
def test_a_choice_out_of_range_is_refused_by_name(name, value):
    with pytest.raises(ArgumentError, match=name):
        PeerOptions(**{name: value})


def test_defaults_are_the_peers_where_nothing_was_chosen():
    options = PeerOptions(steps=5, height=40).of("a", steps=100, guidance=7.5)
    assert (options.steps, options.guidance, options.height) == (5, 7.5, 40)
    assert options.card("steps", "height") == {"steps": 5, "height": 40}


def test_a_choice_of_another_peer_is_refused():
    with pytest.raises(ArgumentError, match="no option severity; it has steps"):
        PeerOptions(severity=0.5).of("a", steps=100)


def test_zero_is_a_choice():
    assert PeerOptions(guidance=0.0).of("a", guidance=7.5).guidance == 0.0


def test_styles_are_those_with_a_text():
    assert styles_of({"fog": "f", "rain": "r"}) == ("rain", "fog")
    assert styles_of(None) == ()
    assert check_style("fog", ("rain", "fog")) == "fog"
    with pytest.raises(ArgumentError, match="'snow' is not one of rain, fog"):
        check_style("snow", ("rain", "fog"))


def test_conditions_are_accepted():
    for condition in CONDITIONS:
        assert PeerOptions(condition=condition).condition == condition
