"""What a browser is shown: the scene's Gaussians, and the particles that `render` would draw."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from tiny_clip import TinyClip
from tiny_reconstruction import SPEED_M_PER_S, TIMES_S, TRACK_ID, camera_at, tiny_reconstruction

from weather_aug.air import air_of
from weather_aug.clip.types import Camera, FrameKey
from weather_aug.edit.ambience import Ambience
from weather_aug.errors import ArgumentError
from weather_aug.gaussians.cube import texel_directions
from weather_aug.particles.shelter import Shelter
from weather_aug.render.fields import fields_of, resolved_of
from weather_aug.render.options import RenderOptions
from weather_aug.view import splats
from weather_aug.view.viewer import CAPACITY
from weather_aug.weather import Weather

Float64 = NDArray[np.float64]

BROWSER = camera_at(0.0, size_px=(960, 540))
CAMERAS = [camera_at(SPEED_M_PER_S * t) for t in TIMES_S]


def test_covariances_are_those_of_the_axes() -> None:
    """R S S^T R^T with R from (w, x, y, z): a quarter turn about z brings x to y."""
    half = math.sqrt(0.5)
    quaternions = np.array([[1, 0, 0, 0], [3 * half, 0, 0, 3 * half]], np.float32)
    scales = np.array([[1, 2, 3], [1, 2, 3]], np.float32)
    found = splats.covariances_of(quaternions, scales)
    np.testing.assert_allclose(found[0], np.diag([1, 4, 9]), atol=1e-6)
    np.testing.assert_allclose(found[1], np.diag([4, 1, 9]), atol=1e-6)


def test_the_largest_covariance_fits_into_float16() -> None:
    huge = np.full((1, 3), 1e9, np.float32)
    found = splats.covariances_of(np.array([[1, 0, 0, 0]], np.float32), huge)
    assert np.isfinite(found.astype(np.float16)).all()


def test_the_background_has_the_colours_that_the_drive_saw() -> None:
    reconstruction = tiny_reconstruction()
    found = splats.background_splats(reconstruction, CAMERAS)
    background = reconstruction.background
    assert len(found.centres_m) == len(background)
    assert (found.centres_m == background.means_m).all()
    opacity = 1 / (1 + np.exp(-background.logit_opacities.astype(np.float64)))
    np.testing.assert_allclose(found.opacities[:, 0], 255 * opacity, atol=0.51)
    centres, seen = splats.nearest_views(background.means_m, CAMERAS)
    assert 0.5 < seen.mean() < 1
    towards = background.means_m[seen].astype(np.float64) - centres[seen]
    x, y, z = (towards / np.linalg.norm(towards, axis=1, keepdims=True)).T
    basis = np.stack(
        [np.full(len(x), 0.28209479), -0.48860251 * y, 0.48860251 * z, -0.48860251 * x]
    )
    colours = np.clip(0.5 + np.einsum("kn,nkc->nc", basis, background.sh[seen]), 0, 1)
    np.testing.assert_allclose(found.rgbs[seen], 255 * colours, atol=0.6)
    mean = np.clip(0.5 + 0.28209479 * background.sh[~seen, 0], 0, 1)
    np.testing.assert_allclose(found.rgbs[~seen], 255 * mean, atol=0.6)


def test_the_nearest_camera_that_sees_a_point_counts() -> None:
    points = np.array([[20, 0, 1.5], [2.6, 0, 1.5], [-20, 0, 1.5], [8, 5.2, 1.5]], np.float32)
    centres, seen = splats.nearest_views(points, CAMERAS)
    assert seen.tolist() == [True, True, False, True]
    np.testing.assert_allclose(centres[0], [5, 0, 1.5])
    # 0.6 m before the camera at 2 m; that at 3 m is beyond it.
    np.testing.assert_allclose(centres[1], [2, 0, 1.5])
    assert (centres[2] == 0).all()
    # To the side it leaves the pictures of the cameras that are nearer.
    np.testing.assert_allclose(centres[3], [0, 0, 1.5])


def test_a_style_colours_the_background() -> None:
    reconstruction = tiny_reconstruction(styles=("snow",))
    own = splats.background_splats(reconstruction, CAMERAS).rgbs.mean()
    half = splats.background_splats(reconstruction, CAMERAS, "snow", 0.5).rgbs.mean()
    snow = splats.background_splats(reconstruction, CAMERAS, "snow").rgbs.mean()
    assert own + 20 < half < snow - 20


@pytest.mark.parametrize("car", [True, False])
def test_what_moves_is_where_it_is_at_that_time(car: bool) -> None:
    reconstruction = tiny_reconstruction(car=car)
    alone = splats.actors_alone(reconstruction)
    assert len(alone.background) == 1
    count = len(reconstruction.actor_gaussians)
    for time_s in (0.0, 0.5):
        found = splats.actor_splats(alone, time_s, np.zeros(3), "snow", 0.5)
        assert len(found.centres_m) == count
        if car:
            middle = found.centres_m.mean(axis=0)
            np.testing.assert_allclose(middle, [10 + 5 * time_s, -1, 0.95], atol=0.03)
    hidden = splats.actor_splats(alone, 0.0, np.zeros(3), without=[TRACK_ID] if car else [])
    assert len(hidden.centres_m) == 0


def falling(view: Camera, weather: Weather, light: Ambience) -> Float64:
    """World positions (N, 3) of the particles that `render` draws for a camera, at 1.5 s."""
    fields = fields_of(weather, 3, air_of(weather, 1.5, 3), light.axes_world, RenderOptions(), None)
    resolved, _ = resolved_of(fields, view, 4000)
    window = (0, 0, view.height, view.width)
    found = [f.particles(view, 1.5, r, window) for f, r in zip(fields, resolved, strict=True)]
    places = np.concatenate(found)[:, :3].astype(np.float64)
    world: Float64 = places @ view.world_from_camera[:3, :3].T + view.centre_world
    return world


WEATHERS = {
    "rain": Weather.rain("heavy"),
    "snow": Weather.snow("heavy"),
    "both": Weather.mix(Weather.rain("light"), Weather.snow("light")),
}


@pytest.mark.parametrize("weather", WEATHERS.values(), ids=WEATHERS.keys())
def test_the_particles_are_those_of_render(weather: Weather, ambience: Ambience) -> None:
    found = splats.particle_splats(BROWSER, 1.5, weather, 3, ambience)
    expected = falling(BROWSER, weather, ambience)
    assert 500 < len(expected) < CAPACITY
    np.testing.assert_allclose(found.centres_m, expected, atol=1e-3)


def test_particles_of_another_time_would_be_seen(ambience: Ambience) -> None:
    found = splats.particle_splats(BROWSER, 1.6, WEATHERS["snow"], 3, ambience)
    expected = falling(BROWSER, WEATHERS["snow"], ambience)
    count = min(len(expected), len(found.centres_m))
    assert np.abs(found.centres_m[:count] - expected[:count]).max() > 0.05


def projected(found: splats.Splats, view: Camera) -> Float64:
    """(N, 2, 2) covariances on the picture, pixels², with the browser's filter."""
    rotation = view.world_from_camera[:3, :3]
    x, y, z = ((found.centres_m - view.centre_world) @ rotation).T
    fx, fy = view.focal_px
    rows = [[fx / z, 0 * z, -fx * x / z**2], [0 * z, fy / z, -fy * y / z**2]]
    jacobian = np.array(rows).transpose(2, 0, 1) @ rotation.T
    seen: Float64 = jacobian @ found.covariances_m2 @ jacobian.transpose(0, 2, 1)
    return seen + 0.3 * np.eye(2)


def test_particles_cover_a_pixel_and_rain_makes_streaks(ambience: Ambience) -> None:
    """The browser drops what has less than 0.5 px² of opacity times area."""
    rain = splats.particle_splats(BROWSER, 1.5, WEATHERS["rain"], 3, ambience, emphasis=3)
    widths = np.sqrt(np.linalg.eigvalsh(projected(rain, BROWSER)))
    assert widths[:, 0].min() > 0.9
    assert np.median(widths[:, 1] / widths[:, 0]) > 2
    snow = splats.particle_splats(BROWSER, 1.5, WEATHERS["snow"], 3, ambience, emphasis=3)
    drawn = snow.opacities[:, 0] / 255 * np.linalg.det(projected(snow, BROWSER)) > 0.25
    assert drawn.sum() > 300


def test_a_wider_particle_is_fainter(ambience: Ambience) -> None:
    """Opacity times area is kept: half the picture's size, half the opacity of what is small."""
    small = camera_at(0.0, size_px=(480, 270))
    sums = []
    for view in (BROWSER, small):
        found = splats.particle_splats(
            view, 1.5, WEATHERS["snow"], 3, ambience, max_particles=100_000
        )
        solid = np.sqrt(np.linalg.det(projected(found, view))) / view.focal_px[0] ** 2
        distance = np.linalg.norm(found.centres_m - view.centre_world, axis=1)
        near = distance < 5
        sums.append((solid * found.opacities[:, 0])[near].sum() / 255)
    assert sums[1] == pytest.approx(sums[0], rel=0.15)


def test_emphasis_makes_particles_more_opaque(ambience: Ambience) -> None:
    plain, strong = (
        splats.particle_splats(BROWSER, 1.5, WEATHERS["rain"], 3, ambience, emphasis=e).opacities
        for e in (1.0, 3.0)
    )
    assert strong.mean() > 2 * plain.mean()
    with pytest.raises(ArgumentError, match="emphasis"):
        splats.particle_splats(BROWSER, 1.5, WEATHERS["rain"], 3, ambience, emphasis=0.5)


def test_nothing_falls_under_a_roof_or_in_clear_air(ambience: Ambience) -> None:
    roof = Shelter(np.full((400, 400), 20.0, np.float32), np.array([-100.0, -100, 0]), np.eye(3))
    snow = WEATHERS["snow"]
    covered = splats.particle_splats(BROWSER, 1.5, snow, 3, ambience, shelter=roof)
    free = splats.particle_splats(BROWSER, 1.5, snow, 3, ambience)
    assert len(covered.centres_m) < 0.05 * len(free.centres_m)
    assert len(splats.particle_splats(BROWSER, 1.5, Weather.clear(), 3, ambience).centres_m) == 0


def test_padding_is_invisible_and_the_count_is_fixed(ambience: Ambience) -> None:
    found = splats.particle_splats(BROWSER, 1.5, WEATHERS["snow"], 3, ambience)
    count = len(found.centres_m)
    more, fewer = found.padded(count + 7), found.padded(count - 7)
    assert {len(array) for array in more} == {count + 7}
    assert (more.opacities[count:] == 0).all()
    assert all((a[:count] == b).all() for a, b in zip(more, found, strict=True))
    assert {len(array) for array in fewer} == {count - 7}


def test_a_browsers_camera_is_the_recorded_one_in_its_window() -> None:
    recorded = replace(camera_at(3.0, 1.0, 20.0), exposure_s=0.002)
    width, height = recorded.width, recorded.height
    fov = 2 * math.atan(0.5 * height / recorded.focal_px[1])
    half = math.radians(20.0) / 2
    # The recorded axes at no yaw, by the matrix with rows along z, then turned by the yaw.
    base = np.array([0.5, -0.5, 0.5, -0.5])
    w, x, y, z = base
    c, s = math.cos(half), math.sin(half)
    turned = np.array([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w])
    found = splats.browser_camera(recorded.centre_world, turned, fov, (width, height), recorded)
    np.testing.assert_allclose(found.world_from_camera, recorded.world_from_camera, atol=1e-12)
    np.testing.assert_allclose(found.intrinsics, recorded.intrinsics, atol=1e-9)
    assert found.exposure_s == 0.002
    assert not found.velocity_m_per_s.any()


def test_points_of_depth_lie_on_the_street() -> None:
    clip = TinyClip()
    frame = clip.frame(FrameKey(1, "right"))
    points, colours = splats.depth_points(frame, 2)
    assert len(points) == len(colours) > 100
    pole = np.hypot(points[:, 0] - 12, points[:, 1] + 3.5) < 0.16
    on_surface = (abs(points[:, 2]) < 1e-2) | (abs(points[:, 1] - 9) < 1e-2) | pole
    assert on_surface.all()
    row, column = 40, 30
    index = np.flatnonzero((colours == frame.image[row, column]).all(axis=1))
    depth = float(frame.depth_m[row, column])  # type: ignore[index]
    (fx, fy), (cx, cy) = frame.camera.focal_px, frame.camera.principal_px
    local = np.array([(column - cx) / fx, (row - cy) / fy, 1]) * depth
    world = frame.camera.world_from_camera[:3, :3] @ local + frame.camera.centre_world
    assert np.abs(points[index] - world).max(axis=1).min() < 1e-4


def test_frames_without_depth_have_no_points() -> None:
    frame = replace(TinyClip().frame(FrameKey(0, "front")), depth_m=None)
    assert [len(array) for array in splats.depth_points(frame, 1)] == [0, 0]


@pytest.mark.parametrize("face", range(6))
def test_faces_of_the_sky_stand_where_their_texels_look(face: int) -> None:
    """An image's texel (a, b) lies at its middle + a · x + b · y of its axes."""
    w, x, y, z = splats.sky_face_wxyz(face)
    across = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)])
    down = np.array([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)])
    places = (2 * np.arange(4) + 1) / 4 - 1
    drawn = (
        splats.sky_face_direction(face)
        + places[None, :, None] * across
        + places[:, None, None] * down
    )
    np.testing.assert_allclose(drawn, texel_directions(4)[face], atol=1e-6)


def test_linear_fog_halves_the_light_where_fog_does() -> None:
    fog = Weather.fog(visibility_m=100.0)
    end_m = splats.fog_end_m(fog)
    assert end_m is not None
    assert math.exp(-fog.fog_per_m * end_m / 2) == pytest.approx(0.5)
    assert splats.fog_end_m(Weather.clear()) is None
    misty = splats.fog_end_m(Weather.rain("heavy"))
    assert misty is not None and misty > end_m


def test_spread_takes_the_first_and_no_more_than_asked() -> None:
    assert splats.spread(range(10), 20) == range(10)
    assert list(splats.spread(range(10), 3)) == [0, 3, 6]
    with pytest.raises(ArgumentError):
        splats.spread(range(10), 0)
