"""Checks 7 and 8: the field is even at any time, never repeats, and has no memory."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from air_only import air_only
from oracles import faults
from particles.particle_scene import camera, field, inside, nearest, whole, world
from physics_scene import measured, splats_of_records
from render_scene import make_frame
from scipy import stats

from weather_aug.particles import statistics
from weather_aug.particles.resolve import NEAR_M
from weather_aug.render import batch_project
from weather_aug.render.batch_medium import AirColumn
from weather_aug.render.compose import render
from weather_aug.weather import Weather

CELLS, SIDE_M = 5, 3.2
MOMENTS = ((0.0, 0.0, 0.0), (1.3, 11.0, 15.0), (37.2, 400.0, 77.0))
"""Time in s, place in m and heading in degrees along a turning path."""


def uniformity(points, low, side):
    """p-value that points of a box fall evenly on its 5^3 cells."""
    index = np.floor((points - low) / side * CELLS).astype(int)
    index = index[((index >= 0) & (index < CELLS)).all(axis=1)]
    counts = np.zeros((CELLS,) * 3)
    np.add.at(counts, tuple(index.T), 1)
    mean = counts.mean()
    assert mean > 5
    return stats.chi2(counts.size - 1).sf(((counts - mean) ** 2 / mean).sum())


def points_ahead(time_s, x, yaw_deg, seeds=range(4)):
    """Flakes (N, 3) in a box before the camera, in its own heading."""
    population = statistics.snow(4.0)
    points = []
    for seed in seeds:
        cam = camera(yaw_deg=yaw_deg, centre=(x, 0, 1.5), width=400, height=400)
        this = field(population, seed, (1.0, 2.0, 0.0), time_s)
        resolved = this.resolve(cam, 1_000)
        resolved = replace(resolved, reach_m=np.full_like(resolved.reach_m, 9.0))
        found = this.particles(cam, time_s, resolved, whole(cam))
        turn = cam.world_from_camera[:3, :3] @ np.array([[0, -1.0, 0], [0, 0, -1], [1, 0, 0]])
        points.append((world(found, cam) - (x, 0, 0)) @ turn)
    return np.concatenate(points)


def check_stationary(points_of):
    """Chi-squared of counts in 5^3 cells: p > 0.01 at 0, 1.3 and 37.2 s, along a turning path."""
    low = np.array([4.0, -0.5 * SIDE_M, -0.1])
    for moment in MOMENTS:
        p = uniformity(points_of(*moment), low, SIDE_M)
        measured(f"7: at {moment}: p = {p:.3f}")
        assert p > 0.01


def test_7_stationary():
    check_stationary(points_ahead)


def test_7_the_recycling_of_the_paper_is_found_out():
    """What leaves below starts again at the top: sheets, after seconds of it."""
    with pytest.raises(AssertionError):
        check_stationary(faults.recycled_points)


def layer_luminance(ambience, places_m, times_s):
    """Mean light of the particles alone over a black wall, along a drive at 15 m/s."""
    weather = Weather(snow_mm_per_h=2.0)
    mean = []
    for x, time_s in zip(places_m, times_s, strict=True):
        cam = camera(centre=(x, 0, 1.5), speed=15.0, width=128, height=80, exposure_s=0.002)
        frame = make_frame(cam, 0, 8.0, time_s=time_s)
        through = [
            render(frame, weather, seed=1, ambience=ambience, options=air_only(budget))
            for budget in (2_000, 0)
        ]
        mean.append(through[0].transmittance.mean() - through[1].transmittance.mean())
    return np.array(mean)


def check_no_repetition(ambience, places_of):
    """Autocorrelation of the layer at the lag b / V of a box of 40 m is below 0.2."""
    step_m, box_m, frames = 4.0, 40.0, 220
    x = step_m * np.arange(frames)
    layer = layer_luminance(ambience, *places_of(x, x / 15.0))
    layer -= layer.mean()
    lag = round(box_m / step_m)
    correlation = float((layer[lag:] * layer[:-lag]).mean() / layer.var())
    measured(f"7: autocorrelation {correlation:+.3f}")
    assert correlation < 0.2


def test_7_no_repetition(ambience):
    check_no_repetition(ambience, lambda x, t: (x, t))
    # Also where only the car moves, and neither fall nor wind mixes what is met again.
    check_no_repetition(ambience, lambda x, t: (x, 0 * t))


def test_7_a_periodic_box_is_found_out(ambience):
    with pytest.raises(AssertionError):
        check_no_repetition(ambience, lambda x, t: (x % 40.0, t % (40.0 / 15.0)))


class Field:
    """Snow and rain as they are asked for: by seed, camera and time."""

    def __init__(self, seed):
        self.seed = seed

    def particles(self, cam, time_s, kind="snow"):
        population = {"snow": statistics.snow(2.0), "rain": statistics.rain(20.0)}[kind]
        this = field(population, self.seed, (0.3, 0.1, 0.0), time_s)
        resolved = this.resolve(cam, 20_000)
        # One reach for all: what a camera resolves depends on where it stands.
        resolved = replace(resolved, reach_m=np.full_like(resolved.reach_m, 4.0))
        return this.particles(cam, time_s, resolved, whole(cam))


def check_random_access(make_field, kind="snow"):
    """A frame alone is the frame in sequence, bit for bit; another seed is another frame."""
    cam = camera()
    in_turn = make_field(1)
    sequence = [in_turn.particles(cam, 0.1 * k, kind) for k in range(10)]
    np.testing.assert_array_equal(sequence[7], make_field(1).particles(cam, 0.1 * 7, kind))
    np.testing.assert_array_equal(sequence[2], in_turn.particles(cam, 0.1 * 2, kind))
    assert not np.array_equal(sequence[7], make_field(2).particles(cam, 0.1 * 7, kind))


def check_two_cameras(make_field, kind="snow"):
    """Two overlapping cameras see the same particles of the world, whichever is asked first."""
    front, side = camera(), camera(yaw_deg=40, centre=(0.1, 0.3, 1.5))
    this = make_field(1)
    places = {}
    for order in ((front, side), (side, front)):
        for cam in order:
            found = this.particles(cam, 2.0, kind)
            if id(cam) in places:
                np.testing.assert_array_equal(places[id(cam)], found)
            places[id(cam)] = found
    common = []
    for cam, other in ((front, side), (side, front)):
        points = world(places[id(cam)], cam)
        both = np.ones(len(points), bool)
        for eye in (cam, other):
            pose = eye.world_from_camera
            seen_as = (points - pose[:3, 3]) @ pose[:3, :3]
            before = (seen_as[:, 2] > 2 * NEAR_M) & (seen_as[:, 2] < 3.5)
            both &= before & inside(np.where(before[:, None], seen_as, (0, 0, -1.0)), eye)
        common.append(points[both])
    off = nearest(common[0], np.concatenate([common[1], np.full((1, 3), 1e3)]))
    measured(f"8: {kind} {len(common[0])} and {len(common[1])} common, {np.max(off):.1e} m apart")
    assert len(common[0]) > 20
    # At the rim of a picture a rounding may decide whether a particle is inside of both.
    assert abs(len(common[0]) - len(common[1])) <= 0.01 * len(common[0])
    assert np.mean(off < 1e-5) > 0.99


@pytest.mark.parametrize("kind", ["rain", "snow"])
def test_8_random_access_and_two_cameras(kind):
    check_random_access(Field, kind)
    check_two_cameras(Field, kind)


@pytest.mark.parametrize("fault", [faults.FieldOfAStream, faults.FieldOfSteps])
def test_8_a_field_with_a_memory_is_found_out(fault):
    with pytest.raises(AssertionError):
        check_random_access(lambda seed: fault(Field, seed))


def test_8_a_field_for_each_camera_is_found_out():
    with pytest.raises(AssertionError):
        check_two_cameras(lambda seed: faults.FieldOfEachCamera(Field, seed))


def check_torch_path(device, dtype=torch.float32, shifted=0.0):
    """Where the torch path draws particles, within 1e-5 of the compiled path's tangents."""
    cam = camera(speed=8.0, width=320, height=192, exposure_s=0.004)
    records = Field(1).particles(cam, 1.0, "rain")
    records = records[(records[:, 12] == 1.0) & inside(records, cam)][:3_000]
    air = AirColumn(*(0.0,) * 4, 60 / 1024, 0.0, 3.0, torch.zeros(1025, device=device), (0, -1, 0))
    white = torch.ones(3, device=device)
    rows = torch.from_numpy(records + np.float32(shifted)).to(device, dtype)
    blocks = splats_of_records(records, cam)[:, :2].astype(float)
    parts = batch_project.project(rows, cam, air, white, white)
    drawn = np.stack([parts.u.cpu().numpy(), parts.v.cpu().numpy()], axis=1).astype(float)
    off = nearest(blocks, drawn).max() / cam.focal_px[0]
    measured(f"8: {device} {len(blocks)} splats, {off:.1e} of a tangent apart")
    assert len(blocks) == len(drawn)
    assert off < 1e-5


def test_8_the_torch_path_draws_the_same_places():
    check_torch_path("cpu")
    if torch.cuda.is_available():
        check_torch_path("cuda")


def test_8_half_precision_places_are_found_out():
    with pytest.raises(AssertionError):
        check_torch_path("cpu", torch.float16)
    with pytest.raises(AssertionError):
        check_torch_path("cpu", shifted=1e-4)


def test_8_rendered_frames_in_any_order(ambience):
    """The pictures themselves, bit for bit."""
    weather = Weather.rain("heavy")

    def shot(time_s, yaw_deg):
        cam = camera(yaw_deg=yaw_deg, centre=(10 * time_s, 0, 1.5), speed=10.0)
        frame = make_frame(cam, 60, 20.0, time_s=time_s)
        return render(frame, weather, seed=4, ambience=ambience).image

    wanted = [(0.1 * k, yaw) for k in range(4) for yaw in (0.0, 50.0)]
    forth = [shot(*one) for one in wanted]
    back = [shot(*one) for one in wanted[::-1]][::-1]
    for one, other in zip(forth, back, strict=True):
        np.testing.assert_array_equal(one, other)
