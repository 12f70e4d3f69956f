"""The small HRDA and MIC: its parts, what arms have in common, and a quick run of all of it."""

import os
import random
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import weather_aug
from weather_aug.clip.types import FrameKey
from weather_aug.errors import ConflictError
from weather_aug.taxonomy import IGNORE
from weather_aug.view.sheet import write_png

for name in ("albumentations", "safetensors", "transformers"):
    pytest.importorskip(name)

ROOT = Path(__file__).parents[1]
RECIPE = ROOT / "recipes" / "train_uda.py"
CAMVID = Path(os.environ.get("WEATHER_AUG_DATA", ROOT / ".." / "shared" / "data")) / "camvid-dev"
sys.path.insert(0, str(RECIPE.parent))
import train_uda  # noqa: E402
from uda import frames, method  # noqa: E402

sys.path.remove(str(RECIPE.parent))

TINY = method.Method(
    iterations=6, alone=0, crop_px=64, batch=2, block_px=4, widths=(8, 8, 16, 16), head=8
)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def batch_of(seed, size=64):
    """Source, labels with some ignored, target, and the truth about it."""
    generator = seeded(seed)
    pictures = torch.randint(256, (2, 2, 3, size, size), generator=generator, dtype=torch.uint8)
    label = torch.randint(5, (2, size, size), generator=generator)
    label[:, :4] = IGNORE
    return pictures[0], label, pictures[1], label.flip(0)


@pytest.fixture
def stood(monkeypatch):
    """What a step learns from: names of views → (pictures, labels, weights), in order."""
    seen = []
    whole = method.entropy

    def entropy(scores, label, weight):
        seen.append((label, weight))
        return whole(scores, label, weight)

    monkeypatch.setattr(method, "entropy", entropy)
    return seen


# The network


def test_networks_are_those_of_their_seed():
    state = torch.get_rng_state()
    one, same, other = (method.Network(TINY, seed).state_dict() for seed in (1, 1, 2))
    assert all(torch.equal(one[name], same[name]) for name in one)
    assert not all(torch.equal(one[name], other[name]) for name in one)
    assert torch.equal(state, torch.get_rng_state())


class Features(torch.nn.Module):
    """An encoder that tells, in place of what it saw, whether it saw the context or details."""

    def forward(self, pictures):
        self.calls = getattr(self, "calls", 0) + 1
        plane = torch.full((len(pictures), 19, *(n // 4 for n in pictures.shape[-2:])), self.calls)
        return SimpleNamespace(hidden_states=plane.float())


class Trust(torch.nn.Module):
    """Attention that is as sure of details everywhere."""

    def __init__(self, trusted):
        super().__init__()
        self.trusted = trusted

    def forward(self, features):
        return torch.full_like(features, self.trusted)


def marked(trusted):
    """Context scores are 1, details 2."""
    network = method.Network(TINY, 0)
    network.encoder, network.head = Features(), torch.nn.Identity()
    network.attention = Trust(trusted)
    return network


@pytest.mark.parametrize(("trusted", "inside"), [(50.0, 2.0), (-50.0, 1.0), (0.0, 1.5)])
def test_details_are_fused_where_they_are_and_trusted(trusted, inside):
    box = (slice(8, 24), slice(0, 16))
    fused, (detail,) = marked(trusted)(torch.zeros(1, 3, 32, 32), [box])
    assert detail.shape == (1, 19, 4, 4)
    assert fused.shape == (1, 19, 8, 8)
    outside = fused.clone()
    outside[..., 2:6, :4] = 1
    assert torch.equal(outside, torch.ones_like(fused))
    assert torch.allclose(fused[..., 2:6, :4], torch.tensor(inside))
    # Boxes over each other are averaged, and the whole is covered.
    whole = marked(trusted).whole(torch.zeros(1, 3, 64, 64))
    assert whole.shape == (1, 19, 64, 64)
    assert torch.allclose(whole, torch.tensor(inside))


def test_windows_cover_pictures_half_over_each_other():
    """Sides that no window divides are covered too; a picture of one window's size has one."""
    times = torch.zeros(80, 112)
    for box in method.windows((80, 112), 64):
        assert times[box].shape == (64, 64)
        times[box] += 1
    assert times.min() == 1
    assert len(method.windows((80, 112), 64)) == 2 * 3
    assert method.windows((64, 64), 64) == [(slice(0, 64), slice(0, 64))]


def test_each_head_learns():
    network = method.Network(TINY, 0)
    pictures = torch.randn(1, 3, 64, 64, generator=seeded())
    fused, _ = network(pictures, [(slice(0, 32), slice(8, 40))])
    fused.square().sum().backward()
    assert all(p.grad is not None for p in network.parameters())
    for part in (network.encoder, network.head, network.attention):
        assert sum(p.grad.abs().sum() for p in part.parameters()) > 0


# The step


def test_the_teacher_averages_its_students():
    """First a copy, then min(1 - 1 / (step + 1), average) of itself, as the trainers have it."""
    learner = method.Learner(replace(TINY, average=0.6), 0)
    expected = None
    for step in range(4):
        student = [p.detach().clone() for p in learner.student.parameters()]
        kept = min(1 - 1 / (step + 1), 0.6)
        old = expected or student
        expected = [kept * a + (1 - kept) * b for a, b in zip(old, student, strict=True)]
        learner.step(step, *batch_of(step))
        teacher = list(learner.teacher.module.parameters())
        assert all(torch.allclose(a, b, atol=1e-6) for a, b in zip(teacher, expected, strict=True))
    assert not all(
        torch.allclose(a, b, atol=1e-6)
        for a, b in zip(teacher, learner.student.parameters(), strict=True)
    )
    learner.teacher.n_averaged.fill_(5000)
    with torch.no_grad():
        old, new = next(learner.teacher.module.parameters()), next(learner.student.parameters())
        expected = 0.6 * old + 0.4 * new
        learner.teacher.update_parameters(learner.student)
    assert torch.allclose(next(learner.teacher.module.parameters()), expected, atol=1e-7)


def test_half_the_classes_are_pasted():
    label = torch.tensor([[0, 1, 2, 2], [3, 4, 255, 255]])
    chosen = set()
    for seed in range(40):
        mask = method.class_mask(label, seeded(seed))
        classes = label[mask].unique().tolist()
        assert len(classes) == 3
        assert IGNORE not in classes
        assert torch.equal(mask, torch.isin(label, torch.tensor(classes)))
        chosen |= {tuple(classes)}
    assert len(chosen) == 10
    assert not method.class_mask(torch.full((2, 2), 255), seeded()).any()


def mixed_rightly(learner, stood, monkeypatch):
    """Whether a step learns from source pixels with their labels, else with the teacher's."""
    source, label, target, hidden = batch_of(3)
    learner.teacher.update_parameters(learner.student)
    learner.teacher.n_averaged.zero_()
    with torch.no_grad():
        scores = learner.teacher.module.whole(target).softmax(1)
    sure, pseudo = scores.max(1)
    # So sure a teacher is of some pixels, and not of the others.
    learner.method = replace(TINY, confident=sure.median().item())
    pictures = []
    monkeypatch.setattr(
        method, "augmented", lambda arm, mixed, key: pictures.append(mixed) or mixed
    )
    stood.clear()
    told = learner.step(0, source, label, target, hidden)
    (mixed,) = pictures
    pasted = (mixed == source).all(1)
    weight = (sure >= sure.median()).float().mean((1, 2), keepdim=True).expand(pseudo.shape)
    truth, counts = next(
        (t, c) for t, c in stood[2:] if t.shape[-1] == 64 and not torch.equal(t, pseudo)
    )
    return (
        torch.equal(
            mixed[(~pasted)[:, None].expand_as(mixed)], target[(~pasted)[:, None].expand_as(mixed)]
        )
        and 0.3 < pasted.float().mean() < 0.7
        and torch.equal(truth, torch.where(pasted, label, pseudo))
        and torch.allclose(counts, torch.where(pasted, 1.0, weight))
        and told["sure"] == pytest.approx(weight.mean().item())
        and told["right"]
        == pytest.approx((pseudo == hidden)[hidden != IGNORE].float().mean().item())
    )


def test_pasted_pixels_bring_their_labels_and_count_in_full(stood, monkeypatch):
    assert mixed_rightly(method.Learner(TINY, 0), stood, monkeypatch)


def test_a_mask_that_is_off_by_a_pixel_is_noticed(stood, monkeypatch):
    """A planted fault: pictures and labels are pasted in different places."""
    where = torch.where

    def shifted(mask, *values):
        return where(mask.roll(1, -1) if mask.ndim == 4 else mask, *values)

    monkeypatch.setattr(torch, "where", shifted)
    learner = method.Learner(TINY, 0)
    try:
        right = mixed_rightly(learner, stood, monkeypatch)
    except StopIteration:
        right = False
    assert not right


def hidden_share(count=300):
    masks = torch.stack([method.block_mask(64, 4, seeded(seed)) for seed in range(count)])
    blocks = masks.reshape(count, 16, 4, 16, 4)
    assert (blocks == blocks[:, :, :1, :, :1]).all()
    assert masks.dtype == torch.bool
    return 1 - masks.float().mean().item()


def test_masks_hide_their_share_of_whole_blocks(monkeypatch):
    assert hidden_share() == pytest.approx(0.7, abs=0.01)
    monkeypatch.setattr(method, "HIDDEN", 0.6)
    assert hidden_share() != pytest.approx(0.7, abs=0.01)
    # A side that is no multiple of a block's has narrower ones at its end.
    assert method.block_mask(64, 24, seeded()).shape == (64, 64)


def test_what_is_masked_is_learnt_from_the_teachers_labels(stood):
    learner = method.Learner(TINY, 0)
    learner.step(0, *batch_of(1))
    # Of each of the three views all of it and a detail.
    assert [tuple(label.shape[1:]) for label, _ in stood] == [(32, 32), (64, 64)] * 3
    masked, weight = stood[5]
    assert masked.max() < 19
    assert (weight == weight[:, :1, :1]).all()


def test_at_first_the_source_teaches_alone(stood):
    """A run of it alone is the same run without self-training: targets move no weight."""
    ends = []
    for seed in (1, 2):
        learner = method.Learner(replace(TINY, alone=6), 0)
        source, label, _, _ = batch_of(1)
        told = learner.step(0, source, label, *batch_of(seed)[2:])
        assert [*told] == ["source"]
        ends.append([p.detach().clone() for p in learner.student.parameters()])
    assert all(torch.equal(a, b) for a, b in zip(*ends, strict=True))
    assert [*method.Learner(TINY, 0).step(0, *batch_of(1))][2:] == ["source", "mixed", "masked"]


def test_the_targets_truth_teaches_nothing():
    ends = []
    for truth in (torch.zeros(2, 64, 64, dtype=torch.long), batch_of(1)[3]):
        learner = method.Learner(TINY, 0)
        learner.step(0, *batch_of(1)[:3], truth)
        ends.append([p.detach().clone() for p in learner.student.parameters()])
    assert all(torch.equal(a, b) for a, b in zip(*ends, strict=True))


def test_what_the_teacher_is_unsure_of_counts_nothing():
    """The weight of masked views is the share of pixels above the threshold, down to nothing."""
    told = [method.Learner(replace(TINY, confident=c), 0).step(0, *batch_of(1)) for c in (0.0, 1.1)]
    assert [each["sure"] for each in told] == [1.0, 0.0]
    assert told[0]["masked"] > 0 == told[1]["masked"]
    assert 0 < told[1]["mixed"] < told[0]["mixed"]


def test_a_teacher_holds_all_that_its_student_holds():
    """No running statistics: averages of weights are a whole net, in which no buffer lags."""
    assert not [*method.Network(TINY, 0).buffers()]


def test_entropy_is_a_mean_over_labelled_pixels():
    scores = torch.randn(1, 19, 2, 2, generator=seeded())
    label = torch.tensor([[[3, IGNORE], [5, 7]]])
    weight = torch.tensor([[[1.0, 9.0], [0.5, 0.0]]])
    logs = scores.log_softmax(1)
    expected = -(logs[0, 3, 0, 0] + 0.5 * logs[0, 5, 1, 0]) / 3
    assert torch.allclose(method.entropy(scores, label, weight), expected)
    nothing = torch.full_like(label, IGNORE)
    assert method.entropy(scores, nothing, weight) == 0


def test_a_step_moves_no_global_generator():
    states = torch.get_rng_state(), str(np.random.get_state()), random.getstate()  # noqa: NPY002
    method.Learner(TINY, 0).step(0, *batch_of(0))
    assert torch.equal(states[0], torch.get_rng_state())
    assert states[1:] == (str(np.random.get_state()), random.getstate())  # noqa: NPY002


# The arms


@pytest.fixture(scope="module")
def street():
    clip = weather_aug.open_clip("street:?frames=1&width=96&height=64&seed=0")
    image = clip.frame(FrameKey(0, "front")).image
    return torch.from_numpy(image.copy()).permute(2, 0, 1)[None]


def test_arms_change_pictures_each_in_its_own_way(street):
    one = {arm: frames.augmented(arm, street, 5) for arm in ("none", "weather_aug")}
    assert all(torch.equal(street, picture) for picture in one.values())
    shares = {}
    for arm in ("photometric", "albumentations", "mixed-2d"):
        pictures = [frames.augmented(arm, street, key) for key in range(60)]
        assert torch.equal(pictures[7], frames.augmented(arm, street, 7))
        shares[arm] = np.mean([not torch.equal(street, picture) for picture in pictures])
        assert all(p.shape == street.shape and p.dtype == torch.uint8 for p in pictures)
    # Changed: 1 - 0.2 * 0.5, 0.75, and 1 - 0.25 * (0.5 + 0.5 * 0.2 * 0.5).
    assert shares == pytest.approx(
        {"photometric": 0.9, "albumentations": 0.75, "mixed-2d": 0.8625}, abs=0.12
    )


def test_pictures_of_a_batch_are_changed_apart(street):
    both = frames.augmented("photometric", street.repeat(2, 1, 1, 1), 3)
    assert not torch.equal(both[0], both[1])


def veiled_share(arm):
    """Of 60 pictures those that are the clear one under as much airlight (200) everywhere."""
    ramp = torch.arange(256, dtype=torch.uint8).repeat(3, 16, 1)[None]
    count = 0
    for key in range(60):
        row = frames.augmented(arm, ramp, key)[0, 0, 0].double()
        veil = row[0] / 200
        line = torch.arange(256) * (1 - veil) + 200 * veil
        count += bool(0.19 < veil < 0.81 and (row - line).abs().max() <= 1)
    return count / 60


def test_fog_of_mixed_2d_knows_no_depth():
    # A third of those in weather, less those whose colours are jittered or blurred.
    assert veiled_share("mixed-2d") == pytest.approx(0.75 / 3 * (0.5 + 0.5 * 0.1), abs=0.1)
    assert veiled_share("mixed-2d") > 0
    assert veiled_share("albumentations") == 0


@pytest.fixture(scope="module")
def roles(tmp_path_factory):
    return frames.streets(tmp_path_factory.mktemp("streets"), 1, 96, 64)


def first(roles, arm, seed=0):
    source, target = map(next, map(iter, frames.loaders(*roles[:2], arm, seed, train_uda.QUICK)))
    return source, target


def test_arms_learn_from_the_same_places(roles):
    """Crops, orders and targets are equal; only pictures, and what weather hides, are not."""
    clear, target = first(roles, "none")
    ours, same = first(roles, "weather_aug")
    assert torch.equal(clear["label_full"], ours["label_full"])
    assert torch.equal(target["image"], same["image"])
    batches = [
        frames.loaders(*roles[:2], arm, 0, train_uda.QUICK)[0] for arm in ("none", "weather_aug")
    ]
    assert any(not torch.equal(a["image"], b["image"]) for a, b in zip(*batches, strict=True))
    other, _ = first(roles, "none", seed=1)
    assert not torch.equal(clear["image"], other["image"])


def test_no_frame_has_two_roles(roles):
    names = [scene.name for role in roles for scene in role]
    assert len(names) == len(set(names)) == 3


# The comparison


def confusion_of(right):
    """One frame of one class and 100 pixels, `right` of which are right."""
    counts = np.zeros((19, 19), np.int64)
    counts[0, 0], counts[0, 1] = right, 100 - right
    return counts


def test_the_interval_of_a_known_case():
    """IoU of one class is here the mean of frames: resampled, it is a binomial share."""
    frames_right = np.array([0, 100] * 10)
    counts = np.array([[confusion_of(right) for right in frames_right]])
    values = train_uda.resampled(counts)
    assert len(values) == 1 + train_uda.RESAMPLES
    assert values[0] == pytest.approx(0.5)
    low, high = np.percentile(values[1:], (2.5, 97.5))
    # Binomial of 20 draws with chance a half: 6 and 14 are its quantiles.
    assert (low, high) == (pytest.approx(0.3), pytest.approx(0.7))
    assert values[1:].std() == pytest.approx(np.sqrt(0.25 / 20), rel=0.05)


def test_seeds_are_resampled_too():
    counts = np.array([[confusion_of(right)] * 5 for right in (20, 60, 100)])
    values = train_uda.resampled(counts)
    assert values[0] == pytest.approx(0.6)
    assert values[1:].std() == pytest.approx(np.std([0.2, 0.6, 1.0]) / np.sqrt(3), rel=0.05)


def test_only_labelled_classes_count():
    counts = np.zeros((1, 1, 19, 19), np.int64)
    counts[0, 0, 2, 2], counts[0, 0, 2, 7], counts[0, 0, 4, 4] = 60, 40, 10
    assert train_uda.resampled(counts)[0] == pytest.approx((0.6 + 1.0) / 2)


def test_differences_are_paired():
    """An arm that is better by the same in each frame is better by that in each resample."""
    low = np.array([[confusion_of(right) for right in range(0, 80, 4)]])
    high = np.array([[confusion_of(right + 10) for right in range(0, 80, 4)]])
    gain = train_uda.resampled(high) - train_uda.resampled(low)
    assert np.allclose(gain, 0.1)
    text = train_uda.report({"mixed-2d": [low, low], "weather_aug": [high, high]}, "here")
    assert re.search(r"weather_aug - mixed-2d +0\.100 \[ 0\.100,  0\.100\]", text)
    assert "counts against photometric and mixed-2d, not against none" in text
    assert text.endswith("Weathered frames: here.")


def test_self_training_is_compared_with_its_source_alone():
    """A gain of each arm over its own run on the source; arms are not compared across the two."""
    low = np.array([[confusion_of(right) for right in range(0, 80, 4)]])
    high = np.array([[confusion_of(right + 10) for right in range(0, 80, 4)]])
    counts = {"mixed-2d": high, "mixed-2d, uda off": low, "weather_aug": low}
    text = train_uda.report({name: [each, each] for name, each in counts.items()}, "here")
    assert re.search(r"mixed-2d - mixed-2d, uda off +0\.100 \[ 0\.100,  0\.100\]", text)
    assert re.search(r"weather_aug - mixed-2d +-0\.100", text)
    assert text.count(" - ") == 2


# Trainings


class Stopped(Exception):
    pass


def trained(roles, path, arm="mixed-2d", every=2, seed=0, **changes):
    path.parent.mkdir(parents=True, exist_ok=True)
    learner = method.Learner(replace(train_uda.QUICK, **changes), seed)
    streams = frames.loaders(*roles[:2], arm, seed, train_uda.QUICK)
    train_uda.trained(learner, streams, arm, path, every)
    return learner


def equal(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def stop_after(monkeypatch, steps):
    step = method.Learner.step

    def stopping(self, done, *batch):
        if done == steps:
            raise Stopped
        return step(self, done, *batch)

    monkeypatch.setattr(method.Learner, "step", stopping)


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_a_stopped_training_ends_in_the_same_bytes(roles, tmp_path, monkeypatch, steps):
    whole = trained(roles, tmp_path / "a" / "state").tensors()
    with monkeypatch.context() as patch:
        stop_after(patch, steps)
        with pytest.raises(Stopped):
            trained(roles, tmp_path / "b" / "state")
    assert (tmp_path / "b" / "state").exists() == (steps >= 2)
    assert equal(whole, trained(roles, tmp_path / "b" / "state").tensors())
    assert (tmp_path / "a" / "state").read_bytes() == (tmp_path / "b" / "state").read_bytes()


@pytest.mark.parametrize("lost", ["exp_avg", "teacher", "batches"])
def test_a_state_without_a_part_would_end_elsewhere(roles, tmp_path, monkeypatch, lost):
    """Planted faults: the comparison above notices what a state could forget."""
    whole = trained(roles, tmp_path / "a" / "state").tensors()
    with monkeypatch.context() as patch:
        stop_after(patch, 2)
        with pytest.raises(Stopped):
            trained(roles, tmp_path / "b" / "state")
    if lost == "batches":
        load = frames.WeatherSampler.load_state_dict
        monkeypatch.setattr(
            frames.WeatherSampler,
            "load_state_dict",
            # The first batches once more, and not those that are left.
            lambda self, state: load(self, state | {"used": 0}),
        )
        with pytest.raises(ValueError, match="longer"):
            trained(roles, tmp_path / "b" / "state")
        return
    load = method.Learner.load

    def forgetting(self, tensors):
        kept = {n: torch.zeros_like(v) if lost in n else v for n, v in tensors.items()}
        load(self, kept)

    monkeypatch.setattr(method.Learner, "load", forgetting)
    assert not equal(whole, trained(roles, tmp_path / "b" / "state").tensors())


def test_arms_and_seeds_end_in_other_weights(roles, tmp_path):
    ends = [
        trained(roles, tmp_path / f"{arm}{seed}" / "state", arm, seed=seed).tensors()
        for arm, seed in [("none", 0), ("photometric", 0), ("weather_aug", 0), ("none", 1)]
    ]
    for place, one in enumerate(ends):
        assert not any(equal(one, other) for other in ends[:place])


def test_a_state_of_another_method_is_refused(roles, tmp_path):
    """Else a run with another threshold would hand back the old one's numbers."""
    trained(roles, tmp_path / "a" / "state")
    with pytest.raises(ConflictError, match=r"confident=0\.8.*another --out"):
        trained(roles, tmp_path / "a" / "state", confident=0.968)


def test_a_state_of_another_training_is_refused(roles, tmp_path):
    trained(roles, tmp_path / "a" / "state")
    with pytest.raises(ConflictError, match="seed"):
        trained(roles, tmp_path / "a" / "state", seed=1)


# All of it


def run(folder, *words):
    return subprocess.run(
        [sys.executable, str(RECIPE), "--quick", "--out", str(folder / "out"), *words],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(Path(weather_aug.__file__).parents[1])},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


@pytest.mark.slow
def test_a_quick_run_compares_and_goes_on(tmp_path):
    words = ("--augment", "mixed-2d", "weather_aug", "--seeds", "0", "--uda", "on", "off")
    done = run(tmp_path, *words)
    assert done.returncode == 0, done.stderr
    assert re.search(r"weather_aug - mixed-2d +-?\d\.\d{3} \[ ?-?\d\.\d{3}, ", done.stdout)
    assert "rendered here" in done.stdout
    states = {
        path: path.read_bytes() for path in sorted((tmp_path / "out").glob("*/state.safetensors"))
    }
    assert len(states) == 4
    assert len(list((tmp_path / "out").glob("*/predictions.png"))) == 4
    (tmp_path / "out" / "weather_aug, uda off-0" / "state.safetensors").unlink()
    again = run(tmp_path, *words)
    assert again.stdout == done.stdout
    assert {path: path.read_bytes() for path in states} == states


def test_real_pictures_take_the_place_of_rendered_ones(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(torch, "set_num_threads", lambda number: None)
    clip = weather_aug.open_clip("street:?frames=2&width=96&height=64&seed=9")
    for number, key in enumerate(clip.keys[1::3]):
        frame = clip.frame(key)
        write_png(tmp_path / f"real/rgb_anon/val/{number}_rgb_anon.png", frame.image)
        write_png(tmp_path / f"real/gt/val/{number}_gt_labelTrainIds.png", frame.label)
    given = dict(augment=("none",), out=tmp_path / "out", quick=True)
    columns = []
    acdc = f"folder:{tmp_path}/real?images=rgb_anon/val&labels=gt/val&taxonomy=train_ids"
    for validation in (None, str(tmp_path / "real"), acdc):
        train_uda.main(train_uda.Options(**given, validation=validation))
        text = capsys.readouterr().out
        columns.append(re.findall(r"\d\.\d{3} \[.*?\]", text))
        assert ("rendered here" in text) == (validation is None)
        assert validation is None or text.endswith(f"Weathered frames: {validation}.\n")
    assert columns[0][0] == columns[1][0]
    assert columns[0][1] != columns[1][1] == columns[2][1]


@pytest.mark.skipif(not CAMVID.is_dir(), reason="CamVid's development part is not on this machine")
def test_camvid_has_its_roles():
    source, target, held_out = (clips[0] for clips in frames.camvid(CAMVID))
    assert [len(clip.keys) for clip in (source, target, held_out)] == [20, 20, 20]
    assert not {k.time_index for k in source.keys} & {k.time_index for k in target.keys}
    batch, unlabelled = first([[source], [target]], "weather_aug")
    assert set(batch["label"].unique().tolist()) <= {*range(19), IGNORE}
    assert unlabelled["image"].shape == (2, 3, 64, 64)
