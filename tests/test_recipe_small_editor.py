"""The small stand-in of the diffusion editor: its parts, a quick run, and the experiment itself."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import weather_aug

pytest.importorskip("diffusers")
pytest.importorskip("peft")

ROOT = Path(__file__).parents[1]
RECIPE = ROOT / "recipes" / "07_small_diffusion_editor.py"
TINY = dict(vae=(8, 16), unet=(32, 32), text=32)


@pytest.fixture(scope="module", autouse=True)
def recipes_on_path():
    sys.path.insert(0, str(RECIPE.parent))
    yield
    sys.path.remove(str(RECIPE.parent))


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    from small_editor.streets import street_scene

    return street_scene(tmp_path_factory.mktemp("streets"), 3, 2, 1, (48, 32))


@pytest.fixture(scope="module")
def held_out(street):
    from small_editor.measure import HeldOut

    return HeldOut.of(street)


class Painter:
    """An editor whose pictures are the targets, some share of the way."""

    name, styles, card = "painter", ("rain", "snow", "fog"), {}

    def __init__(self, street, share):
        self.street, self.share = street, share

    def edit(self, moment, style):
        goals = self.street.targets[style]
        mixed = (
            (1 - self.share) * frame.image + self.share * goals[frame.key] for frame in moment.now
        )
        return tuple(picture.round().astype(np.uint8) for picture in mixed)


def test_the_model_is_small_and_its_self_attention_has_two_resolutions():
    from small_editor.model import Sizes, fresh

    parts = fresh(Sizes(), 0)
    assert parts.parameters() <= 5_000_000
    places = {
        name.split(".attentions")[0] for name, _ in parts.unet.named_modules() if "attn1" in name
    }
    assert {"down_blocks.0", "down_blocks.1"} <= places
    assert {"down_blocks.0", "down_blocks.1"} & places != {"down_blocks.0"}


def test_networks_are_those_of_their_seed():
    from small_editor.model import Sizes, fresh

    state = torch.get_rng_state()
    a, b, other = (fresh(Sizes(**TINY), seed).unet.conv_in.weight for seed in (1, 1, 2))
    assert torch.equal(a, b)
    assert not torch.equal(a, other)
    assert torch.equal(state, torch.get_rng_state())


def test_a_target_is_a_background_only():
    from small_editor.streets import STYLES, target_weather

    for style in STYLES:
        weather = target_weather(style)
        assert weather.rain_mm_per_h == weather.snow_mm_per_h == weather.lamps == 0
        assert weather.spray_per_km == weather.mist_per_km == 0
    assert np.isfinite(target_weather("fog").visibility_m)
    assert np.isinf(target_weather("rain").visibility_m)


def test_pictures_are_listed_with_their_labels_and_held_out_ones_are_not_trained_on(
    street, tmp_path
):
    from small_editor.streets import STYLES, write_list, write_pictures

    assert write_pictures(tmp_path / "pairs", [street], "train") == 6
    assert write_pictures(tmp_path / "pairs", [street], "test") == 6
    # Two pictures of equal bytes would be a leak; here only the list is looked at.
    listed = write_list(tmp_path / "pairs", tmp_path / "pairs.jsonl")
    counts = listed.counts()
    assert counts == {("clear", "train"): 6} | {
        (style, split): 6 for style in STYLES for split in ("train", "test")
    }
    assert all(pair.aligned and pair.source_label for pair in listed.pairs)
    assert all(p.source == p.target for p in listed.pairs if p.style == "clear")


def test_pre_training_lowers_what_it_is_to_lower_and_writes_a_base(street, tmp_path):
    from small_editor.model import Sizes
    from small_editor.pretrain import CARD, Schedule, read_pictures, small_model
    from small_editor.streets import write_pictures

    from weather_aug.edit.diffusion.base import load_base

    write_pictures(tmp_path / "pairs", [street], "train")
    pictures = read_pictures(tmp_path / "pairs")
    assert len(pictures.styles) == 4 * 6
    assert pictures.images.shape[1:] == (3, 32, 48)
    schedule = Schedule(vae_steps=2, unet_steps=2, batch=2, crop_px=(16, 16))
    folder = small_model(
        tmp_path / "base", pictures, sizes=Sizes(**TINY), schedule=schedule, seed=1
    )
    base = load_base(str(folder))
    assert base.factor == 2
    assert "stand-in" in (folder / CARD).read_text("utf-8")
    again = small_model(
        tmp_path / "again", pictures, sizes=Sizes(**TINY), schedule=schedule, seed=1
    )
    assert load_base(str(again)).digest == base.digest


def test_what_is_measured_falls_on_the_way_to_the_target(held_out):
    from small_editor.measure import mean, measured_row

    rows = [measured_row([held_out], Painter(held_out, share)) for share in (0.0, 0.5, 1.0)]
    clear = measured_row([held_out], None)
    for measure in ("L1", "statistics"):
        for style in ("rain", "snow", "fog"):
            found = [mean(row, measure, style) for row in rows]
            assert found[0] == mean(clear, measure, style)
            assert found[0] > found[1] > found[2] == 0


def test_a_difference_counts_streets_and_not_pictures(held_out):
    from small_editor.measure import Measured, difference

    def row(*means):
        return {
            (f"street-{i}", "rain"): Measured({"L1": value + np.array([-1e-3, 1e-3])})
            for i, value in enumerate(means)
        }

    off = difference([row(1.0, 2.0, 3.0)], [row(0.5, 2.5, 2.0)], "L1")
    each = np.array([0.5, -0.5, 1.0])
    assert off.mean == pytest.approx(each.mean())
    assert off.error == pytest.approx(each.std(ddof=1) / np.sqrt(3))
    assert off.better == pytest.approx(1 / 3)
    # More pictures of the same streets say nothing more.
    twice = difference([row(1.0, 2.0, 3.0)] * 2, [row(0.5, 2.5, 2.0)] * 2, "L1")
    assert twice.error == pytest.approx(off.error)


def run(out, *words, timeout):
    return subprocess.run(
        [sys.executable, str(RECIPE), "--out", str(out), *words],
        cwd=out.parent,
        env=os.environ | {"PYTHONPATH": str(Path(weather_aug.__file__).parents[1])},
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )


def test_a_quick_run_goes_through_all_of_it(tmp_path):
    done = run(tmp_path / "out", "--quick", timeout=300)
    assert done.returncode == 0, done.stderr
    for name in ("clear", "self-attention", "+ both (release)", "without labels"):
        assert name in done.stdout
    assert (tmp_path / "out" / "sheet.png").is_file()


@pytest.mark.slow
def test_the_experiment_holds(tmp_path):
    """Each style comes nearer to its target than the clear picture is, in L1 and in statistics."""
    spec = importlib.util.spec_from_file_location("small_editor_recipe", RECIPE)
    recipe = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(recipe)
    plan = recipe.Plan()
    streets = recipe.prepared(plan, tmp_path)
    rows = recipe.measured_all(plan, tmp_path, streets, 1)
    from small_editor.measure import mean

    for style in ("rain", "snow", "fog"):
        for measure in ("L1", "statistics"):
            edited, clear = (mean(rows[n][0], measure, style) for n in ("self-attention", "clear"))
            assert edited < 0.9 * clear
    assert mean(rows["self-attention"][0], "L1") < mean(rows["without labels"][0], "L1")
