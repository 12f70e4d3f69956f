"""Configs for HRDA and MIC: merged by mmcv's rules, and loaded by the trainers' rules.

The checkouts are stand-ins, see `trainer_checkout`; for clones see `writers/test_real_checkout.py`.
"""

from __future__ import annotations

import ast
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from writers.tiny_export import POLICY, TinyClip
from writers.trainer_checkout import DATASET, PLACES, RECIPE, checkout_in, config_of, run
from writers.trainers import Pictures, RareClasses, Sizes

from weather_aug import _files
from weather_aug.scene.scene import WeatherScene
from weather_aug.writers.export import export
from weather_aug.writers.layout import LAYOUTS, read_contents, sealed_contents
from weather_aug.writers.merge import merge_cityscapes
from weather_aug.writers.plan import plan_export

SIZES = Sizes(scale=(256, 192), crop=160)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """An export, made once for each choice; not to be harmed."""
    made: dict[tuple[str, bool], Path] = {}

    def export_of(layout: str = "cityscapes", *, labelled: bool = True) -> Path:
        if (layout, labelled) not in made:
            folder = tmp_path_factory.mktemp(layout)
            clip = TinyClip(frames=2, width=128, height=96, labelled=labelled)
            scene = WeatherScene.build(clip, folder / "tiny")
            plan = plan_export([scene], POLICY, count=4, seed=3, layout=layout)
            made[layout, labelled] = folder / "out"
            export(plan, folder / "out")
        return made[layout, labelled]

    return export_of


@pytest.fixture
def data(finished: Callable[..., Path], tmp_path: Path) -> Path:
    """A copy of a labelled export, to harm."""
    return shutil.copytree(finished(), tmp_path / "data")


def refused(done: subprocess.CompletedProcess[str]) -> str:
    """The one sentence of a run that wrote nothing."""
    assert done.returncode == 2, done.stdout + done.stderr
    assert done.stdout == ""
    lines = done.stderr.splitlines()
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("error: ")
    assert ";" in lines[0], "no cure"
    return lines[0]


def as_started(checkout: Path, done: subprocess.CompletedProcess[str]) -> dict[str, Any]:
    """The config that a trainer sees when the printed command is run: a child of the one written.

    run_experiments.py writes it to configs/generated/<name>/ (HRDA as JSON, MIC as Python) with
    `_base_` made from the given path by replacing "configs" with "../..".
    """
    root, given = (line.split()[-1] for line in done.stdout.splitlines()[-2:])
    assert Path(root) == (checkout / "seg" if checkout.name == "mic" else checkout)
    child = Path(root) / "configs/generated/local-weather_aug/child.json"
    child.parent.mkdir(parents=True)
    child.write_text(json.dumps({"_base_": given.replace("configs", "../..")}))
    return config_of(child)


@pytest.mark.parametrize("name", ["hrda", "mic"])
@pytest.mark.parametrize("layout", [n for n in ("cityscapes", "gta") if n in LAYOUTS])
def test_a_labelled_source_is_drawn_by_rare_class_sampling(
    finished: Callable[..., Path], tmp_path: Path, name: str, layout: str
) -> None:
    root, checkout = finished(layout), checkout_in(tmp_path, name)
    done = run("source", root, checkout)
    assert done.returncode == 0, done.stderr
    train = as_started(checkout, done)["data"]["train"]
    assert train["target"]["data_root"] == "data/acdc/"
    source = Pictures.of(train["source"], sizes=SIZES)
    assert len(source) == 4
    assert Path(train["source"]["data_root"]) == root
    sampling = train["rare_class_sampling"]
    rare = RareClasses.of(Path(train["source"]["data_root"]), source, **sampling)
    rng = np.random.default_rng(0)
    assert {rare.draw(rng).index for _ in range(60)} == {0, 1, 2, 3}


@pytest.mark.parametrize("name", ["hrda", "mic"])
@pytest.mark.parametrize("layout", [n for n in ("cityscapes", "acdc") if n in LAYOUTS])
def test_an_unlabelled_target_is_loaded_without_labels(
    finished: Callable[..., Path], tmp_path: Path, name: str, layout: str
) -> None:
    root, checkout = finished(layout, labelled=False), checkout_in(tmp_path, name)
    done = run("target", root, checkout)
    assert done.returncode == 0, done.stderr
    assert "data/cityscapes/samples_with_class.json is not in the checkout" in done.stdout
    train = as_started(checkout, done)["data"]["train"]
    assert train["source"]["data_root"] == "data/cityscapes/"
    assert "crop_pseudo_margins" not in train["target"]
    target = Pictures.of(train["target"], labelled=False, sizes=SIZES)
    rng = np.random.default_rng(0)
    assert [target.load(i, rng).image.shape for i in range(4)] == [(160, 160, 3)] * 4


def test_without_a_target_the_branch_dg_trains_on_the_export_alone(
    finished: Callable[..., Path], tmp_path: Path
) -> None:
    checkout = checkout_in(tmp_path, "hrda-dg")
    config = as_started(checkout, run("source-only", finished(), checkout))
    train = config["data"]["train"]
    alone = train.pop("dataset")
    assert train == {"type": "RepeatDataset", "times": 20_000}, "4 samples, 80,000 are drawn"
    assert alone["type"] == "DGDataset"
    assert alone["rare_class_sampling"]["min_pixels"] == 3000
    assert alone["source"]["pipeline"][2] == {"type": "Resize", "img_scale": (2048, 1024)}
    assert config["uda"]["source_only"] is True
    assert len(Pictures.of(alone["source"])) == 4
    for other, cure in (("hrda", "checkout dg"), ("mic", "use HRDA, branch dg")):
        line = refused(run("source-only", finished(), checkout_in(tmp_path, other)))
        assert cure in line


def test_exports_merged_with_cityscapes_are_one_source(
    finished: Callable[..., Path], tmp_path: Path
) -> None:
    """The root of Cityscapes is another export here: it has the same files."""
    checkout, root, merge = checkout_in(tmp_path, "mic"), tmp_path / "root", tmp_path / "merge"
    scene = WeatherScene.build(TinyClip("root", 2, 128, 96, tint=9), tmp_path / "scene")
    export(plan_export([scene], POLICY, count=3, seed=1), root)
    merge_cityscapes(root, [finished()], merge)
    done = run("source", merge, checkout)
    assert done.returncode == 0, done.stderr
    train = as_started(checkout, done)["data"]["train"]
    source = Pictures.of(train["source"], sizes=SIZES)
    rare = RareClasses.of(merge, source, **train["rare_class_sampling"])
    rng = np.random.default_rng(0)
    assert {rare.draw(rng).index for _ in range(90)} == set(range(7))
    assert "is a source; give an export" in refused(run("target", merge, checkout))
    next((merge / "gtFine").rglob("*.png")).unlink()
    assert "cannot be read" in refused(run("source", merge, checkout))
    (merge / "samples_with_class.json").unlink()
    assert "run the same merge again" in refused(run("source", merge, checkout))


def test_all_else_stays_as_the_authors_have_it(
    finished: Callable[..., Path], tmp_path: Path
) -> None:
    checkout = checkout_in(tmp_path, "mic")
    done = run("source", finished(), checkout)
    config = as_started(checkout, done)
    assert config["data"]["val"]["data_root"] == "data/acdc/"
    assert config["data"]["samples_per_gpu"] == 2, "mask_mode separate asserts it"
    assert config["data"]["train"]["source"]["pipeline"] == ["cut"]
    assert config["uda"] == {
        **{"type": "DACS", "alpha": 0.999, "mask_mode": "separate", "mask_alpha": "same"},
        **{"mask_pseudo_threshold": "same", "mask_lambda": 1},
        "mask_generator": {"type": "block", "mask_ratio": 0.7, "mask_block_size": 64},
    }
    assert config["model"]["decode_head"]["num_classes"] == 19
    assert config["model"]["pretrained"] == "pretrained/mit_b5.pth"
    assert config["optimizer"]["weight_decay"] == 0.01
    assert config["optimizer_config"] is None
    assert isinstance(config["name"], str)
    assert isinstance(config["exp"], str)


def test_what_was_not_checked_is_said(finished: Callable[..., Path], tmp_path: Path) -> None:
    said = run("source", finished(), checkout_in(tmp_path, "hrda")).stdout
    assert "4 pictures of 128x96 are resized to 1365x1024; enlarged 10.7 times" in said
    assert "4 samples make 6400 pairs with 1600 pictures; after 3200 iterations" in said
    assert "export 50 or more" in said
    assert "train ids 13 occur, but never with more than 3000 pixels" in said
    assert "not checked here, because nothing of the checkout was run:" in said
    assert "pretrained/mit_b5.pth is not in the checkout" in said
    # The tiny scene's backgrounds are the physical editor's, and the export says so.
    assert "does not record what trained the editor" not in said


def test_the_editors_of_backgrounds_are_named(data: Path, tmp_path: Path) -> None:
    card = {"single": {"rain": {"training": {"pair_list": "acdc", "steps": 9}}}}
    editors = [{"editor": "single", "card": card}, {"editor": "instruct-pix2pix", "card": {}}]
    resealed(editors=editors)(data)
    said = run("source", data, checkout_in(tmp_path, "hrda")).stdout
    assert "the editor single made backgrounds, trained on acdc: do not evaluate" in said
    assert "instruct-pix2pix made backgrounds, and its card names no pictures" in said


def unfinished(data: Path) -> None:
    (data / "export.json").unlink()
    (data / ".export").mkdir()


def changed(data: Path) -> None:
    text = (data / "export.json").read_text()
    (data / "export.json").write_text(text.replace('"samples": 4', '"samples": 5'))


def resealed(**fields: Any) -> Callable[[Path], None]:
    def harm(data: Path) -> None:
        (data / "export.json").write_bytes(sealed_contents(read_contents(data) | fields))

    return harm


def first(data: Path, kind: str) -> Path:
    return next((data / kind).rglob("*.png"))


def label_in_colour(data: Path) -> None:
    """Of the size that was recorded, so that only its header tells."""
    path = first(data, "gtFine")
    size = path.stat().st_size
    Image.new("RGB", (128, 96)).save(path, optimize=True)
    with path.open("ab") as file:
        file.truncate(size)


def a_picture_more(data: Path) -> None:
    path = first(data, "leftImg8bit")
    shutil.copy(path, path.with_name("mine_leftImg8bit.png"))


def hidden(data: Path) -> None:
    (data / "leftImg8bit" / "train" / ".DS_Store").write_text("")


def dangling(data: Path) -> None:
    (data / "leftImg8bit" / "train" / "more").symlink_to("nowhere")


def cut_short(data: Path) -> None:
    with first(data, "leftImg8bit").open("ab") as file:
        file.truncate(100)


FAULTS: dict[str, tuple[Callable[[Path], None], str]] = {
    "not there": (shutil.rmtree, "is no export"),
    "unfinished": (unfinished, "run the same export again to continue"),
    "changed": (changed, "has changed since it was written"),
    "newer": (resealed(version=99), "take the recipe of the weather_aug that wrote it"),
    "layout": (resealed(job={"layout": "webdataset", "split": "train"}), "which no data set class"),
    "unlabelled": (resealed(labelled=1), "3 of 4 samples"),
    "label gone": (lambda data: first(data, "gtFine").unlink(), "cannot be read"),
    "label in colour": (label_in_colour, "is no label of one channel"),
    "cut short": (cut_short, "is not whole"),
    "a picture more": (a_picture_more, "holds 5 pictures, the export made 4"),
    "hidden": (hidden, "is a hidden file, at which the loaders stop"),
    "dangling": (dangling, "is a link that leads nowhere"),
    "no statistics": (lambda d: (d / "sample_class_stats.json").unlink(), "cannot be read"),
    "statistics": (lambda d: (d / "samples_with_class.json").write_text("{}"), "has changed"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_an_export_that_would_not_train_is_refused(data: Path, tmp_path: Path, fault: str) -> None:
    harm, said = FAULTS[fault]
    harm(data)
    checkout = checkout_in(tmp_path, "hrda")
    assert said in refused(run("source", data, checkout))
    assert not (checkout / "configs/weather_aug").exists()


def manifest_with(data: Path, change: Callable[[list[dict[str, Any]]], None]) -> None:
    """A manifest that its own `export.json` vouches for, as if an exporter were wrong."""
    entries = [json.loads(line) for line in (data / "manifest.jsonl").read_text().splitlines()]
    change(entries)
    (data / "manifest.jsonl").write_text("".join(json.dumps(entry) + "\n" for entry in entries))
    reseal_file(data, "manifest.jsonl")


def reseal_file(data: Path, name: str) -> None:
    contents = read_contents(data)
    path = data / name
    stored = {"size": path.stat().st_size, "sha256": _files.sha256_of_file(path)}
    contents["files"][name] = stored
    (data / "export.json").write_bytes(sealed_contents(contents))


def test_a_faulty_exporter_would_be_found(data: Path, tmp_path: Path) -> None:
    checkout = checkout_in(tmp_path, "hrda")

    def twice(entries: list[dict[str, Any]]) -> None:
        entries[1]["files"] = entries[0]["files"]

    def elsewhere(entries: list[dict[str, Any]]) -> None:
        entries[0]["files"]["label"], entries[1]["files"]["label"] = (
            entries[1]["files"]["label"],
            entries[0]["files"]["label"],
        )

    kept = shutil.copytree(data, tmp_path / "kept")
    manifest_with(data, twice)
    assert "have one base name" in refused(run("source", data, checkout))
    shutil.copytree(kept, data, dirs_exist_ok=True)
    manifest_with(data, elsewhere)
    assert "is not where CityscapesDataset looks" in refused(run("source", data, checkout))


def test_statistics_that_would_end_a_run_are_found(data: Path, tmp_path: Path) -> None:
    checkout = checkout_in(tmp_path, "hrda")
    stats, by_class = data / "sample_class_stats.json", data / "samples_with_class.json"
    rows, files = json.loads(stats.read_text()), json.loads(by_class.read_text())
    rows[0]["13"] = 32
    stats.write_text(json.dumps(rows))
    reseal_file(data, stats.name)
    assert "class 13 is in" in refused(run("source", data, checkout))
    files["13"] = [["gtFine/train/tiny/gone_gtFine_labelTrainIds.png", 3001]]
    by_class.write_text(json.dumps(files))
    reseal_file(data, by_class.name)
    assert "gone_gtFine_labelTrainIds.png, which is not there" in refused(
        run("source", data, checkout)
    )
    stats.write_text(json.dumps([{"file": row["file"]} for row in rows]))
    reseal_file(data, stats.name)
    assert "has nothing to draw" in refused(run("source", data, checkout))


def test_a_checkout_that_is_none_is_refused(finished: Callable[..., Path], tmp_path: Path) -> None:
    checkout = checkout_in(tmp_path, "hrda")
    assert "is no checkout" in refused(run("source", finished(), tmp_path / "nothing"))
    dataset = checkout / "configs/_base_" / DATASET
    dataset.write_text(PLACES.replace("ann_dir", "labels"))
    assert "has no data.train.source.ann_dir" in refused(run("source", finished(), checkout))
    dataset.unlink()
    assert "newest commit" in refused(run("source", finished(), checkout))


def test_a_clone_that_cannot_start_a_config_is_refused(
    finished: Callable[..., Path], tmp_path: Path
) -> None:
    checkout = checkout_in(tmp_path, "mic")
    (checkout / "seg/run_experiments.py").write_text("f.write(Config(child_cfg).pretty_text)\n")
    assert run("source", finished(), checkout).returncode == 0
    (checkout / "seg/run_experiments.py").write_text("f.write(child_cfg.pretty_text)\n")
    assert "older than the authors' fix" in refused(run("source", finished(), checkout))


@pytest.mark.parametrize(
    ("samples", "role", "said"),
    [
        (49, "source", "export 50 or more"),
        (50, "source", None),
        (60_000, "source", None),
        (100_000, "source", "the order of 100000 x 1600 pairs takes 6 GB"),
        (26, "target", "export 27 or more"),
        (1_000_000, "target", "pairs takes 119 GB"),
        (4, "source-only", None),
    ],
)
def test_an_epoch_that_is_too_short_or_too_large_is_noted(
    samples: int, role: str, said: str | None
) -> None:
    code = f"import settings; print(*settings.pair_notes({samples}, {role!r}), sep='\\n')"
    command = [sys.executable, "-B", "-c", code]
    done = subprocess.run(command, cwd=RECIPE, capture_output=True, text=True, check=True)
    assert (said in done.stdout) if said else not done.stdout.strip()


def test_a_config_that_could_not_be_started_is_refused(
    finished: Callable[..., Path], tmp_path: Path
) -> None:
    checkout = checkout_in(tmp_path, "hrda")
    for out in (
        tmp_path / "a.py",
        checkout / "configs/my_configs/a.py",
        checkout / "configs/a b.py",
    ):
        assert "run_experiments.py" in refused(run("source", finished(), checkout, out))
    assert run("source", finished(), checkout).returncode == 0
    assert run("source", finished(), checkout).returncode == 0, "the same config again"
    mine = checkout / "configs/weather_aug/made.py"
    mine.write_text("mine = 1\n")
    assert "holds something else" in refused(run("source", finished(), checkout))
    assert mine.read_text() == "mine = 1\n"


def test_it_runs_where_hrda_runs(finished: Callable[..., Path], tmp_path: Path) -> None:
    local = {path.stem for path in RECIPE.glob("*.py")}
    for path in RECIPE.glob("*.py"):
        tree = ast.parse(path.read_text(), feature_version=(3, 8))
        for node in ast.walk(tree):
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = [alias.name for alias in node.names]
                found = {node.module} if isinstance(node, ast.ImportFrom) else set(names)
                assert found <= sys.stdlib_module_names | local | {"collections.abc"}
    python = os.environ.get("PYTHON38") or shutil.which("python3.8")
    if python is None or subprocess.run([python, "-V"], check=False).returncode != 0:
        pytest.skip("no Python 3.8 (PYTHON38); its syntax and imports were checked")
    done = run("source", finished(), checkout_in(tmp_path, "mic"), python=python)
    assert done.returncode == 0, done.stderr
