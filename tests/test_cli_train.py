"""`weather-aug train-editor`: flags to options, and what is said of a training."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
import tyro
from pair_folder import write_pair_folder
from tiny_diffusion import build_tiny_sd

from weather_aug.cli import train as command
from weather_aug.cli.train import TrainEditor, parsed_weights
from weather_aug.edit.diffusion import train
from weather_aug.edit.diffusion.objectives import CycleWeights, PairedWeights
from weather_aug.edit.diffusion.train_options import TrainOptions
from weather_aug.errors import ArgumentError, ConflictError

SMALL = (
    "--size 32 48 --batch-size 1 --unet-rank 2 --vae-rank 2 --learning-rate 1e-3 --warm-up 1 "
    "--threads 1 --styles snow --save-every 1 --sample-every 0 --validate-every 0"
).split()


def parsed(arguments: list[str]) -> TrainEditor:
    return tyro.cli(TrainEditor, args=arguments)


def test_a_training_ends_with_an_adapter_and_a_picture_to_look_at(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    build_tiny_sd(Path("base"), seed=0)
    write_pair_folder(Path("pairs"), styles=("snow",))
    capsys.readouterr()
    arguments = ["pairs/pairs.jsonl", "--base", "base", "--out", "adapter", *SMALL]
    parsed([*arguments, "--steps", "2"]).run()
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "2 steps on pairs of 1 snow"
    assert said[1].startswith("losses at the end: epsilon ")
    assert said[2].startswith("held out, snow: epsilon ")
    assert said[3:] == ["adapter adapter; look at", "adapter/samples/step_0000002.png"]
    assert Path(said[4]).is_file()
    with pytest.raises(ConflictError, match="adapter exists"):
        parsed([*arguments, "--steps", "2"]).run()


def test_flags_are_options() -> None:
    needed = ["pairs.jsonl", "--base", "base", "--out", "out"]
    assert parsed(needed).options() == TrainOptions()
    assert parsed([*needed, *SMALL, "--no-skips", "--conditioning", "none"]).options() == (
        TrainOptions(
            size=(32, 48),
            batch_size=1,
            unet_rank=2,
            vae_rank=2,
            learning_rate=1e-3,
            warm_up=1,
            threads=1,
            styles=("snow",),
            save_every=1,
            sample_every=0,
            validate_every=0,
            skips=False,
            conditioning="none",
        )
    )
    cycle = parsed([*needed, "--objective", "cycle", "--weights", "cycle_l1=2"]).options()
    assert cycle.cycle == CycleWeights(cycle_l1=2.0)
    without = parsed([*needed, "--perceptual", "none", "--weights", "perceptual=0"]).options()
    assert without.paired == PairedWeights(perceptual=0.0)


def test_every_option_has_a_flag_and_every_flag_an_option() -> None:
    options = {field.name for field in fields(TrainOptions)} - {"paired", "epsilon", "cycle"}
    flags = {field.name for field in fields(TrainEditor)} - set(command._OWN)
    assert flags == options


def test_the_help_tells_the_defaults(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        parsed(["--help"])
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    for field in fields(TrainOptions):
        default: Any = field.default
        if type(default) in (int, float, str) and field.name != "clip_model":
            told = f"{default:g}".replace("e-06", "e-6") if type(default) is float else default
            assert f"{told} if not given" in shown or f"{told} (" in shown, field.name


@pytest.mark.parametrize("text", ["l1", "=1", "l1=one", "l1="])
def test_what_is_no_weight_is_refused(text: str) -> None:
    with pytest.raises(ArgumentError, match="--weights takes name=value"):
        parsed_weights((text,))


def test_a_weight_stands_once() -> None:
    assert parsed_weights(("l1=1", "epsilon=0.5")) == {"l1": 1.0, "epsilon": 0.5}
    with pytest.raises(ArgumentError, match="'l1' stands twice"):
        parsed_weights(("l1=1", "l1=2"))


def test_restart_and_progress_reach_the_training(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Any] = []

    def stopped(*arguments: Any, **named: Any) -> None:
        given.append((arguments, named))
        raise KeyboardInterrupt

    monkeypatch.setattr(train, "train_editor", stopped)
    with pytest.raises(KeyboardInterrupt):
        parsed(["pairs.jsonl", "--base", "owner/name", "--out", "out", "--restart"]).run()
    (arguments, named) = given[0]
    assert arguments == (Path("pairs.jsonl"), "owner/name", Path("out"), TrainOptions())
    assert named == {"restart": True, "progress": False}
