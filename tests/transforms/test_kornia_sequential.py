"""RandomWeather in containers: kornia's, and ours that shows it masks before pictures."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import kornia.augmentation as K
import numpy as np
import pytest
import torch
from kornia_street import FOG, HEIGHT, MIXED, SNOW, WIDTH, camera, depths, masks, pictures

from weather_aug.clip.depth_sources import DepthSource
from weather_aug.errors import ArgumentError
from weather_aug.taxonomy import IGNORE
from weather_aug.transforms import kornia_sequential
from weather_aug.transforms.kornia import AugmentationSequential, RandomWeather

torch.set_num_threads(1)
KEYS = ["input", "mask"]


@pytest.fixture
def flat_ground(monkeypatch: pytest.MonkeyPatch) -> None:
    """In place of what finds depth in a picture alone: everything 60 m away."""
    found = DepthSource.depth_m

    def depth_m(self: Any, image: Any, label: Any, *rest: Any) -> Any:
        if label is None:
            return np.full(image.shape[:2], 60, np.float32)
        return found(self, image, label, *rest)

    monkeypatch.setattr(DepthSource, "depth_m", depth_m)


def alone(policy: Any = FOG, **given: Any) -> tuple[torch.Tensor, torch.Tensor]:
    return RandomWeather(policy, p=1.0, seed=8)(pictures(), mask=masks(), **given)


def sequence(
    policy: Any = FOG, *others: Any, kind: Any = AugmentationSequential, **how: Any
) -> Any:
    return kind(RandomWeather(policy, p=1.0, seed=8), *others, **({"data_keys": KEYS} | how))


@pytest.mark.parametrize("policy", [FOG, SNOW], ids=["fog", "snow"])
def test_the_mask_is_seen_before_the_picture(policy: Any) -> None:
    found, mask = sequence(policy)(pictures(), masks())
    expected, expected_mask = alone(policy)
    assert torch.equal(found, expected)
    assert torch.equal(mask, expected_mask)
    assert (mask != masks()).any()


def test_the_check_would_notice_a_mask_that_is_not_seen(
    flat_ground: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected, expected_mask = alone()
    monkeypatch.setattr(RandomWeather, "look", blind_look)
    with pytest.warns(UserWarning, match="AugmentationSequential of weather_aug"):
        found, mask = sequence()(pictures(), masks())
    assert not torch.equal(found, expected)
    assert not torch.equal(mask, expected_mask)


LOOK = RandomWeather.look


def blind_look(self: Any, images: Any, params: Any, **known: Any) -> None:
    LOOK(self, images, params, **(known | {"mask": None}))


def test_the_line_of_the_readme() -> None:
    augment = AugmentationSequential(
        RandomWeather(MIXED, p=0.7), K.RandomHorizontalFlip(), data_keys=["input", "mask"]
    )
    images, labels = augment(pictures(6), masks(6)[:, 0])
    assert (images.shape, labels.shape) == (pictures(6).shape, masks(6).shape)
    assert labels.dtype == torch.int64
    again = augment(pictures(6), masks(6)[:, 0], params=augment._params)
    assert torch.equal(again[0], images)
    assert torch.equal(again[1], labels)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int64, torch.float32])
@pytest.mark.parametrize("layout", ["B1HW", "BHW"])
@pytest.mark.parametrize("keepdim", [False, True])
def test_masks_of_any_kind(dtype: torch.dtype, layout: str, keepdim: bool) -> None:
    given = masks(dtype=dtype) if layout == "B1HW" else masks(dtype=dtype)[:, 0]
    _, found = sequence(keepdim=keepdim)(pictures(), given)
    # kornia hands (B, H, W) back as (B, 1, H, W), unless keepdim.
    assert found.shape == (given.shape if keepdim else masks().shape)
    assert found.dtype == dtype
    assert torch.equal(found.reshape(masks().shape).long(), alone()[1])


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_pictures_of_any_kind(dtype: torch.dtype) -> None:
    found, mask = sequence()(pictures(dtype=dtype), masks())
    assert (found.dtype, mask.dtype) == (dtype, torch.int64)
    assert torch.equal(
        mask, RandomWeather(FOG, p=1.0, seed=8)(pictures(dtype=dtype), mask=masks())[1]
    )


def test_one_picture() -> None:
    found, mask = sequence(keepdim=True)(pictures(1)[0], masks(1)[0, 0])
    assert (found.shape, mask.shape) == ((3, HEIGHT, WIDTH), (HEIGHT, WIDTH))
    assert (mask == IGNORE).any()


def test_one_mask_for_a_batch() -> None:
    _, found = sequence()(pictures(), masks(1))
    assert torch.equal(found, alone()[1])


def test_a_list_of_masks() -> None:
    _, found = sequence()(pictures(), list(masks()))
    assert torch.equal(torch.stack([each.reshape(1, HEIGHT, WIDTH) for each in found]), alone()[1])


def test_several_masks_are_marked_and_the_first_holds_the_classes() -> None:
    things = torch.arange(3 * HEIGHT * WIDTH).reshape(3, 1, HEIGHT, WIDTH) + 300
    augment = sequence(data_keys=["input", "mask", "mask"])
    _, mask, marked = augment(pictures(), masks(), things)
    assert torch.equal(mask, alone()[1])
    hidden = (mask == IGNORE) & (masks() != IGNORE)
    assert torch.equal(marked == IGNORE, hidden)
    assert torch.equal(marked[~hidden], things[~hidden])


@pytest.mark.parametrize("keys", [["image", "mask"], ["mask", "image"]])
def test_dictionaries(keys: list[str]) -> None:
    given = {"image": pictures(), "mask": masks()}
    found = sequence(data_keys=None)({key: given[key] for key in keys} | {"name": "street"})
    assert list(found) == [*keys, "name"]
    assert torch.equal(found["image"], alone()[0])
    assert torch.equal(found["mask"], alone()[1])


@pytest.mark.parametrize("first", ["mask", "mask_depth"])
def test_depth_goes_along_and_is_not_marked(first: str) -> None:
    given = {"image": pictures(), "mask": masks(), "mask_depth": depths()}
    order = ["image", first, *({"mask", "mask_depth"} - {first})]
    augment = sequence(FOG, K.RandomHorizontalFlip(p=1.0), data_keys=None)
    found = augment({key: given[key] for key in order})
    expected, mask = alone(depth=depths())
    assert torch.equal(found["image"], expected.flip(-1))
    assert torch.equal(found["mask"], mask.flip(-1))
    assert torch.equal(found["mask_depth"], depths().flip(-1))
    again = augment({key: given[key] for key in order}, params=augment._params)
    assert torch.equal(again["image"], found["image"])


def test_depth_alone_goes_along() -> None:
    found = sequence(data_keys=None)({"image": pictures(), "mask_depth": depths()})
    expected = RandomWeather(FOG, p=1.0, seed=8)(pictures(), depth=depths())
    assert torch.equal(found["image"], expected)
    assert torch.equal(found["mask_depth"], depths())


def test_depth_follows_what_comes_before() -> None:
    flip = K.RandomHorizontalFlip(p=1.0)
    augment = AugmentationSequential(flip, RandomWeather(FOG, p=1.0, seed=8), data_keys=None)
    found = augment({"image": pictures(), "mask": masks(), "mask_depth": depths()})
    flipped = {"mask": masks().flip(-1), "depth": depths().flip(-1)}
    expected, mask = RandomWeather(FOG, p=1.0, seed=8)(pictures().flip(-1), **flipped)
    assert torch.equal(found["image"], expected)
    assert torch.equal(found["mask"], mask)


def test_samples_are_named_in_dictionaries() -> None:
    names = ["a", ("b", 1), 7]
    augment = sequence(MIXED, data_keys=None)
    given = {"image": pictures(), "mask": masks(), "sample_keys": names}
    found = [augment(given) for _ in range(2)]
    assert found[0]["sample_keys"] == names
    assert torch.equal(found[0]["image"], found[1]["image"])
    assert torch.equal(found[0]["image"], alone(MIXED, sample_keys=names)[0])
    del given["sample_keys"]
    assert not torch.equal(augment(given)["image"], found[0]["image"])


def test_cameras_come_in_dictionaries() -> None:
    cameras = [camera(), None, camera()]
    given = {"image": pictures(), "mask": masks(), "cameras": cameras}
    found = sequence(SNOW, data_keys=None)(given)
    assert torch.equal(found["image"], alone(SNOW, cameras=cameras)[0])
    assert not torch.equal(found["image"], alone(SNOW)[0])


def test_boxes_points_and_classes_pass_through() -> None:
    boxes = torch.tensor([[[1.0, 2, 9, 8]]]).repeat(3, 1, 1)
    points = torch.tensor([[[3.0, 4]]]).repeat(3, 1, 1)
    augment = sequence(data_keys=["input", "bbox_xyxy", "keypoints", "mask", "class"])
    _, *found = augment(pictures(), boxes, points, masks(), torch.tensor([1, 2, 3]))
    assert torch.equal(found[0], boxes)
    assert torch.equal(found[1], points)
    assert torch.equal(found[2], alone()[1])
    assert found[3].tolist() == [1, 2, 3]


def test_two_weathers_in_one_container() -> None:
    augment = AugmentationSequential(
        RandomWeather(FOG, p=1.0), RandomWeather(SNOW, p=1.0), data_keys=KEYS, random_apply=1
    )
    images, mask = augment(pictures(), masks())
    assert (images != pictures()).any()
    assert mask.shape == masks().shape


def test_containers_survive_copies() -> None:
    augment = sequence(MIXED)
    copies = [copy.deepcopy(augment), pickle.loads(pickle.dumps(augment))]
    expected = augment(pictures(), masks())
    for each in copies:
        assert all(map(torch.equal, each(pictures(), masks()), expected))
    assert "RandomWeather" in repr(augment)


def test_a_mask_alone_needs_params_of_a_call() -> None:
    augment = sequence()
    _, expected = augment(pictures(), masks())
    assert torch.equal(augment(masks(), params=augment._params, data_keys=["mask"]), expected)
    unseen = augment.forward_parameters(pictures().shape)
    with pytest.raises(ArgumentError, match="know of no picture yet"):
        augment(masks(), params=unseen, data_keys=["mask"])


def test_a_call_that_fails_leaves_nothing_behind() -> None:
    augment = sequence(data_keys=None)
    bad = {"image": pictures() * 3, "mask_depth": depths(), "sample_keys": [1, 2, 3]}
    with pytest.raises(ArgumentError, match=r"\[0, 1\]"):
        augment(bad)
    found = augment({"image": pictures(), "mask": masks()})
    assert (found["mask"] == IGNORE).any()


def test_kornias_own_container_says_what_it_cannot(flat_ground: None) -> None:
    augment = sequence(kind=K.AugmentationSequential)
    with pytest.warns(UserWarning, match="saw the mask after the picture") as told:
        augment(pictures(), masks())
        images, mask = augment(pictures(), masks())
    assert len(told) == 1, "once"
    params = augment._params[0].data
    assert (params["depth"] == 60).all()
    assert torch.equal(mask == IGNORE, params["hidden"] | (masks() == IGNORE))
    assert (mask != masks()).any()
    assert torch.equal(augment(pictures(), masks(), params=augment._params)[0], images)


def test_kornias_own_container_with_masks_that_tell_nothing(flat_ground: None) -> None:
    weather = RandomWeather(FOG, p=1.0, taxonomy=None)
    _, mask = K.AugmentationSequential(weather, data_keys=KEYS)(pictures(), masks())
    assert (mask != masks()).any()


def test_kornias_own_container_does_not_mark_a_depth(flat_ground: None) -> None:
    weather = RandomWeather(FOG, p=1.0, taxonomy=None)
    augment = K.AugmentationSequential(weather, data_keys=None)
    with pytest.raises(ArgumentError, match="mask_depth"):
        augment({"image": pictures(), "mask": masks(), "mask_depth": depths()})


def test_a_picture_alone_goes_through_any_container(flat_ground: None) -> None:
    for kind in (K.ImageSequential, K.AugmentationSequential, AugmentationSequential):
        assert (kind(RandomWeather(FOG, p=1.0))(pictures()) != pictures()).any()


def test_a_video_has_one_weather(flat_ground: None) -> None:
    video = K.VideoSequential(RandomWeather(MIXED, p=1.0), data_format="BTCHW", same_on_frame=True)
    found = video(pictures(4).reshape(2, 2, 3, HEIGHT, WIDTH))
    assert torch.equal(found[:, 0], found[:, 1])
    assert not torch.equal(found[0], found[1])


def test_kornia_hands_modules_on_as_the_container_expects() -> None:
    """What this module overrides in kornia is still there, and still called."""
    base = kornia_sequential.AugmentationSequentialOps
    assert isinstance(K.AugmentationSequential(K.RandomHorizontalFlip()).transform_op, base)
    assert callable(K.AugmentationSequential._preproc_dict_data)
