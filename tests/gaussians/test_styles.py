"""Colours of other weathers: what was painted comes back, in few steps, at any exposure."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch
from tiny_reconstruction import TIMES_S, tiny_reconstruction

from weather_aug.clip.types import Frame, FrameKey
from weather_aug.errors import ArgumentError, DataError
from weather_aug.gaussians import styles as module
from weather_aug.gaussians.draw import view
from weather_aug.gaussians.gather import gather, one_thread_of_torch
from weather_aug.gaussians.styles import _basis, _Colours, _Pictures, fit_style, fit_styles
from weather_aug.gaussians.types import Reconstruction, Sky

PAINTED = tiny_reconstruction(styles=("snow",))
RNG = np.random.default_rng(0)
EXPOSURES = {
    key: (np.eye(3, 4) + RNG.normal(0, 0.05, (3, 4))).astype(np.float32) for key in PAINTED.cameras
}
EXPOSED = replace(PAINTED, exposures=EXPOSURES)


@pytest.fixture(autouse=True)
def one_thread():
    with one_thread_of_torch():
        yield


def shots(street: Reconstruction, style: str | None) -> list[Frame]:
    frames = []
    for key, camera in street.cameras.items():
        time_s = TIMES_S[key.time_index]
        image = view(street, camera, time_s, style=style, key=key, want=("image",)).image
        frames.append(Frame(key, time_s, camera, image))
    return frames


SNOWED, OWN = shots(PAINTED, "snow"), shots(PAINTED, None)
BARE = replace(PAINTED, styles={})


@lru_cache(maxsize=4)
def fitted(steps: int = 8) -> Reconstruction:
    return fit_style(BARE, SNOWED, "snow", steps=steps)


def psnr_db(street: Reconstruction, frames: list[Frame], style: str = "snow") -> float:
    pairs = zip(frames, shots(street, style), strict=True)
    squares = [((a.image / 255 - b.image / 255) ** 2).mean() for a, b in pairs]
    return -10 * float(np.log10(np.mean(squares)))


def test_a_known_recolouring_comes_back():
    assert psnr_db(replace(PAINTED, styles={"snow": own_style()}), SNOWED) < 15
    assert psnr_db(fitted(), SNOWED) >= 35


def own_style():
    """A style that changes nothing."""
    half = np.float16
    return replace(
        PAINTED.styles["snow"],
        sh=PAINTED.background.sh.astype(half),
        actor_sh=PAINTED.actor_gaussians.sh.astype(half),
        sky=PAINTED.sky.faces.astype(half),
    )


def test_it_holds_between_the_recorded_views():
    camera = PAINTED.cameras[FrameKey(2, "front")]
    pose = camera.world_from_camera.copy()
    pose[:3, 3] += (0.5, 0.4, 0.2)
    moved = replace(camera, world_from_camera=pose)
    expected, got = (
        view(street, moved, 0.5, style="snow", want=("image", "seen"))
        for street in (PAINTED, fitted())
    )
    square = ((expected.image / 255.0 - got.image / 255.0)[expected.seen] ** 2).mean()
    assert -10 * np.log10(square) >= 30


def test_every_step_comes_closer():
    gains = [psnr_db(fitted(steps), SNOWED) for steps in (1, 2, 4, 8)]
    assert gains == sorted(gains)


def test_frames_that_were_not_edited_change_nothing():
    street = fit_style(BARE, OWN, "none")
    assert psnr_db(street, OWN, "none") >= 45
    drift = np.abs(street.styles["none"].sh.astype(float) - BARE.background.sh)
    assert np.percentile(drift, 90) < 0.02


def test_an_exposure_is_undone(monkeypatch):
    frames = shots(EXPOSED, "snow")
    bare = replace(EXPOSED, styles={})
    street = fit_style(bare, frames, "snow")
    assert psnr_db(street, frames) >= 35
    # The scene's own colours, without any exposure, are those that were painted.
    plain = replace(street, exposures=PAINTED.exposures)
    assert psnr_db(plain, SNOWED) >= 35
    monkeypatch.setattr(module, "nearest", lambda exposures, key: np.eye(3, 4))
    assert psnr_db(fit_style(bare, frames, "snow"), frames) < 30


def test_several_at_once_are_what_they_are_alone():
    grey = [replace(frame, image=frame.image // 2 + 60) for frame in OWN]
    both = fit_styles(BARE, {"snow": SNOWED, "grey": grey}, steps=3).styles
    for name, frames in (("snow", SNOWED), ("grey", grey)):
        alone = fit_style(BARE, frames, name, steps=3).styles[name]
        for part in ("sh", "actor_sh", "sky"):
            one, other = (getattr(style, part).astype(float) for style in (alone, both[name]))
            np.testing.assert_allclose(one, other, atol=4e-3)


def test_other_styles_and_the_geometry_are_left_alone():
    street = fit_style(PAINTED, OWN, "none", steps=1)
    assert list(street.styles) == ["snow", "none"]
    assert street.styles["snow"] is PAINTED.styles["snow"]
    assert street.background is PAINTED.background
    assert street.sky is PAINTED.sky


def test_a_style_is_half_floats_with_a_sky_half_as_fine():
    style = fitted().styles["snow"]
    assert style.sh.shape == PAINTED.background.sh.shape
    assert style.actor_sh.shape == PAINTED.actor_gaussians.sh.shape
    side = PAINTED.sky.faces.shape[1]
    assert style.sky.shape == (6, side // 2, side // 2, 3)
    assert {style.sh.dtype, style.actor_sh.dtype, style.sky.dtype} == {np.dtype(np.float16)}


def test_a_scene_without_actors_or_directions_has_styles_too():
    plain = tiny_reconstruction(car=False, styles=())
    background = replace(plain.background, sh=np.ascontiguousarray(plain.background.sh[:, :1]))
    shells = replace(plain.actor_gaussians, sh=plain.actor_gaussians.sh[:, :1])
    street = replace(plain, background=background, actor_gaussians=shells)
    frames = shots(street, None)
    style = fit_style(street, frames, "own", steps=1).styles["own"]
    assert style.sh.shape == (len(background), 1, 3)
    assert style.actor_sh.shape == (0, 1, 3)


def test_sky_that_nobody_saw_changes_with_the_rest():
    style = fitted().styles["snow"]
    change = style.sky.repeat(2, axis=1).repeat(2, axis=2).astype(float) - BARE.sky.faces
    below = change[5]
    assert np.ptp(below.reshape(-1, 3), axis=0).max() < 2e-3
    seen = change[0][:6]
    assert np.abs(below.mean((0, 1)) - seen.mean((0, 1))).max() < 0.15


def test_what_no_frame_shows_keeps_the_colours_of_the_scene():
    hidden = BARE.background.means_m[:, 0] < -1
    style = fitted().styles["snow"]
    np.testing.assert_allclose(
        style.sh[hidden].astype(float), BARE.background.sh[hidden], atol=2e-3
    )


def test_the_basis_is_that_of_the_harmonics():
    gathered = gather(BARE, 0.3)
    colours = gathered.colours_seen(np.zeros(3))
    seen = 0.5 + torch.einsum("kr,rkc->rc", _basis(gathered.means_m), gathered.sh)
    torch.testing.assert_close(colours, seen.clamp_min(0), rtol=0, atol=1e-6)


def test_carrying_back_is_the_transpose_of_drawing():
    """The square of a picture, and the product of a change with what comes back, are one."""
    channels = 6
    shape = BARE.sky.faces.shape[:3]
    count = len(BARE.background) + len(BARE.actor_gaussians)
    generator = torch.Generator().manual_seed(0)
    change = _Colours(
        torch.randn(4, count, channels, generator=generator),
        torch.randn(*shape, channels, generator=generator),
    )
    with module.tqdm(disable=True) as bar:
        back, square = _Pictures(BARE, SNOWED, 1, bar).normal(change)
    torch.testing.assert_close(change.dot(back), square, rtol=1e-4, atol=0)


def test_what_cannot_be_fitted_is_refused():
    for edited in ({}, {"snow": []}):
        with pytest.raises(ArgumentError, match="edited must hold frames"):
            fit_styles(BARE, edited)
    with pytest.raises(ArgumentError, match="'grey' are not those of the others"):
        fit_styles(BARE, {"snow": SNOWED, "grey": OWN[:-1]})
    with pytest.raises(ArgumentError, match="steps must be at least 1"):
        fit_style(BARE, SNOWED, "snow", steps=0)
    flat = replace(BARE, exposures=dict.fromkeys(BARE.exposures, np.zeros((3, 4), np.float32)))
    with pytest.raises(DataError, match="cannot be undone"):
        fit_style(flat, SNOWED, "snow")
    blind = replace(BARE, sky=Sky(BARE.sky.faces, np.zeros_like(BARE.sky.seen)))
    assert fit_style(blind, SNOWED, "snow", steps=1).sky is blind.sky
