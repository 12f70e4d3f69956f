"""The published particles: the table's numbers, the paper's motions and its ablations."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.spatial import cKDTree

from weather_aug.clip.types import Camera
from weather_aug.errors import ArgumentError
from weather_aug.particles import published
from weather_aug.particles.published import REACH_SIGMAS, PublishedField, field_from_world
from weather_aug.particles.published_presets import PUBLISHED_PRESETS, published_preset
from weather_aug.particles.resolve import NEAR_M

AXES = np.eye(3)
ORIGIN = np.array([0.0, 0.0, 1.5])
FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""world_from_camera rotation of a camera that looks along x, with z up."""
BEHIND_M = 1000.0
"""From that far behind, a camera has the whole box in its picture."""
by_preset = pytest.mark.parametrize(
    "preset", PUBLISHED_PRESETS, ids=lambda p: f"{p.dataset}-{p.weather}"
)


def camera(centre=ORIGIN, yaw_rad=0.0, pitch_rad=0.0, width=160, height=96):
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    cp, sp = np.cos(pitch_rad), np.sin(pitch_rad)
    yaw = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    pitch = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    pose = np.eye(4)
    pose[:3, :3] = yaw @ pitch @ FORWARD
    pose[:3, 3] = centre
    focal = 0.75 * width
    intrinsics = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return Camera(intrinsics, pose, width, height)


def field(preset, seed=1, **kwargs):
    return PublishedField(preset, seed, ORIGIN, AXES, **kwargs)


def seen(this, cam, time_s=0.0, window=None):
    return this.particles(cam, time_s, window or (0, 0, cam.height, cam.width))


def everything(this, time_s=0.0):
    """Records of the whole box, and positions (along, left, up) about the origin."""
    records = seen(this, camera(ORIGIN - (BEHIND_M, 0, 0)), time_s)
    x, y, z = records[:, :3].astype(float).T
    return records, np.stack([z - BEHIND_M, -x, -y], axis=1)


def bounds(preset):
    """Box as (along, left, up): lowest and highest corner."""
    (x0, y0, z0), (x1, y1, z1) = preset.box_low_m, preset.box_high_m
    if preset.axes == "right-forward-up":
        return np.array([y0, -x1, z0]), np.array([y1, -x0, z1])
    return np.array([z0, -x1, -y1]), np.array([z1, -x0, -y0])


def chi2_share(counts):
    """Where the counts' chi2 against equal means lies in its distribution."""
    mean = counts.mean()
    return stats.chi2(counts.size - 1).cdf(((counts - mean) ** 2 / mean).sum())


@pytest.mark.parametrize(
    ("dataset", "weather", "count", "density", "fall", "grey"),
    [
        ("waymo", "rain", 100_000, 0.78, 3.0, 0.70),
        ("waymo", "snow", 200_000, 1.56, 4.0, 0.85),
        ("pandaset", "fog", 200_000, 1.56, 0.0, 0.65),
        ("nuscenes", "rain", 200_000, 0.93, 3.0, 0.70),
        ("nuscenes", "snow", 300_000, 1.39, 3.0, 0.85),
        ("nuscenes", "fog", 200_000, 0.93, 0.0, 0.65),
    ],
)
def test_counts_densities_and_speeds_are_the_tables(dataset, weather, count, density, fall, grey):
    preset = published_preset(dataset, weather)
    this = field(preset)
    _, points = everything(this)
    assert len(points) == count
    assert count / np.ptp(points, axis=0).prod() == pytest.approx(density, abs=0.006)
    assert preset.density_per_m3 == pytest.approx(density, abs=0.006)
    assert this.fall_m_per_s == pytest.approx(fall)
    assert this.grey_srgb == grey


def test_waymo_and_pandaset_share_their_settings():
    assert published_preset("waymo", "snow") is published_preset("pandaset", "snow")


@by_preset
def test_particles_fill_the_box_evenly(preset):
    _, points = everything(field(preset), time_s=1.7)
    low, high = bounds(preset)
    assert (points >= low - 1e-3).all() and (points <= high + 1e-3).all()
    cells = np.clip(np.floor((points - low) / (high - low) * 8).astype(int), 0, 7)
    counts = np.zeros((8, 8, 8))
    np.add.at(counts, tuple(cells.T), 1)
    assert 1e-4 < chi2_share(counts) < 1 - 1e-4


@by_preset
def test_scales_have_the_tables_moments_in_each_third(preset):
    """Turning about the forward axis changes neither the forward variance nor the other two's sum.

    Second moments, so that the scales drawn below zero count as the table's.
    """
    records, _ = everything(field(preset))
    mean, std = np.array(preset.scale_mean_m), np.array(preset.scale_std_m)
    for third, multiplier in zip(np.array_split(records, 3), preset.y_multipliers, strict=True):
        squares = (mean**2 + std**2) * (1, multiplier**2, 1)
        ahead = squares[preset.forward_axis]
        assert third[:, 11].mean(dtype=float) == pytest.approx(ahead, rel=0.03)
        across = (third[:, 6] + third[:, 9]).mean(dtype=float)
        assert across == pytest.approx(squares.sum() - ahead, rel=0.01)


@pytest.mark.parametrize("dataset", ["waymo", "nuscenes"])
def test_rain_is_long_along_a_vertical_tilted_in_the_picture(dataset):
    """By 0.4 +- 0.1 rad, its top to the right, and as long as the table says."""
    preset = published_preset(dataset, "rain")
    records, _ = everything(field(preset))
    xx, xy, yy = records[:, 6].astype(float), records[:, 7].astype(float), records[:, 9]
    tilt_rad = 0.5 * np.arctan2(-2 * xy, yy - xx)
    assert tilt_rad.mean() == pytest.approx(0.4, abs=0.005)
    assert tilt_rad.std() == pytest.approx(0.1, abs=0.005)
    length_m = np.sqrt(0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy))
    first = length_m[: len(length_m) // 3]
    assert first.mean() == pytest.approx({"waymo": 0.06, "nuscenes": 0.02}[dataset], rel=0.01)
    assert first.std() == pytest.approx(0.001, rel=0.05)


def test_covariances_are_of_gaussians():
    """Symmetric and positive from any camera, with the volume the scales give."""
    this = field(published_preset("waymo", "snow"))
    records = seen(this, camera(yaw_rad=0.6, pitch_rad=0.2)).astype(float)
    xx, xy, xz, yy, yz, zz = records[:, 6:12].T
    full = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]).transpose(2, 0, 1)
    assert np.linalg.eigvalsh(full).min() > -1e-10
    box, _ = everything(this)
    assert full.trace(axis1=1, axis2=2).mean() == pytest.approx(
        box[:, [6, 9, 11]].sum(axis=1).mean(), rel=0.05
    )


@pytest.mark.parametrize(("weather", "mean", "std"), [("rain", 0.2, 0.001), ("snow", 0.5, 0.2)])
def test_opacities_have_the_tables_moments(weather, mean, std):
    opacity = everything(field(published_preset("waymo", weather)))[0][:, 12].astype(float)
    assert opacity.mean() == pytest.approx(mean, abs=0.002)
    assert opacity.std() == pytest.approx(std, rel=0.02)
    assert opacity.min() >= 0 and opacity.max() <= 1


def test_opacities_are_clamped_where_the_release_draws_impossible_ones():
    opacity = everything(field(published_preset("waymo", "snow")))[0][:, 12]
    share = stats.norm.cdf(-2.5)
    assert np.mean(opacity == 0) == pytest.approx(share, rel=0.15)
    assert np.mean(opacity == 1) == pytest.approx(share, rel=0.15)


def test_velocity_is_zero():
    assert not seen(field(published_preset("waymo", "rain")), camera(), 0.3)[:, 3:6].any()


def test_same_arguments_same_bits_and_another_seed_another_field():
    preset, cam = published_preset("waymo", "rain"), camera()
    first = seen(field(preset), cam, 1.3)
    np.testing.assert_array_equal(first, seen(field(preset), cam, 1.3))
    other = seen(field(preset, seed=2), cam, 1.3)
    assert not {tuple(r) for r in first[:, :3]} & {tuple(r) for r in other[:, :3]}


def test_any_time_can_be_asked_for_alone():
    preset, cam = published_preset("nuscenes", "snow"), camera()
    this = field(preset)
    sequence = [seen(this, cam, 0.1 * k) for k in range(4)]
    np.testing.assert_array_equal(sequence[3], seen(field(preset), cam, 0.1 * 3))


@pytest.mark.parametrize("weather", ["snow", "fog"])
def test_a_window_draws_a_subset_in_the_same_order(weather):
    this, cam = field(published_preset("waymo", weather)), camera()
    order = {tuple(r): i for i, r in enumerate(seen(this, cam, 1.0))}
    part = [order[tuple(r)] for r in seen(this, cam, 1.0, window=(30, 50, 24, 40))]
    assert 0 < len(part) < len(order)
    assert part == sorted(part)


@pytest.mark.parametrize("weather", ["rain", "fog"])
def test_nothing_that_touches_the_window_is_missing(weather):
    """Against footprints of all particles of the box, in plain numpy."""
    this, cam, window = (
        field(published_preset("waymo", weather)),
        camera(yaw_rad=0.3),
        (8, 20, 40, 60),
    )
    box, points = everything(this)
    pose = cam.world_from_camera
    x, y, z = ((points + ORIGIN - pose[:3, 3]) @ pose[:3, :3]).T
    sigma_m = np.sqrt(box[:, [6, 9, 11]].max(axis=1))
    (fx, fy), (cx, cy) = cam.focal_px, cam.principal_px
    # Their spheres must be in view of the picture, so that far ones are not smeared over it.
    near = (z > NEAR_M + 0.01) & (np.abs(x) < 0.6 * z) & (np.abs(y) < 0.35 * z)
    z = np.where(near, z, 1.0)
    u, v = cx + fx * x / z, cy + fy * y / z
    blur_px = 3.33 * np.sqrt(0.3)
    half_u = REACH_SIGMAS * fx * sigma_m / z + blur_px
    half_v = REACH_SIGMAS * fy * sigma_m / z + blur_px
    top, left, height, width = window
    touches = near & (u + half_u >= left) & (u - half_u <= left + width - 1)
    touches &= (v + half_v >= top) & (v - half_v <= top + height - 1)
    expected = np.stack([x, y, z], axis=1)[touches]
    assert len(expected) > 100
    distance_m, _ = cKDTree(seen(this, cam, window=window)[:, :3]).query(expected)
    assert distance_m.max() < 1e-3


def test_particles_fall_by_the_tables_step_in_one_frame_interval():
    for dataset, frame_interval_s in (("waymo", 0.1), ("nuscenes", 0.5)):
        preset = published_preset(dataset, "rain")
        this = field(preset, frame_interval_s=frame_interval_s)
        _, before = everything(this, 2.0)
        _, after = everything(this, 2.0 + frame_interval_s)
        low, high = bounds(preset)
        np.testing.assert_allclose(after[:, :2], before[:, :2], atol=1e-3)
        fallen_m = (before - after)[:, 2]
        wrapped = fallen_m < 0
        assert 0 < wrapped.mean() < 0.02
        fallen_m[wrapped] += (high - low)[2]
        np.testing.assert_allclose(fallen_m, 0.3, atol=1e-3)


def recycled_by_the_paper(height_m, low_m, high_m, fall_m, frames):
    """Reference: P = p_max - delta for what has fallen out, frame after frame, with delta = 0."""
    for _ in range(frames):
        height_m = height_m - fall_m
        height_m = np.where(height_m < low_m, high_m, height_m)
    return height_m


def test_the_wrap_stays_uniform_where_the_papers_recycling_piles_up():
    """After 60 frames of rain, in bins of 0.1 m; the field's own check turns red on the paper's."""
    preset = published_preset("waymo", "rain")
    (_, _, low_m), (_, _, high_m) = bounds(preset)
    _, start = everything(field(preset))
    _, wrapped = everything(field(preset), 60 * published.FRAME_INTERVAL_S)
    piled = recycled_by_the_paper(start[:, 2], low_m, high_m, preset.fall_m_per_frame, 60)
    edges = np.linspace(low_m, high_m, 401) + 0.013
    edges[[0, -1]] += (-0.02, 0.02)
    ours, theirs = np.histogram(wrapped[:, 2], edges)[0], np.histogram(piled, edges)[0]
    assert 1e-4 < chi2_share(ours[1:-1]) < 1 - 1e-4
    assert chi2_share(theirs[1:-1]) == 1.0
    assert ours.max() < 1.5 * ours.mean()
    assert theirs.max() > 2.5 * theirs.mean()


def poses():
    """World poses of a reference camera that drives and turns, and of a side camera with it."""
    first = camera()
    now = camera(centre=(25.0, -4.0, 2.0), yaw_rad=0.7, pitch_rad=0.05)
    side_from_first = np.linalg.inv(first.world_from_camera) @ camera(yaw_rad=1.0).world_from_camera
    side = replace(now, world_from_camera=now.world_from_camera @ side_from_first)
    return first, now, side


@pytest.mark.parametrize("preset", [published_preset("waymo", "snow"), PUBLISHED_PRESETS[3]])
def test_aligned_particles_are_where_a_parked_camera_has_them(preset):
    first, now, side = poses()
    delta = field_from_world(first.world_from_camera, now.world_from_camera)
    carried = field(preset, field_from_world=delta)
    np.testing.assert_allclose(
        seen(carried, now, 2.0), seen(field(preset), first, 2.0), rtol=1e-4, atol=2e-5
    )
    np.testing.assert_allclose(
        seen(carried, side, 2.0),
        seen(field(preset), camera(yaw_rad=1.0), 2.0),
        rtol=1e-4,
        atol=2e-5,
    )


def test_alignment_is_the_papers_delta_t():
    """T_t T_0^-1 applied to the points of time 0 gives the points of time t, without motion."""
    preset = published_preset("waymo", "rain")
    first, now, side = poses()
    delta = now.world_from_camera @ np.linalg.inv(first.world_from_camera)
    inverse = field_from_world(first.world_from_camera, now.world_from_camera)
    np.testing.assert_allclose(inverse @ delta, np.eye(4), atol=1e-12)
    _, points = everything(field(preset, dynamics="none"))
    moved = (points + ORIGIN) @ delta[:3, :3].T + delta[:3, 3]
    carried = seen(field(preset, dynamics="none", field_from_world=inverse), side, 7.0)
    pose = side.world_from_camera
    world = carried[:, :3].astype(float) @ pose[:3, :3].T + pose[:3, 3]
    assert len(world) > 1000
    assert cKDTree(moved).query(world)[0].max() < 1e-3


def test_without_alignment_the_box_stays_behind():
    preset = published_preset("waymo", "snow")
    at_start, later = (camera((x, 0, 1.5)) for x in (0.0, 50.0))
    this = field(preset, dynamics="none")
    before, after = seen(this, at_start), seen(this, later)
    assert after[:, 2].max() < 10.1 < 59 < before[:, 2].max()
    assert cKDTree(before[:, :3]).query(after[:, :3] + np.float32([0, 0, 50]))[0].max() < 1e-3
    assert len(seen(this, camera((70, 0, 1.5)))) == 0


def test_without_dynamics_nothing_moves():
    preset, cam = published_preset("waymo", "rain"), camera()
    still = field(preset, dynamics="none")
    np.testing.assert_array_equal(seen(still, cam, 0.0), seen(still, cam, 12.3))
    np.testing.assert_array_equal(seen(still, cam, 0.0), seen(field(preset), cam, 0.0))
    assert still.fall_m_per_s == 0.0
    moved = {tuple(r) for r in seen(field(preset), cam, 12.3)[:, :3]}
    assert not moved & {tuple(r) for r in seen(still, cam)[:, :3]}


@by_preset
def test_without_attributes_all_particles_are_one_blob_of_the_mean(preset):
    plain, points = everything(field(preset, attributes=False), 1.0)
    rich, rich_points = everything(field(preset), 1.0)
    assert np.ptp(plain[:, 12]) == 0
    assert plain[0, 12] == pytest.approx(rich[:, 12].mean(dtype=float), abs=0.002)
    variance = plain[:, [6, 9, 11]].astype(float)
    assert np.ptp(variance) < 1e-6 * variance.max()
    assert np.abs(plain[:, [7, 8, 10]]).max() < 1e-6 * variance.max()
    scales = np.array(preset.scale_mean_m) * (1, np.prod(preset.y_multipliers) ** (1 / 3), 1)
    assert variance.mean() == pytest.approx(scales.prod() ** (2 / 3), rel=1e-5)
    np.testing.assert_allclose(points, rich_points, atol=1e-3)


def test_fog_thickens_with_the_square_of_the_distance():
    """Mean optical depth along the axis, with the footprints cut at 1/255 as a rasteriser does."""
    preset = published_preset("waymo", "fog")
    tau = {10.0: [], 20.0: []}
    for seed in range(6):
        records, points = everything(field(preset, seed))
        opacity = np.maximum(records[:, 12] - 1 / 255, 0.0)
        # Opacity per area of what lies within a metre of the vertical plane through the axis.
        area_m2 = 2.0 * preset.extent_m[2]
        slab = (np.abs(points[:, 1]) < 1.0) & (points[:, 0] > 0)
        for depth_m in tau:
            upto = slab & (points[:, 0] < depth_m)
            tau[depth_m].append(2 * np.pi * 0.7**2 * opacity[upto].sum() / area_m2)
    assert np.mean(tau[10.0]) == pytest.approx(0.42, rel=0.15)
    assert np.mean(tau[20.0]) == pytest.approx(2.0, rel=0.15)
    assert np.mean(tau[20.0]) > 3.5 * np.mean(tau[10.0])


def test_fog_opacity_follows_the_release_formula():
    for dataset in ("waymo", "nuscenes"):
        preset = published_preset(dataset, "fog")
        records, points = everything(field(preset))
        s = {"waymo": 40.0, "nuscenes": 60.0}[dataset]
        ahead, aside = points[:, 0], np.abs(points[:, 1])
        expected = np.maximum(1 - np.exp(-0.1 * ahead / s), 1 - np.exp(-0.1 * 2 * aside / s))
        np.testing.assert_allclose(records[:, 12], expected, atol=2e-6)


def test_bad_input_is_refused_by_name():
    with pytest.raises(ArgumentError, match="dataset must be one of waymo"):
        published_preset("kitti", "rain")
    with pytest.raises(ArgumentError, match="weather must be one of rain"):
        published_preset("waymo", "hail")
    preset = published_preset("waymo", "rain")
    with pytest.raises(ArgumentError, match="dynamics"):
        field(preset, dynamics="wind")
    with pytest.raises(ArgumentError, match="frame_interval_s"):
        field(preset, frame_interval_s=0.0)
    with pytest.raises(ArgumentError, match="field_from_world"):
        field(preset, field_from_world=np.eye(3))
    with pytest.raises(ArgumentError, match="seed"):
        PublishedField(preset, 1.5, ORIGIN, AXES)
