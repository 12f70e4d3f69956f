"""From a training to the pictures that may not be scored on: adapter, scene, export, merge."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import pytest
import torch
from pair_folder import write_pair_folder
from recorded_editor import Recorded, record
from test_export_editors import plan_of, scene_of
from tinting_editor import Tinting
from tiny_diffusion import build_tiny_sd
from tiny_export import POLICY, TinyClip

from weather_aug import _files
from weather_aug.cli import main
from weather_aug.edit.diffusion import leakage as diffusion_leakage
from weather_aug.edit.diffusion.leakage import TRAINED_ON, Digests, TrainedOn, digests_of
from weather_aug.edit.diffusion.options import DiffusionOptions
from weather_aug.edit.diffusion.train import train_editor
from weather_aug.edit.diffusion.train_options import TrainOptions
from weather_aug.errors import DataError, IntegrityError
from weather_aug.scene.scene import WeatherScene
from weather_aug.writers import layout
from weather_aug.writers.export import export
from weather_aug.writers.leakage import trained_pictures
from weather_aug.writers.merge import merge_cityscapes
from weather_aug.writers.plan import plan_export

OPTIONS = TrainOptions(steps=1, batch_size=1, size=(32, 48), unet_rank=2, vae_rank=2, threads=1)
TRAINED, HELD_OUT = "rain_0.png", "rain_1.png"


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Any:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Pictures of two streets, the first trained on; base; adapter; scene; export; merge."""
    folder = tmp_path_factory.mktemp("leakage")
    base = build_tiny_sd(folder / "base", seed=0)
    pairs = write_pair_folder(folder / "pairs", styles=("rain",))
    train_editor(pairs, str(base), folder / "adapter", OPTIONS, progress=False)
    scene = edited(folder / "scene", folder)
    export(plan_export([scene], POLICY, count=2, seed=3), folder / "export")
    plain = scene_of(folder / "plain_scene", "physical")
    export(plan_of([plain]), folder / "plain")
    merge_cityscapes(folder / "plain", [folder / "export"], folder / "merged")
    return folder


def edited(out: Path, data: Path) -> WeatherScene:
    options = DiffusionOptions(str(data / "base"), data / "adapter", height=32)
    clip = TinyClip(frames=1)
    return WeatherScene.build(clip, out, editor="diffusion", editor_options=options)


@pytest.fixture
def val(data: Path, tmp_path: Path) -> Path:
    """What a network is to be scored on: so far, nothing that trained the editor."""
    folder = tmp_path / "val" / "rain"
    folder.mkdir(parents=True)
    shutil.copy(data / "pairs" / HELD_OUT, folder / "a.png")
    shutil.copy(data / "pairs" / "clear_1.png", folder / "b.png")
    return tmp_path / "val"


def stored_again(path: Path, other: Path) -> None:
    cv2.imwrite(str(other), cv2.imread(str(path)), [cv2.IMWRITE_PNG_COMPRESSION, 0])
    assert other.read_bytes() != path.read_bytes()


PLACES = ("scene", "export", "merged")


@pytest.mark.parametrize("place", PLACES)
def test_pictures_that_trained_the_editor_are_found(data: Path, val: Path, place: str) -> None:
    """The file under another name, and its pixels in another file."""
    found = trained_pictures(data / place, val)
    assert (found.pictures, found.editors) == (2, 1)
    assert found.trained == found.unrecorded == []
    shutil.copy(data / "pairs" / TRAINED, val / "rain" / "c.png")
    stored_again(data / "pairs" / "clear_0.png", val / "d.png")
    found = trained_pictures(data / place, val)
    assert found.pictures == 4 and found.unrecorded == []
    adapter = json.loads((data / "adapter/card.json").read_text())["weights"]["sha256"][:12]
    record_name = next((data / "export").glob("trained_on_*")).name
    assert found.trained == [
        f"{val}/d.png trained the editor diffusion {adapter} (its pixels are in {record_name})",
        f"{val}/rain/c.png trained the editor diffusion {adapter} (its file is in {record_name})",
    ]


def test_the_record_is_the_adapters_to_the_byte(data: Path) -> None:
    whole = (data / "adapter" / TRAINED_ON).read_bytes()
    for place in PLACES[1:]:
        (path,) = (data / place).glob("trained_on_*")
        assert path.read_bytes() == whole
    assert (data / "scene/backgrounds" / TRAINED_ON).read_bytes() == whole


def test_a_resized_or_compressed_picture_is_not_found(data: Path, val: Path) -> None:
    """As docs/export.md says."""
    picture = cv2.imread(str(data / "pairs" / TRAINED))
    cv2.imwrite(str(val / "half.png"), cv2.resize(picture, None, fx=0.5, fy=0.5))
    cv2.imwrite(str(val / "compressed.jpg"), picture)
    assert trained_pictures(data / "export", val).trained == []


def test_a_check_of_files_alone_would_be_noticed(
    data: Path, val: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A planted fault: digests of pixels that are none."""
    stored_again(data / "pairs" / TRAINED, val / "again.png")
    assert len(trained_pictures(data / "export", val).trained) == 1

    def files_only(path: Path) -> Digests:
        return digests_of(path)._replace(pixels="0" * 64)

    monkeypatch.setattr(diffusion_leakage, "digests_of", files_only)
    assert trained_pictures(data / "export", val).trained == []


@pytest.mark.parametrize("place", PLACES)
def test_one_flipped_digit_is_no_answer(data: Path, val: Path, tmp_path: Path, place: str) -> None:
    copy = Path(shutil.copytree(data / place, tmp_path / "copy"))
    path = next(copy.rglob("*trained_on*"))
    text = path.read_text()
    place_of = text.index("\n") + 64
    flipped = text[:place_of] + ("0" if text[place_of] != "0" else "1") + text[place_of + 1 :]
    path.write_text(flipped)
    with pytest.raises(IntegrityError, match="has changed since it was written"):
        trained_pictures(copy, val)


@pytest.mark.parametrize("place", PLACES)
def test_a_lost_record_is_no_answer(data: Path, val: Path, tmp_path: Path, place: str) -> None:
    copy = Path(shutil.copytree(data / place, tmp_path / "copy", symlinks=place == "merged"))
    next(copy.rglob("*trained_on*")).unlink()
    with pytest.raises((IntegrityError, DataError), match=r"missing|cannot read"):
        trained_pictures(copy, val)


def test_an_adapter_that_lost_its_record_edits_nothing(data: Path, tmp_path: Path) -> None:
    copy = tmp_path / "data"
    shutil.copytree(data / "adapter", copy / "adapter")
    shutil.copytree(data / "base", copy / "base")
    path = copy / "adapter" / TRAINED_ON
    TrainedOn(frozenset(["0" * 64])).write(path.parent)
    with pytest.raises(IntegrityError, match=r"trained_on\.txt has changed"):
        edited(tmp_path / "scene", copy)
    path.unlink()
    with pytest.raises(DataError, match=r"trained_on\.txt is missing"):
        edited(tmp_path / "scene", copy)
    assert not (tmp_path / "scene").exists()


def test_an_export_at_a_url_is_asked_too(
    data: Path, val: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    url = f"file://{tmp_path}/out"
    scene = WeatherScene.load(data / "scene")
    export(plan_export([scene], POLICY, count=2, seed=3), url, state=tmp_path / "state")
    assert told(url, val, capsys) == (0, ["none of 2 pictures trained the editor"])
    shutil.copy(data / "pairs" / TRAINED, val / "c.png")
    code, lines = told(url, val, capsys)
    assert code == 4 and lines[0].startswith(f"{val}/c.png trained the editor diffusion ")
    next((tmp_path / "out").glob("trained_on_*")).unlink()
    code, lines = told(url, val, capsys)
    assert code == 3 and "is missing" in lines[0]


# Unknown is not clean


def test_an_editor_without_a_record_is_said_to_be_unknown(val: Path, tmp_path: Path) -> None:
    mute = scene_of(tmp_path / "mute", Tinting(), "snow")
    part = scene_of(tmp_path / "part", Recorded(records={"snow": record("a")}), "snow", "rain")
    says = "what trained the editor tinting is on no record"
    assert trained_pictures(mute.path, val) == (2, 0, [], [says])
    says_part = "what trained the editor tinting for rain is on no record"
    assert trained_pictures(part.path, val) == (2, 1, [], [says_part])
    export(plan_of([mute, part]), tmp_path / "export")
    merge_cityscapes(tmp_path / "export", [], tmp_path / "merged")
    for place in ("export", "merged"):
        assert trained_pictures(tmp_path / place, val) == (2, 1, [], [says, says_part])


@pytest.mark.parametrize("editor", ["physical", "none", "snow-cover"])
def test_editors_that_learnt_nothing_leak_nothing(val: Path, tmp_path: Path, editor: str) -> None:
    scene = scene_of(tmp_path / "scene", editor)
    export(plan_of([scene]), tmp_path / "export")
    for place in ("scene", "export"):
        assert trained_pictures(tmp_path / place, val) == (2, 0, [], [])


def resealed(out: Path, change: Any) -> None:
    contents = layout.read_contents(out)
    change(contents)
    (out / "export.json").write_bytes(layout.sealed_contents(contents))


def test_an_export_of_before_editors_were_named_is_unknown(
    data: Path, val: Path, tmp_path: Path
) -> None:
    copy = Path(shutil.copytree(data / "export", tmp_path / "copy"))
    resealed(copy, lambda contents: contents.pop("editors"))
    found = trained_pictures(copy, val)
    assert found.trained == [] and "before exports named their editors" in found.unrecorded[0]


@pytest.mark.parametrize(
    "editors",
    [
        {"editor": "x"},
        ["x"],
        [{"editor": "x"}],
        [{"editor": "x", "card": None}],
        [{"editor": "x", "card": {}, "trained_on": "../../etc/passwd"}],
        [{"editor": "x", "card": {}, "trained_on": "trained_on_0123456789abcdef.txt"}],
        [{"editor": "x", "card": {}, "trained_on": None}],
        [{"card": {}, "trained_on": 3}],
    ],
)
def test_a_malformed_export_is_no_answer(
    data: Path, val: Path, tmp_path: Path, editors: Any
) -> None:
    copy = Path(shutil.copytree(data / "export", tmp_path / "copy"))
    resealed(copy, lambda contents: contents.update(editors=editors))
    with pytest.raises(DataError):
        trained_pictures(copy, val)


def test_what_is_nothing_of_ours_is_refused(data: Path, val: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="neither a scene nor a merge nor a finished export"):
        trained_pictures(tmp_path, val)
    with pytest.raises(DataError, match="neither a picture nor a folder"):
        trained_pictures(data / "export", tmp_path / "nowhere")
    (val / "broken.png").write_bytes((val / "rain/a.png").read_bytes()[:-20])
    with pytest.raises(DataError, match=r"broken\.png is truncated"):
        trained_pictures(data / "export", val)


# The command


def told(
    out: Path | str, against: Path, capsys: pytest.CaptureFixture[str]
) -> tuple[int, list[str]]:
    """Exit code, and the lines of both streams."""
    capsys.readouterr()
    code = 0
    try:
        main(["inspect", str(out), "--against", str(against)])
    except SystemExit as end:
        code = int(str(end.code))
    streams = capsys.readouterr()
    return code, [*streams.out.splitlines(), *streams.err.splitlines()]


@pytest.mark.parametrize("place", PLACES)
def test_the_command_ends_with_4_if_any_picture_was_trained_on(
    data: Path, val: Path, place: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert told(data / place, val, capsys) == (0, ["none of 2 pictures trained the editor"])
    shutil.copy(data / "pairs" / TRAINED, val / "c.png")
    code, lines = told(data / place, val, capsys)
    assert code == 4 and len(lines) == 2
    assert lines[0].startswith(f"{val}/c.png trained the editor diffusion ")
    assert "1 of 3 pictures of " in lines[1] and lines[1].startswith("weather-aug: ")


def test_the_command_does_not_call_the_unknown_clean(
    val: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene_of(tmp_path / "mute", Tinting(), "snow")
    code, lines = told(tmp_path / "mute", val, capsys)
    assert code == 4
    assert lines[0] == "what trained the editor tinting is on no record"
    assert "unknown is not clean" in lines[1]
    scene_of(tmp_path / "physical", "physical")
    code, lines = told(tmp_path / "physical", val, capsys)
    assert code == 0
    assert lines == ["none of 2 pictures trained an editor: none of the backgrounds is learnt"]


def test_several_editors_are_told_apart(
    data: Path, val: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One picture that trained both stands in one sentence."""
    shared = digests_of(val / "rain/a.png").file
    editors = {
        name: Recorded(name=name, records={"snow": TrainedOn(frozenset([shared, digit * 64]))})
        for name, digit in (("one", "1"), ("two", "2"))
    }
    scenes = [scene_of(tmp_path / name, e, "snow") for name, e in editors.items()]
    export(plan_of(scenes), tmp_path / "export")
    found = trained_pictures(tmp_path / "export", val)
    (sentence,) = found.trained
    assert "the editor one (its file" in sentence and " and the editor two (its f" in sentence
    (val / "rain/a.png").unlink()
    code, lines = told(tmp_path / "export", val, capsys)
    assert (code, lines) == (0, ["none of 1 pictures trained one of the 2 editors"])
    assert _files.sha256_of_file(val / "rain/b.png") != shared
