"""The volume of shares: windows, depth order, what lies behind its range, drift, arguments."""

from dataclasses import replace

import numpy as np
import pytest
from render_scene import FORWARD, make_camera
from scipy.interpolate import interpn

from weather_aug._compiled import compiled
from weather_aug.air import Air
from weather_aug.errors import ArgumentError
from weather_aug.render.fog import fog_volume, fog_volume_of
from weather_aug.render.froxels import Z_FAR_M, even_fog, even_layer, share_row
from weather_aug.weather import Weather

WIDTH, HEIGHT = 96, 64


@compiled
def shares(volume, top, left, depth, out):
    nodes = np.empty(volume.share.shape[0] * volume.share.shape[2], np.float32)
    place = np.empty(depth.shape[1], np.uint32)
    for y in range(depth.shape[0]):
        share_row(volume, y + top, left, depth[y], nodes, place, out[y])


def looked_up(volume, depth, top=0, left=0):
    depth = np.ascontiguousarray(depth, np.float32)
    out = np.empty_like(depth)
    shares(volume, top, left, depth, out)
    return out


def tilted_camera(centre=(3.0, -2.0, 1.5)):
    camera = make_camera(WIDTH, HEIGHT)
    roll, pitch = 0.05, -0.1
    cr, sr, cp, sp = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch)
    turn = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1.0]]) @ np.array(
        [[1.0, 0, 0], [0, cp, -sp], [0, sp, cp]]
    )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = FORWARD @ turn, centre
    return replace(camera, world_from_camera=pose)


def volume_for(camera, window=None, **changes):
    arguments = {
        "fog_per_m": 0.03,
        "scale_height_m": 25.0,
        "patchiness": 0.6,
        "puff_share": 0.3,
        "seed": 5,
        "axes_world": np.eye(3),
        "drift_world_m": np.zeros(3),
    } | changes
    return fog_volume(camera, window or (0, 0, camera.height, camera.width), **arguments)


def rise_of(camera):
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    v, u = np.mgrid[: camera.height, : camera.width]
    up = camera.world_from_camera[2, :3]
    return up[0] * (u - cx) / fx + up[1] * (v - cy) / fy + up[2]


def even_depths(camera, z, scale_height_m):
    slopes = rise_of(camera) / scale_height_m
    return np.array([even_layer(float(z), float(s)) for s in slopes.ravel()]).reshape(slopes.shape)


@pytest.mark.parametrize("window", [(0, 0, 17, 31), (13, 40, 51, 56), (63, 95, 1, 1), (5, 4, 8, 8)])
def test_a_window_has_the_bits_of_the_whole(window):
    camera = tilted_camera()
    depth = np.random.default_rng(1).uniform(0.5, 400, (HEIGHT, WIDTH))
    depth[:8] = np.inf
    whole = looked_up(volume_for(camera), depth)
    top, left, rows, columns = window
    part = (slice(top, top + rows), slice(left, left + columns))
    volume = volume_for(camera, window)
    assert volume.share.size < volume_for(camera).share.size
    np.testing.assert_array_equal(whole[part], looked_up(volume, depth[part], top, left))


@pytest.mark.parametrize("scale_height_m", [np.inf, 25.0, 6.0])
def test_optical_depth_never_falls_with_depth(scale_height_m):
    camera = tilted_camera()
    volume = volume_for(
        camera, scale_height_m=scale_height_m, patchiness=1.0, puff_share=0.5, fog_per_m=0.02
    )
    before = np.zeros((HEIGHT, WIDTH))
    for z in np.geomspace(0.3, 3000, 160):
        share = looked_up(volume, np.full((HEIGHT, WIDTH), z))
        now = share * even_depths(camera, z, scale_height_m)
        above_ground = 1.5 + z * rise_of(camera) > -1.0
        # float32; and behind 160 m the layer's top is a chain of lines: 0.001 of optical depth.
        allowed_m = 2e-5 * z if np.isinf(scale_height_m) else 0.05
        assert (now - before)[above_ground].min() > -allowed_m
        before = now


def test_behind_the_volume_even_fog_is_added():
    """Homogeneous: what is surplus at 160 m stays surplus, however far the surface is."""
    camera = make_camera(WIDTH, HEIGHT)
    volume = volume_for(camera, scale_height_m=np.inf)
    surplus = [
        (looked_up(volume, np.full((HEIGHT, WIDTH), z)) - 1.0) * z
        for z in (np.nextafter(np.float32(Z_FAR_M), np.float32(0)), Z_FAR_M, 190, 700, 5000)
    ]
    assert np.abs(surplus[0]).max() > 3
    for other in surplus[1:]:
        np.testing.assert_allclose(surplus[0], other, atol=0.01)  # 1e-6 of 5000 m
    endless = looked_up(volume, np.full((HEIGHT, WIDTH), np.inf))
    np.testing.assert_allclose(1.0, endless, atol=1e-6)


def test_behind_the_volume_shallow_fog_keeps_its_surplus():
    """A ray that has left the layer meets nothing more: its share stays for ever."""
    camera = make_camera(WIDTH, HEIGHT)
    volume = volume_for(camera, scale_height_m=4.0, puff_share=0.0)
    top = slice(0, 12)
    at_range, endless = (
        looked_up(volume, np.full((HEIGHT, WIDTH), z))[top] for z in (Z_FAR_M, np.inf)
    )
    assert np.abs(at_range - 1).max() > 0.1
    np.testing.assert_allclose(at_range, endless, atol=1e-4)


def test_nearly_even_fog_has_the_share_one():
    volume = volume_for(tilted_camera(), patchiness=1e-9, puff_share=0.0)
    np.testing.assert_allclose(1.0, volume.share, atol=1e-4)  # float32 exponential


def test_even_fog_and_no_fog_need_no_volume():
    camera = make_camera(WIDTH, HEIGHT)
    assert len(volume_for(camera, patchiness=0.0, puff_share=0.0).share) == 0
    assert len(volume_for(camera, fog_per_m=0.0).share) == 0


def test_a_weathers_fog_rides_on_its_air():
    """Street axes into world axes: a quarter turn, and the drift along the street is along y."""
    camera = tilted_camera()
    window = (0, 0, HEIGHT, WIDTH)
    axes = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    air = Air(wind_m_per_s=(0.0, 0.0, 0.0), drift_m=(7.3, -2.1, 0.4), wet_s=0.0)
    weather = Weather(visibility_m=90.0, fog_scale_height_m=25.0, fog_patchiness=0.6, fog_puffs=0.3)
    found = fog_volume_of(weather, camera, window, 5, air, axes)
    expected = volume_for(
        camera,
        fog_per_m=weather.fog_per_m,
        axes_world=axes,
        drift_world_m=np.array([2.1, 7.3, 0.4]),
    )
    np.testing.assert_array_equal(expected.share, found.share)
    even = replace(weather, fog_patchiness=0.0, fog_puffs=0.0)
    assert fog_volume_of(even, camera, window, 5, air, axes) is even_fog()


def interpolated(volume, depth):
    """The shares of a whole picture by scipy: linear in row, in column and in 1 / depth."""
    rows, columns = np.indices(depth.shape) * float(volume.nodes_per_px)
    nearness = np.minimum(1 / depth, volume.inverse_depth[0])
    nodes = (-volume.inverse_depth, *(np.arange(count) for count in volume.share.shape[1:]))
    return interpn(nodes, volume.share, np.stack([-nearness, rows, columns], axis=-1))


def test_shares_are_interpolated_between_the_nodes():
    volume = volume_for(tilted_camera())
    depth = np.random.default_rng(2).uniform(0.5, 400, (HEIGHT, WIDTH)).astype(np.float32)
    found = looked_up(volume, depth)
    np.testing.assert_allclose(interpolated(volume, depth), found, atol=1e-5)


def test_the_fog_rides_on_the_wind():
    """A camera carried with the air sees the same fog; one that stands still does not."""
    drift = np.array([7.3, -2.1, 0.4])
    here = volume_for(tilted_camera(), scale_height_m=np.inf)
    carried = tilted_camera(centre=np.array([3.0, -2.0, 1.5]) + drift)
    there = volume_for(carried, scale_height_m=np.inf, drift_world_m=drift)
    np.testing.assert_allclose(here.share, there.share, atol=2e-5)
    stays = volume_for(tilted_camera(), scale_height_m=np.inf, drift_world_m=drift)
    assert np.abs(here.share - stays.share).max() > 0.1


def test_the_fog_moves_without_jumps():
    """Twenty times less wind, twenty times less change; a re-drawn cell would not obey."""
    camera = tilted_camera()
    start = np.array([19.9, 31.9, 3.9])
    base = volume_for(camera, drift_world_m=start)
    changes = [
        np.abs(
            volume_for(camera, drift_world_m=start + step_m * np.array([1.0, 0.3, 0.1])).share
            - base.share
        ).max()
        for step_m in (0.2, 0.01)
    ]
    assert 0 < changes[1] < changes[0] / 10


def test_seeds_differ_and_repeat():
    camera = tilted_camera()
    first, again, other = (volume_for(camera, seed=s).share for s in (5, 5, 6))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.1


def test_resolution_does_not_change_the_fog():
    camera = make_camera(640, 384)
    fine = volume_for(camera).share
    coarse = volume_for(camera.resized(320, 192)).share
    np.testing.assert_allclose(fine[:, :20, :30], coarse[:, :20, :30], atol=0.02)  # half a pixel


@pytest.mark.parametrize(
    ("name", "value"),
    [("patchiness", 1.5), ("puff_share", 0.6), ("fog_per_m", -1.0), ("patchiness", np.nan)],
)
def test_bad_numbers_are_named(name, value):
    with pytest.raises(ArgumentError, match=name):
        volume_for(make_camera(WIDTH, HEIGHT), **{name: value})
