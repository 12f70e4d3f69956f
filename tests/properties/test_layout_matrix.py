"""T1: every type, layout and size gives what the contiguous copy gives, or a typed error at once.

Cells are generated: pictures of each dtype and memory layout, with masks of each dtype and layout,
at sizes down to a single pixel; then everything that is none of these.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from weather_aug.errors import ArgumentError, WeatherAugError
from weather_aug.render.options import RenderOptions
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.taxonomy import IGNORE, SKY
from weather_aug.transforms.picture import Weathered, Weathering

SIZES = ((1, 1), (1, 7), (7, 1), (17, 31), (101, 99))
MASK_DTYPES = ("uint8", "uint16", "int16", "int32", "int64", ">i4", ">i8")
STORM = Weathering.of(
    WeatherPolicy({"rain+snow+fog": 1}, severity=(0.9, 0.9), falling=1.0),
    options=RenderOptions(max_particles=500),
)
DRAWN = STORM.draw(11)
CELLS_AT_LEAST = 4000
REFUSED_WITHIN_S = 0.010


def fortran(array: np.ndarray) -> np.ndarray:
    return np.asfortranarray(array)


def upside_down(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(array[::-1, ::-1])[::-1, ::-1]


def every_other(array: np.ndarray) -> np.ndarray:
    return np.repeat(np.repeat(array, 2, 0), 3, 1)[::2, ::3]


def transposed(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(array.swapaxes(0, 1)).swapaxes(0, 1)


def read_only(array: np.ndarray) -> np.ndarray:
    done = array.copy()
    done.flags.writeable = False
    return done


def unaligned(array: np.ndarray) -> np.ndarray:
    room = np.zeros(array.nbytes + 1, np.uint8)
    done = np.ndarray(array.shape, array.dtype, room[1:].data)
    done[...] = array
    return done


def part_of_more(array: np.ndarray) -> np.ndarray:
    wide = np.pad(array, [(1, 2), (3, 4), *[(0, 0)] * (array.ndim - 2)])
    return wide[1:-2, 3:-4]


LAYOUTS: tuple[Callable[[np.ndarray], np.ndarray], ...] = (
    np.ascontiguousarray,
    fortran,
    upside_down,
    every_other,
    transposed,
    read_only,
    unaligned,
    part_of_more,
)


def picture_of(size: tuple[int, int]) -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (*size, 3), dtype=np.uint8)


def mask_of(size: tuple[int, int]) -> np.ndarray:
    mask = np.zeros(size, np.uint8)
    mask[: size[0] // 3] = SKY
    mask[size[0] // 3 : size[0] // 2, ::2] = 2
    if mask.size > 1:
        mask[-1:, :1] = IGNORE
    return mask


def as_float(image: np.ndarray) -> np.ndarray:
    return (image / np.float32(255)).astype(np.float32)


IMAGE_DTYPES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "uint8": np.copy,
    "float32": as_float,
    ">f4": lambda image: as_float(image).astype(">f4"),
}
_EXPECTED: dict[tuple[int, int], Weathered] = {}


def expected_of(size: tuple[int, int]) -> Weathered:
    if size not in _EXPECTED:
        _EXPECTED[size] = STORM.render(picture_of(size), DRAWN, mask=mask_of(size))
    return _EXPECTED[size]


def cells() -> list[tuple[Any, ...]]:
    return list(itertools.product(SIZES, IMAGE_DTYPES, LAYOUTS, MASK_DTYPES, LAYOUTS))


def test_there_are_enough_cells() -> None:
    assert len(cells()) >= CELLS_AT_LEAST


@pytest.mark.parametrize("kind", IMAGE_DTYPES)
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_every_layout_is_the_contiguous_copy(size: tuple[int, int], kind: str) -> None:
    """What the renderer is handed is compared, which is all that it can tell pictures by.

    Rendering itself is run for a few cells of each size below, and for all in the slow test.
    """
    expected = STORM.frame(picture_of(size), DRAWN, mask=mask_of(size))
    for layout, dtype, mask_layout in itertools.product(LAYOUTS, MASK_DTYPES, LAYOUTS):
        image = layout(IMAGE_DTYPES[kind](picture_of(size)))
        mask = mask_layout(mask_of(size).astype(dtype))
        before = image.tobytes(), mask.tobytes(), image.strides, mask.strides, image.flags.writeable
        frame = STORM.frame(image, DRAWN, mask=mask)
        cell = (layout.__name__, dtype, mask_layout.__name__)
        assert frame.image.flags.c_contiguous, cell
        assert (frame.image == expected.image).all(), cell
        assert frame.label is not None
        assert expected.label is not None
        assert frame.label.tobytes() == expected.label.tobytes(), cell
        assert frame.depth_m is not None
        assert expected.depth_m is not None
        assert frame.depth_m.tobytes() == expected.depth_m.tobytes(), cell
        after = image.tobytes(), mask.tobytes(), image.strides, mask.strides, image.flags.writeable
        assert after == before, cell


def check_rendered(size: tuple[int, int], kind: str, layout: Any, dtype: str, other: Any) -> None:
    expected = expected_of(size)
    image = layout(IMAGE_DTYPES[kind](picture_of(size)))
    mask = other(mask_of(size).astype(dtype))
    done = STORM.render(image, DRAWN, mask=mask)
    assert done.mask is not None
    assert expected.mask is not None
    assert done.image.dtype == image.dtype.newbyteorder("=")
    assert done.mask.dtype == mask.dtype.newbyteorder("=")
    levels = done.image if kind == "uint8" else np.rint(done.image * 255)
    assert (levels == expected.image).all()
    assert (done.mask == expected.mask).all()
    for array in (done.image, done.mask):
        assert array.flags.c_contiguous
        assert array.flags.writeable
        assert not np.shares_memory(array, image)
        assert not np.shares_memory(array, mask)
    assert np.isfinite(done.image).all()
    assert set(np.unique(done.mask)) <= {*np.unique(mask_of(size)), IGNORE}


@pytest.mark.parametrize("kind", IMAGE_DTYPES)
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_layouts_render_alike(size: tuple[int, int], kind: str) -> None:
    for layout, dtype in zip(LAYOUTS, itertools.cycle(MASK_DTYPES)):
        check_rendered(size, kind, layout, dtype, LAYOUTS[-1 - LAYOUTS.index(layout)])


@pytest.mark.slow
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_all_cells_render_alike(size: tuple[int, int]) -> None:
    for cell in cells():
        if cell[0] == size:
            check_rendered(*cell)


def test_a_broadcast_picture_is_its_copy() -> None:
    """Strides of 0: one grey row seen many times."""
    row = picture_of((1, 31))
    image = np.broadcast_to(row, (17, 31, 3))
    mask = np.broadcast_to(np.zeros((1, 31), np.uint8), (17, 31))
    done = STORM.render(image, DRAWN, mask=mask)
    copy = STORM.render(image.copy(), DRAWN, mask=mask.copy())
    assert (done.image == copy.image).all()
    assert (done.mask == copy.mask).all()


def test_a_picture_read_without_its_strides_would_be_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """A planted fault: the memory of a picture taken as if it were contiguous."""

    def careless(array: np.ndarray, dtype: Any = None) -> np.ndarray:
        base = array if array.base is None else array.base
        return np.frombuffer(base.tobytes(), array.dtype)[: array.size].reshape(array.shape)

    size = (17, 31)
    expected = STORM.frame(picture_of(size), DRAWN, mask=mask_of(size))
    image = upside_down(picture_of(size))
    monkeypatch.setattr(np, "ascontiguousarray", careless)
    wrong = STORM.frame(image, DRAWN, mask=mask_of(size))
    assert (wrong.image != expected.image).any()


IMAGE = picture_of((17, 31))
MASK = mask_of((17, 31))
DEPTH = np.full((17, 31), 20.0, np.float32)
REFUSED: dict[str, dict[str, Any]] = {
    **{
        f"image {dtype}": {"image": np.zeros((17, 31, 3), dtype)}
        for dtype in ("u2", "i4", "f2", "f8", "?", "O", "c8", "i1", "u4", "m8[s]", "S1")
    },
    **{
        f"image {shape}": {"image": np.zeros(shape, np.uint8)}
        for shape in (
            *((), (3,), (17, 31), (17, 31, 1), (17, 31, 2), (17, 31, 4), (3, 17, 31)),
            *((1, 17, 31, 3), (0, 31, 3), (17, 0, 3), (0, 0, 3), (17, 31, 0)),
        )
    },
    "image of 65 MP": {"image": np.broadcast_to(np.zeros(3, np.uint8), (8200, 8000, 3))},
    "image None": {"image": None},
    "image list": {"image": IMAGE.tolist()},
    **{
        f"image with {value}": {"image": np.where(IMAGE == IMAGE.max(), np.float32(value), 0.5)}
        for value in (np.nan, np.inf, -np.inf, -0.01, 1.01, 255.0)
    },
    **{
        f"mask {dtype}": {"mask": np.zeros((17, 31), dtype)}
        for dtype in ("f2", "f4", "f8", "?", "i1", "u4", "u8", "O", "c8", "S1")
    },
    **{
        f"mask {shape}": {"mask": np.zeros(shape, np.uint8)}
        for shape in ((), (17,), (31, 17), (17, 30), (17, 31, 1), (1, 17, 31), (0, 0), (0, 31))
    },
    "mask of unknown ids": {"mask": np.full((17, 31), 77, np.uint8)},
    "mask of negative ids": {"mask": np.full((17, 31), -1, np.int64)},
    **{
        f"depth {dtype}": {"depth": np.ones((17, 31), dtype)}
        for dtype in ("u1", "u2", "i4", "?", "O", "c8", "S1")
    },
    **{
        f"depth {shape}": {"depth": np.ones(shape, np.float32)}
        for shape in ((), (31, 17), (17, 31, 1), (0, 0))
    },
    **{
        f"depth all {value}": {"depth": np.full((17, 31), value, np.float32)}
        for value in (np.nan, 0.0, -1.0, -np.inf)
    },
}


@pytest.mark.parametrize("name", REFUSED)
def test_all_else_is_refused_by_name_at_once(name: str) -> None:
    given = {"image": IMAGE, "mask": MASK, "depth": DEPTH} | REFUSED[name]
    image = given.pop("image")
    argument = name.split()[0]
    times = []
    for _ in range(3):
        start = time.process_time()
        with pytest.raises(WeatherAugError, match=argument):
            STORM.render(image, DRAWN, **given)
        times.append(time.process_time() - start)
    assert min(times) < REFUSED_WITHIN_S


@pytest.mark.parametrize("dtype", ["f2", "f4", "f8", ">f4", ">f8"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_depth_of_any_layout_is_the_contiguous_copy(dtype: str, layout: Any) -> None:
    depth = np.linspace(2, 60, 17 * 31).reshape(17, 31).astype(np.float16)
    expected = STORM.render(IMAGE, DRAWN, mask=MASK, depth=depth.astype(np.float32))
    given = layout(depth.astype(dtype))
    before = given.tobytes()
    done = STORM.render(IMAGE, DRAWN, mask=MASK, depth=given)
    assert (done.image == expected.image).all()
    assert (done.mask == expected.mask).all()
    assert given.tobytes() == before


@pytest.mark.parametrize("hole", [np.nan, 0.0, -3.0, np.inf, -np.inf, 1e30])
def test_unknown_depth_is_far(hole: float) -> None:
    depth = DEPTH.copy()
    depth[:, :9] = hole
    far = DEPTH.copy()
    far[:, :9] = np.inf
    done = STORM.render(IMAGE, DRAWN, mask=MASK, depth=depth)
    assert (done.image == STORM.render(IMAGE, DRAWN, mask=MASK, depth=far).image).all()
    assert not np.isnan(done.shot.depth).any()


@pytest.mark.parametrize("severity", [-0.1, 1.1, np.nan, np.inf, 1e308, "much", True])
def test_a_severity_outside_is_refused(severity: Any) -> None:
    with pytest.raises(ArgumentError, match="severity"):
        WeatherPolicy(severity=(0.0, severity))
