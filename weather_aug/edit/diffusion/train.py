"""Train an adapter on pairs of pictures; interrupted work is taken up where it stopped."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from tqdm.auto import tqdm

from weather_aug import _files
from weather_aug._extras import require
from weather_aug._png import png_bytes
from weather_aug.edit.diffusion import samples, train_state
from weather_aug.edit.diffusion.adapter_files import TRAINED_ON_SHA256, save_adapter
from weather_aug.edit.diffusion.base import Base, load_base
from weather_aug.edit.diffusion.leakage import TrainedOn
from weather_aug.edit.diffusion.learner import Learner
from weather_aug.edit.diffusion.pair_data import PairImages
from weather_aug.edit.diffusion.pairs import PairList, read_pairs
from weather_aug.edit.diffusion.train_batches import (
    batches,
    collated,
    counts_of,
    digest_of_pairs,
)
from weather_aug.edit.diffusion.train_batches import chosen as chosen_pairs
from weather_aug.edit.diffusion.train_options import TrainOptions
from weather_aug.errors import ArgumentError, printable

TO = "train an adapter"
VERSION = 1
RECENT = 100
"""Steps at the end of a training whose mean losses a report tells."""


@dataclass(frozen=True, eq=False)
class Report:
    """What a training made."""

    folder: Path
    """Of the adapter: see `adapter_files`; beside it losses.jsonl and samples/."""
    steps: int
    resumed_at: int
    """Steps that an earlier call had done; 0 if there was none."""
    pairs: Mapping[str, int]
    """That were trained on, by style."""
    losses: Mapping[str, float]
    """Means over the last `RECENT` steps."""
    validation: Mapping[str, Mapping[str, float]]
    """Last losses on pairs that were held out, by style; empty if the list has none."""
    sample: Path
    """Grid of pictures at the end: clear, edited, target."""


def train_editor(
    pairs: Path,
    base: str,
    out: Path,
    options: TrainOptions,
    *,
    restart: bool = False,
    progress: bool = True,
) -> Report:
    """Train an adapter, and write it to the folder `out`, which appears only when it is complete.

    Only pairs of the split "train" are trained on; the list is refused if one of their pictures is
    held out as well. Everything that is drawn depends on (seed, step) alone. Work in progress
    stands in `out` + ".training"; the same call again continues it, and on a CPU ends in the bytes
    of a training that was never cut short.

    Args:
        pairs: List that `pairs.write_pairs` wrote.
        base: Folder of a model in the diffusers layout, or the id of one in the local cache.
        out: Folder to make for the adapter.
        options: How to train.
        restart: Drop unfinished work that stands beside `out`.
        progress: Show a bar with losses and rate.

    Returns:
        What was made, and how well it does.

    Raises:
        ArgumentError: If a style has no pairs, or a loss is no longer a number: the learning rate
            is too high.
        ConflictError: If `out` exists, another process trains into it, or unfinished work beside
            it is of another training: says what differs.
        DataError: If list, pictures or base cannot be read, or a held-out picture is trained on.
        IntegrityError: If a picture is not the one that was listed.
        MissingExtraError: If diffusers, peft or accelerate (or bitsandbytes for "adamw8bit") is not
            installed.
        OutputError: If the folder cannot be written.
    """
    require("accelerate", extra="edit", to=TO)
    chosen = chosen_pairs(read_pairs(Path(pairs)), options)
    with train_state.held(Path(out)) as work, _threads(options.threads):
        loaded = load_base(base)
        _check_size(options, loaded)
        train_state.begin(work, _job(chosen, loaded, options), restart=restart)
        done = options.steps
        if not train_state.is_finished(work):
            with accelerated(options) as accelerator:
                training = _Training(chosen, loaded, work, options, accelerator)
                done = training.run(progress=progress)
        report = _report(chosen, work, Path(out), done)
        train_state.publish(work, work.with_name(work.name.removesuffix(train_state.WORK_SUFFIX)))
    return report


class _Training:
    """The loop: batches in, an adapter out."""

    def __init__(
        self,
        pair_list: PairList,
        base: Base,
        work: Path,
        options: TrainOptions,
        accelerator: Any,
    ) -> None:
        self.pair_list, self.work, self.options = pair_list, work, options
        self.accelerator = accelerator
        self.learner = Learner(base, pair_list.selected("train").styles, options, accelerator)
        held_out = [pair for pair in pair_list.pairs if pair.split == "val"]
        self.held_out = replace(pair_list, pairs=tuple(held_out)) if held_out else None

    def run(self, *, progress: bool) -> int:
        """Train to the end and write the adapter into the work; steps done before."""
        options = self.options
        state = train_state.load(self.work)
        done = 0
        if state is not None:
            self.learner.load(state)
            done = state.head["step"]
        train_state.cut_log(self.work, done)
        bar = tqdm(
            total=options.steps, initial=done, desc="train", unit="step", disable=not progress
        )
        with bar:
            steps = batches(self.pair_list, options, first_step=done)
            for step, batch in enumerate(steps, start=done):
                entry = self.learner.step(step, batch)
                train_state.add_to_log(self.work, entry)
                bar.set_postfix({"style": batch["style"], **_shown(entry["losses"])})
                bar.update()
                self._look(step + 1)
        self._write()
        return done

    def _look(self, step: int) -> None:
        """What is due after a step: validation, samples, the state on disk."""
        options = self.options
        last = step == options.steps
        if self.held_out is not None and (last or _due(step, options.validate_every)):
            losses = self._validated(self.held_out)
            train_state.add_to_log(self.work, {"step": step, "validation": losses})
        if last or _due(step, options.sample_every):
            path = self.work / train_state.SAMPLES / sample_name(step)
            _files.write_whole(path, png_bytes(self._grid()))
        if last or _due(step, options.save_every):
            train_state.sync_log(self.work)
            train_state.save(self.work, *self.learner.state(step))

    def _validated(self, held_out: PairList) -> dict[str, dict[str, float]]:
        """Mean losses by style on the first pairs that are held out."""
        found = {}
        for number, style in enumerate(held_out.styles):
            if style not in self.learner.model.spec.styles:
                continue
            images = PairImages(held_out, self.options.size, split="val", style=style)
            count = min(len(images), self.options.validate_count)
            sums: Counter[str] = Counter()
            for index in range(count):
                losses = self.learner.judged(collated([images[index]]), number, index)
                sums.update(losses)
            found[style] = {name: total / count for name, total in sums.items()}
        return found

    def _grid(self) -> Any:
        """One pair of each style: held out if the list has one, else trained on."""
        rows = []
        for style in self.learner.model.spec.styles:
            counts = self.pair_list.counts()
            split = "val" if counts.get((style, "val")) else "train"
            if not counts.get((style, split)):
                continue
            item = PairImages(self.pair_list, self.options.size, split=split, style=style)[0]
            edited = samples.edited(self.learner.model, item["source"], item["source_label"], style)
            clear, shown, target = (
                samples.picture_of(one) for one in (item["source"], edited, item["target"])
            )
            rows.append(samples.Row(style, clear, shown, target, item["aligned"]))
        return samples.grid(rows)

    def _write(self) -> None:
        """The adapter's files, its card last."""
        options = self.options
        validations = [
            entry["validation"]
            for entry in train_state.read_log(self.work)
            if "validation" in entry
        ]
        trained_on = TrainedOn.of(self.pair_list)
        trained_on.write(self.work)
        save_adapter(
            self.learner.model,
            self.work,
            training={
                "objective": options.objective,
                "steps": options.steps,
                "options": options.as_json(),
                "pair_list": self.pair_list.name,
                "pairs_sha256": digest_of_pairs(self.pair_list),
                "pairs": counts_of(self.pair_list),
                TRAINED_ON_SHA256: _files.sha256_of(trained_on.as_bytes()),
                "validation": validations[-1] if validations else {},
                "torch": torch.__version__,
            },
        )


def sample_name(step: int) -> str:
    """Of the grid after a step."""
    return f"step_{step:07d}.png"


def _check_size(options: TrainOptions, base: Base) -> None:
    if any(side % base.factor for side in options.size):
        raise ArgumentError(
            f"size {options.size[0]}x{options.size[1]} must be multiples of {base.factor} pixels "
            f"for {printable(base.name)}"
        )


def _job(pair_list: PairList, base: Base, options: TrainOptions) -> dict[str, Any]:
    """All that the adapter depends on."""
    return {
        "version": VERSION,
        "options": options.as_json(),
        "pair_list": pair_list.name,
        "pairs_sha256": digest_of_pairs(pair_list),
        "base": base.name,
        "base_digest": base.digest,
    }


def _report(pair_list: PairList, work: Path, out: Path, done: int) -> Report:
    log = train_state.read_log(work)
    steps = [entry for entry in log if "losses" in entry]
    recent = steps[-RECENT:]
    sums: Counter[str] = Counter()
    counts: Counter[str] = Counter()
    for entry in recent:
        sums.update(entry["losses"])
        counts.update(dict.fromkeys(entry["losses"], 1))
    validations = [entry["validation"] for entry in log if "validation" in entry]
    last = steps[-1]["step"]
    return Report(
        folder=out,
        steps=last,
        resumed_at=done,
        pairs=counts_of(pair_list),
        losses={name: total / counts[name] for name, total in sums.items()},
        validation=validations[-1] if validations else {},
        sample=out / train_state.SAMPLES / sample_name(last),
    )


def _due(step: int, every: int) -> bool:
    return every > 0 and step % every == 0


def _shown(losses: Mapping[str, float]) -> dict[str, str]:
    return {name: f"{value:.3g}" for name, value in losses.items()}


@contextmanager
def _threads(count: int | None) -> Iterator[None]:
    """Let torch compute with as many threads, inside the block."""
    before = torch.get_num_threads()
    try:
        if count is not None:
            torch.set_num_threads(count)
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def accelerated(options: TrainOptions) -> Iterator[Any]:
    """An accelerator of its own.

    Its library keeps one state a process, by which later callers with another precision would be
    refused.
    """
    accelerate = require("accelerate", extra="edit", to=TO)
    state = require("accelerate.state", extra="edit", to=TO)
    if options.device == "cuda" and not torch.cuda.is_available():
        raise ArgumentError('device "cuda": torch finds no GPU; take device "cpu"')
    ours = not state.is_initialized()
    try:
        try:
            accelerator = accelerate.Accelerator(
                cpu=options.device == "cpu",
                mixed_precision=options.mixed_precision,
                gradient_accumulation_steps=options.accumulate,
            )
        except ValueError as error:
            raise ArgumentError(f"accelerate refuses: {printable(error, 300)}") from None
        if accelerator.num_processes > 1:
            raise ArgumentError(
                f"training runs in one process, accelerate started {accelerator.num_processes}; "
                "run it without `accelerate launch`"
            )
        yield accelerator
    finally:
        if ours:
            state.AcceleratorState._reset_state(reset_partial_state=True)
