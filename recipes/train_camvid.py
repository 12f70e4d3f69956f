"""A small SegFormer trained with and without weather: what weather costs, and what it brings.

python recipes/train_camvid.py /data/camvid      # train, trainannot, val, valannot; 11 classes
python recipes/train_camvid.py                   # no data at hand: a procedural street

The net is that of transformers (`pip install transformers`).

Two copies of one net start from the same weights and are given the same crops of the same pictures
in the same order. One sees them as they were recorded; for the other, a worker of the DataLoader
draws weather into each crop, and the label is 255 where the weather hides the surface. At the end
both are asked about held-out pictures in clear weather, rain, snow and fog, and a sheet of what
they answer is written. A hundred iterations make no good net; they show that the loop runs, that
the loss falls, and what an iteration costs.

How the cost is measured: the nets take turns of ten iterations, so that whatever else the machine
does hits both alike. The first iterations of a turn use batches that were drawn while the other net
had its turn; they do not count. Given are the median over the turns, and of the cost the median
over pairs of turns. The loaders differ in the policy alone. Each has one worker, the net has one
thread: where two cores are free, weather is drawn beside the training and takes next to nothing
from it, as long as the worker is faster than the net; the loaders' own speed is printed, too. Where
no core is free for the worker, because the net takes all (`--threads 2` on two cores) or because
others are at work (see the load), weather takes its time from the net.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import reduce
from itertools import count, islice
from operator import add
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader
from transformers import SegformerConfig, SegformerForSemanticSegmentation

import weather_aug as wa
from weather_aug.scores.agreement import Agreement, agreement
from weather_aug.taxonomy import CLASSES, IGNORE, coloured
from weather_aug.view.sheet import grid, write_png

CLEAR = wa.WeatherPolicy({"clear": 1})
VAL_POLICIES = {"clear": CLEAR} | {
    kind: wa.WeatherPolicy({kind: 1}, falling=1.0) for kind in ("rain", "snow", "fog")
}
MOST_COST = 0.10
MEAN, SCALE = 110.0, 60.0
"""Of the pixels of an everyday street, roughly."""
QUEUED = 2
"""Batches that a worker draws ahead."""


@dataclass(frozen=True)
class Plan:
    """What is trained on what, and for how long."""

    iterations: int = 100
    timed: int = 7
    """Iterations of a turn that count."""
    batch: int = 4
    crop: tuple[int, int] = (256, 256)
    workers: int = 1
    widths: tuple[int, ...] = (16, 32, 64, 96)
    street: str = "frames=10&width=480&height=270"
    seed: int = 0

    @property
    def settling(self) -> int:
        """Iterations of a turn before those: batches that were drawn ahead, and one more."""
        return self.workers * QUEUED + 1


QUICK = Plan(6, 3, 2, (96, 96), widths=(8, 16, 16, 16), street="frames=2&width=192&height=108")


@dataclass
class Arm:
    """One of the two trainings."""

    net: Any
    optimiser: torch.optim.Optimizer
    batches: Iterator[tuple[torch.Tensor, torch.Tensor]]
    per_s: list[float] = field(default_factory=list)
    """Iterations per second in each turn."""
    losses: list[float] = field(default_factory=list)


def scenes(data: Path | None, plan: Plan, folder: Path) -> tuple[wa.WeatherScene, wa.WeatherScene]:
    """The pictures to train on and those to be asked about, with depth and light: made once."""
    uris = [f"street:?{plan.street}&seed={seed}" for seed in (0, 1)]
    if data is not None:
        uris = [
            f"folder:{data}?images={part}&labels={part}annot&taxonomy=camvid11"
            for part in ("train", "val")
        ]
    train, val = (
        wa.WeatherScene.build(wa.open_clip(uri), folder / part)
        for part, uri in zip(("train", "val"), uris, strict=True)
    )
    return train, val


def fresh_net(plan: Plan) -> Any:
    """A SegFormer with random weights; without dropout, so that nothing but weather differs."""
    config = SegformerConfig(
        num_labels=len(CLASSES),
        semantic_loss_ignore_index=IGNORE,
        hidden_sizes=list(plan.widths),
        depths=[1, 1, 1, 1],
        num_attention_heads=[1, 2, 4, 4],
        decoder_hidden_size=64,
        # So few iterations do not get far from weights near 0.
        initializer_range=0.1,
        drop_path_rate=0.0,
        classifier_dropout_prob=0.0,
    )
    with torch.random.fork_rng():
        torch.manual_seed(plan.seed)
        return SegformerForSemanticSegmentation(config)


def batches(
    scene: wa.WeatherScene, policy: wa.WeatherPolicy, plan: Plan
) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """Batches without end; the order of the pictures and their crops hang on the seed alone."""
    dataset = wa.WeatherDataset(
        [scene],
        policy,
        seed=plan.seed,
        crop=plan.crop,
        # As long as the training: each start of an epoch waits for its first batch.
        length=plan.iterations * plan.batch,
        output="tuple",
    )
    loader = DataLoader(
        dataset,
        batch_size=plan.batch,
        shuffle=True,
        drop_last=True,
        generator=torch.Generator().manual_seed(plan.seed),
        num_workers=plan.workers,
        prefetch_factor=QUEUED,
        persistent_workers=True,
    )
    for epoch in count():
        dataset.set_epoch(epoch)
        yield from loader


def arm_of(net: Any, scene: wa.WeatherScene, policy: wa.WeatherPolicy, plan: Plan) -> Arm:
    """A copy of the net, about to be trained in a policy's weather."""
    own = deepcopy(net).train()
    optimiser = torch.optim.AdamW(own.parameters(), lr=2e-3)
    return Arm(own, optimiser, batches(scene, policy, plan))


def step(arm: Arm) -> None:
    """One iteration."""
    images, labels = next(arm.batches)
    loss = arm.net(pixel_values=normalised(images), labels=labels).loss
    arm.optimiser.zero_grad()
    loss.backward()
    arm.optimiser.step()
    arm.losses.append(float(loss.detach()))


def normalised(images: torch.Tensor) -> torch.Tensor:
    """(B, 3, H, W) uint8 as the net takes it."""
    return (images.float() - MEAN) / SCALE


def train(arms: dict[str, Arm], plan: Plan) -> None:
    """Train all arms in turns; the one that was last is first in the next round."""
    order = list(arms.values())
    turn = plan.settling + plan.timed
    for done in range(0, plan.iterations, turn):
        steps = min(turn, plan.iterations - done)
        for arm in order:
            for _ in range(min(plan.settling, steps)):
                step(arm)
            start = time.perf_counter()
            for _ in range(plan.settling, steps):
                step(arm)
            if steps > plan.settling:
                arm.per_s.append((steps - plan.settling) / (time.perf_counter() - start))
        order.reverse()


def cost(arms: dict[str, Arm]) -> float:
    """Share of the iterations per second that weather takes: the median over pairs of turns."""
    turns = zip(arms["weather"].per_s, arms["clear"].per_s, strict=True)
    return 1 - median(weather / clear for weather, clear in turns)


def loader_per_s(arm: Arm, plan: Plan) -> float:
    """Batches per second when nobody trains on them."""
    for _ in islice(arm.batches, plan.settling):
        pass
    start = time.perf_counter()
    for _ in islice(arm.batches, 2 * plan.timed):
        pass
    return 2 * plan.timed / (time.perf_counter() - start)


@torch.no_grad()
def answer(net: Any, image: torch.Tensor) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """The net's train ids (H, W) of a picture (3, H, W) uint8."""
    logits = net.eval()(pixel_values=normalised(image[None])).logits
    full = torch.nn.functional.interpolate(logits, image.shape[1:], mode="bilinear")
    return full[0].argmax(dim=0).to(torch.uint8).numpy()


def miou(found: Agreement) -> float:
    """Mean IoU over the classes that the labels have."""
    return float(found.iou[found.confusion.sum(axis=1) > 0].mean())


def asked(arms: dict[str, Arm], val: wa.WeatherScene, out: Path) -> dict[str, dict[str, float]]:
    """The mIoU of each net in each weather, and the sheet of one picture in all of them."""
    scores: dict[str, dict[str, float]] = {name: {} for name in arms}
    rows = []
    for kind, policy in VAL_POLICIES.items():
        items = wa.WeatherDataset([val], policy, seed=1, output="tuple")
        shown = len(items) // 2
        pictures = [items[k] for k in range(len(items))]
        labels = [label.numpy().astype(np.uint8) for _, label in pictures]
        rows.append([pictures[shown][0].permute(1, 2, 0).numpy(), coloured(labels[shown])])
        for name, arm in arms.items():
            answers = [answer(arm.net, image) for image, _ in pictures]
            scores[name][kind] = miou(reduce(add, map(agreement, labels, answers)))
            rows[-1].append(coloured(answers[shown]))
    columns = ["picture", "label, black is ignored", *(f"trained: {name}" for name in arms)]
    write_png(out, grid(rows, list(VAL_POLICIES), columns, 480))
    return scores


def run(data: Path | None, plan: Plan, out: Path) -> dict[str, Arm]:
    """Train both nets and print what was found."""
    with tempfile.TemporaryDirectory() as folder:
        train_scene, val = scenes(data, plan, Path(folder))
        net = fresh_net(plan)
        policies = {"clear": CLEAR, "weather": wa.WeatherPolicy()}
        arms = {name: arm_of(net, train_scene, p, plan) for name, p in policies.items()}
        print(
            f"{len(train_scene.keys)} pictures, crops {plan.crop[0]} x {plan.crop[1]}, batch "
            f"{plan.batch}; a net of {sum(p.numel() for p in net.parameters()):,} weights; "
            f"threads: {torch.get_num_threads()}, workers: {plan.workers}; "
            f"{plan.iterations} iterations, on {os.cpu_count()} cores under a load of "
            f"{os.getloadavg()[0]:.1f}"
        )
        train(arms, plan)
        for name, arm in arms.items():
            first, last = (np.mean(arm.losses[part]) for part in (slice(10), slice(-10, None)))
            print(
                f"{name:8s} {median(arm.per_s):6.2f} iterations/s (its loader alone "
                f"{loader_per_s(arm, plan):6.2f}), loss {first:.2f} -> {last:.2f}"
            )
        found = cost(arms)
        verdict = "met" if found <= MOST_COST else "missed"
        print(
            f"weather costs {found:.1%} of the iterations per second (<= {MOST_COST:.0%} {verdict})"
        )
        print("mIoU on held-out pictures " + "".join(f"{kind:>8s}" for kind in VAL_POLICIES))
        for name, by_kind in asked(arms, val, out).items():
            print(f"  trained: {name:16s}" + "".join(f"{v:8.3f}" for v in by_kind.values()))
    print(f"what they answer: {out}")
    return arms


def main() -> None:
    """Train as the command line asks."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path, nargs="?", help="a folder of CamVid; a street if none")
    parser.add_argument("--iterations", type=int, help="100 if not given")
    parser.add_argument("--threads", type=int, default=1, help="of the net")
    parser.add_argument("--workers", type=int, default=1, help="of each loader")
    parser.add_argument("--out", type=Path, default=Path("out/train_camvid.png"))
    parser.add_argument("--quick", action="store_true", help="go through all of it, prove nothing")
    given = parser.parse_args()
    plan = replace(QUICK if given.quick else Plan(), workers=given.workers)
    if given.iterations is not None:
        plan = replace(plan, iterations=given.iterations)
    if min(plan.workers, given.threads) < 1 or plan.iterations <= plan.settling:
        parser.error(
            f"--threads and --workers must be at least 1, --iterations more than {plan.settling}: "
            "the first ones of a turn do not count"
        )
    torch.set_num_threads(given.threads)
    run(given.data, plan, given.out)


if __name__ == "__main__":
    main()
