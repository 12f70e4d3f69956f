"""HRDA and MIC's training, in small, fed by WeatherDataset; and what an augmentation gains in it.

python recipes/train_uda.py --augment photometric mixed-2d weather_aug --seeds 0 1 2 --data CAMVID

Source: clear frames with labels, which each arm changes in its own way. Target: other frames in
rain, snow and fog, whose labels nobody sees. The same command goes on where it was stopped, to the
same bytes. --quick goes through all of it in a minute; 200 steps from nothing prove nothing either.

All arms adapt to targets that this library rendered, as it renders the weathered validation frames:
an advantage for the arm weather_aug, which learns that very look with labels. Real pictures know no
such favour: --validation.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.torch import save
from tqdm import tqdm
from uda.frames import CLEAR, WEATHERS, augmented, camvid, endless, loaders, streets
from uda.method import Learner, Method, normalised

import weather_aug as wa
from weather_aug._files import parse_json, write_whole
from weather_aug._keys import key_of, uniforms
from weather_aug.errors import ConflictError
from weather_aug.scores.agreement import agreement
from weather_aug.taxonomy import coloured
from weather_aug.view.sheet import grid, write_png

Arm = Literal["none", "photometric", "albumentations", "mixed-2d", "weather_aug"]
QUICK = Method(iterations=4, crop_px=64, widths=(8, 8, 16, 16), head=16)
RESAMPLES = 2000
OURS = """rain, snow and fog of severity 0.25 to 1, rendered by weather_aug as all arms' targets are;
the arm weather_aug learns from its renderer with labels, an advantage. Judge it by --validation"""
NOTE = """A gain of weather_aug counts against photometric and mixed-2d, not against none.
[95 % of {} resamples of frames and seeds], {} seed(s). Weathered: {}."""


def trained(learner: Learner, streams: list[Any], arm: str, path: Path, every: int) -> None:
    """Train to the end, from the state at `path` if there is one."""
    job, done = f"{arm} {learner.seed} {learner.method}", 0
    if path.exists():
        with safe_open(path, framework="pt") as file:
            head = parse_json(file.metadata()["head"], str(path))
            if head["job"] != job:
                raise ConflictError(f"{path} is of {head['job']}, not {job}; give another --out")
            learner.load({name: file.get_tensor(name) for name in file.keys()})
        done = head["done"]
        for stream, state in zip(streams, head["samplers"], strict=True):
            stream.sampler.load_state_dict(state)
    batches, steps = zip(*map(endless, streams), strict=True), learner.method.iterations
    bar = tqdm(range(done, steps), f"{arm}, seed {learner.seed}", steps, initial=done)
    for step in bar:
        source, target = next(batches)
        pictures = augmented(arm, source["image"], key_of("uda arm", learner.seed, step))
        told = learner.step(step, pictures, source["label"], target["image"])
        bar.set_postfix({name: f"{value:.2f}" for name, value in told.items()})
        if (step + 1) % every == 0 or step + 1 == steps:
            states = [stream.sampler.state_dict() for stream in streams]
            head = {"job": job, "done": step + 1, "samplers": states}
            write_whole(path, save(learner.tensors(), {"head": json.dumps(head)}))


@torch.inference_mode()
def seen(learner: Learner, frames: wa.WeatherDataset) -> list[list[NDArray[np.uint8]]]:
    """Of each frame the picture (H, W, 3), the truth (H, W) and the student's prediction (H, W)."""
    rows = []
    for image, label in map(frames.__getitem__, range(len(frames))):
        found = learner.student.whole(normalised(image[None]))[0].argmax(0)
        rows.append([p.numpy().astype(np.uint8) for p in (image.permute(1, 2, 0), label, found)])
    return rows


def resampled(counts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Mean IoU of (seeds, frames, 19, 19) confusions (row: truth), then of `RESAMPLES` resamples.

    Arms of equal shape get equal draws, so that differences of two arms are paired.
    """
    seeds, frames = counts.shape[:2]
    draws = uniforms(key_of("uda bootstrap"), RESAMPLES * (seeds + frames)).reshape(RESAMPLES, -1)
    drawn = (draws * ([seeds] * seeds + [frames] * frames)).astype(int)
    times = [np.bincount(row, minlength=frames) for row in drawn[:, seeds:]]
    total = np.tensordot([np.ones(frames), *times], counts, (1, 1))
    hits, labelled = np.diagonal(total, axis1=-2, axis2=-1), total.sum(-1)
    iou = hits / np.maximum(labelled + total.sum(-2) - hits, 1)
    miou = iou.sum(-1, where=labelled > 0) / (labelled > 0).sum(-1)
    chosen = np.vstack([np.arange(seeds), drawn[:, :seeds]])
    return np.take_along_axis(miou, chosen, 1).mean(1)


def report(counts: dict[str, list[Any]], weathered: str) -> str:
    """A line for each arm, and for weather_aug against each: on clear and on weathered frames."""
    rows = {arm: np.stack([resampled(np.array(c)) for c in both]) for arm, both in counts.items()}
    if "weather_aug" in rows:
        others = [arm for arm in rows if arm != "weather_aug"]
        rows |= {f"weather_aug - {arm}": rows["weather_aug"] - rows[arm] for arm in others}
    lines = [f"{'mIoU':30}{'clear':27}weathered"]
    for name, both in rows.items():
        ends = np.percentile(both[:, 1:], (2.5, 97.5), axis=1).T
        parts = (
            f"{m:7.3f} [{a:6.3f}, {b:6.3f}]" for m, (a, b) in zip(both[:, 0], ends, strict=True)
        )
        lines.append(f"{name:28}" + "   ".join(parts))
    seeds = len(next(iter(counts.values()))[0])
    return "\n".join([*lines, NOTE.format(RESAMPLES, seeds, weathered)])


def main(
    data: Path | None = None,  # CamVid's folder; procedural streets without it.
    augment: tuple[Arm, ...] = ("photometric", "mixed-2d", "weather_aug"),  # Arms to compare.
    seeds: tuple[int, ...] = (0,),  # Of weights, crops and weathers.
    iterations: int = 200,  # Steps of each arm and seed.
    out: Path = Path("runs/uda"),  # Folder of states and pictures; work in it is taken up again.
    validation: str | None = None,  # Address of a clip of labelled pictures in real bad weather, or
    # a folder as ACDC is (rgb_anon/val, gt/val); in place of rendered ones.
    save_every: int = 50,  # Steps from one state to the next.
    quick: bool = False,  # Four steps of a tiny network.
) -> None:
    """Train each arm with each seed, and compare them."""
    method = QUICK if quick else replace(Method(), iterations=iterations)
    size = (1, 96, 64) if quick else (4, 480, 288)
    source, target, held_out = camvid(data) if data else streets(out / "scenes", *size)
    judged = {"clear": (held_out, CLEAR), "weathered": (held_out, WEATHERS)}
    if validation:
        acdc = f"folder:{validation}?images=rgb_anon/val&labels=gt/val&taxonomy=train_ids"
        judged["weathered"] = ([wa.open_clip(validation if ":" in validation else acdc)], CLEAR)
    judged = {
        name: wa.WeatherDataset(*both, seed=-1, output="tuple", balanced_weathers=True)
        for name, both in judged.items()
    }
    counts: dict[str, list[Any]] = {arm: [[], []] for arm in augment}
    for arm, seed in ((arm, seed) for seed in seeds for arm in augment):
        learner = Learner(method, seed)
        streams = loaders(source, target, arm, seed, method.batch, method.crop_px)
        path = out / f"{arm}-{seed}"
        path.mkdir(parents=True, exist_ok=True)
        trained(learner, streams, arm, path / "state.safetensors", save_every)
        shown, names = [], []
        for found, (name, frames) in zip(counts[arm], judged.items(), strict=True):
            rows = seen(learner, frames)
            found.append([agreement(truth, guess).confusion for _, truth, guess in rows])
            for image, *labels in rows[:: max(1, len(rows) // 2)][:3]:
                shown.append([image, *map(coloured, labels)])
                names.append(name)
        write_png(
            path / "predictions.png", grid(shown, names, ["picture", "truth", "prediction"], 480)
        )
    print(report(counts, validation or OURS))


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
