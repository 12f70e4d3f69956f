"""How much water and snow lies on which surfaces; each check is also shown a planted fault."""

from dataclasses import replace

import numpy as np
import pytest
from edit_scene import (
    DEEP,
    Street,
    flat_street,
    light,
    painted,
    plain_layers,
    points_of,
    street,
    with_layers,
    with_material,
)
from oracles import reference_edit as reference

from weather_aug.colour import SRGB_LEVELS_LINEAR
from weather_aug.edit.physical import edit as module
from weather_aug.edit.physical import look as look_module
from weather_aug.edit.physical.edit import edited
from weather_aug.edit.physical.ground_rows import covered
from weather_aug.edit.physical.materials import MATERIALS
from weather_aug.edit.physical.noise import PERIOD_M
from weather_aug.taxonomy import IGNORE, ROAD, SKY, TERRAIN, TRAIN_ID
from weather_aug.weather import Weather

# How much is covered.

SHARE_VIEW = {"width": 24, "height": 96, "focal_px": 120.0}
RANGES_M = {"near": (3.7, 8.0), "mid": (8.0, 16.0), "far": (16.0, 24.0)}
ASKED = (0.1, 0.25, 0.5, 0.75, 0.9)
PLACES = 18
"""Along and left, over the noise's period: its patches are up to 60 m large."""


def everywhere(here, layers, pairs, count):
    """Linear light (places, pairs, H, W) of green from a grid of places.

    Pairs are a weather and the effects left out.
    """
    pose, found = here.camera.world_from_camera.copy(), []
    for i in range(count):
        for j in range(count):
            pose[:2, 3] = (i + 0.37 * j / count) * PERIOD_M / count, j * PERIOD_M / count
            frame = replace(here.frame, camera=replace(here.camera, world_from_camera=pose))
            window = (0, 0, here.height, here.width)
            found.append(
                [
                    light(edited(frame, layers, weather, here.ambience, window, without))[..., 1]
                    for weather, without in pairs
                ]
            )
    return np.array(found)


def shares(here, layers, weather_of, amount, without=(), count=PLACES):
    """(places, H, W) how far each pixel is covered, between no cover and all of it."""
    bare = (*without, "tracks")
    pairs = [(weather_of(0.0), bare), (weather_of(amount), without), (weather_of(1.0), bare)]
    none, some, all_ = np.moveaxis(everywhere(here, layers, pairs, count), 1, 0)
    span = all_ - none
    return (some - none) / np.where(np.abs(span) > 0.02, span, np.nan)


def check_share(amount, weather_of, tolerance=0.03, without=("tracks",), **maps):
    here = flat_street(100, **SHARE_VIEW)
    layers = plain_layers(here, **maps)
    found = shares(here, layers, weather_of, amount, without)
    for low, high in RANGES_M.values():
        band = (here.frame.depth_m > low) & (here.frame.depth_m < high)
        assert abs(np.nanmean(found[:, band]) - amount) < tolerance


def snowed(amount):
    return Weather(road_snow_cover=amount)


def puddled(amount):
    return Weather(wetness=1.0, puddles=amount)


@pytest.mark.parametrize("amount", ASKED)
def test_snow_covers_as_much_of_the_road_as_was_asked(amount):
    # Far pixels average the noise towards 1/2, where nearly all of it is covered.
    check_share(amount, snowed, tolerance=0.03 if amount < 0.9 else 0.04)


@pytest.mark.parametrize("amount", [0.15, 0.5])
def test_puddles_cover_as_much_of_the_road_as_was_asked(amount):
    check_share(amount, puddled)


def test_more_snow_than_asked_is_found():
    with pytest.raises(AssertionError):
        check_share(0.5, lambda amount: snowed(1.15 * amount if amount < 1 else 1.0))


@pytest.mark.parametrize("fuzz", [0.07, 0.2, 0.5])
@pytest.mark.parametrize("amount", ASKED)
def test_the_threshold_is_the_share_of_even_noise(amount, fuzz):
    noise = (np.arange(400, dtype=np.float32) + 0.5) / 400
    found = [covered(np.float32(amount), np.float32(fuzz), value) for value in noise]
    assert abs(np.mean(found) - amount) < 0.01


# Wheel tracks.


def profile(without=()):
    """Mean cover by metres left of the way, 5 cm apart from -5.25 to 5.25."""
    here = flat_street(100, width=192, height=48, focal_px=60.0, pitch_deg=-25)
    layers = here.layers
    found = shares(here, layers, lambda a: Weather(road_snow_cover=a), 0.7, without, 8)
    points = points_of(here.frame)
    near = here.frame.depth_m < 8.0
    bins = np.round(points[..., 1][near] / 0.15).astype(int)
    cover = np.nanmean(found[:, near], axis=0)
    return {k * 0.15: cover[bins == k].mean() for k in range(-35, 36) if (bins == k).any()}


def tracks_of(cover, middle):
    """Metres left of a lane's middle of its two tracks' own middles, and their barest cover."""
    whole, found = np.median(list(cover.values())), []
    for low, high in ((-1.4, 0.0), (0.0, 1.4)):
        place, here = np.array(
            [(x - middle, v) for x, v in cover.items() if low <= x - middle <= high]
        ).T
        found.append((np.average(place, weights=np.maximum(whole - here, 1e-6)), here.min()))
    return found


def check_tracks(without=()):
    """Two in each lane where the wheels run, bare, and less so where few drive."""
    cover = profile(without)
    between = np.median(list(cover.values()))
    own = tracks_of(cover, 0.0)
    for (place, bare), wheel in zip(own, (-0.75, 0.75), strict=True):
        assert abs(place - wheel) < 0.1
        assert bare < 0.2 * between
    for lane in (-3.5, 3.5):
        for (place, bare), wheel in zip(tracks_of(cover, lane), (-0.75, 0.75), strict=True):
            assert abs(place - wheel) < 0.15
            assert own[0][1] < bare < 0.8 * between


def test_wheels_keep_two_tracks_of_each_lane_bare():
    check_tracks()


def test_a_road_without_tracks_is_found():
    with pytest.raises(AssertionError):
        check_tracks(("tracks",))


def test_tracks_of_another_gauge_are_found(monkeypatch):
    wider = with_layers("lateral_m", lambda layer, *_: layer * np.float16(0.7))
    monkeypatch.setattr(module, "dress", wider)
    with pytest.raises(AssertionError):
        check_tracks()


# What lies where.


def check_caps(name="car"):
    """Snow lies on a thing's upper edge, as high as its cap, and nowhere else on it."""
    box = (name, (6.0, 9.0), (-1.5, 1.5), (0.0, 1.4))
    here = Street(160, 200, 250.0, boxes=(box,), pitch_deg=-8)
    layers = plain_layers(here)
    pair = (painted(here, layers, Weather(snow_cover=s)) for s in (1e-9, 1.0))
    before, after = (light(p)[..., 1] for p in pair)
    brighter = after > before * 0.85 + 0.03
    up = points_of(here.frame)[..., 2]
    thing = here.frame.label == TRAIN_ID[name]
    face = thing & (np.abs(here.frame.depth_m - 6.0) < 0.2) & (up < 1.35)
    most = 1.2 * 1.4 * MATERIALS[name].cap_m + 0.05
    assert brighter[thing].sum() > 50
    assert not brighter[face & (up < 1.4 - most)].any()


@pytest.mark.parametrize("name", ["car", "wall", "building"])
def test_caps_lie_on_upper_edges_alone(name):
    # The roof that the camera looks down on is level; its map is left 0 here.
    check_caps(name)


def test_snow_on_a_cars_side_is_found(monkeypatch):
    monkeypatch.setattr(module, "material_table", with_material("car", cap_m=0.6))
    with pytest.raises(AssertionError):
        check_caps()


def check_bare(kinds):
    """Under deep snow they only come out darker, because the camera exposes for the snow."""
    here = street()
    without = ("relight", "sky", "film", "mirror")
    image = here.edited(DEEP, without=without)
    expected = light(here.frame.image) * (1 - look_module.SNOW_EXPOSURE_LOSS)
    bare = np.isin(here.frame.label, kinds)
    assert bare.sum() > 100
    assert np.abs(light(image) - expected)[bare].max() < 0.01


PEOPLE = (TRAIN_ID["person"], TRAIN_ID["rider"])


@pytest.mark.parametrize("kinds", [PEOPLE, (SKY,)], ids=["people", "sky"])
def test_no_snow_lies_on(kinds):
    check_bare(kinds)


def test_snowmen_are_found(monkeypatch):
    wrong = with_material("person", cover=0.5, cap_m=0.2)
    monkeypatch.setattr(module, "material_table", wrong)
    with pytest.raises(AssertionError):
        check_bare(PEOPLE)


def test_the_label_decides_what_snow_lies_on():
    """The same pixels, called grass, turn white; called sky or nothing, they do not."""
    here = street()
    patch = np.s_[60:70, 40:80]
    seen = {}
    for kind in (TERRAIN, SKY, IGNORE, PEOPLE[0]):
        label = here.frame.label.copy()
        label[patch] = kind
        frame = replace(here.frame, label=label)
        layers = replace(here.layers, classes=label)
        seen[kind] = edited(frame, layers, DEEP, here.ambience, (0, 0, 80, 128), ("relight",))
    assert light(seen[TERRAIN][patch]).min() > 0.3
    for kind in (SKY, IGNORE, PEOPLE[0]):
        assert light(seen[kind][patch]).max() < 0.2


@pytest.mark.parametrize("amount", [0.0, 1.0])
def test_road_and_verge_have_snow_of_their_own(amount):
    here = street(boxes=())
    weather = Weather(snow_cover=1.0 - amount, road_snow_cover=amount)
    image = light(here.edited(weather, without=("tracks",)))
    near = here.frame.depth_m < 15
    white = {k: (image[(here.frame.label == k) & near] > 0.3).mean() for k in (ROAD, TERRAIN)}
    assert white[ROAD] == pytest.approx(amount, abs=0.02)
    assert white[TERRAIN] == pytest.approx(1.0 - amount, abs=0.02)


# Films.

FILM_LEVEL = 250


def film_error(illumination, wetness=1.0):
    """Relative, of the light that a wet road sends back, against Lekner and Dorf's."""
    here = flat_street(FILM_LEVEL, **SHARE_VIEW)
    layers = plain_layers(here, illumination=illumination)
    image = painted(here, layers, Weather(wetness=wetness), without=("mirror",))
    bare = SRGB_LEVELS_LINEAR[FILM_LEVEL]
    ratio = 1 + wetness * (reference.film_ratio(bare / np.float16(illumination)) - 1)
    exposed = 1 + look_module.WET_EXPOSURE * wetness
    return light(image[-1, 12]).mean() / (bare * ratio * exposed) - 1


@pytest.mark.parametrize("illumination", [1.5, 3.0])
def test_a_film_darkens_by_lekner_and_dorf(illumination):
    assert abs(film_error(illumination)) < 0.01


@pytest.mark.parametrize("illumination", [1.5, 3.0, 8.0])
def test_it_does_so_where_the_exposure_is_kept(monkeypatch, illumination):
    monkeypatch.setattr(look_module, "WET_EXPOSURE", 0.0)
    for wetness in (0.3, 1.0):
        assert abs(film_error(illumination, wetness)) < 0.01


def test_light_cut_at_the_pictures_white_is_found(monkeypatch):
    """A white surface in the sun is brighter than a picture can be."""
    monkeypatch.setattr(look_module, "WET_EXPOSURE", 0.0)
    cut = with_layers("illumination", lambda layer, *_: np.minimum(layer, np.float16(1.0)))
    monkeypatch.setattr(module, "dress", cut)
    assert abs(film_error(3.0)) > 0.01
