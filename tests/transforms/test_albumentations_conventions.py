"""What albumentations promises of every transform, and its tests check of its own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import albumentations as A
import numpy as np
import pytest
from tiny_clip import TinyClip

from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.taxonomy import IGNORE, SKY
from weather_aug.transforms.albumentations import (
    RandomFog,
    RandomRain,
    RandomSnow,
    RandomWeather,
)

EACH = pytest.mark.parametrize("make", [RandomRain, RandomSnow, RandomFog])
Make = Callable[..., RandomWeather]
Sample = dict[str, Any]


@pytest.fixture
def sample() -> Sample:
    frame = TinyClip().frame(FrameKey(0, "front"))
    return {
        "image": frame.image.copy(),
        "mask": frame.label.copy(),
        "depth": frame.depth_m.copy(),
        "sample_key": 4,
    }


LAYOUTS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "Fortran order": np.asfortranarray,
    "every second row": lambda a: np.repeat(a, 2, axis=0)[::2],
    "backwards": lambda a: np.ascontiguousarray(a[::-1, ::-1])[::-1, ::-1],
    "part of another": lambda a: np.pad(a, [(1, 1)] * a.ndim)[(slice(1, -1),) * a.ndim],
    "big-endian": lambda a: a.astype(a.dtype.newbyteorder(">")),
    "read-only": lambda a: np.frombuffer(a.tobytes(), a.dtype).reshape(a.shape),
    "unaligned": lambda a: np.frombuffer(b"0" + a.tobytes(), a.dtype, offset=1).reshape(a.shape),
}


@pytest.mark.parametrize("in_compose", [True, False], ids=["in a Compose", "alone"])
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_layouts_do_not_matter_and_inputs_stay(
    sample: Sample, layout: str, dtype: type, in_compose: bool
) -> None:
    weather = RandomSnow(p=1.0)
    call = A.Compose([weather]) if in_compose else weather
    if dtype is np.float32:
        sample["image"] = sample["image"].astype(np.float32) / np.float32(255)
        sample["mask"] = sample["mask"].astype(np.int32)
    expected = call(**sample)
    arrays = {name: LAYOUTS[layout](sample[name]) for name in ("image", "mask", "depth")}
    before = {name: (a.tobytes(), a.flags.num, a.strides) for name, a in arrays.items()}
    done = call(**sample | arrays)
    assert {name: (a.tobytes(), a.flags.num, a.strides) for name, a in arrays.items()} == before
    for name in ("image", "mask"):
        assert done[name].tobytes() == expected[name].tobytes()
        assert done[name].flags.c_contiguous
        assert done[name].flags.writeable
        assert done[name].dtype == sample[name].dtype
        assert done[name].shape == sample[name].shape
        assert not np.shares_memory(done[name], arrays[name])


@EACH
def test_uint8_and_float32_agree(sample: Sample, make: Make) -> None:
    floats = sample | {"image": sample["image"].astype(np.float32) / np.float32(255)}
    expected, done = make(p=1.0)(**sample), make(p=1.0)(**floats)
    assert done["image"].dtype == np.float32
    assert 0 <= done["image"].min()
    assert done["image"].max() <= 1
    assert np.abs(done["image"] * 255 - expected["image"]).max() <= 1
    assert (done["mask"] == expected["mask"]).all()


@EACH
def test_the_same_seed_gives_the_same_sequence(sample: Sample, make: Make) -> None:
    del sample["sample_key"]
    pipelines = [A.Compose([make(p=0.8)], seed=137) for _ in range(2)]
    runs = [[each(**sample)["image"].tobytes() for _ in range(5)] for each in pipelines]
    assert runs[0] == runs[1]
    pipelines[0].set_random_seed(137)
    assert [pipelines[0](**sample)["image"].tobytes() for _ in range(5)] == runs[0]


@pytest.mark.parametrize("given", ["depth", "no depth"])
@pytest.mark.parametrize("of", [IGNORE, SKY])
@pytest.mark.filterwarnings("ignore::weather_aug.clip.depth_sources.GuessedDepthWarning")
@EACH
def test_masks_of_nothing(sample: Sample, make: Make, of: int, given: str) -> None:
    """All ignored, or all sky."""
    sample["mask"] = np.full_like(sample["mask"], of)
    if given == "no depth":
        del sample["depth"]
    done = A.Compose([make(p=1.0)])(**sample)
    assert done["image"].shape == sample["image"].shape
    assert set(np.unique(done["mask"])) <= {of, IGNORE}


@pytest.mark.filterwarnings("ignore::weather_aug.clip.depth_sources.GuessedDepthWarning")
def test_a_picture_alone_is_enough(sample: Sample) -> None:
    done = A.Compose([RandomFog(p=1.0)])(image=sample["image"], sample_key=1)
    assert (done["image"] != sample["image"]).any()
    assert "mask" not in done


def test_empty_lists_of_masks_pass_through(sample: Sample) -> None:
    done = A.Compose([RandomSnow(p=1.0)])(**sample, masks=[])
    assert done["masks"] == []


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (5, 1), (2, 3), (37, 53)], ids=str)
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_odd_sizes(size: tuple[int, int], dtype: type) -> None:
    image = np.full((*size, 3), 0.5 if dtype is np.float32 else 128, dtype)
    given = {"mask": np.zeros(size, np.uint8), "depth": np.full(size, 30.0, np.float32)}
    done = A.Compose([RandomRain(p=1.0)])(image=image, **given)
    assert (done["image"].shape, done["image"].dtype) == (image.shape, image.dtype)
    assert done["mask"].shape == size


@pytest.mark.parametrize("size", [(0, 4), (4, 0), (0, 0)], ids=str)
def test_pictures_without_pixels_are_refused(size: tuple[int, int]) -> None:
    with pytest.raises(ArgumentError, match="image has a zero side"):
        RandomRain(p=1.0)(image=np.zeros((*size, 3), np.uint8), mask=np.zeros(size, np.uint8))


def test_a_strict_compose_knows_what_we_read(sample: Sample) -> None:
    camera = TinyClip().camera(FrameKey(0, "front"))
    done = A.Compose([RandomSnow(p=1.0)], strict=True)(**sample, camera=camera)
    assert done["camera"] is camera
    assert done["sample_key"] == 4
    several = {"images": "images", "masks": "masks", "depths": "depths"}
    stack = {name: np.stack([sample[name[:-1]]] * 2) for name in several}
    A.Compose([RandomSnow(p=1.0)], strict=True)(**stack, cameras=[camera] * 2)
    with pytest.raises(ValueError, match="nothing"):
        A.Compose([RandomSnow(p=1.0)], strict=True)(**sample, nothing=1)


def test_depth_may_follow_the_geometry(sample: Sample) -> None:
    """Declared as a mask it is flipped with the picture, after we have read it; never marked."""
    transforms = [RandomFog((20, 30), p=1.0), A.HorizontalFlip(p=1.0)]
    plain = A.Compose(transforms[:1])(**sample)
    both = A.Compose(transforms, additional_targets={"depth": "mask"})(**sample)
    assert (both["depth"] == sample["depth"][:, ::-1]).all()
    assert (both["image"] == plain["image"][:, ::-1]).all()
    assert (both["mask"] == plain["mask"][:, ::-1]).all()


def test_boxes_and_points_stay(sample: Sample) -> None:
    pipeline = A.Compose(
        [RandomSnow(p=1.0)],
        bbox_params=A.BboxParams("coco", label_fields=["classes"]),
        keypoint_params=A.KeypointParams("xyas", remove_invisible=False),
    )
    boxes, points = [[1.0, 2.0, 30.0, 40.0]], [[3.0, 4.0, 0.5, 2.0], [500.0, -4.0, 0.1, 1.0]]
    done = pipeline(**sample, bboxes=boxes, keypoints=points, classes=["car"])
    # Compose itself scales boxes to [0, 1] and back, in float32, and turns angles to degrees.
    assert np.allclose(done["bboxes"], boxes, rtol=0, atol=1e-4)
    assert np.allclose(done["keypoints"], points, rtol=0, atol=1e-4)
    assert done["classes"] == ["car"]


def test_what_is_not_ours_is_the_same_object(sample: Sample) -> None:
    own = {"note": object(), "items": [1], "depths": object(), "cameras": object()}
    done = A.Compose([RandomSnow(p=1.0)])(**sample, **own)
    assert all(done[name] is value for name, value in own.items())
    assert done["sample_key"] == 4


def test_a_failed_call_leaves_the_next_one_right(sample: Sample) -> None:
    pipeline = A.Compose([RandomSnow(p=1.0)])
    expected = pipeline(**sample)["image"]
    for _ in range(5):
        with pytest.raises(ArgumentError):
            pipeline(**sample | {"depth": np.zeros((48, 64), np.float32)})
    assert (pipeline(**sample)["image"] == expected).all()


def test_a_scribble_on_an_output_changes_no_later_one(sample: Sample) -> None:
    pipeline = A.Compose([RandomWeather(WeatherPolicy({"clear": 1}), p=1.0)])
    first = pipeline(**sample)
    expected = first["image"].copy()
    first["image"][:] = 7
    first["mask"][:] = 7
    assert (pipeline(**sample)["image"] == expected).all()
    assert (pipeline(**sample)["mask"] == sample["mask"]).all()
