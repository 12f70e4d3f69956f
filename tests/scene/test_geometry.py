"""What a reconstructed drive knows of its street: reflections, surfaces, heights and covers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from tiny_reconstruction import (
    HALF_WIDTH_M,
    WALL_M,
    _sheet,
    camera_at,
    joined,
    tiny_reconstruction,
)

from weather_aug.clip.types import Camera, Frame, FrameKey
from weather_aug.edit.physical.mirror_seen import Seen, road_of, small_camera
from weather_aug.edit.physical.site import Site
from weather_aug.errors import ArgumentError
from weather_aug.gaussians.rasterise import rasterise
from weather_aug.gaussians.rotations import matrices_of, quaternions_of
from weather_aug.gaussians.types import Gaussians, Pinhole, Reconstruction
from weather_aug.scene import geometry
from weather_aug.scene.geometry import (
    Plane,
    height_map,
    mirrored,
    mirrored_camera,
    seen_in_road,
    shelter_from_gaussians,
    surfaces,
)
from weather_aug.taxonomy import BUILDING, ROAD, SKY, VEGETATION

Float64 = NDArray[np.float64]
ROAD_PLANE = Plane(np.zeros(3), np.array([0.0, 0.0, 1.0]))
TILTED = Plane(np.array([3.0, 1.0, -0.2]), np.array([0.06, -0.04, 1.0]) / np.sqrt(1.0052))
AXES = np.eye(3)


def tilted(camera: Camera) -> Camera:
    """Rolled, pitched, and with its horizon off the middle."""
    a, b = 0.06, -0.1
    roll = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    pitch = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    pose, intrinsics = camera.world_from_camera.copy(), camera.intrinsics.copy()
    pose[:3, :3] = pose[:3, :3] @ pitch @ roll
    intrinsics[1, 2] += 5.5
    return replace(camera, world_from_camera=pose, intrinsics=intrinsics)


def seen_at(camera: Camera, place: Float64) -> Float64:
    """Column, row and depth of a place."""
    local = camera.world_from_camera[:3, :3].T @ (place - camera.centre_world)
    return np.append((camera.intrinsics @ local)[:2] / local[2], local[2])


def reflected(places: Float64, plane: Plane) -> Float64:
    height = (places - plane.point_world) @ plane.normal_world
    return places - 2 * height[..., None] * plane.normal_world


def check_rows_turned(made: Callable[..., Camera], place: Float64) -> None:
    camera = tilted(camera_at(0.0))
    column, row, depth = seen_at(camera, reflected(place, TILTED))
    other = seen_at(made(camera, TILTED), place)
    np.testing.assert_allclose(other, [column, camera.height - 1 - row, depth], atol=1e-6)


@settings(max_examples=40)
@given(st.floats(5, 40), st.floats(-8, 8), st.floats(0.5, 9))
def test_the_mirrored_camera_sees_a_place_where_its_mirror_image_is(x: float, y: float, z: float):
    check_rows_turned(mirrored_camera, np.array([x, y, z]))


def _with_the_old_centre(camera: Camera, plane: Plane) -> Camera:
    return replace(mirrored_camera(camera, plane), intrinsics=camera.intrinsics)


def _as_if_level(camera: Camera, plane: Plane) -> Camera:
    level = Plane(plane.point_world, np.array([0.0, 0.0, 1.0]))
    return mirrored_camera(camera, level)


@pytest.mark.parametrize("fault", [_with_the_old_centre, _as_if_level])
def test_a_wrong_mirrored_camera_is_found(fault: Callable[..., Camera]) -> None:
    with pytest.raises(AssertionError):
        check_rows_turned(fault, np.array([12.0, 2.0, 3.0]))


def test_mirroring_twice_changes_nothing() -> None:
    camera = tilted(camera_at(2.0))
    back = Plane(TILTED.point_world, -TILTED.normal_world)
    twice = mirrored_camera(mirrored_camera(camera, TILTED), back)
    np.testing.assert_allclose(twice.world_from_camera, camera.world_from_camera, atol=1e-12)
    np.testing.assert_allclose(twice.intrinsics, camera.intrinsics, atol=1e-12)


def test_a_plane_over_the_camera_is_refused() -> None:
    with pytest.raises(ArgumentError, match="below the plane"):
        mirrored_camera(camera_at(0.0), Plane(np.array([0, 0, 2.0]), ROAD_PLANE.normal_world))
    with pytest.raises(ArgumentError, match="unit vector"):
        mirrored_camera(camera_at(0.0), Plane(np.zeros(3), np.array([0, 0, 2.0])))


def plain_mirror_image(scene: Reconstruction, camera: Camera, plane: Plane) -> Seen:
    """The Gaussians themselves mirrored, one by one, and seen by the camera as it stands."""
    part = scene.background
    kept = part.class_scores.argmax(axis=1) != ROAD
    means = part.means_m[kept].astype(np.float64)
    turn = np.eye(3) - 2 * np.outer(plane.normal_world, plane.normal_world)
    axes = turn @ matrices_of(torch.from_numpy(part.quaternions[kept].astype(np.float64))).numpy()
    # A Gaussian is the same with an axis turned about.
    axes[:, :, 2] *= -1
    from weather_aug.gaussians.harmonics import colours_seen

    colours = colours_seen(
        torch.from_numpy(part.sh[kept]),
        torch.from_numpy(part.means_m[kept]),
        torch.from_numpy(camera.centre_world.astype(np.float32)),
    )
    drawn = rasterise(
        torch.from_numpy(reflected(means, plane).astype(np.float32)),
        torch.from_numpy(np.stack([quaternions_of(a) for a in axes]).astype(np.float32)),
        torch.from_numpy(np.exp(part.log_scales[kept])),
        torch.sigmoid(torch.from_numpy(part.logit_opacities[kept])),
        colours,
        torch.from_numpy(np.linalg.inv(camera.world_from_camera).astype(np.float32)),
        Pinhole.of(camera),
    )
    opacity = drawn.opacity.numpy()
    srgb = drawn.colours.numpy() / np.maximum(opacity, 1e-6)[..., None]
    return Seen(np.clip(srgb, 0, 1), drawn.depth_m.numpy(), opacity)


def check_mirrored(render: Callable[..., Seen]) -> None:
    scene, camera = tiny_reconstruction(car=False), tilted(camera_at(1.0))
    plane = Plane(np.array([0.0, 0.0, -0.1]), TILTED.normal_world)
    expected = plain_mirror_image(scene, camera, plane)
    found = render(scene, camera, plane, 0.0)
    clear = expected.opacity > 0.05
    assert 0.2 < clear.mean() < 0.8
    np.testing.assert_allclose(expected.opacity, found.opacity, atol=2e-3)
    np.testing.assert_allclose(expected.srgb[clear], found.srgb[clear], atol=5e-3)
    np.testing.assert_allclose(expected.depth_m[clear], found.depth_m[clear], rtol=2e-3)


def test_the_mirrored_render_is_that_of_mirrored_gaussians(monkeypatch: pytest.MonkeyPatch) -> None:
    # Walls that a tilted plane cuts: what is below it is left out of both.
    monkeypatch.setattr(geometry, "stands_on", lambda g, *_: _no_road(g))
    check_mirrored(mirrored)


def _no_road(gathered: Any) -> NDArray[np.bool_]:
    return gathered.class_scores.numpy().argmax(axis=1) != ROAD


def _not_turned(*args: Any, **kwargs: Any) -> Seen:
    seen = mirrored(*args, **kwargs)
    return Seen(*(plane[::-1] for plane in seen))


def test_a_render_that_is_not_turned_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(geometry, "stands_on", lambda g, *_: _no_road(g))
    with pytest.raises(AssertionError):
        check_mirrored(_not_turned)


@pytest.mark.parametrize("labelled", [True, False])
def test_the_road_does_not_hide_what_it_mirrors(labelled: bool) -> None:
    scene, camera = tiny_reconstruction(), camera_at(0.0)
    if not labelled:
        scene = unlabelled(scene)
    seen = mirrored(scene, camera, ROAD_PLANE, 0.0)
    # Straight ahead the road mirrors the open sky, at the sides the walls, and the car's back.
    assert seen.opacity[38:44, 44:47].max() < 0.05
    assert seen.opacity[54:, :4].min() > 0.9
    assert np.abs(seen.srgb[56, 3] - (0.62, 0.42, 0.30)).max() < 0.15
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(geometry, "stands_on", lambda g, *_: np.ones(len(g.means_m), bool))
        hidden = mirrored(scene, camera, ROAD_PLANE, 0.0)
    assert hidden.opacity[38:44, 44:47].min() > 0.9


def unlabelled(scene: Reconstruction) -> Reconstruction:
    def bare(part: Gaussians) -> Gaussians:
        return replace(part, class_scores=part.class_scores[:, :0])

    return replace(
        scene,
        background=bare(scene.background),
        actor_gaussians=bare(scene.actor_gaussians),
        styles={},
    )


def frame_of(camera: Camera, key: FrameKey) -> Frame:
    label = np.full((camera.height, camera.width), SKY, np.uint8)
    label[camera.height // 2 :] = ROAD
    image = np.full((*label.shape, 3), 90, np.uint8)
    return Frame(key, 0.0, camera, image, label, np.full(label.shape, 20.0, np.float32))


def test_the_road_moves_along_with_a_refined_camera() -> None:
    """A frame's own road and pose, and a drive that was refined to lie elsewhere."""
    scene, key = tiny_reconstruction(car=False), FrameKey(0, "front")
    recorded = scene.cameras[key]
    shift = np.array([0.3, -0.2, 0.1])
    pose = recorded.world_from_camera.copy()
    pose[:3, 3] -= shift
    frame = frame_of(replace(recorded, world_from_camera=pose), key)
    site = Site(frame, AXES, 1.5, 1, frame.label, np.array([-0.1, 0.0, 0.0]))
    point, normal = road_of(site)
    assert abs(float(normal @ (site.origin - point)) - 1.5) < 1e-9
    found = seen_in_road(scene, site)
    expected = mirrored(scene, recorded, ROAD_PLANE, 0.0, key=key)
    np.testing.assert_allclose(expected.opacity, found.opacity, atol=1e-4)
    as_novel = seen_in_road(scene, site, novel=True)
    unmoved = mirrored(scene, small_camera(site), Plane(point, normal), 0.0)
    np.testing.assert_array_equal(unmoved.opacity, as_novel.opacity)
    assert np.abs(unmoved.opacity - expected.opacity).max() > 0.1


def test_exposures_are_applied() -> None:
    scene, key = tiny_reconstruction(), FrameKey(0, "front")
    half = {key: 0.5 * np.eye(3, 4, dtype=np.float32)}
    plain = mirrored(scene, scene.cameras[key], ROAD_PLANE, 0.0)
    dark = mirrored(replace(scene, exposures=half), scene.cameras[key], ROAD_PLANE, 0.0, key=key)
    np.testing.assert_allclose(0.5 * plain.srgb, dark.srgb, atol=1e-6)
    with pytest.raises(ArgumentError, match="no frame"):
        mirrored(scene, scene.cameras[key], ROAD_PLANE, 0.0, key=FrameKey(99, "front"))


def test_surfaces_are_where_they_are() -> None:
    depth, normals = surfaces(tiny_reconstruction(car=False), camera_at(0.0), 0.0)
    camera = camera_at(0.0)
    row = 50
    expected = 1.5 * camera.focal_px[1] / (row - camera.principal_px[1])
    assert depth[row, 48] == pytest.approx(expected, rel=0.08)
    np.testing.assert_allclose(normals[row, 48], [0, 0, 1], atol=0.05)
    np.testing.assert_allclose(normals[30, 2], [0, -1, 0], atol=0.05)
    assert np.isinf(depth[5, 48])
    assert (normals[5, 48] == 0).all()


def test_heights_of_walls_and_road() -> None:
    found = height_map(tiny_reconstruction(car=False), AXES)
    base = found.origin_m[2]
    along, left = ((np.array(found.top_m.shape)[k] * found.cell_m) for k in (0, 1))
    assert along == pytest.approx(42.0, abs=2.0)
    assert left == pytest.approx(2 * HALF_WIDTH_M, abs=2.0)

    def at(x: float, y: float) -> tuple[float, float]:
        i, j = np.floor((np.array([x, y]) - found.origin_m[:2]) / found.cell_m).astype(int)
        return float(found.top_m[i, j] + base), float(found.bottom_m[i, j] + base)

    np.testing.assert_allclose(at(10.0, 0.2), (0.0, 0.0), atol=0.05)
    top, bottom = at(10.0, HALF_WIDTH_M + 0.001)
    assert top == pytest.approx(WALL_M, abs=0.5)
    assert abs(bottom) < 0.5
    with pytest.raises(ArgumentError, match="no opaque"):
        height_map(see_through(tiny_reconstruction()), AXES)


def see_through(scene: Reconstruction) -> Reconstruction:
    faint = replace(scene.background, logit_opacities=np.full(len(scene.background), -2.0, "f4"))
    return replace(scene, background=faint)


def under(train_id: int, height_m: float = WALL_M) -> Reconstruction:
    """The street with a deck over it from x = 10 to 18."""
    scene = tiny_reconstruction(car=False, styles=())
    deck = _sheet(2, (height_m, (10.0, 18.0), (-HALF_WIDTH_M, HALF_WIDTH_M)), train_id, 0.5)
    whole = joined((scene.background, deck))
    return replace(scene, background=whole, support=np.full(len(whole), 50.0, np.float32))


@pytest.mark.parametrize("labelled", [True, False])
def test_a_deck_is_a_cover(labelled: bool) -> None:
    scene = under(BUILDING)
    shelter = shelter_from_gaussians(scene if labelled else unlabelled(scene), AXES)
    assert shelter is not None
    for x in (11.0, 14.0, 17.0):
        i, j = np.floor((np.array([x, 0.2]) - shelter.origin_m[:2]) / shelter.cell_m).astype(int)
        assert shelter.cover_m[i, j] + shelter.origin_m[2] == pytest.approx(WALL_M, abs=0.1)
    covered = np.argwhere(np.isfinite(shelter.cover_m)) * shelter.cell_m + shelter.origin_m[:2]
    assert covered[:, 0].min() >= 9.0
    assert covered[:, 0].max() <= 18.5


@pytest.mark.parametrize(
    "scene",
    [tiny_reconstruction(car=False), under(VEGETATION), under(BUILDING, 1.0)],
    ids=["walls only", "leaves", "lower than the camera"],
)
def test_nothing_else_is_a_cover(scene: Reconstruction) -> None:
    assert shelter_from_gaussians(scene, AXES) is None


def test_leaves_taken_for_covers_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("weather_aug.scene.shelter._COVERS", np.ones(256, bool))
    assert shelter_from_gaussians(under(VEGETATION), AXES) is not None
