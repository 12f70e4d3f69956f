"""The cube map of the sky: its layout, its colours and gradients, and what frames tell of it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from weather_aug.clip.types import Camera, Frame, FrameKey
from weather_aug.errors import ArgumentError
from weather_aug.gaussians import cube, sky_kernels
from weather_aug.gaussians import sky as module
from weather_aug.gaussians.cube import on_face, places_of, table_of, texel_directions, texels_of
from weather_aug.gaussians.sky import SkyMap, sky_colours, sky_picture, sky_seen
from weather_aug.gaussians.types import Pinhole, Sky
from weather_aug.taxonomy import TRAIN_ID

Float64 = NDArray[np.float64]
AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""World (x ahead, z up) from a camera that looks along x."""


def colour_of(directions: Float64) -> Float64:
    """A smooth sky without symmetries, in 0.1..0.9."""
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    mixed = unit @ np.array([[1.2, 0.3, -0.5], [0.1, -1.0, 0.8], [-0.6, 0.9, 1.1]])
    return np.asarray(0.5 + 0.4 * np.sin(mixed + np.array([0.3, 1.1, -0.7])))


def sky_of(size: int) -> Sky:
    faces = colour_of(texel_directions(size).astype(np.float64)).astype(np.float32)
    return Sky(faces, np.ones((6, size, size), bool))


def noisy(size: int = 8, seed: int = 0) -> SkyMap:
    sky = SkyMap(size)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        sky.faces.copy_(torch.rand(sky.faces.shape, generator=generator))
    return sky


def directions_of(count: int, seed: int = 0) -> Float64:
    return np.random.default_rng(seed).normal(size=(count, 3))


def posed(seed: int) -> Float64:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    pose[:3, 3] = (10.0, -4.0, 2.0)
    return pose


@pytest.mark.parametrize(
    ("face", "first", "last"),
    [
        (0, (1, 1, 1), (1, -1, -1)),
        (1, (-1, 1, -1), (-1, -1, 1)),
        (2, (-1, 1, -1), (1, 1, 1)),
        (3, (-1, -1, 1), (1, -1, -1)),
        (4, (-1, 1, 1), (1, -1, 1)),
        (5, (1, 1, -1), (-1, -1, -1)),
    ],
)
def test_faces_lie_as_opengls_do(face: int, first: tuple[int, ...], last: tuple[int, ...]) -> None:
    """Upper left and lower right corners, by hand from OpenGL 4.6, table 8.19."""
    far = texel_directions(512)[face]
    np.testing.assert_allclose(first, far[0, 0], atol=4e-3)
    np.testing.assert_allclose(last, far[-1, -1], atol=4e-3)
    sky = Sky(np.zeros((6, 4, 4, 3), np.float32), np.zeros((6, 4, 4), bool))
    sky.faces[face, 0, 0] = 1.0
    corner = 0.75 * np.array(first, np.float64)
    corner[face // 2] = first[face // 2]
    np.testing.assert_allclose(sky_colours(sky, corner[None]), 1.0, atol=1e-6)


@pytest.mark.parametrize("size", [1, 2, 16])
def test_a_texels_direction_leads_back_to_it(size: int) -> None:
    texels = texels_of(texel_directions(size), size)
    np.testing.assert_array_equal(np.arange(6 * size * size), texels.ravel())


@settings(max_examples=50, deadline=None)
@given(st.tuples(*[st.floats(-10, 10)] * 3).filter(lambda d: max(map(abs, d)) > 1e-3))
def test_a_direction_leads_to_a_face_and_back(direction: tuple[float, ...]) -> None:
    given_direction = np.array(direction)
    face, across, down = places_of(given_direction)
    assert abs(across) <= 1
    assert abs(down) <= 1
    back = on_face(int(face), across, down)
    np.testing.assert_allclose(given_direction / np.abs(given_direction).max(), back, atol=1e-12)


def test_colours_between_texels_are_those_of_the_sky() -> None:
    directions = directions_of(20000)
    found = sky_colours(sky_of(64), directions)
    # The error of bilinear interpolation: an eighth of the curvature times the square of a texel.
    np.testing.assert_allclose(colour_of(directions), found, atol=2e-3)
    again = sky_colours(sky_of(64), 1e3 * directions)
    np.testing.assert_allclose(found, again, atol=2e-4)


def check_seams() -> None:
    """Just this and just that side of an edge a random map has the same colour."""
    sky = noisy(8).to_sky()
    rng = np.random.default_rng(1)
    along = rng.uniform(-0.8, 0.8, 600)
    signs = rng.choice([-1.0, 1.0], (600, 2))
    axes = np.array([rng.permutation(3) for _ in range(600)])
    edge = np.zeros((600, 3))
    for column, value in enumerate((along, signs[:, 0], signs[:, 1])):
        np.put_along_axis(edge, axes[:, column : column + 1], value[:, None], axis=1)
    beside = edge.copy()
    sides = []
    for axis in (1, 2):
        beside = edge.copy()
        np.put_along_axis(
            beside, axes[:, axis : axis + 1], (1 - 1e-5) * signs[:, axis - 1 : axis], axis=1
        )
        sides.append(sky_colours(sky, beside))
    np.testing.assert_allclose(sides[0], sides[1], atol=1e-3)


def test_colours_do_not_jump_between_faces() -> None:
    check_seams()


def test_faces_of_their_own_are_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def clamped(size: int) -> NDArray[np.int32]:
        flat = np.arange(6 * size * size, dtype=np.int32).reshape(6, size, size)
        return np.pad(flat, ((0, 0), (1, 1), (1, 1)), mode="edge")

    monkeypatch.setattr(module, "table_of", clamped)
    with pytest.raises(AssertionError):
        check_seams()


def test_a_direction_without_length_has_no_colour() -> None:
    assert np.isnan(sky_colours(sky_of(4), np.zeros((2, 3)))).all()


PINHOLE = Pinhole(21.0, 23.0, 15.2, 9.7, 33, 20)


def check_gradients() -> None:
    """Compiled float32 against torch's float64, for directions and for a picture."""
    directions = torch.from_numpy(directions_of(500))
    needed = torch.from_numpy(np.random.default_rng(2).uniform(size=(20, 33)) < 0.5)
    pose = posed(3)
    for draw in (
        lambda sky: sky.colours(directions.to(sky.faces.dtype)),
        lambda sky: sky.background(PINHOLE, pose),
        lambda sky: sky.background(PINHOLE, torch.from_numpy(pose), needed),
    ):
        seen, grads = [], []
        for sky in (noisy(), noisy().double()):
            out = draw(sky)
            weights = torch.from_numpy(np.random.default_rng(5).normal(size=out.shape))
            (out * weights.to(out.dtype)).sum().backward()
            assert sky.faces.grad is not None
            seen.append(out.detach().double())
            grads.append(sky.faces.grad.double())
        np.testing.assert_allclose(seen[1], seen[0], atol=1e-5)
        assert float((grads[0] - grads[1]).abs().max()) <= 1e-4 * float(grads[1].abs().max())


def test_gradients_of_the_map() -> None:
    check_gradients()


def _shifted(right: Callable[..., None]) -> Callable[..., None]:
    def wrong(grads: Float64, table: NDArray[np.int32], *rest: Float64) -> None:
        right(grads, np.roll(table, 1, axis=2), *rest)

    return wrong


@pytest.mark.parametrize("name", ["scatter", "scatter_picture"])
def test_gradients_to_the_next_texel_are_found_out(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sky_kernels, name, _shifted(getattr(sky_kernels, name)))
    with pytest.raises(AssertionError):
        check_gradients()


def test_a_picture_is_what_its_pixels_directions_see() -> None:
    sky, pose = noisy(), posed(4)
    columns, rows = np.meshgrid(np.arange(33), np.arange(20))
    lens = np.stack([(columns - 15.2) / 21.0, (rows - 9.7) / 23.0, np.ones(columns.shape)], axis=-1)
    expected = sky_colours(sky.to_sky(), lens @ pose[:3, :3].T)
    np.testing.assert_allclose(expected, sky.background(PINHOLE, pose).detach(), atol=1e-5)
    np.testing.assert_allclose(expected, sky_picture(sky.to_sky(), PINHOLE, pose), atol=1e-5)


def test_pixels_that_are_not_needed_are_0_and_learn_nothing() -> None:
    sky, pose = noisy(), posed(4)
    needed = torch.zeros(20, 33, dtype=torch.bool)
    needed[:7] = True
    part = sky.background(PINHOLE, pose, needed)
    whole = sky.background(PINHOLE, pose).detach()
    assert torch.equal(part[:7].detach(), whole[:7])
    assert not part[7:].any()
    part[7:].sum().backward()
    assert sky.faces.grad is not None
    assert not sky.faces.grad.any()
    np.testing.assert_array_equal(
        part.detach(), sky_picture(sky.to_sky(), PINHOLE, pose, needed.numpy())
    )
    with pytest.raises(ArgumentError, match="needed"):
        sky.background(PINHOLE, pose, needed[1:])
    with pytest.raises(ArgumentError, match="needed"):
        sky_picture(sky.to_sky(), PINHOLE, pose, needed[1:].numpy())


def view(rotation: Float64, size_px: int = 96, focal_px: float = 40.0) -> Camera:
    pose = np.eye(4)
    pose[:3, :3] = rotation
    middle = 0.5 * (size_px - 1)
    lens = np.array([[focal_px, 0, middle], [0, focal_px, middle], [0, 0, 1]])
    return Camera(lens, pose, size_px, size_px)


def seen_by(camera: Camera) -> NDArray[np.uint8]:
    """The picture of `colour_of` by the camera, pixel by pixel from its definition."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixels = np.stack([columns, rows, np.ones(columns.shape)], axis=-1)
    directions = pixels @ np.linalg.inv(camera.intrinsics).T @ camera.world_from_camera[:3, :3].T
    return np.round(255 * colour_of(directions)).astype(np.uint8)


def frame(camera: Camera, image: NDArray[np.uint8], sky: NDArray[np.bool_], index: int) -> Frame:
    depth_m = np.where(sky, np.inf, 5.0).astype(np.float16)
    return Frame(FrameKey(index, "front"), 0.0, camera, image, depth_m=depth_m)


def six_views(size_px: int = 96, focal_px: float = 40.0) -> list[Frame]:
    turns = [Rotation.from_euler("z", 90 * k, degrees=True).as_matrix() for k in range(4)]
    turns += [Rotation.from_euler("y", s, degrees=True).as_matrix() for s in (-90, 90)]
    cameras = [view(turn @ AHEAD, size_px, focal_px) for turn in turns]
    everywhere = np.ones((size_px, size_px), bool)
    return [frame(c, seen_by(c), everywhere, i) for i, c in enumerate(cameras)]


def check_recovery(frames: list[Frame]) -> None:
    sky = SkyMap.of(frames, 32).to_sky()
    assert sky.seen.all()
    # A texel is 0.06 wide, and a pixel that covers it gives its colour to all of it.
    np.testing.assert_allclose(sky_of(32).faces, sky.faces, atol=0.02)
    directions = directions_of(2000)
    assert sky_seen(sky, directions).all()
    np.testing.assert_allclose(colour_of(directions), sky_colours(sky, directions), atol=0.02)


def test_a_known_sky_is_found_from_its_pictures() -> None:
    check_recovery(six_views())


def test_pixels_wider_than_texels_leave_no_gaps() -> None:
    sky = SkyMap.of(six_views(24, 10.0), 64).to_sky()
    assert sky.seen.all()
    np.testing.assert_allclose(sky_of(64).faces, sky.faces, atol=0.06)


def test_a_pose_taken_the_wrong_way_round_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    right = module._world_from_pixel

    def wrong(pinhole: Pinhole, pose: Float64) -> NDArray[np.float32]:
        return right(pinhole, pose.T)

    monkeypatch.setattr(module, "_world_from_pixel", wrong)
    with pytest.raises(AssertionError):
        check_recovery(six_views())


def test_what_was_not_seen_is_filled_from_what_was_and_marked() -> None:
    (ahead, *_) = six_views()
    sky = SkyMap.of([ahead], 32).to_sky()
    assert sky.seen[0].all()
    assert 0.15 < sky.seen.mean() < 0.35
    assert not sky_seen(sky, np.array([-1.0, 0.0, 0.0]))
    assert sky_seen(sky, np.array([1.0, 0.1, 0.1]))
    low, high = sky.faces[sky.seen].min(axis=0), sky.faces[sky.seen].max(axis=0)
    assert (sky.faces >= low - 1e-6).all()
    assert (sky.faces <= high + 1e-6).all()
    # Just outside the seen part the colour goes on.
    rim = np.array([[0.6, 1.0, 0.0], [0.6, 0.0, -1.0]])
    np.testing.assert_allclose(colour_of(rim), sky_colours(sky, rim), atol=0.2)


def test_pixels_that_a_roof_shares_do_not_colour_the_sky() -> None:
    (ahead, *_) = six_views()
    open_sky = np.zeros((96, 96), bool)
    open_sky[:40] = True
    image = ahead.image.copy()
    image[39:] = 0
    sky = SkyMap.of([frame(ahead.camera, image, open_sky, 0)], 32).to_sky()
    assert sky.faces[sky.seen].min() > 0.09
    thin = open_sky.copy()
    thin[:39] = False
    only_rim = SkyMap.of([frame(ahead.camera, image, thin, 0)], 32).to_sky()
    assert only_rim.seen.any()
    assert only_rim.faces.max() == 0.0


def test_labels_tell_where_there_is_no_depth() -> None:
    (ahead, *_) = six_views()
    label = np.full((96, 96), TRAIN_ID["sky"], np.uint8)
    labelled = Frame(ahead.key, 0.0, ahead.camera, ahead.image, label=label)
    np.testing.assert_array_equal(
        SkyMap.of([ahead], 16).to_sky().faces, SkyMap.of([labelled], 16).to_sky().faces
    )
    bare = Frame(ahead.key, 0.0, ahead.camera, ahead.image)
    nothing = SkyMap.of([bare], 16).to_sky()
    assert not nothing.seen.any()
    assert (nothing.faces == 0.5).all()


def test_a_learnt_sky_is_handed_out_in_range() -> None:
    sky = noisy(4)
    with torch.no_grad():
        sky.faces.mul_(3.0).sub_(1.0)
    faces = sky.to_sky().faces
    assert (faces.min(), faces.max()) == (0.0, 1.0)
    assert sky.state_dict().keys() == {"faces", "seen"}


def test_learning_finds_the_sky_behind_the_pictures() -> None:
    frames = six_views(32, 14.0)
    sky = SkyMap(16)
    optimiser = torch.optim.Adam(sky.parameters(), lr=0.05)
    for step in range(120):
        view_of = frames[step % 6]
        target = torch.from_numpy(view_of.image).float() / 255
        camera = view_of.camera
        optimiser.zero_grad()
        picture = sky.background(Pinhole.of(camera), camera.world_from_camera)
        (picture - target).square().mean().backward()  # type: ignore[no-untyped-call]
        optimiser.step()
    off = sky.to_sky().faces - sky_of(16).faces
    assert float(np.sqrt((off**2).mean())) < 0.01


@pytest.mark.parametrize("size", [0, 3, 8192, 2.0])
def test_sizes_are_powers_of_2(size: int) -> None:
    with pytest.raises(ArgumentError, match="power of 2"):
        SkyMap(size)


def test_the_table_of_texels_is_shared_and_cannot_be_changed() -> None:
    assert table_of(8) is cube.table_of(8)
    with pytest.raises(ValueError, match="read-only"):
        table_of(8)[0] = 0
