"""Pictures of 3D Gaussians again, slowly: float64, every Gaussian at every pixel, no tiles.

Shares no code with the package. Gradients are torch's own, of the formulas as they stand. What a
float32 renderer may decide otherwise (skip or draw, stop or go on, who is in front) is marked.
"""

from typing import NamedTuple

import numpy as np
import torch
from numpy.polynomial.legendre import leg2poly

DILATION_PX2 = 0.3
CLAMP_MARGIN = 0.3
LEAST_COMPENSATION = 0.005
MOST_ALPHA = 0.99
LEAST_ALPHA = 1 / 255
LEAST_TRANSMITTANCE = 1e-4
NEAR_M = 0.1

DOUBT = 2e-5
"""Of alpha and transmittance, relative: nearer than this to a threshold, float32 may decide
otherwise."""
DEPTH_DOUBT = 1e-6


class Picture(NamedTuple):
    colours: torch.Tensor
    opacity: torch.Tensor
    depth_m: torch.Tensor
    centres_px: torch.Tensor
    doubtful: torch.Tensor
    """(H, W): float32 may rightly draw another picture, or have another gradient, here."""
    drawn: torch.Tensor
    """(N,): makes up some pixel."""


class Splats(NamedTuple):
    """What a Gaussian is on the picture; V of N, those before the camera, near to far."""

    order: torch.Tensor
    z: torch.Tensor
    centre: torch.Tensor
    covariance: torch.Tensor
    opacity: torch.Tensor
    doubtful: torch.Tensor


def picture(
    means_m,
    quaternions,
    scales_m,
    opacities,
    colours,
    camera_from_world,
    pinhole,
    background=None,
    antialiased=True,
    near_m=NEAR_M,
    shift_px=None,
):
    """The picture of float64 tensors, as the rasteriser promises it.

    `shift_px` (N, 2) moves the centres on the picture and nothing else: its gradient is theirs.
    """
    splats = projected(
        means_m, quaternions, scales_m, opacities, camera_from_world, pinhole, antialiased, near_m
    )
    if shift_px is not None:
        splats = splats._replace(centre=splats.centre + shift_px[splats.order])
    height, width = pinhole.height, pinhole.width
    alpha, doubtful = alphas(splats, height, width)
    after = torch.cumprod(1 - alpha, dim=0)
    reached = torch.cat([torch.ones_like(after[:1]), after])[:-1]
    # What does not pass light on any more is not drawn, and nothing behind it: it only falls.
    drawn = after > LEAST_TRANSMITTANCE
    doubtful = doubtful | ((alpha > 0) & ((after / LEAST_TRANSMITTANCE - 1).abs() < 10 * DOUBT))
    weight = torch.where(drawn, alpha * reached, 0.0)
    left = torch.where(drawn, 1 - alpha, 1.0).prod(dim=0)
    opacity = weight.sum(dim=0)
    depth = (weight * splats.z[:, None, None]).sum(dim=0)
    depth = torch.where(opacity > 0, depth / torch.where(opacity > 0, opacity, 1.0), 0.0)
    mixed = torch.einsum("nhw,nc->hwc", weight, colours[splats.order])
    if background is not None:
        mixed = mixed + left[..., None] * background
    seen = torch.zeros(len(means_m), dtype=torch.bool)
    seen[splats.order] = (weight > 0).flatten(1).any(dim=1)
    centres = torch.zeros(len(means_m), 2, dtype=torch.float64)
    centres = centres.index_put((splats.order,), splats.centre)
    doubtful = doubtful.any(dim=0) | swapped(splats, alpha)
    return Picture(mixed, opacity, depth, centres, doubtful, seen)


def projected(
    means_m,
    quaternions,
    scales_m,
    opacities,
    camera_from_world,
    pinhole,
    antialiased=True,
    near_m=NEAR_M,
):
    """Elliptical weighted averaging: each Gaussian before the camera as an ellipse on the picture.

    Zwicker et al. 2001, with the clamp, dilation and compensation of gsplat (and mip-splatting).
    """
    rotation, shift = camera_from_world[:3, :3], camera_from_world[:3, 3]
    places = means_m @ rotation.T + shift
    order = torch.argsort(places[:, 2], stable=True)
    order = order[places[order, 2] >= near_m]
    x, y, z = places[order].unbind(-1)
    fx, fy, cx, cy, width, height = pinhole
    centre = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=-1)
    across, at_edge_x = clamped(x / z, fx, cx, width)
    down, at_edge_y = clamped(y / z, fy, cy, height)
    none = torch.zeros_like(z)
    jacobian = torch.stack(
        [
            torch.stack([fx / z, none, -fx * across / z], dim=-1),
            torch.stack([none, fy / z, -fy * down / z], dim=-1),
        ],
        dim=-2,
    )
    turned = jacobian @ rotation @ rotations(quaternions[order])
    sharp = turned @ torch.diag_embed(scales_m[order] ** 2) @ turned.transpose(-1, -2)
    soft = sharp + DILATION_PX2 * torch.eye(2, dtype=torch.float64)
    share = determinant(sharp) / determinant(soft)
    at_floor = torch.zeros_like(at_edge_x)
    opacity = opacities[order]
    if antialiased:
        opacity = opacity * compensation(share)
        at_floor = (share / LEAST_COMPENSATION**2 - 1).abs() < 1e-3
    return Splats(order, z, centre, soft, opacity, at_edge_x | at_edge_y | at_floor)


def clamped(slope, focal_px, principal_px, extent_px):
    """Slopes of rays within what the picture holds and a margin; near which it bends."""
    # The picture's edges are half a pixel beyond the centres of its first and last pixels.
    margin = CLAMP_MARGIN * 0.5 * extent_px / focal_px
    low = -(principal_px + 0.5) / focal_px - margin
    high = (extent_px - 0.5 - principal_px) / focal_px + margin
    bends = ((slope - low).abs() < 1e-6 * abs(low)) | ((slope - high).abs() < 1e-6 * abs(high))
    return slope.clamp(low, high), bends


def rotations(quaternions):
    """(N, 3, 3) of (w, x, y, z) of any length."""
    w, x, y, z = normalised(quaternions).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def normalised(quaternions):
    return quaternions / quaternions.norm(dim=-1, keepdim=True)


def determinant(matrices):
    return matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] * matrices[:, 1, 0]


def alphas(splats, height, width):
    """(V, H, W) what each takes of the light at each pixel, and where float32 may disagree."""
    v, u = torch.meshgrid(
        torch.arange(height, dtype=torch.float64),
        torch.arange(width, dtype=torch.float64),
        indexing="ij",
    )
    offset = torch.stack([u, v], dim=-1) - splats.centre[:, None, None]
    power = torch.einsum("nhwi,nij,nhwj->nhw", offset, torch.linalg.inv(splats.covariance), offset)
    raw = splats.opacity[:, None, None] * torch.exp(-0.5 * power)
    alpha = capped(raw)
    doubtful = ((raw / LEAST_ALPHA - 1).abs() < DOUBT) | ((raw / MOST_ALPHA - 1).abs() < DOUBT)
    alpha = torch.where(alpha >= LEAST_ALPHA, alpha, 0.0)
    return alpha, doubtful | (splats.doubtful[:, None, None] & (alpha > 0))


def compensation(share):
    """What a splat's opacity is multiplied by: how much of its area is its own."""
    return share.clamp(min=LEAST_COMPENSATION**2).sqrt()


def capped(alpha):
    return alpha.clamp(max=MOST_ALPHA)


def swapped(splats, alpha):
    """(H, W) where two Gaussians meet whose depths float32 cannot tell apart."""
    found = torch.zeros(alpha.shape[1:], dtype=torch.bool)
    close = (splats.z.diff() < DEPTH_DOUBT * splats.z[1:]) & (splats.z.diff() > 0)
    for behind in (close.nonzero()[:, 0] + 1).tolist():
        found |= (alpha[behind - 1] > 0) & (alpha[behind] > 0)
    return found


def harmonics(direction, degree):
    """(N, (degree + 1)²) real spherical harmonics with the sign (-1)^m, of unit vectors (N, 3).

    From Legendre's polynomials: Y = K · P_l^(|m|)(z) · Re or Im of (x + iy)^|m|, with
    K² = (2l + 1) / 4π · (l - |m|)! / (l + |m|)!, twice that for m other than 0.
    """
    x, y, z = direction.unbind(-1)
    around = torch.complex(x, y)
    values = []
    for order in range(degree + 1):
        legendre = np.polynomial.Polynomial(leg2poly([0] * order + [1]))
        for m in range(-order, order + 1):
            along = sum(
                coefficient * z**power
                for power, coefficient in enumerate(
                    legendre.deriv(abs(m)).coef if m else legendre.coef
                )
            )
            turn = around ** abs(m) if m else torch.ones_like(around)
            factorials = np.prod([1.0 / k for k in range(order - abs(m) + 1, order + abs(m) + 1)])
            scale = np.sqrt((2 * order + 1) / (4 * np.pi) * factorials * (2 if m else 1))
            part = turn.imag if m < 0 else turn.real
            values.append((-1.0) ** m * scale * along * part)
    return torch.stack(values, dim=-1)


def colours_seen(sh, means_m, centre_m, degree):
    """sRGB (N, 3), at least 0: 0.5 and the first (degree + 1)² coefficients."""
    way = means_m - centre_m
    basis = harmonics(way / way.norm(dim=-1, keepdim=True), degree)
    return (0.5 + torch.einsum("nk,nkc->nc", basis, sh[:, : basis.shape[1]])).clamp(min=0)
