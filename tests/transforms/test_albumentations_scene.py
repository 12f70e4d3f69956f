"""Frames of scenes: RandomWeather hands the caller what the scene renders."""

from __future__ import annotations

import json
import pickle
from typing import Any

import albumentations as A
import numpy as np
import pytest

from weather_aug.errors import ArgumentError, SceneError
from weather_aug.render.options import RenderOptions
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.scene.scene import WeatherScene
from weather_aug.taxonomy import IGNORE
from weather_aug.transforms.albumentations import RandomWeather

FOG = WeatherPolicy.fog((30.0, 40.0))
KEY = "000001_front"
NO_GENERATOR: Any = None


def weather_in(*scenes: WeatherScene, **how: Any) -> RandomWeather:
    return RandomWeather(FOG, scenes=[scene.path for scene in scenes], p=1.0, **how)


def shot_of(weather: RandomWeather, scene: WeatherScene, key: Any, sample: Any = 1) -> Any:
    drawn = weather.drawn({"sample_key": sample}, NO_GENERATOR)
    return scene.render(key, drawn.weather, seed=drawn.seed)


def picture(scene: WeatherScene, which: int = 2) -> dict[str, Any]:
    frame = scene.frame(scene.keys[which])
    label = np.zeros(frame.image.shape[:2], np.uint8) if frame.label is None else frame.label
    return {"image": np.array(frame.image), "mask": np.array(label)}


def test_a_labelled_scene_marks_the_callers_own_ids(tiny_scene: WeatherScene) -> None:
    """Ids of no taxonomy of ours, such as instances, are marked where the scene's are hidden."""
    assert str(tiny_scene.keys[2]) == KEY
    weather = weather_in(tiny_scene, taxonomy=None, ignore_index=-1)
    given = picture(tiny_scene)
    given["mask"] = given["mask"].astype(np.int32) + 1000
    done = A.Compose([weather], strict=True)(**given, scene_key=KEY, sample_key=1)
    shot = shot_of(weather, tiny_scene, tiny_scene.keys[2])
    hidden = (shot.label == IGNORE) & (shot.label_full != IGNORE)
    assert 0 < hidden.mean() < 1
    assert done["image"].tobytes() == shot.image.tobytes()
    assert (done["mask"] == np.where(hidden, -1, given["mask"])).all()
    assert done["mask"].dtype == np.int32
    assert done["scene_key"] == KEY


def test_an_unlabelled_scene_marks_what_cannot_be_made_out(unlabelled_scene: WeatherScene) -> None:
    weather = weather_in(unlabelled_scene)
    given = picture(unlabelled_scene)
    done = A.Compose([weather])(**given, scene_key=KEY, sample_key=1)
    shot = shot_of(weather, unlabelled_scene, unlabelled_scene.keys[2])
    assert 0 < (shot.invalid != 0).mean() < 1
    assert ((done["mask"] == IGNORE) == (shot.invalid != 0)).all()


def test_without_a_mask_there_is_none(tiny_scene: WeatherScene) -> None:
    weather = weather_in(tiny_scene)
    done = weather(image=picture(tiny_scene)["image"], scene_key=KEY, sample_key=1)
    assert "mask" not in done


@pytest.mark.parametrize("key", [KEY, (1, "front"), [1, "front"]], ids=str)
def test_keys_are_texts_or_pairs(tiny_scene: WeatherScene, key: Any) -> None:
    weather = weather_in(tiny_scene)
    done = weather(**picture(tiny_scene), scene_key=key, sample_key=1)
    named = weather(**picture(tiny_scene), scene_key=(tiny_scene.name, 1, "front"), sample_key=1)
    own = weather(**picture(tiny_scene), scene_key=tiny_scene.keys[2], sample_key=1)
    assert done["image"].tobytes() == named["image"].tobytes() == own["image"].tobytes()


def test_several_scenes_are_told_apart_by_name(
    tiny_scene: WeatherScene, unlabelled_scene: WeatherScene
) -> None:
    weather = weather_in(tiny_scene, unlabelled_scene)
    done = weather(**picture(tiny_scene), scene_key=("unlabelled", 1, "front"), sample_key=1)
    shot = shot_of(weather, unlabelled_scene, unlabelled_scene.keys[2])
    assert done["image"].tobytes() == shot.image.tobytes()
    with pytest.raises(ArgumentError, match="with several scenes"):
        weather(**picture(tiny_scene), scene_key=KEY)


def test_a_stack_of_frames(tiny_scene: WeatherScene) -> None:
    weather = weather_in(tiny_scene)
    which = (0, 2, 4)
    given = [picture(tiny_scene, k) for k in which]
    keys = [tiny_scene.keys[k] for k in which]
    done = A.Compose([weather])(
        images=np.stack([each["image"] for each in given]),
        masks=np.stack([each["mask"] for each in given]),
        scene_keys=keys,
        sample_key=1,
    )
    for k, key in enumerate(keys):
        shot = shot_of(weather, tiny_scene, key)
        assert done["images"][k].tobytes() == shot.image.tobytes()
        assert (done["masks"][k] == shot.label).all()


def test_options_reach_the_scene(tiny_scene: WeatherScene) -> None:
    weather = weather_in(tiny_scene, options=RenderOptions(labels="keep"))
    given = picture(tiny_scene)
    assert (weather(**given, scene_key=KEY)["mask"] == given["mask"]).all()


def test_scenes_are_written_down_as_paths(tiny_scene: WeatherScene) -> None:
    original = A.Compose([weather_in(tiny_scene)])
    given = picture(tiny_scene) | {"scene_key": KEY, "sample_key": 1}
    expected = original(**given)
    again = A.from_dict(json.loads(json.dumps(A.to_dict(original))))
    sent = pickle.loads(pickle.dumps(original))
    assert "by_name" in vars(original.transforms[0].shelf)
    assert "by_name" not in vars(sent.transforms[0].shelf), "no scene is pickled"
    for each in (again, sent):
        assert each(**given)["image"].tobytes() == expected["image"].tobytes()


def test_a_replay_finds_the_frame_again(tiny_scene: WeatherScene) -> None:
    recorder = A.ReplayCompose([weather_in(tiny_scene)])
    given = picture(tiny_scene) | {"scene_key": KEY}
    done = recorder(**given)
    again = A.ReplayCompose.replay(json.loads(json.dumps(done["replay"])), **given)
    assert again["image"].tobytes() == done["image"].tobytes()
    assert again["mask"].tobytes() == done["mask"].tobytes()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"scene_key": "000009_front"}, "has no frame '000009_front'"),
        ({"scene_key": ("other", 1, "front")}, "there is no scene 'other'"),
        ({"image": np.zeros((48, 64, 3), np.uint8)}, "image is not the picture of frame"),
        ({"image": np.zeros((8, 64, 3), np.uint8)}, "put RandomWeather before crops"),
        ({"mask": np.zeros((48, 63), np.uint8)}, "mask must have the image's shape"),
        ({"mask": np.zeros((48, 64), np.float32)}, "mask must be an integer array"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_does_not_fit_the_frame_is_refused(
    tiny_scene: WeatherScene, change: dict[str, Any], says: str
) -> None:
    with pytest.raises(ArgumentError, match=says):
        weather_in(tiny_scene)(**picture(tiny_scene) | {"scene_key": KEY} | change)


def test_a_key_needs_scenes_and_scenes_need_to_be_there(
    tiny_scene: WeatherScene, tmp_path: Any
) -> None:
    with pytest.raises(ArgumentError, match="scene_key needs scenes"):
        RandomWeather(FOG, p=1.0)(**picture(tiny_scene), scene_key=KEY)
    with pytest.raises(SceneError):
        RandomWeather(FOG, p=1.0, scenes=[tmp_path / "none"])(**picture(tiny_scene), scene_key=KEY)
