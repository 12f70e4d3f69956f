"""Classes of Gaussians from labels: they come back, and every step makes the labels more likely."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch
from tiny_reconstruction import CAR, TIMES_S, tiny_reconstruction

from weather_aug.clip.types import Frame
from weather_aug.errors import ArgumentError
from weather_aug.gaussians import labels as module
from weather_aug.gaussians.draw import view
from weather_aug.gaussians.gather import gather, one_thread_of_torch, rasterised
from weather_aug.gaussians.labels import fit_labels, recorded_support
from weather_aug.gaussians.types import CLASSES, Reconstruction
from weather_aug.taxonomy import IGNORE, SKY

STREET = tiny_reconstruction()


@pytest.fixture(autouse=True)
def one_thread():
    with one_thread_of_torch():
        yield


def unlabelled(street: Reconstruction) -> Reconstruction:
    background, shells = (
        replace(part, class_scores=np.zeros((len(part), 0), np.float16))
        for part in (street.background, street.actor_gaussians)
    )
    return replace(
        street, background=background, actor_gaussians=shells, support=np.zeros(0, np.float32)
    )


BARE = unlabelled(STREET)


def recorded(street: Reconstruction = STREET) -> list[Frame]:
    frames = []
    for key, camera in street.cameras.items():
        shot = view(street, camera, TIMES_S[key.time_index], want=("image", "label"))
        frames.append(Frame(key, TIMES_S[key.time_index], camera, shot.image, shot.label))
    return frames


FRAMES = recorded()


@lru_cache(maxsize=8)
def fitted(steps: int) -> Reconstruction:
    return fit_labels(BARE, FRAMES, steps=steps)


def agreement(street: Reconstruction, frames: list[Frame] = FRAMES) -> float:
    """Share of pixels whose drawn class is the recorded one."""
    same = [
        view(street, street.cameras[frame.key], frame.time_s, want=("label",)).label == frame.label
        for frame in frames
    ]
    return float(np.mean(same))


def log_likelihood(street: Reconstruction, frames: list[Frame] = FRAMES) -> float:
    """Mean over labelled pixels, of the scores as they are blended."""
    total, count = 0.0, 0
    for frame in frames:
        gathered = gather(street, frame.time_s)
        drawn = rasterised(gathered, street.cameras[frame.key], gathered.class_scores)
        shares = drawn.colours.double().numpy()
        shares[..., SKY] += 1 - drawn.opacity.double().numpy()
        known = frame.label != IGNORE
        chosen = shares[known, frame.label[known]]
        total, count = total + np.log(np.maximum(chosen, 1e-6)).sum(), count + known.sum()
    return total / count


def test_labels_of_known_scores_come_back():
    assert agreement(fitted(4)) >= 0.999


def test_they_hold_for_views_between_the_recorded_ones():
    between = [
        Frame(key, 0.1, camera, np.zeros((64, 96, 3), np.uint8), view(STREET, camera, 0.1).label)
        for key, camera in STREET.cameras.items()
    ]
    assert agreement(fitted(4), between) >= 0.99


def test_every_step_makes_the_labels_more_likely():
    likelihoods = [log_likelihood(fitted(steps)) for steps in (1, 2, 3, 4)]
    assert likelihoods == sorted(likelihoods)
    assert agreement(fitted(1)) < agreement(fitted(4))


def test_scores_are_shares():
    got = fitted(4)
    for part in (got.background, got.actor_gaussians):
        assert part.class_scores.shape == (len(part), CLASSES)
        assert part.class_scores.dtype == np.float16
        sums = part.class_scores.astype(float).sum(axis=1)
        assert (np.isclose(sums, 1, atol=2e-3) | (sums == 0)).all()
    shown = got.support > 1
    assert (got.background.class_scores[shown].astype(float).sum(axis=1) > 0.99).all()
    assert (got.background.class_scores[got.support == 0] == 0).all()


def test_actors_get_their_class():
    scores = fitted(4).actor_gaussians.class_scores.astype(float)
    known = scores.sum(axis=1) > 0
    assert known.any()
    assert (scores[known].argmax(axis=1) == CAR).mean() > 0.9


def test_geometry_and_colours_are_left_alone():
    got = fitted(4)
    assert got.background.means_m is BARE.background.means_m
    assert got.background.sh is BARE.background.sh
    assert got.sky is BARE.sky


def test_pixels_to_ignore_say_nothing():
    rng = np.random.default_rng(0)
    holed, wrong = [], []
    for frame in FRAMES:
        holes = rng.random(frame.label.shape) < 0.3
        holed.append(replace(frame, label=np.where(holes, np.uint8(IGNORE), frame.label)))
        wrong.append(replace(frame, label=np.where(holes, np.uint8(CAR), frame.label)))
    got = fit_labels(BARE, holed)
    assert agreement(got) >= 0.99
    assert fitted(4).support == pytest.approx(got.support)
    assert agreement(fit_labels(BARE, wrong)) < 0.99


def test_frames_without_a_label_count_for_the_support_only():
    half = [replace(f, label=None) if f.key.time_index % 2 else f for f in FRAMES]
    got = fit_labels(BARE, half)
    np.testing.assert_allclose(fitted(4).support, got.support, rtol=1e-5)
    assert agreement(got) >= 0.99


def test_support_is_how_many_pixels_each_made_up():
    street = unlabelled(tiny_reconstruction(car=False))
    total = 0.0
    for frame in FRAMES:
        gathered = gather(street, frame.time_s)
        camera = street.cameras[frame.key]
        total += float(rasterised(gathered, camera, gathered.opacities[:, None]).opacity.sum())
    support = recorded_support(street, FRAMES)
    assert support.sum() == pytest.approx(total, rel=1e-5)
    # One Gaussian alone: its weight is the opacity that it makes.
    row = int(support.argmax())
    alone = torch.zeros(len(support), 1)
    alone[row] = 1
    made = sum(
        float(rasterised(gather(street, f.time_s), street.cameras[f.key], alone).colours.sum())
        for f in FRAMES
    )
    assert support[row] == pytest.approx(made, rel=1e-5)


def test_threads_and_order_matter_to_rounding_only():
    other = fit_labels(BARE, FRAMES[::-1], steps=2, threads=2)
    ours = fitted(2).background.class_scores.astype(float)
    np.testing.assert_allclose(ours, other.background.class_scores.astype(float), atol=2e-3)


def test_frames_are_seen_through_the_refined_cameras(monkeypatch):
    off = []
    for frame in FRAMES:
        pose = frame.camera.world_from_camera.copy()
        pose[1, 3] += 0.8
        off.append(replace(frame, camera=replace(frame.camera, world_from_camera=pose)))
    assert agreement(fit_labels(BARE, off)) >= 0.999
    monkeypatch.setattr(module, "camera_of", lambda reconstruction, frame: frame.camera)
    assert agreement(fit_labels(BARE, off)) < 0.97


def test_what_cannot_be_fitted_is_refused():
    with pytest.raises(ArgumentError, match="no frame has a label"):
        fit_labels(BARE, [replace(frame, label=None) for frame in FRAMES])
    with pytest.raises(ArgumentError, match="steps must be at least 1"):
        fit_labels(BARE, FRAMES, steps=0)
