"""A render of the street's mirror image goes where the road mirrors it; faults are found."""

import cv2
import numpy as np
import pytest
from mirror_scene import BOXES, SKY_LIGHT, Scene

from weather_aug.edit.physical import mirror_seen, relight
from weather_aug.edit.physical.layers import layers_of
from weather_aug.edit.physical.mirror import mirror_map, mirrored
from weather_aug.edit.physical.mirror_lines import ray_at
from weather_aug.edit.physical.mirror_seen import road_of, small_camera, with_seen
from weather_aug.errors import ArgumentError
from weather_aug.taxonomy import ROAD

TILTS = [(0, 0), (4, 0), (-3, 0), (0, 5), (3, -6)]
ALIKE = 0.02
NO_SUN = relight.Flattening(
    np.zeros((180, 320, 4), np.float32), np.zeros((180, 320, 2), np.float32), np.zeros(3, "f4")
)
"""So that light stays as it was recorded."""


def picture_of(scene, seen):
    site = scene.site()
    guessed = mirror_map(site)
    if seen is None:
        return mirrored(guessed, site.light, SKY_LIGHT, sharp_slope=0.0).sharp
    found, light = with_seen(site, NO_SUN, guessed, site.light, seen)
    return mirrored(found, light, SKY_LIGHT, sharp_slope=0.0).sharp


def share_right(scene, seen):
    """Share of the whole road, inside even regions, that mirrors what it should."""
    truth, _ = scene.mirrored()
    truth32, near = truth.astype(np.float32), np.ones((5, 5))
    even = (cv2.dilate(truth32, near) - cv2.erode(truth32, near)).max(-1) < ALIKE
    places = even & (scene.frame().label == ROAD)
    assert places.mean() > 0.04
    return (np.abs(picture_of(scene, seen) - truth).max(-1) < ALIKE)[places].mean()


@pytest.mark.parametrize(("pitch_deg", "roll_deg"), TILTS)
def test_the_road_mirrors_what_is_outside_the_picture_too(pitch_deg, roll_deg):
    scene = Scene(pitch_deg, roll_deg)
    assert share_right(scene, scene.seen_in_the_road()) > 0.99


HOUSE = ("building", (8.0, 30.0), (-30.0, -3.0), (0.0, 4.0), (0.2, 0.3, 0.1))
CUT = Scene(-14, 5, boxes=(HOUSE,))
"""The picture's upper border cuts a house that the road mirrors up to its roof, and the sky."""


def test_a_house_that_the_picture_cuts_ends_where_it_ends():
    assert share_right(CUT, CUT.seen_in_the_road()) > 0.99
    assert share_right(CUT, None) < 0.9


@pytest.mark.parametrize(
    "fault",
    [
        lambda seen: seen._replace(srgb=seen.srgb[::-1].copy(), opacity=seen.opacity[::-1].copy()),
        lambda seen: seen._replace(opacity=np.ones_like(seen.opacity)),
        lambda seen: seen._replace(srgb=seen.srgb[:, ::-1].copy(), opacity=seen.opacity[:, ::-1]),
    ],
    ids=["not turned over", "no sky", "left for right"],
)
def test_a_wrong_render_is_found(fault):
    assert share_right(CUT, fault(CUT.seen_in_the_road())) < 0.95


def test_lines_lean_as_the_kernels_lines_do():
    """And where they lean they are no columns."""
    view = mirror_map(CUT.site()).view
    rays, climb = mirror_seen._rays_on_lines(view, (180, 320))
    columns = (np.arange(320) - view.cx) / view.fx
    for row, line in ((10, 300), (90, 0), (170, 20), (179, 319)):
        x, y, up = ray_at(np.float32(row), np.float32(line), view)
        np.testing.assert_allclose([x, y, up], [*rays[row, line], climb[row, line]], atol=1e-5)
    assert np.abs(rays[170, :, 0] - columns).max() > 0.02


def test_the_picture_is_not_overruled_by_what_is_gone():
    """A car of another moment in the render, where the picture shows an open road."""
    here, then = Scene(boxes=BOXES[2:]), Scene(boxes=BOXES)
    assert share_right(here, then.seen_in_the_road()) > 0.97


def test_what_is_gone_is_found_by_looking_through_it(monkeypatch):
    """Planted fault: the picture is not asked."""
    here, then = Scene(boxes=BOXES[2:]), Scene(boxes=BOXES)
    monkeypatch.setattr(mirror_seen, "_seen_through", lambda site, *_: np.zeros(site.shape, bool))
    assert share_right(here, then.seen_in_the_road()) < 0.9


def test_the_way_before_the_road_is_a_share_of_all():
    wall = ("building", (20.0, 30.0), (-60.0, 60.0), (0.0, 40.0), (0.2, 0.3, 0.1))
    scene = Scene(boxes=(wall,))
    site = scene.site()
    found, _ = with_seen(site, NO_SUN, mirror_map(site), site.light, scene.seen_in_the_road())
    _, rays = scene.rays()
    rows = np.nonzero(site.is_ground[:, 160])[0][2:]
    to_road = 1.5 / -rays[rows, 160, 2]
    np.testing.assert_allclose(1 - to_road / 20.0, found.spread[rows, 160], atol=0.01)


def test_what_was_never_reconstructed_stays_as_the_picture_tells():
    """A render that knows nothing changes little: nothing goes on beyond the picture."""
    for scene in (Scene(), Scene(3, -6)):
        site, guessed = scene.site(), mirror_map(scene.site())
        seen = scene.seen_in_the_road()
        empty = seen._replace(opacity=np.zeros(site.shape, np.float32))
        found, light = with_seen(site, NO_SUN, guessed, site.light, empty)
        assert ((found.source >= 0) == (guessed.source >= 0))[site.is_ground].mean() > 0.95
        kept = found.source >= 0
        np.testing.assert_array_equal(light[kept], site.light.reshape(-1, 3)[guessed.source[kept]])


def test_the_small_camera_is_the_pictures_own():
    scene = Scene(3, -2, width=644, height=363)
    site = scene.site()
    camera = small_camera(site)
    assert (camera.height, camera.width) == site.shape
    place = scene.camera.centre_world + 10 * np.array([1.0, 0.2, 0.1])
    whole, small = (
        (c.intrinsics @ c.world_from_camera[:3, :3].T @ (place - c.centre_world))
        for c in (scene.camera, camera)
    )
    pixel, cell = whole[:2] / whole[2], small[:2] / small[2]
    np.testing.assert_allclose(pixel, (cell + 0.5) * site.step - 0.5, atol=1e-9)


def test_the_road_is_where_the_site_says():
    site = Scene().site()
    point, normal = road_of(site)
    np.testing.assert_allclose(normal, [0, 0, 1], atol=1e-3)
    assert abs(normal @ (site.origin - point) - 1.5) < 0.01


def test_layers_take_the_render():
    """The layers of the mirror, and no others."""
    site = CUT.site()
    alone, with_render = layers_of(site), layers_of(site, None, CUT.seen_in_the_road())
    np.testing.assert_array_equal(alone.maps[:12], with_render.maps[:12])
    assert (alone.maps[12:] != with_render.maps[12:]).any()
    assert with_render.maps[15].mean() > 1.1 * alone.maps[15].mean()


def test_another_grid_is_refused():
    scene = Scene()
    seen = scene.seen_in_the_road()
    with pytest.raises(ArgumentError, match="small_camera"):
        layers_of(scene.site(), None, seen._replace(depth_m=seen.depth_m[1:]))
