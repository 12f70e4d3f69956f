"""Choices of a training: what is refused, by which words, and what JSON tells of them."""

from __future__ import annotations

import json
from typing import Any

import pytest

from weather_aug.edit.diffusion.objectives import CycleWeights, PairedWeights
from weather_aug.edit.diffusion.train_options import TrainOptions
from weather_aug.errors import ArgumentError


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"steps": 0}, "steps must be an integer in 1"),
        ({"steps": 2.5}, "steps must be an integer"),
        ({"batch_size": True}, "batch_size must be an integer"),
        ({"batch_size": 4, "accumulate": 3}, "3 does not divide 4"),
        ({"objective": "gan"}, "objective 'gan' is not one of paired, epsilon, cycle"),
        ({"optimiser": "sgd"}, "not one of adamw, adamw8bit"),
        ({"mixed_precision": "fp8"}, "not one of no, fp16, bf16"),
        ({"mixed_precision": "fp16"}, 'needs a GPU; on a CPU take "no" or "bf16"'),
        ({"optimiser": "adamw8bit"}, "needs a GPU"),
        ({"device": "tpu"}, "device 'tpu' is not one of cpu, cuda"),
        ({"perceptual": "dino"}, "perceptual 'dino' is not one of"),
        ({"discriminator": "dino"}, "discriminator 'dino' is not one of"),
        ({"perceptual": "none"}, "does not go with a weight of perceptual of 5; set it to 0"),
        ({"perceptual": "none", "objective": "cycle"}, "weight of cycle_perceptual of 10"),
        ({"learning_rate": 0.0}, "learning_rate must be above 0"),
        ({"learning_rate": float("nan")}, "learning_rate must be a number"),
        ({"clip": 0}, "clip must be above 0"),
        ({"label_dropout": 1.5}, "label_dropout"),
        ({"mirrored": -0.5}, "mirrored"),
        ({"size": (512,)}, "size must be"),
        ({"size": (100, 512)}, "multiples of 8 pixels"),
        ({"styles": ()}, "at least one style"),
        ({"styles": ("rain", "rain")}, "each only once"),
        ({"styles": ("hail",)}, "style 'hail' is not one of clear, rain, snow, fog"),
        ({"conditioning": "color"}, "conditioning 'color' is not one of"),
        ({"unet_rank": 0}, "unet_rank must be in"),
        ({"threads": 0}, "threads must be"),
        ({"seed": 0.5}, "seed must be an integer"),
    ],
)
def test_what_is_no_choice_is_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ArgumentError, match=message):
        TrainOptions(**given)


def test_weights_are_those_of_the_objective() -> None:
    options = TrainOptions(objective="cycle").with_weights({"identity_l1": 3.0})
    assert options.cycle == CycleWeights(identity_l1=3.0)
    assert options.paired == PairedWeights()
    with pytest.raises(ArgumentError, match="objective paired has no weight 'cycle_l1'; it has "):
        TrainOptions().with_weights({"cycle_l1": 1.0})
    with pytest.raises(ArgumentError, match="l1"):
        TrainOptions().with_weights({"l1": -1.0})


def test_json_tells_all_that_matters() -> None:
    told = json.loads(json.dumps(TrainOptions(styles=("rain",)).as_json()))
    assert told["styles"] == ["rain"] and told["size"] == [512, 512]
    assert told["paired"] == {"epsilon": 1.0, "l1": 1.0, "perceptual": 5.0}
    assert "cycle" not in told


def test_a_distance_without_a_weight_can_be_left_out() -> None:
    weights = PairedWeights(perceptual=0.0)
    assert TrainOptions(perceptual="none", paired=weights).perceptual == "none"
    assert TrainOptions(perceptual="none", objective="epsilon").objective == "epsilon"
