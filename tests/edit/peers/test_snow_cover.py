"""Snow cover alone: the physical editor's snow, and not a byte of anything else."""

import numpy as np
import pytest
from edit_scene import Street
from peer_contract import check_is_an_editor, check_is_pure

from weather_aug.edit.background import Moment
from weather_aug.edit.peers import snow_cover
from weather_aug.edit.peers.options import PeerOptions
from weather_aug.edit.peers.snow_cover import WITHOUT, SnowCover, snowed
from weather_aug.edit.physical import look
from weather_aug.errors import ArgumentError
from weather_aug.taxonomy import ROAD, SKY, TRAIN_ID


@pytest.fixture(scope="module")
def street():
    return Street(width=97, height=53, focal_px=80.0)


@pytest.fixture(scope="module")
def moment(street):
    return moment_of(street)


def moment_of(street):
    return Moment(now=(street.frame,), look=lambda frame: (street.layers, street.ambience))


def test_it_is_an_editor(moment):
    check_is_an_editor(SnowCover(), moment)
    check_is_pure(SnowCover(), SnowCover.load(PeerOptions()), moment)


def check_the_rest_is_as_it_was(street):
    frame = street.frame
    picture = SnowCover().edit(moment_of(street), "snow")[0]
    bare = np.isin(frame.label, [SKY, TRAIN_ID["person"], TRAIN_ID["pole"]])
    # Caps lie on the topmost pixels of what stands: the sky keeps all its bytes, the rest most.
    sky = frame.label == SKY
    assert np.array_equal(picture[sky], frame.image[sky])
    same = (picture == frame.image).all(axis=-1)
    assert same[bare].mean() > 0.8
    assert not same[frame.label == ROAD].any()


def test_what_holds_no_snow_keeps_its_bytes(street):
    check_the_rest_is_as_it_was(street)


def test_the_physical_editors_exposure_is_caught(street, monkeypatch):
    def exposed(frame, layers, ambience, weather):
        return street.edited(weather, without=WITHOUT)

    monkeypatch.setattr(snow_cover, "snowed", exposed)
    with pytest.raises(AssertionError):
        check_the_rest_is_as_it_was(street)


@pytest.mark.parametrize("labelled", [True, False])
@pytest.mark.parametrize("severity", [0.2, 1.0])
def test_it_is_the_physical_editors_snow(monkeypatch, severity, labelled):
    """To the byte, where that editor's camera does not expose for white fields."""
    street = Street(width=97, height=53, focal_px=80.0, labelled=labelled)
    weather = SnowCover(severity).weather
    monkeypatch.setattr(look, "SNOW_EXPOSURE_LOSS", 0.0)
    ours = snowed(street.frame, street.layers, street.ambience, weather)
    assert np.array_equal(ours, street.edited(weather, without=WITHOUT))


def test_more_snow_is_whiter(street, moment):
    road = street.frame.label == ROAD
    means = [street.frame.image[road].mean()]
    for severity in (0.25, 0.6, 1.0):
        means.append(SnowCover(severity).edit(moment, "snow")[0][road].mean())
    assert means == sorted(means) and means[-1] > means[0] + 60


def test_what_it_needs(street):
    with pytest.raises(ArgumentError, match="give the moment a look"):
        SnowCover().edit(Moment(now=(street.frame,)), "snow")
    with pytest.raises(ArgumentError, match="no option base"):
        SnowCover.load(PeerOptions(base="somewhere"))
    assert SnowCover.load(PeerOptions(severity=0.0)).weather.snow_cover == 0.0
