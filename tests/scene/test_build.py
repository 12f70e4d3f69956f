"""Building a scene: whole or absent, and continued where it stopped."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_clip import TinyClip, digests_of

from weather_aug import _files
from weather_aug.clip.types import Box, Float64, Frame, FrameKey
from weather_aug.edit.ambience import ambience_of
from weather_aug.edit.physical.layers import Layers
from weather_aug.errors import (
    ArgumentError,
    ClipError,
    ConflictError,
    DataError,
    IntegrityError,
    OutputError,
)
from weather_aug.scene import build as building
from weather_aug.scene import publish, store
from weather_aug.scene.layers import Street
from weather_aug.scene.route import street_axes
from weather_aug.scene.scene import WeatherScene

WORK = ".building"


@dataclass
class Watched:
    """A clip that notes what is read of it and fails where it is told to."""

    clip: TinyClip = field(default_factory=TinyClip)
    fault: Callable[[FrameKey], Exception | None] = lambda key: None
    change: Callable[[Frame], Frame] = lambda frame: frame
    read: list[FrameKey] = field(default_factory=list)

    @property
    def name(self) -> str:
        return self.clip.name

    @property
    def cameras(self) -> tuple[str, ...]:
        return self.clip.cameras

    @property
    def keys(self) -> tuple[FrameKey, ...]:
        return self.clip.keys

    @property
    def up_world(self) -> Float64:
        return self.clip.up_world

    def frame(self, key: FrameKey) -> Frame:
        fault = self.fault(key)
        if fault is not None:
            raise fault
        self.read.append(key)
        return self.change(self.clip.frame(key))


def failing_at(index: int, fault: Exception | None = None) -> Watched:
    clip = TinyClip()
    key = clip.keys[index]
    return Watched(clip, lambda k: (fault or RuntimeError("power cut")) if k == key else None)


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "scene"


def interrupt(out: Path, index: int) -> None:
    with pytest.raises(RuntimeError, match="power cut"):
        WeatherScene.build(failing_at(index), out)
    assert not out.exists()


# Whole


def test_the_folder_holds_what_the_manifest_lists(tiny_scene: WeatherScene) -> None:
    assert set(digests_of(tiny_scene.path)) == {store.MANIFEST, *tiny_scene.manifest.files}
    assert not tiny_scene.path.with_name(tiny_scene.path.name + WORK).exists()


def test_two_builds_give_the_same_bytes(tiny_scene: WeatherScene, out: Path) -> None:
    again = WeatherScene.build(TinyClip(), out)
    assert digests_of(out) == digests_of(tiny_scene.path)
    assert again.digest == tiny_scene.digest


@dataclass(frozen=True)
class Busy(TinyClip):
    """The tiny street with a car ahead."""

    def frame(self, key: FrameKey) -> Frame:
        pose = np.eye(4)
        pose[:3, 3] = (20.0 + key.time_index, 0.0, 0.75)
        car = Box(5, "car", pose, (4.4, 1.8, 1.5), np.array([10.0, 0.0, 0.0]))
        return replace(super().frame(key), boxes=(car,))


def test_boxes_are_built_into_the_scene(out: Path, tmp_path: Path) -> None:
    clip = Busy(frames=2)
    scene = WeatherScene.build(clip, out)
    for key in clip.keys:
        (clean,), (stored,) = clip.frame(key).boxes, scene.frame(key).boxes
        assert (stored.track_id, stored.class_name, stored.size_m) == (5, "car", (4.4, 1.8, 1.5))
        assert (stored.world_from_box == clean.world_from_box).all()
        assert stored.velocity_m_per_s.tolist() == [10.0, 0.0, 0.0]
    again = WeatherScene.build(clip, tmp_path / "again")
    assert digests_of(again.path) == digests_of(scene.path)
    path = next(scene.path.rglob("*boxes.json"))
    path.write_bytes(path.read_bytes().replace(b"20.0", b"30.0"))
    assert ["boxes.json" in problem for problem in scene.damaged_files()] == [True]


def test_time_starts_at_zero(out: Path) -> None:
    late = Watched(change=lambda frame: replace(frame, time_s=frame.time_s + 1.7e9))
    scene = WeatherScene.build(late, out)
    times_s = [scene.frame(key).time_s for key in scene.keys]
    assert times_s == pytest.approx([0, 0, 0.1, 0.1, 0.2, 0.2, 0.3, 0.3], abs=1e-6)


def test_the_airlight_is_the_clips_median(tiny_clip: TinyClip, tiny_scene: WeatherScene) -> None:
    measured = [ambience_of(tiny_clip.frame(key), np.eye(3)).airlight for key in tiny_clip.keys]
    assert tiny_scene.manifest.airlight.tolist() == np.median(measured, axis=0).tolist()


def test_unrelated_pictures_have_no_airlight_in_common(out: Path) -> None:
    clip = Watched()
    clip.is_drive = False  # type: ignore[attr-defined]
    scene = WeatherScene.build(clip, out)
    assert scene.manifest.airlight is None
    for key in clip.keys:
        expected = ambience_of(TinyClip().frame(key), np.eye(3)).airlight
        assert scene.ambience(key).airlight.tolist() == expected.tolist()
    assert len({tuple(scene.ambience(key).airlight) for key in clip.keys}) > 1


def test_street_axes_are_the_way_the_rig_went(tiny_scene: WeatherScene) -> None:
    assert np.allclose(np.eye(3), tiny_scene.manifest.axes_world)


def test_street_axes_of_a_rig_that_stands_are_the_first_cameras_view() -> None:
    entry = {"camera": "front", "world_from_camera": TinyClip().camera(FrameKey(0, "right"))}
    pose = entry["world_from_camera"].world_from_camera.tolist()
    axes = street_axes([{"camera": "a", "world_from_camera": pose}], np.array([0, 0, 2.0]))
    yaw = np.radians(-30)
    assert np.allclose([np.cos(yaw), np.sin(yaw), 0], axes[0])
    assert np.allclose([-np.sin(yaw), np.cos(yaw), 0], axes[1])
    assert np.allclose([0, 0, 1], axes[2])


def test_up_is_not_assumed_to_be_an_axis() -> None:
    """A clip in any world has axes that are right-handed, up and level."""
    rng = np.random.default_rng(4)
    up = np.linalg.qr(rng.normal(size=(3, 3)))[0][0]
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, 3] = 10 * rng.normal(size=3)
    entries = [{"camera": "a", "world_from_camera": pose.tolist()} for pose in poses]
    axes = street_axes(entries, up)
    assert np.allclose(np.eye(3), axes @ axes.T)
    assert np.isclose(1, np.linalg.det(axes))
    assert np.allclose(up, axes[2])
    assert axes[0] @ poses[1, :3, 3] > 0


# Refused


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"editor": "photoshop"}, "editor 'photoshop'"),
        ({"weathers": ("rain", "hail")}, "weather 'hail'"),
        ({"weathers": "rain"}, "weather 'a'"),
    ],
)
def test_unknown_choices_are_refused(out: Path, arguments: dict[str, Any], says: str) -> None:
    with pytest.raises(ArgumentError, match=says):
        WeatherScene.build(TinyClip(), out, **arguments)
    assert list(out.parent.iterdir()) == []


@pytest.mark.parametrize(
    ("clip", "says"),
    [
        (TinyClip(frames=0), "no frames"),
        (TinyClip(name="../evil"), "clip name"),
        (TinyClip(name="a\nb"), "clip name"),
        (TinyClip(name=""), "clip name"),
        (TinyClip(cameras=("../front",)), "camera name"),
        (TinyClip(cameras=("front", "front")), "twice"),
        (TinyClip(up_world=np.zeros(3)), "unit vector"),
        (TinyClip(up_world=np.array([0, 0, np.nan])), "unit vector"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_clip_that_cannot_be_stored_is_refused_before_work(
    out: Path, clip: TinyClip, says: str
) -> None:
    watched = Watched(clip)
    with pytest.raises(DataError, match=says):
        WeatherScene.build(watched, out)
    assert watched.read == []
    assert list(out.parent.iterdir()) == []


BAD_FRAMES: dict[str, Watched] = {
    "damaged": failing_at(5, ClipError("frame 5 cannot be read")),
    "no depth": Watched(change=lambda frame: replace(frame, depth_m=None)),
    "no time": Watched(change=lambda frame: replace(frame, time_s=np.nan)),
    "NaN depth": Watched(
        change=lambda frame: replace(frame, depth_m=np.full(frame.image.shape[:2], np.nan))
    ),
    "unknown label": Watched(
        change=lambda frame: replace(frame, label=np.full_like(frame.label, 77))
    ),
    "looks up": Watched(
        TinyClip(frames=1),
        change=lambda frame: replace(
            frame, camera=replace(frame.camera, world_from_camera=np.eye(4))
        ),
    ),
}


@pytest.mark.parametrize("clip", BAD_FRAMES.values(), ids=BAD_FRAMES.keys())
def test_bad_input_leaves_nothing_behind(out: Path, clip: Watched) -> None:
    with pytest.raises(DataError):
        WeatherScene.build(clip, out)
    assert list(out.parent.iterdir()) == []


def test_missing_parent_folders_are_made(tmp_path: Path) -> None:
    scene = WeatherScene.build(TinyClip(frames=1), tmp_path / "a" / "b" / "scene")
    assert [path.name for path in (tmp_path / "a" / "b").iterdir()] == ["scene"]
    assert scene.damaged_files() == []


def test_a_parent_that_is_a_file_is_an_output_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OutputError, match="cannot write"):
        WeatherScene.build(TinyClip(), tmp_path / "file" / "scene")
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize("below", ["scene", "frames/a/scene"])
def test_a_place_inside_a_scene_is_refused(out: Path, below: str) -> None:
    WeatherScene.build(TinyClip(frames=1), out)
    before = digests_of(out.parent)
    with pytest.raises(OutputError, match="lies inside the scene"):
        WeatherScene.build(TinyClip(), out / below)
    assert digests_of(out.parent) == before
    assert not (out / "frames" / "a").exists()


def test_a_full_disk_keeps_the_work_and_says_so(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[Path] = []
    whole = _files.write_whole

    def full(path: Path, data: bytes) -> None:
        written.append(path)
        if len(written) == 9:
            with _files.reported(path):
                raise OSError(28, "No space left on device")
        whole(path, data)

    monkeypatch.setattr(_files, "write_whole", full)
    with pytest.raises(OutputError, match=r"No space left.*free some space"):
        WeatherScene.build(TinyClip(), out)
    assert not out.exists()
    monkeypatch.undo()
    assert WeatherScene.build(TinyClip(), out, overwrite=False).damaged_files() == []


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("kind", ["folder", "file"])
def test_what_stands_there_is_not_touched(out: Path, kind: str, overwrite: bool) -> None:
    if kind == "file":
        out.write_text("mine")
    else:
        out.mkdir()
        (out / "thesis.txt").write_text("mine")
    before = digests_of(out.parent)
    with pytest.raises(ConflictError, match="exists; choose another folder"):
        WeatherScene.build(TinyClip(), out, overwrite=overwrite)
    assert digests_of(out.parent) == before


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_scene_without_manifest_is_left_to_the_user(out: Path, overwrite: bool) -> None:
    """The cure that is named works; overwrite would not."""
    WeatherScene.build(TinyClip(frames=1), out)
    (out / store.MANIFEST).unlink()
    before = digests_of(out)
    with pytest.raises(ConflictError, match=r"remove it yourself.*overwrite does not") as caught:
        WeatherScene.build(TinyClip(frames=1), out, overwrite=overwrite)
    assert "pass overwrite" not in str(caught.value)
    assert digests_of(out) == before
    shutil.rmtree(out)
    assert WeatherScene.build(TinyClip(frames=1), out).damaged_files() == []


def test_a_scene_is_replaced_only_when_asked(out: Path) -> None:
    first = WeatherScene.build(TinyClip(frames=1), out)
    before = digests_of(out)
    with pytest.raises(ConflictError, match="overwrite"):
        WeatherScene.build(TinyClip(frames=2), out)
    assert digests_of(out) == before
    second = WeatherScene.build(TinyClip(frames=2), out, overwrite=True)
    assert (len(first.keys), len(second.keys)) == (2, 4)
    assert set(digests_of(out)) == {store.MANIFEST, *second.manifest.files}
    assert list(out.parent.iterdir()) == [out]


def test_a_link_to_a_scene_stays_a_link(out: Path, tmp_path: Path) -> None:
    WeatherScene.build(TinyClip(frames=1), out)
    link = tmp_path / "link"
    link.symlink_to(out)
    WeatherScene.build(TinyClip(frames=2), link, overwrite=True)
    assert link.is_symlink()
    assert len(WeatherScene.load(out).keys) == 4


def _cut_short(call: int, action: Callable[[], object]) -> bool:
    """Run `action` in a child that ends at its `call`-th change of a folder; whether it did."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9
    calls = 0

    def counted(function: Callable[..., Any]) -> Callable[..., Any]:
        def inner(*arguments: Any, **options: Any) -> Any:
            nonlocal calls
            calls += 1
            if calls == call:
                os._exit(9)
            return function(*arguments, **options)

        return inner

    for name in ("rename", "replace", "unlink", "rmdir", "fsync"):
        setattr(os, name, counted(getattr(os, name)))
    try:
        action()
    finally:
        os._exit(0)


def test_a_replacement_cut_short_anywhere_leaves_one_whole_scene(tmp_path: Path) -> None:
    old = WeatherScene.build(TinyClip(frames=1), tmp_path / "old")
    new = WeatherScene.build(TinyClip(frames=2), tmp_path / "new")
    files = new.manifest.files
    found = []
    for call in range(1, 100):
        out = tmp_path / str(call) / "scene"
        work = out.with_name(out.name + WORK)
        shutil.copytree(old.path, out)
        shutil.copytree(new.path, work)
        was_cut = _cut_short(call, lambda work=work, out=out: publish.publish(work, out, files))
        with pytest.raises(ConflictError, match="exists"):
            WeatherScene.build(TinyClip(frames=2), out)
        found.append(WeatherScene.load(out, verify=True).digest)
        assert {path.name for path in out.parent.iterdir()} <= {"scene", work.name}
        if not was_cut:
            break
    assert not was_cut
    assert list(dict.fromkeys(found)) == [old.digest, new.digest]
    assert len(found) > 10


def test_a_replacement_that_fails_puts_the_old_scene_back(
    out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = WeatherScene.build(TinyClip(frames=1), out)
    rename = Path.rename

    def refused(path: Path, target: Path) -> Path:
        if path.name.endswith(WORK):
            raise OSError(5, "Input/output error")
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", refused)
    with pytest.raises(OutputError, match="Input/output error"):
        WeatherScene.build(TinyClip(frames=2), out, overwrite=True)
    assert WeatherScene.load(out, verify=True).digest == old.digest


def test_a_strangers_folder_in_the_way_is_not_removed(out: Path) -> None:
    stranger = out.with_name("scene.replaced")
    stranger.mkdir()
    (stranger / "thesis.txt").write_text("mine")
    with pytest.raises(ConflictError, match=r"scene\.replaced.*move it elsewhere"):
        WeatherScene.build(TinyClip(frames=1), out)
    assert digests_of(out.parent).keys() == {"scene.replaced/thesis.txt"}


# Alone


def test_a_second_build_of_one_output_is_refused_and_harms_nothing(
    tiny_scene: WeatherScene, out: Path
) -> None:
    refused = []

    def meanwhile(key: FrameKey) -> None:
        with pytest.raises(ConflictError, match=f"being built by process {os.getpid()} on") as told:
            WeatherScene.build(TinyClip(), out, overwrite=True)
        refused.append(told.value.exit_code)

    WeatherScene.build(Watched(fault=meanwhile), out)
    assert refused == [5] * len(tiny_scene.keys)
    assert digests_of(out) == digests_of(tiny_scene.path)
    assert list(out.parent.iterdir()) == [out]


# Continued


@pytest.mark.parametrize("index", range(8))
def test_an_interrupted_build_is_continued(tiny_scene: WeatherScene, out: Path, index: int) -> None:
    """Finished frames are not read again, but for the first, which shows that it is the clip."""
    interrupt(out, index)
    again = Watched()
    WeatherScene.build(again, out)
    keys = TinyClip().keys
    assert again.read == [*keys[: min(index, 1)], *keys[index:]]
    assert digests_of(out) == digests_of(tiny_scene.path)
    assert not out.with_name(out.name + WORK).exists()


def test_a_build_may_be_interrupted_often(tiny_scene: WeatherScene, out: Path) -> None:
    for index in (0, 0, 0, 2, 2, 7):
        interrupt(out, index)
    WeatherScene.build(TinyClip(), out)
    assert digests_of(out) == digests_of(tiny_scene.path)


def test_a_build_of_another_process_is_continued(tiny_scene: WeatherScene, out: Path) -> None:
    """Nothing in the journal depends on the process, such as the address of the clip."""
    interrupt(out, 6)
    journal = (out.with_name(out.name + WORK) / building.JOURNAL).read_text()
    assert " at 0x" not in journal
    assert hex(id(TinyClip())) not in journal
    assert len(journal.splitlines()) == 7


# The second round


def interrupt_second(out: Path, index: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cut a build when it looks at its `index`-th frame."""
    seen = building.layers_seen
    key = TinyClip().keys[index]

    def cut(frame: Frame, street: Street, mirrored: None) -> Layers:
        if frame.key == key:
            raise RuntimeError("power cut")
        return seen(frame, street, mirrored)

    with monkeypatch.context() as patch:
        patch.setattr(building, "layers_seen", cut)
        with pytest.raises(RuntimeError, match="power cut"):
            WeatherScene.build(TinyClip(), out)
    assert not out.exists()


def looked(monkeypatch: pytest.MonkeyPatch) -> list[FrameKey]:
    """Keys of the frames that are looked at from now on."""
    keys: list[FrameKey] = []
    seen = building.layers_seen

    def noted(frame: Frame, street: Street, mirrored: None) -> Layers:
        keys.append(frame.key)
        return seen(frame, street, mirrored)

    monkeypatch.setattr(building, "layers_seen", noted)
    return keys


@pytest.mark.parametrize("index", [0, 1, 5, 7])
def test_an_interrupted_second_round_is_continued(
    tiny_scene: WeatherScene, out: Path, index: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupt_second(out, index, monkeypatch)
    again, found = Watched(), looked(monkeypatch)
    WeatherScene.build(again, out)
    keys = TinyClip().keys
    assert again.read == [keys[0]]
    assert found == [*keys[: min(index, 1)], *keys[index:]]
    assert digests_of(out) == digests_of(tiny_scene.path)
    assert list(out.parent.iterdir()) == [out]


@pytest.mark.parametrize("part", ["layers", "small"])
def test_a_spoilt_layer_costs_one_frame(
    tiny_scene: WeatherScene, out: Path, part: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupt_second(out, 6, monkeypatch)
    keys = TinyClip().keys
    path = out.with_name(out.name + WORK) / store.part_path(keys[2], part)
    path.write_bytes(path.read_bytes()[:-1])
    found = looked(monkeypatch)
    WeatherScene.build(TinyClip(), out)
    assert found == [keys[0], keys[2], *keys[6:]]
    assert digests_of(out) == digests_of(tiny_scene.path)


def test_layers_of_another_look_are_thrown_away(
    tiny_scene: WeatherScene, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A planted fault: the editor looked at frames otherwise when the work was cut."""
    seen = building.layers_seen
    aside = np.array([[0.0, 3.0], [1.0, 3.0]])
    with monkeypatch.context() as patch:
        patch.setattr(
            building,
            "layers_seen",
            lambda frame, street, mirrored: seen(frame, street._replace(route=aside), mirrored),
        )
        interrupt_second(out, 6, patch)
    stray = out.with_name(out.name + WORK) / store.part_path(TinyClip().keys[0], "classes")
    stray.write_bytes(b"left over")
    found = looked(monkeypatch)
    WeatherScene.build(TinyClip(), out)
    assert found == [TinyClip().keys[0], *TinyClip().keys]
    assert digests_of(out) == digests_of(tiny_scene.path)


def test_layers_belong_to_all_frames(
    tiny_scene: WeatherScene, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The way driven is the whole drive's; layers of another drive's first frames are none of it.

    The first frames are alike, so that only the digest of all can tell.
    """
    interrupt_second(out, 6, monkeypatch)
    work = out.with_name(out.name + WORK)
    journal = work / building.LAYERS_JOURNAL
    lines = journal.read_text().splitlines()
    journal.write_text("\n".join(['{"layers": "of another drive"}', *lines[1:]]) + "\n")
    found = looked(monkeypatch)
    WeatherScene.build(TinyClip(), out)
    assert found == list(TinyClip().keys)
    assert digests_of(out) == digests_of(tiny_scene.path)


def test_a_full_disk_in_the_second_round_keeps_the_work(
    out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = _files.write_whole

    def full(path: Path, data: bytes) -> None:
        if path.name == "000001_front.small.npy":
            with _files.reported(path):
                raise OSError(28, "No space left on device")
        whole(path, data)

    with monkeypatch.context() as patch:
        patch.setattr(_files, "write_whole", full)
        with pytest.raises(OutputError, match="free some space"):
            WeatherScene.build(TinyClip(frames=2), out)
    assert not out.exists()
    again = Watched(TinyClip(frames=2))
    assert WeatherScene.build(again, out).damaged_files() == []
    assert again.read == [TinyClip().keys[0]]


def _cut_journal(work: Path) -> None:
    text = (work / building.JOURNAL).read_text()
    (work / building.JOURNAL).write_text(text[: len(text) - 40])


def _spoil_frame(work: Path) -> None:
    path = work / store.part_path(TinyClip().keys[2], "depth")
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)


def _lose_frame(work: Path) -> None:
    (work / store.part_path(TinyClip().keys[2], "image")).unlink()


def _zero_journals_end(work: Path) -> None:
    with (work / building.JOURNAL).open("ab") as file:
        file.write(bytes(4096))


@pytest.mark.parametrize(
    ("harm", "lost"),
    [(_cut_journal, 5), (_spoil_frame, 2), (_lose_frame, 2), (_zero_journals_end, None)],
)
def test_a_crash_that_cut_a_file_costs_one_frame(
    tiny_scene: WeatherScene, out: Path, harm: Callable[[Path], None], lost: int | None
) -> None:
    interrupt(out, 6)
    harm(out.with_name(out.name + WORK))
    again = Watched()
    WeatherScene.build(again, out)
    keys = TinyClip().keys
    expected = [keys[0], *([] if lost is None else [keys[lost]]), *keys[6:]]
    assert again.read == expected
    assert digests_of(out) == digests_of(tiny_scene.path)


@pytest.mark.parametrize("harm", [b"", b"no journal", b"\xff\xfe", b"{}\n", b"[]\n3\n"])
def test_a_spoilt_journal_starts_over(tiny_scene: WeatherScene, out: Path, harm: bytes) -> None:
    interrupt(out, 6)
    (out.with_name(out.name + WORK) / building.JOURNAL).write_bytes(harm)
    again = Watched()
    WeatherScene.build(again, out)
    assert again.read == list(TinyClip().keys)
    assert digests_of(out) == digests_of(tiny_scene.path)


@pytest.mark.parametrize(
    "other",
    [
        TinyClip(name="other"),
        TinyClip(frames=3),
        TinyClip(cameras=("right",)),
        TinyClip(labelled=False),
        TinyClip(width=80),
    ],
    ids=["name", "frames", "cameras", "labels", "size"],
)
def test_work_on_another_clip_is_thrown_away(out: Path, other: TinyClip) -> None:
    """Nothing of it stays: neither its frames, nor files that the manifest does not list."""
    interrupt(out, 6)
    scene = WeatherScene.build(other, out)
    assert set(digests_of(out)) == {store.MANIFEST, *scene.manifest.files}
    whole = WeatherScene.build(other, out.with_name("whole"))
    assert digests_of(out) == digests_of(whole.path)


_KILLED = """
import os, signal, sys
sys.path.insert(0, {tests!r})
from tiny_clip import TinyClip
from weather_aug.scene import build
from weather_aug.scene.scene import WeatherScene

class Slow(TinyClip):
    def frame(self, key):
        if key == self.keys[5]:
            print("ready", flush=True)
            signal.pause()
        return super().frame(key)

WeatherScene.build(Slow(), {out!r})
"""


def test_a_killed_build_is_continued(tiny_scene: WeatherScene, out: Path) -> None:
    code = _KILLED.format(tests=str(Path(__file__).parents[1]), out=str(out))
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        try:
            with pytest.raises(ConflictError, match=f"by process {process.pid} on"):
                WeatherScene.build(TinyClip(), out)
        finally:
            process.send_signal(signal.SIGKILL)
        assert process.wait(timeout=30) == -signal.SIGKILL
    assert not out.exists()
    again = Watched()
    WeatherScene.build(again, out)
    keys = TinyClip().keys
    assert again.read == [keys[0], *keys[5:]]
    assert digests_of(out) == digests_of(tiny_scene.path)
    assert list(out.parent.iterdir()) == [out]


_KILLED_ANYWHERE = """
import os, signal, sys
sys.path.insert(0, {tests!r})
from tiny_clip import TinyClip
from weather_aug import _files
from weather_aug.scene.scene import WeatherScene

calls = 0
def counted(function):
    def inner(*arguments, **options):
        global calls
        calls += 1
        if calls == {last}:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*arguments, **options)
    return inner

os.fsync = counted(os.fsync)
os.replace = counted(os.replace)
_files.sync_folder = counted(_files.sync_folder)
WeatherScene.build(TinyClip(frames=2), {out!r})
print(calls)
"""


@pytest.mark.slow
@pytest.mark.parametrize("last", range(1, 110, 3))
def test_a_build_killed_at_any_write_is_continued(out: Path, last: int) -> None:
    code = _KILLED_ANYWHERE.format(tests=str(Path(__file__).parents[1]), out=str(out), last=last)
    subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, timeout=60)
    if not out.exists():
        WeatherScene.build(TinyClip(frames=2), out)
    whole = WeatherScene.build(TinyClip(frames=2), out.with_name("whole"))
    assert digests_of(out) == digests_of(whole.path)


def test_damage_after_the_build_is_not_hidden_by_the_journal(out: Path) -> None:
    WeatherScene.build(TinyClip(), out)
    assert not (out / building.JOURNAL).exists()
    (out / store.part_path(TinyClip().keys[0], "image")).unlink()
    with pytest.raises(IntegrityError, match="missing"):
        WeatherScene.load(out)


def test_the_work_folder_may_be_a_strangers_file(out: Path) -> None:
    out.with_name(out.name + WORK).write_text("mine")
    with pytest.raises(OutputError, match="cannot write"):
        WeatherScene.build(TinyClip(), out)
    assert out.with_name(out.name + WORK).read_text() == "mine"
