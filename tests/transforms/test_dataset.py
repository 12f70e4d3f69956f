"""WeatherDataset: item i of epoch e is the same bytes wherever it is drawn."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import pickle
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tiny_clip import TinyClip
from torch.utils.data import DataLoader

from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError
from weather_aug.render.options import RenderOptions
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.scene.scene import WeatherScene
from weather_aug.transforms.dataset import WeatherDataset
from weather_aug.transforms.sampling import Choice
from weather_aug.weather import Weather

POLICY = WeatherPolicy({"rain": 1, "snow": 1, "fog": 1}, severity=(0.5, 1.0), falling=1.0)
PLANES = ("image", "invalid", "transmittance", "depth", "label", "label_full")
CROP = (32, 40)
forks = pytest.mark.filterwarnings(
    # Loaders fork by default on Linux; Python 3.12 warns of it wherever torch has threads.
    "ignore:This process .* is multi-threaded, use of fork:DeprecationWarning"
)
TIMEOUT_S = 120


@pytest.fixture
def dataset(tiny_scene: WeatherScene) -> WeatherDataset:
    return WeatherDataset([tiny_scene], POLICY, seed=4)


def digest_of(item: dict[str, Any]) -> str:
    """One hash over every plane and the recipe."""
    digest = hashlib.sha256()
    for name in sorted(item):
        value = item[name]
        digest.update(name.encode())
        digest.update(value.encode() if isinstance(value, str) else value.numpy().tobytes())
    return digest.hexdigest()


def digests(loader: DataLoader[Any]) -> list[str]:
    """Of the items in the order in which the loader gives them."""
    found = []
    for batch in loader:
        for place, recipe in enumerate(batch["recipe"]):
            item = {name: value[place] for name, value in batch.items() if name != "recipe"}
            found.append(digest_of(item | {"recipe": recipe}))
    return found


def ran_in(item: dict[str, Any]) -> dict[str, Any]:
    """A transform that notes its process."""
    return {"recipe": item["recipe"], "process": multiprocessing.current_process().name}


def loader_of(dataset: WeatherDataset, workers: int, method: str | None) -> DataLoader[Any]:
    return DataLoader(
        dataset,
        batch_size=3,
        num_workers=workers,
        multiprocessing_context=method,
        persistent_workers=workers > 0,
        timeout=TIMEOUT_S if workers else 0,
    )


@pytest.fixture(scope="module")
def two_epochs(tiny_scene: WeatherScene) -> list[list[str]]:
    """Digests of all items of two epochs, drawn in this process without a loader."""
    dataset = WeatherDataset([tiny_scene], POLICY, seed=4, crop=CROP)
    epochs = []
    for epoch in (0, 1):
        dataset.set_epoch(epoch)
        epochs.append([digest_of(dataset[index]) for index in range(len(dataset))])
    return epochs


@forks
@pytest.mark.parametrize(("workers", "method"), [(0, None), (1, "fork"), (2, "fork"), (2, "spawn")])
def test_items_do_not_depend_on_workers(
    tiny_scene: WeatherScene, two_epochs: list[list[str]], workers: int, method: str | None
) -> None:
    """Persistent workers hear of the new epoch, and every item comes in its place."""
    dataset = WeatherDataset([tiny_scene], POLICY, seed=4, crop=CROP)
    loader = loader_of(dataset, workers, method)
    assert [len(set(epoch)) for epoch in two_epochs] == [8, 8]
    assert not set(two_epochs[0]) & set(two_epochs[1])
    for epoch, expected in enumerate(two_epochs):
        dataset.set_epoch(epoch)
        assert digests(loader) == expected


@forks
def test_the_workers_did_the_work(tiny_scene: WeatherScene) -> None:
    """The comparison above would hold as well if no worker had drawn anything."""
    dataset = WeatherDataset([tiny_scene], POLICY, transform=ran_in)
    loader = loader_of(dataset, 2, "fork")
    processes = {name for batch in loader for name in batch["process"]}
    assert len(processes) == 2
    assert "MainProcess" not in processes


@forks
def test_a_private_epoch_would_be_seen(
    tiny_scene: WeatherScene, two_epochs: list[list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without shared memory persistent workers stay in the epoch in which they were started."""
    monkeypatch.setattr(torch.Tensor, "share_memory_", lambda self: self)
    dataset = WeatherDataset([tiny_scene], POLICY, seed=4, crop=CROP)
    loader = loader_of(dataset, 1, "fork")
    assert digests(loader) == two_epochs[0]
    dataset.set_epoch(1)
    assert digests(loader) == two_epochs[0] != two_epochs[1]


def test_items_do_not_depend_on_order_or_batches(dataset: WeatherDataset) -> None:
    expected = {digest_of(dataset[index]) for index in range(len(dataset))}
    for batch_size in (1, 5):
        generator = torch.Generator().manual_seed(3)
        loader = DataLoader(dataset, batch_size, shuffle=True, generator=generator)
        drawn = digests(loader)
        assert set(drawn) == expected
        assert len(drawn) == len(expected) == 8
    assert digest_of(dataset[-1]) == digest_of(dataset[7])


def test_seeds_epochs_and_items_differ(tiny_scene: WeatherScene) -> None:
    drawn = set()
    for seed in (0, 1, -1, 2**64 - 1):
        dataset = WeatherDataset([tiny_scene], POLICY, seed=seed)
        for epoch in (0, 1, 2**63 - 1):
            dataset.set_epoch(epoch)
            assert dataset.epoch == epoch
            drawn |= {dataset[index]["recipe"] for index in range(len(dataset))}
    assert len(drawn) == 4 * 3 * 8


def test_an_item_is_what_the_page_says(dataset: WeatherDataset) -> None:
    item = dataset[2]
    expected = {
        "image": (torch.uint8, (3, 48, 64)),
        "label": (torch.int64, (48, 64)),
        "label_full": (torch.int64, (48, 64)),
        "invalid": (torch.uint8, (48, 64)),
        "transmittance": (torch.float32, (48, 64)),
        "depth": (torch.float32, (48, 64)),
    }
    assert set(item) == {*expected, "recipe"}
    for name, (dtype, shape) in expected.items():
        assert (item[name].dtype, tuple(item[name].shape)) == (dtype, shape), name
        assert item[name].is_contiguous(), name


def test_the_default_collate_makes_a_batch(dataset: WeatherDataset) -> None:
    batch = next(iter(DataLoader(dataset, batch_size=8)))
    assert batch["image"].shape == (8, 3, 48, 64)
    assert batch["label"].shape == (8, 48, 64)
    assert len(batch["recipe"]) == 8


@pytest.mark.parametrize("crop", [None, CROP])
@pytest.mark.parametrize("options", [RenderOptions(), RenderOptions(max_particles=50)])
def test_a_recipe_renders_the_item_again(
    tiny_scene: WeatherScene, crop: tuple[int, int] | None, options: RenderOptions
) -> None:
    dataset = WeatherDataset([tiny_scene], POLICY, seed=8, crop=crop, options=options)
    for index in range(len(dataset)):
        item = dataset[index]
        recipe = json.loads(item["recipe"])
        scene = WeatherScene.load(tiny_scene.path)
        assert (recipe["scene"], recipe["scene_digest"]) == (scene.name, scene.digest)
        shot = scene.render(
            FrameKey(recipe["time_index"], recipe["camera"]),
            Weather.from_dict(recipe["weather"]),
            seed=recipe["seed"],
            window=recipe["window"],
            options=RenderOptions(**recipe["options"]),
        )
        assert np.array_equal(item["image"].numpy(), shot.image.transpose(2, 0, 1))
        for name in PLANES[1:]:
            assert np.array_equal(item[name].numpy(), getattr(shot, name)), name


def test_crops_lie_anywhere_and_cover_the_picture(tiny_scene: WeatherScene) -> None:
    dataset = WeatherDataset([tiny_scene], POLICY, crop=(46, 60))
    corners = set()
    for epoch in range(60):
        for index in range(8):
            key = tiny_scene.keys[index]
            opened = dataset._locate(index)[0].open(key)
            window = dataset._window(opened, Choice(index), epoch, index)
            assert window is not None
            corners.add(window[:2])
    assert corners == {(top, left) for top in range(3) for left in range(5)}
    assert dataset[0]["image"].shape == (3, 46, 60)


def test_a_crop_of_the_whole_is_the_whole(tiny_scene: WeatherScene) -> None:
    whole, crop = WeatherDataset([tiny_scene]), WeatherDataset([tiny_scene], crop=(48, 64))
    assert torch.equal(whole[3]["image"], crop[3]["image"])


def test_a_transform_gets_arrays_and_gives_the_item(tiny_scene: WeatherScene) -> None:
    seen = {}

    def keep(sample: dict[str, Any]) -> tuple[str, Any]:
        seen.update(sample)
        return "item", sample["image"]

    dataset = WeatherDataset([tiny_scene], POLICY, transform=keep)
    name, image = dataset[1]
    assert name == "item"
    assert image is seen["image"]
    assert (image.dtype, image.shape) == (np.uint8, (48, 64, 3))
    assert (seen["label"].dtype, seen["label"].shape) == (np.uint8, (48, 64))
    assert set(seen) == {*PLANES, "recipe"}
    image[:] = 0
    assert dataset[1][1].any()


def test_scenes_follow_one_another(tiny_scene: WeatherScene, tmp_path: Path) -> None:
    other = WeatherScene.build(TinyClip(name="other", frames=2), tmp_path / "other")
    dataset = WeatherDataset([other, tiny_scene], POLICY)
    recipes = [json.loads(dataset[index]["recipe"]) for index in range(len(dataset))]
    assert [recipe["scene"] for recipe in recipes] == ["other"] * 4 + ["tiny"] * 8
    keys = [(recipe["time_index"], recipe["camera"]) for recipe in recipes]
    assert keys == [*other.keys, *tiny_scene.keys]


def test_scenes_without_labels_give_items_without(unlabelled_scene: WeatherScene) -> None:
    item = WeatherDataset([unlabelled_scene], POLICY)[1]
    assert set(item) == {*PLANES, "recipe"} - {"label", "label_full"}


@pytest.mark.parametrize("first", [0, 1])
def test_labelled_and_unlabelled_scenes_do_not_mix(
    tiny_scene: WeatherScene, unlabelled_scene: WeatherScene, first: int
) -> None:
    """Their items would not collate, and only once the two met in a batch."""
    scenes = [tiny_scene, unlabelled_scene]
    with pytest.raises(ArgumentError, match="of scene unlabelled has no label"):
        WeatherDataset([scenes[first], scenes[1 - first]])


def test_a_pickled_dataset_is_small_and_draws_the_same(dataset: WeatherDataset) -> None:
    expected = digest_of(dataset[3])
    data = pickle.dumps(dataset)
    assert len(data) <= 64 * 1024
    assert digest_of(pickle.loads(data)[3]) == expected


def test_global_generators_are_neither_read_nor_moved(dataset: WeatherDataset) -> None:
    def states() -> tuple[Any, ...]:
        numpy_state = np.random.get_state()[1].tolist()  # noqa: NPY002 - what is tested
        return random.getstate(), numpy_state, torch.get_rng_state().tolist()

    before = states()
    item = digest_of(dataset[0])
    assert states() == before
    random.seed(9)
    np.random.seed(9)  # noqa: NPY002
    torch.manual_seed(9)
    assert digest_of(dataset[0]) == item


@pytest.mark.parametrize("index", [8, -9, 10**30])
def test_an_index_outside_ends_a_loop(dataset: WeatherDataset, index: int) -> None:
    with pytest.raises(IndexError, match="dataset of 8"):
        dataset[index]


@pytest.mark.parametrize("index", [1.0, "1", None, slice(2)])
def test_an_index_that_is_no_integer_is_a_type_error(dataset: WeatherDataset, index: Any) -> None:
    with pytest.raises(TypeError):
        dataset[index]


def test_an_index_of_torch_or_numpy_will_do(dataset: WeatherDataset) -> None:
    for index in (torch.tensor(2), np.int64(2)):
        assert dataset[index]["recipe"] == dataset[2]["recipe"]  # type: ignore[index]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"scenes": []}, "scenes must be"),
        ({"scenes": "scenes/0000"}, "scenes must be"),
        ({"scenes": [Path("scene")]}, "scenes must be"),
        ({"seed": 1.5}, "seed"),
        ({"seed": 2**64}, "seed"),
        ({"crop": (49, 64)}, "crop .* does not fit frame 000000_front"),
        ({"crop": (0, 10)}, "crop"),
        ({"crop": (10,)}, "crop"),
        ({"crop": (10.0, 10.0)}, "crop"),
        ({"crop": 256}, r"crop must be \(height, width\) in pixels, got 256"),
        ({"crop": {1, 2}}, "crop must be"),
        ({"policy": {"rain": 1}}, r"WeatherPolicy\(types=\{.*\}\)"),
        ({"policy": {}}, "policy must be a WeatherPolicy, got dict"),
        ({"policy": "rain"}, "policy must be a WeatherPolicy, got str"),
    ],
    ids=str,
)
def test_bad_arguments_are_refused(
    tiny_scene: WeatherScene, arguments: dict[str, Any], says: str
) -> None:
    with pytest.raises(ArgumentError, match=says):
        WeatherDataset(**({"scenes": [tiny_scene]} | arguments))


@pytest.mark.parametrize("epoch", [-1, 2**63, 1.0, "1", None])
def test_an_epoch_that_is_none_is_refused(dataset: WeatherDataset, epoch: Any) -> None:
    with pytest.raises(ArgumentError, match="epoch"):
        dataset.set_epoch(epoch)
    assert dataset.epoch == 0


def test_a_smaller_frame_in_any_scene_refuses_the_crop(
    tiny_scene: WeatherScene, tmp_path: Path
) -> None:
    small = WeatherScene.build(TinyClip(name="small", width=40), tmp_path / "small")
    with pytest.raises(ArgumentError, match="scene small"):
        WeatherDataset([tiny_scene, small], crop=(48, 64))
