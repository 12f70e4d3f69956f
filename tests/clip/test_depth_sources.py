"""Which depth a picture gets: the cache's, a network's, its label's, its own."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tiny_clip import TinyClip

from weather_aug.clip import depth_sources
from weather_aug.clip.alone import depth_from_picture
from weather_aug.clip.depth_cache import DepthCache
from weather_aug.clip.depth_network import DepthNetwork
from weather_aug.clip.depth_sources import DepthSource, GuessedDepthWarning
from weather_aug.clip.prior import geometric_prior_depth
from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError

FRAME = TinyClip().frame(FrameKey(0, "front"))
IMAGE, LABEL, CAMERA = np.array(FRAME.image), np.array(FRAME.label), FRAME.camera
VIEW: dict[str, Any] = dict(
    focal_px=CAMERA.focal_px[1], principal_px=CAMERA.principal_px, camera_height_m=1.4
)


@pytest.fixture(autouse=True)
def unwarned(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(depth_sources, "_warned", False)


def _metres(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    return np.full(image.shape[:2], 7.003, np.float32)


def _depth(source: DepthSource, label: NDArray[np.uint8] | None = LABEL) -> NDArray[np.float32]:
    return source.depth_m(IMAGE, label, CAMERA, 1.4)


def test_the_label_comes_before_the_picture() -> None:
    np.testing.assert_array_equal(geometric_prior_depth(LABEL, **VIEW), _depth(DepthSource()))


def test_the_picture_alone_is_warned_of_once() -> None:
    expected = depth_from_picture(IMAGE, **VIEW)
    with pytest.warns(GuessedDepthWarning, match="depth_network="):
        np.testing.assert_array_equal(expected, _depth(DepthSource(), None))
    # A second warning would be an error here.
    np.testing.assert_array_equal(expected, _depth(DepthSource(), np.full_like(LABEL, 255)))
    depth_sources._warned = False
    with pytest.raises(GuessedDepthWarning):
        _depth(DepthSource(), None)


def test_the_network_comes_before_the_label_and_fills_the_cache(tmp_path: Path) -> None:
    folder = tmp_path / "depths"
    calls = []

    def network(image: NDArray[np.uint8]) -> NDArray[np.float32]:
        calls.append(image)
        return _metres(image)

    source = DepthSource(str(folder), network)
    first, second = _depth(source), _depth(source, None)
    assert len(calls) == 1
    np.testing.assert_array_equal(first, second)
    np.testing.assert_allclose(7.003, first, rtol=1e-3)
    np.testing.assert_array_equal(first, DepthCache(folder).get(IMAGE))


def test_the_cache_comes_first_and_is_not_filled_with_guesses(tmp_path: Path) -> None:
    source = DepthSource(str(tmp_path))
    _depth(source)
    assert list(tmp_path.iterdir()) == []
    DepthCache(tmp_path).put(IMAGE, np.full(IMAGE.shape[:2], 3.0, np.float32))
    np.testing.assert_array_equal(3.0, _depth(source))


def test_unknown_depth_of_a_function_is_far() -> None:
    def holed(image: NDArray[np.uint8]) -> NDArray[np.float32]:
        depth = _metres(image)
        depth[0, :3] = np.nan, 0, -1
        return depth

    depth = _depth(DepthSource(network=holed))
    assert np.isinf(depth[0, :3]).all()
    np.testing.assert_array_equal(np.float32(7.003), depth[1:])


@pytest.mark.parametrize(
    "gives",
    [
        lambda image: _metres(image)[1:],
        lambda image: _metres(image).astype(int),
        lambda image: _metres(image) * np.nan,
        lambda image: np.where(np.arange(image.shape[1]) < 20, _metres(image), np.nan),
        lambda image: None,
    ],
)
def test_a_function_that_gives_no_depth_is_refused(tmp_path: Path, gives: Any) -> None:
    with pytest.raises(ArgumentError, match="depth"):
        _depth(DepthSource(str(tmp_path), gives))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("wrong", [dict(cache=3), dict(network=3), dict(network=b"name")], ids=str)
def test_what_is_no_source_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ArgumentError, match=f"depth_{next(iter(wrong))}"):
        DepthSource(**wrong)


@pytest.mark.parametrize("network", [None, "somebody/model", DepthNetwork("m"), _metres], ids=str)
def test_sources_pickle_and_compare(tmp_path: Path, network: Any) -> None:
    source = DepthSource(str(tmp_path), network)
    assert pickle.loads(pickle.dumps(source)) == source
    assert DepthSource(tmp_path, network) == source
