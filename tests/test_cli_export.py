"""`weather-aug export`: what it says before, writes, and shows afterwards."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from refused_command import refused
from tiny_clip import digests_of

from weather_aug.cli import main
from weather_aug.cli.export import parsed_balance, told_bytes, told_seconds
from weather_aug.errors import ArgumentError
from weather_aug.scene.scene import WeatherScene
from weather_aug.writers.balance import ClassBalance
from weather_aug.writers.layout import sealed_contents
from weather_aug.writers.verify import verify_export

Captured = pytest.CaptureFixture[str]


def job_of(out: Path) -> dict[str, object]:
    job: dict[str, object] = json.loads((out / "export.json").read_text())["job"]
    return job


def entries_of(out: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (out / "manifest.jsonl").read_text().splitlines()]


def test_summary_result_classes_and_sheet(
    tiny_scene: WeatherScene, tmp_path: Path, capsys: Captured
) -> None:
    out = tmp_path / "data"
    main(f"export {tiny_scene.path} --out {out} --count 6 --types rain=3 clear=1".split())
    captured = capsys.readouterr()
    assert captured.err == ""
    lines = captured.out.splitlines()
    assert lines[:3] == [
        "plan     6 samples of 8 frames in 1 scene",
        "weather  clear 25 %, rain 75 %",
        "layout   cityscapes, train: image, label; by this process",
    ]
    assert re.fullmatch(r"size     about [\d.]+ kB, [\d.]+ kB a sample", lines[3])
    assert re.fullmatch(r"time     about \d+ s, \S+ s a sample \(\d+ measured\)", lines[4])
    assert lines[5] == f"6 samples in {out}"
    assert lines[6] == "share of pixels by class, 6 of 6 labels; bars are logarithmic:"
    assert "road" in lines[7]
    assert lines[-2:] == ["look at", f"{out}.png"]
    # The sheet is no part of the export.
    assert verify_export(out) == []
    sheet = cv2.imread(f"{out}.png", cv2.IMREAD_COLOR_RGB)
    assert sheet.shape[1] == 26 + 4 * 484
    assert len(np.unique(sheet.reshape(-1, 3), axis=0)) > 1000


def test_the_size_is_near_what_is_written(
    tiny_scene: WeatherScene, tmp_path: Path, capsys: Captured
) -> None:
    out = tmp_path / "data"
    main(f"export {tiny_scene.path} --out {out} --count 8 --types rain=1".split())
    said = re.search(r"about ([\d.]+) kB,", capsys.readouterr().out)
    assert said is not None
    written = json.loads((out / "export.json").read_text())["bytes"]
    assert float(said[1]) * 1000 == pytest.approx(written, rel=0.1)


def test_a_dry_run_writes_nothing(
    tiny_scene: WeatherScene, tmp_path: Path, capsys: Captured
) -> None:
    out = tmp_path / "data"
    command = f"export {tiny_scene.path} --out {out} --count 5000000 --workers 2 --dry-run".split()
    main(command)
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["plan", "weather", "layout", "size", "time"]
    assert "by 2 processes" in lines[2]
    assert list(tmp_path.iterdir()) == []
    main([*command, "--quiet"])
    assert len(capsys.readouterr().out.splitlines()) == 5


def test_quiet_says_where_and_no_more(
    tiny_scene: WeatherScene, tmp_path: Path, capsys: Captured
) -> None:
    out = tmp_path / "data"
    main(f"export {tiny_scene.path} --out {out} --count 2 --quiet".split())
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == (f"2 samples in {out}\n", "")
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


def test_flags_do_not_change_bytes_that_they_do_not_name(
    tiny_scene: WeatherScene, tmp_path: Path
) -> None:
    command = f"export {tiny_scene.path} --count 3 --seed 5 --out".split()
    main([*command, str(tmp_path / "loud")])
    main([*command, str(tmp_path / "quiet"), "--quiet"])
    assert digests_of(tmp_path / "loud") == digests_of(tmp_path / "quiet")


def test_a_grid_of_weathers(tiny_scene: WeatherScene, tmp_path: Path, capsys: Captured) -> None:
    out = tmp_path / "data"
    weathers = "clear rain+fog=0.4"
    main(f"export {tiny_scene.path} --out {out} --weather {weathers} --seeds 2 --seed 9".split())
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == [
        "plan     32 samples of 8 frames in 1 scene",
        "weather  clear 50 %, rain+fog=0.4 50 %",
    ]
    recipes = [entry["recipe"] for entry in entries_of(out)]
    assert [recipe["seed"] for recipe in recipes[:4]] == [9, 10, 9, 10]
    kinds = json.loads((out / "export.json").read_text())["samples_by_kind"]
    assert kinds == {"clear": 16, "rain+fog=0.4": 16}


def test_a_list_of_samples(tiny_scene: WeatherScene, tmp_path: Path, capsys: Captured) -> None:
    """Lines of one export's manifest, in another layout: the same pictures."""
    first, second = tmp_path / "first", tmp_path / "second"
    main(f"export {tiny_scene.path} --out {first} --count 5 --quiet".split())
    lines = (first / "manifest.jsonl").read_text().splitlines()
    (tmp_path / "list.jsonl").write_text("\n".join([lines[3], lines[1]]))
    capsys.readouterr()
    main(
        f"export {tiny_scene.path} --out {second} --list {tmp_path / 'list.jsonl'} "
        "--layout folders".split()
    )
    assert capsys.readouterr().out.startswith("plan     2 samples of 8 frames")
    again = entries_of(second)
    for entry, line in zip(again, (lines[3], lines[1]), strict=True):
        expected = json.loads(line)
        assert entry["recipe"] == expected["recipe"]
        for part in ("image", "label"):
            assert entry["files"][part]["sha256"] == expected["files"][part]["sha256"]
    missing = tmp_path / "missing.jsonl"
    command = f"export {tiny_scene.path} --out {tmp_path / 'no'} --list {missing}"
    code, line = refused(command.split(), capsys)
    assert (code, "cannot read" in line) == (3, True), line


def test_layout_parts_and_split(tiny_scene: WeatherScene, tmp_path: Path, capsys: Captured) -> None:
    out = tmp_path / "data"
    command = f"export {tiny_scene.path} --out {out} --count 2 --layout acdc --split val"
    main([*command.split(), "--parts", "image", "invalid"])
    assert "layout   acdc, val: image, invalid; by" in capsys.readouterr().out
    assert len([*out.glob("gt/val/*/*_gt_invIds.png")]) == 2
    assert len([*out.rglob("*.png")]) == 4
    assert verify_export(out) == []


def test_an_export_of_tars_ends_with_a_sheet(
    tiny_scene: WeatherScene, tmp_path: Path, capsys: Captured
) -> None:
    out = tmp_path / "data"
    main(f"export {tiny_scene.path} --out {out} --count 3 --layout webdataset".split())
    assert "3 of 3 labels" in capsys.readouterr().out
    assert (tmp_path / "data.png").is_file()


def test_balance_prefers_rare_classes(
    tiny_scene: WeatherScene, tmp_path: Path, capsys: Captured
) -> None:
    out = tmp_path / "data"
    main(f"export {tiny_scene.path} --out {out} --count 4 --balance min_pixels=20".split())
    (line,) = [x for x in capsys.readouterr().out.splitlines() if x.startswith("classes")]
    assert line.startswith("classes  frames are chosen for pole ")
    balance = job_of(out)["balance"]
    assert isinstance(balance, dict)
    assert (balance["temperature"], balance["min_pixels"]) == (0.01, 20)
    code, line = refused(
        f"export {tiny_scene.path} --out {tmp_path / 'no'} --balance".split(), capsys
    )
    assert (code, "min_pixels is 3000" in line) == (2, True), line
    assert not (tmp_path / "no").exists()


def test_balance_is_read_from_texts() -> None:
    assert parsed_balance(()) == ClassBalance()
    assert parsed_balance(("temperature=0.1", "min_pixels=50")) == ClassBalance(0.1, 50)
    for wrong in ("pixels=3", "min_pixels=many", "min_pixels=0"):
        with pytest.raises(ArgumentError):
            parsed_balance((wrong,))


def test_what_is_there_already_is_not_measured_again(
    tiny_scene: WeatherScene, tmp_path: Path, capsys: Captured, monkeypatch: pytest.MonkeyPatch
) -> None:
    from weather_aug.writers import estimate

    command = f"export {tiny_scene.path} --out {tmp_path / 'data'} --count 2".split()
    main(command)
    capsys.readouterr()

    def rendered(*_: object) -> None:
        raise AssertionError("a finished export was measured")

    monkeypatch.setattr(estimate, "rendered", rendered)
    main(command)
    assert "time     all samples are there already\n" in capsys.readouterr().out


def test_damage_that_is_seen_is_a_warning_with_its_cure(
    tiny_scene: WeatherScene, tmp_path: Path, capsys: Captured
) -> None:
    out = tmp_path / "data"
    command = f"export {tiny_scene.path} --out {out} --count 1".split()
    main(command)
    (victim,) = out.rglob("*TrainIds.png")
    data = bytearray(victim.read_bytes())
    data[-20] ^= 1
    victim.write_bytes(data)
    capsys.readouterr()
    main(command)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("weather-aug: warning: ")
    assert line.endswith("; run the same export again with --verify to repair it")
    main([*command, "--verify"])
    assert capsys.readouterr().err == ""


def test_a_sheet_that_cannot_be_written_is_a_warning(
    tiny_scene: WeatherScene, tmp_path: Path, capsys: Captured
) -> None:
    (tmp_path / "data.png").mkdir()
    main(f"export {tiny_scene.path} --out {tmp_path / 'data'} --count 1".split())
    captured = capsys.readouterr()
    assert captured.err.startswith("weather-aug: warning: no contact sheet: cannot write")
    assert "look at" not in captured.out
    assert verify_export(tmp_path / "data") == []


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        ("--weather rain --count 5", "--weather does not go with --count"),
        ("--weather rain --types rain=1", "--weather does not go with --types"),
        ("--weather rain --balance", "--weather does not go with --balance"),
        ("--list a.jsonl --weather rain", "--list does not go with --weather"),
        ("--list a.jsonl --seed 3", "--list does not go with --seed"),
        ("--weather hail", "'hail'"),
        ("--weather rain rain", "stands twice"),
        ("--weather rain --seeds 0", "seeds"),
        ("--seeds 2", "--seeds needs --weather"),
        ("--layout kitti", "'kitti'"),
        ("--parts label", "image"),
        ("--split ../up", "split"),
        ("--balance pixels=3", "--balance takes"),
        ("--address auto", "give --engine ray"),
    ],
)
def test_flags_that_mean_nothing_are_exit_code_2(
    tiny_scene: WeatherScene, tmp_path: Path, capsys: Captured, flags: str, says: str
) -> None:
    out = tmp_path / "new"
    code, line = refused(f"export {tiny_scene.path} --out {out} {flags}".split(), capsys)
    assert (code, says in line) == (2, True), line
    assert not out.exists()


def test_another_jobs_folder_is_exit_code_5(
    tiny_scene: WeatherScene, tmp_path: Path, capsys: Captured
) -> None:
    command = f"export {tiny_scene.path} --out {tmp_path / 'data'} --quiet --count".split()
    main([*command, "1"])
    capsys.readouterr()
    code, line = refused([*command, "2"], capsys)
    assert (code, "another job" in line) == (5, True), line


def test_inspect_says_what_it_is_if_not_whole(
    tiny_scene: WeatherScene, tmp_path: Path, capsys: Captured
) -> None:
    out, merged = tmp_path / "data", tmp_path / "merged"
    main(f"export {tiny_scene.path} --out {out} --count 2 --quiet".split())
    main(["merge", str(out), "--out", str(merged)])
    capsys.readouterr()
    code, line = refused(["inspect", str(merged)], capsys)
    assert (code, "is a merge; inspect its exports" in line) == (3, True), line
    code, line = refused(["inspect", str(tmp_path / "typo")], capsys)
    assert (code, line.endswith("does not exist; check the path")) == (3, True), line
    contents = json.loads((out / "export.json").read_text())
    del contents["sha256"], contents["samples_by_kind"]
    (out / "export.json").write_bytes(sealed_contents(contents))
    code, line = refused(["inspect", str(out)], capsys)
    assert (code, "is not whole (1 problem)" in line) == (4, True), line
    main(f"export {tiny_scene.path} --out {tmp_path / 'cut'} --count 4 --shard 1/2 --quiet".split())
    code, line = refused(["inspect", str(tmp_path / "cut")], capsys)
    assert (code, line.endswith("run the same export again")) == (4, True), line


def test_sizes_and_times_are_for_people() -> None:
    sizes = {0: "0 B", 999: "999 B", 999_700: "1 MB", 3.21e9: "3.21 GB", 1e15: "1e+03 TB"}
    assert {size: told_bytes(size) for size in sizes} == sizes
    times = {0: "1 s", 119: "119 s", 130: "2.2 min", 720: "12 min", 7300: "2.0 h", 2e6: "23 days"}
    assert {time: told_seconds(time) for time in times} == times
