"""The three statistics files against the rules of the trainers that read them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_export import TinyClip

from weather_aug.scene.policy import WeatherPolicy
from weather_aug.scene.scene import WeatherScene
from weather_aug.taxonomy import TRAIN_ID
from weather_aug.writers import export as exporting
from weather_aug.writers.choices import FromPolicy
from weather_aug.writers.cityscapes import ClassStats
from weather_aug.writers.export import export
from weather_aug.writers.plan import ExportPlan, plan_export

NAMES = ("sample_class_stats.json", "sample_class_stats_dict.json", "samples_with_class.json")


def read(out: Path) -> list[Any]:
    return [json.loads((out / name).read_text()) for name in NAMES]


def rare_class_table(out: Path) -> dict[int, list[str]]:
    """Base names by class as a trainer loads them; it stops where a class has no file."""
    frequency: dict[int, int] = {}
    for row in read(out)[0]:
        del row["file"]
        for train_id, pixels in row.items():
            frequency[int(train_id)] = frequency.get(int(train_id), 0) + pixels
    with_class = {int(c): files for c, files in read(out)[2].items()}
    table = {}
    for train_id in frequency:
        files = [file for file, pixels in with_class[train_id] if pixels > 3000]
        assert files, f"class {train_id} has no file that passes"
        table[train_id] = [Path(file).name for file in files]
    return table


def test_a_class_needs_one_file_with_more_than_3000_pixels(tmp_path: Path) -> None:
    stats = ClassStats(3)
    stats.add(0, {"0": 3001, "5": 3000, "7": 1})
    stats.add(1, {"0": 12, "5": 3000})
    assert stats.kept == (0,)
    assert stats.dropped == (5, 7)
    stats.write(tmp_path, lambda: [f"gtFine/train/s/{index}.png" for index in range(3)])
    rows, by_file, by_class = read(tmp_path)
    assert rows == [
        {"0": 3001, "file": "gtFine/train/s/0.png"},
        {"0": 12, "file": "gtFine/train/s/1.png"},
        {"file": "gtFine/train/s/2.png"},
    ]
    assert by_file == {row["file"]: {"0": row["0"]} if "0" in row else {} for row in rows}
    assert by_class == {"0": [["gtFine/train/s/0.png", 3001], ["gtFine/train/s/1.png", 12]]}
    assert rare_class_table(tmp_path) == {0: ["0.png"]}


def test_samples_without_a_label_are_left_out(tmp_path: Path) -> None:
    stats = ClassStats(2)
    stats.add(1, {"4": 5000})
    stats.write(tmp_path, lambda: [None, "b.png"])
    assert read(tmp_path)[0] == [{"4": 5000, "file": "b.png"}]


def test_the_statistics_of_an_export_count_its_labels(tmp_path: Path) -> None:
    clip = TinyClip(width=96, height=64)
    scene = WeatherScene.build(clip, tmp_path / "scene")
    plan = plan_export([scene], WeatherPolicy(types={"clear": 1}), count=6, seed=0)
    report = export(plan, tmp_path / "out")
    labels = [clip.frame(item.key).label for item in plan]
    sky, road = (
        [int(np.count_nonzero(label == TRAIN_ID[name])) for label in labels]
        for name in ("sky", "road")
    )
    assert max(road) <= 3000 < max(sky)
    assert report.classes == (TRAIN_ID["sky"],)
    assert report.dropped_classes == (TRAIN_ID["road"], TRAIN_ID["car"])
    table = rare_class_table(tmp_path / "out")
    written = [path.name for path in (tmp_path / "out" / "gtFine").rglob("*.png")]
    assert sorted(table[TRAIN_ID["sky"]]) == sorted(written)
    assert [row[str(TRAIN_ID["sky"])] for row in read(tmp_path / "out")[0]] == sky


def test_finishing_plans_nothing_anew(
    plan: ExportPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An item's weather is drawn in 80 us: for each row of each file that was minutes."""
    finish, asked = exporting.finish, []
    item = FromPolicy.item

    def watched(*arguments: Any, **options: Any) -> Any:
        with monkeypatch.context() as patch:
            patch.setattr(FromPolicy, "item", lambda *a: asked.append(a[1]) or item(*a))
            return finish(*arguments, **options)

    monkeypatch.setattr(exporting, "finish", watched)
    export(plan, tmp_path / "out")
    assert asked == []
    rows, by_file, _ = read(tmp_path / "out")
    paths = [plan.paths(index)["label"] for index in range(plan.count)]
    assert [row["file"] for row in rows] == paths == list(by_file)


def test_an_export_without_labels_has_no_statistics(tmp_path: Path) -> None:
    scene = WeatherScene.build(TinyClip(labelled=False), tmp_path / "scene")
    plan = plan_export([scene], WeatherPolicy(), count=3, seed=0)
    report = export(plan, tmp_path / "out")
    assert report.labelled == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "export.json",
        "leftImg8bit",
        "manifest.jsonl",
    ]


@pytest.mark.parametrize("pixels", [0, 64_000_000])
def test_counts_of_the_largest_picture_fit(tmp_path: Path, pixels: int) -> None:
    stats = ClassStats(1)
    stats.add(0, {"18": pixels})
    stats.write(tmp_path, lambda: ["a.png"])
    assert read(tmp_path)[1] == {"a.png": {"18": pixels} if pixels else {}}
