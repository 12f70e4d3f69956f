"""Colours of spherical harmonics against Legendre's polynomials in float64."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import reference_gaussians as reference

from weather_aug.errors import ArgumentError
from weather_aug.gaussians.harmonics import colours_seen

DEGREES = (0, 1, 2, 3)


def drawn(degree=3, seed=0, count=40):
    """Coefficients, places and a camera centre; some colours fall below the floor."""
    draw = torch.Generator().manual_seed(seed)
    sh = torch.randn(count, (degree + 1) ** 2, 3, generator=draw)
    means = 5 * torch.randn(count, 3, generator=draw)
    return sh, means, torch.randn(3, generator=draw)


def check(sh, means_m, centre_m, degree=None):
    """Colours and all gradients are the reference's."""
    highest = int(sh.shape[1] ** 0.5) - 1 if degree is None else degree
    exact = [leaf.double().requires_grad_() for leaf in (sh, means_m, centre_m)]
    single = [leaf.clone().requires_grad_() for leaf in (sh, means_m, centre_m)]
    wanted = reference.colours_seen(*exact, highest)
    found = colours_seen(*single, degree)
    assert found.dtype == torch.float32
    assert found.shape == wanted.shape
    sure = wanted.detach() > 1e-4
    off = (wanted - found).detach().abs()
    assert off.numel() == 0 or off.max() <= 1e-5, f"colours are off by {off.max():.2g}"
    weight = torch.randn(wanted.shape, generator=torch.Generator().manual_seed(1)) * sure
    (wanted * weight).sum().backward()
    (found * weight).sum().backward()
    for right, got in zip(exact, single, strict=True):
        distance, norm = (right.grad - got.grad).norm().item(), right.grad.norm().item()
        assert distance <= 1e-5 * norm, f"a gradient is off by {distance:.2g} of {norm:.2g}"
    return found


@pytest.mark.parametrize("degree", DEGREES)
def test_colours_and_gradients_are_the_references(degree):
    found = check(*drawn(degree))
    assert (found == 0).any()
    assert (found > 1).any()


@pytest.mark.parametrize("degree", DEGREES)
def test_a_lower_degree_leaves_the_rest_out(degree):
    sh, means, centre = drawn()
    check(sh, means, centre, degree)
    cut = colours_seen(sh[:, : (degree + 1) ** 2].contiguous(), means, centre)
    assert torch.equal(cut, colours_seen(sh, means, centre, degree))


@settings(max_examples=25)
@given(st.sampled_from(DEGREES), st.integers(0, 2**31), st.integers(0, 30))
def test_any_coefficients(degree, seed, count):
    check(*drawn(degree, seed, count))


def test_signs_are_those_of_3dgs():
    """What a file of another program holds must look the same here: -y, z, -x."""
    axes = torch.tensor([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    for coefficient, (axis, sign) in enumerate([(0, -1), (1, 1), (2, -1)], start=1):
        sh = torch.zeros(1, 4, 3)
        sh[0, coefficient] = 1.0
        seen = colours_seen(sh, 3 * axes[[axis]], torch.zeros(3))
        expected = max(0.5 + sign * 0.4886025, 0.0)
        np.testing.assert_allclose([[expected] * 3], seen, atol=1e-6)
    plain = colours_seen(torch.ones(1, 1, 3), axes[:1], torch.zeros(3))
    np.testing.assert_allclose([[0.5 + 0.28209479] * 3], plain, atol=1e-6)


def test_the_references_functions_are_orthonormal():
    """Over the sphere, by Gauss's points: what makes them harmonics, whatever their signs."""
    z, heights = np.polynomial.legendre.leggauss(8)
    turns = 2 * np.pi * np.arange(16) / 16
    z, turn = (values.ravel() for values in np.meshgrid(z, turns, indexing="ij"))
    rim = np.sqrt(1 - z**2)
    way = torch.from_numpy(np.stack([rim * np.cos(turn), rim * np.sin(turn), z], axis=1))
    basis = reference.harmonics(way, 3)
    area = torch.from_numpy(np.repeat(heights, 16) * 2 * np.pi / 16)
    product = torch.einsum("n,nj,nk->jk", area, basis, basis)
    assert (product - torch.eye(16, dtype=torch.float64)).abs().max() < 1e-12


def test_what_is_below_the_floor_is_black_and_still():
    sh = torch.full((2, 4, 3), -3.0, requires_grad=True)
    means = torch.tensor([[0.1, 0.0, 2.0], [0.0, 0.2, 3.0]], requires_grad=True)
    seen = colours_seen(sh, means, torch.zeros(3))
    seen.sum().backward()
    assert not seen.any()
    assert not sh.grad.any()
    assert not means.grad.any()


def test_inputs_are_left_alone_in_any_layout():
    sh, means, centre = drawn()
    kept = sh.clone(), means.clone(), centre.clone()
    seen = colours_seen(sh, means, centre)
    assert all(torch.equal(a, b) for a, b in zip(kept, (sh, means, centre), strict=True))
    turned = sh.permute(2, 1, 0).contiguous().permute(2, 1, 0)
    assert torch.equal(seen, colours_seen(turned, means.T.contiguous().T, centre))


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("sh", {"sh": torch.zeros(40, 5, 3)}),
        ("sh", {"sh": torch.zeros(40, 16, 4)}),
        ("sh", {"sh": torch.zeros(40, 16)}),
        ("sh", {"sh": torch.zeros(40, 16, 3, dtype=torch.float64)}),
        ("means_m", {"means_m": torch.zeros(39, 3)}),
        ("means_m", {"means_m": torch.zeros(40, 3, dtype=torch.float64)}),
        ("centre_m", {"centre_m": torch.zeros(4)}),
        ("degree", {"degree": 4}),
        ("degree", {"degree": -1}),
    ],
)
def test_wrong_arguments_are_refused_by_name(name, change):
    sh, means, centre = drawn()
    arguments = {"sh": sh, "means_m": means, "centre_m": centre} | change
    with pytest.raises(ArgumentError, match=name):
        colours_seen(**arguments)


def _without_signs(patch):
    right = reference.harmonics
    patch.setattr(
        reference,
        "harmonics",
        lambda way, degree: (
            right(way, degree) * torch.tensor([1.0, -1, 1, -1])[: (degree + 1) ** 2]
        ),
    )


def _from_the_other_side(patch):
    right = reference.harmonics
    patch.setattr(reference, "harmonics", lambda way, degree: right(-way, degree))


def _not_normalised(patch):
    patch.setattr(torch.Tensor, "norm", lambda self, **_: torch.ones(len(self), 1).double())


FAULTS = {
    "signs": _without_signs,
    "direction": _from_the_other_side,
    "length": _not_normalised,
}


@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_found(name, monkeypatch):
    FAULTS[name](monkeypatch)
    with pytest.raises(AssertionError, match="off by"):
        check(*drawn(1))
