"""The physical editor's promises; each check is also shown a planted fault that breaks it."""

from dataclasses import replace

import numpy as np
import pytest
from edit_scene import (
    ALL,
    BOXES,
    CAMERA_HEIGHT_M,
    EFFECTS,
    WEATHERS,
    Street,
    off,
    painted,
    plain_layers,
    street,
    with_geometry,
    with_layers,
    with_material,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import reference_edit as reference

from weather_aug.edit.physical import edit as module
from weather_aug.edit.physical.dress import dress
from weather_aug.edit.physical.edit import edited
from weather_aug.edit.physical.look import look_of
from weather_aug.edit.physical.materials import COVER, material_table
from weather_aug.taxonomy import ROAD, TRAIN_ID
from weather_aug.weather import Weather

# The reference.


def check_reference(name, labelled):
    here = street(labelled=labelled)
    expected = reference.edited(here.frame, here.layers, WEATHERS[name], here.ambience)
    assert (off(expected, here.edited(WEATHERS[name])) <= 1).mean() >= 0.999


@pytest.mark.parametrize("labelled", [True, False])
@pytest.mark.parametrize("name", WEATHERS)
def test_it_is_the_float64_editor(name, labelled):
    check_reference(name, labelled)


@pytest.mark.parametrize("without", [(), *((effect,) for effect in EFFECTS)])
def test_it_is_the_float64_editor_without_an_effect(without):
    here = street()
    expected = reference.edited(here.frame, here.layers, ALL, here.ambience, without)
    assert (off(expected, here.edited(ALL, without=without)) <= 1).mean() >= 0.999


def _with_look(**changes):
    def wrong(*args):
        found = look_of(*args)
        return found._replace(**{k: np.float32(f(getattr(found, k))) for k, f in changes.items()})

    return wrong


TONE_TABLES = module.tone_tables
FAULTS = {
    "more of the road flooded": ("wet", "look_of", _with_look(flooded=lambda v: v + 0.1)),
    "half the film": ("wet", "look_of", _with_look(film=lambda v: 0.8 * v)),
    "another exposure": ("overcast", "look_of", _with_look(exposure=lambda v: 1.05 * v)),
    "fewer puddles": ("puddles", "look_of", _with_look(puddles=lambda v: 0.7 * v)),
    "no tracks": ("heavy snow", "look_of", _with_look(tracks=lambda v: 0.0)),
    "half a crown's snow": (
        "heavy snow",
        "material_table",
        with_material("vegetation", cover=0.4),
    ),
    "dry pavements": ("wet", "material_table", with_material("sidewalk", mirror=0.0)),
    "a metre aside": ("heavy snow", "geometry_of", with_geometry(left_0=lambda v: v + 1)),
    "half a pixel up": ("puddles", "geometry_of", with_geometry(cy=lambda v: v + 2)),
    "no tone": ("overcast", "tone_tables", lambda overcast: TONE_TABLES(0.0)),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_the_reference_finds(monkeypatch, fault):
    name, function, wrong = FAULTS[fault]
    monkeypatch.setattr(module, function, wrong)
    with pytest.raises(AssertionError):
        check_reference(name, True)


# Windows, purity, types.


def windows(height, width):
    def inside(corner):
        top, left = corner
        return st.tuples(
            st.just(top), st.just(left), st.integers(1, height - top), st.integers(1, width - left)
        )

    return st.tuples(st.integers(0, height - 1), st.integers(0, width - 1)).flatmap(inside)


def check_window(here, weather, window):
    top, left, height, width = window
    whole = here.edited(weather)[top : top + height, left : left + width]
    np.testing.assert_array_equal(whole, here.edited(weather, window))


COARSE = {"width": 460, "height": 40, "focal_px": 350.0}
"""Its small grid has cells of 2 x 2 pixels."""


@settings(max_examples=40, deadline=None)
@given(windows(80, 128), st.sampled_from(sorted(WEATHERS)), st.booleans())
def test_any_window_is_the_same_pixels(window, name, labelled):
    check_window(street(labelled=labelled), WEATHERS[name], window)


@settings(max_examples=20, deadline=None)
@given(windows(40, 460), st.sampled_from(sorted(WEATHERS)))
def test_any_window_is_the_same_pixels_on_a_coarse_grid(window, name):
    check_window(street(**COARSE), WEATHERS[name], window)


def test_single_pixels_are_the_same():
    here = street(**COARSE)
    whole = here.edited(ALL)
    for y, x in [(0, 0), (39, 459), (17, 33), (18, 34), (39, 0), (25, 201)]:
        np.testing.assert_array_equal(whole[y, x], here.edited(ALL, (y, x, 1, 1))[0, 0])


def test_maps_cut_too_narrow_are_found(monkeypatch):
    def narrow(layer, window, step):
        cut = layer.copy()
        cut[: int(window[0] / step) + 1] = 0.0
        return cut

    monkeypatch.setattr(module, "dress", with_layers("illumination", narrow))
    with pytest.raises(AssertionError):
        check_window(street(**COARSE), ALL, (21, 5, 9, 100))


@pytest.mark.parametrize("name", ["building", "car"])
def test_a_window_below_the_edge_of_something_near_is_the_same_pixels(name):
    box = (name, (4.0, 9.0), (-1.0, 1.0), (0.0, 1.2))
    here = street(width=64, height=700, focal_px=1500.0, boxes=(box,))
    for top in range(480, 620, 7):
        check_window(here, Weather(snow_cover=1.0, snow_depth_m=0.5), (top, 0, 1, 64))


@pytest.mark.parametrize("labelled", [True, False])
def test_inputs_stay_as_they_are_and_may_be_written_or_not(labelled):
    here = street(labelled=labelled)
    frame, layers = here.frame, here.layers
    arrays = {"image": frame.image, "label": frame.label, "depth_m": frame.depth_m}
    copies = {k: None if v is None else v.copy() for k, v in arrays.items()}
    own = replace(layers, classes=layers.classes.copy(), tint=layers.tint.copy())
    window = (0, 0, 80, 128)
    before = len(dress.signatures)
    written = edited(replace(frame, **copies), own, ALL, here.ambience, window)
    np.testing.assert_array_equal(here.edited(ALL), written)
    for name, copy in copies.items():
        if copy is not None:
            np.testing.assert_array_equal(arrays[name], copy)
    np.testing.assert_array_equal(layers.classes, own.classes)
    # Once compiled for all of them.
    assert len(dress.signatures) == max(before, 1)


def test_it_is_repeatable():
    np.testing.assert_array_equal(street().edited(ALL), Street().edited(ALL))


@pytest.mark.parametrize("name", WEATHERS)
def test_half_precision_depth_is_the_same_picture(name):
    pictures = [street(depth_type=kind).edited(WEATHERS[name]) for kind in (np.float32, np.float16)]
    assert (off(*pictures) <= 4).mean() > 0.97
    assert off(*pictures).mean() < 1.0


# Off by name.

CHANGED = {
    "mirror": ("road", "sidewalk"),
    "puddles": ("road",),
    "ripples": ("road", "sidewalk"),
    "tracks": ("road",),
}
"""Where alone leaving an effect out may change anything."""
EVERYWHERE = ("relight", "sky", "film", "snow_cover")


NEAR = {"pitch_deg": -45.0, "focal_px": 200.0, "boxes": ()}
"""So near that the rings of drops are seen."""


def check_left_out(here, effect):
    changed = off(here.edited(ALL), here.edited(ALL, without=(effect,))) > 0
    assert changed.sum() > 50
    if effect in CHANGED:
        kinds = [TRAIN_ID[name] for name in CHANGED[effect]]
        assert not changed[~np.isin(here.layers.classes, kinds)].any()


@pytest.mark.parametrize("effect", (*CHANGED, *EVERYWHERE))
def test_each_effect_can_be_left_out(effect):
    check_left_out(street(**NEAR) if effect == "ripples" else street(), effect)


def test_a_name_that_is_not_heard_is_found(monkeypatch):
    monkeypatch.setattr(module, "look_of", lambda *args: look_of(*args[:4], ()))
    for effect in CHANGED:
        with pytest.raises(AssertionError):
            check_left_out(street(**NEAR) if effect == "ripples" else street(), effect)


def test_an_effect_that_reaches_too_far_is_found(monkeypatch):
    def far(*args):
        found = look_of(*args)
        return found._replace(exposure=np.float32(1.1)) if "mirror" in args[-1] else found

    monkeypatch.setattr(module, "look_of", far)
    with pytest.raises(AssertionError):
        check_left_out(street(), "mirror")


TWINS = {
    ("sky", "relight"): {"overcast": 0.0},
    ("snow_cover",): {"snow_cover": 0.0, "road_snow_cover": 0.0, "snow_depth_m": 0.0},
    ("puddles",): {"puddles": 0.0},
}


@pytest.mark.parametrize("without", TWINS)
def test_left_out_is_as_if_the_weather_had_none(without):
    none = replace(ALL, **TWINS[without])
    np.testing.assert_array_equal(street().edited(none), street().edited(ALL, without=without))


def check_identity(here, weather, without=()):
    np.testing.assert_array_equal(here.frame.image, here.edited(weather, without=without))


@pytest.mark.parametrize("labelled", [True, False])
def test_nothing_changes_nothing(labelled):
    here = street(labelled=labelled)
    check_identity(here, Weather())
    check_identity(here, ALL, EFFECTS)
    for kind in (Weather.rain, Weather.snow, Weather.fog):
        check_identity(here, kind(0.0))
    check_identity(here, Weather(rain_mm_per_h=40.0, visibility_m=80.0, snow_mm_per_h=2.0))


def test_every_level_of_every_channel_comes_back():
    ramp = np.arange(256, dtype=np.uint8)
    image = np.stack([ramp, ramp[::-1], np.roll(ramp, 77)], -1)[None].repeat(2, axis=0)
    here = Street(256, 2, 200.0)
    here.__dict__["frame"] = replace(here.frame, image=image)
    np.testing.assert_array_equal(image, painted(here, plain_layers(here), Weather()))


def test_a_tone_left_on_is_found(monkeypatch):
    monkeypatch.setattr(module, "tone_tables", lambda overcast: TONE_TABLES(max(overcast, 0.1)))
    with pytest.raises(AssertionError):
        check_identity(street(), Weather())


# Continuity.

STATES = (
    *("overcast", "wetness", "puddles", "snow_cover", "road_snow_cover", "snow_depth_m"),
    "rain_mm_per_h",
)


def check_continuous(here, base, name, step=1e-3):
    """A thousandth more is less than a fifth of a level on the mean, and no jump but of a few.

    The few are pixels at the foot of walls, that snow buries when it gets deeper.
    """
    value = getattr(base, name)
    near = replace(base, **{name: value + (step if value < 0.5 or name[:4] == "rain" else -step)})
    difference = off(here.edited(base), here.edited(near))
    assert difference.mean() < 0.2
    assert (difference > 3).mean() < 5e-4


BASES = {"some of all": ALL, "all of all": replace(ALL, wetness=1.0, overcast=1.0, snow_cover=1.0)}


@pytest.mark.parametrize("name", STATES)
@pytest.mark.parametrize("base", BASES)
def test_small_changes_are_small(base, name):
    check_continuous(street(), BASES[base], name)


@pytest.mark.parametrize("name", [name for name in STATES if name != "snow_cover"])
def test_the_first_of_it_is_little(name):
    check_continuous(street(), Weather(), name)


def test_the_first_snow_is_little():
    check_continuous(street(), Weather(), "snow_cover")


def test_a_switch_is_found(monkeypatch):
    def switching(*args):
        found = look_of(*args)
        return found._replace(puddles=np.float32(round(float(found.puddles), 1)))

    monkeypatch.setattr(module, "look_of", switching)
    with pytest.raises(AssertionError):
        check_continuous(street(), replace(ALL, puddles=0.2495), "puddles")


def test_the_scene_is_what_it_says():
    """The street shows all that the checks speak of."""
    kinds = {name for name, *_ in BOXES} | {"road", "sidewalk", "terrain", "sky"}
    assert {TRAIN_ID[name] for name in kinds} == set(np.unique(street().frame.label))
    assert street().camera.centre_world[2] == CAMERA_HEIGHT_M
    assert material_table(labelled=True)[ROAD, COVER] == 1.0
