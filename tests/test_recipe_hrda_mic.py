"""Configs for HRDA and MIC: merged by mmcv's rules, and loaded by the trainers' rules.

The checkouts are stand-ins with the file names and keys of the real ones; none was run.
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
from writers.trainers import Pictures, RareClasses, Sizes

from weather_aug.scene.scene import WeatherScene
from weather_aug.writers.export import export
from weather_aug.writers.layout import LAYOUTS, read_contents, sealed_contents
from weather_aug.writers.plan import plan_export

RECIPE = Path(__file__).parents[1] / "recipes" / "hrda_mic"
SIZES = Sizes(scale=(256, 192), crop=160)

PLACES = """
data = dict(
    samples_per_gpu=2,
    workers_per_gpu=4,
    train=dict(
        type='UDADataset',
        source=dict(type='CityscapesDataset', data_root='data/cityscapes/',
                    img_dir='leftImg8bit/train', ann_dir='gtFine/train', pipeline=['cut']),
        target=dict(type='ACDCDataset', data_root='data/acdc/',
                    img_dir='rgb_anon/train', ann_dir='gt/train', pipeline=['cut'])),
    val=dict(type='ACDCDataset', data_root='data/acdc/', img_dir='rgb_anon/val', ann_dir='gt/val'))
"""
BASES = {
    "default_runtime.py": "log_level = 'INFO'\n",
    "models/daformer_sepaspp_mitb5.py": (
        "model = dict(type='EncoderDecoder', pretrained='pretrained/mit_b5.pth',\n"
        "             decode_head=dict(type='DAFormerHead', num_classes=19),\n"
        "             test_cfg=dict(mode='whole'))\n"
    ),
    "datasets/uda_cityscapesHR_to_acdcHR_1024x1024.py": PLACES,
    "uda/dacs_a999_fdthings.py": (
        "uda = dict(type='DACS', alpha=0.999, mask_generator=None)\nuse_ddp_wrapper = True\n"
    ),
    "uda/dacs_fdthings_srconly.py": "uda = dict(type='DACS', source_only=True)\n",
    "schedules/adamw.py": "optimizer = dict(type='AdamW', lr=6e-05, weight_decay=0.01)\n",
    "schedules/poly10warm.py": "lr_config = dict(policy='poly', warmup_iters=1500)\n",
}


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


def checkout_in(folder: Path, name: str) -> Path:
    """A stand-in for a clone: hrda, hrda-dg or mic."""
    root = folder / name / "seg" if name == "mic" else folder / name
    trainer = "mic" if name == "mic" else "hrda"
    example = "gtaHR2csHR_mic_hrda.py" if name == "mic" else "gtaHR2csHR_hrda.py"
    texts = {f"configs/_base_/{path}": text for path, text in BASES.items()}
    texts |= {f"configs/{trainer}/{example}": "", "run_experiments.py": ""}
    if name == "hrda-dg":
        texts["mmseg/datasets/dg_dataset.py"] = ""
    for path, text in texts.items():
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        (root / path).write_text(text)
    return folder / name


def run(
    role: str, data: Path, checkout: Path, out: Path | None = None, python: str = sys.executable
) -> subprocess.CompletedProcess[str]:
    seg = checkout / "seg" if checkout.name == "mic" else checkout
    out = out or seg / "configs/weather_aug/made.py"
    command = [python, RECIPE, "--role", role, "--data", data, "--checkout", checkout, "--out", out]
    return subprocess.run(
        [str(part) for part in command], capture_output=True, text=True, check=False, timeout=60
    )


def refused(done: subprocess.CompletedProcess[str]) -> str:
    """The one sentence of a run that wrote nothing."""
    assert done.returncode == 2, done.stdout + done.stderr
    assert done.stdout == ""
    lines = done.stderr.splitlines()
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("error: ")
    assert ";" in lines[0], "no cure"
    return lines[0]


def config_of(path: Path) -> dict[str, Any]:
    """A config and its bases, merged by mmcv's rules: bases may not share names."""
    named: dict[str, Any] = {}
    if path.suffix == ".json":
        named = json.loads(path.read_text())
    else:
        exec(path.read_text(), {}, named)
    bases = named.pop("_base_", [])
    merged: dict[str, Any] = {}
    for base in [bases] if isinstance(bases, str) else bases:
        one = config_of(path.parent / base)
        assert not merged.keys() & one.keys(), "mmcv refuses names that two bases share"
        merged |= one
    return merged_into(merged, named)


def merged_into(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    made = dict(base)
    for key, value in over.items():
        deletes = isinstance(value, dict) and value.get("_delete_", False)
        if isinstance(value, dict) and key in base and not deletes:
            assert isinstance(base[key], dict), f"mmcv merges no dict into {key}"
            made[key] = merged_into(base[key], value)
        elif isinstance(value, dict):
            made[key] = {k: v for k, v in value.items() if k != "_delete_"}
        else:
            made[key] = value
    return made


def as_started(checkout: Path, done: subprocess.CompletedProcess[str]) -> dict[str, Any]:
    """The config that a trainer sees when the printed command is run: a child of the one written.

    run_experiments.py writes it to configs/generated/<name>/ with `_base_` made from the given path
    by replacing "configs" with "../..".
    """
    root, given = (line.split()[-1] for line in done.stdout.splitlines()[-2:])
    assert Path(root) == (checkout / "seg" if checkout.name == "mic" else checkout).resolve()
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
    assert config["data"]["train"]["type"] == "DGDataset"
    assert config["uda"]["source_only"] is True
    assert len(Pictures.of(config["data"]["train"]["source"])) == 4
    for other, cure in (("hrda", "checkout dg"), ("mic", "use HRDA, branch dg")):
        line = refused(run("source-only", finished(), checkout_in(tmp_path, other)))
        assert cure in line


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
    assert "classes 13 occur, but never with more than 3000 pixels" in said
    assert "not checked here, because nothing of the checkout was run:" in said
    assert "pretrained/mit_b5.pth is not in the checkout" in said
    assert "does not record which pictures trained the editor" in said


def test_the_editors_of_backgrounds_are_named(data: Path, tmp_path: Path) -> None:
    contents = read_contents(data) | {"editors": [{"pair_list": "acdc"}]}
    (data / "export.json").write_bytes(sealed_contents(contents))
    said = run("source", data, checkout_in(tmp_path, "hrda")).stdout
    assert "an editor trained on acdc; do not evaluate" in said


def unfinished(data: Path) -> None:
    (data / "export.json").unlink()
    (data / ".export").mkdir()


def changed(data: Path) -> None:
    text = (data / "export.json").read_text()
    (data / "export.json").write_text(text.replace('"samples": 4', '"samples": 5'))


def resealed(**fields: Any) -> Callable[[Path], None]:
    def harm(data: Path) -> None:
        contents = read_contents(data)
        contents["job"] |= fields.pop("job", {})
        (data / "export.json").write_bytes(sealed_contents(contents | fields))

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


def cut_short(data: Path) -> None:
    with first(data, "leftImg8bit").open("ab") as file:
        file.truncate(100)


FAULTS: dict[str, tuple[Callable[[Path], None], str]] = {
    "not there": (shutil.rmtree, "is no export"),
    "unfinished": (unfinished, "run the same export again to continue"),
    "changed": (changed, "has changed since it was written"),
    "newer": (resealed(version=99), "take the recipe of the weather_aug that wrote it"),
    "layout": (resealed(job={"layout": "webdataset"}), "which no data set class"),
    "unlabelled": (resealed(labelled=1), "3 of 4 samples"),
    "label gone": (lambda data: first(data, "gtFine").unlink(), "cannot be read"),
    "label in colour": (label_in_colour, "is no label of one channel"),
    "cut short": (cut_short, "is not whole"),
    "a picture more": (a_picture_more, "holds 5 pictures, the export made 4"),
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
    from weather_aug import _files

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
    dataset = checkout / "configs/_base_/datasets/uda_cityscapesHR_to_acdcHR_1024x1024.py"
    dataset.write_text(PLACES.replace("ann_dir", "labels"))
    assert "has no data.train.source.ann_dir" in refused(run("source", finished(), checkout))
    dataset.unlink()
    assert "newest commit" in refused(run("source", finished(), checkout))


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
