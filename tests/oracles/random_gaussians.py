"""Gaussians for the rasteriser's tests: drawn from a seed, float32, of every difficult kind."""

from dataclasses import dataclass, fields, replace

import torch

from weather_aug.gaussians.types import Pinhole

LEAVES = ("means_m", "quaternions", "scales_m", "opacities", "colours", "camera_from_world")


@dataclass(frozen=True)
class Case:
    """What `rasterise` takes."""

    means_m: torch.Tensor
    quaternions: torch.Tensor
    scales_m: torch.Tensor
    opacities: torch.Tensor
    colours: torch.Tensor
    camera_from_world: torch.Tensor
    pinhole: Pinhole
    background: torch.Tensor | None = None
    antialiased: bool = True

    @property
    def tensors(self):
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if torch.is_tensor(value)}

    def in_type(self, dtype, requires_grad=True):
        """The same values as fresh leaves."""
        leaves = {
            name: value.detach().to(dtype, copy=True).requires_grad_(requires_grad)
            for name, value in self.tensors.items()
        }
        return replace(self, **leaves)


def case(
    kind="mixed",
    seed=0,
    *,
    count=None,
    channels=3,
    width=53,
    height=37,
    background=True,
    antialiased=True,
):
    """Gaussians of one `kind` of KINDS or RARE before a turned and shifted camera."""
    count = RARE_COUNTS.get(kind, 60) if count is None else count
    draw = torch.Generator().manual_seed(seed)

    def uniform(low, high, *shape):
        return low + (high - low) * torch.rand(*shape, generator=draw, dtype=torch.float64)

    pinhole = Pinhole(0.9 * width, 1.0 * width, 0.45 * width, 0.55 * height - 0.3, width, height)
    low_z, high_z, low_px, high_px, low_opacity, spread = (KINDS | RARE)[kind]
    z = uniform(low_z, high_z, count)
    # Places on and around the picture, `spread` times its size.
    u = (uniform(-0.5, 0.5, count) * spread + 0.5) * width
    v = (uniform(-0.5, 0.5, count) * spread + 0.5) * height
    slopes = torch.stack([(u - pinhole.cx_px) / pinhole.fx_px, (v - pinhole.cy_px) / pinhole.fy_px])
    places = torch.stack([slopes[0] * z, slopes[1] * z, z], dim=-1)
    sizes_px = low_px * (high_px / low_px) ** uniform(0, 1, count, 3)
    scales = sizes_px * z.abs().clamp(min=0.1)[:, None] / pinhole.fx_px
    camera_from_world = pose(uniform(-1, 1, 4), uniform(-3, 3, 3))
    rotation, shift = camera_from_world[:3, :3], camera_from_world[:3, 3]
    lengths = 10 ** uniform(-2, 2, count, 1)
    quaternions = torch.randn(count, 4, generator=draw, dtype=torch.float64) * lengths
    made = Case(
        (places - shift) @ rotation,
        quaternions,
        scales,
        uniform(low_opacity, 1, count),
        uniform(0, 1, count, channels),
        camera_from_world,
        pinhole,
        uniform(0, 1, channels) if background else None,
        antialiased,
    )
    return made.in_type(torch.float32, requires_grad=False)


def pose(quaternion, shift_m):
    """(4, 4) rigid motion."""
    w, vector = quaternion[0], quaternion[1:]
    norm2 = quaternion @ quaternion
    cross = torch.zeros(3, 3, dtype=torch.float64)
    cross[0, 1], cross[0, 2], cross[1, 2] = -vector[2], vector[1], -vector[0]
    cross = cross - cross.T
    rotation = torch.eye(3, dtype=torch.float64) + 2 / norm2 * (w * cross + cross @ cross)
    made = torch.eye(4, dtype=torch.float64)
    made[:3, :3], made[:3, 3] = rotation, shift_m
    return made


KINDS = {
    # Nearest and farthest z, m; least and largest size, px; least opacity; places / picture.
    "mixed": (2.0, 15.0, 0.5, 8.0, 0.05, 1.2),
    "off-axis": (1.0, 10.0, 2.0, 20.0, 0.05, 4.0),
    "behind": (-3.0, 3.0, 0.5, 8.0, 0.05, 1.5),
    "near": (0.05, 0.3, 1.0, 30.0, 0.05, 2.0),
    "huge": (2.0, 15.0, 20.0, 200.0, 0.02, 1.5),
    "tiny": (2.0, 15.0, 0.02, 0.5, 0.5, 1.0),
    "opaque": (2.0, 15.0, 2.0, 20.0, 0.9, 1.0),
    "needles": (2.0, 15.0, 0.05, 50.0, 0.2, 1.2),
}
RARE = {
    # Smaller than any pixel sees, and so opaque that they are seen all the same.
    "specks": (2.0, 15.0, 0.001, 0.02, 0.96, 1.0),
    # At the cap. Few, because two of them leave exactly as much light as stops a ray.
    "capped": (2.0, 15.0, 30.0, 90.0, 0.999, 1.2),
}
RARE_COUNTS = {"capped": 3}
