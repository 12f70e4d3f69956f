"""How each recorded picture was exposed: an affine map of the scene's colours, learnt per picture.

Convention:
    sRGB as recorded = matrix (3, 4) @ (sRGB of the scene, 1). The scene's own colours and all the
    matrices together could be traded for each other, so the mean of the matrices is held at the
    identity, exactly: each is the identity plus its own deltas less the mean of all deltas.
    What was not learnt (a held-out picture) is shown as the nearest in time of its camera was
    exposed; a new viewpoint as the scene is, without any.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from weather_aug.clip.types import FrameKey
from weather_aug.errors import ArgumentError, printable
from weather_aug.gaussians import exposure_kernels

Float32 = NDArray[np.float32]

LEARNING_RATE = 1e-3
"""For Adam. A picture that is visited 50 times can change by 5 %, and those of one drive seldom
differ by more. (OmniRe learns the weights of a network that makes the matrices, at 1e-5.)"""
PENALTY_WEIGHT = 0.1
"""Of `Exposures.penalty` in the loss: 10 % brighter or darker cost as much as an L1 of 2.5e-4."""


class Exposures(nn.Module):
    """Affine colours of the training pictures; see the module's Convention.

    Raises:
        ArgumentError: If a key is given twice.
    """

    def __init__(self, keys: Iterable[FrameKey]) -> None:
        super().__init__()
        self.keys = tuple(FrameKey(*key) for key in keys)
        self._rows = {key: row for row, key in enumerate(self.keys)}
        if len(self._rows) != len(self.keys):
            raise ArgumentError(f"keys must differ, got {len(self.keys) - len(self._rows)} twice")
        self.deltas = nn.Parameter(torch.zeros(len(self.keys), 3, 4))

    def forward(self, key: FrameKey, image: Tensor) -> Tensor:
        """A picture (H, W, 3) of the scene as it was recorded at `key`.

        Raises:
            ArgumentError: If no picture of this key was learnt, or the image is not (H, W, 3).
        """
        if key not in self._rows:
            raise ArgumentError(
                f"key {printable(key)} has no exposure of its own; take that of `nearest`"
            )
        return exposed(image, self._matrix(self._rows[key]))

    def penalty(self) -> Tensor:
        """Mean square of what the matrices differ from the identity by."""
        return (self.deltas - self.deltas.mean(dim=0)).square().mean()

    def by_key(self) -> dict[FrameKey, Float32]:
        """(3, 4) by picture."""
        with torch.no_grad():
            return {key: self._matrix(row).cpu().numpy() for key, row in self._rows.items()}

    def _matrix(self, row: int) -> Tensor:
        own = self.deltas[row] - self.deltas.mean(dim=0)
        return own + torch.eye(3, 4, dtype=own.dtype, device=own.device)


def nearest(exposures: Mapping[FrameKey, Float32], key: FrameKey) -> Float32:
    """(3, 4) of the same camera's picture that is nearest in time, the earlier of two.

    The identity for a camera of which there is none.
    """
    own = [other for other in exposures if other.camera == key.camera]
    if not own:
        return np.eye(3, 4, dtype=np.float32)
    best = min(own, key=lambda k: (abs(k.time_index - key.time_index), k.time_index))
    return exposures[best]


def exposed(image: Tensor, matrix: Tensor) -> Tensor:
    """Colours (H, W, 3) after an affine map (3, 4), with gradients to both.

    float32 on a CPU goes through compiled loops, all else through torch.

    Raises:
        ArgumentError: If the shapes are others.
    """
    if image.ndim != 3 or image.shape[2] != 3 or tuple(matrix.shape) != (3, 4):
        raise ArgumentError(
            f"image must be (H, W, 3) and matrix (3, 4), got {tuple(image.shape)} and "
            f"{tuple(matrix.shape)}"
        )
    if all(t.device.type == "cpu" and t.dtype == torch.float32 for t in (image, matrix)):
        out: Tensor = _Exposed.apply(image, matrix)
        return out
    return image @ matrix[:, :3].T + matrix[:, 3]


class _Exposed(torch.autograd.Function):
    """The compiled way."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, matrix: Tensor) -> Tensor:
        ctx.given = tuple(given.detach().contiguous().numpy() for given in (image, matrix))
        out = np.empty_like(ctx.given[0])
        exposure_kernels.expose(*ctx.given, out)
        return torch.from_numpy(out)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor]:
        image, matrix = ctx.given
        d_image, d_matrix = np.empty_like(image), np.zeros((3, 4))
        exposure_kernels.expose_back(image, matrix, grad.contiguous().numpy(), d_image, d_matrix)
        return torch.from_numpy(d_image), torch.from_numpy(d_matrix).float()
