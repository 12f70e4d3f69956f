"""Single pictures in weather: what all transforms share."""

from __future__ import annotations

import json
import pickle
from typing import Any

import numpy as np
import pytest
import torch
from tiny_clip import TinyClip

from weather_aug.air import air_of
from weather_aug.clip.types import Camera, Frame, FrameKey
from weather_aug.errors import ArgumentError
from weather_aug.render import compose
from weather_aug.render.options import LabelPolicy, RenderOptions
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.taxonomy import CLASSES, IGNORE, ROAD, SKY
from weather_aug.transforms import picture
from weather_aug.transforms.given import rgb_uint8
from weather_aug.transforms.picture import Drawn, Weathering, default_camera, light_of
from weather_aug.weather import Weather

FOG = Weathering.of(WeatherPolicy.fog((40, 60)))
SNOW = Weathering.of(WeatherPolicy.snow((2, 4)))
CLEAR = Weathering.of(WeatherPolicy({"clear": 1}))


@pytest.fixture(scope="module")
def frame() -> Frame:
    return TinyClip().frame(FrameKey(0, "front"))


def test_a_float_picture_is_the_same_in_eight_bits(frame: Frame) -> None:
    drawn = SNOW.draw(1)
    whole = SNOW.render(frame.image, drawn, mask=frame.label, depth=frame.depth_m)
    fine = (frame.image / np.float32(255)).astype(np.float32)
    done = SNOW.render(fine, drawn, mask=frame.label, depth=frame.depth_m)
    assert done.image.dtype == np.float32
    assert (np.rint(done.image * 255) == whole.image).all()
    between = fine + np.float32(0.4 / 255)
    done = SNOW.render(between.clip(0, 1), drawn, mask=frame.label, depth=frame.depth_m)
    assert (np.rint(done.image * 255) == whole.image).all()
    assert done.mask is not None
    assert (done.mask == whole.mask).all()


def test_hidden_pixels_get_the_callers_ignored_id(frame: Frame) -> None:
    drawn = FOG.draw(1)
    usual = FOG.render(frame.image, drawn, mask=frame.label, depth=frame.depth_m)
    own = Weathering.of(FOG.policy, ignore_index=-1)
    done = own.render(frame.image, drawn, mask=frame.label.astype(np.int32), depth=frame.depth_m)
    assert usual.mask is not None
    assert done.mask is not None
    hidden = usual.mask != frame.label
    assert hidden.any()
    assert (usual.mask[hidden] == IGNORE).all()
    assert (done.mask[hidden] == -1).all()
    assert (done.mask[~hidden] == frame.label[~hidden]).all()


def test_ids_of_no_street_are_marked_where_nothing_can_be_told(frame: Frame) -> None:
    """A mask of instances keeps each of its ids where it can be seen: nothing is moved."""
    place = np.arange(frame.label.size, dtype=np.int32).reshape(frame.label.shape)
    weathering = Weathering.of(FOG.policy, taxonomy=None, ignore_index=-1)
    done = weathering.render(frame.image, FOG.draw(1), mask=place, depth=frame.depth_m)
    assert done.mask is not None
    assert ((done.mask == -1) == (done.shot.invalid != 0)).all()
    assert 0 < (done.mask == -1).mean() < 1
    assert (done.mask[done.mask != -1] == place[done.mask != -1]).all()


def test_clear_weather_is_the_picture_itself(frame: Frame) -> None:
    done = CLEAR.render(frame.image, CLEAR.draw(1), mask=frame.label, depth=frame.depth_m)
    assert (done.image == frame.image).all()
    assert (done.mask == frame.label).all()
    fine = (frame.image / np.float32(255.7)).astype(np.float32)
    assert (CLEAR.render(fine, CLEAR.draw(1), mask=frame.label).image == fine).all()


@pytest.mark.parametrize("labels", ["ignore_unseen", "acdc", "keep"])
def test_ids_without_a_train_class_are_hidden_too(frame: Frame, labels: LabelPolicy) -> None:
    """The caller may train on more ids than have a train class."""
    names = {index: None if index == ROAD else name for index, name in enumerate(CLASSES)}
    own = Weathering.of(
        FOG.policy, taxonomy=names | {IGNORE: None}, options=RenderOptions(labels=labels)
    )
    done = own.render(frame.image, FOG.draw(1), mask=frame.label, depth=frame.depth_m)
    assert done.mask is not None
    classless = frame.label == ROAD
    unreadable = classless & (done.shot.invalid != 0)
    assert 0 < unreadable.sum() < classless.sum()
    expected = unreadable if labels == "ignore_unseen" else np.zeros_like(unreadable)
    assert ((done.mask == IGNORE)[classless] == expected[classless]).all()


@pytest.mark.parametrize("taxonomy", ["train_ids", None])
def test_labels_that_are_kept_are_kept(frame: Frame, taxonomy: str | None) -> None:
    keep = Weathering.of(FOG.policy, options=RenderOptions(labels="keep"), taxonomy=taxonomy)
    done = keep.render(frame.image, keep.draw(1), mask=frame.label, depth=frame.depth_m)
    assert (done.mask == frame.label).all()
    assert done.shot.invalid.any()


def test_a_prior_takes_the_place_of_missing_depth(frame: Frame) -> None:
    done = FOG.render(frame.image, FOG.draw(1), mask=frame.label)
    assert np.isinf(done.shot.depth[frame.label == SKY]).all()
    assert (done.shot.depth[-4:] < 10).all()


def test_a_draw_can_be_written_down() -> None:
    for key in (0, 7, 2**127):
        drawn = Weathering().draw(key)
        assert Drawn.from_dict(json.loads(json.dumps(drawn.to_dict()))) == drawn
        assert 0 <= drawn.speed_m_per_s <= 15


def test_the_whole_choice_can_be_written_down() -> None:
    weathering = Weathering.of(
        {"types": {"rain": 1}},
        speed_m_per_s=(1, 2),
        camera_height_m=1.2,
        hfov_deg=90.0,
        options={"max_particles": 10, "without": ["drops"]},
        taxonomy="camvid11",
        ignore_index=-1,
        unknown_ids="ignore",
        depth_cache="cache",
    )
    assert weathering.options == RenderOptions(max_particles=10, without=("drops",))
    assert Weathering.of(**json.loads(json.dumps(weathering.to_dict()))) == weathering
    assert pickle.loads(pickle.dumps(weathering)) == weathering
    with pytest.raises(ArgumentError, match="depth_network is a function"):
        Weathering.of(depth_network=lambda image: image[..., 0]).to_dict()


def stack_of(count: int) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    frames = [TinyClip().frame(FrameKey(k, "front")) for k in range(count)]
    return [f.image for f in frames], [f.label for f in frames], [f.depth_m for f in frames]


def test_a_stack_is_each_picture_at_its_time_under_one_light() -> None:
    images, masks, depths = stack_of(3)
    drawn = SNOW.draw(5)
    done = SNOW.render_stack(images, drawn, fps=10, masks=masks, depths=depths)
    first = SNOW.frame(images[0], drawn, mask=masks[0], depth=depths[0])
    for k, shot in enumerate(done):
        frame = SNOW.frame(images[k], drawn, mask=masks[k], depth=depths[k], time_s=k / 10)
        alone = compose.render(frame, drawn.weather, seed=drawn.seed, ambience=light_of(first))
        assert (shot.image == alone.image).all()
        travelled_m = frame.camera.centre_world - first.camera.centre_world
        assert travelled_m == pytest.approx([0, 0, drawn.speed_m_per_s * k / 10])
    # The air drifts on, too: equal pictures at other times differ.
    assert air_of(drawn.weather, 0.1, drawn.seed) != air_of(drawn.weather, 0.0, drawn.seed)
    assert (done[0].image != done[1].image).any()


@pytest.mark.parametrize("name", ["masks", "depths", "cameras"])
def test_a_stack_takes_sequences(name: str) -> None:
    with pytest.raises(ArgumentError, match=f"{name} must be a sequence, got int"):
        SNOW.render_stack(stack_of(2)[0], SNOW.draw(5), fps=10, **{name: 5})


def test_what_is_no_camera_is_refused(frame: Frame) -> None:
    camera: Any = {"fx": 500}
    with pytest.raises(ArgumentError, match="camera must be a Camera, got dict"):
        SNOW.render(frame.image, SNOW.draw(1), camera=camera)


def test_a_light_for_each_picture_would_be_seen() -> None:
    images, masks, depths = stack_of(2)
    images[1] = 255 - images[1] // 4
    drawn = FOG.draw(5)
    one = FOG.render_stack(images, drawn, fps=10, masks=masks, depths=depths)
    seen = [s.shot.frame for s in one]
    own = FOG.render(images[1], drawn, mask=masks[1], depth=depths[1])
    far = np.isinf(depths[1])
    assert light_of(seen[0]).airlight != pytest.approx(light_of(seen[1]).airlight, abs=0.05)
    assert np.abs(one[1].image[far].astype(int) - own.image[far]).mean() > 2


@pytest.mark.parametrize("name", ["masks", "depths", "cameras"])
def test_a_stack_needs_one_of_each(name: str) -> None:
    images, masks, depths = stack_of(2)
    given: dict[str, Any] = {"masks": masks, "depths": depths}
    given[name] = given.get(name, [default_camera((48, 64), 0.0)] * 2)[:1]
    with pytest.raises(ArgumentError, match=f"{name} must hold one for each of 2"):
        FOG.render_stack(images, FOG.draw(0), fps=10, **given)


@pytest.mark.parametrize("fps", [0, -1, np.nan, "fast"])
def test_a_rate_that_is_none_is_refused(fps: Any) -> None:
    with pytest.raises(ArgumentError, match="fps"):
        FOG.render_stack(*stack_of(1)[:1], FOG.draw(0), fps=fps)


def test_the_default_camera_sees_as_wide_as_it_is_told() -> None:
    for hfov_deg in (60.0, 90.0):
        camera = default_camera((480, 640), 10.0, hfov_deg)
        assert np.degrees(2 * np.arctan(320 / camera.focal_px[0])) == pytest.approx(hfov_deg)
        assert camera.principal_px == (319.5, 239.5)
        assert camera.velocity_m_per_s.tolist() == [0, 0, 10]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"policy": {"types": {"hail": 1}}}, "hail"),
        ({"policy": "rain"}, r"policy must be a WeatherPolicy, .* got str; write WeatherPolicy\("),
        ({"policy": Weather.fog("heavy")}, "policy must be a WeatherPolicy, .* got Weather;"),
        ({"speed_m_per_s": 5}, "speed_m_per_s must be a range"),
        ({"speed_m_per_s": (9, 3)}, "speed_m_per_s must be a range"),
        ({"speed_m_per_s": (0, 1000)}, "speed_m_per_s"),
        ({"camera_height_m": 0}, "camera_height_m"),
        ({"hfov_deg": 180}, "hfov_deg"),
        ({"options": "fast"}, "options must be RenderOptions"),
        ({"options": {"speed": 3}}, "no field speed"),
        ({"taxonomy": "nowhere"}, "nowhere"),
        ({"colour": 3}, "there is no argument colour; there are policy, speed"),
    ],
    ids=str,
)
def test_bad_choices_are_refused_at_once(arguments: dict[str, Any], says: str) -> None:
    with pytest.raises(ArgumentError, match=says):
        Weathering.of(**arguments)


@pytest.mark.parametrize(
    ("image", "says"),
    [
        (torch.zeros(3, 8, 9), "got Tensor; weather comes before conversion to tensors"),
        (np.zeros((3, 8, 9), np.uint8), r"got \(3, 8, 9\): move .* image.transpose\(1, 2, 0\)"),
        (np.zeros((8, 9, 4), np.uint8), "got .*: leave its alpha out"),
        (np.zeros((8, 9), np.uint8), "got .*: read it in colour"),
        (np.zeros((8, 9, 5), np.uint8), r"got \(8, 9, 5\)$"),
        (np.zeros((8, 9, 3)), "got float64; convert it with image.astype"),
        (np.full((8, 9, 3), 200, np.float32), "divide it by 255, or keep uint8"),
        (np.full((8, 9, 3), -1.5, np.float32), "weather comes before normalisation"),
        (np.full((8, 9, 3), np.nan, np.float32), "weather comes before normalisation"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_refused_picture_is_told_its_cure(image: Any, says: str) -> None:
    with pytest.raises(ArgumentError, match=says):
        rgb_uint8(image)


def test_a_camera_that_is_given_is_used(frame: Frame) -> None:
    wide = Camera(np.array([[20.0, 0, 32], [0, 20, 24], [0, 0, 1]]), np.eye(4), 64, 48)
    drawn = SNOW.draw(3)
    done = [
        SNOW.render(frame.image, drawn, mask=frame.label, depth=frame.depth_m, camera=camera).image
        for camera in (None, wide)
    ]
    assert (done[0] != done[1]).any()


def test_rounding_is_to_the_nearest_level() -> None:
    levels = np.array([0.0, 0.4 / 255, 0.6 / 255, 1.0], np.float32)
    image = np.broadcast_to(levels[None, :, None], (1, 4, 3))
    assert rgb_uint8(image)[0, :, 0].tolist() == [0, 0, 1, 255]


def test_an_exception_leaves_all_usable(frame: Frame, monkeypatch: pytest.MonkeyPatch) -> None:
    """M6: the next call after one that broke half-way gives what it gave before."""
    drawn = SNOW.draw(2)
    given = {"mask": frame.label, "depth": frame.depth_m}
    before = SNOW.render(frame.image, drawn, **given).image

    def broken(*args: Any, **kwargs: Any) -> Any:
        raise RuntimeError("cut short")

    for name in ("render", "light_of"):
        with monkeypatch.context() as patch:
            patch.setattr(picture, name, broken)
            with pytest.raises(RuntimeError, match="cut short"):
                SNOW.render(frame.image, drawn, **given)
        assert (SNOW.render(frame.image, drawn, **given).image == before).all()


def test_every_severity_is_drawn_from_the_policy() -> None:
    weathers = [Weathering.of(WeatherPolicy.rain((5, 20))).draw(k).weather for k in range(50)]
    rates = [weather.rain_mm_per_h for weather in weathers]
    assert min(rates) >= 5 - 1e-9
    assert max(rates) <= 20 + 1e-9
    assert len(set(rates)) == 50
    assert all(isinstance(weather, Weather) for weather in weathers)
