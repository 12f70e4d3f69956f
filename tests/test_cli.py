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
from gaussian_clip import GaussianClip, known
from numpy.typing import NDArray
from tiny_clip import digests_of

import weather_aug
from weather_aug.cli import main
from weather_aug.cli.export import Export, parsed_types
from weather_aug.clip.types import FrameKey
from weather_aug.render.options import RenderOptions
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.scene.scene import WeatherScene
from weather_aug.scene.viewpoint import Viewpoint
from weather_aug.timeline import WeatherTimeline
from weather_aug.view.sheet import states
from weather_aug.view.video import drive_frames, parked_frames
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
    # A picture, its depth, label and boxes, and the editor's two files, of three frames.
    files = [path for path in Path("scene").rglob("*") if path.is_file()]
    assert out[2].startswith(f"{len(files) - 1} files, ")
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


def test_render_takes_two_weathers_at_once_and_leaves_effects_out(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = WeatherScene.load(folder)
    options = RenderOptions(without=("mirror", "noise"))
    for flags, falling in (("", True), (" --no-falling", False)):
        out = tmp_path / f"pictures{falling}"
        command = f"render {folder} --weather rain+fog --without noise mirror --camera front"
        main(f"{command}{flags} --out {out}".split())
        both = Weather.mix(Weather.rain("heavy", falling=falling), Weather.fog("heavy"))
        expected = scene.render(scene.keys[0], both, options=options).image
        assert np.array_equal(frames_in(out)[0], expected)
        assert (scene.render(scene.keys[0], both).image != expected).any()
    capsys.readouterr()
    for flags, says in (
        ("--weather rain+hail", "'hail'"),
        ("--weather clear+fog --no-falling", "does not fall"),
        ("--without rainbows", "'rainbows'"),
    ):
        code, line = refused(f"render {folder} {flags} --out {tmp_path / 'no'}".split(), capsys)
        assert (code, says in line) == (2, True), line
    assert not (tmp_path / "no").exists()


def test_sweep_shows_states_and_leaves_effects_out(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = WeatherScene.load(folder)
    key = FrameKey(1, "right")
    where = f"sweep {folder} --camera right --time 1 --tile-width 64 --out {tmp_path / 'a.png'}"
    main([*f"{where} --states --without lamps drops".split()])
    written = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_COLOR_RGB)
    options = RenderOptions(without=("lamps", "drops"))
    assert np.array_equal(written, states(scene, key, tile_width=64, options=options))
    assert not np.array_equal(written, states(scene, key, tile_width=64))
    capsys.readouterr()
    code, line = refused(f"{where} --without rainbows".split(), capsys)
    assert (code, "'rainbows'" in line) == (2, True)


def test_render_writes_invalid_masks_without_labels(
    unlabelled_scene: WeatherScene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "pictures"
    main(
        f"render {unlabelled_scene.path} --camera front --labels --weather fog --out {out}".split()
    )
    assert capsys.readouterr().out.splitlines() == [
        f"4 pictures in {out}",
        "4 of them have no label; only their invalid masks were written",
    ]
    keys = [str(key) for key in unlabelled_scene.keys if key.camera == "front"]
    suffixes = ("", "_invIds")
    assert {p.stem for p in out.iterdir()} == {f"{k}{suffix}" for k in keys for suffix in suffixes}
    shot = unlabelled_scene.render(unlabelled_scene.keys[0], Weather.fog("heavy"))
    invalid = cv2.imread(str(out / f"{keys[0]}_invIds.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(invalid, shot.invalid)


def frames_in(folder: Path) -> list[NDArray[np.uint8]]:
    """Pictures of a folder, RGB, by name."""
    return [cv2.imread(str(p), cv2.IMREAD_COLOR_RGB) for p in sorted(folder.iterdir())]


def test_render_makes_a_video_of_a_drive(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first camera at the clip's own rate; without loss the frames are those of the scene."""
    path = tmp_path / "new" / "snow.mp4"
    main([*f"render {folder} --weather snow --seed 3 --video {path}".split()])
    assert capsys.readouterr().out == f"4 frames at 10 per second in {path}\n"
    reader = cv2.VideoCapture(str(path))
    assert reader.get(cv2.CAP_PROP_FRAME_COUNT) == 4
    assert reader.get(cv2.CAP_PROP_FPS) == 10

    out = tmp_path / "frames"
    main([*f"render {folder} --weather snow --camera right --fps 5 --video {out}".split()])
    assert capsys.readouterr().out == f"4 frames at 5 per second in {out}\n"
    scene = WeatherScene.load(folder)
    expected = drive_frames(scene, "right", Weather.snow("heavy"))
    for image, frame in zip(frames_in(out), expected, strict=True):
        assert np.array_equal(image, frame)


def test_render_parks_the_car_in_a_changing_weather(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Unless told otherwise the change takes the whole video, of the clip's middle frame."""
    scene = WeatherScene.load(folder)
    parked = f"render {folder} --from clear --parked-s 0.4 --fps 20"
    snow = Weather.snow("light")
    for options, key, times_s in (
        ("", FrameKey(2, "front"), (0.2, 0.6)),
        (" --time 1 --start-s 0.15 --end-s 0.2", FrameKey(1, "front"), (0.15, 0.2)),
    ):
        out = tmp_path / f"parked{len(options)}"
        main(f"{parked}{options} --weather snow --severity light --video {out}".split())
        assert capsys.readouterr().out == f"8 frames at 20 per second in {out}\n"
        change = WeatherTimeline.transition(Weather.clear(), snow, *times_s)
        frames = frames_in(out)
        expected = list(parked_frames(scene, key, change, fps=20, duration_s=0.4))
        assert np.array_equal(frames[0], scene.frame(key).image)
        assert all(np.array_equal(a, b) for a, b in zip(frames, expected, strict=True))


@pytest.mark.parametrize("video", [True, False], ids=["video", "pictures"])
def test_render_takes_a_timeline(folder: Path, tmp_path: Path, video: bool) -> None:
    shower = WeatherTimeline.transition(Weather.clear(), Weather.rain("heavy"), 0.05, 0.15)
    file, out = tmp_path / "shower.json", tmp_path / "out"
    file.write_text(shower.to_json())
    where = "--video" if video else "--out"
    main([*f"render {folder} --timeline {file} --camera front {where} {out}".split()])
    scene = WeatherScene.load(folder)
    for image, frame in zip(frames_in(out), drive_frames(scene, "front", shower), strict=True):
        assert np.array_equal(image, frame)


def test_a_file_that_is_no_timeline_is_exit_code_3(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, out = tmp_path / "weather.json", tmp_path / "new"
    for text, says in (("{", "not valid JSON"), ('{"knots": []}', "at least one"), ("[]", "list")):
        file.write_text(text)
        code, line = refused(f"render {folder} --timeline {file} --out {out}".split(), capsys)
        assert (code, "weather.json" in line, says in line) == (3, True, True), line
    code, line = refused(f"render {folder} --timeline {tmp_path}/no.json".split(), capsys)
    assert (code, "no.json" in line) == (3, True)
    assert not out.exists()


def test_a_video_in_the_way_is_refused_before_any_work(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("mine")
    code, line = refused(f"render {folder} --video {tmp_path / 'full'}".split(), capsys)
    assert (code, "not empty" in line) == (5, True)
    code, line = refused(f"render {folder} --video {tmp_path / 'full/thesis.txt'}".split(), capsys)
    assert (code, "ends with .mp4" in line) == (2, True)
    (tmp_path / "file").write_text("mine")
    code, line = refused(f"render {folder} --video {tmp_path / 'file' / 'a.mp4'}".split(), capsys)
    assert (code, "cannot write" in line) == (6, True)


def test_export_takes_weights_of_types(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "data"
    main([*f"export {folder} --out {out} --count 12 --types rain=2 rain+fog=1e0 snow=0".split()])
    assert capsys.readouterr().err == ""
    job = json.loads((out / "export.json").read_text())["job"]
    assert job["policy"]["types"] == {"rain": 2.0, "rain+fog": 1.0, "snow": 0.0}


def test_exports_default_is_the_policys() -> None:
    assert parsed_types(Export.types) == WeatherPolicy().types


def test_an_export_without_labels_warns(
    folder: Path,
    unlabelled_scene: WeatherScene,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "data"
    main([*f"export {folder} {unlabelled_scene.path} --out {out} --count 16".split()])
    captured = capsys.readouterr()
    assert f"\n16 samples in {out}\n" in captured.out
    assert captured.err == "weather-aug: warning: 8 of 16 samples have no label\n"


def test_verify_repairs_what_inspect_finds(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "data"
    command = f"export {folder} --out {out} --count 3".split()
    main(command)
    whole = digests_of(out)
    victim = min((out / "leftImg8bit").rglob("*.png"))
    data = bytearray(victim.read_bytes())
    data[len(data) // 2] ^= 1
    victim.write_bytes(data)
    main(command)
    capsys.readouterr()
    with pytest.raises(SystemExit) as caught:
        main(["inspect", str(out)])
    captured = capsys.readouterr()
    assert caught.value.code == 4
    assert victim.name in captured.out
    assert captured.err.endswith("run the same export again with --verify to repair it\n")
    main([*command, "--verify"])
    assert digests_of(out) == whole


def test_export_writes_a_data_set(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "data"
    main([*f"export {folder} --out {out} --count 3 --severity 0.2 0.4 --seed 5".split()])
    assert f"\n3 samples in {out}\n" in capsys.readouterr().out
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


@pytest.mark.parametrize(
    ("command", "says"),
    [
        ("export {scene} --out {new}", "interrupted; run the same command again to continue"),
        ("render {scene} --out {new}", "interrupted"),
        ("render {scene} --video {new}", "interrupted"),
        ("sweep {scene} --out {new}", "interrupted"),
        ("inspect {scene}", "interrupted"),
    ],
)
def test_only_what_goes_on_says_so(
    folder: Path,
    tmp_path: Path,
    command: str,
    says: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupted(path: Path) -> WeatherScene:
        raise KeyboardInterrupt

    monkeypatch.setattr(WeatherScene, "load", interrupted)
    arguments = command.format(scene=folder, new=tmp_path / "new").split()
    assert refused(arguments, capsys) == (130, f"weather-aug: {says}")


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    main(["--version"])
    assert capsys.readouterr().out == f"weather-aug {weather_aug.__version__}\n"


USAGE = {
    "unknown scheme": ("build sky:/data --out {new}", "no scheme 'sky'"),
    "no scheme": ("build data --out {new}", "has no scheme"),
    "unknown option": ("build street:?colour=red --out {new}", "no option 'colour'"),
    "a fit of nothing": ("build " + STREET + " --out {new} --steps 9", "--steps needs --reconst"),
    "a style of nothing": ("build " + STREET + " --out {new} --styles rain", "--styles needs"),
    "an unknown style": (
        "build " + STREET + " --out {new} --reconstruct --styles dusk",
        "style 'dusk'",
    ),
    "a fit of no steps": ("build " + STREET + " --out {new} --reconstruct --steps 0", "steps"),
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
    "unknown severity of clear": (
        "render {scene} --out {new} --weather clear --severity mild",
        "severity 'mild'",
    ),
    "fog that fell": ("render {scene} --out {new} --weather fog --no-falling", "--no-falling"),
    "clear that fell": ("render {scene} --out {new} --weather clear --no-falling", "--no-falling"),
    "unknown that fell": ("render {scene} --out {new} --weather hail --no-falling", "'hail'"),
    "unknown first weather": ("render {scene} --out {new} --from hail", "weather type 'hail'"),
    "a change that is none": (
        "render {scene} --out {new} --from clear --start-s 2 --end-s 1",
        "end_s must be after",
    ),
    "a start of nothing": ("render {scene} --out {new} --start-s 1", "--start-s needs --from"),
    "a rate of pictures": ("render {scene} --out {new} --fps 5", "--fps needs --video"),
    "parked pictures": ("render {scene} --out {new} --parked-s 5", "--parked-s needs --video"),
    "a time to drive at": ("render {scene} --video {new} --time 1", "--time needs --parked-s"),
    "a video in two places": ("render {scene} --video {new} --out b", "does not go with --out"),
    "labels of a video": ("render {scene} --video {new} --labels", "does not go with --labels"),
    "a timeline and a weather": (
        "render {scene} --timeline a.json --weather snow --no-falling",
        "--timeline does not go with --no-falling, --weather",
    ),
    "an odd film": ("render {scene} --video {new}.avi", "ends with .mp4"),
    "a video without pace": ("render {scene} --video {new} --fps 0", "fps"),
    "a video without camera": ("render {scene} --video {new} --camera rear", "no camera 'rear'"),
    "a video without frame": (
        "render {scene} --video {new} --parked-s 1 --time 99",
        "no frame 000099_front",
    ),
    "a video without end": ("render {scene} --video {new} --parked-s 1e9", "duration_s"),
    "a type without weight": ("export {scene} --out {new} --types rain", "type=weight"),
    "a type without name": ("export {scene} --out {new} --types =1", "type=weight"),
    "a weight of words": ("export {scene} --out {new} --types rain=much", "'rain=much'"),
    "a weight of NaN": ("export {scene} --out {new} --types rain=nan", "weight of rain"),
    "a weight below 0": ("export {scene} --out {new} --types rain=-1", "weight of rain"),
    "a type twice": ("export {scene} --out {new} --types rain=1 rain=2", "'rain' stands twice"),
    "an unknown type": ("export {scene} --out {new} --types rain+hail=1", "type 'hail'"),
    "a narrow demo": ("demo --out {new} --width 8", "width must be in [32, 4096]"),
    "a demo of nothing": ("demo --out {new} --frames 0", "frames"),
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
    assert all(name in captured.out for name in names)
    assert "every file is whole" not in captured.out
    assert captured.err.splitlines() == [
        f"weather-aug: {folder} is not whole (2 problems); build the scene again"
    ]


@pytest.mark.parametrize("text", ["{", "{}", '{"format": "other"}'])
def test_inspect_of_a_damaged_manifest_ends_with_the_cure(
    folder: Path, tmp_path: Path, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "scene.json").write_text(text)
    code, line = refused(["inspect", str(folder)], capsys)
    assert code in (3, 4)
    assert line.endswith(" again"), line

    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "export.json").write_text(text)
    code, line = refused(["inspect", str(tmp_path / "data")], capsys)
    assert (code, line.endswith("remove the folder and export again")) == (4, True), line


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
    code, line = refused(["build", STREET, "--out", str(tmp_path / "file" / "scene")], capsys)
    assert (code, str(tmp_path / "file") in line) == (6, True)
    code, line = refused(["demo", "--out", str(tmp_path / "file" / "demo")], capsys)
    assert (code, "cannot write" in line) == (6, True)


@pytest.mark.parametrize("command", ["render {scene} --out {file}", "demo --out {file}"])
def test_a_file_where_a_folder_should_be(
    folder: Path, tmp_path: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "file"
    file.write_text("mine")
    code, line = refused(command.format(scene=folder, file=file).split(), capsys)
    assert (code, f"{file} is a file" in line) == (6, True), line
    assert file.read_text() == "mine"


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
    for command in ("build", "render", "sweep", "export", "inspect", "demo", "--version"):
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
        assert lines[-2:] == [str(out / name) for name in ("states.png", "contact_sheet.png")]
        trees.append(digests_of(out))
    assert trees[0] == trees[1]
    sheet = cv2.imread(lines[-1])
    assert sheet.shape[1] > 1000
    assert len(np.unique(sheet.reshape(-1, 3), axis=0)) > 1000, "pictures, not paper"
    assert WeatherScene.load(out / "scene", verify=True).cameras == ("left", "front", "right")


def test_a_scene_is_shown_from_elsewhere(
    gaussian_scene: WeatherScene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """--viewpoint, --turn, --style and --without-actors, as `WeatherScene.render` takes them."""
    folder, out = gaussian_scene.path, tmp_path / "out"
    choices = "--viewpoint 1 0.2 0 --turn 3 0 0 --style snow --amount 0.5 --without-actors 7"
    main(["render", str(folder), "--weather", "snow", "--out", str(out), *choices.split()])
    key = gaussian_scene.keys[1]
    shot = gaussian_scene.render(
        key,
        Weather.snow("heavy"),
        viewpoint=Viewpoint(lateral_m=1, height_m=0.2, yaw_deg=3),
        style="snow",
        amount=0.5,
        without_actors=(7,),
    )
    picture = cv2.imread(str(out / f"{key}.png"))[..., ::-1]
    assert (picture == shot.image).all()
    capsys.readouterr()
    main(["inspect", str(folder)])
    assert "Gaussians, styles: rain, snow, fog" in capsys.readouterr().out


def test_a_build_says_what_it_reconstructed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("weather_aug.clip.open.open_clip", lambda spec: GaussianClip())
    with known():
        main(["build", "any", "--out", str(tmp_path / "s"), "--reconstruct", "--styles", "snow"])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"6 frames of front in {tmp_path / 's'}"
    assert lines[1].endswith("Gaussians of 6 frames (psnr_db 99, ssim 1)")


def test_choices_of_other_pictures_need_them(
    gaussian_scene: WeatherScene, tiny_scene: WeatherScene, capsys: pytest.CaptureFixture[str]
) -> None:
    code, line = refused(["render", str(tiny_scene.path), "--style", "snow"], capsys)
    assert code == 2 and "--reconstruct" in line
    code, line = refused(["render", str(gaussian_scene.path), "--amount", "0.5"], capsys)
    assert code == 2 and "--amount needs --style" in line
