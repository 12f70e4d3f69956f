"""RandomWeather in AlbumentationsX, which takes albumentations' place: a fresh environment."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import venv
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from weather_aug.scene.policy import WeatherPolicy
from weather_aug.scene.scene import WeatherScene
from weather_aug.transforms.albumentations import RandomWeather

ROOT = Path(__file__).resolve().parents[2]
SUCCESSOR = "albumentationsx==2.5.1"
QUIET = {"NO_ALBUMENTATIONS_UPDATE": "1", "ALBUMENTATIONS_NO_TELEMETRY": "1"}


def run(*command: str | Path, timeout: int, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        env={**os.environ, **QUIET, "PYTHONPATH": ""},
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An interpreter with the package of this checkout and AlbumentationsX."""
    folder = tmp_path_factory.mktemp("x")
    download = ("-m", "pip", "download", "-q", "--no-deps", "-d", folder / "wheel", SUCCESSOR)
    reached = run(sys.executable, *download, timeout=120, cwd=folder)
    if reached.returncode:
        pytest.skip(f"no registry gives {SUCCESSOR}: {reached.stderr.strip()[-200:]}")
    versions = (ROOT / "constraints.txt").read_text().splitlines()
    kept = [line for line in versions if not line.startswith(("albumentations", "albucore"))]
    (folder / "constraints.txt").write_text("\n".join(kept))
    venv.create(folder / "env", with_pip=True)
    interpreter = folder / "env" / "bin" / "python"
    install = ("-m", "pip", "install", "-q", "-c", folder / "constraints.txt", ROOT, SUCCESSOR)
    done = run(interpreter, *install, timeout=1200, cwd=folder)
    assert done.returncode == 0, done.stderr[-2000:]
    return interpreter


@pytest.fixture(scope="module")
def found(python: Path, tiny_scene: WeatherScene, tmp_path_factory: Any) -> dict[str, Any]:
    script = Path(__file__).with_name("albumentations_x.py")
    cwd = tmp_path_factory.mktemp("elsewhere")
    done = run(python, script, tiny_scene.path.resolve(), timeout=1200, cwd=cwd)
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout)


@pytest.mark.slow
def test_it_is_the_successor(found: dict[str, Any]) -> None:
    assert (found["version"], found["hook"]) == (SUCCESSOR.partition("==")[2], True)


@pytest.mark.slow
def test_a_named_sample_is_the_picture_of_albumentations(
    found: dict[str, Any], tiny_scene: WeatherScene
) -> None:
    frame = tiny_scene.frame((1, "front"))
    sample = {"image": frame.image, "mask": frame.label, "depth": np.float32(frame.depth_m)}
    weather = RandomWeather(WeatherPolicy.snow((2.0, 4.0)), p=1.0)
    done = weather(**sample, sample_key=("a", 1))
    expected = hashlib.sha256(done["image"].tobytes() + done["mask"].tobytes()).hexdigest()
    assert found["picture"] == expected


@pytest.mark.slow
@pytest.mark.parametrize(
    "what",
    [
        "shapes",
        "written",
        "units",
        "seeds",
        "depth as a mask",
        "moves nothing",
        "stack",
        "replay",
        "scene",
        "named in workers",
    ],
)
def test_the_contract_holds(found: dict[str, Any], what: str) -> None:
    assert found[what]
    assert all(found[what]), found[what]


@pytest.mark.slow
def test_workers_do_not_repeat_each_other_and_tensors_come_back(found: dict[str, Any]) -> None:
    # Of eight samples with p = 0.7 the clear ones are alike.
    assert found["named apart"] >= 5
    assert found["unnamed apart"] >= 5
    assert found["tensor"] == [3, 48, 64]
