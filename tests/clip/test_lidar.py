"""LiDAR depth on surfaces whose depth is known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from weather_aug.clip import lidar
from weather_aug.clip.completion import completed, sharpened
from weather_aug.clip.lidar import lidar_depth, projected_depth, without_see_through
from weather_aug.errors import ArgumentError
from weather_aug.taxonomy import BUILDING, ROAD, SKY

HEIGHT, WIDTH, FOCAL_PX = 120, 200, 200.0
INTRINSICS = np.array([[FOCAL_PX, 0, 99.5], [0, FOCAL_PX, 40.0], [0, 0, 1]])
CAMERA_HEIGHT_M = 1.6


def _rays() -> NDArray[np.float64]:
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    pixels = np.stack([columns, rows, np.ones_like(rows)], axis=-1)
    return pixels @ np.linalg.inv(INTRINSICS).T


def _scan(depth: NDArray[np.float64], every_row: int, every_column: int) -> NDArray[np.float64]:
    sampled = depth[::every_row, ::every_column, None]
    hit = np.isfinite(sampled)
    points = _rays()[::every_row, ::every_column] * np.where(hit, sampled, 0)
    return points[hit[..., 0]]


def _ground() -> NDArray[np.float64]:
    slope = _rays()[..., 1]
    return np.where(slope > 0.02, CAMERA_HEIGHT_M / np.maximum(slope, 0.02), np.inf)


def test_ground_between_scan_lines_is_the_plane() -> None:
    truth = _ground()
    image = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    label = np.where(np.isinf(truth), SKY, ROAD).astype(np.uint8)
    depth = lidar_depth(_scan(truth, 6, 3), INTRINSICS, image, label)
    np.testing.assert_array_equal(np.isinf(truth), np.isinf(depth))
    seen = np.isfinite(truth)
    # Above the first and below the last scan line there is nothing to go by.
    seen[:48], seen[115:] = False, False
    off = np.abs(depth[seen] - truth[seen]) / truth[seen]
    assert np.percentile(off, 95) < 0.03


def test_wall_goes_on_above_the_reach_of_the_lidar() -> None:
    truth = np.full((HEIGHT, WIDTH), 20.0)
    image = np.full((HEIGHT, WIDTH, 3), 60, np.uint8)
    label = np.full((HEIGHT, WIDTH), BUILDING, np.uint8)
    points = _scan(truth, 6, 3)
    points = points[points[:, 1] > 0]
    np.testing.assert_allclose(20.0, lidar_depth(points, INTRINSICS, image, label), rtol=0.01)


def test_edge_of_a_nearer_thing_follows_the_picture() -> None:
    truth = np.full((HEIGHT, WIDTH), 30.0)
    truth[30:90, 60:140] = 8.0
    image = np.full((HEIGHT, WIDTH, 3), 60, np.uint8)
    image[30:90, 60:140] = 200
    label = np.full((HEIGHT, WIDTH), BUILDING, np.uint8)
    depth = lidar_depth(_scan(truth, 7, 4), INTRINSICS, image, label)
    assert (np.abs(depth - truth) > 1.0).mean() < 0.02


def test_points_seen_through_a_nearer_surface_are_dropped() -> None:
    near = np.zeros((HEIGHT, WIDTH), np.float32)
    near[20:100:4, 20:180:3] = 8.0
    sparse = near.copy()
    sparse[51, 101] = 30.0
    sparse[10, 100] = 30.0
    kept = without_see_through(sparse, 600.0)
    assert kept[51, 101] == 0
    assert kept[10, 100] == 30.0
    np.testing.assert_array_equal(near[near > 0], kept[near > 0])


def test_ground_is_not_taken_for_see_through() -> None:
    sparse = np.zeros((HEIGHT, WIDTH), np.float32)
    truth = _ground()
    sparse[::5, ::2] = np.where(np.isfinite(truth), truth, 0)[::5, ::2]
    kept = without_see_through(sparse, FOCAL_PX)
    assert (kept > 0).sum() == (sparse > 0).sum()


def test_nearest_point_of_a_pixel_wins() -> None:
    ray = _rays()[50, 60]
    points = np.stack([ray * 9.0, ray * 5.0, ray * 7.0, -ray * 3.0])
    sparse = projected_depth(points, INTRINSICS, (HEIGHT, WIDTH))
    assert sparse[50, 60] == pytest.approx(5.0)
    assert np.count_nonzero(sparse) == 1


def test_bad_points_are_refused() -> None:
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    with pytest.raises(ArgumentError, match=r"shape \(N, 3\)"):
        lidar_depth(np.zeros((5, 4)), INTRINSICS, image)
    with pytest.raises(ArgumentError, match="no point falls into the picture"):
        lidar_depth(np.array([[0.0, 0.0, -4.0]]), INTRINSICS, image)


def test_membrane_is_linear_between_two_columns_and_stops_at_a_barrier() -> None:
    guide = np.full((24, 41, 3), 128, np.uint8)
    values, confidence = np.zeros((24, 41), np.float32), np.zeros((24, 41), np.float32)
    values[:, 0], values[:, 40] = 1.0, 3.0
    confidence[:, [0, 40]] = 1000
    smooth = completed(values, confidence, guide, sweeps=200)
    np.testing.assert_allclose(np.linspace(1, 3, 41)[None].repeat(24, 0), smooth, atol=0.02)
    barrier = np.zeros((24, 41), bool)
    barrier[:, 20:] = True
    parted = completed(values, confidence, guide, barrier=barrier, sweeps=200)
    np.testing.assert_allclose(1.0, parted[:, :20], atol=0.02)
    np.testing.assert_allclose(3.0, parted[:, 20:], atol=0.02)


def test_ramps_become_steps_and_planes_stay() -> None:
    ramp = np.interp(np.arange(60), [28, 32], [0.02, 0.2]).astype(np.float32)
    step = sharpened(np.tile(ramp, (20, 1)), min_jump=4e-3)
    assert set(np.unique(step)) == {np.float32(0.02), np.float32(0.2)}
    plane = np.tile(np.linspace(0.1, 0.2, 60, dtype=np.float32), (20, 1))
    np.testing.assert_array_equal(plane, sharpened(plane, min_jump=4e-3))


def test_a_halo_around_a_sign_goes() -> None:
    truth = np.full((HEIGHT, WIDTH), 30.0)
    truth[40:70, 90:110] = 8.0
    image = np.full((HEIGHT, WIDTH, 3), (40, 60, 40), np.int64)
    image[40:70, 90:110] = (200, 150, 30)
    # Texture, so that the completion alone has edges everywhere.
    image += np.random.default_rng(0).integers(-14, 15, (HEIGHT, WIDTH, 1))
    label = np.full((HEIGHT, WIDTH), BUILDING, np.uint8)
    points = _scan(truth, 8, 5)
    shown = image.clip(0, 255).astype(np.uint8)
    wrong = (np.abs(lidar_depth(points, INTRINSICS, shown, label) - truth) > 1).mean()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lidar, "refined", lambda depth, image, **options: depth)
        haloed = (np.abs(lidar_depth(points, INTRINSICS, shown, label) - truth) > 1).mean()
    assert wrong < 0.5 * haloed
