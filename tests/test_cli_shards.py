"""`weather-aug export --shard`, and urls on the command line."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import fsspec
import pytest
from fsspec.implementations.memory import MemoryFileSystem
from refused_command import refused
from tiny_clip import digests_of

from weather_aug.cli import main
from weather_aug.cli.export import parsed_shard, sheet_of
from weather_aug.errors import ArgumentError
from weather_aug.scene.scene import WeatherScene
from weather_aug.writers import lock
from weather_aug.writers.shards import Shard

Captured = pytest.CaptureFixture[str]
SECRET = "memory://me:secret@bucket/rainy?token=hidden"


class Strict(MemoryFileSystem):
    """A store in memory that takes users, passwords and queries."""

    protocol = ("memory",)

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return str(super()._strip_protocol(re.sub(r"me:secret@|\?[^/]*", "", path)))


@pytest.fixture
def store(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[MemoryFileSystem]:
    """A store, and a working directory of one's own."""
    monkeypatch.chdir(tmp_path)
    MemoryFileSystem.store.clear()
    MemoryFileSystem.pseudo_dirs[:] = [""]
    fsspec.register_implementation("memory", Strict, clobber=True)
    yield Strict()
    fsspec.register_implementation("memory", MemoryFileSystem, clobber=True)


def test_shards_and_the_command_that_finishes(
    tiny_scene: WeatherScene, tmp_path: Path, capsys: Captured
) -> None:
    out = tmp_path / "data"
    command = f"export {tiny_scene.path} --out {out} --count 10".split()
    ends = "when all shards are done, the same command without --shard finishes the export"
    for text, samples in (("2/3", 3), ("1/3", 4), ("3/3", 3)):
        main([*command, "--shard", text])
        lines = capsys.readouterr().out.splitlines()
        assert lines[0] == "plan     10 samples of 8 frames in 1 scene"
        assert lines[3] == f"shard    {text[0]} of 3: {samples} samples"
        assert re.fullmatch(r"size     about [\d.]+ kB, [\d.]+ kB a sample", lines[4])
        assert re.fullmatch(r"time     about \d+ s, \S+ s a sample \(\d+ measured\)", lines[5])
        said = f"{samples} samples of shard {text[0]} of 3 are committed in {out}; {ends}"
        assert lines[6:] == [said]
    main([*command, "--shard", "2/3"])
    assert "time     all samples are there already" in capsys.readouterr().out
    main([*command, "--shard", "1/2", "--dry-run"])
    assert "time     all samples are there already" in capsys.readouterr().out
    main(command)
    assert f"10 samples in {out}\n" in capsys.readouterr().out
    main([*command, "--shard", "2/3", "--quiet"])
    captured = capsys.readouterr()
    assert captured.out == (
        f"{out} is finished already, 10 samples; shard 2 of 3 has nothing to do\n"
    )
    main(["inspect", str(out)])
    assert "every file is whole" in capsys.readouterr().out
    main(f"export {tiny_scene.path} --out {tmp_path / 'one'} --count 10 --quiet".split())
    assert digests_of(out) == digests_of(tmp_path / "one")


def test_a_shards_size_is_a_share_of_the_whole(
    tiny_scene: WeatherScene, tmp_path: Path, capsys: Captured
) -> None:
    command = f"export {tiny_scene.path} --out {tmp_path / 'no'} --count 4000 --dry-run".split()
    sizes = []
    for flags in ([], ["--shard", "1/4"]):
        main([*command, *flags])
        said = re.search(r"about ([\d.]+) MB, ([\d.]+) kB a", capsys.readouterr().out)
        assert said is not None
        sizes.append(float(said[1]))
        assert 1000 * float(said[1]) == pytest.approx(
            float(said[2]) * (1000 if flags else 4000), rel=0.01
        )
    assert sizes[0] == pytest.approx(4 * sizes[1], rel=0.05)


def test_a_shard_that_runs_already_is_exit_code_5(
    tiny_scene: WeatherScene, tmp_path: Path, capsys: Captured
) -> None:
    out = tmp_path / "data"
    out.mkdir()
    command = f"export {tiny_scene.path} --out {out} --count 2 --quiet".split()
    part = Shard(1, 2)
    with lock.shared(out, part.state(out), str(part)):
        for flags, says in (
            (["--shard", "1/2"], f"shard 1 of 2 of {out} is being exported to"),
            ([], f"{out} is being exported to"),
        ):
            code, line = refused([*command, *flags], capsys)
            assert (code, f"{says} by process {os.getpid()} on" in line) == (5, True), line


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        ("--shard 3", "--shard takes i/n"),
        ("--shard 0/4", "1 <= i <= n"),
        ("--shard 5/4", "1 <= i <= n"),
        ("--shard 1/2 --verify", "--shard does not go with --verify"),
        ("--state elsewhere", "state is for an output such as s3://"),
    ],
)
def test_flags_that_mean_nothing_are_exit_code_2(
    tiny_scene: WeatherScene, tmp_path: Path, capsys: Captured, flags: str, says: str
) -> None:
    out = tmp_path / "new"
    code, line = refused(f"export {tiny_scene.path} --out {out} {flags}".split(), capsys)
    assert (code, says in line) == (2, True), line
    assert not out.exists()


def test_shards_are_read_from_texts() -> None:
    assert parsed_shard("3/16") == Shard(3, 16)
    for wrong in ("", "3", "3/", "a/b", "3/16/2", "-1/4", "1/4 "):
        with pytest.raises(ArgumentError):
            parsed_shard(wrong)


def test_an_export_to_a_url(
    tiny_scene: WeatherScene, tmp_path: Path, capsys: Captured, store: MemoryFileSystem
) -> None:
    command = ["export", str(tiny_scene.path), "--out", SECRET, "--count", "6"]
    main([*command, "--dry-run"])
    assert list(tmp_path.iterdir()) == []
    capsys.readouterr()
    main(command)
    captured = capsys.readouterr()
    assert captured.err == ""
    lines = captured.out.splitlines()
    assert lines[5] == "6 samples in memory://bucket/rainy"
    assert lines[6] == "share of pixels by class, 6 of 6 labels; bars are logarithmic:"
    assert lines[-2:] == ["look at", "rainy.png"]
    assert cv2.imread("rainy.png").shape[1] == 26 + 4 * 484
    assert {path.name for path in tmp_path.iterdir()} == {"rainy.png", ".weather-aug-export"}
    main(command)
    again = capsys.readouterr().out
    assert "time     all samples are there already" in again
    main(["inspect", SECRET])
    whole = capsys.readouterr().out
    assert re.fullmatch(
        r"6 samples, 6 labelled \(.+\); layout cityscapes, train: image, label\n"
        "every file is whole\n",
        whole,
    )
    for text in (captured.out, again, whole):
        assert "secret" not in text and "hidden" not in text
    main(f"export {tiny_scene.path} --out {tmp_path / 'data'} --count 6 --quiet".split())
    (tmp_path / "copy").mkdir()
    store.get("memory://bucket/rainy/", str(tmp_path / "copy"), recursive=True)
    assert digests_of(tmp_path / "copy") == digests_of(tmp_path / "data")


def test_shards_of_a_url_with_a_state(
    tiny_scene: WeatherScene, tmp_path: Path, capsys: Captured, store: MemoryFileSystem
) -> None:
    command = f"export {tiny_scene.path} --out memory://bucket/rainy --count 4 --state st".split()
    main([*command, "--shard", "1/2"])
    assert "2 samples of shard 1 of 2 are committed in memory://bucket/" in capsys.readouterr().out
    main([*command, "--dry-run"])
    assert "; 2 samples are there already" in capsys.readouterr().out
    code, line = refused(["inspect", "memory://bucket/rainy"], capsys)
    assert (code, "is not whole (1 problem); run the same export again" in line) == (4, True)
    main([*command, "--quiet"])
    capsys.readouterr()
    assert [path.name for path in tmp_path.iterdir()] == ["st"]
    main(["inspect", "memory://bucket/rainy"])
    path = store.find("memory://bucket/rainy/gtFine")[0]
    data = store.cat_file(path)
    store.pipe_file(path, data[:-20] + bytes([data[-20] ^ 1]) + data[-19:])
    with pytest.raises(SystemExit):
        main(["inspect", "memory://bucket/rainy"])
    captured = capsys.readouterr()
    assert "has changed since it was written" in captured.out
    assert "memory://bucket/rainy is not whole (1 problem)" in captured.err
    main(command)
    assert "warning: memory://bucket/rainy/gtFine" in capsys.readouterr().err
    main([*command, "--verify"])
    assert capsys.readouterr().err == ""


def test_messages_about_urls_hold_no_password(
    tiny_scene: WeatherScene, capsys: Captured, store: MemoryFileSystem
) -> None:
    store.pipe_file("memory://bucket/rainy/theses.tex", b"years of work")
    export = f"export {tiny_scene.path} --count 2 --out".split()
    for command, expected in (
        (["inspect", SECRET], (3, "memory://bucket/rainy is neither a scene")),
        ([*export, SECRET], (5, "memory://bucket/rainy is no export, but holds theses.tex")),
        ([*export, "s3://me:secret@x/y?token=hidden"], (2, "s3://x/y needs a package")),
        ([*export, "nosuch://me:secret@x/y?token=hidden"], (2, "nosuch://x/y cannot be opened")),
        ([*export, SECRET, "--workers", "2"], (5, "")),
        (["export", "s3://me:secret@x/y", "--out", "a"], (2, "a url (s3://…) stands where")),
        (["merge", "a", "s3://me:secret@x/y", "--out", "b"], (2, "a url (s3://…) stands where")),
        (["inspect", "a", "--against", "s3://me:secret@x/y"], (2, "a url (s3://…) stands")),
    ):
        code, line = refused(command, capsys)
        assert (code, expected[1] in line) == (expected[0], True), line
        assert "secret" not in line and "hidden" not in line


def test_where_the_sheet_goes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    assert sheet_of("a/b") == Path("a/b.png")
    assert sheet_of("a/b/") == Path("a/b.png")
    assert sheet_of(".") == tmp_path.with_name(f"{tmp_path.name}.png")
    assert sheet_of("s3://me:secret@bucket/a/b/?x=1") == Path("b.png")
    assert sheet_of("s3://bucket") == Path("bucket.png")
