"""The command line: each command end to end, and one line and an exit code for bad input."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_clip import digests_of

from weather_aug.cli import main
from weather_aug.scene.scene import WeatherScene
from weather_aug.weather import Weather

STREET = "street:?frames=1&width=64&height=40"
KEYS = ("000000_left", "000000_front", "000000_right")


@pytest.fixture
def folder(tiny_scene: WeatherScene, tmp_path: Path) -> Path:
    """A copy of the tiny scene that a test may harm."""
    return Path(shutil.copytree(tiny_scene.path, tmp_path / "copy"))


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """Exit code and the one line on stderr of a command that must fail."""
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    assert len(lines) == 1, captured.err
    assert lines[0].startswith("weather-aug: ")
    assert lines[0].isprintable()
    assert "Traceback" not in captured.err
    assert isinstance(caught.value.code, int)
    return caught.value.code, lines[0]


def test_the_way_from_clip_to_pictures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """build, render, sweep and inspect on the procedural street."""
    monkeypatch.chdir(tmp_path)
    main(["build", STREET, "--out", "scene"])
    assert capsys.readouterr().out == "3 frames of left, front, right in scene\n"

    main("render scene --weather snow --severity 0.6 --seed 3 --out pictures --labels".split())
    assert capsys.readouterr().out == "3 pictures in pictures\n"
    scene = WeatherScene.load("scene")
    suffixes = ("", "_labelTrainIds", "_invIds")
    written = {path.stem for path in (tmp_path / "pictures").iterdir()}
    assert written == {f"{key}{suffix}" for key in KEYS for suffix in suffixes}
    shot = scene.render(scene.keys[1], Weather.snow(0.6), seed=3)
    for suffix, expected in zip(suffixes, (shot.image, shot.label, shot.invalid), strict=True):
        path = f"pictures/{scene.keys[1]}{suffix}.png"
        flag = cv2.IMREAD_UNCHANGED if suffix else cv2.IMREAD_COLOR_RGB
        assert np.array_equal(cv2.imread(path, flag), expected)

    main("sweep scene --camera right --tile-width 64 --out sheet/sweep.png".split())
    assert capsys.readouterr().out == "sheet/sweep.png\n"
    assert cv2.imread("sheet/sweep.png").shape == (26 + 3 * 44, 26 + 5 * 68, 3)

    main(["inspect", "scene"])
    out = capsys.readouterr().out.splitlines()
    assert out[0] == f"scene {scene.name}, digest {scene.digest[:12]}, editor physical"
    assert out[1] == "3 frames (3 labelled) of left, front, right"
    assert out[2].startswith("9 files, ")
    assert out[3] == "every file is whole"


def test_render_takes_one_camera_and_what_the_weather_left(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "pictures"
    main([*f"render {folder} --camera right --no-falling --max-particles 10 --out {out}".split()])
    assert capsys.readouterr().out == f"4 pictures in {out}\n"
    scene = WeatherScene.load(folder)
    expected = scene.render(scene.keys[1], Weather.rain("heavy", falling=False)).image
    assert np.array_equal(cv2.imread(str(out / "000000_right.png"), cv2.IMREAD_COLOR_RGB), expected)
    assert len(list(out.iterdir())) == 4


def test_export_writes_a_data_set(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "data"
    main([*f"export {folder} --out {out} --count 3 --severity 0.2 0.4 --seed 5".split()])
    assert capsys.readouterr().out == f"3 samples in {out}\n"
    assert len(list(out.rglob("*.png"))) >= 6
    main(["inspect", str(out)])
    assert "every file is whole" in capsys.readouterr().out


def test_a_build_goes_on_after_an_interruption(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from weather_aug.scene import store

    encode, calls = store.encode_frame, []

    def interrupted(frame: object) -> dict[str, bytes]:
        calls.append(frame)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return encode(frame)  # type: ignore[arg-type]

    monkeypatch.setattr(store, "encode_frame", interrupted)
    command = ["build", STREET, "--out", str(tmp_path / "scene")]
    code, line = refused(command, capsys)
    assert (code, "run the same command again" in line) == (130, True)
    assert not (tmp_path / "scene").exists()
    main(command)
    assert "3 frames" in capsys.readouterr().out


USAGE = {
    "unknown scheme": ("build sky:/data --out {new}", "no scheme 'sky'"),
    "no scheme": ("build data --out {new}", "has no scheme"),
    "unknown option": ("build street:?colour=red --out {new}", "no option 'colour'"),
    "unknown editor": ("build " + STREET + " --out {new} --editor magic", "editor 'magic'"),
    "unknown weather": ("render {scene} --out {new} --weather hail", "weather type 'hail'"),
    "unknown severity": ("render {scene} --out {new} --severity mild", "severity 'mild'"),
    "severity of NaN": ("render {scene} --out {new} --severity nan", "severity"),
    "severity beyond": ("render {scene} --out {new} --severity 1.5", "severity"),
    "unknown camera": ("render {scene} --out {new} --camera rear", "no camera 'rear'"),
    "no budget": ("render {scene} --out {new} --max-particles -1", "max_particles"),
    "a seed too wide": (f"render {{scene}} --out {{new}} --seed {2**64}", "seed"),
    "unknown time": ("sweep {scene} --out {new} --time 99", "no frame 000099_front"),
    "unknown camera in a sweep": ("sweep {scene} --out {new} --camera rear", "no camera 'rear'"),
    "no width": ("sweep {scene} --out {new} --tile-width 0", "tile_width"),
}


@pytest.mark.parametrize(("command", "says"), USAGE.values(), ids=USAGE.keys())
def test_a_wrong_argument_is_exit_code_2(
    folder: Path, tmp_path: Path, command: str, says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    new = tmp_path / "new"
    code, line = refused(command.format(scene=folder, new=new).split(), capsys)
    assert (code, says in line) == (2, True), line
    assert not new.exists()


@pytest.mark.parametrize(
    "arguments", [[], ["bild"], ["render"], ["build", "street:", "--out"], ["render", "a", "--x"]]
)
def test_a_wrong_command_is_exit_code_2(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize(
    "command",
    [
        "build folder:{missing} --out {new}",
        "build kitti-odometry:{missing} --out {new}",
        "render {missing} --out {new}",
        "sweep {missing} --out {new}",
        "inspect {missing}",
    ],
)
def test_missing_input_is_exit_code_3(
    tmp_path: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    missing, new = tmp_path / "missing", tmp_path / "new"
    code, line = refused(command.format(missing=missing, new=new).split(), capsys)
    assert (code, "missing" in line) == (3, True), line
    assert not new.exists()


def test_a_hostile_manifest_is_exit_code_3(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A camera's name would become part of a picture's path."""
    manifest = json.loads((folder / "scene.json").read_text())
    manifest["frames"][0]["camera"] = "../../../evil"
    (folder / "scene.json").write_text(json.dumps(manifest))
    before = digests_of(tmp_path)
    code, line = refused(["render", str(folder), "--out", str(tmp_path / "new")], capsys)
    assert (code, "camera" in line) == (3, True), line
    assert digests_of(tmp_path) == before


@pytest.mark.parametrize("command", ["render {} --out {new}", "sweep {} --out {new}", "inspect {}"])
def test_a_cut_file_is_exit_code_4(
    folder: Path, tmp_path: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = folder / "frames" / "000001_front.depth.npy"
    path.write_bytes(path.read_bytes()[:-1])
    code, line = refused(command.format(folder, new=tmp_path / "new").split(), capsys)
    assert code == 4
    assert "000001_front.depth.npy" in line
    assert "build the scene again" in line


def test_inspect_finds_every_changed_byte(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = ("000001_front.png", "000003_right.label.npy")
    for name in names:
        data = bytearray((folder / "frames" / name).read_bytes())
        data[len(data) // 2] ^= 1
        (folder / "frames" / name).write_bytes(data)
    with pytest.raises(SystemExit) as caught:
        main(["inspect", str(folder)])
    captured = capsys.readouterr()
    assert caught.value.code == 4
    assert all(name in captured.out + captured.err for name in names)
    assert "every file is whole" not in captured.out


def test_an_existing_output_is_exit_code_5(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "scene"
    out.mkdir()
    (out / "thesis.txt").write_text("mine")
    code, line = refused(["build", STREET, "--out", str(out)], capsys)
    assert (code, "exists" in line) == (5, True)
    assert [path.name for path in tmp_path.rglob("*")] == ["scene", "thesis.txt"]


def test_an_unwritable_output_is_exit_code_6(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("mine")
    code, line = refused(["sweep", str(folder), "--out", str(tmp_path / "file" / "a.png")], capsys)
    assert (code, "cannot write" in line) == (6, True)
    code, line = refused(["build", STREET, "--out", str(tmp_path / "no" / "scene")], capsys)
    assert (code, "does not exist" in line) == (6, True)
    code, line = refused(["demo", "--out", str(tmp_path / "file" / "demo")], capsys)
    assert (code, "cannot write" in line) == (6, True)


def test_a_program_of_its_own_prints_one_line_and_no_traceback(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "weather_aug.cli", "render", str(tmp_path / "missing")]
    run = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert run.returncode == 3
    assert len(run.stderr.splitlines()) == 1
    assert run.stderr.startswith("weather-aug: ")


def test_help_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["--help"])
    assert not caught.value.code
    out = capsys.readouterr().out
    for command in ("build", "render", "sweep", "export", "inspect", "demo"):
        assert command in out


@pytest.mark.skipif(os.name != "posix", reason="pipes of a POSIX shell")
def test_a_reader_that_leaves_is_no_error(tmp_path: Path, folder: Path) -> None:
    """`weather-aug inspect SCENE | head -0` ends quietly."""
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "weather_aug.cli", "inspect", str(folder)]
    run = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, timeout=60, check=False)
    os.close(writer)
    assert run.stderr == b""


@pytest.mark.slow
def test_the_demo_ends_with_a_sheet(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The second run stands over the first, and gives the same."""
    out = tmp_path / "demo"
    trees = []
    for _ in range(2):
        main(f"demo --out {out} --frames 1 --width 320".split())
        lines = capsys.readouterr().out.splitlines()
        assert lines[-1] == str(out / "contact_sheet.png")
        trees.append(digests_of(out))
    assert trees[0] == trees[1]
    sheet = cv2.imread(lines[-1])
    assert sheet.shape[1] > 1000
    assert len(np.unique(sheet.reshape(-1, 3), axis=0)) > 1000, "pictures, not paper"
    assert WeatherScene.load(out / "scene", verify=True).cameras == ("left", "front", "right")
