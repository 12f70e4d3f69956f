"""A render of the street's mirror image goes where the road mirrors it; faults are found."""

import cv2
import numpy as np
import pytest
from mirror_scene import SKY_LIGHT, Scene

from weather_aug.edit.physical import mirror_seen, relight
from weather_aug.edit.physical.layers import layers_of
from weather_aug.edit.physical.mirror import mirror_map, mirrored
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


@pytest.mark.parametrize("pitch_deg", [-12, -15])
def test_a_house_that_the_picture_cuts_ends_where_it_ends(pitch_deg):
    house = ("building", (8.0, 30.0), (-30.0, -3.0), (0.0, 4.0), (0.2, 0.3, 0.1))
    scene = Scene(pitch_deg, boxes=(house,))
    assert share_right(scene, scene.seen_in_the_road()) > 0.99
    assert share_right(scene, None) < 0.95


@pytest.mark.parametrize(
    "fault",
    [
        lambda seen: seen._replace(srgb=seen.srgb[::-1].copy(), opacity=seen.opacity[::-1].copy()),
        lambda seen: seen._replace(opacity=np.zeros_like(seen.opacity)),
        lambda seen: seen._replace(srgb=seen.srgb[:, ::-1].copy()),
    ],
    ids=["not turned over", "nothing seen", "left for right"],
)
def test_a_wrong_render_is_found(fault):
    scene = Scene(2)
    assert share_right(scene, fault(scene.seen_in_the_road())) < 0.9


def test_lines_are_sampled_where_they_lean():
    """Planted fault: columns for lines."""
    scene = Scene(0, 9)
    seen = scene.seen_in_the_road()
    right = share_right(scene, seen)
    upright = mirror_seen._rays_on_lines

    def on_columns(view, shape):
        rays, climb = upright(view, shape)
        columns = np.arange(shape[1], dtype=np.float32)
        rays[..., 0] = (columns - view.cx) / view.fx
        return rays, climb

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mirror_seen, "_rays_on_lines", on_columns)
        assert share_right(scene, seen) < right - 0.05


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
    """A wall of which the render knows nothing is no hole to the sky; open sky stays open."""
    wall = ("building", (20.0, 30.0), (-60.0, 4.0), (0.0, 4.0), (0.2, 0.3, 0.1))
    scene = Scene(boxes=(wall,))
    site, guessed = scene.site(), mirror_map(scene.site())
    empty = scene.seen_in_the_road()._replace(opacity=np.zeros(site.shape, np.float32))
    found, light = with_seen(site, NO_SUN, guessed, site.light, empty)
    kept = found.source >= 0
    assert kept[site.is_ground].mean() > 0.1
    assert (guessed.source[kept] >= 0).all()
    np.testing.assert_array_equal(
        light[kept], site.light.reshape(-1, 3)[guessed.source[kept]]
    )


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
    scene = Scene(4)
    site = scene.site()
    alone, with_render = layers_of(site), layers_of(site, None, scene.seen_in_the_road())
    np.testing.assert_array_equal(alone.maps[:12], with_render.maps[:12])
    assert (alone.maps[12:] != with_render.maps[12:]).any()
    nothing = scene.seen_in_the_road()._replace(srgb=np.zeros((180, 320, 3), np.float32))
    dark = layers_of(site, None, nothing)
    assert dark.maps[12:15].mean() < 0.8 * with_render.maps[12:15].mean()


def test_another_grid_is_refused():
    scene = Scene()
    seen = scene.seen_in_the_road()
    with pytest.raises(ArgumentError, match="small_camera"):
        layers_of(scene.site(), None, seen._replace(depth_m=seen.depth_m[1:]))
