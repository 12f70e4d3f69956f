"""Gaussians and what a reconstructed drive consists of, as plain arrays.

Convention:
    Colours are sRGB in 0..1, because pictures and every viewer of 3DGS files blend them so.
    Quaternions are (w, x, y, z) and are normalised where they are used. Scales are stored as their
    logarithms, opacities as logits, as 3DGS files have them. Spherical harmonics follow 3DGS:
    colour = 0.5 + Σ coefficient · basis, floored at 0, coefficient 0 first.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from weather_aug.clip.types import Camera, FrameKey
from weather_aug.errors import ArgumentError

Float32 = NDArray[np.float32]

SH_COEFFICIENTS = (1, 4, 9, 16)
"""Of degree 0 to 3."""
CLASSES = 19
"""Train ids that a Gaussian has a score for."""


class Pinhole(NamedTuple):
    """How a camera takes a picture, without its place: pixel centres at integer coordinates."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    width: int
    height: int

    @classmethod
    def of(cls, camera: Camera) -> Pinhole:
        """The lens of a `Camera`."""
        return cls(*camera.focal_px, *camera.principal_px, camera.width, camera.height)


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N anisotropic 3D Gaussians in one coordinate frame; see the module's Convention.

    Raises:
        ArgumentError: If the arrays disagree in their length, or have another shape.
    """

    means_m: Float32
    """(N, 3)."""
    quaternions: Float32
    """(N, 4)."""
    log_scales: Float32
    """(N, 3), logarithms of metres."""
    logit_opacities: Float32
    """(N,)."""
    sh: Float32
    """(N, K, 3) with K = 1, 4, 9 or 16."""
    class_scores: NDArray[Any]
    """(N, C) float16 or float32: how far each train id claims a Gaussian; C = 0 if unlabelled."""

    def __post_init__(self) -> None:
        count = len(self.means_m)
        shapes = {
            "means_m": (count, 3),
            "quaternions": (count, 4),
            "log_scales": (count, 3),
            "logit_opacities": (count,),
        }
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ArgumentError(
                    f"{name} must have shape {shape}, got {getattr(self, name).shape}"
                )
        if self.sh.ndim != 3 or len(self.sh) != count or self.sh.shape[2] != 3:
            raise ArgumentError(f"sh must have shape ({count}, K, 3), got {self.sh.shape}")
        if self.sh.shape[1] not in SH_COEFFICIENTS:
            raise ArgumentError(
                f"sh must hold {SH_COEFFICIENTS} coefficients, got {self.sh.shape[1]}"
            )
        if self.class_scores.ndim != 2 or len(self.class_scores) != count:
            raise ArgumentError(
                f"class_scores must have shape ({count}, C), got {self.class_scores.shape}"
            )

    def __len__(self) -> int:
        return len(self.means_m)


@dataclass(frozen=True, eq=False)
class Actor:
    """A tracked object that moves by itself."""

    track_id: int
    class_name: str
    is_deformable: bool
    """Walkers and riders: their Gaussians have offsets that change with the time."""
    size_m: tuple[float, float, float]
    times_s: NDArray[np.float64]
    """(T,), rising: the moments at which it was tracked."""
    world_from_actor: NDArray[np.float64]
    """(T, 4, 4), refined; the origin is the centre of its box (x ahead, y left, z up)."""


@dataclass(frozen=True, eq=False)
class Sky:
    """A cube map of what is behind all Gaussians, in world axes.

    Faces are +x, -x, +y, -y, +z, -z, in the layout of OpenGL's cube maps.
    """

    faces: Float32
    """(6, S, S, 3), sRGB in 0..1."""
    seen: NDArray[np.bool_]
    """(6, S, S): a recorded frame showed sky there."""


@dataclass(frozen=True, eq=False)
class Style:
    """The colours of a whole scene in one weather, over a geometry that all weathers share."""

    sh: NDArray[Any]
    """(N, K, 3) float16 of the background."""
    actor_sh: NDArray[Any]
    """(M, K, 3) float16 of the actors' Gaussians."""
    sky: NDArray[Any]
    """(6, T, T, 3) float16 with T = S, or a part of it: skies in weather have no fine detail."""


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A drive as Gaussians: what stands still, what moves, and the sky."""

    background: Gaussians
    """In world axes."""
    sky: Sky
    actors: tuple[Actor, ...]
    actor_gaussians: Gaussians
    """M Gaussians of all actors, each in the frame of its own."""
    owners: NDArray[np.int32]
    """(M,) index into `actors`."""
    offsets_m: Float32
    """(M, B, 3) coefficients of the offsets over time, in the actor's frame; zero if rigid."""
    cameras: Mapping[FrameKey, Camera]
    """The recorded cameras, refined."""
    exposures: Mapping[FrameKey, Float32]
    """(3, 4) by frame: sRGB as recorded = matrix @ (sRGB of the scene, 1)."""
    styles: Mapping[str, Style] = field(default_factory=dict)
    """By name of the weather."""
    support: Float32 = field(default_factory=lambda: np.zeros(0, np.float32))
    """(N,) how many pixels of the recorded frames each background Gaussian made up."""
