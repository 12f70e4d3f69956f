"""Training: what it makes, that it goes on to the bit, that it learns from nothing held out."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import pytest
import torch
from pair_folder import write_pair_folder

from weather_aug import _files
from weather_aug.edit.diffusion import learner as learner_module
from weather_aug.edit.diffusion import train, train_state
from weather_aug.edit.diffusion.adapter_files import (
    CARD,
    TRAINED_ON_SHA256,
    WEIGHTS,
    load_adapter,
    read_card,
    read_trained_on,
)
from weather_aug.edit.diffusion.base import load_base
from weather_aug.edit.diffusion.leakage import TRAINED_ON, TrainedOn
from weather_aug.edit.diffusion.learner import Learner
from weather_aug.edit.diffusion.pairs import PairList, read_pairs, write_pairs
from weather_aug.edit.diffusion.train import Report, train_editor
from weather_aug.edit.diffusion.train_batches import batches
from weather_aug.edit.diffusion.train_options import TrainOptions
from weather_aug.errors import ArgumentError, ConflictError, DataError

OPTIONS = TrainOptions(
    steps=5,
    batch_size=1,
    size=(32, 48),
    unet_rank=2,
    vae_rank=2,
    learning_rate=1e-3,
    warm_up=2,
    save_every=2,
    sample_every=2,
    validate_every=2,
    validate_count=1,
    threads=1,
)


STYLES = ("rain", "snow")


@dataclass(frozen=True)
class Made:
    """A training that was never cut short."""

    report: Report
    pairs: Path
    base: Path


@pytest.fixture(scope="module")
def made(small_base: Path, tmp_path_factory: pytest.TempPathFactory) -> Made:
    folder = tmp_path_factory.mktemp("training")
    pairs = write_pair_folder(folder / "pairs", styles=STYLES)
    report = train_editor(pairs, str(small_base), folder / "out", OPTIONS, progress=False)
    return Made(report, pairs, small_base)


@pytest.fixture(scope="module")
def cut_short(made: Made, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where a training stopped before its fourth step; the state on disk is of the second."""
    out = tmp_path_factory.mktemp("cut") / "out"
    learn = Learner.step

    def stopped(self: Learner, number: int, batch: Any) -> Any:
        if number == 3:
            raise KeyboardInterrupt
        return learn(self, number, batch)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Learner, "step", stopped)
        train_editor(made.pairs, str(made.base), out, OPTIONS, progress=False)
    assert [path.name for path in out.parent.iterdir()] == ["out.training"]
    return out.parent


@pytest.fixture
def out(cut_short: Path, tmp_path: Path) -> Path:
    """Of a training that was cut short, to go on with."""
    shutil.copytree(cut_short, tmp_path / "run")
    return tmp_path / "run" / "out"


def content(folder: Path) -> dict[str, str]:
    """Digest of each file below a folder."""
    return {
        str(path.relative_to(folder)): _files.sha256_of_file(path)
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_what_is_made(made: Made) -> None:
    folder = made.report.folder
    assert set(content(folder)) == {
        WEIGHTS,
        CARD,
        TRAINED_ON,
        train_state.JOB,
        train_state.LOG,
        *(f"samples/{train.sample_name(step)}" for step in (2, 4, 5)),
    }
    card = read_card(folder)
    assert card.spec == OPTIONS.spec(STYLES)
    told = card.training
    assert (told["objective"], told["steps"]) == ("paired", OPTIONS.steps)
    assert told["options"] == json.loads(json.dumps(OPTIONS.as_json()))
    assert told["pairs"] == dict.fromkeys(STYLES, 1)
    assert told["pairs_sha256"] == train.digest_of_pairs(read_pairs(made.pairs))
    assert set(told["validation"]) == set(STYLES)
    model = load_adapter(folder, load_base(str(made.base)))
    assert max(float(tensor.abs().max()) for tensor in model.trained().values()) > 0

    root = made.pairs.parent
    trained_on = read_trained_on(folder, card)
    assert trained_on is not None and trained_on == TrainedOn.read(folder)
    assert told[TRAINED_ON_SHA256] == _files.sha256_of_file(folder / TRAINED_ON)
    assert trained_on.overlap([root / "snow_0.png"]) == [root / "snow_0.png"]
    assert trained_on.overlap([root / "snow_1.png", root / "clear_1.png"]) == []

    log = train_state.read_log(folder)
    assert [entry["step"] for entry in log if "losses" in entry] == [1, 2, 3, 4, 5]
    assert sorted(entry["style"] for entry in log[:2]) == sorted(STYLES)
    assert [entry["step"] for entry in log if "validation" in entry] == [2, 4, 5]
    assert made.report.steps == 5 and made.report.resumed_at == 0
    assert made.report.sample.is_file()
    assert cv2.imread(str(made.report.sample)).shape == (2 * (22 + 128 + 4), 3 * 196 - 4, 3)


def test_cut_short_it_goes_on_to_the_bit(made: Made, out: Path) -> None:
    """The third step, done once already, is done and logged again from the second's state."""
    report = train_editor(made.pairs, str(made.base), out, OPTIONS, progress=False)
    assert report.resumed_at == 2
    assert content(out) == content(made.report.folder)
    assert [path.name for path in out.parent.iterdir()] == ["out"]


@pytest.mark.parametrize("fault", ["moments", "batches"])
def test_that_test_sees_what_is_not_taken_up(
    made: Made, out: Path, monkeypatch: pytest.MonkeyPatch, fault: str
) -> None:
    if fault == "moments":
        monkeypatch.setattr(learner_module, "load_optimiser", lambda *_: None)
    else:

        def from_the_start(
            pair_list: PairList, options: TrainOptions, *, first_step: int
        ) -> Iterator[Any]:
            return batches(pair_list, replace(options, steps=options.steps - first_step))

        monkeypatch.setattr(train, "batches", from_the_start)
    train_editor(made.pairs, str(made.base), out, OPTIONS, progress=False)
    assert content(out)[WEIGHTS] != content(made.report.folder)[WEIGHTS]


@pytest.mark.slow
def test_killed_at_any_moment_it_ends_in_the_same_bytes(made: Made, tmp_path: Path) -> None:
    arguments = f"{str(made.pairs)!r}, {str(made.base)!r}, {str(tmp_path / 'out')!r}"
    script = (
        "from pathlib import Path\n"
        "from test_train import OPTIONS, train_editor\n"
        f"pairs, base, out = {arguments}\n"
        "train_editor(Path(pairs), base, Path(out), OPTIONS, progress=False)\n"
    )
    tests = Path(__file__).parent
    paths = [str(tests), str(tests.parents[1]), str(tests.parents[2])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    state = tmp_path / "out.training" / train_state.STATE
    process = subprocess.Popen([sys.executable, "-c", script], env=environment)
    while process.poll() is None and not state.exists():
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    subprocess.run([sys.executable, "-c", script], env=environment, check=True)
    assert content(tmp_path / "out") == content(made.report.folder)


def test_an_adapter_that_is_whole_is_only_put_in_its_place(
    made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a kill leaves after the card was written: everything, and maybe the state."""
    out = tmp_path / "out"
    shutil.copytree(made.report.folder, tmp_path / "out.training")
    (tmp_path / "out.training" / train_state.STATE).write_bytes(b"cut sho")
    monkeypatch.setattr(train, "Learner", None)
    report = train_editor(made.pairs, str(made.base), out, OPTIONS, progress=False)
    assert report.resumed_at == OPTIONS.steps
    assert report.losses == made.report.losses
    assert content(out) == content(made.report.folder)


def test_unfinished_work_of_another_training_is_refused(made: Made, out: Path) -> None:
    before = content(out.parent)
    other = replace(OPTIONS, seed=1, learning_rate=2e-3)
    message = r"learning_rate was 0.001, is 0.002; .*seed was 0, is 1; give the same command"
    with pytest.raises(ConflictError, match=message):
        train_editor(made.pairs, str(made.base), out, other, progress=False)
    assert content(out.parent) == before

    state = out.parent / "out.training" / train_state.STATE
    state.write_bytes(state.read_bytes()[:-100])
    with pytest.raises(DataError, match="is damaged"):
        train_editor(made.pairs, str(made.base), out, OPTIONS, progress=False)

    shorter = replace(other, steps=1)
    report = train_editor(made.pairs, str(made.base), out, shorter, restart=True, progress=False)
    assert (report.steps, report.resumed_at) == (1, 0)
    assert read_card(out).training["options"]["seed"] == 1


def test_what_is_not_ours_is_left_alone(made: Made, tmp_path: Path) -> None:
    with pytest.raises(ConflictError, match="exists"):
        train_editor(made.pairs, str(made.base), made.report.folder, OPTIONS)
    strange = tmp_path / "out.training"
    strange.mkdir()
    (strange / "diary.txt").write_text("mine")
    for restart in (False, True):
        with pytest.raises(ConflictError, match="no unfinished training"):
            train_editor(made.pairs, str(made.base), tmp_path / "out", OPTIONS, restart=restart)
    assert (strange / "diary.txt").read_text() == "mine"


def test_a_training_that_saved_nothing_gives_way(tmp_path: Path) -> None:
    train_state.begin(tmp_path / "work", {"options": {"steps": 1}}, restart=False)
    train_state.begin(tmp_path / "work", {"options": {"steps": 2}}, restart=False)
    assert _files.read_json(tmp_path / "work" / train_state.JOB) == {"options": {"steps": 2}}


def test_a_leak_is_refused_before_anything_is_written(small_base: Path, tmp_path: Path) -> None:
    pairs = write_pair_folder(tmp_path / "pairs", styles=("rain", "snow"))
    listed = read_pairs(pairs)
    leaking = [
        replace(pair, split="val") if pair.style == "snow" else pair for pair in listed.pairs
    ]
    write_pairs(pairs, replace(listed, pairs=tuple(leaking)))
    # Of the style that is not learnt, but its clear picture is the same.
    options = replace(OPTIONS, styles=("rain",))
    with pytest.raises(DataError, match="are trained on"):
        train_editor(pairs, str(small_base), tmp_path / "out", options)
    assert [path.name for path in tmp_path.iterdir()] == ["pairs"]


def seen_in_batches(pairs: Path) -> bool:
    """Whether a training of 12 steps sees a picture of the split "val"."""
    listed = read_pairs(pairs)
    only = replace(listed, pairs=tuple(p for p in listed.pairs if p.split == "val"))
    held_out = next(iter(batches(_as_training(only), replace(OPTIONS, mirrored=0.0, steps=4))))
    seen = batches(listed, replace(OPTIONS, mirrored=0.0, steps=12))
    return any(torch.equal(batch["source"], held_out["source"]) for batch in seen)


def _as_training(pair_list: PairList) -> PairList:
    return replace(pair_list, pairs=tuple(replace(p, split="train") for p in pair_list.pairs))


def test_what_is_held_out_is_in_no_batch(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    assert not seen_in_batches(made.pairs)

    def all_of_them(self: PairList, split: str, style: str | None = None) -> PairList:
        return self

    monkeypatch.setattr(PairList, "selected", all_of_them)
    assert seen_in_batches(made.pairs)


def test_labels_are_withheld_as_often_as_asked(made: Made) -> None:
    listed = read_pairs(made.pairs)

    def withheld(share: float) -> list[bool]:
        options = replace(OPTIONS, steps=8, batch_size=4, label_dropout=share)
        return [
            bool((label == 255).all())
            for batch in batches(listed, options)
            for label in batch["source_label"]
        ]

    assert not any(withheld(0.0)) and all(withheld(1.0))
    assert 8 <= sum(withheld(0.5)) <= 24
    assert withheld(0.5) == withheld(0.5)


def test_a_single_style_learns(small_base: Path, tmp_path: Path) -> None:
    """The baseline of the all-in-one; without anything held out, too."""
    pairs = write_pair_folder(tmp_path / "pairs", val=0, styles=("snow",))
    options = replace(
        OPTIONS, steps=20, learning_rate=2e-3, validate_every=0, sample_every=0, save_every=20
    )
    stream = torch.random.get_rng_state()
    report = train_editor(pairs, str(small_base), tmp_path / "out", options, progress=False)
    assert torch.equal(torch.random.get_rng_state(), stream)
    assert read_card(tmp_path / "out").spec.styles == ("snow",)
    assert not report.validation
    totals = [sum(entry["losses"].values()) for entry in train_state.read_log(tmp_path / "out")]
    assert sum(totals[-5:]) < 0.7 * sum(totals[:5])


def test_what_does_not_go_with_the_pairs_is_refused(small_base: Path, tmp_path: Path) -> None:
    elsewhere = write_pair_folder(tmp_path / "elsewhere", styles=("rain",), aligned=False)
    clear = write_pair_folder(tmp_path / "clear", styles=("clear",))
    refused = [
        (elsewhere, OPTIONS, "different places"),
        (elsewhere, replace(OPTIONS, styles=("snow",)), "no pair of train and snow"),
        (clear, replace(OPTIONS, objective="cycle"), "besides clear"),
    ]
    for pairs, options, message in refused:
        with pytest.raises(ArgumentError, match=message):
            train_editor(pairs, str(small_base), tmp_path / "out", options)


def test_accelerate_is_left_as_it_was(made: Made) -> None:
    from accelerate.state import is_initialized

    assert not is_initialized()
    with train.accelerated(replace(OPTIONS, mixed_precision="bf16")) as accelerator:
        assert accelerator.mixed_precision == "bf16"
    with train.accelerated(OPTIONS) as accelerator:
        with pytest.raises(ArgumentError, match="accelerate refuses"):
            with train.accelerated(replace(OPTIONS, mixed_precision="bf16")):
                pass
        assert is_initialized() and accelerator.mixed_precision == "no"
    assert not is_initialized()
