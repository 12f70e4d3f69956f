"""The peer: 3D Gaussian splatting in plain torch, float32, with torch's own gradients.

Lists of Gaussians for each tile, padded to the longest; the exponents of all pixels of a tile are
one matrix product, and so are their colours. As usually written, all tiles go side by side, padded
to the longest list of all; written with care, tiles with lists of about one length go together, a
cache's worth at a time, which is many times as fast.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from weather_aug.gaussians.types import Pinhole

TILE_PX = 8
GROUP_FRAGMENTS = 2**18
"""Pixels times Gaussians, padding included, that are blended at once: about a cache's worth."""
DILATION_PX2, CLAMP_MARGIN, NEAR_M = 0.3, 0.3, 0.1
LEAST_ALPHA, MOST_ALPHA, LEAST_TRANSMITTANCE = 1 / 255, 0.99, 1e-4


class Ellipses(NamedTuple):
    """V Gaussians before the camera, near to far, as they lie on the picture."""

    order: Tensor
    z: Tensor
    centre: Tensor
    variances: Tensor
    conic: Tensor
    opacity: Tensor


def draw(
    means_m: Tensor,
    quaternions: Tensor,
    scales_m: Tensor,
    opacities: Tensor,
    colours: Tensor,
    camera_from_world: Tensor,
    pinhole: Pinhole,
    group_fragments: int | None = GROUP_FRAGMENTS,
) -> tuple[Tensor, Tensor, Tensor]:
    """Colours (H, W, C) over black, opacity (H, W) and expected depth (H, W), antialiased.

    With `group_fragments` None all lists are padded to the longest of all, and blended at once.
    """
    ellipses = _ellipses(means_m, quaternions, scales_m, opacities, camera_from_world, pinhole)
    depth = ellipses.z[:, None]
    values = torch.cat([colours[ellipses.order], depth, torch.ones_like(depth)], dim=1)
    across, down = -(-pinhole.width // TILE_PX), -(-pinhole.height // TILE_PX)
    members, lengths = _lists(ellipses, across, down)
    starts = lengths.cumsum(0) - lengths
    parts, drawn = [], []
    for tiles in _groups(lengths, group_fragments):
        parts.append(
            _blended(ellipses, values, members, starts[tiles], lengths[tiles], tiles, across)
        )
        drawn.append(tiles)
    flat = values.new_zeros(across * down, TILE_PX**2, values.shape[1])
    if drawn:
        flat = flat.index_put((torch.cat(drawn),), torch.cat(parts))
    picture = flat.view(down, across, TILE_PX, TILE_PX, -1).transpose(1, 2)
    picture = picture.reshape(down * TILE_PX, across * TILE_PX, -1)
    picture = picture[: pinhole.height, : pinhole.width]
    opacity = picture[..., -1]
    return picture[..., :-2], opacity, picture[..., -2] / opacity.clamp(min=1e-10)


def _ellipses(
    means_m: Tensor,
    quaternions: Tensor,
    scales_m: Tensor,
    opacities: Tensor,
    camera_from_world: Tensor,
    pinhole: Pinhole,
) -> Ellipses:
    rotation = camera_from_world[:3, :3]
    places = means_m @ rotation.T + camera_from_world[:3, 3]
    order = places.detach()[:, 2].argsort(stable=True)
    order = order[places.detach()[order, 2] >= NEAR_M]
    xy, z = places[order, :2], places[order, 2]
    fx, fy, cx, cy, width, height = pinhole
    focal, principal = z.new_tensor([fx, fy]), z.new_tensor([cx, cy])
    extent = z.new_tensor([width, height])
    slope = xy / z[:, None]
    margin = CLAMP_MARGIN * 0.5 * extent
    low, high = (-principal - 0.5 - margin) / focal, (extent - 0.5 - principal + margin) / focal
    bent = slope.clamp(low, high)
    jacobian = torch.cat([torch.diag(focal).expand(len(z), 2, 2), -(focal * bent)[..., None]], 2)
    roots = jacobian / z[:, None, None] @ rotation @ _rotations(quaternions[order])
    roots = roots * scales_m[order, None]
    sharp = roots @ roots.transpose(1, 2)
    covariance = sharp + DILATION_PX2 * torch.eye(2)
    det = _determinants(covariance)
    share = _determinants(sharp) / det
    variances = covariance.diagonal(dim1=1, dim2=2)
    conic = (
        torch.stack([covariance[:, 1, 1], -covariance[:, 0, 1], covariance[:, 0, 0]], dim=1)
        / det[:, None]
    )
    opacity = opacities[order] * share.clamp(min=2.5e-5).sqrt()
    return Ellipses(order, z, slope * focal + principal, variances, conic, opacity)


def _rotations(quaternions: Tensor) -> Tensor:
    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=1).unbind(1)
    entries = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(entries, dim=1).view(-1, 3, 3)


def _determinants(matrices: Tensor) -> Tensor:
    return matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] ** 2


@torch.no_grad()
def _lists(ellipses: Ellipses, across: int, down: int) -> tuple[Tensor, Tensor]:
    """Gaussians of all tiles, row by row, each tile's near to far; how many each tile has."""
    reach2 = 2 * (ellipses.opacity / LEAST_ALPHA).log().clamp(min=0)
    half = (reach2[:, None] * ellipses.variances).sqrt()
    most = torch.tensor([across, down])
    first = ((ellipses.centre - half).ceil() / TILE_PX).floor().long().clamp(min=0).minimum(most)
    last = ((ellipses.centre + half).floor() / TILE_PX).floor().long() + 1
    size = (last.minimum(most) - first).clamp(min=0) * (reach2 > 0)[:, None]
    counts = size.prod(dim=1)
    owner = torch.arange(len(counts)).repeat_interleave(counts)
    place = torch.arange(len(owner)) - (counts.cumsum(0) - counts)[owner]
    wide = size[owner, 0]
    tile = (first[owner, 1] + place // wide) * across + first[owner, 0] + place % wide
    tile, by_tile = tile.sort(stable=True)
    return owner[by_tile], tile.bincount(minlength=across * down)


def _groups(lengths: Tensor, fragments: int | None) -> list[Tensor]:
    """Tiles that are not empty, longest first, cut into groups of about equal work."""
    order = lengths.argsort(descending=True)
    order = order[lengths[order] > 0]
    if fragments is None:
        return [order] if len(order) else []
    groups = []
    while len(order):
        count = max(fragments // (TILE_PX**2 * int(lengths[order[0]])), 1)
        groups.append(order[:count])
        order = order[count:]
    return groups


def _blended(
    ellipses: Ellipses,
    values: Tensor,
    members: Tensor,
    starts: Tensor,
    lengths: Tensor,
    tiles: Tensor,
    across: int,
) -> Tensor:
    """(G, TILE_PX², C) of G tiles."""
    place = torch.arange(int(lengths[0]))
    inside = place < lengths[:, None]
    member = members[(starts[:, None] + place).clamp(max=len(members) - 1)]
    middle = torch.stack([tiles % across, tiles // across], dim=1) * TILE_PX + TILE_PX // 2
    x, y = (ellipses.centre[member] - middle[:, None]).unbind(-1)
    a, b, c = ellipses.conic[member].unbind(-1)
    linear = a * x + b * y, b * x + c * y
    # The exponent is a polynomial of the pixel's place in its tile.
    terms = [a / 2, b, c / 2, -linear[0], -linear[1], (linear[0] * x + linear[1] * y) / 2]
    step = torch.arange(TILE_PX**2)
    u, v = (step % TILE_PX - TILE_PX // 2).float(), (step // TILE_PX - TILE_PX // 2).float()
    basis = torch.stack([u * u, u * v, v * v, u, v, torch.ones_like(u)])
    power = torch.stack(terms, dim=-1) @ basis
    opacity = torch.where(inside, ellipses.opacity[member], 0.0)[..., None]
    alpha = (opacity * torch.exp(-power)).clamp(max=MOST_ALPHA)
    alpha = torch.where(alpha >= LEAST_ALPHA, alpha, 0.0)
    after = (1 - alpha).cumprod(dim=1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], dim=1)
    weight = torch.where(after > LEAST_TRANSMITTANCE, alpha * before, 0.0)
    return weight.transpose(1, 2) @ values[member]
