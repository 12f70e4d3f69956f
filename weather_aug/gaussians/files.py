"""Gaussians as files that other programs open: the PLY of 3DGS, written and read back bit by bit.

Convention:
    One element `vertex`, binary little-endian, all properties float32: x y z, nx ny nz (zero), the
    spherical harmonics f_dc_0..2 and f_rest_* (all of red, then green, then blue), opacity (logit),
    scale_0..2 (logarithms), rot_0..3 (w, x, y, z). Axes and metres are those of the Gaussians
    given; the file says nothing about them. Our class scores are further properties class_00,
    class_01, …, and are written only when asked for: not every reader skips what it does not know.
    docs/gaussian_files.md says who opens these files, and what else is in use.

Sources:
    3D Gaussian Splatting (Kerbl et al. 2023) for fields and order; PLY (Turk 1994).
"""

from __future__ import annotations

import math
import re
import stat
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from weather_aug import _files
from weather_aug.errors import ArgumentError, DataError, printable
from weather_aug.gaussians.types import SH_COEFFICIENTS, Gaussians

Float32 = NDArray[np.float32]

MAX_HEADER_BYTES = 65536
MOST_CLASSES = 100
"""Two digits name them."""
MOST_MEAN_M = 1e9
"""Its square is far from the largest float32; so it is with the following."""
MOST_LOG_SCALE = 40.0
MOST_COEFFICIENT = 1e6
QUATERNION_NORM = (1e-12, 1e12)
SURE_LOGIT = 16.0
"""float32 knows opacities up to 1 - 2^-24; converters write an opaque Gaussian's logit as inf."""

_MEANS = ("x", "y", "z")
_NORMALS = ("nx", "ny", "nz")
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALES = ("scale_0", "scale_1", "scale_2")
_QUATERNION = ("rot_0", "rot_1", "rot_2", "rot_3")
_NEEDED = (*_MEANS, *_DC, "opacity", *_SCALES, *_QUATERNION)
_OPENING = ("ply", "format binary_little_endian 1.0")
_FLOATS = ("float", "float32")
_CONVERT = "convert it with: splat-transform in.ply out.ply"


def write_ply(path: str | Path, gaussians: Gaussians, *, with_classes: bool = False) -> None:
    """Write Gaussians as a 3DGS PLY; the file is whole or absent. See the module's Convention.

    Args:
        path: File to write, whose name should end in .ply.
        gaussians: What to write; the degree of its harmonics is kept.
        with_classes: Write the class scores too, for `read_ply`; strangers may not skip them.

    Raises:
        ArgumentError: If an array is not float16 or float32, or a number is not finite or could not
            be drawn (see `read_ply`), or there are more than 100 classes.
        OutputError: If the file cannot be written.
    """
    columns = _columns(gaussians, with_classes)
    problem = _unusable(gaussians)
    if problem:
        raise ArgumentError(f"cannot write these Gaussians: {problem}")
    rows = np.empty(len(gaussians), _layout(columns))
    for name, values in columns.items():
        rows[name] = values
    with _files.whole_file(Path(path)) as file:
        lines = [*_OPENING, f"element vertex {len(rows)}"]
        lines += [f"property float {name}" for name in columns]
        file.write("\n".join([*lines, "end_header", ""]).encode("ascii"))
        rows.tofile(file)


def read_ply(path: str | Path, *, drop: Collection[str] = ()) -> Gaussians:
    """Read a 3DGS PLY of degree 0 to 3, with or without normals and class scores.

    The header is checked against the size of the file before anything is allocated, and nothing in
    it is run.

    Args:
        path: File to read.
        drop: Properties to leave out that 3DGS does not know; unnamed ones are refused, because
            they may change what the others mean, as the `filter_3D` of Mip-Splatting does.

    Returns:
        Gaussians with float32 arrays of the file's bits, but for infinite opacities, which some
        converters write for 0 and 1: they are read as logits of -16 and 16.

    Raises:
        DataError: If the file is missing, is no such PLY (text, big-endian, compressed, a needed
            property missing or of another type, sizes that do not agree), or a number in it is
            not finite, farther than 1e9 m, larger than e^40 m, or a quaternion without direction.
    """
    path = Path(path)
    where = printable(path, 200)
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise DataError(f"{where} is not a regular file")
        with path.open("rb") as file:
            header = _checked_header(file, where, drop)
            rows = _rows(file, where, header)
            gaussians = _gaussians(rows, header)
    except OSError as error:
        raise DataError(f"cannot read {where}: {error.strerror or error}") from None
    problem = _unusable(gaussians)
    if problem:
        raise DataError(f"{where}: {problem}; remove these, or export the file again")
    return gaussians


class _Header(NamedTuple):
    begin: int
    """Of the rows, bytes."""
    rows: int
    names: tuple[str, ...]
    """Of all properties, in the order of the file."""
    coefficients: int
    classes: int


def _columns(gaussians: Gaussians, with_classes: bool) -> dict[str, Float32]:
    """Values (N,) by property, in the order of the file."""
    count = len(gaussians)
    rest_names = _rest_names(gaussians.sh.shape[1])
    rest = gaussians.sh[:, 1:].transpose(0, 2, 1).reshape(count, len(rest_names))
    blocks = {
        _MEANS: gaussians.means_m,
        _NORMALS: np.zeros((count, 3), np.float32),
        _DC: gaussians.sh[:, 0],
        rest_names: rest,
        ("opacity",): gaussians.logit_opacities[:, None],
        _SCALES: gaussians.log_scales,
        _QUATERNION: gaussians.quaternions,
    }
    if with_classes:
        classes = gaussians.class_scores.shape[1]
        if classes > MOST_CLASSES:
            raise ArgumentError(f"a PLY holds {MOST_CLASSES} classes at most, got {classes}")
        blocks[_class_names(classes)] = gaussians.class_scores
    for names, block in blocks.items():
        if not np.can_cast(block.dtype, np.float32, "safe"):
            raise ArgumentError(
                f"{names[0]}: a PLY holds float32, got {block.dtype}; convert with .astype"
            )
    return {
        name: block[:, column]
        for names, block in blocks.items()
        for column, name in enumerate(names)
    }


def _gaussians(rows: NDArray[np.void], header: _Header) -> Gaussians:
    def block(names: tuple[str, ...]) -> Float32:
        found = np.empty((len(rows), len(names)), np.float32)
        for column, name in enumerate(names):
            found[:, column] = rows[name]
        return found

    sh = np.empty((len(rows), header.coefficients, 3), np.float32)
    sh[:, 0] = block(_DC)
    rest = block(_rest_names(header.coefficients))
    sh[:, 1:] = rest.reshape(len(rows), 3, header.coefficients - 1).transpose(0, 2, 1)
    logits = block(("opacity",))[:, 0]
    endless = np.isinf(logits)
    logits[endless] = np.copysign(np.float32(SURE_LOGIT), logits[endless])
    return Gaussians(
        block(_MEANS),
        block(_QUATERNION),
        block(_SCALES),
        logits,
        sh,
        block(_class_names(header.classes)),
    )


def _rest_names(coefficients: int) -> tuple[str, ...]:
    return tuple(f"f_rest_{k}" for k in range(3 * (coefficients - 1)))


def _class_names(classes: int) -> tuple[str, ...]:
    return tuple(f"class_{k:02d}" for k in range(classes))


def _rows(file: BinaryIO, where: str, header: _Header) -> NDArray[np.void]:
    """The rows behind a header that was checked."""
    file.seek(header.begin)
    rows = np.fromfile(file, _layout(header.names), header.rows)
    if len(rows) != header.rows:
        raise DataError(f"{where} was cut short while it was read; read it again")
    return rows


def _layout(names: Iterable[str]) -> np.dtype[np.void]:
    return np.dtype([(name, "<f4") for name in names])


def _checked_header(file: BinaryIO, where: str, drop: Collection[str]) -> _Header:
    """What the header promises, if that is 3DGS and the file has as many bytes."""
    size = file.seek(0, 2)
    file.seek(0)
    lines, begin = _header_lines(file.read(MAX_HEADER_BYTES), where)
    count, names = _declared(lines, where)
    coefficients, classes = _known([name for name in names if name not in drop], where)
    expected = begin + count * 4 * len(names)
    if expected != size:
        raise DataError(
            f"{where} declares {count} Gaussians of {len(names)} numbers, {expected} bytes in all, "
            f"but has {size}; it was cut short or is not what it says: copy or export it again"
        )
    return _Header(begin, count, names, coefficients, classes)


def _header_lines(start: bytes, where: str) -> tuple[list[str], int]:
    """Lines between the first and the last of the header, and where the rows begin."""
    newline = b"\r\n" if start.startswith(b"ply\r\n") else b"\n"
    last = newline + b"end_header" + newline
    end = start.find(last)
    if not start.startswith(b"ply" + newline) or end < 0:
        raise DataError(
            f"{where} is no PLY: it does not begin with a line 'ply' and a header of at most "
            f"{MAX_HEADER_BYTES} bytes; .splat, .spz and .sog are other formats: {_CONVERT}"
        )
    header = start[:end].decode("ascii", errors="replace")
    lines = header.split(newline.decode())[1:]
    for line in lines:
        if not line.isprintable() or "\ufffd" in line:
            raise DataError(f"{where}: a line of its header is no text: {printable(line)!r}")
    return lines, end + len(last)


def _declared(lines: list[str], where: str) -> tuple[int, tuple[str, ...]]:
    """Number of rows and names of their properties; all are float32 and differ."""
    if not lines or lines[0].split() != _OPENING[1].split():
        found = printable(lines[0] if lines else "")
        raise DataError(
            f"{where} must be of format binary_little_endian 1.0, got {found!r}; read it with "
            "the package plyfile, set text = False and byte_order = '<', and write it again"
        )
    counts: list[int] = []
    names: list[str] = []
    for line in lines[1:]:
        words = line.split()
        match words:
            case ["comment" | "obj_info", *_]:
                continue
            case ["element", "vertex", number] if not counts and _NUMBER.fullmatch(number):
                counts.append(int(number))
            case ["property", kind, name] if counts and kind in _FLOATS and name not in names:
                names.append(name)
            case ["element", "chunk", _]:
                raise DataError(f"{where} is a compressed PLY; {_CONVERT}")
            case _:
                raise DataError(
                    f"{where}: {printable(line)!r} has no place in the header of a 3DGS PLY, which "
                    "has one element, vertex, and float properties that differ; export it again, "
                    f"or {_CONVERT}"
                )
    if not counts:
        raise DataError(f"{where} has no element vertex, so it holds no Gaussians")
    return counts[0], tuple(names)


def _known(names: Sequence[str], where: str) -> tuple[int, int]:
    """How many coefficients and classes these properties hold, if they are 3DGS."""
    missing = [name for name in _NEEDED if name not in names]
    if missing:
        raise DataError(
            f"{where} lacks {', '.join(missing)}: it is a point cloud or a mesh, or of another "
            "kind of Gaussians; export it as a 3DGS PLY"
        )
    given = set(names)
    rest = sum(name.startswith("f_rest_") for name in names)
    classes = sum(_CLASS.fullmatch(name) is not None for name in names)
    coefficients = rest // 3 + 1
    if coefficients not in SH_COEFFICIENTS or not given.issuperset(_rest_names(coefficients)):
        raise DataError(
            f"{where} has {rest} properties f_rest_*; of degree 0 to 3 there are 0, 9, 24 or 45"
        )
    if rest % 3 or not given.issuperset(_class_names(classes)):
        raise DataError(f"{where}: properties f_rest_* or class_* do not count from 0 on")
    ours = {*_NEEDED, *_NORMALS, *_rest_names(coefficients), *_class_names(classes)}
    strange = [name for name in names if name not in ours]
    if strange:
        raise DataError(
            f"{where} has properties that 3DGS does not know: {printable(', '.join(strange))}; "
            f"if they change nothing, read it with drop={printable(tuple(strange))}"
        )
    return coefficients, classes


def _unusable(gaussians: Gaussians) -> str | None:
    """What is wrong with the first numbers that no rasteriser could draw."""
    limits = {
        "means (x, y, z)": (gaussians.means_m, -MOST_MEAN_M, MOST_MEAN_M),
        "log scales (scale_*)": (gaussians.log_scales, -math.inf, MOST_LOG_SCALE),
        "harmonics (f_dc_*, f_rest_*)": (gaussians.sh, -MOST_COEFFICIENT, MOST_COEFFICIENT),
        "opacities (opacity)": (gaussians.logit_opacities, -math.inf, math.inf),
        "class scores (class_*)": (gaussians.class_scores, -math.inf, math.inf),
    }
    for name, (values, low, high) in limits.items():
        bad = ~(np.isfinite(values) & (values >= low) & (values <= high))
        if bad.any():
            rows = np.flatnonzero(bad.reshape(len(bad), -1).any(axis=1))
            span = "finite" if math.isinf(high) else f"finite and at most {high:g}"
            return f"{name} of {len(rows)} Gaussians are not {span}, the first is number {rows[0]}"
    low, high = QUATERNION_NORM
    norms = np.linalg.norm(gaussians.quaternions.astype(np.float64), axis=1)
    turned = np.flatnonzero(~((norms >= low) & (norms <= high)))
    if len(turned):
        return (
            f"quaternions (rot_*) of {len(turned)} Gaussians have no direction, the first is "
            f"number {turned[0]}"
        )
    return None


_NUMBER = re.compile(r"[0-9]{1,15}")
_CLASS = re.compile(r"class_[0-9]{2}")
