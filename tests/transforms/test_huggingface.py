"""RandomWeather on data sets of Hugging Face: `with_transform`, `map`, and workers."""

from __future__ import annotations

import io
import multiprocessing
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from tiny_clip import TinyClip
from torch.utils.data import DataLoader

from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError, WeatherAugError
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.taxonomy import IGNORE
from weather_aug.transforms.huggingface import RandomWeather
from weather_aug.transforms.picture import Weathering

datasets = pytest.importorskip("datasets")

FOG = WeatherPolicy({"fog": 1}, severity=(1.0, 1.0))
MIXED = WeatherPolicy({"rain": 1, "snow": 1, "fog": 1}, severity=(0.6, 1.0))

Batch = dict[str, Any]


def street(rows: int = 4) -> Batch:
    """Columns as a batch holds them."""
    frames = [TinyClip().frame(key) for key in TinyClip().keys[:rows]]
    return {
        "image": [Image.fromarray(frame.image) for frame in frames],
        "label": [Image.fromarray(frame.label) for frame in frames],
        "id": [str(frame.key) for frame in frames],
    }


def dataset(rows: int = 4) -> Any:
    features = {
        "image": datasets.Image(),
        "label": datasets.Image(),
        "id": datasets.Value("string"),
    }
    return datasets.Dataset.from_dict(street(rows), datasets.Features(features))


def pixels(picture: Any) -> bytes:
    return np.asarray(picture).tobytes()


def test_a_row_of_a_dataset_is_the_renderers_picture() -> None:
    """The bytes are those of the shared contract on the row's arrays."""
    weather = RandomWeather(FOG, p=1, sample="id")
    row = dataset().with_transform(weather)[2]
    given_row = dataset()[2]
    image, mask = np.asarray(given_row["image"]), np.asarray(given_row["label"])
    weathering = Weathering.of(FOG)
    drawn = weathering.draw(weather._sample.draws.key(image, given_row["id"]))
    expected = weathering.render(image, drawn, mask=mask)
    assert (row["image"].mode, row["label"].mode, row["id"]) == ("RGB", "L", given_row["id"])
    assert (expected.image == np.asarray(row["image"])).all()
    assert (expected.mask == np.asarray(row["label"])).all()
    assert (expected.mask == IGNORE).any()


def test_a_batch_is_not_changed_and_other_columns_stay() -> None:
    batch = street()
    before = {name: [pixels(value) for value in batch[name]] for name in ("image", "label")}
    done = RandomWeather(FOG, p=1)(batch)
    assert done.keys() == batch.keys()
    assert done["id"] is batch["id"]
    assert {name: [pixels(value) for value in batch[name]] for name in before} == before
    assert [pixels(value) for value in done["image"]] != before["image"]


def test_map_gives_the_same_as_with_transform() -> None:
    weather = RandomWeather(MIXED, p=0.5, sample="id")
    rows = dataset()
    expected = rows.with_transform(weather)[:]
    for batched in (True, False):
        found = rows.map(weather, batched=batched, batch_size=3, load_from_cache_file=False)[:]
        for name in ("image", "label"):
            assert [pixels(v) for v in found[name]] == [pixels(v) for v in expected[name]]
        assert found["id"] == expected["id"]


def test_map_does_not_write_a_jpeg_twice() -> None:
    """Rows that get no weather, and columns that are none of ours, lose nothing."""
    file = io.BytesIO()
    noise = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
    Image.fromarray(noise).save(file, format="JPEG", quality=60)
    batch = {name: [{"bytes": file.getvalue(), "path": None}] for name in ("image", "other")}
    features = datasets.Features({name: datasets.Image() for name in batch})
    rows = datasets.Dataset.from_dict(batch, features)
    done = rows.map(RandomWeather(p=0, mask=None), batched=True, load_from_cache_file=False)
    assert pixels(done[0]["image"]) == pixels(rows[0]["image"])
    stored = done.cast_column("other", datasets.Image(decode=False))[0]["other"]
    assert stored["bytes"] == file.getvalue()


def test_arrays_stay_arrays() -> None:
    batch = street()
    frames = [np.asarray(image, np.float32) / np.float32(255) for image in batch["image"]]
    masks = [np.asarray(mask).astype(np.int64) for mask in batch["label"]]
    done = RandomWeather(FOG, p=1)({"image": frames, "label": masks})
    assert {image.dtype for image in done["image"]} == {np.dtype(np.float32)}
    assert {mask.dtype for mask in done["label"]} == {np.dtype(np.int64)}
    assert (done["label"][0] == IGNORE).any()


@pytest.mark.parametrize(("mode", "dtype"), [("L", np.uint8), ("I;16", np.uint16), ("I", np.int32)])
def test_masks_keep_their_mode(mode: str, dtype: type) -> None:
    ids = np.asarray(street()["label"][0]).astype(dtype)
    batch = {"image": street()["image"][:1], "label": [Image.fromarray(ids)]}
    ignore = 255 if dtype == np.uint8 else 999
    done = RandomWeather(FOG, p=1, ignore_index=ignore)(batch)["label"][0]
    assert batch["label"][0].mode == done.mode == mode
    assert (np.asarray(done) == ignore).any()


@settings(max_examples=20)
@given(colours=st.integers(11, 256))
def test_a_palette_survives_with_the_ignored_pixels_in_a_file(colours: int) -> None:
    """A PNG of few colours has few bits a pixel: 255 would be read as something else."""
    batch = street(1)
    palette = np.random.default_rng(colours).integers(0, 255, 3 * colours).tolist()
    batch["label"][0].putpalette(palette)
    assert batch["label"][0].mode == "P"
    done = RandomWeather(FOG, p=1)(batch)["label"][0]
    file = io.BytesIO()
    done.save(file, format="PNG")
    read = Image.open(file)
    assert read.mode == "P"
    assert pixels(read) == pixels(done)
    assert (np.asarray(read) == IGNORE).any()
    assert read.getpalette()[: len(palette)] == palette


def test_depth_may_be_a_column() -> None:
    """Dense fog hides nothing at 1 m; depth comes as an array or as a picture."""
    batch = street(2)
    near = np.ones((48, 64), np.float32)
    batch["depth"] = [near, Image.fromarray(near)]
    done = RandomWeather(FOG, p=1, depth="depth")(batch)
    assert [pixels(mask) for mask in done["label"]] == [pixels(mask) for mask in batch["label"]]


def test_a_column_may_name_frames_of_a_scene(tiny_scene: Any) -> None:
    rows = dataset(2)
    weather = RandomWeather(
        MIXED, p=1, scene_key="id", sample="id", scenes=[tiny_scene.path], seed=5
    )
    row = rows.with_transform(weather)[1]
    drawn = weather._sample.weathering.draw(
        weather._sample.draws.key(np.asarray(rows[1]["image"]), rows[1]["id"])
    )
    expected = tiny_scene.render(FrameKey(0, "right"), drawn.weather, seed=drawn.seed)
    assert (expected.image == np.asarray(row["image"])).all()
    assert (expected.label == np.asarray(row["label"])).all()


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"image": [Image.new("L", (64, 48))]}, "Image.mode='RGB'"),
        ({"image": [Image.new("RGBA", (64, 48))]}, "mode RGBA"),
        ({"image": [[[0, 0, 0]]]}, "got list"),
        ({"label": [Image.new("RGB", (64, 48))]}, "mode RGB, it must hold ids"),
        ({"label": [Image.new("1", (64, 48))]}, "mode 1"),
        ({"label": [Image.new("L", (48, 64))]}, "mask"),
        ({"label": [np.full((48, 64), 90, np.uint8)]}, "90"),
    ],
)
def test_what_is_no_picture_or_mask_is_named(changes: Batch, says: str) -> None:
    with pytest.raises(WeatherAugError, match=says):
        RandomWeather(FOG, p=1)(street(1) | changes)


def test_a_missing_column_names_those_there_are() -> None:
    with pytest.raises(ArgumentError, match="'annotation'; there are image, label, id"):
        RandomWeather(FOG, mask="annotation")(street())


def test_unnamed_draws_differ_and_named_ones_repeat() -> None:
    batch = {"image": street()["image"][:1] * 4, "label": street()["label"][:1] * 4}
    unnamed = RandomWeather(MIXED, p=1)(batch)
    assert len({pixels(image) for image in unnamed["image"]}) == 4
    named = RandomWeather(MIXED, p=1, sample="id")
    twice = named(batch | {"id": [7, 7, 8, "8"]})["image"]
    assert pixels(twice[0]) == pixels(twice[1])
    assert len({pixels(image) for image in twice}) == 3
    named.set_epoch(1)
    assert pixels(named(batch | {"id": [7, 7, 8, "8"]})["image"][0]) != pixels(twice[0])


def loaded(rows: Any, workers: int) -> list[bytes]:
    how = {"multiprocessing_context": multiprocessing.get_context("fork")} if workers else {}
    loader = DataLoader(rows, batch_size=2, num_workers=workers, collate_fn=list, **how)
    return [pixels(row["image"]) for batch in loader for row in batch]


def test_workers_agree_where_rows_have_names_and_differ_where_not() -> None:
    named = RandomWeather(MIXED, p=1, sample="id")
    rows = dataset().with_transform(named)
    assert loaded(rows, workers=2) == loaded(rows, workers=0)
    same = datasets.concatenate_datasets([dataset(1)] * 4)
    assert len({*loaded(same.with_transform(RandomWeather(MIXED, p=1)), workers=2)}) == 4


def test_it_pickles() -> None:
    weather = RandomWeather(MIXED, p=1, sample="id")
    again = pickle.loads(pickle.dumps(weather))
    batches = [each(street())["image"] for each in (weather, again)]
    assert [pixels(v) for v in batches[0]] == [pixels(v) for v in batches[1]]


DATA = Path(__file__).resolve().parents[2] / ".." / "shared" / "data" / "camvid-dev"


@pytest.mark.skipif(not DATA.is_dir(), reason="no shared CamVid data")
def test_a_folder_of_real_pictures() -> None:
    """Files as a data set holds them: the label of CamVid, with its own ids."""
    names = sorted(path.name for path in (DATA / "val").glob("*.png"))[:2]
    columns = {"image": "val", "annotation": "valannot"}
    rows = datasets.Dataset.from_dict(
        {column: [str(DATA / place / name) for name in names] for column, place in columns.items()},
        datasets.Features({column: datasets.Image() for column in columns}),
    )
    weather = RandomWeather(
        FOG, p=1, mask="annotation", taxonomy="camvid11", ignore_index=11, unknown_ids="ignore"
    )
    for before, after in zip(rows, rows.with_transform(weather), strict=True):
        ids, hidden = (np.asarray(row["annotation"]) for row in (before, after))
        assert ((hidden == ids) | (hidden == 11)).all()
        assert (hidden == 11).mean() > (ids == 11).mean()
