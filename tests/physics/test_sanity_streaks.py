"""Checks 5 and 6: where streaks point, how long and how faint the shutter makes them."""

from dataclasses import replace

import numpy as np
import pytest
from oracles import faults
from particles.particle_scene import camera, field, whole
from physics_scene import (
    FAINTEST,
    FILTER_PX2,
    angle_deg,
    covariances,
    layer,
    long_axes,
    measured,
    solid,
    splats_of_records,
)
from render_scene import make_camera

from weather_aug.particles import statistics

FALL_M_PER_S = 6.54
"""Of a drop of 2 mm."""


def sweep_px(position, velocity, cam):
    """Streak (N, 2) of particles on the picture: J (T_e (v - omega x p)), in float64."""
    moved = cam.exposure_s * (velocity - np.cross(cam.angular_velocity_rad_per_s, position))
    (fx, fy), z = cam.focal_px, position[:, 2:]
    across = moved[:, :2] - position[:, :2] / z * moved[:, 2:]
    return np.array([fx, fy]) / z * across


def check_axes(sweep=sweep_px, turning=(0.2, -0.6, 0.3)):
    """The long axis of a footprint is the streak's, to 0.1 degrees, also while the car turns."""
    cam = make_camera(
        600,
        400,
        800.0,
        exposure_s=0.01,
        aperture_m=0.0,
        angular_velocity_rad_per_s=np.array(turning),
    )
    rng = np.random.default_rng(5)
    worst = 0.0
    for _ in range(300):
        z = rng.uniform(2.5, 9)
        position = np.array([[*(rng.uniform(-0.3, 0.3, 2) * z * [1, 0.6]), z]])
        velocity = rng.normal(0, [2, 5, 9], (1, 3))
        splats = splats_of_records(solid(position, velocity, 1.5e-3), cam)
        streak = sweep(position, velocity, cam)
        if np.hypot(*streak[0]) < 3 or len(splats) != 1:
            continue
        worst = max(worst, angle_deg(long_axes(splats), streak)[0])
    measured(f"5: axes within {worst:.5f} deg")
    assert worst < 0.1


def test_5_axes():
    check_axes()


def test_5_a_forgotten_turn_or_approach_is_found_out():
    with pytest.raises(AssertionError):
        check_axes(lambda p, v, cam: sweep_px(p, v, without_turning(cam)))
    with pytest.raises(AssertionError):
        check_axes(lambda p, v, cam: sweep_px(p, v * [1, 1, 0], cam))


def without_turning(cam):
    return replace(cam, angular_velocity_rad_per_s=np.zeros(3))


def drops_of_a_field(cam, wind, reach_m=6.0):
    """Rain as the field has it, without sways, of all sizes up to a depth."""
    population = statistics.rain(30.0)
    still = np.zeros_like(population.sway_m)
    population = replace(population, sway_m=still, sway_per_wind_s=still)
    this = field(population, wind=wind)
    resolved = this.resolve(cam, 20_000)
    resolved = replace(resolved, reach_m=np.full_like(resolved.reach_m, reach_m))
    return population, this.particles(cam, 0.0, resolved, whole(cam))


def check_parked(wind_m_per_s=3.0, seen_as=lambda records: records):
    """A parked camera sees rain lean by atan(w / v_t), to 0.1 degrees on the axis."""
    cam = camera(width=800, height=600, exposure_s=0.005, aperture_m=0.0)
    # The camera looks along x: a wind to the left is across its picture.
    population, records = drops_of_a_field(cam, (0.0, wind_m_per_s, 0.0))
    on_axis = records.copy()
    # Off the axis a vertical streak stays vertical; moved there, only the wind is left.
    on_axis[:, :2] = 0.0
    worst, classes, speeds = 0.0, set(), population.fall_speed_m_per_s
    for row in seen_as(on_axis)[:: len(on_axis) // 400]:
        fall = row[4]
        if cam.exposure_s * cam.focal_px[1] * fall / row[2] < 3:
            continue
        axis = long_axes(splats_of_records(row[None], cam)[:1])
        speed = speeds[np.abs(speeds - fall).argmin()]
        classes.add(float(speed))
        worst = max(worst, angle_deg(axis, np.array([[-wind_m_per_s, speed]]))[0])
    measured(f"5: parked within {worst:.5f} deg, {len(classes)} classes")
    assert len(classes) > 3
    assert worst < 0.1


def test_5_parked():
    check_parked()


def test_5_rain_without_wind_is_found_out():
    with pytest.raises(AssertionError):
        check_parked(seen_as=faults.windless)


def check_focus_of_expansion(seen_as=lambda records: records, focus=None):
    """Streaks seen from a driving car meet where it is heading for, to 2 px."""
    cam = camera(speed=15.0, width=800, height=600, exposure_s=0.006, aperture_m=0.0)
    wind = np.array([1.0, 1.2, 0.0])
    population, records = drops_of_a_field(cam, wind)
    fall = population.fall_speed_m_per_s[7]
    records = records[np.abs(records[:, 4] - fall) < 1e-3]
    pixels, normals = [], []
    for row in seen_as(records):
        splats = splats_of_records(row[None], cam)
        spread = np.linalg.eigvalsh(covariances(splats))[:, ::-1] if len(splats) else []
        for splat, (long, short) in zip(splats, spread, strict=False):
            if long > 9 * short:
                along = long_axes(splat[None])[0]
                pixels.append(splat[:2].astype(float))
                normals.append([-along[1], along[0]])
    pixels, normals = np.array(pixels), np.array(normals)
    met = np.linalg.lstsq(normals, (normals * pixels).sum(axis=1), rcond=None)[0]
    if focus is None:
        world = wind - [15.0, 0, 0] - [0, 0, fall]
        relative = world @ cam.world_from_camera[:3, :3]
        focus = cam.focal_px[0] * relative[:2] / relative[2] + np.array(cam.principal_px)
    off = np.hypot(*(met - focus))
    measured(f"5: {len(pixels)} streaks meet {off:.3f} px off the heading")
    assert len(pixels) > 50
    assert off < 2.0


def test_5_focus_of_expansion():
    check_focus_of_expansion()


def test_5_no_ego_motion_and_the_middle_of_the_picture_are_found_out():
    with pytest.raises(AssertionError):
        check_focus_of_expansion(seen_as=faults.without_ego_motion)
    with pytest.raises(AssertionError):
        check_focus_of_expansion(focus=np.array([399.5, 299.5]))


def length_alpha_sum(exposure_s, diameter_m, depth_m, drawn):
    """Streak length in px, its opacity and opacity times area of one drop's Gaussians."""
    cam = make_camera(64, 1200, 1266.0, exposure_s=exposure_s, aperture_m=0.0)
    splats = drawn(solid([0, 0, depth_m], (0, FALL_M_PER_S, 0), diameter_m), cam).astype(float)
    spread = covariances(splats)
    width_px2 = (1266 * diameter_m / depth_m) ** 2 / 8 + FILTER_PX2
    alpha = splats[:, 6] - FAINTEST
    area = 2 * np.pi * np.sqrt(np.linalg.det(spread))
    if len(splats) == 1:
        length = np.sqrt(12 * (spread[0, 1, 1] - width_px2))
    else:
        length = np.ptp(splats[:, 1]) * len(splats) / (len(splats) - 1)
    return length, (alpha * area).sum() / length, (alpha * area).sum()


def check_exposure(drawn=splats_of_records):
    """Half the exposure: half the length, twice the opacity, the same opacity times area."""
    for diameter_m, depth_m in ((0.002, 8.0), (0.001, 4.0), (0.004, 2.5), (0.002, 1.0)):
        whole_, half = (
            length_alpha_sum(exposure_s, diameter_m, depth_m, drawn)
            for exposure_s in (0.010, 0.005)
        )
        ratios = np.divide(half, whole_)
        measured(f"5: D {diameter_m} at {depth_m} m: length, alpha, sum ratios {ratios}")
        np.testing.assert_allclose(ratios[:2], (0.5, 2.0), rtol=0.005)
        assert abs(ratios[2] - 1) < 0.005
        silhouette_px2 = np.pi / 4 * (1266 * diameter_m / depth_m) ** 2
        assert abs(half[2] / silhouette_px2 - 1) < 0.005


def test_5_exposure():
    check_exposure()


def test_5_an_opacity_without_exposure_is_found_out():
    with pytest.raises(AssertionError):
        check_exposure(faults.opacity_without_exposure(splats_of_records))


def peak_alpha(exposure_s, drawn=splats_of_records):
    """Peak of a drop's Gaussian far narrower than the pixel: 1 / length, too."""
    cam = make_camera(64, 1200, 1266.0, exposure_s=exposure_s, aperture_m=0.0)
    splats = drawn(solid([0, 0, 8.0], (0, FALL_M_PER_S, 0), 0.002), cam)
    return float(splats[0, 6]) - FAINTEST


def test_5_the_peak_of_a_long_streak_doubles():
    ratio = peak_alpha(0.020) / peak_alpha(0.040)
    measured(f"5: peak ratio {ratio:.4f}")
    assert ratio == pytest.approx(2.0, rel=0.005)


SPEED_M_PER_S = {1: 3.95, 2: 6.54, 4: 8.82}
TABLE = {
    1: {1: 0.159, 2: 0.088, 5: 0.038, 10: 0.019, 20: 0.010},
    2: {1: 0.184, 2: 0.104, 5: 0.045, 10: 0.023, 20: 0.012},
    4: {1: 0.245, 2: 0.145, 5: 0.065, 10: 0.034, 20: 0.017},
}
"""Mean opacity by diameter in mm and exposure in ms, parked car."""


def mean_alpha(diameter_mm, exposure_ms, drawn):
    """Of the drawn pixels, over the rectangle that the drop sweeps: D wide, L + D long."""
    cam = make_camera(64, 2400, 4000.0, exposure_s=1e-3 * exposure_ms, aperture_m=0.0)
    depth_m = 2.0 if exposure_ms < 20 else 4.0
    velocity = (0, SPEED_M_PER_S[diameter_mm], 0)
    records = solid([0, 0, depth_m], velocity, 1e-3 * diameter_mm)
    _, through = layer(drawn(records, cam), cam)
    length_m = 1e-3 * exposure_ms * velocity[1]
    width_px, height_px = (
        4000 / depth_m * v for v in (1e-3 * diameter_mm, length_m + 1e-3 * diameter_mm)
    )
    return (1 - through.astype(float)).sum() / (width_px * height_px)


def check_exposure_table(drawn=splats_of_records):
    """2 mm at 5 ms: 0.045 +- 0.005 on the mean, 0.058 along a flat top; and the whole table."""
    mean = mean_alpha(2, 5, drawn)
    flat_top = mean / (np.pi / 4)
    measured(f"6: 2 mm at 5 ms: mean {mean:.4f}, flat top {flat_top:.4f}")
    assert abs(mean - 0.045) < 0.005
    assert abs(flat_top - 0.058) < 0.0025
    for diameter_mm, row in TABLE.items():
        for exposure_ms, alpha in row.items():
            found = mean_alpha(diameter_mm, exposure_ms, drawn)
            measured(f"6: {diameter_mm} mm, {exposure_ms} ms: {found:.4f} ({alpha})")
            # Parts of a streak lie over each other: up to 4 % of what they should take is lost.
            assert abs(found - alpha) < 0.05 * alpha + 0.0005


def test_6_exposure_table():
    check_exposure_table()


def test_6_an_opacity_without_exposure_is_found_out():
    with pytest.raises(AssertionError):
        check_exposure_table(faults.opacity_without_exposure(splats_of_records))


def check_pixel_sums(drawn=splats_of_records):
    """Opacity added up over the pixels is the silhouette, to 2 %, averaged over places."""
    rng = np.random.default_rng(3)
    worst = 0.0
    for exposure_s in (0.001, 0.002, 0.005, 0.010, 0.020):
        for depth_m in (1.0, 3.0, 8.0):
            cam = make_camera(64, 400, 1266.0, exposure_s=exposure_s, aperture_m=0.0)
            sums = []
            for place in rng.uniform(-4, 4, (48, 2)) * depth_m / 1266:
                records = solid([*place, depth_m], (0, FALL_M_PER_S, 0), 0.002)
                sums.append((1 - layer(drawn(records, cam), cam)[1].astype(float)).sum())
            area = np.pi / 4 * (1266 * 0.002 / depth_m) ** 2
            error = np.mean(sums) / area - 1
            measured(f"6: pixel sum {exposure_s} s {depth_m} m {error:+.4f}")
            worst = max(worst, abs(error))
    assert worst < 0.02


def test_6_pixels_add_up_to_the_silhouette():
    check_pixel_sums()
    with pytest.raises(AssertionError):
        check_pixel_sums(faults.opacity_without_exposure(splats_of_records))
    with pytest.raises(AssertionError):
        check_pixel_sums(lambda records, cam: splats_of_records(records, cam, compensate=False))
