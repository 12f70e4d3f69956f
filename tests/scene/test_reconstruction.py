"""Gaussians in the scene folder: what goes in comes out, and what was tampered with is found."""

from __future__ import annotations

import io
import json
import pickle
import shutil
import zlib
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from tiny_reconstruction import camera_at, tiny_reconstruction

from weather_aug import _files
from weather_aug._keys import key_of
from weather_aug.clip.types import FrameKey
from weather_aug.errors import IntegrityError, SceneError
from weather_aug.gaussians.types import CLASSES, Actor, Gaussians, Reconstruction, Sky, Style
from weather_aug.scene import reconstruction as storing
from weather_aug.scene import reconstruction_record as records
from weather_aug.scene import store
from weather_aug.scene.reconstruction import (
    encode_geometry,
    encode_labels,
    encode_style,
    joined,
    read_reconstruction,
)
from weather_aug.scene.reconstruction_record import parse_reconstruction
from weather_aug.scene.records import StoredFile
from weather_aug.scene.scene import WeatherScene

Entry = dict[str, Any]


def encoded(scene: Reconstruction) -> tuple[Entry, dict[str, bytes]]:
    """The whole of a reconstruction: the manifest's entry and the files."""
    made = [encode_geometry(scene), encode_labels(scene)]
    made += [encode_style(name, style) for name, style in scene.styles.items()]
    parts = {path: data for _, files in made for path, data in files.items()}
    return joined(entry for entry, _ in made), parts


def written(folder: Path, scene: Reconstruction) -> Reconstruction:
    """Through the folder and back."""
    entry, parts = encoded(scene)
    (folder / records.GAUSSIANS).mkdir(parents=True, exist_ok=True)
    for path, data in parts.items():
        (folder / path).write_bytes(data)
    files = {path: StoredFile(len(data), "") for path, data in parts.items()}
    record = parse_reconstruction(json.loads(json.dumps(entry)), files)
    assert record is not None
    return read_reconstruction(folder, record)


def assert_equal(one: Any, other: Any) -> None:
    """Equal to the bit, type by type, through all fields."""
    assert type(one) is type(other) or isinstance(one, dict)
    if isinstance(one, np.ndarray):
        assert one.dtype == other.dtype and one.shape == other.shape
        assert one.tobytes() == other.tobytes()
    elif hasattr(one, "__dataclass_fields__"):
        for field in fields(one):
            assert_equal(getattr(one, field.name), getattr(other, field.name))
    elif isinstance(one, dict):
        assert list(one) == list(other)
        for key in one:
            assert_equal(one[key], other[key])
    elif isinstance(one, tuple):
        assert len(one) == len(other)
        for left, right in zip(one, other, strict=True):
            assert_equal(left, right)
    else:
        assert one == other


@st.composite
def reconstructions(draw: st.DrawFn) -> Reconstruction:
    """Any sizes, zero too; numbers of all magnitudes that a scene may hold."""
    numbers = np.random.Generator(np.random.Philox(key_of("r", draw(st.integers(0, 2**60)))))
    count, moving = draw(st.integers(0, 5)), draw(st.integers(0, 4))
    classes = draw(st.sampled_from([0, CLASSES]))
    actors = draw(st.integers(1, 3)) if moving else draw(st.integers(0, 1))

    def some(*shape: int, dtype: Any = np.float32) -> NDArray[Any]:
        return (numbers.standard_normal(shape) * 10.0 ** numbers.uniform(-3, 2)).astype(dtype)

    def gaussians(n: int) -> Gaussians:
        degree = draw(st.sampled_from([1, 4, 9, 16]))
        quaternions = some(n, 4)
        quaternions[:, 0] += 1e3
        return Gaussians(
            *(some(n, 3), quaternions, np.clip(some(n, 3), -40, 40), some(n)),
            *(some(n, degree, 3), some(n, classes, dtype=np.float16)),
        )

    def actor(index: int) -> Actor:
        moments = draw(st.integers(1, 4))
        poses = np.tile(np.eye(4), (moments, 1, 1))
        poses[:, :3, 3] = some(moments, 3)
        size_m = (float(numbers.uniform(0.1, 9)), 1.8, 1.0 / 3.0)
        times_s = np.cumsum(numbers.uniform(0.01, 1, moments))
        return Actor(100 - index, "Bus/RV", bool(index % 2), size_m, times_s, poses)

    keys = [FrameKey(index, name) for index in range(draw(st.integers(0, 3))) for name in "ab"]
    cameras = {key: camera_at(key.time_index / 3.0, y_m=0.1) for key in keys}
    side = draw(st.integers(1, 3))
    styles = {
        name: Style(
            some(count, 4, 3, dtype=np.float16),
            some(moving, 1, 3, dtype=np.float16),
            some(6, side, side, 3, dtype=np.float16),
        )
        for name in draw(st.sampled_from([(), ("rain",), ("rain", "rain_sh", "a-actor")]))
    }
    return Reconstruction(
        gaussians(count),
        Sky(some(6, side, side, 3), numbers.random((6, side, side)) < 0.5),
        tuple(actor(index) for index in range(actors)),
        gaussians(moving),
        numbers.integers(0, max(actors, 1), moving).astype(np.int32),
        some(moving, draw(st.integers(0, 4)), 3),
        cameras,
        {key: some(3, 4) for key in keys[:2]},
        styles,
        np.abs(some(count)) if draw(st.booleans()) else np.zeros(0, np.float32),
    )


@given(scene=reconstructions())
def test_any_reconstruction_comes_back_to_the_bit(
    tmp_path_factory: pytest.TempPathFactory, scene: Reconstruction
) -> None:
    folder = tmp_path_factory.mktemp("any")
    assert_equal(written(folder, scene), scene)
    shutil.rmtree(folder)


def test_the_tiny_street_comes_back_to_the_bit(tmp_path: Path) -> None:
    scene = tiny_reconstruction(styles=("rain", "snow"))
    back = written(tmp_path, scene)
    assert_equal(back, scene)
    assert_equal(encoded(back), encoded(scene))


def test_an_array_that_is_lost_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The check above fails if one array is stored as another."""
    own = storing._arrays_of
    monkeypatch.setattr(
        storing, "_arrays_of", lambda s: own(s) | {"exposures": np.zeros((6, 3, 4))}
    )
    scene = tiny_reconstruction()
    with pytest.raises(AssertionError):
        assert_equal(written(tmp_path, scene), scene)


def test_scores_of_single_precision_are_stored_as_halves(tmp_path: Path) -> None:
    scene = tiny_reconstruction(styles=())
    scores = scene.background.class_scores.astype(np.float32) / np.float32(3)
    scene = replace(scene, background=replace(scene.background, class_scores=scores))
    back = written(tmp_path, scene).background.class_scores
    assert back.tobytes() == scores.astype(np.float16).tobytes()


def test_arrays_are_mapped_and_cannot_be_written(tmp_path: Path) -> None:
    back = written(tmp_path, tiny_reconstruction())
    means = back.background.means_m
    assert not means.flags.writeable
    assert isinstance(means.base, np.memmap)
    with pytest.raises(ValueError, match="read-only"):
        means[0, 0] = 1


def test_files_are_what_numpy_reads_and_no_pickles(tmp_path: Path) -> None:
    written(tmp_path, tiny_reconstruction())
    for path in (tmp_path / records.GAUSSIANS).iterdir():
        np.load(path, allow_pickle=False)


# What cannot be stored


def with_background(scene: Reconstruction, **changes: Any) -> Reconstruction:
    return replace(scene, background=replace(scene.background, **changes))


def changed(array: NDArray[Any], value: float) -> NDArray[Any]:
    copy = array.copy()
    copy.reshape(-1)[0] = value
    return copy


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
@pytest.mark.parametrize("name", ["means_m", "log_scales", "logit_opacities", "sh"])
def test_numbers_that_are_none_are_not_stored(name: str, value: float) -> None:
    scene = tiny_reconstruction(styles=())
    bad = with_background(scene, **{name: changed(getattr(scene.background, name), value)})
    with pytest.raises(SceneError, match=f"background_{name}"):
        encode_geometry(bad)


@pytest.mark.parametrize("name", ["../evil", "a.b", "", "Schnee!", "x" * 65])
def test_a_style_must_have_a_name_that_may_stand_in_a_file_name(name: str) -> None:
    style = tiny_reconstruction().styles["snow"]
    with pytest.raises(SceneError, match="style"):
        encode_style(name, style)


# A folder from a stranger


@pytest.fixture
def folder(tiny_scene: WeatherScene, tmp_path: Path) -> Path:
    """A copy of the tiny scene with Gaussians, which a test may harm."""
    copy = Path(shutil.copytree(tiny_scene.path, tmp_path / "scene"))
    scene = tiny_reconstruction(styles=("rain",))
    entry, parts = encoded(scene)
    (copy / records.GAUSSIANS).mkdir()
    for relative, data in parts.items():
        (copy / relative).write_bytes(data)
    listed = {p: {"size": len(d), "sha256": _files.sha256_of(d)} for p, d in parts.items()}
    rewrite(copy, lambda m: m.update(reconstruction=entry, files=m["files"] | listed))
    return copy


def rewrite(folder: Path, change: Callable[[Entry], object]) -> None:
    """Edit the manifest as JSON and seal it again, as somebody would on purpose."""
    path = folder / store.MANIFEST
    content = json.loads(path.read_text())
    change(content)
    content.pop("sha256", None)
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    path.write_text(json.dumps(content | {"sha256": _files.sha256_of(text.encode())}))


def plant(folder: Path, name: str, array: NDArray[Any]) -> None:
    """Replace an array and all that is said of it."""
    path, data = records.array_path(name), npy(array)
    (folder / path).write_bytes(data)
    listed = {"size": len(data), "sha256": _files.sha256_of(data)}
    rewrite(
        folder,
        lambda m: (
            m["files"].update({path: listed}),
            m["reconstruction"]["arrays"].update({name: list(array.shape)}),
        ),
    )


def npy(array: NDArray[Any], *, allow_pickle: bool = False) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=allow_pickle)
    return buffer.getvalue()


def stored(folder: Path, name: str) -> NDArray[Any]:
    return np.array(np.load(folder / records.array_path(name)))


def test_a_scene_gives_its_gaussians(folder: Path) -> None:
    scene = WeatherScene.load(folder, verify=True)
    assert_equal(scene.reconstruction, tiny_reconstruction(styles=("rain",)))
    assert scene.reconstruction is scene.reconstruction
    again = pickle.loads(pickle.dumps(scene))
    assert "reconstruction" not in vars(again)
    assert_equal(again.reconstruction, scene.reconstruction)


def test_a_scene_without_gaussians_has_none(tiny_scene: WeatherScene) -> None:
    assert tiny_scene.reconstruction is None
    assert tiny_scene.manifest.reconstruction is None


def test_opening_a_scene_does_not_read_its_gaussians(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any) -> Any:
        raise AssertionError

    monkeypatch.setattr("weather_aug.scene.scene.read_reconstruction", refuse)
    assert WeatherScene.load(folder).keys


def test_a_file_that_is_cut_or_changed_is_found(folder: Path) -> None:
    path = folder / records.array_path("background_sh")
    data = path.read_bytes()
    path.write_bytes(data[:-4])
    with pytest.raises(IntegrityError, match="background_sh"):
        WeatherScene.load(folder)
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    with pytest.raises(IntegrityError, match="background_sh"):
        WeatherScene.load(folder, verify=True)
    path.unlink()
    with pytest.raises(IntegrityError, match="background_sh"):
        WeatherScene.load(folder)


def test_a_pickle_instead_of_an_array_is_not_loaded(folder: Path) -> None:
    path = records.array_path("support")
    data = npy(np.array([{"a": 1}], object), allow_pickle=True)
    (folder / path).write_bytes(data)
    listed = {"size": len(data), "sha256": _files.sha256_of(data)}
    rewrite(folder, lambda m: m["files"].update({path: listed}))
    with pytest.raises(SceneError, match="support"):
        WeatherScene.load(folder).reconstruction  # noqa: B018


HARMFUL: dict[str, tuple[str, Callable[[NDArray[Any]], NDArray[Any]], str]] = {
    "a mean that is no number": ("background_means_m", lambda a: changed(a, np.nan), "means_m"),
    "a mean beyond all drives": ("actor_means_m", lambda a: changed(a, 1e20), "means_m"),
    "an endless scale": ("background_log_scales", lambda a: changed(a, np.inf), "log_scales"),
    "a quaternion of no length": ("actor_quaternions", lambda a: 0 * a, "no length"),
    "fewer opacities": ("background_logit_opacities", lambda a: a[:-1], "logit_opacities"),
    "five coefficients": ("background_sh", lambda a: a[:, [0, 1, 2, 3, 0]], "coefficients"),
    "classes of others": ("actor_class_scores", lambda a: a[:, :5], "classes"),
    "too many classes": ("actor_class_scores", lambda a: np.repeat(a, 2, axis=1), "classes"),
    "an owner who is not there": ("owners", lambda a: a + 1, "owners"),
    "a negative owner": ("owners", lambda a: a - 1, "owners"),
    "offsets of others": ("offsets_m", lambda a: a[:-1], "offsets_m"),
    "a sky that is not square": ("sky_faces", lambda a: a[:, :, :-1], "sky_faces"),
    "a sky with five faces": ("sky_faces", lambda a: a[:5], "sky_faces"),
    "a sky half seen": ("sky_seen", lambda a: changed(a, 2), "sky_seen"),
    "support of others": ("support", lambda a: a[:-1], "support"),
    "times that fall": ("track_times_s", lambda a: a[::-1], "times fall"),
    "a pose that shears": ("track_poses", lambda a: 1.5 * a, "rigid"),
    "a pose that mirrors": ("track_poses", lambda a: a * np.diag([1, -1, 1, 1]), "reflection"),
    "tracks of others": ("track_poses", lambda a: a[:-1], "track_poses"),
    "a camera that shears": ("camera_poses", lambda a: 1.5 * a, "rigid"),
    "a camera of no size": ("camera_numbers", lambda a: 0 * a, "size"),
    "a camera of half a pixel": ("camera_numbers", lambda a: a + 0.5, "whole"),
    "cameras of others": ("camera_intrinsics", lambda a: a[:-1], "camera_intrinsics"),
    "exposures of others": ("exposures", lambda a: a[:-1], "exposures"),
    "a style of others": ("style.rain.sh", lambda a: a[:-1], "style.rain.sh"),
    "a style of no number": ("style.rain.sky", lambda a: changed(a, np.nan), "style.rain.sky"),
    "a style's odd degree": ("style.rain.actor_sh", lambda a: a[:, :2], "coefficients"),
}


@pytest.mark.parametrize("harm", HARMFUL)
def test_arrays_of_a_stranger_are_refused(folder: Path, harm: str) -> None:
    name, change, message = HARMFUL[harm]
    plant(folder, name, np.ascontiguousarray(change(stored(folder, name))))
    with pytest.raises(SceneError, match=message) as caught:
        WeatherScene.load(folder).reconstruction  # noqa: B018
    assert "build the scene again" in str(caught.value)


def of_the_record(change: Callable[[Entry], object]) -> Callable[[Entry], object]:
    return lambda manifest: change(manifest["reconstruction"])


MALFORMED: dict[str, Callable[[Entry], object]] = {
    "an array too much": lambda r: r["arrays"].update(evil=[1]),
    "an array missing": lambda r: r["arrays"].pop("owners"),
    "a file that is not listed": lambda r: r.update(styles=["rain", "fog"]),
    "another number of dimensions": lambda r: r["arrays"].update(owners=[1, 1]),
    "a negative count": lambda r: r["arrays"].update(owners=[-1]),
    "half a row": lambda r: r["arrays"].update(owners=[1.5]),
    "text for a shape": lambda r: r["arrays"].update(owners="many"),
    "a style twice": lambda r: r.update(styles=["rain", "rain"]),
    "a style's way out": lambda r: r.update(styles=["../rain"]),
    "an actor without a name": lambda r: r["actors"][0].update(class_name=""),
    "an actor of no size": lambda r: r["actors"][0].update(size_m=[1, 0, 1]),
    "an actor of two sides": lambda r: r["actors"][0].update(size_m=[1, 1]),
    "an actor who may be soft": lambda r: r["actors"][0].update(is_deformable="yes"),
    "a track that is none": lambda r: r["actors"][0].update(track_id="7"),
    "a frame twice": lambda r: r["cameras"].append(r["cameras"][0]),
    "a camera's way out": lambda r: r["cameras"].append([0, "../x"]),
    "no record of the fit": lambda r: r.pop("fit"),
    "a fit of words": lambda r: r.update(fit={"psnr": "good"}),
    "nothing but a list": lambda r: [r.pop(name) for name in list(r)],
}


@pytest.mark.parametrize("harm", MALFORMED)
def test_a_malformed_record_is_refused(folder: Path, harm: str) -> None:
    rewrite(folder, of_the_record(MALFORMED[harm]))
    with pytest.raises(SceneError):
        WeatherScene.load(folder)


@pytest.mark.parametrize("name", ["background_means_m", "exposures", "sky_seen", "owners"])
def test_a_shape_larger_than_the_file_is_refused(folder: Path, name: str) -> None:
    def grow(record: Entry) -> None:
        record["arrays"][name][0] *= 1000

    rewrite(folder, of_the_record(grow))
    with pytest.raises(SceneError, match=name):
        WeatherScene.load(folder).reconstruction  # noqa: B018


@given(data=st.binary(max_size=300), place=st.integers(0, 200))
def test_noise_in_an_array_gives_an_error_or_the_same_numbers(
    tmp_path_factory: pytest.TempPathFactory, data: bytes, place: int
) -> None:
    folder = tmp_path_factory.mktemp("noise")
    scene = tiny_reconstruction(spacing_m=2.0, styles=())
    entry, parts = encoded(scene)
    (folder / records.GAUSSIANS).mkdir()
    name = sorted(parts)[zlib.crc32(data) % len(parts)]
    parts[name] = parts[name][:place] + data + parts[name][place + len(data) :]
    for path, content in parts.items():
        (folder / path).write_bytes(content)
    record = parse_reconstruction(entry, {path: StoredFile(0, "") for path in parts})
    assert record is not None
    try:
        back = read_reconstruction(folder, record)
    except SceneError:
        return
    finally:
        shutil.rmtree(folder)
    assert all(np.isfinite(getattr(back.background, f)).all() for f in ("means_m", "sh"))
