"""Backgrounds of a scene: of the right moments, whole, and continued where the work stopped."""

from __future__ import annotations

import gc
import json
import os
import shutil
import signal
import subprocess
import sys
import weakref
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tinting_editor import TINTS, Tinting, tinted
from tiny_clip import TinyClip, digests_of

from weather_aug import _files
from weather_aug.clip.types import Frame, FrameKey
from weather_aug.edit.background import Moment
from weather_aug.edit.editors import Unedited
from weather_aug.errors import ArgumentError, ConflictError, DataError, OutputError
from weather_aug.scene import backgrounds, journal, store
from weather_aug.scene.backgrounds_record import background_path
from weather_aug.scene.scene import WeatherScene

WORK = ".building"
CLIP = TinyClip(frames=3, width=32, height=24)
SNOW_RAIN = ("snow", "rain")


@dataclass(frozen=True)
class Unrelated(TinyClip):
    is_drive: bool = False


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "scene"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> WeatherScene:
    """Built once; tests that harm it copy its folder."""
    folder = tmp_path_factory.mktemp("tinted") / "scene"
    return WeatherScene.build(CLIP, folder, editor=Tinting(), weathers=SNOW_RAIN)


def expected(clip: TinyClip, key: FrameKey, style: str, *, drive: bool = True) -> NDArray[np.uint8]:
    """The editor's picture, with neighbours taken from the clip itself."""

    def near(step: int) -> NDArray[np.uint8] | None:
        time = key.time_index + step
        if not drive or not 0 <= time < clip.frames:
            return None
        return clip.frame(FrameKey(time, key.camera)).image

    return tinted(clip.frame(key).image, near(-1), near(1), TINTS[style])


# The right pictures


def test_every_frame_has_its_picture_in_each_style(scene: WeatherScene) -> None:
    for key in CLIP.keys:
        for style in SNOW_RAIN:
            assert (scene.background(key, style) == expected(CLIP, key, style)).all(), (key, style)
    assert scene.manifest.editor == "tinting"
    assert scene.manifest.weathers == scene.manifest.styles == SNOW_RAIN
    assert scene.manifest.backgrounds is not None
    assert scene.manifest.backgrounds.card == json.loads(json.dumps(Tinting().card))
    with pytest.raises(ArgumentError, match="style 'fog' is unknown; there is snow, rain"):
        scene.background(CLIP.keys[0], "fog")
    with pytest.raises(ArgumentError, match="no frame"):
        scene.background(FrameKey(99, "front"), "snow")


def test_the_folder_holds_what_the_manifest_lists(scene: WeatherScene) -> None:
    assert set(digests_of(scene.path)) == {store.MANIFEST, *scene.manifest.files}
    paths = [background_path(style, key) for style in SNOW_RAIN for key in CLIP.keys]
    assert set(paths) < set(scene.manifest.files)
    assert not scene.path.with_name(scene.path.name + WORK).exists()
    again = WeatherScene.load(scene.path, verify=True)
    assert again.damaged_files() == []


def test_unrelated_pictures_have_no_neighbours(out: Path) -> None:
    clip = Unrelated(frames=2, width=32, height=24)
    built = WeatherScene.build(clip, out, editor=Tinting(), weathers=("fog",))
    for key in clip.keys:
        assert (built.background(key, "fog") == expected(clip, key, "fog", drive=False)).all()


@dataclass
class Noting(Tinting):
    """Notes keys of moments and how many frames there are at a time."""

    moments: list[tuple[list[str], ...]] = field(default_factory=list)
    frames: weakref.WeakSet[Frame] = field(default_factory=weakref.WeakSet)
    most: int = 0

    def edit(self, moment: Moment, style: str) -> tuple[NDArray[np.uint8], ...]:
        parts = (moment.before, moment.now, moment.after)
        self.moments.append(tuple([str(frame.key) for frame in part] for part in parts))
        self.frames.update(frame for part in parts for frame in part)
        gc.collect()
        self.most = max(self.most, len(self.frames))
        return super().edit(moment, style)


@dataclass(frozen=True)
class Gappy(TinyClip):
    """Time indices 0, 5, 6, 7; the rig's second camera is missing at 5."""

    @property
    def keys(self) -> tuple[FrameKey, ...]:
        all_keys = [FrameKey(time, camera) for time in (0, 5, 6, 7) for camera in self.cameras]
        return tuple(key for key in all_keys if key != FrameKey(5, "right"))


def test_moments_are_rigs_between_their_neighbours_and_few_are_held(out: Path) -> None:
    editor = Noting()
    clip = Gappy(frames=8, width=32, height=24)
    WeatherScene.build(clip, out, editor=editor, weathers=("snow",))
    rigs: list[list[str]] = [
        [],
        ["000000_front", "000000_right"],
        ["000005_front"],
        ["000006_front", "000006_right"],
        ["000007_front", "000007_right"],
        [],
    ]
    assert editor.moments == [tuple(rigs[i : i + 3]) for i in range(4)]
    assert editor.most == 5, "frames of three moments"


def test_inputs_cannot_be_changed(out: Path) -> None:
    class Careless(Tinting):
        def edit(self, moment: Moment, style: str) -> Any:
            moment.now[0].image[:] = 0

    with pytest.raises(ValueError, match="read-only"):
        WeatherScene.build(CLIP, out, editor=Careless())


def test_an_editor_is_told_what_the_physical_one_knows(out: Path) -> None:
    editor = Tinting(looks=True)
    built = WeatherScene.build(CLIP, out, editor=editor, weathers=("snow",))
    key = CLIP.keys[3]
    layers, ambience = built.layers(key), built.ambience(key)
    extra = 1000 * layers.illumination + 50 * float(ambience.airlight[0])
    near = [CLIP.frame(FrameKey(time, key.camera)).image for time in (0, 2)]
    found = tinted(CLIP.frame(key).image, near[0], near[1], TINTS["snow"], extra=extra)
    assert (built.background(key, "snow") == found).all()


def planted(name: str, patch: pytest.MonkeyPatch) -> None:
    """A mistake in the moments."""
    at = backgrounds.Moments.at

    def faulty(self: backgrounds.Moments, time_index: int) -> Moment:
        moment = at(self, time_index)
        if name == "swapped":
            return replace(moment, before=moment.after, after=moment.before)
        if name == "alone":
            return replace(moment, before=(), after=())
        if name == "cameras":
            cameras = [frame.key.camera for frame in moment.now][::-1]
            before = tuple(
                replace(frame, key=FrameKey(frame.key.time_index, camera))
                for frame, camera in zip(moment.before, cameras, strict=False)
            )
            return replace(moment, before=before)
        return replace(moment, now=moment.now[::-1])

    patch.setattr(backgrounds.Moments, "at", faulty)


@pytest.mark.parametrize("name", ["swapped", "alone", "cameras"])
def test_wrong_moments_would_be_seen(
    scene: WeatherScene, out: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    planted(name, monkeypatch)
    other = WeatherScene.build(CLIP, out, editor=Tinting(), weathers=SNOW_RAIN)
    assert any(
        (other.background(key, "snow") != scene.background(key, "snow")).any() for key in CLIP.keys
    )


# The physical editor


def test_the_physical_editor_stores_nothing(tiny_scene: WeatherScene) -> None:
    """Its manifest has the fields that it always had."""
    content = json.loads((tiny_scene.path / store.MANIFEST).read_text())
    assert list(content) == [
        *("format", "version", "name", "editor", "weathers", "axes_world", "airlight", "shelter"),
        *("frames", "files", "sha256"),
    ]
    assert content["editor"] == "physical" and content["weathers"] == ["rain", "snow", "fog"]
    assert tiny_scene.manifest.backgrounds is None and tiny_scene.manifest.styles == ()


def test_what_another_editor_left_is_not_published(tiny_scene: WeatherScene, out: Path) -> None:
    cut(out, TinyClip(), 3)
    WeatherScene.build(TinyClip(), out)
    assert digests_of(out) == digests_of(tiny_scene.path)
    assert not (out / "backgrounds").exists()


# Refused


class Odd:
    """No editor: nothing to edit with."""

    name, styles, card = "odd", ("snow",), {}


def giving(result: Callable[[Moment], Any]) -> Tinting:
    class Giving(Tinting):
        def edit(self, moment: Moment, style: str) -> Any:
            return result(moment)

    return Giving()


@pytest.mark.parametrize(
    ("choices", "says"),
    [
        ({"editor": "photoshop"}, "editor 'photoshop' is not one of physical, diffusion"),
        ({"editor": Odd()}, "a BackgroundEditor, got Odd"),
        ({"editor": 3}, "a BackgroundEditor, got int"),
        ({"editor": Tinting(name="../x")}, "may not be called '../x'"),
        ({"editor": Tinting(name="physical")}, "may not be called 'physical'"),
        ({"editor": Tinting(styles=())}, "must be of rain, snow, fog"),
        ({"editor": Tinting(styles=("hail",))}, "must be of rain, snow, fog"),
        ({"editor": Tinting(styles=("snow", "snow"))}, "each once"),
        ({"editor": Tinting(strength=float("nan"))}, "not of JSON values"),
        ({"editor": Tinting(strength=np.float32(1))}, "not of JSON values"),
        ({"editor": Tinting(styles=("snow",)), "weathers": ("snow", "fog")}, "cannot edit to fog"),
        ({"editor": Tinting(), "weathers": ("clear",)}, "no style"),
        ({"editor": Tinting(), "weathers": ()}, "no style"),
        ({"editor": Tinting(), "weathers": ("hail",)}, "weather 'hail'"),
        ({"editor": Tinting(), "editor_options": 3}, "leave them out"),
        ({"editor_options": 3}, "leave them out"),
        ({"editor": "none", "editor_options": 3}, "has no options"),
    ],
)
def test_choices_that_are_none_are_refused_before_work(
    out: Path, choices: dict[str, Any], says: str
) -> None:
    with pytest.raises(ArgumentError, match=says):
        WeatherScene.build(CLIP, out, **choices)
    assert list(out.parent.iterdir()) == []


def test_a_card_of_a_book_is_refused(out: Path) -> None:
    with pytest.raises(ArgumentError, match="more than 65536"):
        WeatherScene.build(CLIP, out, editor=Tinting(name="a", strength="x" * 70_000))


@pytest.mark.parametrize(
    ("editor", "says"),
    [
        (giving(lambda moment: ()), "0 pictures of 2 frames"),
        (giving(lambda moment: [f.image[1:] for f in moment.now]), r"\(23, 32, 3\)"),
        (giving(lambda moment: [f.image / 255 for f in moment.now]), "float64"),
        (giving(lambda moment: ["a", "b"]), "no picture of frame 000000_front in snow: None None"),
    ],
)
def test_what_is_no_picture_is_refused_and_the_work_kept(
    out: Path, editor: Tinting, says: str
) -> None:
    with pytest.raises(ArgumentError, match=says):
        WeatherScene.build(CLIP, out, editor=editor, weathers=("snow",))
    assert not out.exists() and out.with_name(out.name + WORK).exists()


def test_any_memory_layout_is_a_picture(scene: WeatherScene, out: Path) -> None:
    class Flipped(Tinting):
        def edit(self, moment: Moment, style: str) -> Any:
            return [np.flip(np.flip(p, 1).copy(), 1) for p in super().edit(moment, style)]

    built = WeatherScene.build(CLIP, out, editor=Flipped(), weathers=SNOW_RAIN)
    assert digests_of(built.path) == digests_of(scene.path)


def test_frames_that_cannot_be_edited_leave_nothing(out: Path) -> None:
    """As any bad input does."""
    editor = Tinting(fault=lambda key, style: DataError("it is night"))
    with pytest.raises(DataError, match="night"):
        WeatherScene.build(CLIP, out, editor=editor)
    assert list(out.parent.iterdir()) == []


def test_no_editing_is_an_editor_too(out: Path) -> None:
    built = WeatherScene.build(CLIP, out, editor="none")
    assert built.manifest.editor == Unedited.name
    assert built.manifest.styles == ("rain", "snow", "fog")
    for key in CLIP.keys:
        for style in built.manifest.styles:
            assert (built.background(key, style) == CLIP.frame(key).image).all()


# Continued


def failing_at(index: int, clip: TinyClip = CLIP) -> Tinting:
    """An editor that ends at the `index`-th frame that it edits."""
    editor = Tinting()

    def fault(key: FrameKey, style: str) -> Exception | None:
        return RuntimeError("power cut") if len(editor.edited) == index else None

    editor.fault = fault
    return editor


def cut(out: Path, clip: TinyClip = CLIP, index: int = 5) -> None:
    with pytest.raises(RuntimeError, match="power cut"):
        WeatherScene.build(clip, out, editor=failing_at(index), weathers=SNOW_RAIN)
    assert not out.exists()


@pytest.mark.parametrize("index", [0, 3, 4, 11])
def test_an_interrupted_round_is_continued(scene: WeatherScene, out: Path, index: int) -> None:
    """Whole moments are kept; the first is made once more, to see that the editor is the same."""
    cut(out, index=index)
    editor = Tinting()
    WeatherScene.build(CLIP, out, editor=editor, weathers=SNOW_RAIN)
    each = len(CLIP.cameras) * len(SNOW_RAIN)
    times = [key.time_index for key, _ in editor.edited[::each]]
    whole = index // each
    assert times == [*range(min(whole, 1)), *range(whole, CLIP.frames)]
    assert digests_of(out) == digests_of(scene.path)
    assert list(out.parent.iterdir()) == [out]


def stored(out: Path, time_index: int) -> Path:
    return out.with_name(out.name + WORK) / background_path("rain", FrameKey(time_index, "right"))


def spoil(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1] + b"\0")


@pytest.mark.parametrize("harm", [Path.unlink, spoil])
def test_a_spoilt_picture_costs_one_moment(
    scene: WeatherScene, out: Path, harm: Callable[[Path], None]
) -> None:
    cut(out, index=9)
    harm(stored(out, 1))
    editor = Tinting()
    WeatherScene.build(CLIP, out, editor=editor, weathers=SNOW_RAIN)
    assert {key.time_index for key, _ in editor.edited} == {0, 1, 2}
    assert digests_of(out) == digests_of(scene.path)


def test_a_journal_that_trusts_existence_would_be_seen(
    scene: WeatherScene, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A planted fault: what a crash spoilt is taken for whole."""
    cut(out, index=9)
    spoil(stored(out, 1))
    monkeypatch.setattr(journal, "_is_whole", lambda path, file: path.is_file())
    built = WeatherScene.build(CLIP, out, editor=Tinting(), weathers=SNOW_RAIN)
    assert digests_of(built.path) != digests_of(scene.path)
    assert built.damaged_files() != []


class Fickle(Tinting):
    """Has the card of another editor."""

    @property
    def card(self) -> Any:
        return Tinting().card


@pytest.mark.parametrize(
    "other",
    [Tinting(strength=0.4), Tinting(name="other"), Fickle(strength=0.4)],
    ids=["card", "name", "pictures"],
)
def test_work_of_another_editor_is_thrown_away(out: Path, other: Tinting) -> None:
    """By its card; and by its pictures, where the card does not tell."""
    cut(out, index=9)
    WeatherScene.build(CLIP, out, editor=other, weathers=SNOW_RAIN)
    again = WeatherScene.build(CLIP, out.with_name("again"), editor=other, weathers=SNOW_RAIN)
    assert digests_of(out) == digests_of(again.path)


def test_other_styles_are_other_work(out: Path) -> None:
    cut(out, index=9)
    built = WeatherScene.build(CLIP, out, editor=Tinting(), weathers=("rain", "fog"))
    assert set(digests_of(out)) == {store.MANIFEST, *built.manifest.files}
    assert not (out / "backgrounds" / "snow").exists()


@dataclass(frozen=True)
class Brighter(TinyClip):
    """The same clip but for the last frame."""

    def frame(self, key: FrameKey) -> Frame:
        frame = super().frame(key)
        last = key == self.keys[-1]
        return replace(frame, image=frame.image + np.uint8(9)) if last else frame


def test_pictures_of_other_frames_are_thrown_away(out: Path) -> None:
    """The first frame is the same, and so is the first moment; only the digests can tell."""
    cut(out, index=9)
    work = out.with_name(out.name + WORK)
    lines = (work / "journal.jsonl").read_text().splitlines()
    (work / "journal.jsonl").write_text("\n".join(lines[:-1]) + "\n")
    clip = Brighter(**{name: getattr(CLIP, name) for name in ("frames", "width", "height")})
    WeatherScene.build(clip, out, editor=Tinting(), weathers=SNOW_RAIN)
    again = WeatherScene.build(clip, out.with_name("again"), editor=Tinting(), weathers=SNOW_RAIN)
    assert digests_of(out) == digests_of(again.path)


def test_a_full_disk_keeps_the_work(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = _files.write_whole

    def full(path: Path, data: bytes) -> None:
        if path.parent.name == "rain" and path.name.startswith("000001"):
            with _files.reported(path):
                raise OSError(28, "No space left on device")
        whole(path, data)

    with monkeypatch.context() as patch:
        patch.setattr(_files, "write_whole", full)
        with pytest.raises(OutputError, match="free some space"):
            WeatherScene.build(CLIP, out, editor=Tinting(), weathers=SNOW_RAIN)
    editor = Tinting()
    built = WeatherScene.build(CLIP, out, editor=editor, weathers=SNOW_RAIN)
    assert built.damaged_files() == []
    assert len(editor.edited) == 12, "the first again, then two more"


def _killed_at(call: int, action: Callable[[], object]) -> bool:
    """Run `action` in a child that is killed at its `call`-th change of a folder; was it?"""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
    calls = 0

    def counted(function: Callable[..., Any]) -> Callable[..., Any]:
        def inner(*arguments: Any, **options: Any) -> Any:
            nonlocal calls
            calls += 1
            if calls == call:
                os.kill(os.getpid(), signal.SIGKILL)
            return function(*arguments, **options)

        return inner

    for name in ("rename", "replace", "unlink", "rmdir", "mkdir", "fsync"):
        setattr(os, name, counted(getattr(os, name)))
    try:
        action()
    finally:
        os._exit(0)


def _kill_everywhere(scene: WeatherScene, tmp_path: Path, step: int) -> int:
    """Kill the third round at every `step`-th change of a folder, and continue; how many there are.

    What it starts from is the work of the first two rounds.
    """
    start = tmp_path / "start" / "scene"
    start.parent.mkdir()
    cut(start, index=0)

    def build(out: Path) -> WeatherScene:
        return WeatherScene.build(CLIP, out, editor=Tinting(), weathers=SNOW_RAIN)

    for call in range(1, 1000, step):
        out = tmp_path / str(call) / "scene"
        shutil.copytree(start.parent, out.parent)
        was_killed = _killed_at(call, lambda out=out: build(out))
        if was_killed and not out.exists():
            build(out)
        assert digests_of(out) == digests_of(scene.path)
        if not was_killed:
            return call
        shutil.rmtree(out.parent)
    raise AssertionError("there is no end to it")


def test_a_build_killed_between_writes_is_continued(scene: WeatherScene, tmp_path: Path) -> None:
    assert _kill_everywhere(scene, tmp_path, 9) > 40


@pytest.mark.slow
def test_a_build_killed_at_any_write_is_continued(scene: WeatherScene, tmp_path: Path) -> None:
    assert _kill_everywhere(scene, tmp_path, 1) > 40


_KILLED = """
import signal, sys
sys.path.insert(0, {tests!r})
from tinting_editor import Tinting
from tiny_clip import TinyClip
from weather_aug.scene.scene import WeatherScene

class Slow(Tinting):
    def edit(self, moment, style):
        if len(self.edited) == 6:
            print("ready", flush=True)
            signal.pause()
        return super().edit(moment, style)

WeatherScene.build(
    TinyClip(frames=3, width=32, height=24), {out!r}, editor=Slow(), weathers=("snow", "rain")
)
"""


def test_a_killed_process_is_continued_by_another(scene: WeatherScene, out: Path) -> None:
    code = _KILLED.format(tests=str(Path(__file__).parents[1]), out=str(out))
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        try:
            with pytest.raises(ConflictError, match=f"by process {process.pid} on"):
                WeatherScene.build(CLIP, out, editor=Tinting(), weathers=SNOW_RAIN)
        finally:
            process.send_signal(signal.SIGKILL)
        assert process.wait(timeout=30) == -signal.SIGKILL
    editor = Tinting()
    WeatherScene.build(CLIP, out, editor=editor, weathers=SNOW_RAIN)
    assert [key.time_index for key, _ in editor.edited[::4]] == [0, 1, 2]
    assert digests_of(out) == digests_of(scene.path)
