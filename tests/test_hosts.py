"""The README's lines for each host library run as pasted, where only that library is installed."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TIMEOUT_S = 1800
"""A busy machine installs and compiles for many minutes in a fresh environment."""


@dataclass(frozen=True)
class Host:
    """What is installed beside this package, and how its snippets are told from others."""

    packages: tuple[str, ...]
    word: str
    """In each of its snippets, and in nobody else's."""
    extra: str = ""
    before: str = ""
    """What the reader of the snippet has already."""
    after: str = ""
    """What the reader does with it next."""
    is_config: bool = False
    """Whether it is a file of its own, `snippet.py`, that `after` reads."""


LIGHTNING = """
import lightning, torch
import weather_aug as wa

weather_dataset = wa.WeatherDataset([wa.WeatherScene.build(clip, "scene")], policy, crop=(32, 32))

class Net(lightning.LightningModule):
    def __init__(self):
        super().__init__()
        self.net = torch.nn.Conv2d(3, 19, 1)
    def training_step(self, batch, index):
        loss = torch.nn.CrossEntropyLoss(ignore_index=255)
        return loss(self.net(batch["image"] / 255), batch["label"])
    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), 0.1)
"""
HUGGINGFACE = """
import datasets
from PIL import Image

columns = {
    "image": [Image.fromarray(image)] * 2,
    "annotation": [Image.fromarray(train_ids)] * 2,
    "id": ["a", "b"],
}
dataset = datasets.Dataset.from_dict(columns)
dataset = dataset.cast(datasets.Features(
    {"image": datasets.Image(), "annotation": datasets.Image(), "id": datasets.Value("string")}
))
"""
# mmcv-lite has no compiled kernels, mmseg imports their names, and no pipeline of data calls them.
MMSEG = """
import sys, types

class Compiled(types.ModuleType):
    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)

sys.modules["mmcv._ext"] = Compiled("mmcv._ext")

from PIL import Image
Image.fromarray(image).save("image.png")
Image.fromarray(train_ids).save("label.png")
"""
MMSEG_AFTER = """
import mmseg.datasets
from mmengine.config import Config
from mmengine.dataset import Compose
from mmengine.registry import init_default_scope
from weather_aug.transforms.mmseg import RandomWeather

init_default_scope("mmseg")
steps = Config.fromfile("snippet.py").train_pipeline
place = [step["type"] for step in steps].index("RandomWeather")
# What the test fixes, so that there is something to compare: the draw, and the whole picture.
steps[place].update(p=1.0, keyed=True)
for step in steps:
    if step["type"] == "RandomCrop":
        step["crop_size"] = image.shape[:2]
pipeline = Compose(steps)
assert isinstance(pipeline.transforms[place], RandomWeather), pipeline

def fresh():
    return dict(img_path="image.png", seg_map_path="label.png", label_map=None,
                reduce_zero_label=False, seg_fields=[], sample_idx=0)

loaded = Compose(steps[:place])(fresh())
assert (loaded["img"] == image[..., ::-1]).all()
arguments = {name: value for name, value in steps[place].items() if name != "type"}
expected = RandomWeather(**arguments)(loaded)
assert (expected["img"] != loaded["img"]).any()
packed = pipeline(fresh())
assert (packed["inputs"].permute(1, 2, 0).numpy() == expected["img"]).all()
assert (packed["data_samples"].gt_sem_seg.data[0].numpy() == expected["gt_seg_map"]).all()
"""
HOSTS = {
    "albumentations": Host((), "weather_aug.transforms.albumentations", extra="albumentations"),
    "kornia": Host((), "weather_aug.transforms.kornia", extra="kornia"),
    "huggingface": Host(("datasets",), "weather_aug.transforms.huggingface", before=HUGGINGFACE),
    "lightning": Host(("lightning",), "import lightning", before=LIGHTNING),
    "mmseg": Host(
        ("mmsegmentation==1.2.2", "mmengine", "mmcv-lite==2.1.0", "ftfy", "regex"),
        "weather_aug.transforms.mmseg",
        before=MMSEG,
        after=MMSEG_AFTER,
        is_config=True,
    ),
}
BEFORE = """
import numpy as np
import torch
import weather_aug as wa

clip = wa.open_clip("street:?frames=2&width=640&height=520")
frame = clip.frame(clip.keys[0])
image, train_ids = frame.image.copy(), frame.label.copy()
image_copy, train_ids_copy = image.copy(), train_ids.copy()
images = torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255
masks = torch.from_numpy(train_ids)[None, None].float()
policy = wa.WeatherPolicy(types={"rain": 1, "snow": 1, "fog": 1})
"""
AFTER = """
assert (image == image_copy).all() and (train_ids == train_ids_copy).all()
print("as pasted")
"""


def snippets(host: Host, readme: str) -> list[str]:
    """The fenced blocks of Python that are the host's."""
    blocks = re.findall(r"^```python\n(.*?)^```", readme, re.DOTALL | re.MULTILINE)
    return [block for block in blocks if host.word in block]


@pytest.mark.parametrize("name", HOSTS)
def test_the_readme_has_a_snippet_for_each_host(name: str) -> None:
    assert snippets(HOSTS[name], (ROOT / "README.md").read_text(encoding="utf-8"))


def test_a_snippet_is_found_by_its_module_alone() -> None:
    host = HOSTS["huggingface"]
    text = "```python\nx = 1\n```\n\n```sh\n{0}\n```\n{0}\n```python\nimport {0}\n```\n"
    assert snippets(host, text.format(host.word)) == [f"import {host.word}\n"]


@pytest.fixture(scope="module")
def registry() -> None:
    """A package that every build of this one needs must be there."""
    command = [sys.executable, "-m", "pip", "install", "--dry-run", "--no-deps", "--quiet"]
    asked = subprocess.run(
        [*command, "--ignore-installed", "hatchling"],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    if asked.returncode:
        pytest.skip(f"no package registry: {asked.stderr.strip().splitlines()[-1]}")


@pytest.fixture
def environment(tmp_path: Path, registry: None) -> Iterator[Path]:
    """A fresh virtual environment, which is a gigabyte and does not stay."""
    folder = tmp_path / "environment"
    run([sys.executable, "-m", "venv", str(folder)], tmp_path)
    yield folder
    shutil.rmtree(folder)


def run(command: list[str], folder: Path) -> str:
    """What a command prints; nothing of this checkout's environment is seen by it."""
    unseen = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
    done = subprocess.run(
        command,
        cwd=folder,
        env={name: value for name, value in os.environ.items() if name not in unseen},
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    assert done.returncode == 0, f"{command}\n{done.stdout[-4000:]}\n{done.stderr[-4000:]}"
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("name", HOSTS)
def test_snippets_run_as_pasted(name: str, environment: Path, tmp_path: Path) -> None:
    host = HOSTS[name]
    python = str(environment / "bin" / "python")
    package = f"{ROOT}[{host.extra}]" if host.extra else str(ROOT)
    constraints = ["--constraint", str(ROOT / "constraints.txt")]
    run([python, "-m", "pip", "install", "-q", *constraints, package, *host.packages], tmp_path)
    for number, snippet in enumerate(snippets(host, (ROOT / "README.md").read_text("utf-8"))):
        folder = tmp_path / f"snippet{number}"
        folder.mkdir()
        (folder / "snippet.py").write_text(snippet)
        parts = [BEFORE, host.before, "" if host.is_config else snippet, host.after, AFTER]
        (folder / "pasted.py").write_text("\n".join(parts))
        assert "as pasted" in run([python, "pasted.py"], folder)
