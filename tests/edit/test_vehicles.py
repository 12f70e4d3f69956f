"""Which vehicles are found, where they are, and which way they drive."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from render_scene import make_camera, make_frame

from weather_aug.clip.street import StreetClip
from weather_aug.clip.types import Box, FrameKey
from weather_aug.edit.physical import vehicles
from weather_aug.edit.physical.vehicles import kind_of, vehicles_of
from weather_aug.errors import ArgumentError
from weather_aug.taxonomy import ROAD, TRAIN_ID

AXES = np.eye(3)
SPEED = 12.0
HEIGHT_M = 1.5
WIDTH, LENGTH = 1.8, 4.4


def camera():
    return make_camera(1024, 512, velocity=(SPEED, 0.0, 0.0))


def street(*rears, kind="car", cut=()):
    """A flat road and the rears of cars on it: (ahead, left, up) of the lower middle, metres.

    `cut` names rows of a rear that something thin hides.
    """
    lens = camera()
    (fx, fy), (cx, cy) = lens.focal_px, lens.principal_px
    row = np.arange(512.0)[:, None] - cy
    depth = np.where(row > 0, HEIGHT_M * fy / np.maximum(row, 1e-9), np.inf)
    depth = np.broadcast_to(depth, (512, 1024)).astype(np.float32)
    label = np.full((512, 1024), ROAD, np.uint8)
    for ahead, left, up in sorted(rears, reverse=True):
        u = cx + fx * np.array([-left - WIDTH / 2, -left + WIDTH / 2]) / ahead
        v = cy + fy * np.array([HEIGHT_M - up - 1.5, HEIGHT_M - up]) / ahead
        part = tuple(
            slice(max(round(low), 0), max(round(high), 0)) for low, high in (v.tolist(), u.tolist())
        )
        depth[part], label[part] = ahead, TRAIN_ID[kind]
        for share in cut:
            label[part[0].start + int(share * (part[0].stop - part[0].start))] = ROAD
    return make_frame(lens, 90, depth, label)


def found(frame, **options):
    return vehicles_of(frame, frame.label, AXES, HEIGHT_M, **options)


def box(ahead, left, *, velocity=None, yaw=0.0, name="car", track=1):
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pose[:3, 3] = (ahead, left, 0.75)
    speed = None if velocity is None else np.array([velocity, 0.0, 0.0])
    return Box(track, name, pose, (LENGTH, WIDTH, 1.5), speed)


def of_boxes(*boxes):
    frame = replace(make_frame(camera(), 90, 50.0), boxes=boxes)
    return vehicles_of(frame, None, AXES, HEIGHT_M)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        *(("car", "car"), ("Car", "car"), ("Truck", "truck"), ("vehicle.bus.rigid", "bus")),
        *(("Bus/RV/Caravan", "bus"), ("Wheeled Slow", None), ("person", None), ("Trailer", None)),
        *(("scar", None), ("van", "car")),
    ],
)
def test_data_sets_names_are_known(name, kind):
    assert kind_of(name) == kind


# From boxes


def test_a_box_is_a_vehicle():
    (car,) = of_boxes(box(20, 3, velocity=-9.0, yaw=np.pi, track=77))
    np.testing.assert_allclose(car.centre_world, [20, 3, 0])
    np.testing.assert_allclose(car.heading_world, [-1, 0, 0], atol=1e-12)
    assert car.velocity_m_per_s.tolist() == [-9, 0, 0]
    assert (car.kind, car.size_m, car.parked) == ("car", (LENGTH, WIDTH, 1.5), False)
    assert not car.centre_world.flags.writeable and not car.velocity_m_per_s.flags.writeable
    assert of_boxes(box(20, 3, velocity=5.0, track=77))[0].key == car.key
    assert of_boxes(box(20, 3, velocity=5.0, track=78))[0].key != car.key
    assert of_boxes(box(20, 3, name="person")) == of_boxes(box(130, 3)) == ()


@pytest.mark.parametrize(
    ("what", "parked"),
    [
        (box(20, 0.5, velocity=0.0), False),
        (box(20, -4, velocity=0.0), True),
        (box(20, 4, velocity=0.0, yaw=np.pi), True),
        (box(20, -4, velocity=3.0), False),
        (box(20, 0.5), False),
        (box(20, -4), True),
        (box(20, 4, yaw=np.pi), False),
        (box(20, 4, yaw=np.pi / 2), True),
    ],
)
def test_who_stands_beside_the_lane_is_parked(what, parked):
    assert of_boxes(what)[0].parked == parked


def test_without_a_velocity_who_drives_goes_as_fast_as_the_camera():
    ahead, comes, stands = of_boxes(box(20, 0), box(20, 3, yaw=np.pi), box(20, -4))
    np.testing.assert_allclose(ahead.velocity_m_per_s, [SPEED, 0, 0], atol=1e-9)
    np.testing.assert_allclose(comes.velocity_m_per_s, [-SPEED, 0, 0], atol=1e-9)
    assert not stands.velocity_m_per_s.any()


def test_two_cameras_know_a_vehicle_by_the_same_key():
    clip = StreetClip(frames=2, width=64, height=48, seed=1)
    seen = []
    for name in ("front", "left", "right"):
        frame = clip.frame(FrameKey(1, name))
        seen.append({v.key: v for v in vehicles_of(frame, None, AXES, 1.6)})
    shared = seen[0].keys() & seen[1].keys()
    assert shared
    for key in shared:
        assert seen[0][key].centre_world.tolist() == seen[1][key].centre_world.tolist()
        assert seen[0][key].parked == seen[1][key].parked


# From pixels


@given(
    ahead=st.floats(8, 55),
    left=st.floats(-1.8, 1.8),
)
def test_a_car_ahead_is_found_where_it_is(ahead, left):
    (car,) = found(street((ahead, left, 0.0)))
    assert not car.parked
    # Half a step of the grid at the car's distance.
    step_m = 4 * ahead / 768
    np.testing.assert_allclose(
        car.centre_world, [ahead + LENGTH / 2, left, 0], rtol=2e-3, atol=step_m
    )
    assert car.heading_world.tolist() == [1, 0, 0]
    assert car.velocity_m_per_s.tolist() == [SPEED, 0, 0]


@pytest.mark.parametrize("side", [1, -1], ids=["right-hand", "left-hand"])
def test_who_is_in_the_other_lane_comes(side):
    options = {"left_hand_traffic": side < 0}
    (comes,) = found(street((20, 3.5 * side, 0)), **options)
    assert comes.heading_world.tolist() == [-1, 0, 0] and not comes.parked
    assert comes.velocity_m_per_s.tolist() == [-SPEED, 0, 0]
    (stands,) = found(street((20, -3.5 * side, 0)), **options)
    assert stands.parked and not stands.velocity_m_per_s.any()
    (far,) = found(street((20, 7.0 * side, 0)), **options)
    assert far.parked


@pytest.mark.parametrize(
    "frame",
    [
        street((20, 0, 1.5)),
        street((5, 4.0, 0)),
        street((75, 0, 0)),
        street((20, 0, 0), cut=np.arange(0, 1, 1 / 70)),
        street((20, 0, 0), kind="person"),
        street(),
    ],
    ids=["hovers", "cut", "far", "broken", "person", "empty"],
)
def test_what_is_no_whole_vehicle_on_the_road_is_skipped(frame):
    assert found(frame) == ()


def test_a_hovering_car_is_a_fault_of_the_footing(monkeypatch):
    monkeypatch.setattr(vehicles, "FOOTING_M", 10.0)
    assert len(found(street((20, 0, 1.5)))) == 1


def test_a_car_hides_a_part_of_the_next_one(monkeypatch):
    row = street((15, -0.4, 0), (24, 0.9, 0))
    assert min(car.centre_world[0] for car in found(row)) == pytest.approx(17.2, abs=0.1)
    monkeypatch.setattr(vehicles, "DEPTH_JUMP", np.inf)
    assert {round(car.centre_world[1], 1) for car in found(row)} != {-0.4}


def test_a_vehicle_across_the_street_has_no_direction():
    lens, frame = camera(), street()
    depth, label = frame.depth_m.copy(), frame.label.copy()
    (fx, fy), (cx, cy) = lens.focal_px, lens.principal_px
    part = (
        slice(round(cy), round(cy + fy * HEIGHT_M / 15)),
        slice(round(cx - fx * 2.2 / 15), round(cx + fx * 2.2 / 15)),
    )
    depth[part], label[part] = 15.0, TRAIN_ID["car"]
    (car,) = found(replace(frame, depth_m=depth, label=label))
    assert car.parked


def test_guesses_agree_with_the_streets_own_boxes():
    near = good = 0
    for seed in (1, 2):
        frame = StreetClip(frames=12, width=768, height=384, seed=seed).frame(FrameKey(10, "front"))
        true = vehicles_of(frame, None, AXES, 1.6)
        for guess in vehicles_of(replace(frame, boxes=()), frame.label, AXES, 1.6):
            off = [np.linalg.norm(guess.centre_world - v.centre_world) for v in true]
            best = true[int(np.argmin(off))]
            if guess.centre_world[0] - frame.camera.centre_world[0] > 45:
                continue
            near += 1
            assert min(off) < 1.0
            same_way = guess.parked or guess.heading_world @ best.heading_world > 0.9
            good += guess.parked == best.parked and same_way
    assert near >= 6
    assert good >= 0.8 * near


def test_a_camera_that_looks_aside_guesses_nothing():
    frame = street((20, 0, 0))
    aside = replace(frame.camera, velocity_m_per_s=np.array([0.0, SPEED, 0.0]))
    assert found(replace(frame, camera=aside)) == ()


def test_nothing_is_changed_and_two_calls_agree():
    frame = street((20, 0, 0), (30, 3.5, 0))
    before = frame.label.tobytes(), frame.depth_m.tobytes()
    first, second = found(frame), found(frame)
    assert [v.key for v in first] == [v.key for v in second] and len(first) == 2
    assert before == (frame.label.tobytes(), frame.depth_m.tobytes())
    half = replace(frame, depth_m=frame.depth_m.astype(np.float16))
    assert [v.key for v in found(half)] == [v.key for v in first]
    assert vehicles_of(frame, None, AXES, HEIGHT_M) == ()
    assert vehicles_of(replace(frame, depth_m=None), frame.label, AXES, HEIGHT_M) == ()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"classes": np.zeros((4, 4), np.uint8)}, "classes"),
        ({"classes": np.zeros((512, 1024), np.int32)}, "classes must be uint8"),
        ({"axes_world": np.eye(2)}, "axes_world"),
        ({"camera_height_m": 0.0}, "camera_height_m"),
        ({"camera_height_m": np.nan}, "camera_height_m"),
    ],
)
def test_bad_arguments_are_refused_by_name(arguments, says):
    frame = street()
    known = {"classes": frame.label, "axes_world": AXES, "camera_height_m": HEIGHT_M}
    with pytest.raises(ArgumentError, match=says):
        vehicles_of(frame, **(known | arguments))
