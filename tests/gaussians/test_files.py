"""PLY files: what is written is read back bit by bit, laid out as 3DGS has it; the rest is refused.

The layout is checked by another reader (bytes taken apart here), and by another program where it is
installed: `splat-transform` of PlayCanvas, on PATH or in the folder that SPLAT_TRANSFORM names (a
folder of `npm install @playcanvas/splat-transform@2.7.1`, or the program itself).
"""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from plyfile import PlyData

from weather_aug import _files
from weather_aug.errors import ArgumentError, DataError, OutputError
from weather_aug.gaussians import files
from weather_aug.gaussians.files import read_ply, write_ply
from weather_aug.gaussians.types import SH_COEFFICIENTS, Gaussians

Float32 = NDArray[np.float32]

ARRAYS = ("means_m", "quaternions", "log_scales", "logit_opacities", "sh", "class_scores")
SAME_FOLDER = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


def cloud(count: int, coefficients: int = 16, classes: int = 0, seed: int = 0) -> Gaussians:
    """Random Gaussians of a street's size."""
    rng = np.random.default_rng(seed)

    def normal(spread: float, *shape: int) -> Float32:
        return (spread * rng.standard_normal((count, *shape))).astype(np.float32)

    quaternions = normal(1.0, 4)
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return Gaussians(
        normal(30.0, 3),
        quaternions,
        normal(1.0, 3) - 3,
        normal(2.0),
        normal(0.3, coefficients, 3),
        normal(1.0, classes),
    )


def assert_same_bits(expected: Gaussians, found: Gaussians) -> None:
    for name in ARRAYS:
        wanted = np.asarray(getattr(expected, name), np.float32)
        array = getattr(found, name)
        assert (array.shape, array.dtype) == (wanted.shape, np.float32), name
        assert array.tobytes() == wanted.tobytes(), name


def bits(low: float, high: float, *shape: int) -> st.SearchStrategy[Float32]:
    """Any float32 in a range, subnormals and negative zeros too."""
    # numpy counts with 2^24 steps between the ends: those must be float32.
    ends = {"min_value": float(np.float32(low)), "max_value": float(np.float32(high))}
    return hnp.arrays(np.float32, shape, elements=st.floats(**ends, width=32))


@st.composite
def any_gaussians(draw: st.DrawFn) -> Gaussians:
    count, coefficients = draw(st.integers(0, 4)), draw(st.sampled_from(SH_COEFFICIENTS))
    quaternions = draw(bits(-1, 1, count, 4))
    quaternions[:, draw(st.integers(0, 3))] = draw(st.sampled_from([0.5, -1.0, 1e-6]))
    return Gaussians(
        draw(bits(-1e9, 1e9, count, 3)),
        quaternions,
        draw(bits(-3e38, 40, count, 3)),
        draw(bits(-3e38, 3e38, count)),
        draw(bits(-1e6, 1e6, count, coefficients, 3)),
        draw(bits(-3e38, 3e38, count, draw(st.sampled_from([0, 1, 19])))),
    )


@SAME_FOLDER
@given(gaussians=any_gaussians())
def test_what_is_written_is_read_back_bit_by_bit(gaussians: Gaussians, tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", gaussians, with_classes=True)
    assert_same_bits(gaussians, read_ply(tmp_path / "a.ply"))


def test_class_scores_are_written_only_when_asked_for(tmp_path: Path) -> None:
    gaussians = cloud(3, classes=19)
    half = replace(gaussians, class_scores=gaussians.class_scores.astype(np.float16))
    write_ply(tmp_path / "with.ply", half, with_classes=True)
    assert_same_bits(half, read_ply(tmp_path / "with.ply"))
    write_ply(tmp_path / "a.ply", half)
    assert b"class" not in (tmp_path / "a.ply").read_bytes()
    assert read_ply(tmp_path / "a.ply").class_scores.shape == (3, 0)


# --- The layout, by another reader ---

LAYOUT = (
    "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 "
    + " ".join(f"f_rest_{k}" for k in range(45))
    + " opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
).split()


def taken_apart(path: Path) -> tuple[list[str], list[dict[str, float]]]:
    """Header lines and rows of a PLY of floats, by hand."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode().splitlines()
    names = [line.split()[2] for line in lines if line.startswith("property")]
    rows = struct.iter_unpack(f"<{len(names)}f", body)
    return lines, [dict(zip(names, row, strict=True)) for row in rows]


def assert_laid_out_as_3dgs(folder: Path) -> None:
    gaussians = cloud(2)
    write_ply(folder / "a.ply", gaussians)
    lines, rows = taken_apart(folder / "a.ply")
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 2"]
    assert lines[3:] == [f"property float {name}" for name in LAYOUT]
    for n, row in enumerate(rows):
        expected = dict.fromkeys(("nx", "ny", "nz"), 0.0)
        for axis in range(3):
            expected["xyz"[axis]] = gaussians.means_m[n, axis]
            expected[f"scale_{axis}"] = gaussians.log_scales[n, axis]
            expected[f"f_dc_{axis}"] = gaussians.sh[n, 0, axis]
            for k in range(15):
                expected[f"f_rest_{15 * axis + k}"] = gaussians.sh[n, 1 + k, axis]
        expected |= {f"rot_{k}": gaussians.quaternions[n, k] for k in range(4)}
        assert row == expected | {"opacity": gaussians.logit_opacities[n]}


def test_the_layout_is_that_of_3dgs(tmp_path: Path) -> None:
    assert_laid_out_as_3dgs(tmp_path)


def test_harmonics_by_coefficient_would_be_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Planted fault: f_rest is red, green, blue of each coefficient."""
    columns = files._columns

    def swapped(gaussians: Gaussians, with_classes: bool) -> dict[str, Float32]:
        found = columns(gaussians, with_classes)
        return found | {f"f_rest_{3 * k + c}": gaussians.sh[:, 1 + k, c]
                        for k in range(15) for c in range(3)}  # fmt: skip

    monkeypatch.setattr(files, "_columns", swapped)
    with pytest.raises(AssertionError):
        assert_laid_out_as_3dgs(tmp_path)


# --- Files of others ---


def header(names: list[str], count: int, kind: str = "float") -> list[str]:
    properties = [f"property {kind} {name}" for name in names]
    return ["format binary_little_endian 1.0", f"element vertex {count}", *properties]


def put(path: Path, lines: list[str], body: bytes, newline: str = "\n") -> Path:
    text = newline.join(["ply", *lines, "end_header", ""])
    path.write_bytes(text.encode("latin1") + body)
    return path


def names_of(coefficients: int) -> list[str]:
    rest = [f"f_rest_{k}" for k in range(3 * (coefficients - 1))]
    return [name for name in LAYOUT if not name.startswith("f_rest")] + rest


def test_plyfile_reads_what_is_written_and_the_other_way_round(tmp_path: Path) -> None:
    gaussians = cloud(40, classes=2)
    write_ply(tmp_path / "a.ply", gaussians, with_classes=True)
    data = PlyData.read(tmp_path / "a.ply")
    assert (data.text, data.byte_order, len(data.elements)) == (False, "<", 1)
    assert [p.name for p in data["vertex"].properties] == [*LAYOUT, "class_00", "class_01"]
    assert (data["vertex"]["rot_0"] == gaussians.quaternions[:, 0]).all()
    assert (data["vertex"]["f_rest_16"] == gaussians.sh[:, 2, 1]).all()
    data.comments.append("by another")
    data.write(tmp_path / "b.ply")
    assert_same_bits(gaussians, read_ply(tmp_path / "b.ply"))


@pytest.mark.parametrize("order", ["=", ">"])
def test_the_cure_for_text_and_other_byte_orders_cures(tmp_path: Path, order: str) -> None:
    gaussians = cloud(3, 4)
    write_ply(tmp_path / "a.ply", gaussians)
    data = PlyData.read(tmp_path / "a.ply", mmap=False)
    data.text, data.byte_order = order == "=", order
    data.write(tmp_path / "b.ply")
    with pytest.raises(DataError, match="plyfile"):
        read_ply(tmp_path / "b.ply")
    p = PlyData.read(tmp_path / "b.ply")
    p.text, p.byte_order = False, "<"
    p.write(tmp_path / "c.ply")
    assert read_ply(tmp_path / "c.ply").sh.shape == (3, 4, 3)


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize("coefficients", SH_COEFFICIENTS)
def test_files_without_normals_in_any_order_are_read(
    tmp_path: Path, coefficients: int, newline: str
) -> None:
    names = [name for name in reversed(names_of(coefficients)) if not name.startswith("n")]
    values = np.arange(1, 2 * len(names) + 1, dtype="<f4").reshape(2, -1) / 8
    lines = ["comment by somebody", *header(names, 2)]
    lines = [lines[1], lines[0], "obj_info none", *lines[2:]]
    found = read_ply(put(tmp_path / "a.ply", lines, values.tobytes(), newline))
    by_name = dict(zip(names, values.T, strict=True))
    assert (found.means_m == np.stack([by_name[n] for n in "xyz"], axis=1)).all()
    assert (found.quaternions[:, 0] == by_name["rot_0"]).all()
    assert found.sh.shape == (2, coefficients, 3)
    if coefficients > 1:
        last_green = by_name[f"f_rest_{2 * (coefficients - 1) - 1}"]
        assert (found.sh[:, -1, 1] == last_green).all()


def test_what_3dgs_does_not_know_is_dropped_by_name_only(tmp_path: Path) -> None:
    names = [*names_of(1), "filter_3D"]
    values = np.ones((1, len(names)), "<f4")
    path = put(tmp_path / "a.ply", header(names, 1), values.tobytes())
    with pytest.raises(DataError, match=r"filter_3D.*drop="):
        read_ply(path)
    assert len(read_ply(path, drop=("filter_3D",))) == 1


def test_endless_opacities_of_converters_are_nearly_0_and_1(tmp_path: Path) -> None:
    names = names_of(1)
    values = np.ones((3, len(names)), "<f4")
    values[:2, names.index("opacity")] = np.inf, -np.inf
    found = read_ply(put(tmp_path / "a.ply", header(names, 3), values.tobytes()))
    assert found.logit_opacities.tolist() == [16.0, -16.0, 1.0]
    assert np.float32(1 / (1 + np.exp(-16.0))) < 1


# --- Hostile files ---

ONE = header(names_of(1), 1)
BODY = np.ones((1, len(names_of(1))), "<f4").tobytes()


def with_value(name: str, value: float) -> bytes:
    row = np.ones(len(names_of(1)), "<f4")
    row[names_of(1).index(name)] = value
    return row.tobytes()


def without(name: str) -> tuple[list[str], bytes]:
    return [line for line in ONE if not line.endswith(f" {name}")], BODY[4:]


HOSTILE: dict[str, tuple[list[str], bytes, str]] = {
    "no position": (*without("x"), "lacks x: it is a point cloud"),
    "no rotation": (*without("rot_3"), "lacks rot_3"),
    "no opacity": (*without("opacity"), "lacks opacity"),
    "ascii": (["format ascii 1.0", *ONE[1:]], b"1 " * 17 + b"\n", "write it again"),
    "big-endian": (["format binary_big_endian 1.0", *ONE[1:]], BODY, "byte_order = '<'"),
    "double": (header(names_of(1), 1, "double"), BODY * 2, "'property double x'"),
    "integers": (header(names_of(1), 1, "int"), BODY, "'property int x'"),
    "a list": ([*ONE, "property list uchar int faces"], BODY, "has no place"),
    "twice the same": ([*ONE, "property float x"], BODY + BODY[:4], "has no place"),
    "a second element": ([*ONE, "element face 1"], BODY, "has no place"),
    "compressed": ([ONE[0], "element chunk 1", "property float min_x"], BODY, "splat-transform"),
    "nothing": (ONE[:1], b"", "no element vertex"),
    "no format": (ONE[1:], BODY, "format binary_little_endian"),
    "negative": ([ONE[0], "element vertex -1", *ONE[2:]], BODY, "has no place"),
    "a count of words": ([ONE[0], "element vertex 1_0", *ONE[2:]], BODY, "has no place"),
    "huge": ([ONE[0], "element vertex 99999999999999", *ONE[2:]], BODY, "but has"),
    "cut short": (ONE, BODY[:-1], "cut short"),
    "too long": (ONE, BODY + b"\0", "but has"),
    "harmonics of no degree": (
        [*ONE, *(f"property float f_rest_{k}" for k in range(12))],
        BODY + BODY[:48],
        "12 properties f_rest",
    ),
    "a hole in the harmonics": (
        [*ONE, *(f"property float f_rest_{k + (k > 3)}" for k in range(9))],
        BODY + BODY[:36],
        "f_rest",
    ),
    "a hole in the classes": ([*ONE, "property float class_01"], BODY + BODY[:4], "class"),
    "not a number": (ONE, with_value("y", np.nan), "means .* 1 Gaussians .* number 0"),
    "endlessly far": (ONE, with_value("z", np.inf), "means"),
    "far": (ONE, with_value("x", 2e9), "at most 1e"),
    "endlessly large": (ONE, with_value("scale_1", np.inf), "log scales"),
    "large": (ONE, with_value("scale_0", 90.0), "log scales"),
    "a colour that is none": (ONE, with_value("f_dc_2", np.nan), "harmonics"),
    "an opacity that is none": (ONE, with_value("opacity", np.nan), "opacities"),
    "a quaternion that is none": (ONE, with_value("rot_2", np.inf), "no direction"),
    "a header of bytes": ([*ONE, "comment \xff"], BODY, "is no text"),
    "a header without an end": ([*ONE, *["comment " + 1000 * "a"] * 66], BODY, "header of at most"),
}


@pytest.mark.parametrize(("lines", "body", "says"), HOSTILE.values(), ids=HOSTILE.keys())
def test_a_hostile_file_is_refused_in_words(
    tmp_path: Path, lines: list[str], body: bytes, says: str
) -> None:
    path = put(tmp_path / "evil.ply", lines, body)
    with pytest.raises(DataError, match=says) as refused:
        read_ply(path)
    assert "evil.ply" in str(refused.value)


def test_the_file_that_the_hostile_ones_spoil_is_read(tmp_path: Path) -> None:
    assert len(read_ply(put(tmp_path / "a.ply", ONE, BODY))) == 1


def test_a_quaternion_of_zeros_is_refused(tmp_path: Path) -> None:
    row = np.ones(len(names_of(1)), "<f4")
    row[[names_of(1).index(f"rot_{k}") for k in range(4)]] = 0
    with pytest.raises(DataError, match="no direction"):
        read_ply(put(tmp_path / "a.ply", ONE, row.tobytes()))


def test_no_file_and_no_regular_file(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="No such file"):
        read_ply(tmp_path / "a.ply")
    with pytest.raises(DataError, match="regular file"):
        read_ply(tmp_path)
    os.mkfifo(tmp_path / "pipe.ply")
    with pytest.raises(DataError, match="regular file"):
        read_ply(tmp_path / "pipe.ply")


def test_a_huge_count_allocates_nothing(tmp_path: Path) -> None:
    path = put(tmp_path / "a.ply", [ONE[0], "element vertex 999999999999999", *ONE[2:]], BODY)
    tracemalloc.start()
    with pytest.raises(DataError):
        read_ply(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2**20


@SAME_FOLDER
@given(
    changes=st.lists(st.tuples(st.floats(0, 1), st.binary(max_size=3)), min_size=1, max_size=4),
    end=st.floats(0.5, 1),
)
def test_a_spoilt_file_is_read_or_refused_and_nothing_else(
    changes: list[tuple[float, bytes]], end: float, tmp_path: Path
) -> None:
    path = tmp_path / "a.ply"
    write_ply(path, cloud(2, 4, 2), with_classes=True)
    spoilt = bytearray(path.read_bytes())
    for place, new in changes:
        begin = int(place * (len(spoilt) - 1))
        spoilt[begin : begin + len(new)] = new
    path.write_bytes(spoilt[: int(end * len(spoilt))] if end < 0.9 else spoilt)
    try:
        read_ply(path)
    except DataError as refused:
        assert "a.ply" in str(refused)


# --- Writing ---


def test_a_full_disk_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    old = cloud(3)
    write_ply(tmp_path / "a.ply", old)

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(_files.os, "fsync", full)
    with pytest.raises(OutputError, match="free some space"):
        write_ply(tmp_path / "a.ply", cloud(4))
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]
    assert_same_bits(old, read_ply(tmp_path / "a.ply"))


@pytest.mark.parametrize(
    ("name", "change", "says"),
    [
        ("means_m", lambda a: a * np.nan, "means"),
        ("log_scales", lambda a: a + 50, "log scales"),
        ("quaternions", lambda a: a * 0, "no direction"),
        ("logit_opacities", lambda a: a * np.inf, "opacities"),
        ("sh", lambda a: a.astype(np.float64), "float32, got float64"),
        ("class_scores", lambda a: np.zeros((len(a), 101), np.float32), "100 classes"),
        ("class_scores", lambda a: a * np.nan, "class scores"),
    ],
)
def test_what_could_not_be_read_is_not_written(
    tmp_path: Path, name: str, change: Callable[[Float32], Float32], says: str
) -> None:
    gaussians = cloud(2, classes=3)
    gaussians = replace(gaussians, **{name: change(getattr(gaussians, name))})
    with pytest.raises(ArgumentError, match=says):
        write_ply(tmp_path / "a.ply", gaussians, with_classes=True)
    assert not list(tmp_path.iterdir())


# --- Another program ---

Tool = Callable[..., None]


@pytest.fixture(scope="module")
def splat_transform() -> Tool:
    """Runs the program of PlayCanvas, or skips the test."""
    folder = Path(os.environ.get("SPLAT_TRANSFORM", "node_modules"))
    places = (folder, folder / ".bin", folder / "node_modules" / ".bin")
    found = [shutil.which("splat-transform", path=str(place)) for place in places]
    found += [shutil.which("splat-transform"), shutil.which(str(folder))]
    program = next((path for path in found if path), None)
    if program is None or shutil.which("node") is None:
        pytest.skip("node or splat-transform is not there: npm install @playcanvas/splat-transform")

    def run(*arguments: object) -> None:
        command = [program, "-q", "-w", *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stdout + done.stderr

    return run


def test_splat_transform_reads_every_number(tmp_path: Path, splat_transform: Tool) -> None:
    gaussians = cloud(200)
    write_ply(tmp_path / "a.ply", gaussians)
    splat_transform(tmp_path / "a.ply", tmp_path / "a.csv")
    with (tmp_path / "a.csv").open() as text:
        names = text.readline().strip().split(",")
        table = np.loadtxt(text, delimiter=",").astype(np.float32)
    assert names == LAYOUT
    _, rows = taken_apart(tmp_path / "a.ply")
    assert (table == np.array([list(row.values()) for row in rows], np.float32)).all()


@pytest.mark.parametrize("coefficients", SH_COEFFICIENTS)
def test_what_splat_transform_writes_is_read_bit_by_bit(
    tmp_path: Path, splat_transform: Tool, coefficients: int
) -> None:
    gaussians = cloud(50, coefficients, classes=2)
    write_ply(tmp_path / "a.ply", gaussians, with_classes=True)
    splat_transform(tmp_path / "a.ply", tmp_path / "b.ply")
    assert_same_bits(gaussians, read_ply(tmp_path / "b.ply"))


def covariances(gaussians: Gaussians) -> NDArray[np.float64]:
    """(N, 3, 3), from (w, x, y, z)."""
    w, x, y, z = gaussians.quaternions.astype(np.float64).T
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)
    axes = rotation * np.exp(gaussians.log_scales.astype(np.float64))[:, None, :]
    product: NDArray[np.float64] = axes @ axes.transpose(0, 2, 1)
    return product


def first_degree(sh: Float32, direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3) what degree 1 adds to the colours seen along `direction`."""
    x, y, z = direction
    basis = 0.4886025119029199 * np.array([-y, z, -x])
    added: NDArray[np.float64] = np.einsum("k,nkc->nc", basis, sh[:, 1:4].astype(np.float64))
    return added


def test_turned_by_splat_transform_as_by_the_formulas(
    tmp_path: Path, splat_transform: Tool
) -> None:
    """That quaternions, scales and harmonics mean to it what they mean to us."""
    gaussians = cloud(100, 4)
    write_ply(tmp_path / "a.ply", gaussians)
    splat_transform(tmp_path / "a.ply", "-r", "0,0,90", tmp_path / "b.ply")
    turned = read_ply(tmp_path / "b.ply")
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(turned.means_m, gaussians.means_m @ quarter.T, atol=1e-4)
    expected = quarter @ covariances(gaussians) @ quarter.T
    np.testing.assert_allclose(covariances(turned), expected, rtol=1e-4, atol=1e-6)
    direction = np.array([0.36, -0.48, 0.8])
    np.testing.assert_allclose(
        first_degree(turned.sh, quarter @ direction),
        first_degree(gaussians.sh, direction),
        atol=1e-5,
    )


def test_compressed_and_back_within_its_steps(tmp_path: Path, splat_transform: Tool) -> None:
    """11 bits for places and scales, 10 for quaternions, 8 for colours and opacities."""
    gaussians = cloud(512)
    write_ply(tmp_path / "a.ply", gaussians)
    splat_transform(tmp_path / "a.ply", tmp_path / "a.compressed.ply")
    with pytest.raises(DataError, match="compressed PLY"):
        read_ply(tmp_path / "a.compressed.ply")
    splat_transform(tmp_path / "a.compressed.ply", tmp_path / "b.ply")
    back = read_ply(tmp_path / "b.ply")
    apart_m = np.linalg.norm(gaussians.means_m[:, None] - back.means_m, axis=2)
    order = apart_m.argmin(axis=1)
    assert len(np.unique(order)) == len(gaussians)
    extent_m = np.ptp(gaussians.means_m, axis=0).max()
    assert apart_m.min(axis=1).max() < extent_m / 1000
    assert np.abs(back.log_scales[order] - gaussians.log_scales).max() < 0.01
    alike = np.abs((back.quaternions[order] * gaussians.quaternions).sum(axis=1))
    assert alike.min() > 1 - 1e-5
    opacity, expected = (
        1 / (1 + np.exp(-logits.astype(np.float64)))
        for logits in (back.logit_opacities[order], gaussians.logit_opacities)
    )
    assert np.abs(opacity - expected).max() < 1 / 255
    assert np.abs(back.sh[order, 0] - gaussians.sh[:, 0]).max() < 0.02
    assert np.abs(back.sh[order, 1:] - gaussians.sh[:, 1:]).max() < 8 / 256


def test_the_five_lines_for_drivestudio_convert(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The block of docs/gaussian_files.md, on a checkpoint with the names of its table."""
    gaussians = cloud(20, 4)
    names = "_means _quats _scales _features_dc _features_rest".split()
    arrays = [getattr(gaussians, name) for name in ARRAYS[:3]]
    state = dict(zip(names, [*arrays, gaussians.sh[:, 0], gaussians.sh[:, 1:]], strict=True))
    state["_opacities"] = gaussians.logit_opacities[:, None]
    tensors = {name: torch.from_numpy(array) for name, array in state.items()}
    monkeypatch.chdir(tmp_path)
    torch.save({"models": {"Background": tensors}, "step": 30000}, "checkpoint_final.pth")
    page = Path(files.__file__).parents[2] / "docs" / "gaussian_files.md"
    blocks = page.read_text(encoding="utf-8").split("```python\n")[1:]
    (block,) = [text.split("```")[0] for text in blocks if "checkpoint_final" in text]
    exec(block, {"torch": torch, "np": np, "Gaussians": Gaussians, "write_ply": write_ply})
    assert_same_bits(gaussians, read_ply("background.ply"))
