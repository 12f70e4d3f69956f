"""The loader benchmark: equal tasks, ratios the right way up, and its table in the README."""

import json
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.utils.data import Dataset

from benchmarks import loader, readme_table, sample
from benchmarks.loader import OURS, PLAIN, THEIRS_ON_CROP, THEIRS_ON_WHOLE, WITHOUT_SCENE
from benchmarks.readme_table import CLOSING, NAMES, OPENING, table, with_table
from weather_aug.errors import DataError

README = Path(__file__).parents[1] / "README.md"


@pytest.fixture(scope="module")
def contenders():
    """On a picture a quarter as wide and high."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (loader, sample):
            patch.setattr(module, "HEIGHT", 256)
            patch.setattr(module, "WIDTH", 512)
            patch.setattr(module, "CROP", 128)
        with loader.one_frame_scene() as scene:
            yield loader.contenders(scene)


def test_all_give_the_same_kind_of_sample(contenders):
    assert list(contenders) == [PLAIN, OURS, WITHOUT_SCENE, THEIRS_ON_CROP, THEIRS_ON_WHOLE]
    for name, dataset in contenders.items():
        image, label = dataset[3]
        assert (image.shape, image.dtype) == ((3, 128, 128), torch.uint8), name
        assert (label.shape, label.dtype) == ((128, 128), torch.int64), name
        assert image.is_contiguous()
        assert len(dataset) == loader.SAMPLES


def test_a_sample_hangs_on_its_epoch_and_number(contenders):
    for name, dataset in contenders.items():
        epochs = []
        for epoch in (0, 1, 0):
            dataset.set_epoch(epoch)
            epochs.append([dataset[k] for k in (1, 0)])
        for (first, _), (again, _) in zip(epochs[0], epochs[2], strict=True):
            assert torch.equal(first, again), name
        assert not torch.equal(epochs[0][0][0], epochs[0][1][0]), name
        assert not torch.equal(epochs[0][0][0], epochs[1][0][0]), name


def test_pictures_are_weathered_equally_often(contenders):
    """The crops of albumentations' pipelines are those of the plain one, so that weather shows."""
    count = 60
    plain = [contenders[PLAIN][k][0] for k in range(count)]
    shares = {}
    for name in (WITHOUT_SCENE, THEIRS_ON_CROP, THEIRS_ON_WHOLE):
        changed = (contenders[name][k][0] != plain[k] for k in range(count))
        shares[name] = sum(bool(each.any()) for each in changed) / count
    draws = [loader.POLICY.draw(0, 0, k).kind for k in range(400)]
    shares[OURS] = np.mean([kind != "clear" for kind in draws])
    assert loader.WEATHERED == 0.75
    assert shares == pytest.approx(dict.fromkeys(shares, loader.WEATHERED), abs=0.17)


class Sleeping(Dataset):
    """Samples that take a known time."""

    def __init__(self, seconds):
        self.seconds = seconds

    def set_epoch(self, epoch):
        pass

    def __len__(self):
        return loader.SAMPLES

    def __getitem__(self, index):
        time.sleep(self.seconds)
        return torch.zeros(1)


def test_the_slower_loader_has_the_lower_ratio(monkeypatch):
    monkeypatch.setattr(loader, "TURN_S", 0.01)
    per_s = loader.rates({PLAIN: Sleeping(0.02), OURS: Sleeping(0.08)}, rounds=2)
    assert [len(values) for values in per_s.values()] == [2, 2]
    # Two workers, and starting them does not count.
    assert 20 < np.median(per_s[OURS]) <= 2 / 0.08 * 1.05
    assert loader.ratios(per_s)[OURS] < 0.5


def test_ratios_are_of_one_round():
    """A machine that gets twice as slow in one round changes no ratio."""
    per_s = {PLAIN: [100.0, 50.0, 100.0], OURS: [80.0, 40.0, 80.0]}
    assert loader.ratios(per_s) == {PLAIN: 1.0, OURS: pytest.approx(0.8)}


def results(**changed):
    per_s = {name: [20.0 / (k + 1)] * 3 for k, name in enumerate(NAMES)} | changed
    machine = {"cpu": "A CPU", "versions": {"albumentations": "2.0.8"}}
    return {"machine": machine, "results": {"loader": {"samples_per_s": per_s}}}


def ratios_in(text):
    """Ratio by name of a README's table, which is refused if it is not well-formed."""
    between = text.split(OPENING)[1].split(CLOSING)[0]
    rows = [line for line in between.splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    assert {len(row) for row in cells} == {2}
    assert cells[1] == ["---", "---:"]
    found = {name: value for name, value in cells[2:]}
    assert list(found) == list(NAMES.values())
    assert all(value.endswith(" ×") for value in found.values())
    values = {name: float(value.removesuffix(" ×")) for name, value in found.items()}
    assert values["no weather"] == 1.0
    assert all(0 < value < 2 for value in values.values())
    assert between.strip().endswith("by benchmarks/loader.py.")
    return values


def test_the_readme_has_a_table():
    text = README.read_text(encoding="utf-8")
    if OPENING not in text:
        pytest.skip("the README has no place for the table")
    ratios_in(text)


def test_the_table_says_what_was_measured(contenders):
    assert set(NAMES) == set(contenders)
    text = with_table(f"{OPENING}{CLOSING}", table(results()))
    assert list(ratios_in(text).values()) == [1.0, 0.5, 0.33, 0.25, 0.2]


@pytest.mark.parametrize(
    ("old", "new"),
    [("| 1.00 × |", "| 1.00 |"), ("| no weather |", "| no | weather |"), ("0.50", "5.0")],
)
def test_a_broken_table_is_seen(old, new):
    text = with_table(f"{OPENING}{CLOSING}", table(results()))
    assert old in text
    with pytest.raises(AssertionError):
        ratios_in(text.replace(old, new))


outside = st.text(max_size=80).filter(lambda text: "<!--" not in text)


@given(outside, outside, outside)
def test_writing_again_changes_nothing_and_the_rest_stays(before, old, after):
    text = f"{before}{OPENING}{old}{CLOSING}{after}"
    once = with_table(text, "| a |")
    assert once == f"{before}{OPENING}\n| a |\n{CLOSING}{after}"
    assert with_table(once, "| a |") == once
    assert with_table(before, "| a |") == before


@pytest.mark.parametrize(
    "text", [OPENING, CLOSING, CLOSING + OPENING, f"{OPENING}{CLOSING}{OPENING}{CLOSING}"]
)
def test_markers_that_do_not_match_are_refused(text):
    with pytest.raises(DataError, match="once each, in order"):
        with_table(text, "| a |")


def test_the_script_writes_once(tmp_path, capsys):
    readme, found = tmp_path / "README.md", tmp_path / "results.json"
    found.write_text(json.dumps(results()), encoding="utf-8")
    readme.write_text(f"# A\n\n{OPENING}\nold\n{CLOSING}\n\nB\n", encoding="utf-8")
    readme_table.main(readme, found)
    first, when = readme.read_text(encoding="utf-8"), readme.stat().st_mtime_ns
    assert ratios_in(first)
    assert "old" not in first
    readme_table.main(readme, found)
    assert (first, when) == (readme.read_text(encoding="utf-8"), readme.stat().st_mtime_ns)
    readme.write_text("# A\n", encoding="utf-8")
    readme_table.main(readme, found)
    assert readme.read_text(encoding="utf-8") == "# A\n"
    assert "nothing written" in capsys.readouterr().out


@pytest.mark.parametrize("found", [{}, results(more=[1.0]), {"results": {"loader": {}}}])
def test_results_of_other_loaders_are_refused(found):
    with pytest.raises(DataError, match="run make bench"):
        table(found)
