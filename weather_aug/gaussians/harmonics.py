"""Colours of Gaussians that change with the direction they are seen from."""

from __future__ import annotations

from torch import Tensor


def colours_seen(
    sh: Tensor, means_m: Tensor, centre_m: Tensor, degree: int | None = None
) -> Tensor:
    """sRGB (N, 3), at least 0, of Gaussians seen from `centre_m`.

    Args:
        sh: (N, K, 3) coefficients.
        means_m: (N, 3) float32.
        centre_m: (3,) of the camera, in the same axes.
        degree: Highest degree to use; all of `sh` if None.

    Sources:
        3DGS (Kerbl et al. 2023): real spherical harmonics, colour = max(0, 0.5 + Σ c·Y).
    """
    raise NotImplementedError
