"""Stacks of pictures: one drive in one weather under one light."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import albumentations as A
import numpy as np
import pytest
from tiny_clip import TinyClip

from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError
from weather_aug.render.compose import render
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.taxonomy import IGNORE
from weather_aug.transforms.albumentations import RandomWeather
from weather_aug.transforms.picture import Drawn, Weathering, light_of

SNOW = WeatherPolicy.snow((2.0, 4.0))
FOG = WeatherPolicy.fog((30.0, 40.0))
NO_GENERATOR: Any = None

Sample = dict[str, Any]


@pytest.fixture
def drive() -> Sample:
    """Four pictures of the tiny street, which gets darker, and what is known of them."""
    frames = [TinyClip().frame(FrameKey(k, "front")) for k in range(4)]
    return {
        "images": np.stack([frame.image for frame in frames]),
        "masks": np.stack([frame.label for frame in frames]),
        "depths": np.stack([frame.depth_m for frame in frames]),
    }


def frame_by_frame(weather: RandomWeather, drawn: Drawn, drive: Sample) -> list[np.ndarray]:
    """Each picture alone, at its time, in the light of the first."""
    how, pictures, light = weather.weathering, [], None
    for k, image in enumerate(drive["images"]):
        given = {"mask": drive["masks"][k], "depth": drive["depths"][k]}
        frame = how.frame(image, drawn, time_s=k / weather.fps, **given)
        light = light or light_of(frame)
        shot = render(frame, drawn.weather, seed=drawn.seed, ambience=light, options=how.options)
        pictures.append(shot.image)
    return pictures


def check_one_drive(drive: Sample, fps: float = 8.0) -> None:
    weather = RandomWeather(SNOW, p=1.0, fps=fps)
    done = A.Compose([weather])(**drive, sample_key=2)
    drawn = weather.drawn({"sample_key": 2}, NO_GENERATOR)
    assert (done["images"] == frame_by_frame(weather, drawn, drive)).all()


@pytest.mark.parametrize("fps", [8.0, 30.0])
def test_each_picture_is_the_draw_at_its_time(drive: Sample, fps: float) -> None:
    check_one_drive(drive, fps)


def own_light(self: Weathering, images: Any, drawn: Drawn, **given: Any) -> Any:
    frames = [
        self.frame(image, drawn, mask=mask, depth=depth, time_s=k / given["fps"])
        for k, (image, mask, depth) in enumerate(
            zip(images, given["masks"], given["depths"], strict=True)
        )
    ]
    shots = [self._rendered(frame, drawn, light_of(frame)) for frame in frames]
    whole = zip(images, given["masks"], shots, strict=True)
    return [self.handed_back(image, mask, shot) for image, mask, shot in whole]


def standing_still(self: Weathering, images: Any, drawn: Drawn, **given: Any) -> Any:
    return own_stack(self, images, drawn, **given | {"fps": 1e4})


own_stack = Weathering.render_stack


@pytest.mark.parametrize("fault", [own_light, standing_still])
def test_a_light_or_a_time_of_its_own_is_seen(
    drive: Sample, fault: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Weathering, "render_stack", fault)
    with pytest.raises(AssertionError):
        check_one_drive(drive)


def test_the_same_flakes_fly_on(drive: Sample) -> None:
    """A tenth of a millisecond later they are where they were; in another draw they are not."""
    twice = {name: np.stack([values[0]] * 2) for name, values in drive.items()}
    # Noise and drops on the glass are not what flies.
    quiet = {"options": {"without": ["noise", "compression", "exposure"]}}
    still = RandomWeather(SNOW, p=1.0, fps=1e4, **quiet)
    first, second = still(**twice, sample_key=1)["images"].astype(int)
    other = still(**twice, sample_key=2)["images"][0].astype(int)
    assert np.abs(first - second).mean() < 0.2
    assert np.abs(first - other).mean() > 2
    late = RandomWeather(SNOW, p=1.0, fps=2.0, **quiet)(**twice, sample_key=1)["images"]
    assert np.abs(late[0].astype(int) - late[1]).mean() > 2


def test_masks_of_a_stack_are_marked(drive: Sample) -> None:
    done = A.Compose([RandomWeather(FOG, p=1.0)], seed=3)(**drive)
    hidden = done["masks"] != drive["masks"]
    assert hidden.any(axis=(1, 2)).all()
    assert (done["masks"][hidden] == IGNORE).all()
    assert (done["depths"] == drive["depths"]).all()


@pytest.mark.parametrize("direct", [True, False], ids=["alone", "in a Compose"])
def test_lists_stay_lists_and_inputs_as_they_were(drive: Sample, direct: bool) -> None:
    weather = RandomWeather(SNOW, p=1.0)
    lists = {name: list(values) for name, values in drive.items()}
    before = {name: values.tobytes() for name, values in drive.items()}
    call = weather if direct else A.Compose([weather])
    done, stacked = call(**lists, sample_key=1), call(**drive, sample_key=1)
    for name in ("images", "masks"):
        assert isinstance(done[name], list)
        assert isinstance(stacked[name], np.ndarray)
        assert (np.stack(done[name]) == stacked[name]).all()
        assert stacked[name].flags.c_contiguous
        assert not np.shares_memory(stacked[name], drive[name])
    assert {name: values.tobytes() for name, values in drive.items()} == before


def test_pictures_alone_are_enough_where_depth_is_given(drive: Sample) -> None:
    done = A.Compose([RandomWeather(SNOW, p=1.0)])(
        images=drive["images"], depths=drive["depths"], sample_key=1
    )
    assert (done["images"] != drive["images"]).any()
    assert "masks" not in done


def test_float_pictures_and_cameras(drive: Sample) -> None:
    cameras = [TinyClip().camera(FrameKey(k, "front")) for k in range(4)]
    weather = RandomWeather(SNOW, p=1.0)
    own = weather(**drive, cameras=cameras, sample_key=1)
    assert own["cameras"] is cameras
    assert (own["images"] != weather(**drive, sample_key=1)["images"]).any()
    floats = drive | {"images": drive["images"].astype(np.float32) / np.float32(255)}
    done = weather(**floats, cameras=cameras, sample_key=1)["images"]
    assert done.dtype == np.float32
    assert np.abs(done * 255 - own["images"]).max() <= 1


def test_masks_with_a_last_axis_keep_it(drive: Sample) -> None:
    """As AlbumentationsX hands them on."""
    weather = RandomWeather(FOG, p=1.0)
    flat = weather(**drive, sample_key=1)
    axes = {name: drive[name][..., None] for name in ("masks", "depths")}
    done = weather(**drive | axes, sample_key=1)
    assert (done["masks"][..., 0] == flat["masks"]).all()
    assert (done["images"] == flat["images"]).all()


def test_an_empty_stack_stays_empty(drive: Sample) -> None:
    none = {name: values[:0] for name, values in drive.items()}
    done = RandomWeather(SNOW, p=1.0)(**none)
    assert (done["images"].shape, done["masks"].shape) == ((0, 48, 64, 3), (0, 48, 64))
    lists = RandomWeather(SNOW, p=1.0)(images=[], masks=[])
    assert (lists["images"], lists["masks"]) == ([], [])


@pytest.mark.parametrize("name", ["masks", "depths", "cameras", "scene_keys"])
def test_too_few_of_each_are_refused(drive: Sample, name: str) -> None:
    few = drive.get(name, [None] * 4)[:3]
    with pytest.raises(ArgumentError, match=f"{name} must hold one for each of 4 pictures, got 3"):
        RandomWeather(SNOW, p=1.0)(**drive | {name: few})


@pytest.mark.parametrize("name", ["images", "masks", "depths", "cameras", "scene_keys"])
def test_what_is_no_stack_is_refused(drive: Sample, name: str) -> None:
    with pytest.raises(ArgumentError, match=f"{name} must be a list or an array, got int"):
        RandomWeather(SNOW, p=1.0)(**drive | {name: 5})


@pytest.mark.parametrize("name", ["mask", "depth", "camera", "scene_key"])
def test_what_belongs_to_one_picture_is_refused(drive: Sample, name: str) -> None:
    with pytest.raises(ArgumentError, match=f"with images give {name}s"):
        RandomWeather(SNOW, p=1.0)(**drive, **{name: drive["masks"][0]})
