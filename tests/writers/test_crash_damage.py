"""Damage of every kind at once: found, repaired, and what is not ours is left alone."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from tiny_export import POLICY, tree_of

from weather_aug.cli import main
from weather_aug.scene.scene import WeatherScene
from weather_aug.writers.export import export
from weather_aug.writers.merge import merge_cityscapes
from weather_aug.writers.plan import ExportPlan, plan_export
from weather_aug.writers.verify import verify_export

Damage = Callable[[Path, Path], object]

DAMAGES: dict[str, Damage] = {
    "empty": lambda path, _: path.write_bytes(b""),
    "cut": lambda path, _: path.write_bytes(path.read_bytes()[:-7]),
    "one bit": lambda path, _: path.write_bytes(flipped(path.read_bytes())),
    "another's": lambda path, other: path.write_bytes(other.read_bytes()),
    "missing": lambda path, _: path.unlink(),
    "a link": lambda path, other: (path.unlink(), path.symlink_to(other)),
}


def flipped(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 4]) + data[middle + 1 :]


@pytest.fixture(scope="module")
def twenty(scene: WeatherScene) -> ExportPlan:
    return plan_export([scene], POLICY, count=20, seed=3)


@pytest.fixture(scope="module")
def whole(twenty: ExportPlan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole") / "out"
    export(twenty, out)
    return out


def damage_all(plan: ExportPlan, out: Path) -> set[str]:
    """Each kind of damage to a picture and to a label, of different samples; what was damaged."""
    kinds = [(part, damage) for part in ("image", "label") for damage in DAMAGES.values()]
    for index, (part, damage) in enumerate(kinds):
        damage(out / plan.paths(index)[part], out / plan.paths(index + 1)[part])
    return {plan.paths(index)[part] for index, (part, _) in enumerate(kinds)}


def with_extra_files(out: Path) -> dict[str, bytes]:
    """Files of somebody else in an export, one of them called like a temporary file's folder."""
    extra = {"notes.txt": b"mine", "leftImg8bit/train/tiny/extra_leftImg8bit.png": b"x"}
    for name, data in extra.items():
        (out / name).write_bytes(data)
    (out / "leftImg8bit" / "old.tmp").mkdir()
    return extra


def test_all_damage_is_told_and_repaired_and_extra_files_stay(
    twenty: ExportPlan, whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = Path(shutil.copytree(whole, tmp_path / "out"))
    damaged, extra = damage_all(twenty, out), with_extra_files(out)
    problems = verify_export(out)
    for name in (*damaged, *extra):
        assert any(name in problem for problem in problems), name
    assert len(problems) == len(damaged) + len(extra)
    with pytest.raises(SystemExit) as ended:
        main(["inspect", str(out)])
    assert ended.value.code == 4
    capsys.readouterr()
    report = export(twenty, out, verify=True)
    assert report.damaged == report.rendered == len(damaged)
    assert tree_of(out) == tree_of(whole) | tree_of_extra(out, extra)
    assert len(verify_export(out)) == len(extra)


def test_damage_to_unfinished_work_is_repaired_and_extra_files_stay(
    twenty: ExportPlan, whole: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    left = iter(range(15))

    def stop(_: object) -> None:
        if next(left, None) is None:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export(twenty, out, on_sample=stop)
    damaged, extra = damage_all(twenty, out), with_extra_files(out)
    report = export(twenty, out)
    assert report.damaged == len(damaged)
    assert tree_of(out) == tree_of(whole) | tree_of_extra(out, extra)


def tree_of_extra(out: Path, extra: dict[str, bytes]) -> dict[str, str]:
    """What `tree_of` says of the extra files if they still are as they were."""
    assert {name: (out / name).read_bytes() for name in extra} == extra
    tree = tree_of(out)
    return {name: tree[name] for name in extra}


def test_what_a_killed_merge_left_is_no_strangers_file(whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "merged"
    merge_cityscapes(whole, [], out)
    left = out / f"merge.json.{'0' * 16}.tmp"
    left.write_bytes(b"half")
    assert merge_cityscapes(whole, [], out).samples == 20
    assert not left.exists()
