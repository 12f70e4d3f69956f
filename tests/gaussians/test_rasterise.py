"""The rasteriser against its float64 reference: pictures, all gradients, and what it refuses."""

import importlib.util
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.gaussian_checks import (
    GRADIENT,
    PLANES,
    check_gradients,
    check_picture,
    expected,
    loss,
    ours,
    weights,
)
from oracles.random_gaussians import KINDS, LEAVES, RARE, case

from weather_aug.errors import ArgumentError
from weather_aug.gaussians.rasterise import NEAR_M
from weather_aug.gaussians.types import Pinhole


@pytest.fixture(autouse=True)
def one_thread():
    """Torch's own threads cost more than they bring on pictures of this size."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.mark.parametrize("antialiased", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_pictures_are_the_references(kind, antialiased):
    wanted, _ = check_picture(case(kind, 0, antialiased=antialiased))
    assert wanted.drawn.sum() >= 10


@pytest.mark.parametrize("antialiased", [True, False])
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("kind", KINDS)
def test_gradients_of_all_inputs_are_the_references(kind, seed, antialiased):
    pairs = check_gradients(case(kind, seed, antialiased=antialiased))
    assert all(right.abs().max() > 0 for right, _ in pairs.values())


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_of_each_gaussian_are_the_references(kind):
    """The norm over all is that of the few largest; here each counts by its own."""
    pairs = check_gradients(case(kind, 2))
    for name in ("means_m", "quaternions", "scales_m", "opacities", "colours"):
        right, got = (gradient.reshape(60, -1) for gradient in pairs[name])
        off, norm = (right - got).norm(dim=1), right.norm(dim=1)
        # What hides behind 0.999 of opacity has the rounding of what is before it, too.
        shown = norm > 1e-2 * norm.max()
        relative = off[shown] / norm[shown]
        assert relative.median() <= GRADIENT, name
        assert relative.max() <= 20 * GRADIENT, name


@pytest.mark.parametrize("kind", RARE)
def test_rare_ones_are_the_references(kind):
    """At the floor of the compensation and at the cap of alpha, where gradients end."""
    made = case(kind, 0)
    check_picture(made)
    # Most specks are alone in their pixel, where depth does not change with its weight: what
    # float32 leaves of w z / w² - z / w is noise.
    check_gradients(made, {"specks": 5 * GRADIENT}.get(kind, GRADIENT))


@pytest.mark.parametrize("channels", [1, 3, 19])
def test_any_number_of_channels(channels):
    check_picture(case(channels=channels))
    check_gradients(case(channels=channels))


@pytest.mark.parametrize("size", [(1, 1), (8, 8), (7, 9), (64, 5), (33, 16)])
def test_any_size(size):
    width, height = size
    made = case("off-axis", width=width, height=height)
    check_picture(made)
    check_gradients(made)


@settings(max_examples=25)
@given(
    st.sampled_from(list(KINDS)),
    st.integers(0, 2**31),
    st.integers(1, 80),
    st.sampled_from([1, 2, 3, 5]),
    st.integers(1, 40),
    st.integers(1, 40),
    st.booleans(),
)
def test_any_scene(kind, seed, count, channels, width, height, antialiased):
    made = case(
        kind,
        seed,
        count=count,
        channels=channels,
        width=width,
        height=height,
        antialiased=antialiased,
    )
    check_picture(made)


def test_no_gaussians_is_the_background():
    made = case(count=0).in_type(torch.float32)
    found = ours(made)
    assert torch.equal(made.background.expand(37, 53, 3), found.colours)
    assert not found.opacity.any()
    assert not found.depth_m.any()
    loss(found, weights(expected(case(count=0).in_type(torch.float64)))).backward()
    assert {name: leaf.shape for name, leaf in made.tensors.items()} == {
        name: leaf.grad.shape for name, leaf in made.tensors.items()
    }


def test_one_gaussian_by_hand():
    """A ball in the middle: what stands in the papers, put together without the reference."""
    found = ours(_ball(opacity=0.8))
    # 0.2 m at 4 m, 40 px focal length: 2 px; a dilation by 0.3 px² both ways.
    variance = 2.0**2 + 0.3
    peak = 0.8 * 2.0**2 / variance
    at = peak * math.exp(-(3**2 + 1**2) / (2 * variance))
    assert found.opacity[10, 15] == pytest.approx(peak, rel=1e-5)
    assert found.opacity[11, 18] == pytest.approx(at, rel=1e-5)
    assert found.colours[11, 18].tolist() == pytest.approx([0.2 * at, 0.5 * at], rel=1e-5)
    assert found.depth_m[11, 18] == pytest.approx(4.0, rel=1e-5)
    assert found.centres_px[0].tolist() == [15.0, 10.0]
    # Where it falls below 1/255 it is cut.
    reach = math.sqrt(2 * math.log(255 * peak) * variance)
    assert found.radii_px[0] == pytest.approx(reach, rel=1e-5)
    assert found.opacity[10, 15 + math.floor(reach)] >= 1 / 255
    assert found.opacity[10, 15 + math.ceil(reach)] == 0
    assert found.depth_m[10, 15 + math.ceil(reach)] == 0


def _ball(opacity=0.8, z=4.0, scale=0.2):
    return replace(
        case(count=1, background=False),
        means_m=torch.tensor([[0.0, 0.0, z]]),
        scales_m=torch.full((1, 3), scale),
        opacities=torch.tensor([opacity]),
        colours=torch.tensor([[0.2, 0.5]]),
        camera_from_world=torch.eye(4),
        pinhole=Pinhole(40.0, 40.0, 15.0, 10.0, 31, 21),
    )


def test_alpha_is_capped():
    assert ours(_ball(opacity=1.0, scale=5.0)).opacity.max() == pytest.approx(0.99, abs=1e-6)


@pytest.mark.parametrize(("z", "is_drawn"), [(NEAR_M, True), (0.0999, False), (-4.0, False)])
def test_what_is_nearer_than_the_near_plane_is_not_drawn(z, is_drawn):
    # The float32 just above 0.1, so that its float64 is not below.
    z = float(np.nextafter(np.float32(z), np.float32(1))) if is_drawn else z
    found = ours(_ball(z=z))
    assert is_drawn == (found.opacity.max() > 0)
    assert is_drawn == (found.radii_px[0] > 0)


def test_equal_depths_are_drawn_by_their_index():
    pair = _ball(opacity=0.9)
    doubled = {
        name: torch.cat([getattr(pair, name)] * 2)
        for name in LEAVES
        if name not in ("colours", "camera_from_world")
    }
    shown = ours(replace(pair, **doubled, colours=torch.eye(2))).colours[10, 15]
    assert shown[0] > 2 * shown[1]


@pytest.mark.parametrize("length", [1e-3, 1.0, 1e3])
def test_a_quaternions_length_does_not_matter(length):
    base = case("needles", 3)
    unit = base.quaternions / base.quaternions.norm(dim=1, keepdim=True)
    made = replace(base, quaternions=unit * length)
    check_picture(made)
    right, got = check_gradients(made)["quaternions"]
    along = (got.double() * unit.double()).sum(dim=1).abs()
    assert (along <= 1e-5 * right.norm(dim=1).max()).all()


def test_needles_longer_than_the_picture_stay():
    """One metre of wire before the lens: its conic is nearly singular in float32."""
    turn = 0.9
    wire = replace(
        _ball(),
        scales_m=torch.tensor([[15.0, 1e-3, 1e-3]]),
        means_m=torch.tensor([[0.02, 0.01, 1.0]]),
        quaternions=torch.tensor([[math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2)]]),
        pinhole=Pinhole(400.0, 400.0, 150.0, 50.0, 301, 101),
    )
    wanted, found = expected(wire.in_type(torch.float64, False)), ours(wire)
    assert (wanted.opacity > 0.01).sum() > 100
    # Float32 loses digits of the exponent here, not the wire.
    assert (wanted.opacity - found.opacity).abs().max() < 0.02


def test_radii_reach_all_that_is_drawn():
    for kind in KINDS:
        made = case(kind, 4)
        wanted, found = expected(made.in_type(torch.float64, False)), ours(made)
        assert not found.radii_px.requires_grad
        assert (found.radii_px[wanted.drawn] > 0).all()
        shown = found.radii_px > 0
        off = (wanted.centres_px - found.centres_px)[shown].abs()
        scale = wanted.centres_px[shown].abs().clamp(min=1)
        assert (off <= 1e-6 * scale).all()


def test_centres_carry_gradients_of_their_own():
    made, exact = case(seed=5).in_type(torch.float32), case(seed=5).in_type(torch.float64)
    found, wanted = ours(made), expected(exact)
    shown = found.radii_px > 0
    (found.centres_px[shown] ** 2).sum().backward()
    (wanted.centres_px[shown] ** 2).sum().backward()
    for name in ("means_m", "camera_from_world"):
        right = getattr(exact, name).grad
        assert (right - getattr(made, name).grad).norm() <= GRADIENT * right.norm()


def test_backgrounds():
    made = case(seed=6)
    plain = ours(made, background=None)
    black = ours(made, background=torch.zeros(3))
    assert torch.equal(plain.colours, black.colours)
    picture = torch.rand(37, 53, 3, generator=torch.Generator().manual_seed(0))
    check_picture(replace(made, background=picture))
    check_gradients(replace(made, background=picture))


@pytest.mark.parametrize("kind", ["mixed", "opaque", "near"])
def test_two_threads_give_the_same_bytes(kind):
    made = case(kind, 7, count=300, channels=5, width=150, height=70)
    results = []
    for threads in (1, 2, 3):
        leaves = made.in_type(torch.float32)
        found = ours(leaves, threads=threads)
        draw = torch.Generator().manual_seed(0)
        sum(
            (getattr(found, name) * torch.randn(getattr(found, name).shape, generator=draw)).sum()
            for name in PLANES
        ).backward()
        gradients = [leaf.grad for leaf in leaves.tensors.values()]
        results.append([*found, found.centres_px.grad, *gradients])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_inputs_are_left_alone_in_any_layout():
    made = case(seed=8)
    kept = {name: leaf.clone() for name, leaf in made.tensors.items()}
    first = ours(made)
    assert all(torch.equal(kept[name], leaf) for name, leaf in made.tensors.items())
    turned = {
        name: getattr(made, name).T.contiguous().T
        for name in ("means_m", "quaternions", "scales_m", "colours", "camera_from_world")
    }
    again = ours(replace(made, **turned))
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))


def test_some_gradients_alone_are_the_same():
    """Freezing the shapes, as a weather's colours are fitted, changes no other gradient."""
    made = case(seed=9)
    everything = made.in_type(torch.float32)
    chosen = weights(expected(made.in_type(torch.float64, False)))
    loss(ours(everything), chosen).backward()
    for name in made.tensors:
        leaf = getattr(made, name).clone().requires_grad_()
        loss(ours(replace(made, **{name: leaf})), chosen).backward()
        right = getattr(everything, name).grad
        assert (right - leaf.grad).norm() <= 1e-6 * right.norm(), name


BAD = {
    "means_m": (torch.zeros(60, 2), torch.zeros(60, 3, dtype=torch.float64), torch.tensor(1.0)),
    "quaternions": (torch.ones(60, 3), torch.ones(59, 4), torch.ones(60, 4).half()),
    "scales_m": (torch.ones(60), torch.ones(60, 1), torch.ones(60, 3).double()),
    "opacities": (torch.ones(60, 1), torch.ones(61), torch.ones(60).double()),
    "colours": (
        torch.ones(60),
        torch.tensor(1.0),
        torch.ones(60, 0),
        torch.ones(59, 3),
        torch.ones(60, 3).double(),
    ),
    "camera_from_world": (torch.eye(3), torch.eye(4)[None], torch.eye(4).double()),
    "background": (
        torch.ones(1),
        torch.ones(4),
        torch.ones(37, 53, 1),
        torch.ones(53, 37, 3),
        torch.ones(3).double(),
    ),
}


@pytest.mark.parametrize(
    ("name", "value"), [(name, value) for name, values in BAD.items() for value in values]
)
def test_wrong_tensors_are_refused_by_name(name, value):
    with pytest.raises(ArgumentError, match=name):
        ours(replace(case(), **{name: value}))


@pytest.mark.parametrize(
    "options",
    [{"near_m": 0.0}, {"near_m": -1.0}, {"near_m": math.nan}, {"threads": 0}, {"backend": "gpu"}],
)
def test_wrong_options_are_refused_by_name(options):
    (name,) = options
    with pytest.raises(ArgumentError, match=name):
        ours(case(), **options)


def test_an_empty_picture_is_refused():
    made = case()
    with pytest.raises(ArgumentError, match="pinhole"):
        ours(replace(made, pinhole=made.pinhole._replace(width=0)))


@pytest.fixture
def cuda():
    if not torch.cuda.is_available() or importlib.util.find_spec("gsplat") is None:
        pytest.skip("needs CUDA and gsplat: pip install 'weather-aug[gsplat]'")
    return "cuda"


def test_gsplat_draws_the_same_on_cuda(cuda):
    made = case("mixed", 0, count=500, width=319, height=183)
    # gsplat 1.5 caps alpha at 0.999, later versions and we at 0.99.
    made = replace(made, opacities=made.opacities.clamp(max=0.95))
    here = made.in_type(torch.float32)
    there = replace(
        made, **{name: leaf.to(cuda).requires_grad_() for name, leaf in made.tensors.items()}
    )
    found, wanted = ours(here), ours(there)
    assert wanted.colours.is_cuda
    assert _psnr(1.0, wanted.colours.cpu(), found.colours) >= 45
    assert _psnr(1.0, wanted.opacity.cpu(), found.opacity) >= 45
    solid = found.opacity > 0.5
    assert _psnr(15.0, wanted.depth_m.cpu()[solid], found.depth_m[solid]) >= 45
    drawn = (found.radii_px > 0) & (wanted.radii_px.cpu() > 0)
    assert (wanted.centres_px.cpu() - found.centres_px)[drawn].abs().max() <= 1e-2
    goal = torch.rand(found.colours.shape, generator=torch.Generator().manual_seed(0))
    ((found.colours - goal) ** 2).sum().backward()
    ((wanted.colours - goal.to(cuda)) ** 2).sum().backward()
    for name, leaf in here.tensors.items():
        right = getattr(there, name).grad.cpu()
        cosine = torch.nn.functional.cosine_similarity(right.flatten(), leaf.grad.flatten(), dim=0)
        assert cosine >= 0.99, name
    assert wanted.centres_px.grad.shape == found.centres_px.grad.shape


def _psnr(peak, a, b):
    return 20 * math.log10(peak) - 10 * math.log10(float(((a - b) ** 2).mean()) + 1e-20)
