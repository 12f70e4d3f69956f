"""RandomWeather under the conventions of mmsegmentation 0.x and 1.x, neither of which is needed."""

from __future__ import annotations

import copy
import multiprocessing
import pickle
import sys
import warnings
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_clip import TinyClip
from torch.utils.data import DataLoader, Dataset

from weather_aug import transforms
from weather_aug.clip.depth_sources import GuessedDepthWarning
from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError, ConflictError, MissingExtraError, WeatherAugError
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.taxonomy import IGNORE, SKY
from weather_aug.transforms import mmseg
from weather_aug.transforms.mmseg import RandomWeather
from weather_aug.transforms.picture import Weathering

FOG = WeatherPolicy({"fog": 1}, severity=(1.0, 1.0))
SNOW = WeatherPolicy({"snow": 1}, severity=(0.9, 1.0), falling=1.0)
MIXED = WeatherPolicy({"rain": 1, "snow": 1, "fog": 1}, severity=(0.6, 1.0))

Results = dict[str, Any]


def old(index: int = 0, label: bool = True) -> Results:
    """What 0.16 holds after LoadImageFromFile and LoadAnnotations; HRDA's target has no label."""
    frame = TinyClip().frame(TinyClip().keys[index])
    results = {
        "img_info": {"filename": f"{index}.png", "ann": {"seg_map": f"{index}_labelTrainIds.png"}},
        "img_prefix": "images",
        "seg_prefix": "labels",
        "seg_fields": [],
        "filename": f"images/{index}.png",
        "ori_filename": f"{index}.png",
        "img": np.ascontiguousarray(frame.image[..., ::-1]),
        "img_shape": frame.image.shape,
        "ori_shape": frame.image.shape,
        "pad_shape": frame.image.shape,
        "scale_factor": 1.0,
        "img_norm_cfg": {"mean": np.zeros(3), "std": np.ones(3), "to_rgb": False},
    }
    if label:
        results["gt_semantic_seg"] = frame.label.copy()
        results["seg_fields"] = ["gt_semantic_seg"]
    return results


def new(index: int = 0, label: bool = True) -> Results:
    """What 1.2 holds after LoadImageFromFile, LoadAnnotations and LoadDepthAnnotation."""
    frame = TinyClip().frame(TinyClip().keys[index])
    results = {
        "img_path": f"images/{index}.png",
        "seg_map_path": f"labels/{index}.png",
        "label_map": None,
        "reduce_zero_label": False,
        "seg_fields": ["gt_depth_map"],
        "sample_idx": index,
        "img": np.ascontiguousarray(frame.image[..., ::-1]),
        "img_shape": frame.image.shape[:2],
        "ori_shape": frame.image.shape[:2],
        "gt_depth_map": frame.depth_m.copy(),
    }
    if label:
        results["gt_seg_map"] = frame.label.copy()
        results["seg_fields"] = ["gt_seg_map", "gt_depth_map"]
    return results


GENERATIONS = pytest.mark.parametrize(
    ("loaded", "label"), [(old, "gt_semantic_seg"), (new, "gt_seg_map")], ids=["0.x", "1.x"]
)


@GENERATIONS
def test_picture_and_label_get_weather_and_all_else_stays(loaded: Any, label: str) -> None:
    results = loaded()
    results["valid_pseudo_mask"] = np.ones(results["img"].shape[:2], np.uint8)
    before = copy.deepcopy(results)
    done = RandomWeather(FOG, p=1)(results)
    assert done is not results
    assert done.keys() == results.keys()
    assert all(done[name] is results[name] for name in results if name not in ("img", label))
    for name in ("img", label, "valid_pseudo_mask"):
        assert (results[name] == before[name]).all()
    assert (done["img"].dtype, done["img"].shape) == (np.uint8, results["img"].shape)
    assert done["img"].flags.c_contiguous
    hidden = done[label] != results[label]
    assert hidden.any()
    assert (done[label][hidden] == IGNORE).all()
    assert done[label].dtype == results[label].dtype


@GENERATIONS
def test_it_is_the_renderers_picture_in_bgr(loaded: Any, label: str) -> None:
    """The bytes are those of the shared contract on the RGB picture, turned round."""
    results = loaded()
    transform = RandomWeather(SNOW, p=1, seed=3, keyed=True)
    weathering = Weathering.of(SNOW)
    rgb = results["img"][..., ::-1]
    name = results.get("sample_idx", results.get("ori_filename"))
    drawn = weathering.draw(transform._sample.draws.key(rgb, name))
    expected = weathering.render(rgb, drawn, mask=results[label])
    done = transform.transform(results)
    assert (expected.image[..., ::-1] == done["img"]).all()
    assert (expected.mask == done[label]).all()


def test_the_order_of_channels_matters() -> None:
    """An RGB picture under channel_order='rgb' is the BGR one's mirror image in channels."""
    bgr = new()
    rgb = bgr | {"img": np.ascontiguousarray(bgr["img"][..., ::-1])}
    expected = RandomWeather(FOG, p=1, keyed=True)(bgr)["img"][..., ::-1]
    done = RandomWeather(FOG, p=1, keyed=True, channel_order="rgb")(rgb)["img"]
    assert (expected == done).all()
    assert (expected != RandomWeather(FOG, p=1, keyed=True)(rgb)["img"]).any()


def test_depth_of_the_sample_is_used() -> None:
    """Dense fog: with everything at 1 m nothing is hidden, at 900 m all but the sky."""
    results = new()
    shape = results["img"].shape[:2]
    fog = RandomWeather(FOG, p=1, keyed=True, depth_key="gt_depth_map")
    near = fog(results | {"gt_depth_map": np.full(shape, 1, np.float32)})
    far = fog(results | {"gt_depth_map": np.full(shape, 900, np.float32)})
    assert (near["gt_seg_map"] == results["gt_seg_map"]).all()
    assert (far["gt_seg_map"][results["gt_seg_map"] != SKY] == IGNORE).all()


def test_a_scene_gives_the_full_effect(tiny_scene: Any) -> None:
    """With a key the renderer knows the true depth and camera of the picture."""
    results = new()
    transform = RandomWeather(SNOW, p=1, keyed=True, scenes=[tiny_scene.path])
    key = FrameKey(0, "front")
    done = transform(results | {"scene_key": str(key)})
    drawn = transform._sample.weathering.draw(transform._sample.draws.key(results["img"], 0))
    expected = tiny_scene.render(key, drawn.weather, seed=drawn.seed)
    assert (expected.image == done["img"][..., ::-1]).all()
    assert (expected.label == done["gt_seg_map"]).all()


@GENERATIONS
def test_a_resize_alone_may_come_first(loaded: Any, label: str) -> None:
    results = loaded()
    half = {"img": results["img"][::2, ::2].copy(), label: results[label][::2, ::2].copy()}
    shape, factor = half["img"].shape, (0.5, 0.5)
    if "pad_shape" in results:
        factor = np.array([0.5, 0.5, 0.5, 0.5], np.float32)
    resized = results | half | {"img_shape": shape[:2], "scale_factor": factor}
    assert RandomWeather(FOG, p=1)(resized)["img"].shape == shape


@GENERATIONS
@settings(max_examples=30)
@given(data=st.data())
def test_a_part_is_refused_whatever_the_weather(loaded: Any, label: str, data: Any) -> None:
    results = loaded()
    height, width = results["img"].shape[:2]
    rows = data.draw(st.integers(1, height - 2))
    columns = data.draw(st.integers(1, width - 2))
    cut = results | {"img": results["img"][:rows, :columns]}
    with pytest.raises(ArgumentError, match="before crops"):
        RandomWeather(FOG, p=data.draw(st.sampled_from([0, 1])))(cut)


def wrong(name: str) -> Results:
    results = new()
    picture = results["img"]
    changes: dict[str, Results] = {
        "no picture": {"img": None},
        "channels first": {"img": picture.transpose(2, 0, 1), "ori_shape": (3, 48)},
        "normalised": {"img": (picture.astype(np.float32) - 100) / 50},
        "loaded with to_float32": {"img": picture.astype(np.float32)},
        "flipped": {"flip": True, "flip_direction": "horizontal"},
        "another label": {"gt_seg_map": results["gt_seg_map"][:10]},
        "depth in the first size": {"depth": np.ones((96, 128), np.float32)},
        "a key without scenes": {"scene_key": "000000_front"},
    }
    return results | changes[name]


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("no picture", "after LoadImageFromFile"),
        ("channels first", "shape"),
        ("normalised", "before normalisation"),
        ("loaded with to_float32", "before normalisation"),
        ("flipped", "before RandomFlip"),
        ("another label", "mask"),
        ("depth in the first size", "depth"),
        ("a key without scenes", "scenes="),
    ],
)
def test_what_came_before_in_the_wrong_order_is_named(name: str, says: str) -> None:
    with pytest.raises(ArgumentError, match=says):
        RandomWeather(FOG, p=1)(wrong(name))


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"p": 1.5}, "p must be"),
        ({"channel_order": "grb"}, "'bgr' or 'rgb'"),
        ({"prob": 0.5}, "no argument prob"),
        ({"policy": {"types": {"hail": 1}}}, "hail"),
        ({"scenes": "scenes/one"}, "sequence of folders"),
        ({"seed": 0.5}, "seed"),
    ],
)
def test_a_wrong_config_is_refused_when_it_is_built(arguments: Results, says: str) -> None:
    with pytest.raises(WeatherAugError, match=says):
        RandomWeather(**arguments)


def test_plain_values_make_the_same_transform() -> None:
    """As a config writes them."""
    plain = {"policy": {"types": {"snow": 1}, "severity": [0.9, 1.0], "falling": 1.0}, "p": 1}
    by_config = RandomWeather(**plain, keyed=True, options={"without": ["noise"]})
    by_objects = RandomWeather(SNOW, 1, keyed=True, options={"without": ("noise",)})
    assert (by_config(new())["img"] == by_objects(new())["img"]).all()
    assert "p=1.0, seed=0, keyed=True" in repr(by_config)


def test_probability_is_kept() -> None:
    results = new()
    half = RandomWeather(FOG, p=0.5)
    changed = sum((half(results)["img"] != results["img"]).any() for _ in range(100))
    assert 25 <= changed <= 75  # five standard deviations about 50
    assert (RandomWeather(FOG, p=0)(results)["img"] == results["img"]).all()


def test_unnamed_draws_differ_and_named_ones_repeat() -> None:
    results = new()
    unnamed, named = RandomWeather(MIXED, p=1), RandomWeather(MIXED, p=1, keyed=True)
    assert len({unnamed(results)["img"].tobytes() for _ in range(4)}) == 4
    assert len({named(results)["img"].tobytes() for _ in range(4)}) == 1
    first = named(results)["img"]
    assert (named(results | {"sample_idx": 1})["img"] != first).any()
    named.set_epoch(1)
    assert (named(results)["img"] != first).any()
    assert (RandomWeather(MIXED, p=1, keyed=True, seed=1)(results)["img"] != first).any()


def test_a_nameless_sample_cannot_be_keyed() -> None:
    results = {name: value for name, value in new().items() if name not in mmseg.NAMES}
    with pytest.raises(ArgumentError, match="sample_idx, ori_filename"):
        RandomWeather(FOG, keyed=True)(results)
    RandomWeather(FOG, p=1)(results)


class Samples(Dataset[Any]):
    """A data set of mmseg, as far as a DataLoader knows it."""

    def __init__(self, transform: RandomWeather, count: int = 8) -> None:
        self.transform, self.count = transform, count

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Any:
        return self.transform(new(index % 2) | {"sample_idx": index})["img"]


def pictures(transform: RandomWeather, workers: int) -> list[bytes]:
    how = {"multiprocessing_context": multiprocessing.get_context("fork")} if workers else {}
    loader = DataLoader(Samples(transform), batch_size=None, num_workers=workers, **how)
    return [np.asarray(image).tobytes() for image in loader]


def test_workers_do_not_repeat_each_other() -> None:
    assert len({*pictures(RandomWeather(MIXED, p=1), workers=2)}) == 8


def test_named_draws_are_the_same_on_any_number_of_workers() -> None:
    transform = RandomWeather(MIXED, p=1, keyed=True)
    assert pictures(transform, workers=2) == pictures(transform, workers=0)
    again = pickle.loads(pickle.dumps(transform))
    assert pictures(again, workers=0) == pictures(transform, workers=0)


class Registry:
    """What registries of mmcv 1.x and of mmengine have in common."""

    def __init__(self) -> None:
        self.module_dict: dict[str, type] = {}

    def register_module(
        self, name: str | None = None, force: bool = False, module: Any = None
    ) -> None:
        assert name is not None
        if not force and name in self.module_dict:
            raise KeyError(f"{name} is already registered")
        self.module_dict[name] = module

    def build(self, config: Results) -> Any:
        arguments = dict(config)
        return self.module_dict[arguments.pop("type")](**arguments)


WHERE = pytest.mark.parametrize("where", [".".join(names) for names in mmseg.REGISTRIES])


@pytest.fixture
def registry(where: str, monkeypatch: pytest.MonkeyPatch) -> Registry:
    """That of an mmseg which has nothing else."""
    made = Registry()
    *packages, attribute = where.split(".")
    for depth in range(1, len(packages) + 1):
        module = ModuleType(".".join(packages[:depth]))
        module.__path__ = []
        monkeypatch.setitem(sys.modules, module.__name__, module)
    setattr(module, attribute, made)
    return made


@WHERE
def test_configs_find_it_by_name(where: str, registry: Registry) -> None:
    assert mmseg.register() == where
    assert mmseg.register() == where
    config = {"type": "RandomWeather", "policy": {"types": {"fog": 1}}, "p": 0.7}
    assert isinstance(registry.build(config), RandomWeather)
    mmseg.register("WeatherAug")
    assert registry.module_dict == {"RandomWeather": RandomWeather, "WeatherAug": RandomWeather}


@WHERE
def test_custom_imports_are_enough(
    where: str, registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Importing the module is what `custom_imports` of a config does."""
    monkeypatch.setattr(transforms, "mmseg", mmseg)
    monkeypatch.delitem(sys.modules, mmseg.__name__)
    fresh = import_module(mmseg.__name__)
    assert registry.module_dict == {"RandomWeather": fresh.RandomWeather}


@WHERE
def test_a_name_that_is_taken_is_told(where: str, registry: Registry) -> None:
    registry.module_dict["RandomWeather"] = dict
    with pytest.raises(ConflictError, match="register"):
        mmseg.register()
    with pytest.warns(UserWarning, match=r"register\('WeatherAug'\)"):
        mmseg._register_quietly()
    assert mmseg.register("WeatherAug") == where
    assert registry.module_dict["RandomWeather"] is dict


@pytest.mark.parametrize(
    ("source", "error"),
    [
        ("assert False, 'MMCV==2.2.0 is used but incompatible'", AssertionError),
        ("import mmcv_that_is_absent", ModuleNotFoundError),
    ],
)
def test_a_broken_mmseg_is_told_and_does_no_harm(
    source: str, error: type[Exception], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mmseg").mkdir()
    (tmp_path / "mmseg" / "__init__.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.warns(UserWarning, match=f"not registered with mmseg .{error.__name__}"):
        mmseg._register_quietly()
    with pytest.raises(error):
        mmseg.register()


@pytest.mark.skipif(find_spec("mmseg") is not None, reason="mmseg is installed")
def test_without_mmseg_nothing_is_said_until_it_is_asked_for() -> None:
    mmseg._register_quietly()
    with pytest.raises(MissingExtraError, match="install mmsegmentation"):
        mmseg.register()


@GENERATIONS
def test_pipelines_without_labels_see_depth_in_the_picture(loaded: Any, label: str) -> None:
    """As in HRDA's target pipelines and in test pipelines."""
    results = loaded(label=False)
    with warnings.catch_warnings():
        # Said once in a process: that depth is guessed.
        warnings.simplefilter("ignore", GuessedDepthWarning)
        done = RandomWeather(FOG, p=1)(results)
    assert label not in done
    assert (done["img"] != results["img"]).any()
