"""What is stored of a frame: names in their places, finite, repeatable, and nothing changed."""

from dataclasses import replace

import numpy as np
import pytest
from edit_scene import CAMERA_HEIGHT_M, Street, flat_street

from weather_aug.colour import linear_from_srgb
from weather_aug.edit.physical import layers, smear
from weather_aug.edit.physical.layers import NAMES, layers_of
from weather_aug.edit.physical.mirror_lines import View
from weather_aug.edit.physical.relight import DARK
from weather_aug.edit.physical.site import site_of

AXES = np.eye(3)
PLACES = {
    "GROUND_GAIN": "ground_slope",
    "OBJECT_GAIN": "object_slope",
    "MATTE": "matte_slope",
    "ILLUMINATION": "illumination",
    "LUMINANCE_MEAN": "luminance",
    "FACING_UP": "facing_up",
    "LATERAL_M": "lateral_m",
    "SHARP": "sharp_red",
    "ROUGH": "rough_red",
}


def of(frame):
    return layers_of(site_of(frame, AXES, CAMERA_HEIGHT_M))


def by_name(found):
    return dict(zip(NAMES, found.maps.astype(float), strict=True))


def test_names_are_where_the_kernels_look():
    assert {name: NAMES[getattr(layers, name)] for name in PLACES} == PLACES


@pytest.mark.parametrize("labelled", [True, False])
@pytest.mark.parametrize("depth_type", [np.float16, np.float32])
def test_maps_are_finite_half_precision_and_cannot_be_written(labelled, depth_type):
    street = Street(labelled=labelled, depth_type=depth_type)
    found = street.layers
    assert found.maps.dtype == np.float16
    assert found.maps.shape == (len(NAMES), street.height, street.width)
    assert np.isfinite(found.maps).all()
    assert not found.maps.flags.writeable
    assert found.classes.shape == (street.height, street.width)
    assert np.isfinite(found.tint).all()


def test_looking_twice_sees_the_same():
    one, other = (of(Street().frame) for _ in range(2))
    np.testing.assert_array_equal(one.maps, other.maps)
    np.testing.assert_array_equal(one.tint, other.tint)
    np.testing.assert_array_equal(one.plane, other.plane)


def check_illumination(frame, level, function=of):
    """Under even light a grey road of albedo 0.12 tells how bright white is, to a hundredth."""
    # Logarithms are of light with DARK added, which is left in.
    expected = (linear_from_srgb(np.array(level / 255)) + DARK) / 0.12
    found = function(frame)
    assert abs(found.illumination / expected - 1) < 0.01
    np.testing.assert_allclose(by_name(found)["illumination"], expected, rtol=0.02)


@pytest.mark.parametrize("level", [60, 96, 140])
def test_the_road_tells_the_light(level):
    check_illumination(flat_street(level).frame, level)


def test_light_told_by_the_sky_is_found():
    frame = flat_street(96).frame
    with pytest.raises(AssertionError):
        check_illumination(replace(frame, label=np.full_like(frame.label, 10)), 96)


def test_a_flat_empty_road_mirrors_the_sky_alone():
    maps = by_name(flat_street(96).layers)
    below = np.s_[100:, 10:-10]
    for kind in ("sharp", "rough"):
        for colour in ("red", "green", "blue"):
            assert np.abs(maps[f"{kind}_{colour}"][below]).max() < 0.01
        assert (maps[f"{kind}_sky"][below] > 0.99).all()


def test_a_wall_hides_the_sky_from_the_road():
    wall = ("wall", (12.0, 13.0), (-30.0, 30.0), (0.0, 30.0))
    street = Street(256, 160, 200.0, boxes=(wall,))
    sky = by_name(street.layers)["sharp_sky"]
    foot = np.flatnonzero(street.frame.label[:, 128] == 3).max()
    assert sky[foot + 3, 128] < 0.05


def test_even_light_has_no_shadow_to_give_back():
    maps = by_name(flat_street(96).layers)
    for name in ("ground_slope", "ground_offset", "ground_least", "ground_most"):
        assert np.abs(maps[name]).max() < 0.02


def test_a_cast_shadow_is_given_back():
    street = Street(256, 160, 200.0, boxes=(), road_half_m=1e4)
    maps = by_name(street.layers)
    shade = street.frame.image[..., 1] < 65
    shade &= street.frame.label == 0
    assert shade.sum() > 300
    assert np.median(maps["ground_most"][shade]) > 0.6 * np.log(1 / 0.55**2.2)


def test_nothing_given_is_changed():
    frame = Street().frame
    before = [array.copy() for array in (frame.image, frame.label, frame.depth_m)]
    of(frame)
    for old, new in zip(before, (frame.image, frame.label, frame.depth_m), strict=True):
        np.testing.assert_array_equal(old, new)


def test_a_driven_way_moves_the_tracks_alone():
    site = site_of(Street().frame, AXES, CAMERA_HEIGHT_M)
    ahead = layers_of(site)
    aside = layers_of(site, np.array([[0.0, 1.5], [20.0, 1.5]]))
    different = {
        name
        for name, one, other in zip(NAMES, ahead.maps, aside.maps, strict=True)
        if not np.array_equal(one, other)
    }
    assert different == {"lateral_m"}


def test_smears_fill_all_they_are_given_where_no_ray_goes_down():
    height, width = 3, 4
    up = View(*(np.float32(v) for v in (4.0, 4.0, 1.5, 9.0, 0.0, -1.0, 0.0, 1.5)))
    out = np.full((height, width, 3), np.nan, np.float32)
    ends, twice = np.zeros((width, 4)), np.zeros((height + 1, width, 4))
    smear.smear(ends, twice, np.ones((height, width), np.float32), up, np.float32(0.1), out)
    assert np.isfinite(out).all()


def test_a_single_row_of_ground_is_enough_to_look_at():
    street = Street(64, 40, 60.0)
    label = np.full((40, 64), 2, np.uint8)
    label[39] = 0
    of(replace(street.frame, label=label))
