"""WeatherDataset over clips: pictures and labels for which nothing was precomputed."""

from __future__ import annotations

import json
import pickle
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from test_dataset import PLANES, digest_of, digests, forks, loader_of
from tiny_clip import TinyClip

from weather_aug.clip.depth_sources import DepthSource
from weather_aug.clip.open import open_clip
from weather_aug.clip.types import Camera, Frame, FrameKey
from weather_aug.errors import ArgumentError, ClipError
from weather_aug.render.options import RenderOptions
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.scene.records import rig_motion
from weather_aug.scene.scene import WeatherScene
from weather_aug.scene.viewpoint import ViewpointJitter
from weather_aug.transforms.dataset import WeatherDataset
from weather_aug.transforms.sampling import RareClass
from weather_aug.transforms.sources import ClipSource

POLICY = WeatherPolicy({"rain": 1, "snow": 1, "fog": 1}, severity=(0.3, 0.7), falling=1.0)
CROP = (32, 40)
CAMVID = Path(__file__).resolve().parents[2] / ".." / "shared" / "data" / "camvid-dev"
CAMERA_HEIGHT_M = 1.5
LEAST_PSNR_DB = 45.0
NO_TRACKS = RenderOptions(without=("tracks",))


class Pictures(TinyClip):
    """The same pictures, as if they had nothing to do with each other."""

    is_drive = False


class Blind(TinyClip):
    """Nobody measured how far anything is."""

    def frame(self, key: FrameKey) -> Frame:
        return replace(super().frame(key), depth_m=None)


@dataclass(frozen=True)
class Patchy(TinyClip):
    """Some frames have no label, are small, or cannot be read."""

    without_label: tuple[int, ...] = ()
    small: tuple[int, ...] = ()
    broken: tuple[int, ...] = ()
    is_drive: bool = False

    def frame(self, key: FrameKey) -> Frame:
        if key.time_index in self.broken:
            raise ClipError(f"frame {key} cannot be read")
        if key.time_index in self.small:
            return TinyClip(name=self.name, width=32, height=24).frame(key)
        frame = super().frame(key)
        return replace(frame, label=None) if key.time_index in self.without_label else frame


@dataclass(frozen=True)
class ExactDepth(DepthSource):
    """Depth of the tiny street; it notes what it was asked."""

    asked: list[tuple[float, bool]] = field(default_factory=list)

    def depth_m(
        self,
        image: NDArray[np.uint8],
        label: NDArray[np.uint8] | None,
        camera: Camera,
        camera_height_m: float,
    ) -> NDArray[np.float32]:
        self.asked.append((camera_height_m, label is not None))
        return TinyClip()._hits(camera)[1]


def psnr_db(a: Any, b: Any) -> float:
    error = np.mean((np.asarray(a, np.float64) - np.asarray(b, np.float64)) ** 2)
    return float(10 * np.log10(255**2 / max(error, 1e-9)))


def test_a_clip_looks_like_its_scene(tiny_scene: WeatherScene) -> None:
    """Same draws, same street, same light; a clip does not know where wheels ran in the snow."""
    clip, scene = (
        WeatherDataset([one], POLICY, options=NO_TRACKS) for one in (TinyClip(), tiny_scene)
    )
    assert len(clip) == len(scene) == 8
    for index in range(8):
        one, other = clip[index], scene[index]
        assert set(one) == set(other)
        for name in PLANES:
            assert (one[name].dtype, one[name].shape) == (other[name].dtype, other[name].shape)
        assert psnr_db(one["image"], other["image"]) > LEAST_PSNR_DB, index
        assert (one["label"] == other["label"]).float().mean() > 0.98
        recipes = [json.loads(item["recipe"]) for item in (one, other)]
        assert recipes[0]["weather"] == recipes[1]["weather"]
        assert recipes[0]["seed"] == recipes[1]["seed"]


def test_another_weather_would_be_seen(tiny_scene: WeatherScene) -> None:
    clip = WeatherDataset([TinyClip()], POLICY, seed=1, options=NO_TRACKS)
    scene = WeatherDataset([tiny_scene], POLICY, options=NO_TRACKS)
    assert min(psnr_db(clip[i]["image"], scene[i]["image"]) for i in range(8)) < LEAST_PSNR_DB


def test_a_drive_has_the_axes_and_the_light_of_its_scene(tiny_scene: WeatherScene) -> None:
    source = ClipSource(TinyClip(), DepthSource(), 0)
    for key in source.keys:
        own, expected = source.light_of(source.read(key)), tiny_scene.ambience(key)
        np.testing.assert_allclose(own.axes_world, expected.axes_world)
        for light in ("airlight", "sky", "middle", "ground"):
            np.testing.assert_allclose(getattr(own, light), getattr(expected, light), rtol=1e-9)
        assert own.camera_height_m == pytest.approx(expected.camera_height_m)


def test_unrelated_pictures_have_each_their_own_light() -> None:
    airlights = []
    for clip in (TinyClip(), Pictures()):
        source = ClipSource(clip, DepthSource(), 0)
        lights = [source.light_of(source.read(key)).airlight for key in source.keys[::2]]
        airlights.append(len({light.tobytes() for light in lights}))
    assert airlights == [1, 4]


def test_only_a_few_frames_are_read_for_the_light(monkeypatch: pytest.MonkeyPatch) -> None:
    read = []
    monkeypatch.setattr(
        Blind, "frame", lambda self, key: read.append(key) or TinyClip.frame(self, key)
    )
    ClipSource(Blind(frames=50), DepthSource(), 0)
    assert {0, 49} <= {key.time_index for key in read if key.camera == "front"}
    assert len(read) <= 11


def test_the_rig_moves_as_in_a_scene(tiny_scene: WeatherScene) -> None:
    source = ClipSource(TinyClip(), DepthSource(), 0)
    for key in source.keys:
        expected = rig_motion(tiny_scene.manifest.frames, key)
        for name, pose in vars(expected).items():
            np.testing.assert_allclose(getattr(source.rig_of(key), name), pose)


@pytest.mark.parametrize("crop", [None, CROP])
@pytest.mark.parametrize("options", [RenderOptions(), RenderOptions(preset="weatheredit")])
def test_recipes_are_rendered_again(
    tiny_scene: WeatherScene, crop: tuple[int, int] | None, options: RenderOptions
) -> None:
    """Also by another data set of the same sources, and from JSON values."""
    sources = [TinyClip(name="one"), tiny_scene, Pictures(name="one")]
    dataset = WeatherDataset(sources, POLICY, crop=crop, options=options)
    other = WeatherDataset(sources, seed=9)
    assert dataset.scenes == tuple(sources)
    for index in (0, 3, 9, 17, 23):
        item = dataset[index]
        shot = other.render_recipe(item["recipe"])
        assert np.array_equal(item["image"].permute(1, 2, 0).numpy(), shot.image)
        for name in PLANES[1:]:
            assert np.array_equal(item[name].numpy(), getattr(shot, name)), name
    recipe = json.loads(dataset[23]["recipe"])
    assert (recipe["source"], recipe["clip"]) == (2, "one")
    again = dataset.render_recipe(recipe)
    assert np.array_equal(dataset[23]["depth"].numpy(), again.depth)


def test_a_recipe_of_others_is_refused(tiny_scene: WeatherScene) -> None:
    recipe = WeatherDataset([TinyClip(name="other")], POLICY)[0]["recipe"]
    with pytest.raises(ArgumentError, match="recipe is of 'other'"):
        WeatherDataset([tiny_scene, TinyClip()]).render_recipe(recipe)


def test_depth_that_a_clip_lacks_is_found(tmp_path: Path) -> None:
    source = ExactDepth()
    blind = WeatherDataset([Blind()], POLICY, depth=source)
    assert set(source.asked) == {(CAMERA_HEIGHT_M, True)}
    item, expected = blind[2], WeatherDataset([TinyClip()], POLICY)[2]
    assert (item["image"] == expected["image"]).all()
    high = Blind(labelled=False)
    object.__setattr__(high, "camera_height_m", 2.5)
    WeatherDataset([high], POLICY, depth=source)[0]
    assert source.asked[-1] == (2.5, False)


def test_depth_of_labelled_pictures_is_found_without_being_told() -> None:
    item = WeatherDataset([Blind()], POLICY)[0]
    sky = item["label_full"] == 10
    assert item["depth"][sky].isinf().all()
    assert item["depth"][~sky].isfinite().all()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three pictures and their labels."""
    clip = Pictures(frames=3, cameras=("front",))
    for part in ("images", "labels"):
        (tmp_path / part).mkdir()
    for key in clip.keys:
        frame = clip.frame(key)
        name = f"{key.time_index:03d}.png"
        assert frame.label is not None
        assert cv2.imwrite(str(tmp_path / "images" / name), frame.image[..., ::-1])
        assert cv2.imwrite(str(tmp_path / "labels" / name), frame.label)
    return tmp_path


def test_folders_of_pictures_and_labels(folder: Path) -> None:
    clip = open_clip(f"folder:{folder}?images=images&labels=labels&taxonomy=train_ids")
    dataset = WeatherDataset([clip], POLICY, crop=CROP)
    recorded = Pictures(frames=3, cameras=("front",))
    for index, key in enumerate(recorded.keys):
        item = dataset[index]
        top, left, rows, columns = json.loads(item["recipe"])["window"]
        label = recorded.frame(key).label
        assert label is not None
        part = label[top : top + rows, left : left + columns]
        assert np.array_equal(item["label_full"].numpy(), part)


@pytest.mark.skipif(not CAMVID.is_dir(), reason="CamVid's development part is not on this machine")
def test_camvid() -> None:
    address = f"folder:{CAMVID}?images=train&labels=trainannot&taxonomy=camvid11"
    law = RareClass(min_pixels=500)
    dataset = WeatherDataset([open_clip(address)], POLICY, crop=(256, 256), sampling=law)
    for index in range(3):
        item = dataset[index]
        assert item["image"].shape == (3, 256, 256)
        assert set(item["label"].unique().tolist()) <= {*range(19), 255}
    assert len(pickle.dumps(dataset)) < 16 * 1024


@forks
@pytest.mark.parametrize(("workers", "method"), [(2, "fork"), (1, "spawn")])
def test_items_do_not_depend_on_workers(folder: Path, workers: int, method: str) -> None:
    clip = open_clip(f"folder:{folder}?images=images&labels=labels&taxonomy=train_ids")
    dataset = WeatherDataset([clip, TinyClip()], POLICY, crop=CROP)
    loader = loader_of(dataset, workers, method)
    for epoch in (0, 1):
        dataset.set_epoch(epoch)
        assert digests(loader) == [digest_of(dataset[index]) for index in range(len(dataset))]


def test_a_pickled_dataset_draws_the_same() -> None:
    dataset = WeatherDataset([TinyClip(), Pictures(name="more")], POLICY)
    data = pickle.dumps(dataset)
    assert len(data) < 8 * 1024
    again = pickle.loads(data)
    for index in (0, 11):
        assert digest_of(again[index]) == digest_of(dataset[index])


def test_labels_alone_are_enough_to_count_classes(monkeypatch: pytest.MonkeyPatch) -> None:
    """A clip that can read a label without its picture is asked for no more."""
    monkeypatch.setattr(
        Pictures, "label", lambda self, key: TinyClip.frame(self, key).label, raising=False
    )
    read = []
    monkeypatch.setattr(
        Pictures, "frame", lambda self, key: read.append(key) or TinyClip.frame(self, key)
    )
    WeatherDataset([Pictures()], sampling=RareClass(min_pixels=40))
    assert len(read) == 1
    monkeypatch.delattr(Pictures, "label")
    WeatherDataset([Pictures()], sampling=RareClass(min_pixels=40))
    assert len(read) == 1 + 1 + 8


@pytest.mark.parametrize("first", [0, 1])
def test_labelled_and_unlabelled_sources_do_not_mix(tiny_scene: WeatherScene, first: int) -> None:
    sources = [tiny_scene, TinyClip(name="bare", labelled=False)]
    with pytest.raises(ArgumentError, match="frame 000000_front of clip bare has no label"):
        WeatherDataset([sources[first], sources[1 - first]])


def test_a_clip_in_which_labels_are_missing_says_where() -> None:
    dataset = WeatherDataset([Patchy(without_label=(2,))], POLICY)
    assert "label" in dataset[0]
    with pytest.raises(ArgumentError, match="frame 000002_front of clip tiny has no label, but"):
        dataset[4]
    with pytest.raises(ArgumentError, match="000002_front of clip tiny has no label"):
        WeatherDataset([Patchy(without_label=(2,))], sampling=RareClass(min_pixels=40))
    bare = WeatherDataset([Patchy(without_label=(0, 1, 3))], POLICY)
    with pytest.raises(ArgumentError, match="frame 000002_front of clip tiny has a label, but"):
        bare[4]


def test_a_crop_that_does_not_fit_says_where() -> None:
    dataset = WeatherDataset([Patchy(small=(1,))], POLICY, crop=(40, 40))
    with pytest.raises(ArgumentError, match=r"does not fit frame 000001_front .*24x32"):
        dataset[2]
    with pytest.raises(ArgumentError, match="does not fit frame 000000_front of clip tiny"):
        WeatherDataset([TinyClip()], crop=(49, 10))


def test_a_frame_that_cannot_be_read_harms_no_other() -> None:
    """M6: all other items are right before and after."""
    faulty = WeatherDataset([Patchy(broken=(1,), frames=5)], POLICY)
    sound = WeatherDataset([Pictures(frames=5)], POLICY)
    for index in (2, 0, 3, 1, 2, 9, 4):
        if index in (2, 3):
            with pytest.raises(ClipError, match="cannot be read"):
                faulty[index]
        else:
            assert digest_of(faulty[index]) == digest_of(sound[index])


def test_clips_are_seen_from_their_cameras_only() -> None:
    with pytest.raises(ArgumentError, match="clip tiny can be seen from its cameras only"):
        WeatherDataset([TinyClip()], viewpoint_jitter=ViewpointJitter())


def test_a_single_clip_or_an_empty_one_is_refused() -> None:
    with pytest.raises(ArgumentError, match=r"write WeatherDataset\(\[clip\], \.\.\.\)"):
        WeatherDataset(TinyClip())  # type: ignore[arg-type]
    with pytest.raises(ArgumentError, match="clip tiny, which has no frames"):
        WeatherDataset([TinyClip(frames=0)])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("{", "no JSON text"),
        ("[]", "must be an object"),
        ("{}", "has no 'time_index'"),
        ({"options": {"rain": 1}}, "RenderOptions has no field rain"),
    ],
)
def test_what_is_no_recipe_is_refused(change: Any, says: str) -> None:
    dataset = WeatherDataset([TinyClip()], crop=(8, 8))
    recipe = change if isinstance(change, str) else json.loads(dataset[0]["recipe"]) | change
    with pytest.raises(ArgumentError, match=says):
        dataset.render_recipe(recipe)


@pytest.mark.parametrize("name", ["options", "depth"])
def test_what_is_none_of_its_kind_is_refused_when_it_is_made(name: str) -> None:
    given: Any = {name: {}}
    with pytest.raises(ArgumentError, match=f"{name} must be"):
        WeatherDataset([TinyClip()], **given)
