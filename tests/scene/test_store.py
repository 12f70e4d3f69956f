"""The scene folder: what goes in comes out, and what was tampered with is found."""

from __future__ import annotations

import io
import json
import pickle
import shutil
import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tiny_clip import TinyClip, digests_of

from weather_aug import _files
from weather_aug.clip.types import Box, Frame, FrameKey
from weather_aug.edit.ambience import Ambience
from weather_aug.edit.background import STYLES
from weather_aug.errors import DataError, IntegrityError, SceneError, WeatherAugError
from weather_aug.scene import store
from weather_aug.scene.backgrounds_record import background_path
from weather_aug.scene.boxes import MAX_BOXES, MAX_BOXES_BYTES, read_boxes
from weather_aug.scene.scene import WeatherScene

FIRST = "frames/000000_front"
PARTS = [f"{FIRST}.png", f"{FIRST}.depth.npy", f"{FIRST}.label.npy"]


@pytest.fixture
def folder(tiny_scene: WeatherScene, tmp_path: Path) -> Path:
    """A copy of the tiny scene that a test may harm."""
    return Path(shutil.copytree(tiny_scene.path, tmp_path / "scene"))


def rewrite(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Edit the manifest as JSON and seal it again, as somebody would on purpose."""
    path = folder / store.MANIFEST
    content = json.loads(path.read_text())
    change(content)
    content.pop("sha256", None)
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    path.write_text(json.dumps(content | {"sha256": _files.sha256_of(text.encode())}))


def plant(folder: Path, relative: str, data: bytes) -> None:
    """Replace a file together with its record in the manifest, as somebody would on purpose."""
    (folder / relative).write_bytes(data)
    record = {"size": len(data), "sha256": _files.sha256_of(data)}
    rewrite(folder, lambda m: m["files"].update({relative: record}))


def npy(array: NDArray[Any], *, allow_pickle: bool = False) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=allow_pickle)
    return buffer.getvalue()


# What goes in comes out


def test_frames_come_back_as_they_went_in(tiny_clip: TinyClip, tiny_scene: WeatherScene) -> None:
    assert tiny_scene.keys == tiny_clip.keys
    assert tiny_scene.cameras == tiny_clip.cameras
    for key in tiny_clip.keys:
        clean, stored = tiny_clip.frame(key), tiny_scene.frame(key)
        assert stored.image.tobytes() == clean.image.tobytes()
        assert stored.label is not None
        assert stored.label.tobytes() == clean.label.tobytes()
        assert stored.depth_m is not None
        assert stored.depth_m.dtype == np.float16
        assert stored.depth_m.tobytes() == clean.depth_m.astype(np.float16).tobytes()
        assert stored.key == key
        assert stored.time_s == clean.time_s
        for name in ("intrinsics", "world_from_camera", "velocity_m_per_s"):
            assert (getattr(stored.camera, name) == getattr(clean.camera, name)).all()
        assert stored.camera.exposure_s == clean.camera.exposure_s
        assert tiny_scene.size_of(key) == clean.image.shape[:2]


def test_a_frame_without_label_stays_without(tmp_path: Path) -> None:
    scene = WeatherScene.build(TinyClip(frames=1, labelled=False), tmp_path / "scene")
    assert all(scene.frame(key).label is None for key in scene.keys)
    assert not list(scene.path.rglob("*label*"))


def test_depth_that_says_nothing_becomes_the_sky(tiny_clip: TinyClip) -> None:
    frame = tiny_clip.frame(tiny_clip.keys[0])
    depth = np.full(frame.image.shape[:2], 7.0, np.float32)
    depth[0, :6] = (np.nan, 0.0, -3.0, np.inf, 1e9, 65000.0)
    data = store.encode_frame(replace(frame, depth_m=depth))["depth"]
    stored = np.load(io.BytesIO(data))
    assert stored[0, :5].tolist() == [np.inf] * 5
    assert stored[0, 5] == np.float16(65000)
    assert (stored[1:] == 7).all()


def test_a_depth_of_nothing_but_nan_is_refused(tiny_clip: TinyClip) -> None:
    frame = tiny_clip.frame(tiny_clip.keys[0])
    depth = np.full(frame.image.shape[:2], np.nan, np.float32)
    with pytest.raises(SceneError, match="000000_front: depth is NaN everywhere"):
        store.encode_frame(replace(frame, depth_m=depth))


def test_a_label_of_another_taxonomy_is_refused(tiny_clip: TinyClip) -> None:
    frame = tiny_clip.frame(tiny_clip.keys[0])
    label = frame.label.copy()
    label[3, 3] = 26
    with pytest.raises(SceneError, match="label holds 26"):
        store.encode_frame(replace(frame, label=label))
    label[3, 3] = 255
    assert store.encode_frame(replace(frame, label=label))


def boxed(clip: TinyClip, boxes: tuple[Box, ...]) -> Frame:
    return replace(clip.frame(clip.keys[0]), boxes=boxes)


def some_boxes() -> tuple[Box, ...]:
    pose = np.eye(4)
    pose[:3, 3] = (12.0, 1.0 / 3.0, 0.75)
    car = Box(2**40 + 7, "Bus/RV/Caravan", pose, (4.5, 1.8, 1.5), np.array([8.0, 0.1, 0.0]))
    return car, Box(-3, "person", np.eye(4), (0.5, 0.5, 1.7))


def test_boxes_come_back_as_they_went_in(tiny_clip: TinyClip, tmp_path: Path) -> None:
    data = store.encode_frame(boxed(tiny_clip, some_boxes()))["boxes"]
    assert data == store.encode_frame(boxed(tiny_clip, some_boxes()))["boxes"]
    path = tmp_path / "boxes.json"
    path.write_bytes(data)
    stored = read_boxes(path)
    assert len(stored) == 2
    for clean, back in zip(some_boxes(), stored, strict=True):
        assert (clean.track_id, clean.class_name) == (back.track_id, back.class_name)
        assert clean.size_m == back.size_m
        assert clean.world_from_box.tobytes() == back.world_from_box.tobytes()
    assert stored[0].velocity_m_per_s is not None and stored[1].velocity_m_per_s is None
    assert stored[0].velocity_m_per_s.tolist() == [8.0, 0.1, 0.0]
    assert not stored[0].world_from_box.flags.writeable


def test_a_frame_without_boxes_has_no_file_of_them(
    tiny_clip: TinyClip, tiny_scene: WeatherScene
) -> None:
    assert not list(tiny_scene.path.rglob("*boxes*"))
    assert tiny_scene.frame(tiny_scene.keys[0]).boxes == ()
    assert "boxes" not in store.encode_frame(tiny_clip.frame(tiny_clip.keys[0]))


@pytest.mark.parametrize(
    "box",
    [
        Box(1, "a\nb", np.eye(4), (1, 1, 1)),
        Box(1, "", np.eye(4), (1, 1, 1)),
        Box(1, "x" * 65, np.eye(4), (1, 1, 1)),
        Box(2**64, "car", np.eye(4), (1, 1, 1)),
        Box(1, "car", np.eye(4), (1, 1, 1e11)),
    ],
)
def test_a_box_that_no_scene_holds_is_refused(tiny_clip: TinyClip, box: Box) -> None:
    with pytest.raises(SceneError, match="000000_front: a box cannot be stored"):
        store.encode_frame(boxed(tiny_clip, (box,)))


def test_the_largest_frame_of_boxes_can_be_read(tiny_clip: TinyClip, tmp_path: Path) -> None:
    pose = np.eye(4)
    pose[:3, 3] = -1.0 / 3e-5
    worst = Box(2**64 - 1, "\U0001f697" * 64, pose, (1 / 3,) * 3, np.full(3, -1 / 3e2))
    path = tmp_path / "boxes.json"
    path.write_bytes(store.encode_frame(boxed(tiny_clip, (worst,) * MAX_BOXES))["boxes"])
    assert path.stat().st_size < MAX_BOXES_BYTES
    assert len(read_boxes(path)) == MAX_BOXES
    with pytest.raises(SceneError, match=f"{MAX_BOXES + 1} boxes"):
        store.encode_frame(boxed(tiny_clip, (worst,) * (MAX_BOXES + 1)))


def _spoilt(**changes: Any) -> Any:
    entry = {
        "track_id": 1,
        "class_name": "car",
        "world_from_box": np.eye(4).tolist(),
        "size_m": [1.0, 1.0, 1.0],
        "velocity_m_per_s": None,
    }
    return {"boxes": [entry | changes]}


@pytest.mark.parametrize(
    "content",
    [
        [],
        {},
        {"boxes": {}},
        {"boxes": [7]},
        {"boxes": [{}]},
        {"boxes": [_spoilt()["boxes"][0]] * (MAX_BOXES + 1)},
        _spoilt(track_id="7"),
        _spoilt(track_id=2**70),
        _spoilt(class_name=7),
        _spoilt(class_name="\x1b[2J"),
        _spoilt(world_from_box=[[1e300] * 4] * 4),
        _spoilt(world_from_box=np.diag([1.0, 1.0, -1.0, 1.0]).tolist()),
        _spoilt(size_m=[1.0, 1.0]),
        _spoilt(size_m=[1.0, 1.0, -1.0]),
        _spoilt(size_m="car"),
        _spoilt(velocity_m_per_s=[1e9, 0.0, 0.0]),
        _spoilt(velocity_m_per_s=[0.0]),
    ],
)
def test_malformed_boxes_are_refused(tmp_path: Path, content: Any) -> None:
    path = tmp_path / "boxes.json"
    path.write_text(json.dumps(_spoilt()))
    assert len(read_boxes(path)) == 1
    path.write_text(json.dumps(content))
    with pytest.raises(SceneError, match=r"boxes\.json holds no boxes.*build the scene again"):
        read_boxes(path)


@pytest.mark.parametrize(
    "data", [b"", b"{", b"\xff", b'{"boxes": NaN}', b" " * MAX_BOXES_BYTES * 2]
)
def test_a_file_that_is_no_json_holds_no_boxes(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "boxes.json"
    path.write_bytes(data)
    with pytest.raises(SceneError, match="holds no boxes"):
        read_boxes(path)
    path.unlink()
    with pytest.raises(SceneError, match="holds no boxes"):
        read_boxes(path)


@pytest.mark.parametrize("time_s", [np.nan, np.inf, 1e11])
def test_a_time_that_is_none_is_refused(tiny_clip: TinyClip, time_s: float) -> None:
    frame = tiny_clip.frame(tiny_clip.keys[0])
    with pytest.raises(SceneError, match="time"):
        store.encode_frame(replace(frame, time_s=time_s))


def test_arrays_are_what_numpy_writes(tiny_clip: TinyClip) -> None:
    """Anybody can read them; the header is ours so that its bytes never change."""
    frame = tiny_clip.frame(tiny_clip.keys[0])
    parts = store.encode_frame(frame)
    assert parts["depth"] == npy(frame.depth_m.astype(np.float16))
    assert parts["label"] == npy(frame.label)


def test_the_same_frame_gives_the_same_bytes(tiny_clip: TinyClip) -> None:
    key = tiny_clip.keys[1]
    assert store.encode_frame(tiny_clip.frame(key)) == store.encode_frame(tiny_clip.frame(key))


def test_the_longest_manifest_opens_under_its_own_limit(tiny_clip: TinyClip) -> None:
    """The most frames of the longest names and numbers stay below what is read."""
    longest = -1.2345678901234567e-300
    name = "c" * 64
    frame = tiny_clip.frame(tiny_clip.keys[0])
    colour = np.full(3, longest)
    ambience = Ambience(np.eye(3), colour, colour, colour, colour)
    entry = store.frame_record(replace(frame, key=FrameKey(store.MAX_FRAMES, name)), ambience)
    for field, shape in (("intrinsics", (3, 3)), ("world_from_camera", (4, 4))):
        entry[field] = np.full(shape, longest).tolist()
    for field in ("velocity_m_per_s", "angular_velocity_rad_per_s"):
        entry[field] = np.full(3, longest).tolist()
    for field in ("time_s", "exposure_s", "aperture_m"):
        entry[field] = longest
    numbers = {"tint": [longest] * 3, "plane": [longest] * 3, "illumination": longest}
    entry["layers"] = {"step": 12, **numbers}
    file = {"size": 10**9, "sha256": "f" * 64}
    parts = ("image", "depth", "label", "boxes", "layers", "small", "classes")
    key = FrameKey(store.MAX_FRAMES, name)
    entry["files"] = {part: store.part_path(key, part) for part in parts}
    styled = [background_path(style, key) for style in STYLES]
    files = {path: file for path in (*entry["files"].values(), *styled)}
    empty = len(store.manifest_bytes({"frames": [], "files": {}}))
    each = len(store.manifest_bytes({"frames": [entry], "files": files})) - empty
    assert 1000 < each
    assert each * store.MAX_FRAMES + 10_000 <= store.MAX_MANIFEST_BYTES


def test_a_clip_longer_than_a_manifest_is_refused_before_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(store, "MAX_FRAMES", 7)
    with pytest.raises(DataError, match=r"8 frames.*7.*in parts"):
        WeatherScene.build(TinyClip(), tmp_path / "scene")
    assert list(tmp_path.iterdir()) == []


# What was tampered with is found


@pytest.mark.parametrize("relative", PARTS)
@pytest.mark.parametrize("place", [0.0, 0.5, 1.0], ids=["start", "middle", "end"])
def test_one_flipped_bit_is_found(folder: Path, relative: str, place: float) -> None:
    scene = WeatherScene.load(folder, verify=True)
    assert scene.damaged_files() == []
    data = bytearray((folder / relative).read_bytes())
    data[round(place * (len(data) - 1))] ^= 1
    (folder / relative).write_bytes(data)
    with pytest.raises(IntegrityError, match=f"{relative} has changed.*build it again"):
        WeatherScene.load(folder, verify=True)
    assert [relative in problem for problem in scene.damaged_files()] == [True]


def test_a_changed_manifest_is_another_scene(folder: Path) -> None:
    before = WeatherScene.load(folder).digest
    rewrite(folder, lambda m: m["airlight"].__setitem__(0, m["airlight"][0] * 0.999))
    assert WeatherScene.load(folder).digest != before


@pytest.mark.parametrize("field", ["airlight", "intrinsics", "time_s", "sha256"])
def test_one_changed_digit_of_the_manifest_is_found_at_load(folder: Path, field: str) -> None:
    """Of a number that stays in its range, so that nothing else can tell."""
    path = folder / store.MANIFEST
    text = path.read_text()
    start = text.rindex(f'"{field}"')
    # The second digit, lest a leading one turns into 0 or the number leaves its range.
    place = [i for i in range(start + len(field) + 2, len(text)) if text[i].isdigit()][1]
    path.write_text(f"{text[:place]}{(int(text[place]) + 1) % 10}{text[place + 1 :]}")
    with pytest.raises(IntegrityError, match=r"scene\.json has changed.*build the scene again"):
        WeatherScene.load(folder)


def test_a_manifest_without_its_seal_is_found_at_load(folder: Path) -> None:
    path = folder / store.MANIFEST
    content = json.loads(path.read_text())
    assert len(content.pop("sha256")) == 64
    path.write_text(json.dumps(content))
    with pytest.raises(IntegrityError, match="has changed"):
        WeatherScene.load(folder)


def test_the_seal_is_of_the_content_not_of_its_layout(folder: Path) -> None:
    path = folder / store.MANIFEST
    path.write_text(json.dumps(json.loads(path.read_text()), sort_keys=True))
    assert WeatherScene.load(folder).keys


def _truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


def _append(path: Path) -> None:
    path.write_bytes(path.read_bytes() + b"\0")


def _empty(path: Path) -> None:
    path.write_bytes(b"")


def _link(path: Path) -> None:
    moved = path.with_name("moved")
    path.rename(moved)
    path.symlink_to(moved)


def _folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


@pytest.mark.parametrize("relative", PARTS)
@pytest.mark.parametrize("harm", [Path.unlink, _truncate, _append, _empty, _link, _folder])
def test_a_file_of_another_size_or_kind_is_found_at_load(
    folder: Path, relative: str, harm: Callable[[Path], object]
) -> None:
    harm(folder / relative)
    with pytest.raises(IntegrityError, match=f"{relative}.*build the scene again"):
        WeatherScene.load(folder)


@pytest.mark.parametrize("relative", PARTS)
def test_a_file_that_goes_while_the_scene_is_open_is_a_typed_error(
    folder: Path, relative: str
) -> None:
    scene = WeatherScene.load(folder)
    (folder / relative).unlink()
    with pytest.raises(SceneError, match=f"{relative} cannot be read"):
        scene.frame(scene.keys[0])
    assert any(relative in problem for problem in scene.damaged_files())


def test_a_folder_that_is_no_scene_says_how_to_make_one(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "missing"):
        with pytest.raises(SceneError, match=r"not a scene.*weather-aug build"):
            WeatherScene.load(path)


# Manifests written by somebody else

FRAME_FIELDS = (
    *("time_index", "camera", "time_s", "width", "height", "intrinsics", "world_from_camera"),
    *("exposure_s", "aperture_m", "velocity_m_per_s", "angular_velocity_rad_per_s"),
    *("light", "files"),
)
FIELDS = ("format", "version", "name", "editor", "weathers", "axes_world", "airlight")
HUGE = 10**400


def _set(*path: Any, to: Any) -> Callable[[dict[str, Any]], None]:
    def change(content: dict[str, Any]) -> None:
        for step in path[:-1]:
            content = content[step]
        content[path[-1]] = to

    return change


def _drop(*path: Any) -> Callable[[dict[str, Any]], None]:
    def change(content: dict[str, Any]) -> None:
        for step in path[:-1]:
            content = content[step]
        del content[path[-1]]

    return change


def _file_named(relative: str) -> Callable[[dict[str, Any]], None]:
    def change(content: dict[str, Any]) -> None:
        content["frames"][0]["files"]["image"] = relative
        content["files"][relative] = content["files"][f"{FIRST}.png"]

    return change


def _frame(field: str, value: Any) -> Callable[[dict[str, Any]], None]:
    return _set("frames", 0, field, to=value)


REFLECTION = np.diag([1.0, 1.0, -1.0, 1.0]).tolist()
FAR = [[1, 0, 0, 1e300], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]

HOSTILE: dict[str, Callable[[dict[str, Any]], None]] = {
    **{f"without {name}": _drop(name) for name in (*FIELDS, "frames", "files")},
    **{f"frame without {name}": _drop("frames", 0, name) for name in FRAME_FIELDS},
    **{f"{name} null": _set(name, to=None) for name in (*FIELDS[:-1], "frames", "files")},
    **{f"frame {name} null": _frame(name, None) for name in FRAME_FIELDS},
    **{f"frame {name} text": _frame(name, "../x") for name in FRAME_FIELDS},
    **{f"frame {name} huge": _frame(name, HUGE) for name in FRAME_FIELDS if name != "time_index"},
    **{f"frame {name} nested": _frame(name, {"a": [1]}) for name in FRAME_FIELDS},
    "version 2": _set("version", to=2),
    "version text": _set("version", to="1"),
    "another format": _set("format", to="weather_aug export"),
    "a list": lambda m: m.clear(),
    "no frames": _set("frames", to=[]),
    "frames an object": _set("frames", to={"a": 1}),
    "a frame twice": lambda m: m["frames"].append(m["frames"][0]),
    "files a list": _set("files", to=[]),
    "a file without digest": _drop("files", f"{FIRST}.png"),
    "a size that is text": _set("files", f"{FIRST}.png", "size", to="many"),
    "a size that is another": _set("files", f"{FIRST}.png", "size", to=HUGE),
    "a size missing": _drop("files", f"{FIRST}.png", "size"),
    "an absolute path": _file_named("/etc/hostname"),
    "a way out": _file_named("../outside.png"),
    "a way out and back": _file_named("frames/../frames/000000_front.png"),
    "a dot": _file_named("./frames/000000_front.png"),
    "an empty path": _file_named(""),
    "the folder itself": _file_named("."),
    "a folder": _file_named("frames"),
    "a backslash": _file_named("frames\\000000_front.png"),
    "a zero byte": _file_named("frames/000000_front.png\0"),
    "a very long name": _file_named("a" * 5000),
    "a camera that is a way out": _frame("camera", "../../../evil"),
    "a camera that rings the bell": _frame("camera", "front\x1b[31m\a"),
    "a name that is a way out": _set("name", to="../evil"),
    "a name with a line break": _set("name", to="street\nweather-aug: all is well"),
    "a pose of NaN text": _frame("world_from_camera", [["nan"] * 4] * 4),
    "a pose that mirrors": _frame("world_from_camera", REFLECTION),
    "a pose that shears": _frame("world_from_camera", np.triu(np.ones((4, 4))).tolist()),
    "a pose beyond measure": _frame("world_from_camera", FAR),
    "a pose of huge integers": _frame("world_from_camera", [[HUGE] * 4] * 4),
    "a pose that is ragged": _frame("world_from_camera", [[1, 2], [3]]),
    "a focal length of 0": _frame("intrinsics", [[0, 0, 1], [0, 0, 1], [0, 0, 1]]),
    "a focal length of 1e-300": _frame("intrinsics", [[1e-300, 0, 1], [0, 1e-300, 1], [0, 0, 1]]),
    "a velocity beyond measure": _frame("velocity_m_per_s", [1e300, 0, 0]),
    "a turn beyond measure": _frame("angular_velocity_rad_per_s", [1e300, 0, 0]),
    "a time beyond measure": _frame("time_s", 1e300),
    "a picture of no pixels": _frame("width", 0),
    "a picture of too many pixels": _frame("width", 10**9),
    "axes that are no axes": _set("axes_world", to=np.ones((3, 3)).tolist()),
    "axes of huge integers": _set("axes_world", to=[[HUGE] * 3] * 3),
    "an airlight below black": _set("airlight", to=[-1, 0.5, 0.5]),
    "an airlight above white": _set("airlight", to=[1e9, 0.5, 0.5]),
    "a light of text": _set("frames", 0, "light", "sky", to=["a", "b", "c"]),
    "a light of two": _set("frames", 0, "light", "sky", to=[0.5, 0.5]),
    "a light missing": _drop("frames", 0, "light", "ground"),
    "a frame without airlight": _drop("frames", 0, "light", "airlight"),
}


@pytest.mark.parametrize("change", HOSTILE.values(), ids=HOSTILE.keys())
def test_a_malformed_manifest_is_a_typed_error_at_load(
    folder: Path, change: Callable[[dict[str, Any]], None]
) -> None:
    rewrite(folder, change)
    with pytest.raises((SceneError, IntegrityError)) as caught:
        WeatherScene.load(folder)
    assert len(str(caught.value)) < 1000
    assert str(caught.value).isprintable()


def _text(folder: Path) -> str:
    return (folder / store.MANIFEST).read_text()


TEXTS: dict[str, Callable[[str], bytes]] = {
    "empty": lambda _: b"",
    "not JSON": lambda _: b"scene",
    "cut": lambda text: text[: len(text) // 2].encode(),
    "a key twice": lambda text: text.replace('"name"', '"name": "a", "name"', 1).encode(),
    "NaN": lambda text: text.replace('"time_s": 0.0', '"time_s": NaN', 1).encode(),
    "infinity": lambda text: text.replace('"time_s": 0.0', '"time_s": 1e999', 1).encode(),
    "nested deeply": lambda _: b"[" * 200_000,
    "digits without end": lambda _: b"1" * 100_000,
    "not UTF-8": lambda text: b"\xff" + text.encode(),
    "a list": lambda _: b"[]",
    "a number": lambda _: b"3",
}


@pytest.mark.parametrize("change", TEXTS.values(), ids=TEXTS.keys())
def test_malformed_text_is_a_typed_error_at_load(
    folder: Path, change: Callable[[str], bytes]
) -> None:
    text = _text(folder)
    (folder / store.MANIFEST).write_bytes(change(text))
    assert (folder / store.MANIFEST).read_bytes() != text.encode()
    with pytest.raises(DataError, match=r"scene\.json"):
        WeatherScene.load(folder)


def test_a_manifest_beyond_the_limit_is_not_read(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(store, "MAX_MANIFEST_BYTES", 100)
    with pytest.raises(DataError, match="larger than 100 bytes"):
        WeatherScene.load(folder)


def test_a_file_outside_is_never_opened(folder: Path) -> None:
    """The way out is refused even where a file of the right bytes lies there."""
    outside = folder.parent / "outside.png"
    shutil.copy(folder / f"{FIRST}.png", outside)
    for way in ("../outside.png", str(outside)):
        rewrite(folder, _file_named(way))
        with pytest.raises(IntegrityError, match="not a plain path"):
            WeatherScene.load(folder)


# Files written by somebody else


class _Attack:
    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (Path("attacked"),))


def _header_only_npy(shape: str, kind: str = "<f2") -> bytes:
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}"
    padded = header.ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(padded)) + padded.encode()


def _npz() -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, a=np.zeros((48, 64), np.float16))
    return buffer.getvalue()


DEPTH_FILES: dict[str, bytes] = {
    "empty": b"",
    "text": b"depth",
    "a pickle": pickle.dumps(_Attack()),
    "an array of objects": npy(np.array([[_Attack()]], object), allow_pickle=True),
    "an archive": _npz(),
    "another type": npy(np.zeros((48, 64), np.int16)),
    "text values": npy(np.full((48, 64), "a")),
    "cut to its header": npy(np.zeros((48, 64), np.float16))[:128],
    "another shape": npy(np.zeros((64, 48), np.float16)),
    "three axes": npy(np.zeros((48, 64, 1), np.float16)),
    "cut": npy(np.zeros((48, 64), np.float16))[:-100],
    "a shape without end": _header_only_npy("(4611686018427387904, 4611686018427387904)"),
    "a shape below 0": _header_only_npy("(-1, 64)"),
    "a header of code": _header_only_npy("__import__('os')"),
    "a header of brackets": b"\x93NUMPY\x01\x00" + struct.pack("<H", 9000) + b"(" * 9000,
}


@pytest.mark.parametrize("data", DEPTH_FILES.values(), ids=DEPTH_FILES.keys())
@pytest.mark.parametrize("part", ["depth", "label"])
def test_an_array_that_is_none_is_a_typed_error(
    folder: Path, part: str, data: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    plant(folder, f"{FIRST}.{part}.npy", data)
    scene = WeatherScene.load(folder, verify=True)
    with pytest.raises(DataError, match="000000_front"):
        scene.frame(scene.keys[0])
    assert not Path("attacked").exists()


def _png_of(width: int, height: int) -> bytes:
    """A valid PNG of black pixels, a few kilobytes for any size."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    pixels = zlib.compress(bytes(min(height * (1 + 3 * width), 10**6)), 9)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
    )


def test_the_planted_picture_is_a_picture(folder: Path) -> None:
    plant(folder, f"{FIRST}.png", _png_of(64, 48))
    scene = WeatherScene.load(folder)
    assert scene.frame(scene.keys[0]).image.max() == 0


@pytest.mark.parametrize(
    "data",
    [b"", b"\x89PNG", _png_of(64, 48)[:30], _png_of(48, 64), _png_of(30_000, 30_000), b"GIF89a"],
    ids=["empty", "only magic", "only header", "another size", "a bomb", "another format"],
)
def test_a_picture_that_is_none_is_a_typed_error(folder: Path, data: bytes) -> None:
    plant(folder, f"{FIRST}.png", data)
    scene = WeatherScene.load(folder, verify=True)
    with pytest.raises(SceneError, match=r"000000_front\.png is not a readable PNG of 64x48"):
        scene.frame(scene.keys[0])


def test_a_picture_is_measured_before_it_is_decoded(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(store.cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    plant(folder, f"{FIRST}.png", _png_of(30_000, 30_000))
    scene = WeatherScene.load(folder)
    with pytest.raises(SceneError):
        scene.frame(scene.keys[0])


def test_reading_changes_nothing(folder: Path) -> None:
    before = digests_of(folder)
    scene = WeatherScene.load(folder, verify=True)
    for key in scene.keys:
        frame = scene.frame(key)
        assert frame.depth_m is not None
        assert not frame.depth_m.flags.writeable
    assert digests_of(folder) == before
    assert issubclass(SceneError, WeatherAugError)
