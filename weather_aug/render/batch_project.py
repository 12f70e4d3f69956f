"""Particles in camera axes become Gaussians on the picture, in torch.

The algebra is done in float64, where the determinant of a long streak does not cancel; fragments
need no more than float32.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from weather_aug.clip.types import Camera
from weather_aug.particles.field import COVARIANCE, OPACITY, VELOCITY
from weather_aug.particles.resolve import shutter_turning_rad_per_s
from weather_aug.render.batch_medium import AirColumn
from weather_aug.render.project import (
    DEFOCUS_VARIANCE,
    FAINTEST,
    FOCUS_M,
    HIDING_ALPHA,
    LARGE_SHARE,
    LONG_SWEEP_PX,
    MOST_OPAQUE,
    MOST_PARTS,
    PART_SPREAD,
    PIXEL_FILTER_PX2,
    SWEEP_PER_PART,
    WHOLE_SPREAD,
    WIDE_STREAK_PX,
)


@dataclass(frozen=True, eq=False)
class Splats:
    """N Gaussians on a picture, structure of arrays on one device, float32.

    Convention:
        Pixel centres are at integer coordinates. A splat's opacity at (x, y) is
        peak exp(-(a dx^2 + 2 b dx dy + c dy^2) / 2), cut where it falls to 1/255.
    """

    u: Tensor
    """(N,) column of the centre, pixels."""
    v: Tensor
    """(N,) row of the centre."""
    conic: Tensor
    """(N, 3): a, b, c of the inverse covariance, 1/px^2."""
    half: Tensor
    """(N, 2) half width and half height of the footprint, pixels."""
    reach2: Tensor
    """(N,) squared Mahalanobis distance of the cut."""
    peak: Tensor
    """(N,) opacity at the centre, in (1/255, 0.99]."""
    z_m: Tensor
    """(N,) depth."""
    light: Tensor
    """(N, 3) linear colour as seen through the air in front of it."""
    large: Tensor
    """(N,) bool: its footprint can hide a surface."""

    def __len__(self) -> int:
        return self.u.shape[0]

    def take(self, index: Tensor) -> Splats:
        """The splats of an index (K,) or a mask (N,), in its order."""
        return Splats(*(getattr(self, f.name)[index] for f in fields(self)))

    def far_to_near(self) -> Splats:
        """The same splats by falling depth; equal depths keep their order."""
        return self.take(torch.argsort(self.z_m, descending=True, stable=True))


def concatenated(parts: Sequence[Splats]) -> Splats:
    """All splats of at least one part, in the order given."""
    return Splats(*(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(Splats)))


def project(
    particles: Tensor,
    camera: Camera,
    air: AirColumn,
    colour: Tensor,
    airlight: Tensor,
    *,
    compensate: bool = True,
) -> Splats:
    """Turn particles into screen-space Gaussians, keeping those that touch the picture.

    The projected covariance gains q q^T / 12 from a uniform sweep q, c^2 / 16 from defocus of
    diameter c and 0.3 px^2 from the pixel filter; the peak falls by the square root of the ratio of
    determinants, so that the opacity integrated over the picture is the silhouette's. A sweep of
    more than 12 px of a footprint wider than a pixel is drawn in parts of three widths each.

    Args:
        particles: (N, 13): position in metres, velocity relative to the camera's centre in m/s,
            covariance xx, xy, xz, yy, yz, zz in m^2, peak opacity; camera axes.
        camera: Camera of the whole picture.
        air: What is in front of the particles.
        colour: (3,) linear light of a particle.
        airlight: (3,) linear light.
        compensate: False leaves the peak as it is: wrong, and there for tests to see.

    Returns:
        Splats on the particles' device, in the particles' order.

    Source:
        Zwicker et al. (2001), EWA splatting; Yu et al. (2024), Mip-Splatting, for the compensation.
    """
    rows = particles.double()
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    x, y, z = rows[:, 0], rows[:, 1], rows[:, 2]
    tx, ty, sx, sy = x / z, y / z, fx / z, fy / z
    qx, qy = _sweep_px(rows, camera)
    a0, b0, c0 = _sharp_covariance(rows[:, COVARIANCE:OPACITY], tx, ty, sx, sy)
    defocus = camera.aperture_m * fx * (1.0 / z - 1.0 / FOCUS_M)
    soft = PIXEL_FILTER_PX2 + defocus * defocus * DEFOCUS_VARIANCE
    i, parts, place = _cut(_part_counts(torch.hypot(qx, qy), 0.5 * (a0 + c0) + soft))
    px, py = qx[i] / parts, qy[i] / parts
    spread = torch.where(parts == 1, WHOLE_SPREAD, PART_SPREAD)
    a = a0[i] + spread * px * px + soft[i]
    b = b0[i] + spread * px * py
    c = c0[i] + spread * py * py + soft[i]
    det = a * c - b * b
    det_sharp = (a0 * c0 - b0 * b0).clamp(min=0.0)[i]
    fainter = torch.sqrt(det_sharp / det) if compensate else torch.ones_like(det)
    peak = (rows[i, OPACITY] * fainter / parts + FAINTEST).clamp(max=MOST_OPAQUE)
    reach2 = 2.0 * torch.log(peak / FAINTEST)
    u, v = cx + fx * tx[i] + qx[i] * place, cy + fy * ty[i] + qy[i] * place
    half = torch.sqrt(reach2.clamp(min=0.0)[:, None] * torch.stack([a, c], dim=1))
    seen = (reach2 > 0.0) & _touches(u, v, half, camera)
    through = torch.exp(-air.optical_depth(z, tx, ty))[i, None]
    hiding2 = 2.0 * torch.log(peak / HIDING_ALPHA)
    hidden_px2 = torch.pi * hiding2 * torch.sqrt(det) * parts
    splats = Splats(
        u=u.float(),
        v=v.float(),
        conic=(torch.stack([c, -b, a], dim=1) / det[:, None]).float(),
        half=half.float(),
        reach2=reach2.float(),
        peak=peak.float(),
        z_m=z[i].float(),
        light=(airlight.double() + through * (colour - airlight).double()).float(),
        large=hidden_px2 > LARGE_SHARE * camera.width * camera.height,
    )
    return splats.take(seen)


def _sweep_px(rows: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Motion of each particle on the picture while the shutter is open, pixels."""
    turn_x, turn_y, turn_z = (float(w) for w in shutter_turning_rad_per_s(camera))
    x, y, z = rows[:, 0], rows[:, 1], rows[:, 2]
    vx, vy, vz = rows[:, VELOCITY:COVARIANCE].unbind(1)
    ux = vx - (turn_y * z - turn_z * y)
    uy = vy - (turn_z * x - turn_x * z)
    uz = vz - (turn_x * y - turn_y * x)
    fx, fy = camera.focal_px
    steps = camera.exposure_s / z
    return fx * steps * (ux - x / z * uz), fy * steps * (uy - y / z * uz)


def _sharp_covariance(
    covariance: Tensor, tx: Tensor, ty: Tensor, sx: Tensor, sy: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """uu, uv, vv of J Sigma J^T for (N, 6) covariances, px^2."""
    xx, xy, xz, yy, yz, zz = covariance.unbind(1)
    uu = xx - 2.0 * tx * xz + tx * tx * zz
    uv = xy - ty * xz - tx * yz + tx * ty * zz
    vv = yy - 2.0 * ty * yz + ty * ty * zz
    return sx * sx * uu, sx * sy * uv, sy * sy * vv


def _part_counts(sweep_px: Tensor, variance_px2: Tensor) -> Tensor:
    """How many Gaussians (N,) draw each streak, from its length and its mean variance without."""
    width = torch.sqrt(variance_px2)
    parts = torch.ceil(sweep_px / (SWEEP_PER_PART * width)).clamp(1, MOST_PARTS)
    long = (sweep_px > LONG_SWEEP_PX) & (width > WIDE_STREAK_PX)
    return torch.where(long, parts, torch.ones_like(parts)).long()


def _cut(counts: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Of each part: its particle, into how many that is cut, and its place from -1/2 to 1/2."""
    whole = torch.arange(len(counts), device=counts.device)
    particle = torch.repeat_interleave(whole, counts)
    parts, first = counts[particle], (torch.cumsum(counts, 0) - counts)[particle]
    place = torch.arange(len(particle), device=counts.device) - first
    return particle, parts, (place + 0.5) / parts - 0.5


def _touches(u: Tensor, v: Tensor, half: Tensor, camera: Camera) -> Tensor:
    across = (u + half[:, 0] >= 0.0) & (u - half[:, 0] <= camera.width - 1)
    return across & (v + half[:, 1] >= 0.0) & (v - half[:, 1] <= camera.height - 1)
