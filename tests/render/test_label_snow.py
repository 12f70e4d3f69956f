"""Buried borders and covered signs: where, how wide, in any window, and as the editor paints it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from render_scene import make_camera, make_frame

from weather_aug.render import label_snow
from weather_aug.render.compose import render
from weather_aug.render.label_snow import (
    buried_borders,
    covered_faces,
    mean_cover,
    snow_limits,
)
from weather_aug.render.options import DEFAULT_OPTIONS, RenderOptions
from weather_aug.taxonomy import CLASSES, IGNORE, ROAD, SIDEWALK, SKY, TERRAIN, TRAIN_ID
from weather_aug.weather import Weather

CAR, SIGN, LIGHT = (TRAIN_ID[name] for name in ("car", "traffic sign", "traffic light"))
DEEP = Weather(snow_cover=1.0, road_snow_cover=1.0, snow_depth_m=0.2)
WIDTH, HEIGHT = 320, 200
CAMERA_M, FOCAL_PX = 1.5, 240.0
KERB_M = 2.0


def street(gap_px=0):
    """Flat ground seen level from 1.5 m: road, and left of a kerb 2 m to the side a sidewalk."""
    camera = make_camera(WIDTH, HEIGHT, FOCAL_PX)
    label = np.full((HEIGHT, WIDTH), SKY, np.uint8)
    depth = np.full((HEIGHT, WIDTH), np.inf, np.float32)
    rows = np.arange(HEIGHT // 2 + 5, HEIGHT)
    depth[rows] = (CAMERA_M * FOCAL_PX / (rows - (HEIGHT - 1) / 2))[:, None]
    left_m = depth * ((WIDTH - 1) / 2 - np.arange(WIDTH)) / FOCAL_PX
    ground = np.isfinite(depth)
    label[ground] = ROAD
    label[ground & (left_m > KERB_M)] = SIDEWALK
    for row in rows:
        edge = int((label[row] == SIDEWALK).sum())
        label[row, edge : edge + gap_px] = IGNORE
    return make_frame(camera, 90, depth, label)


def limits(weather=DEEP, options=DEFAULT_OPTIONS):
    return snow_limits(weather, options)


def band(frame, weather=DEEP):
    return buried_borders(frame, (0, 0, HEIGHT, WIDTH), limits(weather)) == 1


def check_width(found):
    """A quarter of a metre to each side of the kerb, and never less than four pixels."""
    frame = street()
    # The kerb crosses rows aslant: four pixels across it are more along a row.
    least_px = 4.0 * np.hypot(1.0, KERB_M / CAMERA_M)
    for row in range(110, HEIGHT, 6):
        z = float(frame.depth_m[row, 0])
        expected = max(least_px, 0.25 * FOCAL_PX / z)
        for kind in (ROAD, SIDEWALK):
            assert expected == pytest.approx((found & (frame.label == kind))[row].sum(), abs=1.6)


def test_the_band_is_a_quarter_of_a_metre_and_at_least_four_pixels():
    found = band(street())
    check_width(found)
    assert not found[street().label == SKY].any()


@pytest.mark.parametrize(("name", "value"), [("BAND_M", 0.5), ("BAND_M", 0.0), ("BAND_PX", 8)])
def test_other_widths_are_found_out(monkeypatch, name, value):
    monkeypatch.setattr(label_snow, name, value)
    for kernel in ("_stamp", "_band"):
        monkeypatch.setattr(label_snow, kernel, getattr(label_snow, kernel).py_func)
    with np.errstate(invalid="ignore"), pytest.raises(AssertionError):
        check_width(band(street()))


def test_an_unlabelled_line_between_two_grounds_is_a_border():
    """CamVid's kerbs are often void."""
    frame = street(gap_px=3)
    found = band(frame)
    for kind in (ROAD, SIDEWALK):
        assert found[frame.label == kind].any()
    assert not found[frame.label == IGNORE].any()
    assert not band(street(gap_px=9)).any()


@pytest.mark.parametrize(
    "weather",
    [
        Weather(snow_cover=1.0, road_snow_cover=0.8, snow_depth_m=0.2),  # the road shows
        Weather(snow_cover=0.8, road_snow_cover=1.0, snow_depth_m=0.2),  # the sidewalk shows
        Weather(snow_cover=1.0, road_snow_cover=1.0, snow_depth_m=0.03),  # kerbs stick out
        Weather.rain("extreme"),
    ],
)
def test_borders_that_can_be_seen_stay(weather):
    frame, found = street(), limits(weather)
    assert found is None or not buried_borders(frame, (0, 0, HEIGHT, WIDTH), found).any()


def test_without_snow_on_the_picture_nothing_is_buried():
    assert limits(options=RenderOptions(without=("snow_cover",))) is None
    assert limits(Weather()) is None


def test_mean_cover_is_that_of_the_materials():
    weather = Weather(snow_cover=0.9, road_snow_cover=0.4)
    assert mean_cover(ROAD, weather) == 0.4
    assert mean_cover(TERRAIN, weather) == 0.9
    assert mean_cover(SIDEWALK, weather) == pytest.approx(0.9 * 0.97)


def test_a_render_keeps_each_side_and_ignores_the_band(ambience):
    frame = street()
    frame.label[150:170, 20:60] = CAR
    shot = render(frame, DEEP, seed=1, ambience=ambience)
    lost = band(frame)
    np.testing.assert_array_equal(lost, shot.label == IGNORE)
    np.testing.assert_array_equal(frame.label[~lost], shot.label[~lost])
    np.testing.assert_array_equal(lost, shot.invalid == 1)
    assert (shot.label[150:170, 20:60] == CAR).all()
    np.testing.assert_array_equal(frame.label, shot.label_full)
    kept = render(frame, DEEP, seed=1, ambience=ambience, options=RenderOptions(labels="acdc"))
    np.testing.assert_array_equal(frame.label, kept.label)
    np.testing.assert_array_equal(lost, kept.invalid == 1)


@given(seed=st.integers(0, 2**32 - 1))
def test_bands_and_faces_of_any_window(seed):
    rng = np.random.default_rng(seed)
    label = rng.choice([ROAD, SIDEWALK, TERRAIN, CAR, SIGN, LIGHT, IGNORE], (30, 20))
    label = label.astype(np.uint8).repeat(6, 0).repeat(9, 1)
    depth = rng.uniform(0.5, 30, label.shape)
    depth = np.where(
        rng.random(label.shape) < 0.9, depth[::6, ::9].repeat(6, 0).repeat(9, 1), depth
    )
    frame = make_frame(make_camera(180, 180, 150.0), 90, depth, label)
    top, left = (int(v) for v in rng.integers(0, 180, 2))
    height, width = int(rng.integers(1, 181 - top)), int(rng.integers(1, 181 - left))
    for find in (buried_borders, covered_faces):
        whole = find(frame, (0, 0, 180, 180), limits())
        part = find(frame, (top, left, height, width), limits())
        np.testing.assert_array_equal(whole[top : top + height, left : left + width], part)


def check_margin():
    """A band 64 pixels wide reaches into a window that starts 60 pixels from its border."""
    label = np.full((100, 300), ROAD, np.uint8)
    label[:, :150] = SIDEWALK
    frame = make_frame(make_camera(300, 100, 600.0), 90, 1.5, label)
    part = buried_borders(frame, (0, 210, 100, 10), limits())
    assert part[:, :5].all()
    assert not part[:, 5:].any()


def test_a_wide_band_reaches_into_a_window():
    check_margin()


def test_a_window_without_its_surroundings_is_found_out(monkeypatch):
    around = label_snow._around
    monkeypatch.setattr(
        label_snow, "_around", lambda frame, window, margin: around(frame, window, 8)
    )
    with pytest.raises(AssertionError):
        check_margin()


def sign(kind=SIGN, depth_m=6.0):
    """A sign 20 pixels tall before a wall far behind it, of any colour."""
    label = np.full((120, 160), TRAIN_ID["building"], np.uint8)
    depth = np.full((120, 160), 40.0, np.float32)
    label[40:80, 60:100], depth[40:80, 60:100] = kind, depth_m
    return make_frame(make_camera(160, 120, 480.0), (60, 20, 20), depth, label)


def check_faces(kind):
    """Invalid are the rows of a sign that the editor paints white."""
    frame = sign(kind)
    weather = Weather(snow_cover=1.0, snow_depth_m=0.2)
    found = covered_faces(frame, (0, 0, 120, 160), snow_limits(weather, DEFAULT_OPTIONS)) == 1
    share = found[40:80, 60:100].mean(axis=0)
    assert 0.1 < share.mean() < 0.9
    assert not np.delete(found, np.s_[60:100], 1).any()
    return frame, weather, found


@pytest.mark.parametrize("kind", [SIGN, LIGHT])
def test_faces_under_snow_are_invalid_and_keep_their_class(kind, ambience):
    frame, weather, found = check_faces(kind)
    options = RenderOptions(without=("noise", "glare", "compression", "exposure"))
    shot = render(frame, weather, seed=1, ambience=ambience, options=options)
    np.testing.assert_array_equal(frame.label, shot.label)
    np.testing.assert_array_equal(found, shot.invalid == 1)
    red, green = (shot.image[40:80, 60:100, c].astype(int) for c in (0, 1))
    white = red - green < 0.3 * (red - green).max()
    # The editor's caps follow its noise, these their mean.
    assert found[40:80, 60:100].mean() == pytest.approx(white.mean(), rel=0.25)


def test_other_things_have_no_faces():
    for name in set(CLASSES) - {"traffic sign", "traffic light"}:
        with pytest.raises(AssertionError):
            check_faces(TRAIN_ID[name])


def test_what_stands_behind_something_nearer_has_no_cap():
    frame = sign()
    frame.depth_m[:40] = 3.0
    assert not covered_faces(frame, (0, 0, 120, 160), limits()).any()
