"""Depth networks of transformers, tiny and random, through the library's own files."""

from __future__ import annotations

import json
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tiny_clip import TinyClip

torch = pytest.importorskip("torch")
transformers = pytest.importorskip("transformers", reason="transformers are not installed")

from tiny_depth_model import (  # noqa: E402
    build_tiny_depth_anything,
    build_tiny_dpt,
    build_tiny_glpn,
    build_tiny_zoedepth,
)

from weather_aug import _extras  # noqa: E402
from weather_aug.clip import depth_network  # noqa: E402
from weather_aug.clip.alone import Surfaces  # noqa: E402
from weather_aug.clip.depth_network import DepthNetwork, metres_from_relative  # noqa: E402
from weather_aug.clip.depth_sources import DepthSource  # noqa: E402
from weather_aug.clip.prior import MAX_DEPTH_M, MIN_DEPTH_M  # noqa: E402
from weather_aug.clip.types import FrameKey  # noqa: E402
from weather_aug.errors import ArgumentError, DataError, MissingExtraError  # noqa: E402
from weather_aug.taxonomy import SKY, TRAIN_ID  # noqa: E402

FRAME = TinyClip(width=96, height=64).frame(FrameKey(0, "front"))
IMAGE, LABEL, CAMERA = np.array(FRAME.image), np.array(FRAME.label), FRAME.camera
TRUE_M = np.asarray(FRAME.depth_m, np.float32)

BUILDERS: dict[str, tuple[Callable[[Path], Path], str]] = {
    "depth_anything": (build_tiny_depth_anything, "relative"),
    "depth_anything_metric": (lambda folder: build_tiny_depth_anything(folder, "metric"), "metric"),
    "dpt": (build_tiny_dpt, "relative"),
    "glpn": (build_tiny_glpn, "metric"),
    "zoedepth": (build_tiny_zoedepth, "metric"),
}


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("models")
    return {name: build(root / name) for name, (build, _) in BUILDERS.items()}


def _depth(
    folder: Path | str, label: NDArray[np.uint8] | None = LABEL, **how: Any
) -> NDArray[np.float32]:
    return DepthNetwork(str(folder), **how).depth_m(IMAGE, label, CAMERA, 1.5)


@pytest.mark.parametrize("name", BUILDERS)
def test_every_kind_gives_metres_of_the_pictures_size(models: Any, name: str) -> None:
    depth = _depth(models[name])
    assert (depth.shape, depth.dtype) == (LABEL.shape, np.float32)
    np.testing.assert_array_equal(LABEL == SKY, np.isinf(depth))
    known = depth[LABEL != SKY]
    assert ((known >= MIN_DEPTH_M) & (known <= MAX_DEPTH_M)).all()
    assert np.ptp(known) > 0
    assert depth_network._loaded(str(models[name]), "cpu").kind == BUILDERS[name][1]
    np.testing.assert_array_equal(depth, _depth(models[name]))


@pytest.mark.parametrize("name", ["depth_anything_metric", "glpn"])
def test_metres_are_those_of_the_librarys_own_pipeline(models: Any, name: str) -> None:
    folder = models[name]
    processor = transformers.AutoImageProcessor.from_pretrained(folder, backend="pil")
    network = transformers.AutoModelForDepthEstimation.from_pretrained(folder).eval()
    with torch.inference_mode():
        out = network(**processor(images=IMAGE, return_tensors="pt"))
    theirs = processor.post_process_depth_estimation(out, target_sizes=[LABEL.shape])
    expected = np.clip(theirs[0]["predicted_depth"].numpy(), MIN_DEPTH_M, MAX_DEPTH_M)
    seen = LABEL != SKY
    # They resize by cubics, which overshoot at edges.
    off = np.abs(_depth(folder)[seen] / expected[seen] - 1)
    assert np.median(off) < 0.02


def test_without_a_label_the_sky_is_looked_for(models: Any) -> None:
    depth = _depth(models["glpn"], None)
    overlap = np.isinf(depth) & (LABEL == SKY)
    assert overlap.sum() > 0.9 * (LABEL == SKY).sum()


def test_a_source_reads_the_named_model(models: Any, tmp_path: Path) -> None:
    source = DepthSource(str(tmp_path / "depths"), str(models["dpt"]))
    first = source.depth_m(IMAGE, LABEL, CAMERA, 1.5)
    np.testing.assert_array_equal(first, source.depth_m(IMAGE, None, CAMERA, 1.5))
    np.testing.assert_allclose(_depth(models["dpt"]), first, rtol=1e-3)


def test_a_model_is_read_once_and_pickles_as_its_name(
    models: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    depth_network._loaded.cache_clear()
    reads = []
    kind = transformers.AutoModelForDepthEstimation
    read = kind.from_pretrained
    monkeypatch.setattr(
        kind, "from_pretrained", lambda *a, **k: (reads.append(a), read(*a, **k))[1]
    )
    network = DepthNetwork(str(models["dpt"]))
    state = torch.get_rng_state()
    network.depth_m(IMAGE, LABEL, CAMERA, 1.5)
    assert torch.equal(state, torch.get_rng_state())
    data = pickle.dumps(network)
    assert len(data) < 1000
    pickle.loads(data).depth_m(IMAGE, LABEL, CAMERA, 1.5)
    assert len(reads) == 1


def _off_by(noise: float) -> float:
    """Median relative error of depth up to 30 m, set by ground of which an eighth is the bonnet."""
    rng = np.random.Generator(np.random.Philox(2))
    relative = 37 * (1 / TRUE_M + noise * rng.standard_normal(TRUE_M.shape)) + 5
    relative[-4:] += 20
    found = metres_from_relative(relative.astype(np.float32), Surfaces(LABEL, 0.0), CAMERA, 1.5)
    kept = TRUE_M < 30
    kept[-4:] = False
    return float(np.median(np.abs(found[kept] / TRUE_M[kept] - 1)))


def test_relative_depth_is_set_on_the_ground() -> None:
    assert _off_by(0.0) < 0.005
    assert _off_by(0.002) < 0.02


def test_a_plain_line_would_be_led_astray(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        depth_network, "_robust_line", lambda x, y: tuple(np.polyfit(x, y, 1).tolist())
    )
    assert _off_by(0.0) > 0.1


def test_without_ground_the_spread_is_the_priors() -> None:
    label = np.full(LABEL.shape, TRAIN_ID["building"], np.uint8)
    label[:20] = SKY
    rows = np.arange(LABEL.shape[0], dtype=np.float32)[:, None] + np.zeros(LABEL.shape, np.float32)
    found = metres_from_relative(rows, Surfaces(label, 0.0), CAMERA, 1.5)
    assert np.isfinite(found).all() and (found > 0).all()
    turned = metres_from_relative(-rows, Surfaces(LABEL, 0.0), CAMERA, 1.5)
    assert np.isfinite(turned).all() and (turned > 0).all()


def test_one_depth_everywhere_is_refused() -> None:
    with pytest.raises(DataError, match="same depth everywhere"):
        metres_from_relative(np.full(LABEL.shape, 3.0, np.float32), Surfaces(LABEL, 0.0), CAMERA, 1)


def test_a_bright_facade_that_is_near_is_no_sky(monkeypatch: pytest.MonkeyPatch) -> None:
    sky = np.zeros((4, 10), bool)
    sky[:, :8] = True
    monkeypatch.setattr(depth_network, "sky_mask", lambda _: sky.copy())
    depth = np.full((4, 10), 150.0, np.float32)
    depth[:, :2] = 12.0
    found = depth_network._far_sky(np.zeros((4, 10, 3), np.uint8), depth)
    np.testing.assert_array_equal(np.arange(10) < 8, found[0] | (np.arange(10) < 2))
    assert not found[:, :2].any()


def test_a_model_that_is_not_here_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    with pytest.raises(DataError, match=r"hf download depth-anything/\S+ --local-dir"):
        _depth("depth-anything/Depth-Anything-V2-Small-hf")
    with pytest.raises(DataError, match="no folder"):
        _depth("/no/such/folder")


def test_transformers_are_named_with_their_extra(
    models: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    depth_network._loaded.cache_clear()

    def absent(module: str) -> Any:
        raise ImportError(module)

    monkeypatch.setattr(_extras.importlib, "import_module", absent)
    with pytest.raises(MissingExtraError, match=r"weather-aug\[depth\]"):
        _depth(models["dpt"])


@pytest.mark.parametrize("saved_as", ["DPTImageProcessor", "DPTImageProcessorFast"])
def test_preprocessing_that_others_saved_is_read(
    models: Any, tmp_path: Path, saved_as: str
) -> None:
    folder = shutil.copytree(models["depth_anything"], tmp_path / "model")
    path = folder / "preprocessor_config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"image_processor_type": saved_as}))
    np.testing.assert_array_equal(_depth(models["depth_anything"]), _depth(folder))


def _without_weight(folder: Path, part: str) -> None:
    from safetensors.torch import load_file, save_file

    path = folder / "model.safetensors"
    weights = {name: value for name, value in load_file(path).items() if part not in name}
    assert len(weights) < len(load_file(path))
    save_file(weights, path, {"format": "pt"})


def test_missing_weights_are_refused_unless_unused(models: Any, tmp_path: Path) -> None:
    folder = shutil.copytree(models["dpt"], tmp_path / "unused")
    _without_weight(folder, "fusion_stage.layers.0.residual_layer1.")
    np.testing.assert_array_equal(_depth(models["dpt"]), _depth(folder))
    folder = shutil.copytree(models["dpt"], tmp_path / "used")
    _without_weight(folder, "fusion_stage.layers.0.residual_layer2.")
    with pytest.raises(DataError, match="weights are missing"):
        _depth(folder)


def test_other_files_are_refused_and_never_unpickled(models: Any, tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(DataError, match="empty"):
        _depth(empty)
    pickled = shutil.copytree(models["dpt"], tmp_path / "pickled")
    (pickled / "model.safetensors").rename(pickled / "pytorch_model.bin")
    with pytest.raises(DataError, match="pickled"):
        _depth(pickled)
    other = tmp_path / "other"
    transformers.ViTConfig().save_pretrained(other)
    with pytest.raises(DataError, match="wrap another in a function"):
        _depth(other)


def test_wrong_arguments_are_named(models: Any) -> None:
    with pytest.raises(ArgumentError, match="kind"):
        DepthNetwork("model", kind="disparity")
    with pytest.raises(ArgumentError, match="device"):
        _depth(models["dpt"], device="nonsense")
    network = DepthNetwork(str(models["dpt"]))
    for shape in ((1, 7, 3), (8, 400, 3)):
        with pytest.raises(ArgumentError, match="too small or narrow"):
            network.depth_m(np.zeros(shape, np.uint8), None, CAMERA, 1.5)


def test_what_a_network_gives_is_looked_at(models: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        depth_network, "_predicted", lambda *_: np.full(LABEL.shape, np.nan, np.float32)
    )
    with pytest.raises(DataError, match="NaN"):
        _depth(models["glpn"])
