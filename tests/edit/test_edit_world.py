"""The edited street is one street, from any camera, in any axes and in pictures of any kind."""

from dataclasses import replace

import numpy as np
import pytest
from edit_scene import (
    ALL,
    EFFECTS,
    WEATHERS,
    Street,
    light,
    off,
    painted,
    plain_layers,
    points_of,
    street,
    with_geometry,
)

from weather_aug.edit.physical import edit as module
from weather_aug.edit.physical.noise import PERIOD_M
from weather_aug.errors import CalibrationError
from weather_aug.taxonomy import IGNORE, ROAD, SKY
from weather_aug.weather import Weather

# Anchored to the world.


def cover_of(here):
    """(H, W) how far snow covers the road."""
    none, some, all_ = (
        light(here.edited(Weather(road_snow_cover=a), without=("tracks",)))[..., 1]
        for a in (0.0, 0.5, 1.0)
    )
    span = all_ - none
    return np.where(np.abs(span) > 0.02, (some - none) / np.where(span == 0, 1, span), np.nan)


def seen_again(one, other):
    """Covers of the road's places that two cameras see, within 12 m of both: (2, N)."""
    points = points_of(one.frame)
    camera = other.camera
    with np.errstate(invalid="ignore"):
        inside = (points - camera.centre_world) @ camera.world_from_camera[:3, :3]
        pixels = inside @ camera.intrinsics.T
        u, v = (np.round(pixels[..., k] / pixels[..., 2]) for k in (0, 1))
    told = (one.frame.label == ROAD) & (one.frame.depth_m < 12) & (inside[..., 2] > 1)
    told &= (u >= 0) & (u < other.width) & (v >= 0) & (v < other.height)
    row, column = v[told].astype(int), u[told].astype(int)
    same = np.abs(other.frame.depth_m[row, column] - inside[..., 2][told]) < 0.2
    pair = np.array([cover_of(one)[told], cover_of(other)[row, column]])
    return pair[:, same & np.isfinite(pair).all(0)]


VIEWS = [
    {"place_m": (2.0, 0.0)},
    {"place_m": (1.0, 0.8), "yaw_deg": 7.0},
    {"roll_deg": 6.0, "pitch_deg": -4.0},
]
SHARP = {"width": 256, "height": 160, "focal_px": 200.0, "boxes": ()}


def check_anchored(view):
    pair = seen_again(street(**SHARP), street(**SHARP, **view))
    assert pair.shape[1] > 1500
    # A pixel's rounding moves places by centimetres.
    assert np.abs(pair[0] - pair[1]).mean() < 0.05


@pytest.mark.parametrize("view", VIEWS)
def test_the_same_place_is_white_in_every_picture_of_it(view):
    check_anchored(view)


def test_snow_that_drives_along_is_found(monkeypatch):
    wrong = with_geometry(along_0=lambda v: 0.0, left_0=lambda v: 0.0)
    monkeypatch.setattr(module, "geometry_of", wrong)
    with pytest.raises(AssertionError):
        check_anchored(VIEWS[0])


def moved(here, offset=(0.0, 0.0, 0.0), turn=None):
    """The same picture in other world axes: turned first, then moved."""
    turn = np.eye(3) if turn is None else turn
    pose = here.camera.world_from_camera.copy()
    pose[:3] = turn @ pose[:3]
    pose[:3, 3] += offset
    there = replace(
        here, ambience=replace(here.ambience, axes_world=here.ambience.axes_world @ turn.T)
    )
    camera = replace(here.camera, world_from_camera=pose)
    there.__dict__["frame"] = replace(here.frame, camera=camera)
    there.__dict__["camera"] = camera
    return there


def check_same(here, there, weather):
    assert (off(here.edited(weather), there.edited(weather)) <= 1).mean() > 0.999


@pytest.mark.parametrize("labelled", [True, False])
@pytest.mark.parametrize("periods", [(1, 0, 0), (-2, 3, 0), (900, -2000, 0)])
def test_the_noises_period_changes_nothing(periods, labelled):
    here = street(labelled=labelled)
    there = moved(here, PERIOD_M * np.array(periods, float))
    for name in ("puddles", "heavy snow"):
        check_same(here, there, WEATHERS[name])


def test_any_height_of_the_world_changes_nothing():
    check_same(street(), moved(street(), (0.0, 0.0, 417.0)), WEATHERS["puddles"])


def test_another_place_is_found():
    with pytest.raises(AssertionError):
        check_same(street(), moved(street(), (100.0, 0.0, 0.0)), WEATHERS["heavy snow"])


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_world_turned_gives_the_same_picture(axis):
    c, s = np.cos(0.7), np.sin(0.7)
    turn = np.roll(np.roll(np.array([[1, 0, 0], [0, c, -s], [0, s, c]]), axis, 0), axis, 1)
    here = street(place_m=(12.0, -0.5))
    for name in ("puddles", "heavy snow"):
        check_same(here, moved(here, turn=turn), WEATHERS[name])


def test_a_world_whose_axes_nobody_turned_is_found():
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    here = street(place_m=(12.0, -0.5))
    there = moved(here, turn=turn)
    there = replace(there, ambience=here.ambience)
    pose = turn @ here.camera.world_from_camera[:3]
    camera = replace(here.camera, world_from_camera=np.vstack([pose, [0, 0, 0, 1.0]]))
    there.__dict__["frame"] = replace(here.frame, camera=camera)
    with pytest.raises(AssertionError):
        check_same(here, there, WEATHERS["heavy snow"])


# Whatever comes.


def like(here, **parts):
    there = replace(here)
    there.__dict__["frame"] = replace(here.frame, **parts)
    return there


def filled(value, kind=np.float32, shape=(80, 128)):
    return np.full(shape, value, kind)


ODD = {
    "depth without end": lambda: like(street(), depth_m=filled(np.inf)),
    "depth without end, no label": lambda: like(street(labelled=False), depth_m=filled(np.inf)),
    "no depth that is one": lambda: like(street(), depth_m=filled(np.nan)),
    "depth 0": lambda: like(street(labelled=False), depth_m=filled(0.0)),
    "below the smallest": lambda: like(street(), depth_m=filled(1e-4)),
    "the largest half": lambda: like(street(), depth_m=filled(6e4, np.float16)),
    "all sky": lambda: like(street(), label=filled(SKY, np.uint8)),
    "no sky": lambda: like(street(), label=filled(ROAD, np.uint8)),
    "no ground": lambda: like(street(), label=filled(2, np.uint8)),
    "no label that is one": lambda: like(street(), label=filled(IGNORE, np.uint8)),
    "no such class": lambda: like(street(), label=filled(200, np.uint8)),
    "black": lambda: like(street(), image=filled(0, np.uint8, (80, 128, 3))),
    "white": lambda: like(street(), image=filled(255, np.uint8, (80, 128, 3))),
    "looks up": lambda: street(pitch_deg=20.0),
    "looks down": lambda: street(pitch_deg=-20.0),
    "rolled": lambda: street(roll_deg=10.0),
    "looks down and rolled, no label": lambda: Street(pitch_deg=-20, roll_deg=-10, labelled=False),
    "looks back": lambda: street(yaw_deg=180.0),
    "16 x 16": lambda: street(width=16, height=16, focal_px=12.0),
    "1 x 1": lambda: street(width=1, height=1, focal_px=1.0, pitch_deg=-20.0),
    "a row": lambda: street(width=40, height=1, focal_px=30.0, pitch_deg=-20.0),
    "a column": lambda: street(width=1, height=40, focal_px=30.0),
    "2 x 2, no label": lambda: street(width=2, height=2, focal_px=2.0, labelled=False),
    "cells larger than it is high": lambda: street(
        width=1400, height=3, focal_px=900.0, pitch_deg=-20.0
    ),
}


@pytest.mark.parametrize("name", ODD)
def test_any_picture_gets_its_weather(name):
    """No warning, no number that is none; and where nothing is left of the effects, the picture."""
    here = ODD[name]()
    assert np.isfinite(here.layers.maps).all()
    assert np.isfinite(here.layers.plane).all()
    for weather in (*WEATHERS.values(), ALL, replace(ALL, puddles=1.0, snow_depth_m=2.0)):
        image = here.edited(weather)
        assert image.shape == here.frame.image.shape
        np.testing.assert_array_equal(image, here.edited(weather))
    np.testing.assert_array_equal(here.frame.image, here.edited(ALL, without=EFFECTS))


def test_layers_of_steps_larger_than_the_picture():
    here = street()
    layers = plain_layers(here, step=300.0)
    for weather in WEATHERS.values():
        assert painted(here, layers, weather).shape == (80, 128, 3)


@pytest.mark.parametrize("roll_deg", [70.0, 180.0])
def test_a_picture_on_its_side_is_refused_by_name(roll_deg):
    with pytest.raises(CalibrationError, match="upright"):
        _ = Street(roll_deg=roll_deg).layers
