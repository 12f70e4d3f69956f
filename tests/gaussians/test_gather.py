"""Gaussians at a moment: which are there, where, and in which colours."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tiny_reconstruction import TIMES_S, TRACK_ID, camera_at, tiny_reconstruction

from weather_aug.clip.types import Frame, FrameKey
from weather_aug.errors import ArgumentError
from weather_aug.gaussians import gather as module
from weather_aug.gaussians.actors import offset_basis
from weather_aug.gaussians.gather import camera_of, gather, sky_of
from weather_aug.gaussians.harmonics import colours_seen

STREET = tiny_reconstruction(styles=("snow", "fog"))
STREET = replace(
    STREET,
    styles={
        "snow": STREET.styles["snow"],
        "fog": replace(STREET.styles["fog"], sky=STREET.styles["fog"].sky * np.float16(0.5)),
    },
)
STANDING, MOVING = len(STREET.background), len(STREET.actor_gaussians)
ELSEWHERE = np.eye(4)
ELSEWHERE[:3, :3] = Rotation.from_rotvec((0.1, -0.2, 2.0)).as_matrix()
ELSEWHERE[:3, 3] = (20.0, 2.0, 1.0)
UNIT = st.floats(0, 1)


def covariances(quaternions, scales) -> np.ndarray:
    axes = Rotation.from_quat(np.asarray(quaternions, float), scalar_first=True).as_matrix()
    return np.einsum("nij,nj,nkj->nik", axes, np.asarray(scales, float) ** 2, axes)


def test_all_are_there_activated_with_the_actor_in_its_place():
    got = gather(STREET, TIMES_S[2])
    assert list(got.rows) == list(range(STANDING + MOVING))
    own = STREET.background
    np.testing.assert_array_equal(got.means_m[:STANDING], own.means_m)
    np.testing.assert_allclose(got.scales_m[:STANDING], np.exp(own.log_scales), rtol=1e-6)
    opacity = 1 / (1 + np.exp(-own.logit_opacities.astype(float)))
    np.testing.assert_allclose(got.opacities[:STANDING], opacity, rtol=1e-6)
    shells, pose = STREET.actor_gaussians, STREET.actors[0].world_from_actor[2]
    expected = shells.means_m @ pose[:3, :3].T + pose[:3, 3]
    np.testing.assert_allclose(got.means_m[STANDING:], expected, atol=1e-5)
    np.testing.assert_array_equal(got.class_scores[STANDING:], shells.class_scores)
    assert all(t.dtype == torch.float32 for t in got[:6])


def test_an_actor_is_there_as_long_as_it_was_tracked():
    for time_s, count in ((-0.1, 0), (TIMES_S[0], MOVING), (TIMES_S[-1], MOVING), (1.01, 0)):
        assert len(gather(STREET, time_s).rows) == STANDING + count


def test_without_leaves_out_its_rows_and_no_others():
    everything, less = gather(STREET, 0.1), gather(STREET, 0.1, without=(TRACK_ID,))
    assert list(less.rows) == list(range(STANDING))
    for one, other in zip(everything[:6], less[:6], strict=True):
        assert torch.equal(one[:STANDING], other)


@pytest.mark.parametrize("time_s", [0.3, 5.0])
def test_poses_put_an_actor_elsewhere_even_when_it_was_not_there(time_s):
    got = gather(STREET, time_s, poses={TRACK_ID: ELSEWHERE})
    shells = STREET.actor_gaussians
    expected = shells.means_m @ ELSEWHERE[:3, :3].T + ELSEWHERE[:3, 3]
    np.testing.assert_allclose(got.means_m[STANDING:], expected, atol=1e-5)
    here = covariances(got.quaternions[STANDING:], got.scales_m[STANDING:])
    there = covariances(shells.quaternions, np.exp(shells.log_scales))
    turned = ELSEWHERE[:3, :3] @ there @ ELSEWHERE[:3, :3].T
    np.testing.assert_allclose(here, turned, atol=1e-6)


def look_of_a_turned_actor() -> tuple[torch.Tensor, torch.Tensor]:
    """Colours of the car as recorded, and of one that was turned, with its camera, about z."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec((0.0, 0.0, 2.5)).as_matrix()
    turned = turn @ STREET.actors[0].world_from_actor[0]
    centre = np.array([1.0, 2.0, 3.0])
    recorded = gather(STREET, 0.0).colours_seen(centre)
    moved = gather(STREET, 0.0, poses={TRACK_ID: turned}).colours_seen(turn[:3, :3] @ centre)
    return recorded[STANDING:], moved[STANDING:]


def test_the_look_of_an_actor_turns_with_it(monkeypatch):
    recorded, moved = look_of_a_turned_actor()
    torch.testing.assert_close(recorded, moved, rtol=0, atol=1e-6)
    still = np.eye(3, dtype=np.float32)
    monkeypatch.setattr(
        module, "_turns", lambda r, t, present: torch.from_numpy(np.array([still] * len(present)))
    )
    recorded, moved = look_of_a_turned_actor()
    assert (recorded - moved).abs().max() > 1e-3


def test_colours_are_those_of_the_harmonics_in_world_axes():
    got = gather(STREET, 0.5, origin_m=(3.0, 4.0, 5.0))
    centre = torch.tensor([1.0, 2.0, 3.0])
    expected = colours_seen(got.sh, got.means_m + torch.tensor([3.0, 4.0, 5.0]), centre)
    torch.testing.assert_close(expected, got.colours_seen(centre.numpy()), rtol=0, atol=1e-6)


def test_offsets_move_the_gaussians_of_a_deformable_actor_only():
    rng = np.random.default_rng(0)
    offsets = rng.normal(0, 0.1, STREET.offsets_m.shape).astype(np.float32)
    rigid = replace(STREET, offsets_m=offsets)
    soft = replace(rigid, actors=(replace(STREET.actors[0], is_deformable=True),))
    still = gather(STREET, 0.3).means_m
    assert torch.equal(gather(rigid, 0.3).means_m, still)
    basis = offset_basis(STREET.actors[0].times_s, 0.3, offsets.shape[1])
    shift = np.einsum("mbi,b->mi", offsets.astype(float), basis)
    got = gather(soft, 0.3).means_m - still
    np.testing.assert_allclose(got[STANDING:], shift, atol=1e-5)


def test_another_origin_shifts_the_means():
    origin = np.array([12.25, -3.5, 1.75])
    far, near = gather(STREET, 0.3), gather(STREET, 0.3, origin_m=origin)
    np.testing.assert_allclose(near.means_m.numpy() + origin, far.means_m, atol=2e-6)


@given(snow=UNIT, fog=UNIT, amount=UNIT)
@settings(max_examples=20)
def test_styles_blend_linearly(snow, fog, amount):
    total = max(snow + fog, 1.0)
    weights = {"snow": snow / total, "fog": fog / total}
    got = gather(STREET, 0.3, style=weights, amount=amount)
    own = np.concatenate([STREET.background.sh, STREET.actor_gaussians.sh]).astype(float)
    expected = (1 - amount * sum(weights.values())) * own
    faces = (1 - amount * sum(weights.values())) * STREET.sky.faces.astype(float)
    for name, weight in weights.items():
        style = STREET.styles[name]
        expected += amount * weight * np.concatenate([style.sh, style.actor_sh]).astype(float)
        faces += amount * weight * style.sky.astype(float)
    np.testing.assert_allclose(got.sh, expected, atol=1e-6)
    np.testing.assert_allclose(sky_of(STREET, weights, amount).faces, faces, atol=1e-6)


def test_none_of_a_style_is_the_scene_and_all_of_it_the_style():
    own, none = gather(STREET, 0.3), gather(STREET, 0.3, style="snow", amount=0.0)
    assert torch.equal(own.sh, none.sh)
    whole = gather(STREET, 0.3, style="snow")
    style = STREET.styles["snow"]
    assert torch.equal(
        whole.sh, torch.from_numpy(np.concatenate([style.sh, style.actor_sh])).float()
    )


def test_a_style_of_fewer_harmonics_fades_those_of_the_scene():
    style = STREET.styles["snow"]
    plain = replace(style, sh=style.sh[:, :1], actor_sh=style.actor_sh[:, :1])
    street = replace(STREET, styles={"plain": plain})
    got = gather(street, 0.3, style="plain", amount=0.75).sh[:STANDING]
    np.testing.assert_allclose(got[:, 1:], 0.25 * STREET.background.sh[:, 1:], atol=1e-7)


def test_nothing_of_the_reconstruction_is_changed_and_it_may_be_read_only():
    frozen = tiny_reconstruction()
    for gaussians in (frozen.background, frozen.actor_gaussians):
        for field in fields(gaussians):
            getattr(gaussians, field.name).flags.writeable = False
    got = gather(frozen, 0.3, style="snow", amount=0.5)
    for tensor in got[:6]:
        tensor.zero_()
    np.testing.assert_array_equal(STREET.background.means_m, frozen.background.means_m)


def test_what_is_left_out_is_empty():
    got = gather(STREET, 0.3, colours=False, labels=False)
    assert got.sh.shape == (STANDING + MOVING, 0, 3)
    assert got.class_scores.shape == (STANDING + MOVING, 0)


def test_the_refined_camera_comes_in_the_size_of_the_frame():
    key = FrameKey(0, "front")
    camera = camera_at(3.0).resized(48, 32)
    frame = Frame(key, 0.0, camera, np.zeros((32, 48, 3), np.uint8))
    refined = camera_of(STREET, frame)
    assert (refined.width, refined.height) == (48, 32)
    assert refined.centre_world[0] == 0.0
    other = replace(frame, key=FrameKey(99, "front"))
    assert camera_of(STREET, other) is camera


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"style": "rain"}, "style 'rain' is unknown; there is snow, fog"),
        ({"style": {"snow": -0.1}}, "weight of style 'snow'"),
        ({"style": {"snow": float("nan")}}, "weight of style 'snow'"),
        ({"style": {"snow": 0.7, "fog": 0.4}}, "add up to at most 1, got 1.1"),
        ({"style": "snow", "amount": 1.5}, "amount"),
        ({"without": (3,)}, "without names track 3"),
        ({"poses": {3: np.eye(4)}}, "poses names track 3"),
        ({"poses": {TRACK_ID: np.eye(3)}}, r"must be a finite \(4, 4\)"),
        ({"poses": {TRACK_ID: 2 * np.eye(4)}}, "not a rigid motion"),
        ({"poses": {TRACK_ID: np.diag([1.0, 1, -1, 1])}}, "not a rigid motion"),
    ],
)
def test_what_is_unknown_or_out_of_range_is_refused(arguments, message):
    with pytest.raises(ArgumentError, match=message):
        gather(STREET, 0.3, **arguments)


def test_a_scene_without_styles_says_how_to_get_one():
    with pytest.raises(ArgumentError, match=r"styles\.fit_style"):
        gather(tiny_reconstruction(styles=()), 0.3, style="snow")
