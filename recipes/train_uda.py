"""HRDA and MIC's training, in small, fed by WeatherDataset; and what an augmentation gains in it.

python recipes/train_uda.py --data CAMVID --augment photometric mixed-2d weather_aug --seeds 0 1 2

Source: clear frames with labels, which each arm changes in its way. Target: others in rain, snow
and fog, whose labels teach nothing. The same command goes on where it stopped, to the same bytes.
"""

from __future__ import annotations

import itertools
import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
import tyro
from safetensors.torch import safe_open, save
from tqdm import tqdm
from uda.frames import CLEAR, WEATHERS, Arm, augmented, camvid, loaders, streets
from uda.method import Learner, Method, windows

import weather_aug as wa
from weather_aug._files import parse_json, write_whole
from weather_aug._keys import key_of, uniforms
from weather_aug.errors import ConflictError
from weather_aug.scores.agreement import agreement
from weather_aug.taxonomy import CLASSES, coloured
from weather_aug.view.sheet import grid, write_png

QUICK, RESAMPLES = Method(4, alone=1, crop_px=64, widths=(8, 8, 16, 16), head=16, batch=2), 2000
ALONE = ", uda off"
OURS = """rain, snow and fog of severity 0.25 to 1, rendered here, as are
all targets and what the arm weather_aug learns with labels: its advantage. See --validation"""
NOTE = """A gain of weather_aug counts against photometric and mixed-2d, not against none.
[95 % of resamples of frames and, if there are several, of seeds]. Weathered frames: {}."""


@dataclass(frozen=True)
class Options:  # noqa: D101 (its docstring would be printed in place of the module's)
    data: Path | None = None  # CamVid's folder; procedural streets without it.
    augment: tuple[Arm, ...] = ("photometric", "mixed-2d", "weather_aug")  # Arms to compare.
    seeds: tuple[int, ...] = (0,)  # Of weights, crops and weathers.
    uda: tuple[Literal["on", "off"], ...] = ("on",)  # off: on the source alone to the end.
    method: Annotated[Method, tyro.conf.arg(name="")] = field(default_factory=Method)
    out: Path = Path("runs/uda")  # States and pictures; work that is there is taken up again.
    validation: str | None = None  # Labelled pictures of real weather: a folder as ACDC, or a clip.
    threads: int = 1  # Of torch; with more, sums are rounded in other ways.
    quick: bool = False  # Four steps of a tiny network, whatever else is asked of the method.


def trained(learner: Learner, streams: list[Any], arm: str, path: Path, every: int = 50) -> None:
    """Train to the end, from the state at `path` if there is one."""
    steps, done, means = learner.method.iterations, 0, dict[str, float]()
    if path.exists():
        with safe_open(path, framework="pt") as file:
            head = parse_json(file.metadata()["head"], str(path))
            done, samplers = head["done"], head["samplers"]
            if head["method"] != repr(learner.method):
                raise ConflictError(f"{path} holds a {head['method']}; choose another --out")
            for stream, state in zip(streams, samplers, strict=True):
                stream.sampler.load_state_dict(state)  # Refuses a state of another training.
            learner.load({name: file.get_tensor(name) for name in file.keys()})
    batches = zip(*(stream.sampler.follow(stream) for stream in streams), strict=True)
    bar = tqdm(range(done, steps), f"{arm}, seed {learner.seed}", steps, initial=done)
    for step, (source, target) in zip(bar, batches, strict=True):
        pictures = augmented(arm, source["image"], key_of("uda arm", learner.seed, step))
        told = learner.step(step, pictures, source["label"], target["image"], target["label"])
        means = {name: 0.9 * means.get(name, now) + 0.1 * now for name, now in told.items()}
        bar.set_postfix({name: f"{value:.2f}" for name, value in means.items()})
        if (step + 1) % every == 0 or step + 1 == steps:
            samplers = [stream.sampler.state_dict() for stream in streams]
            head = {"done": step + 1, "samplers": samplers, "method": repr(learner.method)}
            write_whole(path, save(learner.tensors(), {"head": json.dumps(head)}))


@torch.inference_mode()
def judged(learner: Learner, frames: wa.WeatherDataset) -> tuple[Any, list[list[Any]]]:
    """(N, 19, 19) confusions of the student (row: truth); pictures, truths and predictions."""
    counts, shown = [], []
    for image, label in map(frames.__getitem__, range(len(frames))):
        scores, picture = torch.zeros(len(CLASSES), *label.shape), image[None]
        for box in windows(label.shape, learner.method.crop_px):
            scores[:, *box] += learner.student.whole(picture[..., *box])[0]
        labels = [each.numpy().astype(np.uint8) for each in (label, scores.argmax(0))]
        counts.append(agreement(*labels).confusion)
        shown.append([image.permute(1, 2, 0).numpy(), *map(coloured, labels)])
    return np.array(counts), shown


def resampled(counts: Any) -> Any:
    """(1 + `RESAMPLES`,) mean IoU: of (seeds, frames, 19, 19) confusions, then of resamples."""
    seeds, frames = counts.shape[:2]  # Equal ones get equal draws: differences are paired.
    draws = uniforms(key_of("uda bootstrap"), RESAMPLES * (seeds + frames)).reshape(RESAMPLES, -1)
    drawn = (draws * ([seeds] * seeds + [frames] * frames)).astype(int)
    times = [np.bincount(row, minlength=frames) for row in drawn[:, seeds:]]
    total = np.tensordot([np.ones(frames), *times], counts, (1, 1))
    hits, labelled = np.diagonal(total, axis1=-2, axis2=-1), total.sum(-1)
    miou = (hits / np.maximum(labelled + total.sum(-2) - hits, 1)).mean(-1, where=labelled > 0)
    return np.take_along_axis(miou, np.vstack([np.arange(seeds), drawn[:, :seeds]]), 1).mean(1)


def report(counts: dict[str, list[Any]], weathered: str) -> str:
    """A line for each arm, for weather_aug against each, and for each against source alone."""
    rows = {arm: np.stack([resampled(np.array(c)) for c in both]) for arm, both in counts.items()}
    pairs = [("weather_aug", arm) for arm in rows if not arm.endswith(ALONE)]
    for a, b in pairs + [(arm, arm + ALONE) for arm in rows]:
        if a != b and {a, b} <= counts.keys():
            rows[f"{a} - {b}"] = rows[a] - rows[b]
    lines = [f"{'mIoU':44}{'clear':27}weathered"]
    for name, both in rows.items():
        limits = np.percentile(both[:, 1:], (2.5, 97.5), axis=1)
        parts = map("{:7.3f} [{:6.3f}, {:6.3f}]".format, both[:, 0], *limits)
        lines.append(f"{name:42}" + "   ".join(parts))
    return "\n".join([*lines, NOTE.format(weathered)])


def main(given: Options) -> None:
    """Train each arm with each seed, and compare them."""
    torch.set_num_threads(given.threads)
    size = (1, 96, 64) if given.quick else (4, 480, 288)
    *pair, held_out = camvid(given.data) if given.data else streets(given.out / "scenes", *size)
    sets = {"clear": (held_out, CLEAR), "weathered": (held_out, WEATHERS)}
    if real := given.validation:
        acdc = f"folder:{real}?images=rgb_anon/val&labels=gt/val&taxonomy=train_ids"
        sets["weathered"] = ([wa.open_clip(real if ":" in real else acdc)], CLEAR)
    counts: dict[str, list[Any]] = {}
    for uda, arm, seed in itertools.product(given.uda, given.augment, given.seeds):
        method, name = QUICK if given.quick else given.method, arm
        if uda == "off":
            method, name = replace(method, alone=method.iterations), arm + ALONE
        folder, learner = given.out / f"{name}-{seed}", Learner(method, seed)
        folder.mkdir(parents=True, exist_ok=True)
        streams = loaders(*pair, arm, seed, method)
        trained(learner, streams, arm, folder / "state.safetensors")
        rows, names, lists = [], [], counts.setdefault(name, [[], []])
        for found, (which, both) in zip(lists, sets.items(), strict=True):
            frames = wa.WeatherDataset(*both, seed=-1, output="tuple", balanced_weathers=True)
            confusions, shown = judged(learner, frames)
            found.append(confusions)
            rows += shown[:: max(1, len(shown) // 3)][:3]
            names += [which] * (len(rows) - len(names))
        sheet = grid(rows, names, ["picture", "truth", "prediction"], 480)
        write_png(folder / "predictions.png", sheet)
    print(report(counts, given.validation or OURS))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
