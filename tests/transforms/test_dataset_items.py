"""What an item is: pairs, tuples, even shares of weathers, and nothing shared or changed."""

from __future__ import annotations

import copy
import json
import pickle
import random
from collections import Counter
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from test_dataset import PLANES, digest_of
from tiny_clip import TinyClip
from torch.utils.data import DataLoader, Subset

from weather_aug.clip.types import Frame, FrameKey
from weather_aug.errors import ArgumentError
from weather_aug.scene.policy import TYPES, WeatherPolicy
from weather_aug.scene.scene import WeatherScene
from weather_aug.scene.viewpoint import ViewpointJitter
from weather_aug.transforms.curriculum import SeverityCurriculum
from weather_aug.transforms.dataset import WeatherDataset
from weather_aug.transforms.permutation import dealt
from weather_aug.transforms.sampling import RareClass
from weather_aug.weather import Weather

POLICY = WeatherPolicy({"rain": 1, "snow": 1, "fog": 1}, severity=(0.5, 1.0), falling=1.0)
ALL = WeatherPolicy({"clear": 1, "rain": 1, "snow": 1, "fog": 1, "rain+fog": 1})
CROP = (32, 40)


class Kept(TinyClip):
    """A clip that gives the same writeable arrays again and again."""

    def frame(self, key: FrameKey) -> Frame:
        frames = self.__dict__.setdefault("frames_kept", {})
        if key not in frames:
            frame = super().frame(key)
            for name in ("image", "label", "depth_m"):
                object.__setattr__(frame, name, np.array(getattr(frame, name)))
            frames[key] = frame
        return frames[key]


def planes_of(frame: Frame) -> list[bytes]:
    return [np.asarray(p).tobytes() for p in (frame.image, frame.label, frame.depth_m)]


@pytest.mark.parametrize("viewpoints", [False, True])
def test_clear_is_the_same_picture_without_weather(
    tiny_scene: WeatherScene, gaussian_scene: WeatherScene, viewpoints: bool
) -> None:
    """The same frame, crop and viewpoint; the rest of the item is what it is without it."""
    jitter = ViewpointJitter(lateral_m=1.0) if viewpoints else None
    scenes = [gaussian_scene] if viewpoints else [tiny_scene, TinyClip()]
    choices: dict[str, Any] = {"crop": CROP, "viewpoint_jitter": jitter}
    pair = WeatherDataset(scenes, POLICY, with_clear=True, **choices)
    plain = WeatherDataset(scenes, POLICY, **choices)
    for index in (0, len(pair) - 1):
        item = pair[index]
        clear = item.pop("clear")
        assert digest_of(item) == digest_of(plain[index])
        recipe = json.loads(item["recipe"]) | {"weather": Weather.clear().to_dict()}
        expected = pair.render_recipe(recipe).image.transpose(2, 0, 1)
        assert (clear.dtype, clear.shape) == (torch.uint8, (3, *CROP))
        assert np.array_equal(clear.numpy(), expected)
        assert clear.is_contiguous()
        assert not torch.equal(clear, item["image"])


def test_clear_of_clear_weather_is_the_picture(tiny_scene: WeatherScene) -> None:
    """M5, and memory of its own: who paints one does not paint the other."""
    policy = WeatherPolicy({"clear": 1})
    item = WeatherDataset([tiny_scene], policy, with_clear=True)[3]
    assert torch.equal(item["clear"], item["image"])
    recorded = tiny_scene.frame(tiny_scene.keys[3])
    assert np.array_equal(item["image"].permute(1, 2, 0).numpy(), recorded.image)
    assert np.array_equal(item["label"].numpy(), recorded.label)
    item["clear"][:] = 0
    assert item["image"].any()


def test_tuples_are_what_training_loops_take(tiny_scene: WeatherScene) -> None:
    item = WeatherDataset([tiny_scene], POLICY)[2]
    image, label = WeatherDataset([tiny_scene], POLICY, output="tuple")[2]
    assert torch.equal(image, item["image"])
    assert torch.equal(label, item["label"])
    three = WeatherDataset([tiny_scene], POLICY, output="tuple", with_clear=True)
    batch = next(iter(DataLoader(three, batch_size=4)))
    assert [part.shape for part in batch] == [(4, 3, 48, 64), (4, 48, 64), (4, 3, 48, 64)]
    assert [part.dtype for part in batch] == [torch.uint8, torch.int64, torch.uint8]


def test_transforms_get_the_clear_picture_as_an_array(tiny_scene: WeatherScene) -> None:
    dataset = WeatherDataset([tiny_scene], POLICY, with_clear=True, transform=lambda s: s["clear"])
    assert np.array_equal(dataset[5], tiny_scene.frame(tiny_scene.keys[5]).image)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"output": "list"}, "output must be one of dict, tuple, got 'list'"),
        ({"output": "tuple", "transform": print}, "exclude each other"),
        *(({"length": n}, "length must be") for n in (0, -1, 1.5, "8", True, 2**40)),
    ],
    ids=str,
)
def test_bad_arguments_are_refused(
    tiny_scene: WeatherScene, arguments: dict[str, Any], says: str
) -> None:
    with pytest.raises(ArgumentError, match=says):
        WeatherDataset([tiny_scene], **arguments)


def test_tuples_need_labels(unlabelled_scene: WeatherScene) -> None:
    with pytest.raises(ArgumentError, match="the frames have no labels"):
        WeatherDataset([unlabelled_scene], output="tuple")
    item = WeatherDataset([unlabelled_scene], with_clear=True)[0]
    assert set(item) == {*PLANES, "recipe", "clear"} - {"label", "label_full"}


@pytest.fixture(scope="module")
def balanced(tiny_scene: WeatherScene) -> WeatherDataset:
    return WeatherDataset([tiny_scene], ALL, length=103, balanced_weathers=True)


@given(
    st.dictionaries(st.sampled_from([*TYPES, "rain+fog"]), st.integers(0, 9), min_size=1),
    st.integers(0, 2**63 - 1),
    st.integers(1, 300),
)
@settings(suppress_health_check=[HealthCheck.filter_too_much])
def test_weathers_are_dealt_out_evenly(types: dict[str, int], epoch: int, length: int) -> None:
    """Each type's number differs from its exact share of the epoch by less than one."""
    total = sum(types.values())
    if total == 0:
        return
    policy = WeatherPolicy(types)
    found = Counter(
        policy.draw(3, epoch, i, which=dealt(3, epoch, i, length)).kind for i in range(length)
    )
    for name, weight in types.items():
        # In whole numbers: |found - length * weight / total| < 1.
        assert abs(found[name] * total - length * weight) < total, name


def test_a_balanced_dataset_is_even(balanced: WeatherDataset) -> None:
    for epoch in range(3):
        balanced.set_epoch(epoch)
        kinds = Counter(balanced.drawn(index).kind for index in range(103))
        assert set(kinds) == set(ALL.types)
        assert set(kinds.values()) <= {20, 21}


def test_independent_draws_would_not_be_even(tiny_scene: WeatherScene) -> None:
    dataset = WeatherDataset([tiny_scene], ALL, length=103)
    kinds = Counter(dataset.drawn(index).kind for index in range(103))
    assert not set(kinds.values()) <= {20, 21}


def test_balance_changes_the_type_alone(tiny_scene: WeatherScene, balanced: WeatherDataset) -> None:
    plain = WeatherDataset([tiny_scene], ALL, length=103)
    balanced.set_epoch(0)
    pairs = [(balanced.drawn(i), plain.drawn(i)) for i in range(103)]
    assert all(a.severity == b.severity and a.seed == b.seed for a, b in pairs)
    assert len({a.kind == b.kind for a, b in pairs}) == 2
    item = balanced[4]
    draw = balanced.drawn(4)
    recipe = json.loads(item["recipe"])
    assert (recipe["weather"], recipe["seed"]) == (draw.weather.to_dict(), draw.seed)


def correlation(a: Any, b: Any) -> float:
    return float(np.corrcoef(a, b)[0, 1])


@pytest.mark.parametrize("is_balanced", [False, True])
def test_draws_know_nothing_of_their_neighbours(
    tiny_scene: WeatherScene, is_balanced: bool
) -> None:
    """S5, of severities and particles: items, epochs and seeds next to each other; n = 2000."""
    n = 2000

    def drawn(seed: int, epoch: int) -> tuple[Any, Any]:
        choices: dict[str, Any] = {"length": n + 2, "balanced_weathers": is_balanced}
        dataset = WeatherDataset([tiny_scene], ALL, seed=seed, **choices)
        dataset.set_epoch(epoch)
        draws = [dataset.drawn(index) for index in range(n + 2)]
        return np.array([d.severity for d in draws]), np.array([d.seed for d in draws], float)

    here = drawn(5, 3)
    others = [drawn(6, 3), drawn(5, 4)]
    for which in (0, 1):
        base = here[which][:n]
        for other in (here[which][1 : n + 1], here[which][2 : n + 2]):
            assert abs(correlation(base, other)) <= 4 / np.sqrt(n)
        for other in others:
            assert abs(correlation(base, other[which][:n])) <= 4 / np.sqrt(n)
            # Item i - 1 of the next seed: what sums of seed and index would repeat.
            assert abs(correlation(base, other[which][1 : n + 1])) <= 4 / np.sqrt(n)
            assert not (base == other[which][:n]).any()
    assert abs(correlation(here[0], here[1])) <= 4 / np.sqrt(n)


def test_seeds_added_to_items_would_be_seen() -> None:
    """The comparison above sees streams that repeat each other."""
    policy = ALL
    one = [policy.draw(0, 0, 5 + i).severity for i in range(100)]
    other = [policy.draw(0, 0, 6 + i).severity for i in range(99)]
    assert correlation(one[1:], other) > 0.99


def test_sources_are_not_changed() -> None:
    """M1: a clip's own arrays, though they could be written, at any choice of output."""
    clip = Kept()
    before = {key: planes_of(clip.frame(key)) for key in clip.keys}
    law = RareClass(min_pixels=40)
    for choices in ({}, {"with_clear": True, "crop": CROP, "sampling": law, "output": "tuple"}):
        dataset = WeatherDataset([clip], ALL, length=24, **choices)
        for index in range(24):
            item = dataset[index]
            for plane in item.values() if isinstance(item, dict) else item:
                if isinstance(plane, torch.Tensor):
                    plane.zero_()
    assert {key: planes_of(clip.frame(key)) for key in clip.keys} == before


def test_a_source_that_is_painted_would_be_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """The arrays compared above are those that are rendered from."""
    clip = Kept()
    key = clip.keys[0]
    before = planes_of(clip.frame(key))
    monkeypatch.setattr(
        "weather_aug.transforms.dataset.clear_of", lambda opened, shot, asked: shot.frame.image
    )
    policy = WeatherPolicy({"fog": 1})
    item = WeatherDataset([clip], policy, with_clear=True, transform=lambda s: s)[0]
    item["clear"][:] = 0
    assert planes_of(clip.frame(key)) != before


@pytest.mark.parametrize("transform", [None, dict])
def test_items_share_no_memory(tiny_scene: WeatherScene, transform: Any) -> None:
    """M3: with the source, with earlier items, or plane with plane."""
    clip = Kept()
    for source in (clip, tiny_scene):
        dataset = WeatherDataset([source], ALL, with_clear=True, transform=transform)
        items = [dataset[index] for index in (*range(8), *range(8))]
        planes = [np.asarray(v) for item in items for v in item.values() if not isinstance(v, str)]
        owners = {plane.__array_interface__["data"][0] for plane in planes}
        assert len(owners) == len(planes) == 16 * 7
        for key in clip.keys:
            frame = clip.frame(key)
            for plane in planes:
                assert not any(
                    np.shares_memory(plane, part)
                    for part in (frame.image, frame.label, frame.depth_m)
                    if part is not None
                )


def test_a_transform_that_fails_harms_no_other_item(tiny_scene: WeatherScene) -> None:
    """M6: a hundred faults; the next item is right after each."""
    faulty = True

    def transform(sample: dict[str, Any]) -> dict[str, Any]:
        if faulty:
            sample["image"][:] = 0
            raise ZeroDivisionError
        return sample

    fog = WeatherPolicy({"fog": 1})
    dataset = WeatherDataset([tiny_scene], fog, transform=transform, crop=(8, 8))
    plain = WeatherDataset([tiny_scene], fog, transform=lambda s: s, crop=(8, 8))
    expected = [plain[index]["image"].tobytes() for index in range(8)]
    for index in range(100):
        faulty = True
        with pytest.raises(ZeroDivisionError):
            dataset[index % 8]
        faulty = False
        assert dataset[(index + 1) % 8]["image"].tobytes() == expected[(index + 1) % 8]


def full(scene: WeatherScene) -> WeatherDataset:
    """Everything that can be chosen, at once."""
    return WeatherDataset(
        [scene, TinyClip()],
        ALL,
        seed=3,
        crop=CROP,
        sampling=RareClass(min_pixels=40),
        length=12,
        balanced_weathers=True,
        curriculum=SeverityCurriculum(((0, (0.1, 0.3)), (4, (0.2, 1.0)))),
        with_clear=True,
    )


def test_copies_in_the_middle_of_use_draw_the_same(tiny_scene: WeatherScene) -> None:
    """D14; each copy then has an epoch of its own."""
    dataset = full(tiny_scene)
    dataset.set_epoch(2)
    expected = [digest_of(dataset[index]) for index in range(12)]
    for other in (pickle.loads(pickle.dumps(dataset)), copy.deepcopy(dataset)):
        assert [digest_of(other[index]) for index in range(12)] == expected
        other.set_epoch(3)
        assert dataset.epoch == 2
        assert digest_of(other[0]) != expected[0]
        assert other.fingerprint() == dataset.fingerprint()


def test_repeated_and_interleaved_items_are_the_same(tiny_scene: WeatherScene) -> None:
    """D1, with all choices on; in any order, and of subsets (D4)."""
    dataset = full(tiny_scene)
    expected = [digest_of(dataset[index]) for index in range(12)]
    assert len(set(expected)) == 12
    places = np.random.default_rng(0).integers(0, 12, 60).tolist()
    assert [digest_of(dataset[index]) for index in places] == [expected[i] for i in places]
    subset = Subset(dataset, [7, 3, 3])
    assert [digest_of(subset[i]) for i in range(3)] == [expected[i] for i in (7, 3, 3)]


def test_global_generators_are_neither_read_nor_moved(tiny_scene: WeatherScene) -> None:
    """D6, with all choices on."""

    def states() -> tuple[Any, ...]:
        numpy_state = np.random.get_state()[1].tolist()  # noqa: NPY002 - what is tested
        return random.getstate(), numpy_state, torch.get_rng_state().tolist()

    expected = None
    for seeding in range(3):
        random.seed(seeding)
        np.random.seed(seeding)  # noqa: NPY002
        torch.manual_seed(seeding)
        before = states()
        dataset = full(tiny_scene)
        found = [digest_of(dataset[index]) for index in range(12)]
        assert states() == before
        assert found == (expected := expected or found)


def test_a_pickled_dataset_stays_small(tiny_scene: WeatherScene) -> None:
    """K1: 64 KiB and 1 KiB a scene; also with the classes of 100 frames in each."""
    scenes = [tiny_scene] * 100
    dataset = WeatherDataset(scenes, ALL, sampling=RareClass(min_pixels=40))
    assert len(dataset) == 800
    assert len(pickle.dumps(dataset)) <= (64 + len(scenes)) * 1024
