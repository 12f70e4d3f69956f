"""Lamps of vehicles: whose are on, what is seen of them, and what light they add."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from render_scene import make_camera

from weather_aug.colour import LUMINANCE
from weather_aug.edit.physical.vehicles import Vehicle
from weather_aug.errors import ArgumentError
from weather_aug.render import lamp_light, lamps
from weather_aug.render.lamp_light import add_lamps
from weather_aug.render.lamps import lamps_of, seen_lamps

UP = np.array([0.0, 0.0, 1.0])
WIDTH, HEIGHT = 320, 192
AIRLIGHT = np.full(3, 0.6)


def vehicle(ahead=20.0, left=0.0, *, comes=True, parked=False, key=1):
    heading = np.array([-1.0 if comes else 1.0, 0.0, 0.0])
    centre = np.array([ahead, left, 0.0])
    return Vehicle("car", centre, heading, (4.4, 1.8, 1.5), 10 * heading, parked, key)


def seen(*vehicles, camera=None, depth=None, tau_per_m=0.0, wetness=0.0):
    camera = camera or make_camera(WIDTH, HEIGHT)
    depth = np.full((camera.height, camera.width), np.inf, np.float32) if depth is None else depth
    return seen_lamps(
        lamps_of(vehicles, 1.0, 0, UP),
        camera,
        depth,
        extinction_per_m=tau_per_m,
        wetness=wetness,
        airlight=AIRLIGHT,
        camera_height_m=1.5,
    )


def picture(grey=90):
    noise = np.random.default_rng(0).integers(-20, 20, (HEIGHT, WIDTH, 3))
    return (grey + noise).astype(np.uint8)


def added(lamps_seen, window=(0, 0, HEIGHT, WIDTH)):
    """(H, W, 3) linear light, before the sensor clips it."""
    light = np.zeros((*window[2:], 3), np.float32)
    for lamp in lamps_seen:
        lamp_light._shine(lamp, window, lamp_light._DECAY, light)
    return light


ALL = (0, 0, HEIGHT, WIDTH)
CROWD = [vehicle(key=key) for key in range(60)]


# Whose lamps are on


def nested(low, high, seed):
    """Whether who drives with lamps on at a share still does at a greater one."""
    few, more = ({id(owner) for owner in _owners(share, seed)} for share in (low, high))
    return few <= more


def _owners(share, seed):
    return [v for v in CROWD if lamps_of((v,), share, seed, UP)]


@given(low=st.floats(0, 1), high=st.floats(0, 1), seed=st.integers(-5, 5))
def test_a_greater_share_adds_vehicles(low, high, seed):
    assert nested(min(low, high), max(low, high), seed)


def test_a_share_of_the_crowd_and_other_seeds_draw_others():
    assert len(_owners(0.0, 1)) == 0 and len(_owners(1.0, 1)) == 60
    assert 18 <= len(_owners(0.5, 1)) <= 42
    assert [v.key for v in _owners(0.5, 1)] != [v.key for v in _owners(0.5, 2)]
    assert lamps_of((vehicle(parked=True),), 1.0, 1, UP) == ()


def test_a_stream_would_not_nest(monkeypatch):
    stream = np.random.default_rng(3)
    monkeypatch.setattr(lamps, "uniforms", lambda key, count: stream.random(count))
    assert not nested(0.5, 0.6, 1)


def test_lamps_are_two_and_two_at_the_corners():
    found = lamps_of((vehicle(20.0, comes=False),), 1.0, 0, UP)
    places = np.array([lamp.position_world for lamp in found])
    np.testing.assert_allclose(places[:2], [[22.2, 0.62, 0.65], [22.2, -0.62, 0.65]])
    np.testing.assert_allclose(places[2:], [[17.8, 0.62, 0.85], [17.8, -0.62, 0.85]])
    for lamp in found:
        assert lamp.colour @ LUMINANCE == pytest.approx(1.0)
    red, _, blue = found[2].colour
    assert red > 20 * blue


# What is seen of them


def test_only_the_side_that_faces_the_camera_shines():
    comes, goes = seen(vehicle(comes=True)), seen(vehicle(comes=False))
    assert len(comes) == len(goes) == 2
    assert comes[0].red < 1.2 < 4 < goes[0].red
    assert comes[0].core > 10 * goes[0].core
    assert seen(vehicle(-20.0, comes=True)) == ()


def test_what_is_nearer_hides_a_lamp():
    depth = np.full((HEIGHT, WIDTH), 17.8, np.float32)
    clear = seen(vehicle())[0].core
    for ahead, share in ((17.8, 1.0), (17.4, 1.0), (16.0, 0.0), (5.0, 0.0)):
        found = seen(vehicle(), depth=np.full_like(depth, ahead))
        assert (found[0].core if found else 0.0) == pytest.approx(share * clear, rel=1e-5)
    half = depth.copy()
    u = seen(vehicle())[0].u
    half[:, : round(float(u))] = 5.0
    assert 0.2 * clear < seen(vehicle(), depth=half)[0].core < 0.9 * clear


def test_half_precision_and_unknown_depth_hide_nothing():
    clear = [tuple(lamp) for lamp in seen(vehicle())]
    depth = np.full((HEIGHT, WIDTH), 17.8, np.float16)
    assert [tuple(lamp) for lamp in seen(vehicle(), depth=depth)] == clear
    assert [tuple(lamp) for lamp in seen(vehicle(), depth=0 * depth)] == clear


@given(ahead=st.floats(6, 90), tau_per_m=st.floats(0, 0.2))
def test_fog_takes_the_disc_and_gives_less_back(ahead, tau_per_m):
    camera = make_camera(WIDTH, HEIGHT)
    clear, foggy = seen(vehicle(ahead))[0], seen(vehicle(ahead), tau_per_m=tau_per_m)
    distance = math.dist(
        camera.centre_world, lamps_of((vehicle(ahead),), 1, 0, UP)[0].position_world
    )
    direct = math.exp(-min(tau_per_m * distance, 20))
    total = clear.core + clear.glow
    if not foggy:
        # No pixel would show it.
        assert direct * total < 0.01
        return
    assert foggy[0].core == pytest.approx(direct * clear.core, rel=1e-4)
    assert foggy[0].core + foggy[0].glow + foggy[0].halo <= total * (1 + 1e-5)
    assert foggy[0].halo >= 0 and clear.halo == 0
    assert foggy[0].halo_radius_px >= clear.halo_radius_px
    for thicker in seen(vehicle(ahead), tau_per_m=tau_per_m + 0.01)[:1]:
        assert thicker.halo_radius_px > foggy[0].halo_radius_px


def test_a_lamp_beside_the_recorded_one_fades():
    """A tail lamp 5 m ahead has vanished, one 10 m ahead is half as bright as it would be."""
    found = [seen(vehicle(ahead + 2.2, comes=False)) for ahead in (5.0, 10.0, 14.0)]
    assert found[0] == ()
    light = [lamps_seen[0].core * d * d for lamps_seen, d in zip(found[1:], (10, 14), strict=True)]
    assert 0.2 < light[0] / light[1] < 0.6


def test_the_light_is_the_lamps_illuminance():
    """I / d^2 lux over the solid angle of a pixel and the luminance of white."""
    camera = make_camera(WIDTH, HEIGHT)
    (lamp, *_) = seen(vehicle(40.0), camera=camera)
    place = lamps_of((vehicle(40.0),), 1, 0, UP)[0].position_world
    lux = lamps.HEAD_LAMP_CD / float(((place - camera.centre_world) ** 2).sum())
    expected = lux * 240.0**2 * 0.6 / lamps.HORIZON_CD_PER_M2
    light = added([lamp]) @ LUMINANCE
    # What the reach cuts from the glow's tail is missing.
    assert light.sum() == pytest.approx(expected, rel=0.02)


def test_a_disc_is_as_wide_as_the_lamp():
    camera = make_camera(4 * WIDTH, 4 * HEIGHT)
    lamp = seen(vehicle(12.0), camera=camera)[0]
    radius = 0.5 * lamps.LAMP_DIAMETER_M * 960 / 9.8
    assert lamp.variance_px2 == pytest.approx(radius**2 / 4 + lamps.LENS_SIGMA_PX**2, rel=1e-3)


# What is drawn


def test_halo_and_glow_end_without_an_edge():
    lamp = seen(vehicle(12.0), tau_per_m=0.1)[0]._replace(u=np.float32(150), v=np.float32(90))
    wide = np.float32(8.0)
    lamp = lamp._replace(reach_px=5 * wide, halo_radius_px=wide, glow_radius_px=wide)
    light = added([lamp])[..., 0]
    row = light[90, 150:]
    assert (np.diff(row) <= 1e-6).all()
    assert row[39] > 0 and (row[40:] == 0).all()
    # The last step, to nothing, is no greater than those before it.
    steps = -np.diff(row)
    assert steps[39] <= 1.01 * steps[38] < 0.01 * row[10]


def windows_agree(image, lamps_seen, ground, cut=lambda lamps_seen, window: lamps_seen):
    whole = add_lamps(image, lamps_seen, window=ALL, ground=ground)
    for window in ((0, 0, 100, 155), (77, 140, 80, 31), (100, 3, 92, 317), (80, 161, 1, 1)):
        top, left, rows, columns = window
        part = (slice(top, top + rows), slice(left, left + columns))
        drawn = add_lamps(image[part], cut(lamps_seen, window), window=window, ground=ground[part])
        if drawn.tobytes() != np.ascontiguousarray(whole[part]).tobytes():
            return False
    return True


def test_a_windows_pixels_are_those_of_the_whole():
    image = picture()
    ground = np.zeros((HEIGHT, WIDTH), bool)
    ground[100:, 10:300] = True
    found = seen(
        *(vehicle(8.0 + 9 * n, 2.0 * n - 3, comes=n % 2 == 0, key=n) for n in range(4)),
        tau_per_m=0.03,
        wetness=1.0,
    )
    assert len(found) >= 6
    assert windows_agree(image, found, ground)

    def inside(lamps_seen, window):
        """A fault: a lamp outside the window shines into it all the same."""
        top, left, rows, columns = window
        return [
            lamp
            for lamp in lamps_seen
            if top <= lamp.v < top + rows and left <= lamp.u < left + columns
        ]

    assert not windows_agree(image, found, ground, inside)


def test_nothing_is_changed_where_no_light_falls():
    image = picture()
    before = image.tobytes()
    assert add_lamps(image, (), window=ALL, ground=None).tobytes() == before
    lit = add_lamps(image, seen(vehicle()), window=ALL, ground=None)
    assert image.tobytes() == before
    assert (lit >= image).all() and (lit != image).any()
    far = seen(vehicle(20.0))[0]
    outside = np.hypot(*np.meshgrid(np.arange(WIDTH) - far.u, np.arange(HEIGHT) - far.v)) > 150
    assert (lit[outside] == image[outside]).all()


def test_a_head_lamp_is_a_small_white_disc():
    lit = add_lamps(picture(), seen(vehicle(20.0)), window=ALL, ground=None)
    lamp = seen(vehicle(20.0))[0]
    u, v = round(float(lamp.u)), round(float(lamp.v))
    assert (lit[v, u] >= 250).all()
    white = (lit.min(axis=2) >= 250).sum()
    assert 2 * 3 <= white <= 2 * 60
    fog = add_lamps(picture(170), seen(vehicle(30.0), tau_per_m=0.03), window=ALL, ground=None)
    assert (fog.min(axis=2) >= 250).sum() <= 2 * 40


# The wet road


def test_a_streak_lies_below_the_lamp_on_wet_ground_only():
    image = np.full((HEIGHT, WIDTH, 3), 60, np.uint8)
    ground = np.zeros((HEIGHT, WIDTH), np.uint8)
    ground[:, 150:] = 1
    dry, wet = seen(vehicle(15.0, 1.0)), seen(vehicle(15.0, 1.0), wetness=1.0)
    assert [lamp.streak for lamp in dry] == [0.0, 0.0]
    plain = add_lamps(image, dry, window=ALL, ground=ground)
    assert (add_lamps(image, wet, window=ALL, ground=None) == plain).all()
    mirrored = add_lamps(image, wet, window=ALL, ground=ground).astype(int) - plain
    assert (mirrored >= 0).all()
    rows, columns = np.nonzero(mirrored.max(axis=2))
    assert columns.min() >= 150 and rows.min() >= int(min(lamp.foot_v for lamp in wet)) - 1
    for lamp in wet:
        # The camera is 1.5 m and the mirrored lamp 0.65 m off the road, 12.8 m away.
        assert lamp.mirror_v == pytest.approx(95.5 + 240 * 2.15 / 12.8, abs=1e-3)
        assert lamp.foot_v == pytest.approx(95.5 + 240 * 1.5 / 12.8, abs=1e-3)
        assert lamp.mirror_u == pytest.approx(lamp.u, abs=1e-3)
        assert lamp.streak_v_px > 3 * lamp.streak_u_px
    half = seen(vehicle(15.0, 1.0), wetness=0.5)
    assert half[0].streak == pytest.approx(0.5 * wet[0].streak)


def test_bad_arguments_are_refused_by_name():
    camera = make_camera(WIDTH, HEIGHT)
    for share in (-0.1, 1.1, math.nan):
        with pytest.raises(ArgumentError, match="share"):
            lamps_of(CROWD, share, 0, UP)
    with pytest.raises(ArgumentError, match="seed"):
        lamps_of(CROWD, 1.0, 0.5, UP)
    with pytest.raises(ArgumentError, match="depth_m"):
        seen(vehicle(), camera=camera, depth=np.ones((3, 3), np.float32))
    with pytest.raises(ArgumentError, match="extinction_per_m"):
        seen(vehicle(), tau_per_m=-1.0)
    with pytest.raises(ArgumentError, match="wetness"):
        seen(vehicle(), wetness=2.0)
    with pytest.raises(ArgumentError, match="window"):
        add_lamps(picture(), (), window=(0, 0, 3, 3), ground=None)
    with pytest.raises(ArgumentError, match="ground"):
        add_lamps(picture(), (), window=ALL, ground=np.ones((3, 3), bool))
    with pytest.raises(ArgumentError, match="ground must be"):
        add_lamps(picture(), (), window=ALL, ground=np.ones((HEIGHT, WIDTH)))


def test_a_turned_camera_sees_the_same_lamps():
    """A rotation of the world moves nothing on the picture."""
    turn = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
    camera = make_camera(WIDTH, HEIGHT)
    pose = camera.world_from_camera.copy()
    pose[:3] = turn @ pose[:3]
    car = vehicle(18.0, 1.5)
    moved = replace(
        car, centre_world=turn @ car.centre_world, heading_world=turn @ car.heading_world
    )
    here = seen(car, wetness=0.7, tau_per_m=0.01)
    there = seen(moved, camera=replace(camera, world_from_camera=pose), wetness=0.7, tau_per_m=0.01)
    np.testing.assert_allclose(np.array(here), np.array(there), rtol=1e-4)
