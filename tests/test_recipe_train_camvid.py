"""The training recipe: a fair comparison, and a quick run of all of it."""

import importlib.util
import os
import subprocess
import sys
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import torch

import weather_aug as wa
from weather_aug.clip.images import read_image
from weather_aug.scores.agreement import Agreement

pytest.importorskip("transformers")

ROOT = Path(__file__).parents[1]
RECIPE = ROOT / "recipes" / "train_camvid.py"
CAMVID = Path(os.environ.get("WEATHER_AUG_DATA", ROOT / ".." / "shared" / "data")) / "camvid-dev"
ALWAYS = wa.WeatherPolicy({"rain": 1, "snow": 1, "fog": 1}, severity=(0.6, 1.0), falling=1.0)


@pytest.fixture(scope="module")
def recipe():
    spec = importlib.util.spec_from_file_location("train_camvid", RECIPE)
    module = importlib.util.module_from_spec(spec)
    # Where dataclasses look up the types of their fields.
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


@pytest.fixture(scope="module")
def plan(recipe):
    return replace(recipe.QUICK, crop=(32, 32))


@pytest.fixture
def trained(recipe, plan, tiny_scene):
    """Train two copies of one net, one for each policy; their arms."""

    def run(policies, plans=(plan, plan)):
        torch.set_num_threads(1)
        net = recipe.fresh_net(plan)
        arms = {
            name: recipe.arm_of(net, tiny_scene, policy, plan)
            for (name, policy), plan in zip(policies.items(), plans, strict=True)
        }
        recipe.train(arms, plan)
        return arms

    return run


def run(folder, *words, timeout=600):
    return subprocess.run(
        [sys.executable, str(RECIPE), *words],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )


def check_ran(done, picture):
    assert done.returncode == 0, done.stderr
    for words in ("clear ", "weather ", "iterations/s", "weather costs", "mIoU on held-out"):
        assert words in done.stdout
    scores = [line.split()[2:] for line in done.stdout.splitlines() if "trained:" in line]
    assert [len(row) for row in scores] == [4, 4]
    assert all(0 <= float(value) <= 1 for row in scores for value in row)
    sheet = read_image(picture)
    assert sheet.shape[1] > 4 * 480
    assert len(np.unique(sheet.reshape(-1, 3), axis=0)) > 1000


def test_a_quick_run_goes_through_all_of_it(tmp_path):
    check_ran(run(tmp_path, "--quick"), tmp_path / "out" / "train_camvid.png")


@pytest.mark.slow
@pytest.mark.skipif(not CAMVID.is_dir(), reason="no shared CamVid data")
def test_it_trains_on_camvid(tmp_path):
    done = run(tmp_path, str(CAMVID), "--iterations", "12", "--out", "sheet.png")
    check_ran(done, tmp_path / "sheet.png")
    assert "40 pictures, crops 256 x 256" in done.stdout


@pytest.mark.parametrize("words", [("--iterations", "3"), ("--workers", "0"), ("--threads", "0")])
def test_a_training_without_anything_to_time_is_refused(recipe, monkeypatch, capsys, words):
    monkeypatch.setattr(sys, "argv", ["train_camvid.py", *words])
    with pytest.raises(SystemExit) as ended:
        recipe.main()
    assert ended.value.code == 2
    assert "must be at least 1, --iterations more than" in capsys.readouterr().err


def test_nets_are_those_of_their_seed(recipe, plan):
    state = torch.get_rng_state()
    a, b, other = (
        next(recipe.fresh_net(replace(plan, seed=seed)).parameters()) for seed in (1, 1, 2)
    )
    assert torch.equal(a, b)
    assert not torch.equal(a, other)
    assert torch.equal(state, torch.get_rng_state())


def test_both_see_the_same_crops_in_the_same_order(recipe, plan, tiny_scene):
    """Labels are equal wherever the weather hides nothing; pictures are not."""

    def drawn(policy, plan):
        return list(islice(recipe.batches(tiny_scene, policy, plan), plan.iterations))

    clear, weather = drawn(recipe.CLEAR, plan), drawn(ALWAYS, plan)
    other_seed = drawn(ALWAYS, replace(plan, seed=1))

    def differing(a, b):
        pairs = [(x, y, y != 255) for (_, x), (_, y) in zip(a, b, strict=True)]
        return sum(int((x != y)[seen].sum()) for x, y, seen in pairs)

    assert differing(clear, weather) == 0
    assert differing(clear, other_seed) > 0
    assert all(not torch.equal(a, b) for (a, _), (b, _) in zip(clear, weather, strict=True))
    assert clear[0][0].shape == (plan.batch, 3, *plan.crop)


def test_nothing_but_the_weather_differs(trained, recipe, plan):
    """Two clear arms end with the same weights; another order of pictures would show."""
    same = trained({"clear": recipe.CLEAR, "weather": recipe.CLEAR})
    assert same["clear"].losses == same["weather"].losses
    assert len(same["clear"].losses) == plan.iterations
    weights = [arm.net.state_dict() for arm in same.values()]
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])
    unequal = trained({"clear": recipe.CLEAR, "weather": ALWAYS})
    assert unequal["clear"].losses == same["clear"].losses
    assert unequal["weather"].losses != same["clear"].losses
    planted = (plan, replace(plan, seed=plan.seed + 1))
    fault = trained({"clear": recipe.CLEAR, "weather": recipe.CLEAR}, planted)
    assert fault["clear"].losses != fault["weather"].losses


def test_training_is_deterministic(trained, recipe):
    policies = {"clear": recipe.CLEAR, "weather": ALWAYS}
    first, again = (trained(policies)["weather"] for _ in range(2))
    assert first.losses == again.losses


def test_turns_alternate_and_their_first_iterations_are_not_timed(recipe, plan, monkeypatch):
    """Each iteration takes a second of a clock of its own; settling takes a hundred."""
    now, steps = [0.0], []

    def step(arm):
        number = sum(name == arm.net for name in steps) % 5
        steps.append(arm.net)
        now[0] += 100.0 if number < plan.settling else 1.0

    monkeypatch.setattr(recipe, "step", step)
    monkeypatch.setattr(recipe.time, "perf_counter", lambda: now[0])
    arms = {name: recipe.Arm(name, None, iter(())) for name in ("a", "b")}
    recipe.train(arms, replace(plan, iterations=12, timed=2))
    assert "".join(steps) == "aaaaabbbbbbbbbbaaaaaaabb"
    assert [arm.per_s for arm in arms.values()] == [[1.0, 1.0], [1.0, 1.0]]


def test_the_cost_is_that_of_pairs_of_turns(recipe):
    """A machine that gets twice as slow in one turn slows both, and costs nothing."""
    arms = {
        "clear": recipe.Arm(None, None, iter(()), [10.0, 5.0, 10.0]),
        "weather": recipe.Arm(None, None, iter(()), [9.0, 4.5, 9.5]),
    }
    assert recipe.cost(arms) == pytest.approx(0.1)
    arms["weather"].per_s = [10.0, 5.0, 10.0]
    assert recipe.cost(arms) == 0


def test_classes_that_no_label_has_do_not_count(recipe):
    confusion = np.zeros((19, 19), np.int64)
    confusion[0, 0], confusion[0, 1], confusion[2, 2] = 3, 1, 4
    assert recipe.miou(Agreement(confusion)) == pytest.approx((3 / 4 + 1) / 2)
    assert Agreement(confusion).miou < recipe.miou(Agreement(confusion))
