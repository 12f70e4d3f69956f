"""An export through the real loaders: mmsegmentation 1.x, mmengine, cityscapesScripts.

They are installed into an environment of their own, made here or given in WEATHER_AUG_MMSEG_PYTHON:
they bring a third OpenCV, and mmsegmentation wants an mmcv that is older than its newest.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from tiny_export import POLICY, TinyClip
from trainer_checkout import checkout_in, config_of, run

from weather_aug.clip.images import read_image
from weather_aug.scene.scene import WeatherScene
from weather_aug.writers.export import export
from weather_aug.writers.plan import plan_export

ROOT = Path(__file__).parents[2]
PACKAGES = (
    *("torch", "mmengine==0.10.7", "mmcv-lite==2.1.0", "mmsegmentation==1.2.2"),
    *("cityscapesScripts==2.3.0", "ftfy", "regex"),
)

pytestmark = pytest.mark.slow


def called(*command: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(part) for part in command],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=1800,
        check=False,
    )


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An interpreter with the loaders; the test is skipped where no registry can be reached."""
    if given := os.environ.get("WEATHER_AUG_MMSEG_PYTHON"):
        return Path(given)
    environment = tmp_path_factory.mktemp("mmseg") / "environment"
    assert called(sys.executable, "-m", "venv", environment).returncode == 0
    made = environment / ("Scripts" if os.name == "nt" else "bin") / "python"
    pip = (made, "-m", "pip", "--disable-pip-version-check")
    if called(*pip, "download", "--no-deps", "-d", environment / "probe", PACKAGES[1]).returncode:
        pytest.skip("no package registry can be reached")
    done = called(*pip, "install", "--quiet", "-c", ROOT / "constraints.txt", *PACKAGES)
    assert done.returncode == 0, done.stderr[-2000:]
    return made


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("real")
    scene = WeatherScene.build(TinyClip(width=128, height=96), folder / "tiny")
    export(plan_export([scene], POLICY, count=8, seed=3), folder / "out")
    return folder / "out"


@pytest.fixture(scope="module")
def config(root: Path) -> Path:
    checkout = checkout_in(root.parent, "mic")
    assert run("source", root, checkout).returncode == 0
    return checkout / "seg/configs/weather_aug/made.py"


@pytest.fixture(scope="module")
def read(python: Path, root: Path, config: Path) -> dict[str, Any]:
    """What the real loaders make of the export and the config."""
    done = called(python, "-W", "ignore", Path(__file__).with_name("real_mmseg.py"), root, config)
    assert done.returncode == 0, done.stderr[-3000:]
    result: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return result


def test_the_real_data_set_reads_what_the_manifest_says(read: dict[str, Any], root: Path) -> None:
    entries = [json.loads(line) for line in (root / "manifest.jsonl").read_text().splitlines()]
    by_image = {sample["image"]: sample for sample in read["samples"]}
    assert len(by_image) == len(read["samples"]) == len(entries) == 8
    for entry in entries:
        sample = by_image[entry["files"]["image"]["path"]]
        assert sample["label"] == entry["files"]["label"]["path"]
        assert sample["shape"] == [3, 96, 128]
        ignored = sample["pixels"].pop("255", 0)
        assert sample["pixels"] == entry["class_pixels"]
        assert ignored + sum(sample["pixels"].values()) == 96 * 128
        mean_bgr = read_image(root / sample["image"]).mean(axis=(0, 1))[::-1]
        assert sample["mean_bgr"] == pytest.approx(mean_bgr.tolist(), abs=1e-6)


def test_the_real_config_reader_merges_as_the_tests_do(read: dict[str, Any], config: Path) -> None:
    assert read["config"] == config_of(config)


def test_cityscapes_scripts_score_the_labels_against_themselves(read: dict[str, Any]) -> None:
    assert read["scores"]["itself"] == 1.0
    assert 0.3 < read["scores"]["wrong"] < 0.9, "a wrong quarter must show"
