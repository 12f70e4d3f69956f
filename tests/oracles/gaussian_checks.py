"""Our rasteriser beside its reference: equal pictures, equal gradients, or an AssertionError."""

import torch
from oracles import reference_gaussians as reference
from oracles.random_gaussians import LEAVES

from weather_aug.gaussians.rasterise import rasterise

FORWARD, GRADIENT = 1e-4, 1e-4
PLANES = ("colours", "opacity", "depth_m")
MOST_DOUBTFUL = 0.05
"""Of the pixels: where a threshold is so near that float32 may decide otherwise."""


def ours(case, **options):
    leaves = [getattr(case, name) for name in LEAVES]
    fixed = {"background": case.background, "antialiased": case.antialiased}
    return rasterise(*leaves, case.pinhole, **fixed | options)


def expected(case, **options):
    leaves = [getattr(case, name) for name in LEAVES]
    return reference.picture(*leaves, case.pinhole, case.background, case.antialiased, **options)


def weights(picture, seed=1):
    """Of a loss over all planes, 0 where the reference is in doubt."""
    draw = torch.Generator().manual_seed(seed)
    sure = ~picture.doubtful
    planes = [getattr(picture, name) for name in PLANES]
    shapes = [(plane.shape, sure[(...,) + (None,) * (plane.ndim - 2)]) for plane in planes]
    return [
        torch.randn(shape, generator=draw, dtype=torch.float64) * mask for shape, mask in shapes
    ]


def loss(picture, weights):
    return sum(
        (getattr(picture, name) * weight.to(picture.opacity.dtype)).sum()
        for name, weight in zip(PLANES, weights, strict=True)
    )


def check_picture(case):
    """Our picture is the reference's."""
    wanted, found = expected(case.in_type(torch.float64, False)), ours(case)
    sure = ~wanted.doubtful
    assert wanted.doubtful.sum() <= 3 + MOST_DOUBTFUL * sure.numel()
    for name in PLANES:
        plane = getattr(found, name)
        assert plane.dtype == torch.float32
        assert plane.shape == getattr(wanted, name).shape
        off = (getattr(wanted, name) - plane).abs()[sure]
        assert off.numel() == 0 or off.max() <= FORWARD, f"{name} is off by {off.max():.2g}"
    return wanted, found


def check_gradients(case, most=GRADIENT):
    """Our gradients of every input are the reference's, by the norm of their difference."""
    exact, single = case.in_type(torch.float64), case.in_type(torch.float32)
    shift = torch.zeros(len(case.means_m), 2, dtype=torch.float64, requires_grad=True)
    wanted, found = expected(exact, shift_px=shift), ours(single)
    chosen = weights(wanted)
    loss(wanted, chosen).backward()
    loss(found, chosen).backward()
    pairs = {name: (leaf.grad, getattr(single, name).grad) for name, leaf in exact.tensors.items()}
    pairs["centres_px"] = (shift.grad, found.centres_px.grad)
    for name, (right, got) in pairs.items():
        assert got.dtype == torch.float32
        off, norm = (right - got).norm().item(), right.norm().item()
        assert off <= most * norm, f"gradient of {name} is off by {off:.2g} of {norm:.2g}"
    return pairs
