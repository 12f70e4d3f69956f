"""Streets, pairs, base model and adapters of the experiment: made where they are missing."""

from __future__ import annotations

import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

from small_editor.measure import HeldOut
from small_editor.pretrain import Schedule, read_pictures, small_model
from small_editor.streets import street_scene, write_list, write_pictures


@dataclass(frozen=True)
class Plan:
    """How much of everything."""

    streets: range = range(10, 34)
    times: int = 10
    """Of a street that is trained on, 0.9 s apart."""
    held_out: range = range(100, 104)
    held_out_times: int = 8
    """0.1 s apart."""
    size_px: tuple[int, int] = (160, 96)
    schedule: Schedule = field(default_factory=Schedule)
    steps: int = 700
    batch: int = 2
    singles: bool = True
    """Whether single-style adapters are trained, too."""
    threads: int = 1
    """Of one training; on more, small layers take no less time."""


QUICK = Plan(
    *(range(10, 11), 1, range(100, 102), 2, (48, 32)),
    schedule=Schedule(vae_steps=3, unet_steps=3, batch=2, crop_px=(16, 24)),
    steps=4,
    singles=False,
)


def prepared(plan: Plan, out: Path) -> list[HeldOut]:
    """Write streets, pairs and the base model where they are missing; the held-out streets."""
    scenes, pairs = out / "scenes", out / "pairs"
    held_out = [
        street_scene(scenes, s, plan.held_out_times, 1, plan.size_px) for s in plan.held_out
    ]
    if not (out / "pairs.jsonl").is_file():
        drives = [street_scene(scenes, s, plan.times, 9, plan.size_px) for s in plan.streets]
        write_pictures(pairs, drives, "train")
        write_pictures(pairs, held_out, "test")
        write_list(pairs, out / "pairs.jsonl")
    if not (out / "base").is_dir():
        began = time.perf_counter()
        small_model(out / "base", read_pictures(pairs), schedule=plan.schedule)
        print(f"pre-training took {time.perf_counter() - began:.0f} s", flush=True)
    return [HeldOut.of(scene) for scene in held_out]


def trained(plan: Plan, out: Path, name: str, steps: int, *words: str) -> Path:
    """An adapter by the command that trains them; its folder."""
    folder = out / name
    if not folder.is_dir():
        began = time.perf_counter()
        command = [sys.executable, "-m", "weather_aug.cli", "train-editor"]
        given = [out / "pairs.jsonl", *flags(plan, out, steps), "--out", folder, "--steps", steps]
        subprocess.run([*command, *map(str, given), *words], check=True)
        print(f"{name}: {steps} steps took {time.perf_counter() - began:.0f} s", flush=True)
    return folder


def flags(plan: Plan, out: Path, steps: int) -> list[object]:
    """What all trainings have in common.

    Rates of SD-Turbo's size would move a small model nowhere in minutes; the picture's L1 counts
    most because that is what is measured.
    """
    width, height = plan.size_px
    return [
        *("--base", out / "base", "--size", height, width, "--batch-size", plan.batch),
        *("--learning-rate", 1e-3, "--warm-up", 50, "--cool-down", steps // 2, "--clip", 1.0),
        *("--unet-rank", 16, "--vae-rank", 8, "--label-dropout", 0, "--threads", plan.threads),
        *("--weights", "l1=5", "epsilon=0.5", "perceptual=1"),
        *("--save-every", 10_000, "--sample-every", 0, "--validate-every", 0),
    ]
