"""Frames from elsewhere: near the recording where it was made, honest where nothing was seen."""

from __future__ import annotations

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from gaussian_clip import street
from tiny_reconstruction import CAR, TRACK_ID

from weather_aug.clip.types import Box, Frame, FrameKey
from weather_aug.errors import ArgumentError
from weather_aug.gaussians.draw import view
from weather_aug.render.compose import RenderedFrame
from weather_aug.render.options import EFFECTS, RenderOptions
from weather_aug.scene import novel, styles
from weather_aug.scene.novel import boxes_at
from weather_aug.scene.scene import WeatherScene
from weather_aug.scene.styles import CARRIED, lying_in, style_weather
from weather_aug.scene.viewpoint import Viewpoint
from weather_aug.taxonomy import IGNORE
from weather_aug.weather import Weather

KEY = FrameKey(2, "front")
BESIDE = Viewpoint(lateral_m=1.0, height_m=0.2, yaw_deg=4.0)
BACK = Viewpoint(forward_m=-4.0, yaw_deg=25.0)
"""Looks at a part of the wall that no frame showed."""
RAIN, SNOW, CLEAR = Weather.rain("heavy"), Weather.snow("heavy"), Weather.clear()
PLANES = ("image", "label", "label_full", "invalid", "transmittance", "depth")


def bytes_of(shot: RenderedFrame) -> list[bytes]:
    return [np.ascontiguousarray(getattr(shot, name)).tobytes() for name in PLANES]


def psnr_db(one: Any, other: Any) -> float:
    error = np.mean((np.asarray(one, float) - np.asarray(other, float)) ** 2)
    return float(20 * np.log10(255 / np.sqrt(max(error, 1e-9))))


# Frames


def test_at_the_recorded_place_it_is_the_recorded_frame(gaussian_scene: WeatherScene) -> None:
    """The scene's Gaussians are those that the recording shows."""
    for key in gaussian_scene.keys:
        frame, seen = gaussian_scene.frame_from(key)
        recorded = gaussian_scene.frame(key)
        assert psnr_db(frame.image, recorded.image) > 45
        assert seen.mean() > 0.98
        assert (frame.label == recorded.label)[seen].mean() > 0.98
        off = frame.depth_m[np.isfinite(recorded.depth_m)].astype(float)
        assert np.allclose(off, recorded.depth_m[np.isfinite(recorded.depth_m)], rtol=0.02)
        assert frame.key == key and frame.time_s == recorded.time_s
        assert frame.normals_world is not None


def test_it_follows_the_viewpoint(gaussian_scene: WeatherScene) -> None:
    moved = gaussian_scene.frame_from(KEY, BESIDE)
    there = moved.frame.camera
    direct = view(street(), there, moved.frame.time_s, key=KEY)
    assert psnr_db(moved.frame.image, direct.image) > 45
    assert psnr_db(moved.frame.image, gaussian_scene.frame(KEY).image) < 30
    same = gaussian_scene.frame_from(KEY, camera=there)
    assert (same.frame.image == moved.frame.image).all()


def test_what_was_never_seen_has_no_label(gaussian_scene: WeatherScene) -> None:
    frame, seen = gaussian_scene.frame_from(KEY, BACK)
    assert 0.1 < (~seen).mean() < 0.6
    assert (frame.label[~seen] == IGNORE).all()
    shot = gaussian_scene.render(KEY, RAIN, viewpoint=BACK)
    for label in (shot.label, shot.label_full, shot.frame.label):
        assert (label[~seen] == IGNORE).all()
    assert (shot.invalid[~seen] == 1).all()


def test_a_mask_that_is_left_out_is_noticed(
    gaussian_scene: WeatherScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(novel.NovelFrame, "masked", lambda self: self)
    frame, seen = gaussian_scene.frame_from(KEY, BACK)
    assert not (frame.label[~seen] == IGNORE).all()


def test_a_car_can_be_left_out_and_put_elsewhere(gaussian_scene: WeatherScene) -> None:
    with_it = gaussian_scene.frame_from(KEY).frame
    without = gaussian_scene.frame_from(KEY, without=[TRACK_ID]).frame
    assert (with_it.label == CAR).any() and len(with_it.boxes) == 1
    # Gaussians beside the car got a share of its label.
    few = 0.1 * (with_it.label == CAR).sum()
    assert (without.label == CAR).sum() < few and without.boxes == ()
    pose = with_it.boxes[0].world_from_box.copy()
    pose[:3, 3] += (0.0, 3.0, 0.0)
    moved = gaussian_scene.frame_from(KEY, poses={TRACK_ID: pose}).frame
    assert (moved.boxes[0].world_from_box == pose).all()
    columns = [np.nonzero(frame.label == CAR)[1].mean() for frame in (with_it, moved)]
    assert columns[1] < columns[0] - 5
    shot = gaussian_scene.render(KEY, RAIN, without_actors=[TRACK_ID])
    assert (shot.label_full == CAR).sum() < few


def test_another_moment_moves_what_moves(gaussian_scene: WeatherScene) -> None:
    now = gaussian_scene.frame_from(KEY).frame
    later = gaussian_scene.frame_from(KEY, time_s=now.time_s + 0.3).frame
    step = later.boxes[0].world_from_box[:3, 3] - now.boxes[0].world_from_box[:3, 3]
    assert np.allclose(step, (1.5, 0.0, 0.0))
    assert later.time_s == now.time_s + 0.3
    assert (later.label == CAR).sum() < (now.label == CAR).sum()


def test_boxes_of_what_stands_stay_and_velocities_turn() -> None:
    (car,) = street().actors
    parked = Box(3, "car", np.eye(4), (4.0, 2.0, 1.5))
    own = Box(TRACK_ID, "car", car.world_from_actor[1], car.size_m, np.array([4.0, 0.0, 0.0]))
    key, image = FrameKey(1, "front"), np.zeros((64, 96, 3), np.uint8)
    recorded = Frame(key, 0.2, street().cameras[key], image, boxes=(own, parked))
    kept, moving = boxes_at([car], recorded, 0.2, (), {})
    assert kept is parked and moving.velocity_m_per_s.tolist() == [4.0, 0.0, 0.0]
    _, later = boxes_at([car], recorded, 0.5, (), {})
    assert np.allclose(later.velocity_m_per_s, (5.0, 0.0, 0.0))
    left = np.array([[0.0, -1, 0, 9], [1, 0, 0, 8], [0, 0, 1, 0.95], [0, 0, 0, 1]])
    _, put = boxes_at([car], recorded, 0.2, (), {TRACK_ID: left})
    assert np.allclose(put.velocity_m_per_s, (0.0, 4.0, 0.0))
    assert boxes_at([car], recorded, 99.0, (), {}) == (parked,)
    assert boxes_at([car], recorded, 0.2, (TRACK_ID,), {}) == (parked,)


# Renders


def test_renders_are_a_function_of_their_arguments(gaussian_scene: WeatherScene) -> None:
    shot = gaussian_scene.render(KEY, RAIN, seed=3, viewpoint=BESIDE)
    again = pickle.loads(pickle.dumps(gaussian_scene)).render(KEY, RAIN, seed=3, viewpoint=BESIDE)
    assert bytes_of(shot) == bytes_of(again)
    other = gaussian_scene.render(KEY, RAIN, seed=4, viewpoint=BESIDE)
    assert shot.image.tobytes() != other.image.tobytes()


def test_a_window_has_the_bytes_of_the_whole(gaussian_scene: WeatherScene) -> None:
    whole = gaussian_scene.render(KEY, SNOW, viewpoint=BACK, style="snow")
    part = gaussian_scene.render(KEY, SNOW, viewpoint=BACK, style="snow", window=(8, 16, 40, 64))
    for name in PLANES:
        assert (getattr(whole, name)[8:48, 16:80] == getattr(part, name)).all(), name


def test_weather_at_the_recorded_place_is_the_recorded_frames(
    gaussian_scene: WeatherScene,
) -> None:
    recorded = gaussian_scene.render(KEY, RAIN, seed=1)
    drawn = gaussian_scene.render(KEY, RAIN, seed=1, viewpoint=Viewpoint())
    assert psnr_db(drawn.image, recorded.image) > 30
    seen = drawn.label_full != IGNORE
    assert (drawn.label == recorded.label)[seen].mean() > 0.98


def test_a_clear_day_from_elsewhere_is_the_gaussians_own_picture(
    gaussian_scene: WeatherScene,
) -> None:
    frame, seen = gaussian_scene.frame_from(KEY, BESIDE)
    shot = gaussian_scene.render(KEY, CLEAR, viewpoint=BESIDE)
    assert (shot.image == frame.image).all()
    assert (shot.label == frame.label).all()
    assert (shot.invalid == ~seen).all()


def test_styles_show_their_weather_and_are_not_dressed_again(
    gaussian_scene: WeatherScene,
) -> None:
    """After snow, in clear air, a style is the picture: nothing that lies is drawn twice."""
    after = replace(Weather.snow("heavy", falling=False), lamps=0.0, overcast=0.0)
    quiet = RenderOptions(without=("spray", "lamps", "noise", "glare", "compression", "exposure"))
    styled = gaussian_scene.frame_from(KEY, style="snow").frame
    shot = gaussian_scene.render(KEY, after, style="snow", options=quiet)
    assert (shot.image == styled.image).all()
    dressed = gaussian_scene.render(KEY, after, viewpoint=Viewpoint(), options=quiet)
    assert psnr_db(dressed.image, styled.image) < 30


def test_a_style_dressed_twice_is_noticed(
    gaussian_scene: WeatherScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(styles, "CARRIED", ())
    with pytest.raises(AssertionError):
        test_styles_show_their_weather_and_are_not_dressed_again(gaussian_scene)


def test_styles_have_an_amount_and_mix(gaussian_scene: WeatherScene) -> None:
    def light(**choices: Any) -> float:
        return float(gaussian_scene.frame_from(KEY, **choices).frame.image.mean())

    none, half, whole = (light(style="snow", amount=amount) for amount in (0.0, 0.5, 1.0))
    assert none < half < whole
    assert none == light()
    mixed = light(style={"snow": 0.25, "rain": 0.25})
    assert abs(mixed - half) < 1


def test_labels_are_buried_under_the_styles_snow_not_the_weathers() -> None:
    snow, rain = lying_in("snow", 0.5), lying_in("rain", 1.0)
    heavy = Weather.snow("heavy")
    assert snow.snow_cover == pytest.approx(0.5 * heavy.snow_cover)
    assert snow.snow_depth_m == pytest.approx(0.5 * heavy.snow_depth_m)
    assert rain.is_clear and lying_in(None, 1.0).is_clear
    assert lying_in({"snow": 0.5, "rain": 0.5}, 1.0) == snow


def test_snow_on_a_style_buries_borders(gaussian_scene: WeatherScene) -> None:
    """As `render` does of the same label when the editor draws that snow."""
    deep = replace(SNOW, snow_cover=1.0, road_snow_cover=1.0, snow_depth_m=0.2)
    frame = gaussian_scene.frame_from(KEY)
    label = frame.frame.label.copy()
    label[40:, :48] = 1
    faked = frame._replace(frame=replace(frame.frame, label=label))
    shot = RenderedFrame(
        faked.frame.image,
        *(label.copy(), label.copy()),
        np.zeros((64, 96), np.uint8),
        np.ones((64, 96), np.float32),
        *(faked.frame, (0, 0, 64, 96)),
    )
    honest = novel.honest(shot, faked, deep, RenderOptions())
    assert (honest.label == IGNORE).sum() > (shot.label == IGNORE).sum()
    assert (honest.label_full == label)[frame.seen].all()
    kept = novel.honest(shot, faked, deep, RenderOptions(labels="keep"))
    assert (kept.label == label)[frame.seen].all()
    bare = novel.honest(shot, faked, Weather.clear(), RenderOptions())
    assert (bare.label == label)[frame.seen].all()


def test_a_style_is_weather_without_anything_in_the_air() -> None:
    for name in ("rain", "snow", "fog"):
        weather = style_weather(name)
        assert weather is not None and weather.overcast == 1.0
        assert weather.rain_mm_per_h == weather.snow_mm_per_h == weather.mist_per_km == 0
        assert weather.visibility_m == np.inf and weather.spray_per_km == 0
        assert weather.lamps == weather.lens_drops == weather.wipers == 0
    assert style_weather("dusk") is None
    assert set(CARRIED) <= set(EFFECTS)


def test_a_higher_camera_is_known_to_stand_higher(gaussian_scene: WeatherScene) -> None:
    """The plane of the road, which the editor finds, stays where it is."""
    low, high = (
        gaussian_scene._looked_at(gaussian_scene.frame_from(KEY, Viewpoint(height_m=up)).frame)
        for up in (0.0, 1.0)
    )
    assert np.allclose(low.plane, high.plane, atol=0.1)


# What is refused


def test_a_scene_without_gaussians_names_the_cure(tiny_scene: WeatherScene) -> None:
    for call in (
        lambda: tiny_scene.frame_from(KEY),
        lambda: tiny_scene.render(KEY, RAIN, viewpoint=Viewpoint()),
        lambda: tiny_scene.render(KEY, RAIN, style="snow"),
    ):
        with pytest.raises(ArgumentError, match="reconstruct=True"):
            call()


@pytest.mark.parametrize(
    ("choices", "message"),
    [
        ({"viewpoint": (1, 0, 0)}, "viewpoint must be a Viewpoint"),
        ({"style": "dusk"}, "dusk"),
        ({"style": "snow", "amount": 2.0}, "amount"),
        ({"without_actors": [99]}, "99"),
        ({"poses": {TRACK_ID: 2 * np.eye(4)}}, "rigid"),
    ],
)
def test_what_cannot_be_shown_is_refused(
    gaussian_scene: WeatherScene, choices: dict[str, Any], message: str
) -> None:
    with pytest.raises(ArgumentError, match=message):
        gaussian_scene.render(KEY, RAIN, **choices)


def test_a_viewpoint_and_a_camera_exclude_each_other(gaussian_scene: WeatherScene) -> None:
    camera = gaussian_scene.frame(KEY).camera
    with pytest.raises(ArgumentError, match="not both"):
        gaussian_scene.frame_from(KEY, Viewpoint(), camera=camera)
    with pytest.raises(ArgumentError, match="time_s"):
        gaussian_scene.frame_from(KEY, time_s=float("nan"))
