"""The recipe's configs and our rules against clones of HRDA and MIC, where there are any.

    WEATHER_AUG_HRDA=… WEATHER_AUG_HRDA_DG=… WEATHER_AUG_MIC=… WEATHER_AUG_MMCV_PYTHON=…

are clones (HRDA on `master` and on `dg`) and an interpreter of their environment (torch, mmcv
1.3.7). Their configs, data sets and pipelines run, their networks do not. No clone is written to.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import subprocess
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from tiny_export import POLICY, TinyClip
from trainer_checkout import config_of, run
from trainers import (
    CROP_TRIES,
    DEFAULT_SIZES,
    Pictures,
    RareClasses,
    Sample,
    scan,
    varied,
    window_at,
)

from weather_aug.clip.types import Frame, FrameKey
from weather_aug.scene.scene import WeatherScene
from weather_aug.taxonomy import TRAIN_ID
from weather_aug.writers.export import export
from weather_aug.writers.merge import merge_cityscapes
from weather_aug.writers.plan import plan_export

DRAWS = 40
NEEDED = {"hrda": "WEATHER_AUG_HRDA", "hrda-dg": "WEATHER_AUG_HRDA_DG", "mic": "WEATHER_AUG_MIC"}
SOURCES = ("cityscapes", "gta", "merge")
CASES = [
    *((name, "source", data) for name in ("hrda", "mic") for data in SOURCES),
    *((name, "target", data) for name in ("hrda", "mic") for data in ("acdc", "cityscapes")),
    *(("hrda-dg", "source-only", data) for data in SOURCES),
]

pytestmark = pytest.mark.slow


def given(variable: str) -> Path:
    """A path of the environment; the test is skipped where there is none."""
    if variable not in os.environ:
        pytest.skip(f"{variable} is not set")
    return Path(os.environ[variable])


def seg(checkout: Path, name: str) -> Path:
    """Where a checkout's training is started."""
    return checkout / "seg" if name == "mic" else checkout


class RareClip(TinyClip):
    """A truck and a bus that many crops miss, and a right half that is road beyond three quarters.

    Crops are drawn again for either reason. Its width is resized to a broken number of pixels.
    """

    def frame(self, key: FrameKey) -> Frame:
        frame = super().frame(key)
        assert frame.label is not None
        label = frame.label.copy()
        label[:, 194:] = TRAIN_ID["road"]
        label[96:160, :64] = TRAIN_ID["truck"]
        label[96:160, 200:264] = TRAIN_ID["bus"]
        return dataclasses.replace(frame, label=label)


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """An export of a layout, or a merge, made once."""
    folder = tmp_path_factory.mktemp("exported")
    clip = RareClip(frames=2, width=388, height=200)
    scene = WeatherScene.build(clip, folder / "scene")

    @cache
    def export_of(data: str) -> Path:
        if data == "merge":
            merge_cityscapes(export_of("root"), [export_of("cityscapes")], folder / "merge")
            return folder / "merge"
        layout = "cityscapes" if data == "root" else data
        seed = 1 if data == "root" else 3
        export(plan_export([scene], POLICY, count=6, seed=seed, layout=layout), folder / data)
        return folder / data

    return export_of


class Drawn(NamedTuple):
    """What the checkout's own code drew."""

    config: Path
    found: dict[str, Any]
    labels: NDArray[np.uint8]
    images: NDArray[np.uint8]


def called(checkout: Path, config: Path, folder: Path, draws: int) -> subprocess.CompletedProcess:
    """The checkout's code, run in a folder with `data`."""
    root = seg(checkout, checkout.name)
    path = os.pathsep.join([str(root), *filter(None, [os.environ.get("PYTHONPATH")])])
    helper = Path(__file__).with_name("real_checkout.py")
    return subprocess.run(
        [given("WEATHER_AUG_MMCV_PYTHON"), "-W", "ignore", helper, config, str(draws), "out"],
        env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": path},
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )


def linked(name: str, folder: Path) -> Path:
    """A folder that stands for a clone: its files by links, its configs as a copy."""
    source, made = seg(given(NEEDED[name]), name), seg(folder / name, name)
    made.mkdir(parents=True)
    shutil.copytree(source / "configs", made / "configs")
    for part in ("mmseg", "run_experiments.py"):
        (made / part).symlink_to((source / part).resolve())
    return folder / name


@pytest.fixture(scope="module")
def drawn(
    exported: Callable[[str], Path], tmp_path_factory: pytest.TempPathFactory
) -> Callable[..., Drawn]:
    """A case, drawn once."""

    @cache
    def draw(name: str, role: str, data: str) -> Drawn:
        given("WEATHER_AUG_MMCV_PYTHON")
        folder = tmp_path_factory.mktemp("case")
        checkout = linked(name, folder)
        out = seg(checkout, name) / "configs" / "wa" / "made.py"
        done = run(role, exported(data), checkout, out)
        assert done.returncode == 0, done.stderr
        (folder / "data").mkdir()
        (folder / "data" / "acdc").symlink_to(exported("acdc"))
        (folder / "data" / "cityscapes").symlink_to(exported("root"))
        ran = called(checkout, out, folder, DRAWS)
        assert ran.returncode == 0, ran.stderr[-3000:]
        found = json.loads((folder / "out.json").read_text())
        with np.load(folder / "out.npz") as arrays:
            # A config's relative data folders are meant from here.
            for entry in sides(found["config"]["data"]["train"]).values():
                entry["data_root"] = str(folder / entry["data_root"])
            return Drawn(out, found, arrays["labels"], arrays["images"])

    return draw


def sides(train: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Source, and target if there is one, of a config's `data.train`."""
    train = train.get("dataset", train)
    return {side: train[side] for side in ("source", "target") if side in train}


def ours(drawn: Drawn) -> RareClasses:
    train = drawn.found["config"]["data"]["train"]
    entry = sides(train)["source"]
    sampling = train.get("dataset", train)["rare_class_sampling"]
    return RareClasses.of(Path(entry["data_root"]), Pictures.of(entry), **sampling)


@pytest.mark.parametrize("case", CASES, ids="-".join)
def test_their_code_lists_what_our_rules_list(drawn: Callable[..., Drawn], case: Any) -> None:
    one = drawn(*case)
    found, train = one.found, one.found["config"]["data"]["train"]
    for side, entry in sides(train).items():
        pictures = Pictures.of(entry, labelled=side == "source")
        assert found[side]["type"] == entry["type"]
        assert [list(pair) for pair in pictures.paths] == found[side]["files"]
    rare = ours(one)
    assert list(rare.classes) == found["classes"]
    assert {TRAIN_ID["truck"], TRAIN_ID["bus"]} < set(rare.classes)
    assert rare.probabilities == pytest.approx(found["probabilities"], rel=1e-3, abs=1e-30)
    assert {str(c): list(files) for c, files in rare.files.items()} == found["files"]
    assert dict(rare.index_by_file) == found["index_by_file"]


@pytest.mark.parametrize("case", CASES, ids="-".join)
def test_their_code_draws_as_our_rules_say(drawn: Callable[..., Drawn], case: Any) -> None:
    one = drawn(*case)
    rare = ours(one)
    assert rare.source.sizes == DEFAULT_SIZES
    resized = cache(rare.source.resized)
    least = rare.min_pixels * rare.min_crop_ratio
    again, recut = 0, 0
    for number, draw in enumerate(one.found["draws"]):
        assert draw["file"] in rare.files[draw["train_id"]]
        index = rare.index_by_file[draw["file"]]
        *missed, last = draw["loads"]
        assert {load["index"] for load in draw["loads"]} == {index}
        assert len(missed) <= CROP_TRIES
        shown = str(draw["train_id"])
        assert all(load["pixels"].get(shown, 0) <= least for load in missed)
        assert last["pixels"].get(shown, 0) > least or len(missed) == CROP_TRIES
        for load in draw["loads"]:
            check_corners(load["corners"], resized(index))
        window = window_at(*last["corners"][-1], DEFAULT_SIZES.crop)
        image, label = rare.source.cut(resized(index), window, last["flip"])
        assert label is not None
        assert np.array_equal(label[::4, ::4], one.labels[number])
        # Another OpenCV may round a resized value the other way.
        assert np.abs(image[::16, ::16].astype(int) - one.images[number]).max() <= 1
        again += bool(missed)
        recut += any(len(load["corners"]) > 1 for load in draw["loads"])
        assert draw["target"] == (None if case[1] == "source-only" else [3, 1024, 1024])
    assert min(again, recut) > 5, "crops were hardly drawn again"
    assert len({draw["train_id"] for draw in one.found["draws"]}) > 1


def check_corners(corners: list[list[int]], resized: Sample) -> None:
    """Of one class too much is drawn again, ten times."""
    assert resized.label is not None
    windows = [window_at(top, left, DEFAULT_SIZES.crop) for top, left in corners]
    enough = [varied(resized.label[window], DEFAULT_SIZES.cat_max_ratio) for window in windows]
    assert not any(enough[:-1])
    assert enough[-1] or len(windows) == CROP_TRIES + 1


@pytest.mark.parametrize("case", CASES, ids="-".join)
def test_their_config_reader_merges_as_the_tests_do(drawn: Callable[..., Drawn], case: Any) -> None:
    one = drawn(*case)
    merged = json.loads(json.dumps(config_of(one.config)))
    config = json.loads(json.dumps(one.found["config"]))
    for train in (merged["data"]["train"], config["data"]["train"]):
        for entry in sides(train).values():
            entry["data_root"] = Path(entry["data_root"]).name
    assert merged == config
    assert one.found["pretty"] > 0
    if case[1] == "source-only":
        assert one.found["epoch"] >= 80_000


@pytest.mark.parametrize("planted", ["hidden", "dangling"])
def test_what_is_no_plain_file_ends_their_scan(
    exported: Callable[[str], Path], tmp_path: Path, planted: str
) -> None:
    given("WEATHER_AUG_MMCV_PYTHON")
    checkout = linked("mic", tmp_path)
    data = shutil.copytree(exported("cityscapes"), tmp_path / "copy")
    out = checkout / "seg/configs/wa/made.py"
    assert run("source", data, checkout, out).returncode == 0
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "acdc").symlink_to(exported("acdc"))
    images = data / "leftImg8bit" / "train"
    if planted == "hidden":
        (images / ".notes").write_text("")
    else:
        (images / "gone_leftImg8bit.png").symlink_to(tmp_path / "nowhere")
    error = NotADirectoryError if planted == "hidden" else FileNotFoundError
    ran = called(checkout, out, tmp_path, 1)
    assert ran.returncode == 1
    assert error.__name__ in ran.stderr
    with pytest.raises(error):
        list(scan(images, "_leftImg8bit.png"))
