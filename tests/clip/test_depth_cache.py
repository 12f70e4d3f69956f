"""The cache of depth: what is put in comes out, and nothing else is ever taken for depth."""

from __future__ import annotations

import pickle
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from weather_aug import _files
from weather_aug.clip import depth_cache
from weather_aug.clip.depth_cache import DepthCache
from weather_aug.errors import ArgumentError, DataError, OutputError

IMAGE = np.random.Generator(np.random.Philox(1)).integers(0, 256, (6, 9, 3), np.uint8)
DEPTH = np.linspace(1, 90, 54, dtype=np.float32).reshape(6, 9)
DEPTH[0] = np.inf


@given(
    depth=arrays.arrays(
        np.float32, st.tuples(*2 * [st.integers(1, 5)]), elements=st.floats(2**-20, 2**20, width=32)
    )
)
def test_what_is_put_comes_out_as_half_precision(
    depth: np.ndarray, tmp_path_factory: pytest.TempPathFactory
) -> None:
    cache = DepthCache(tmp_path_factory.mktemp("cache"))
    image = np.zeros((*depth.shape, 3), np.uint8)
    put = cache.put(image, depth)
    got = cache.get(image)
    assert got is not None
    assert (got.dtype, got.shape) == (np.float32, depth.shape)
    np.testing.assert_array_equal(put, got)
    usual = (depth > 0.02) & (depth < 50_000)
    np.testing.assert_allclose(depth[usual], got[usual], rtol=1e-3)
    assert np.isinf(got[depth > 60_000]).all()


def test_a_depth_is_found_by_the_picture_alone(tmp_path: Path) -> None:
    cache = DepthCache(tmp_path / "made" / "later")
    assert cache.get(IMAGE) is None
    cache.put(IMAGE[:, ::-1][:, ::-1], DEPTH)
    other = IMAGE.copy()
    other[5, 8, 2] ^= 1
    assert cache.get(other) is None
    assert cache.get(IMAGE.reshape(9, 6, 3)) is None
    assert pickle.loads(pickle.dumps(cache)).get(IMAGE) is not None
    path = cache.path_of(IMAGE)
    assert path.parent.name == path.stem[:2]
    assert path.stat().st_size < 2 * DEPTH.size + 200
    np.testing.assert_array_equal(np.load(path, allow_pickle=False), cache.get(IMAGE))


class Attack:
    def __reduce__(self) -> Any:
        return (pytest.fail, ("a file of the cache was unpickled",))


def _damages() -> dict[str, Any]:
    def array(values: Any, **how: Any) -> Any:
        return lambda path: np.save(path, values, **how)

    nan, zero = DEPTH.astype(np.float16), DEPTH.astype(np.float16)
    nan[3, 3], zero[3, 3] = np.nan, 0
    objects = np.empty(DEPTH.shape, object)
    objects[0, 0] = Attack()
    return {
        "cut": lambda path: path.write_bytes(path.read_bytes()[:-1]),
        "longer": lambda path: path.write_bytes(path.read_bytes() + b"\0"),
        "empty": lambda path: path.write_bytes(b""),
        "text": lambda path: path.write_text("depth"),
        "folder": lambda path: (path.unlink(), path.mkdir()),
        "shape": array(DEPTH.T),
        "columns": array(np.asfortranarray(DEPTH)),
        "integers": array(np.ones(DEPTH.shape, np.int16)),
        "nan": array(nan),
        "zero": array(zero),
        "pickle": array(objects, allow_pickle=True),
        "bare pickle": lambda path: path.write_bytes(pickle.dumps(Attack())),
        "huge": lambda path: path.write_bytes(
            b"\x93NUMPY\x01\x00\x76\x00"
            + b"{'descr': '<f2', 'fortran_order': False, 'shape': (6, 99999999999), }".ljust(117)
            + b"\n"
        ),
    }


@pytest.mark.parametrize("damage", _damages())
def test_a_damaged_file_is_named_with_its_cure(tmp_path: Path, damage: str) -> None:
    cache = DepthCache(tmp_path)
    cache.put(IMAGE, DEPTH)
    path = cache.path_of(IMAGE)
    _damages()[damage](path)
    with pytest.raises(DataError, match=f"{path.name}.*delete it"):
        cache.get(IMAGE)


def test_a_single_precision_file_of_the_user_is_read(tmp_path: Path) -> None:
    cache = DepthCache(tmp_path)
    path = cache.path_of(IMAGE)
    path.parent.mkdir()
    np.save(path, DEPTH)
    np.testing.assert_array_equal(DEPTH, cache.get(IMAGE))


@pytest.mark.parametrize("depth", [DEPTH[:, :-1], DEPTH * np.nan, -DEPTH, np.ones((6, 9), int)])
def test_what_is_no_depth_is_not_stored(tmp_path: Path, depth: np.ndarray) -> None:
    with pytest.raises(ArgumentError, match="depth_m"):
        DepthCache(tmp_path).put(IMAGE, depth)
    assert list(tmp_path.iterdir()) == []


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    cache = DepthCache(tmp_path / "file")
    with pytest.raises(OutputError, match="file"):
        cache.put(IMAGE, DEPTH)
    with pytest.raises(DataError, match="file"):
        cache.get(IMAGE)


def _written_by_many(folder: Path) -> list[BaseException]:
    """Eight workers put the same depth at the same time; what they met."""
    cache, met = DepthCache(folder), []
    gate = threading.Barrier(8)

    def work() -> None:
        try:
            gate.wait(10)
            for _ in range(5):
                cache.put(IMAGE, DEPTH)
                if cache.get(IMAGE) is None:
                    raise AssertionError("lost")
        except BaseException as error:
            met.append(error)

    workers = [threading.Thread(target=work) for _ in range(8)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(60)
    return met


def test_workers_may_write_the_same_depth(tmp_path: Path, monkeypatch: Any) -> None:
    assert _written_by_many(tmp_path / "a") == []
    paths = [path for path in (tmp_path / "a").rglob("*") if path.is_file()]
    assert [path.suffix for path in paths] == [".npy"]
    # One temporary name for all is what goes wrong.
    monkeypatch.setattr(depth_cache.secrets, "token_hex", lambda _: "same")
    assert _written_by_many(tmp_path / "b") != []


def test_a_write_that_breaks_off_leaves_nothing(tmp_path: Path, monkeypatch: Any) -> None:
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(_files.os, "fsync", full)
    with pytest.raises(OutputError, match="free some space"):
        DepthCache(tmp_path).put(IMAGE, DEPTH)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []
