"""Particles among the scene's Gaussians, against air and particles over the scene's picture."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tiny_reconstruction import SPEED_M_PER_S, TRACK_ID, camera_at, tiny_reconstruction

from weather_aug.clip.types import Camera, Frame, FrameKey
from weather_aug.edit.ambience import Ambience, ambience_of
from weather_aug.errors import ArgumentError
from weather_aug.gaussians.draw import View, view
from weather_aug.gaussians.types import Reconstruction
from weather_aug.render import joint
from weather_aug.render.compose import render
from weather_aug.render.joint import render_joint
from weather_aug.render.options import EFFECTS, RenderOptions
from weather_aug.weather import Weather

UInt8 = NDArray[np.uint8]

AIR_ALONE = RenderOptions(without=EFFECTS)
AXES = np.eye(3)
SIZE_PX = (192, 108)
RAIN, SNOW = Weather.rain("heavy"), Weather.snow("heavy")
AIM_DB = 40.0


def psnr_db(one: UInt8, other: UInt8) -> float:
    return float(10 * np.log10(255**2 / np.mean((one.astype(float) - other) ** 2)))


def driving(time_s: float, size_px: tuple[int, int] = SIZE_PX) -> Camera:
    camera = camera_at(SPEED_M_PER_S * time_s, size_px=size_px)
    return replace(camera, velocity_m_per_s=np.array([SPEED_M_PER_S, 0.0, 0.0]))


def layered(
    scene: Reconstruction, camera: Camera, time_s: float, weather: Weather, seed: int
) -> tuple[UInt8, Ambience, View]:
    """The picture and its depth first, then the weather over it."""
    seen = view(scene, camera, time_s, want=("image", "depth"))
    assert seen.image is not None
    frame = Frame(FrameKey(0, "front"), time_s, camera, seen.image, None, seen.depth_m)
    ambience = ambience_of(frame, AXES)
    shot = render(frame, weather, seed=seed, ambience=ambience, options=AIR_ALONE)
    return shot.image, ambience, seen


def compared(weather: Weather) -> float:
    scene, camera = tiny_reconstruction(spacing_m=0.2), driving(0.2)
    two, ambience, _ = layered(scene, camera, 0.2, weather, 3)
    one = render_joint(scene, camera, 0.2, weather, seed=3, ambience=ambience, options=AIR_ALONE)
    return psnr_db(two, one)


@pytest.mark.parametrize("weather", [RAIN, SNOW], ids=["rain", "snow"])
def test_it_looks_like_two_layers(weather: Weather) -> None:
    assert compared(weather) > AIM_DB - 2


@pytest.mark.slow
@pytest.mark.parametrize("size_px", [(320, 180)])
def test_twenty_frames_look_like_two_layers(size_px: tuple[int, int]) -> None:
    """Surfaces as sharp as a fit makes them; each frame by itself."""
    scene = tiny_reconstruction(spacing_m=0.1)
    found = []
    for index, time_s in enumerate((0.0, 0.2, 0.4, 0.6, 0.8)):
        camera = driving(time_s, size_px)
        for kind in (Weather.rain, Weather.snow):
            for severity in ("moderate", "heavy"):
                weather = kind(severity)
                two, ambience, _ = layered(scene, camera, time_s, weather, index)
                one = render_joint(
                    scene,
                    camera,
                    time_s,
                    weather,
                    seed=index,
                    ambience=ambience,
                    options=AIR_ALONE,
                )
                found.append(psnr_db(two, one))
    assert len(found) == 20
    assert min(found) > AIM_DB, np.round(found, 1)


def test_without_weather_it_is_the_scenes_own_picture() -> None:
    scene, camera = tiny_reconstruction(), driving(0.2)
    two, ambience, _ = layered(scene, camera, 0.2, Weather.clear(), 0)
    for exposure in (
        np.eye(3, 4),
        np.array([[0.8, 0.1, 0, 0.05], [0, 0.9, 0, 0.02], [0, 0, 1, 0]]),
    ):
        key = FrameKey(1, "front")
        exposed = replace(scene, exposures={key: exposure.astype(np.float32)})
        expected = view(exposed, camera, 0.2, key=key, want=("image",)).image
        found = render_joint(
            exposed, camera, 0.2, Weather.clear(), seed=0, ambience=ambience, key=key
        )
        assert expected is not None
        assert np.abs(expected.astype(int) - found).max() <= 1
    assert two.shape == found.shape


def test_blending_linear_light_alone_would_brighten_the_scene(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene, camera = tiny_reconstruction(), driving(0.2)
    two, ambience, _ = layered(scene, camera, 0.2, Weather.clear(), 0)
    monkeypatch.setattr(joint, "_factor", lambda *_: 1.0)
    found = render_joint(scene, camera, 0.2, Weather.clear(), seed=0, ambience=ambience)
    assert (found.astype(int) - two).mean() > 1.0
    assert psnr_db(two, found) < AIM_DB


@pytest.mark.parametrize("share", [1e-3, 1e3], ids=["before the scene", "behind the scene"])
def test_a_wrong_order_is_found(share: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before a wall some metres away; planted fault: all particles on one side of it."""
    storm = Weather.snow("extreme")
    scene = tiny_reconstruction(spacing_m=0.2, car=False)
    camera = camera_at(15.0, yaw_deg=70.0, size_px=SIZE_PX)
    two, ambience, _ = layered(scene, camera, 0.2, storm, 3)
    arguments: dict[str, Any] = {"seed": 3, "ambience": ambience, "options": AIR_ALONE}
    right = psnr_db(two, render_joint(scene, camera, 0.2, storm, **arguments))
    assert right > AIM_DB
    particles = joint._particles

    def moved(splats: Any) -> Any:
        falling, light = particles(splats)
        return falling._replace(depths_m=np.float32(share) * falling.depths_m), light

    monkeypatch.setattr(joint, "_particles", moved)
    assert psnr_db(two, render_joint(scene, camera, 0.2, storm, **arguments)) < right - 2


def test_air_that_is_left_out_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    fog = Weather.fog(visibility_m=60.0, fog_patchiness=0.0, fog_puffs=0.0)
    assert compared(fog) > 36
    monkeypatch.setattr(joint, "_through", lambda scene, *_: np.ones(len(scene.depths_m), "f4"))
    assert compared(fog) < 25


def test_another_seed_is_other_weather() -> None:
    scene, camera = tiny_reconstruction(), driving(0.2)
    _, ambience, _ = layered(scene, camera, 0.2, SNOW, 3)
    shots = [
        render_joint(scene, camera, 0.2, SNOW, seed=seed, ambience=ambience) for seed in (3, 3, 4)
    ]
    np.testing.assert_array_equal(shots[0], shots[1])
    assert (shots[0] != shots[2]).any()


def test_differences_lie_where_pixels_share_surfaces() -> None:
    """At the soft edges of surfaces; inside of them both are the same."""
    scene, camera = tiny_reconstruction(spacing_m=0.2), driving(0.2)
    two, ambience, seen = layered(scene, camera, 0.2, RAIN, 3)
    one = render_joint(scene, camera, 0.2, RAIN, seed=3, ambience=ambience, options=AIR_ALONE)
    off = np.abs(two.astype(int) - one).max(axis=-1)
    soft = (seen.opacity > 0.02) & (seen.opacity < 0.98)
    assert off[~soft].mean() < 0.25 * off[soft].mean()
    hard = ~soft[..., None] & np.ones(3, bool)
    assert psnr_db(two[hard], one[hard]) > AIM_DB + 3


def test_actors_and_styles_are_the_gathered_ones() -> None:
    scene, camera = tiny_reconstruction(), driving(0.2)
    _, ambience, _ = layered(scene, camera, 0.2, SNOW, 0)
    arguments: dict[str, Any] = {"seed": 0, "ambience": ambience}
    plain = render_joint(scene, camera, 0.2, SNOW, **arguments)
    white = render_joint(scene, camera, 0.2, SNOW, style="snow", **arguments)
    empty = render_joint(scene, camera, 0.2, SNOW, without=[TRACK_ID], **arguments)
    assert white.mean() > plain.mean() + 5
    assert (empty != plain).any()


def test_what_is_not_drawn_here_is_refused() -> None:
    scene, camera = tiny_reconstruction(), driving(0.2)
    ambience = layered(scene, camera, 0.2, SNOW, 0)[1]
    arguments: dict[str, Any] = {"seed": 0, "ambience": ambience}
    patchy = Weather.fog(visibility_m=100.0, fog_patchiness=0.5)
    with pytest.raises(ArgumentError, match="even fog"):
        render_joint(scene, camera, 0.2, patchy, **arguments)
    for options in (RenderOptions(alignment="camera"), RenderOptions(multiple_scattering=True)):
        with pytest.raises(ArgumentError, match=r"compose\.render"):
            render_joint(scene, camera, 0.2, SNOW, options=options, **arguments)
    with pytest.raises(ArgumentError, match="no exposure"):
        render_joint(scene, camera, 0.2, SNOW, key=FrameKey(9, "rear"), **arguments)
    with pytest.raises(ArgumentError, match="Weather"):
        render_joint(scene, camera, 0.2, "snow", **arguments)  # type: ignore[arg-type]
