"""RandomWeather for kornia, called as kornia's own tests call every augmentation."""

from __future__ import annotations

import copy
import io
import pickle
import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kornia_street import (
    FOG,
    HEIGHT,
    MIXED,
    RAIN,
    SNOW,
    WIDTH,
    camera,
    depths,
    masks,
    pictures,
    psnr,
)
from torch import Tensor, nn

from weather_aug.clip.depth_sources import DepthSource
from weather_aug.errors import ArgumentError, DataError, MissingExtraError
from weather_aug.render.batch import BATCH_OPTIONS
from weather_aug.render.options import DEFAULT_OPTIONS
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.taxonomy import IGNORE
from weather_aug.transforms import kornia_weather
from weather_aug.transforms.kornia import RandomWeather
from weather_aug.transforms.kornia_params import camera_of, camera_rows, drawn_of, drawn_rows
from weather_aug.transforms.picture import Drawn, Weathering
from weather_aug.weather import Weather

torch.set_num_threads(1)


@pytest.fixture
def flat_ground(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """In place of what finds depth: everything 60 m away; it notes the labels it was given."""
    labels = []

    def depth_m(self: Any, image: Any, label: Any, camera: Any, camera_height_m: float) -> Any:
        labels.append(label)
        return np.full(image.shape[:2], 60, np.float32)

    monkeypatch.setattr(DepthSource, "depth_m", depth_m)
    return labels


@pytest.mark.parametrize("policy", [None, SNOW, FOG.to_dict()], ids=["default", "snow", "dict"])
@pytest.mark.parametrize("same_on_batch", [False, True])
@pytest.mark.parametrize("p", [0.0, 0.5, 1.0])
def test_smoke(policy: Any, same_on_batch: bool, p: float) -> None:
    weather = RandomWeather(policy, p=p, same_on_batch=same_on_batch, seed=3)
    found, mask = weather(pictures(), mask=masks())
    assert (found.shape, found.dtype, found.device) == (
        pictures().shape,
        torch.float32,
        found.device,
    )
    assert 0 <= float(found.min()) and float(found.max()) <= 1
    assert mask.shape == masks().shape
    assert f"p={p}" in repr(weather)
    assert "WeatherPolicy" in repr(weather)


@pytest.mark.parametrize("keepdim", [False, True])
@pytest.mark.parametrize(
    ("shape", "batched"),
    [
        ((2, 3, 16, 24), (2, 3, 16, 24)),
        ((1, 3, 7, 5), (1, 3, 7, 5)),
        ((3, 16, 24), (1, 3, 16, 24)),
        ((2, 3, 1, 1), (2, 3, 1, 1)),
        ((0, 3, 16, 24), (0, 3, 16, 24)),
    ],
    ids=str,
)
def test_cardinality(shape: tuple[int, ...], batched: tuple[int, ...], keepdim: bool) -> None:
    weather = RandomWeather(SNOW, p=1.0, keepdim=keepdim)
    depth = torch.full((*batched[:1], 1, *shape[-2:]), 20.0)
    found = weather(torch.full(shape, 0.4), depth=depth)
    assert found.shape == (shape if keepdim else batched)


@pytest.mark.parametrize(
    ("given", "error", "says"),
    [
        (torch.zeros(2, 3, 4, 4, dtype=torch.uint8), TypeError, "float"),
        (torch.zeros(2, 1, 4, 4), ArgumentError, r"\(B, 3, H, W\)"),
        (torch.zeros(4, 4), ArgumentError, r"\(B, 3, H, W\)"),
        (torch.zeros(2, 3, 0, 4), ArgumentError, r"\(B, 3, H, W\)"),
        (torch.full((2, 3, 4, 4), 1.01), ArgumentError, r"\[0, 1\]"),
        (torch.full((2, 3, 4, 4), -0.5), ArgumentError, "normalisation"),
        (torch.full((2, 3, 4, 4), torch.nan), ArgumentError, "finite"),
    ],
    ids=["uint8", "grey", "plane", "empty", "above", "below", "nan"],
)
def test_exception(given: Tensor, error: type, says: str) -> None:
    mask = torch.zeros(len(given), *given.shape[-2:], dtype=torch.int64)
    with pytest.raises(error, match=says):
        RandomWeather(SNOW, p=1.0)(given, mask=mask)


@pytest.mark.parametrize(
    ("given", "error", "says"),
    [
        ({"mask": masks()[..., 1:]}, ArgumentError, "mask must have shape"),
        ({"mask": masks(2)}, ArgumentError, "mask must have shape"),
        ({"mask": masks().repeat(1, 2, 1, 1)}, ArgumentError, "mask must have shape"),
        ({"mask": masks().numpy()}, ArgumentError, "torch tensor"),
        ({"mask": masks() + 0.5}, ArgumentError, "whole numbers"),
        ({"mask": masks() + 40}, DataError, "mask"),
        ({"mask": masks().bool()}, ArgumentError, "bool"),
        ({"mask": masks(), "depth": depths()[..., 1:]}, ArgumentError, "depth must have shape"),
        ({"mask": masks(), "depth": masks()}, ArgumentError, "depth must be floating point"),
        ({"mask": masks(), "depth": depths() * torch.nan}, ArgumentError, "complete the depth"),
        ({"mask": masks(), "cameras": [None]}, ArgumentError, "cameras must have one item"),
        ({"mask": masks(), "sample_keys": [1]}, ArgumentError, "sample_keys must have one item"),
        ({"mask": masks(), "sample_keys": [1.5] * 3}, ArgumentError, "sample_key"),
        ({"mask": masks(), "params": {}}, ArgumentError, "params must hold"),
    ],
    ids=str,
)
def test_what_comes_along_is_checked(given: dict[str, Any], error: type, says: str) -> None:
    with pytest.raises(error, match=says):
        RandomWeather(SNOW, p=1.0)(pictures(), **given)


def test_unknown_arguments_are_refused() -> None:
    with pytest.raises(TypeError, match="masks"):
        RandomWeather()(pictures(), masks=masks())


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"policy": {"types": {"hail": 1}}}, "hail"),
        ({"p": 1.5}, "p must be"),
        ({"seed": "one"}, "seed must be an integer"),
        ({"intensity": 3}, "no argument intensity"),
        ({"options": DEFAULT_OPTIONS}, "BATCH_OPTIONS"),
        ({"options": {"max_particles": 5}}, "BATCH_OPTIONS"),
        ({"options": replace(BATCH_OPTIONS, preset="weatheredit")}, "preset"),
        ({"ignore_index": 2**40}, "ignore_index"),
    ],
    ids=str,
)
def test_bad_arguments_are_refused_at_once(arguments: dict[str, Any], says: str) -> None:
    with pytest.raises(ArgumentError, match=says):
        RandomWeather(**arguments)


def test_module() -> None:
    """In torch's own Sequential it does what it does alone."""
    alone = RandomWeather(SNOW, p=1.0, seed=5)
    among = nn.Sequential(RandomWeather(SNOW, p=1.0, seed=5), nn.Identity())
    alone.weathering = among[0].weathering = replace(alone.weathering, depth=DepthSource())
    params = alone.forward_parameters(pictures().shape)
    alone.look(pictures(), params, depth=depths())
    among[0].forward_parameters = lambda shape, keys=None: params  # type: ignore[method-assign]
    assert torch.equal(alone(pictures(), params=params), among(pictures()))


@pytest.mark.parametrize("policy", [SNOW, RAIN, FOG], ids=["snow", "rain", "fog"])
def test_gradcheck(policy: WeatherPolicy) -> None:
    weather = RandomWeather(policy, p=1.0)
    # Off the 8-bit levels, where the interpolated tone curve has its kinks.
    images = pictures(1, torch.float64)[..., 6:8, 8:11] + 0.3 / 255
    weather(images, depth=depths(1)[..., 6:8, 8:11])
    params = weather._params
    images.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: weather(x, params=params), images)


def test_gradients_reach_pictures_with_and_without_weather() -> None:
    weather = RandomWeather(SNOW, p=0.5)
    params = weather.forward_parameters(pictures().shape) | {
        "batch_prob": torch.tensor([1.0, 0.0, 1.0])
    }
    images = pictures().requires_grad_()
    weather(images, params=params, depth=depths()).sum().backward()
    assert images.grad is not None
    assert (images.grad[1] == 1).all()
    assert ((images.grad[0] != 1) & images.grad[0].isfinite()).any()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
@pytest.mark.parametrize("policy", [SNOW, FOG], ids=["snow", "fog"])
def test_dtype(policy: WeatherPolicy, dtype: torch.dtype) -> None:
    images = pictures(1, dtype)
    weather = RandomWeather(policy, p=1.0, seed=2)
    found, mask = weather(images, mask=masks(1))
    fine = RandomWeather(policy, p=1.0, seed=2)
    expected, expected_mask = fine(images.float(), mask=masks(1))
    assert found.dtype == dtype
    assert weather._params["depth"].dtype == torch.float32
    torch.testing.assert_close(found.float(), expected.to(dtype).float(), atol=1e-5, rtol=1e-5)
    assert torch.equal(mask, expected_mask)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_rounding_beyond_white_is_no_fault(dtype: torch.dtype) -> None:
    images = pictures(1, dtype)
    images[..., 0] = 1 + torch.finfo(dtype).eps
    assert RandomWeather(SNOW, p=1.0)(images, depth=depths(1)).max() <= 1


def test_same_on_batch() -> None:
    same, _ = RandomWeather(SNOW, p=1.0, same_on_batch=True)(pictures(), mask=masks())
    assert torch.equal(same[0], same[1])
    assert torch.equal(same[0], same[2])
    own, _ = RandomWeather(SNOW, p=1.0)(pictures(), mask=masks())
    assert not torch.equal(own[0], own[1])


def test_same_on_batch_holds_for_the_gate() -> None:
    weather = RandomWeather(SNOW, p=0.5, same_on_batch=True)
    gates = [weather.forward_parameters((4, 3, 8, 8))["batch_prob"] for _ in range(40)]
    assert all(len({*gate.tolist()}) == 1 for gate in gates)
    assert {float(gate[0]) for gate in gates} == {0.0, 1.0}


def test_probability() -> None:
    def share(p: float) -> float:
        return float(RandomWeather(p=p).forward_parameters((400, 3, 8, 8))["batch_prob"].mean())

    assert (share(0.0), share(1.0)) == (0.0, 1.0)
    assert 0.36 < share(0.5) < 0.64  # 5.6 standard deviations


def test_pictures_that_get_no_weather_are_untouched() -> None:
    weather = RandomWeather(SNOW, p=0.5)
    images = pictures()
    images[1] = torch.nan  # and cannot make the call fail
    params = weather.forward_parameters(images.shape)
    params["batch_prob"] = torch.tensor([1.0, 0.0, 1.0])
    found, mask = weather(images, params=params, mask=masks())
    assert found[1].isnan().all()
    assert not found[0].isnan().any()
    assert torch.equal(mask[1], masks()[1])
    assert not params["hidden"][1].any()
    assert (params["transmittance"][1] == 1).all()


def test_clear_days_are_untouched(flat_ground: list[Any]) -> None:
    found, mask = RandomWeather({"types": {"clear": 1}}, p=1.0)(pictures(), mask=masks())
    assert torch.equal(found, pictures())
    assert torch.equal(mask, masks())
    assert flat_ground == [], "nobody looks for depth that is not needed"


def test_inputs_are_not_changed() -> None:
    given = (pictures(), masks(), depths())
    found, mask = RandomWeather(FOG, p=1.0)(given[0], mask=given[1], depth=given[2])
    for tensor, expected in zip(given, (pictures(), masks(), depths()), strict=True):
        assert torch.equal(tensor, expected)
    clear, kept = RandomWeather(FOG, p=0.0)(given[0], mask=given[1])
    assert len({t.data_ptr() for t in (*given, found, mask, clear, kept)}) == 7


@pytest.mark.parametrize("p", [0.5, 1.0])
def test_params_repeat_a_call(p: float) -> None:
    weather = RandomWeather(MIXED, p=p, seed=4)
    given: dict[str, Any] = {"mask": masks(6), "cameras": [None, camera()] * 3}
    found, mask = weather(pictures(6), **given)
    params = weather._params
    assert (found != pictures(6)).any()
    for again in (weather, RandomWeather(FOG, p=p)):  # what is drawn is in the parameters
        assert torch.equal(again(pictures(6), params=params), found)
        repeated = again(pictures(6), params=params, mask=masks(6))
        assert torch.equal(repeated[0], found)
        assert torch.equal(repeated[1], mask)
    stored = io.BytesIO()
    torch.save(params, stored)
    stored.seek(0)
    assert torch.equal(weather(pictures(6), params=torch.load(stored)), found)
    del params["camera"]
    assert not torch.equal(weather(pictures(6), params=params), found)


def test_cameras_of_other_pictures_are_refused() -> None:
    wide = replace(camera(), width=2 * WIDTH)
    with pytest.raises(ArgumentError, match="cameras must be of the pictures' size"):
        RandomWeather(SNOW, p=1.0)(pictures(2), cameras=[None, wide])


def test_params_of_other_pictures_are_refused() -> None:
    weather = RandomWeather(SNOW, p=1.0)
    weather(pictures(), depth=depths())
    with pytest.raises(ArgumentError, match="params are of pictures of size"):
        weather(pictures()[..., 1:], params=weather._params)
    with pytest.raises(ArgumentError, match="drawn for 2 pictures"):
        weather(pictures(2), params=weather._params)
    with pytest.raises(ArgumentError, match="give one"):
        weather(pictures(), params=weather._params, sample_keys=[1, 2, 3])


@settings(max_examples=40)
@given(st.integers(0, 2**40), st.floats(0, 100))
def test_draws_survive_as_tensors(key: int, speed: float) -> None:
    draw = WeatherPolicy({"rain+fog": 1, "snow": 1, "fog": 1}).draw(key, 0, 0)
    for seed in (draw.seed, 2**53 - 1, 0):
        drawn = Drawn(draw.weather, seed, speed)
        rows = drawn_rows([Drawn(Weather.clear(), 1, 0.0), drawn])
        assert drawn_of(rows, 1) == drawn
        assert drawn_of(rows, 0) == Drawn(Weather.clear(), 1, 0.0)


def test_cameras_survive_as_tensors() -> None:
    expected = replace(camera(), angular_velocity_rad_per_s=np.array([0.1, 0.2, 0.3]))
    rows = {"camera": camera_rows([None, expected])}
    found = camera_of(rows, 1, (HEIGHT, WIDTH))
    assert camera_of(rows, 0, (HEIGHT, WIDTH)) is camera_of({}, 0, (HEIGHT, WIDTH)) is None
    assert all(
        np.array_equal(value, getattr(found, name)) for name, value in vars(expected).items()
    )


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int16, torch.int32, torch.int64])
@pytest.mark.parametrize("layout", ["B1HW", "BHW"])
def test_masks_say_what_can_be_seen(dtype: torch.dtype, layout: str) -> None:
    given = masks(dtype=dtype) if layout == "B1HW" else masks(dtype=dtype)[:, 0]
    _, found = RandomWeather(FOG, p=1.0)(pictures(), mask=given, depth=depths())
    hidden = found != given
    assert (found.dtype, found.shape) == (dtype, given.shape)
    assert hidden.any()
    assert (found[hidden] == IGNORE).all()
    assert (depths().reshape(given.shape)[hidden] > 10).all()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_masks_may_be_floats(dtype: torch.dtype) -> None:
    expected = RandomWeather(FOG, p=1.0)(pictures(), mask=masks())[1]
    found = RandomWeather(FOG, p=1.0)(pictures(), mask=masks(dtype=dtype))[1]
    assert found.dtype == dtype
    assert torch.equal(found.long(), expected)


def test_ids_are_the_callers() -> None:
    how: dict[str, Any] = {"p": 1.0, "seed": 1}
    expected = RandomWeather(FOG, **how)(pictures(), mask=masks())[1]
    found = RandomWeather(FOG, ignore_index=-100, **how)(pictures(), mask=masks())[1]
    assert torch.equal(found == -100, expected == IGNORE)
    with pytest.raises(ArgumentError, match="cannot hold ignore_index -100"):
        RandomWeather(FOG, ignore_index=-100)(pictures(), mask=masks(dtype=torch.uint8))


def test_ids_without_a_train_class_are_hidden_too() -> None:
    """The caller may train on more ids than have a train class."""
    nameless = dict.fromkeys(range(256))
    known: dict[str, Any] = {"mask": masks(), "depth": depths()}
    found = RandomWeather(FOG, p=1.0, taxonomy=nameless)(pictures(), **known)[1]
    hidden = found != masks()
    assert hidden.any()
    assert (found[hidden] == IGNORE).all()
    assert (depths()[hidden] > 10).all()


def test_labels_are_kept_where_the_options_say_so() -> None:
    options = replace(BATCH_OPTIONS, labels="keep")
    for how in ({"taxonomy": None}, {}):
        weather = RandomWeather(FOG, p=1.0, options=options, **how)
        assert torch.equal(weather(pictures(), mask=masks(), depth=depths())[1], masks())


def test_masks_without_classes_are_marked(flat_ground: list[Any]) -> None:
    things = 1000 + torch.arange(HEIGHT * WIDTH).reshape(1, 1, HEIGHT, WIDTH)
    found = RandomWeather(FOG, p=1.0, taxonomy=None)(pictures(1), mask=things)[1]
    assert (found == IGNORE).any()
    assert ((found == IGNORE) | (found == things)).all()
    assert flat_ground == [None]


def test_depth_comes_from_the_call_then_the_mask_then_the_picture(flat_ground: list[Any]) -> None:
    weather = RandomWeather(FOG, p=1.0, seed=1)
    weather(pictures(1), mask=masks(1), depth=depths(1))
    assert flat_ground == []
    expected = depths(1).masked_fill(depths(1).isnan(), torch.inf)
    assert torch.equal(weather._params["depth"], expected)
    weather(pictures(1), mask=masks(1))
    weather(pictures(1))
    assert np.array_equal(flat_ground[0], masks(1)[0, 0].numpy())
    assert flat_ground[1:] == [None]
    assert (weather._params["depth"] == 60).all()


def test_depth_matters() -> None:
    params = RandomWeather(FOG, p=1.0).forward_parameters((1, 3, HEIGHT, WIDTH))
    near, far = (
        RandomWeather(FOG, p=1.0)(
            pictures(1), params=dict(params), depth=torch.full((1, 1, HEIGHT, WIDTH), metres)
        )
        for metres in (1.0, 200.0)
    )
    assert (near - pictures(1)).abs().mean() < 0.5 * (far - pictures(1)).abs().mean()


def test_cameras_matter() -> None:
    same = RandomWeather(SNOW, p=1.0, same_on_batch=True)
    found = same(pictures(), depth=depths(), cameras=[None, camera(), None])
    assert torch.equal(found[0], found[2])
    assert not torch.equal(found[0], found[1])


def agreement(policy: WeatherPolicy, depth: Tensor | None = None) -> tuple[float, float]:
    """Least PSNR, and share of equal ids, of a batch and of the same draws rendered alone."""
    weather = RandomWeather(policy, p=1.0, seed=6)
    found, mask = weather(pictures(2), mask=masks(2), depth=depth)
    alone = Weathering.of(policy, options=BATCH_OPTIONS)
    image = (pictures(1)[0].permute(1, 2, 0) * 255).round().to(torch.uint8).numpy()
    scores, shares = [], []
    for row in range(2):
        expected = alone.render(
            image,
            drawn_of(weather._params, row),
            mask=masks()[0, 0].numpy(),
            depth=None if depth is None else depth[0, 0].numpy(),
        )
        assert expected.mask is not None
        scores.append(psnr(found[row].permute(1, 2, 0).numpy(), expected.image / 255))
        shares.append(float((mask[row, 0].numpy() == expected.mask).mean()))
    return min(scores), min(shares)


@pytest.mark.parametrize("policy", [SNOW, RAIN, FOG], ids=["snow", "rain", "fog"])
@pytest.mark.parametrize("depth", [None, depths(2)], ids=["prior", "depth"])
def test_agreement_with_numpy(policy: WeatherPolicy, depth: Tensor | None) -> None:
    """The same draws look as they do in the transforms of single pictures."""
    score, share = agreement(policy, depth)
    assert score > 45
    assert share > 0.99


def another_light(frame: Any) -> Any:
    light = LIGHT_OF(frame)
    return replace(light, sky=0.5 * light.sky, airlight=0.5 * light.airlight)


def blind(*args: Any, labels: Any, **how: Any) -> Any:
    return RENDER_BATCH(*args, labels=None, **how)


LIGHT_OF, RENDER_BATCH = kornia_weather.light_of, kornia_weather.render_batch


@pytest.mark.parametrize(
    ("name", "fault", "policy"),
    [
        ("light_of", another_light, FOG),
        ("light_of", another_light, RAIN),
        ("render_batch", blind, RAIN),
    ],
    ids=["light in fog", "light in rain", "labels"],
)
def test_the_agreement_would_notice(
    name: str, fault: Any, policy: WeatherPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kornia_weather, name, fault)
    score, share = agreement(policy)
    assert score < 45 or share < 0.99


def test_seeds_matter() -> None:
    """So few flakes are seen in so small a picture that PSNR hardly tells their seeds apart."""
    weather = RandomWeather(SNOW, p=1.0, same_on_batch=True)
    params = weather.forward_parameters(pictures().shape)
    params["seed"] = torch.tensor([1, 2, 1])
    found = weather(pictures(), params=params, depth=depths())
    assert torch.equal(found[0], found[2])
    assert not torch.equal(found[0], found[1])


def test_copies_draw_the_same() -> None:
    weather = RandomWeather(MIXED, p=0.7, seed=9)
    weather.set_epoch(3)
    copies = [
        copy.deepcopy(weather),
        pickle.loads(pickle.dumps(weather)),
        weather.to(torch.float64),
    ]
    draws = [each.forward_parameters((4, 3, 8, 8)) for each in (*copies[:2], weather)]
    for other in draws[:2]:
        assert other.keys() == draws[2].keys()
        assert all(torch.equal(value, draws[2][name]) for name, value in other.items())
    assert weather.state_dict() == {}
    assert weather.load_state_dict({}) is not None
    assert repr(weather) == repr(copies[0])
    assert list(weather.parameters()) == []


def test_without_kornia_the_error_names_the_extra() -> None:
    code = (
        "import sys; sys.modules['kornia'] = None\n"
        "from weather_aug.errors import MissingExtraError\n"
        "try:\n    import weather_aug.transforms.kornia\n"
        "except MissingExtraError as error:\n    print(error)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert "pip install 'weather-aug[kornia]'" in run.stdout, run.stderr


def test_an_old_kornia_is_refused() -> None:
    """With 0.8.3 masks would not be marked."""
    with pytest.raises(MissingExtraError, match=r"0\.8\.3 is installed"):
        kornia_weather.check_version("0.8.3")
    for version in ("0.9.0", "0.10.1rc1", "1.0.0"):
        kornia_weather.check_version(version)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
@pytest.mark.parametrize("policy", [SNOW, FOG], ids=["snow", "fog"])
def test_cuda(policy: WeatherPolicy) -> None:
    weather = RandomWeather(policy, p=1.0, seed=2).to("cuda")
    found, mask = weather(pictures().cuda(), mask=masks().cuda())
    assert (found.device.type, mask.device.type) == ("cuda", "cuda")
    same = RandomWeather(policy, p=1.0, seed=2)
    expected, expected_mask = same(pictures(), mask=masks())
    for row in range(3):
        assert psnr(found[row].cpu().numpy(), expected[row].numpy()) > 45
    assert (mask.cpu() == expected_mask).float().mean() > 0.99
    # Parameters of one device are taken on another.
    assert torch.equal(same(pictures(), params=same._params), expected)
    again = weather(pictures().cuda(), params=dict(same._params))
    assert psnr(again.cpu().numpy(), expected.numpy()) > 45
