"""What the rasteriser's tests would not overlook, and what their reference itself stands on."""

import math
from dataclasses import replace

import pytest
import torch
from oracles import reference_gaussians as reference
from oracles.gaussian_checks import PLANES, check_gradients, check_picture, expected
from oracles.random_gaussians import LEAVES, case


@pytest.fixture(autouse=True)
def one_thread():
    """Torch's own threads cost more than they bring on pictures of this size."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def _unlike(**values):
    def plant(patch):
        for name, value in values.items():
            patch.setattr(reference, name, value)

    return plant


def _unnormalised(patch):
    patch.setattr(reference, "normalised", lambda quaternions: quaternions)


def _pixel_corners(patch):
    right = reference.projected

    def wrong(*args):
        splats = right(*args)
        return splats._replace(centre=splats.centre - 0.5)

    patch.setattr(reference, "projected", wrong)


def _far_to_near(patch):
    right = reference.projected

    def wrong(*args):
        splats = right(*args)
        return reference.Splats(*(values.flip(0) for values in splats))

    patch.setattr(reference, "projected", wrong)


def _drawn_before_stopping(patch):
    """The splat that takes the last light is drawn, as it is not in 3DGS."""
    right = torch.cumprod

    def wrong(values, dim):
        after = right(values, dim)
        ones = torch.ones_like(after[:1])
        before = torch.cat([ones, after])[:-1]
        live = before > reference.LEAST_TRANSMITTANCE
        return torch.where(live, after.clamp(min=1.001 * reference.LEAST_TRANSMITTANCE), after)

    patch.setattr(torch, "cumprod", wrong)


FAULTS = {
    "dilation of mip-splatting": ("mixed", True, _unlike(DILATION_PX2=0.1)),
    "clamp at the picture's edge": ("off-axis", True, _unlike(CLAMP_MARGIN=0.0)),
    "clamp far outside": ("off-axis", True, _unlike(CLAMP_MARGIN=10.0)),
    "compensation without a floor": ("specks", True, _unlike(LEAST_COMPENSATION=0.0)),
    "no compensation": ("mixed", True, _unlike(LEAST_COMPENSATION=1.0)),
    "cap of gsplat 1.5": ("capped", True, _unlike(MOST_ALPHA=0.999)),
    "nothing is cut": ("mixed", False, _unlike(LEAST_ALPHA=1e-4)),
    "stop ten times as early": ("opaque", False, _unlike(LEAST_TRANSMITTANCE=1e-3)),
    "the last one is drawn": ("opaque", False, _drawn_before_stopping),
    "quaternions as they are": ("mixed", True, _unnormalised),
    "pixel centres at one half": ("mixed", True, _pixel_corners),
    "far to near": ("mixed", True, _far_to_near),
}


@pytest.mark.parametrize("check", [check_picture, check_gradients])
@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_found(name, check, monkeypatch):
    """Each of what others do, in the place of what we do, makes picture and gradients differ."""
    kind, antialiased, plant = FAULTS[name]
    made = case(kind, 0, antialiased=antialiased)
    plant(monkeypatch)
    with pytest.raises(AssertionError, match="off by"):
        check(made)


def _through(name):
    """The value as it is, the gradient as if the function of that name were not there."""

    def plant(patch):
        right = getattr(reference, name)

        def wrong(value, *args):
            made = right(value, *args)
            if isinstance(made, tuple):
                return value + (made[0] - value).detach(), made[1]
            return value + (made - value).detach()

        patch.setattr(reference, name, wrong)

    return plant


def _held(name):
    """The value as it is, without a gradient."""

    def plant(patch):
        right = getattr(reference, name)
        patch.setattr(reference, name, lambda value: right(value).detach())

    return plant


def _length_held(patch):
    patch.setattr(
        reference, "normalised", lambda values: values / values.norm(dim=-1, keepdim=True).detach()
    )


def _depth_held(patch):
    right = reference.projected

    def wrong(*args):
        splats = right(*args)
        return splats._replace(z=splats.z.detach())

    patch.setattr(reference, "projected", wrong)


GRADIENT_FAULTS = {
    "through the Jacobian's clamp": ("off-axis", _through("clamped")),
    "through the cap": ("capped", _through("capped")),
    "compensation held": ("mixed", _held("compensation")),
    "length of a quaternion held": ("mixed", _length_held),
    "depth held": ("mixed", _depth_held),
}


@pytest.mark.parametrize("name", GRADIENT_FAULTS)
def test_faults_of_the_gradients_alone_are_found(name, monkeypatch):
    kind, plant = GRADIENT_FAULTS[name]
    plant(monkeypatch)
    check_picture(case(kind, 0))
    with pytest.raises(AssertionError, match=r"gradient of .* is off by"):
        check_gradients(case(kind, 0))


def test_the_reference_is_a_plain_walk_along_each_ray():
    """Its sums over all Gaussians at once against the loop that they stand for."""
    made = case("opaque", 1, width=9, height=6).in_type(torch.float64, False)
    wanted = expected(made)
    leaves = [getattr(made, name) for name in LEAVES if name != "colours"]
    splats = reference.projected(*leaves, made.pinhole, made.antialiased)
    stopped = 0
    for y in range(6):
        for x in range(9):
            light, colour = 1.0, torch.zeros(3, dtype=torch.float64)
            for n, index in enumerate(splats.order):
                offset = torch.tensor([x, y]) - splats.centre[n]
                power = offset @ torch.linalg.solve(splats.covariance[n], offset)
                alpha = min(0.99, float(splats.opacity[n]) * math.exp(-0.5 * power))
                if alpha < 1 / 255:
                    continue
                if light * (1 - alpha) <= 1e-4:
                    stopped += 1
                    break
                colour += light * alpha * made.colours[index]
                light *= 1 - alpha
            colour += light * made.background
            assert torch.allclose(wanted.colours[y, x], colour, rtol=0, atol=1e-12)
            assert wanted.opacity[y, x] == pytest.approx(1 - light, abs=1e-12)
    assert stopped > 10


def test_the_references_gradients_are_differences():
    made = case("mixed", 3, count=5, width=6, height=5).in_type(torch.float64)

    def planes(*leaves):
        changed = replace(made, **dict(zip(made.tensors, leaves, strict=True)))
        return [getattr(expected(changed), name) for name in PLANES]

    assert torch.autograd.gradcheck(planes, tuple(made.tensors.values()), fast_mode=True)
