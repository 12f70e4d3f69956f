"""Poses of the recorded cameras, refined while the scene is learnt.

Convention:
    world_from_camera = recorded @ [turn, shift]: the turn is a rotation vector (radians), the shift
    in metres, both in the axes of the recorded camera and zero at first. Held-out pictures and new
    viewpoints keep their recorded poses, see `camera_from_world`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from weather_aug.clip.types import Camera, FrameKey
from weather_aug.errors import ArgumentError, printable
from weather_aug.gaussians.rotations import matrices_of, quaternions_of_vectors

Float64 = NDArray[np.float64]

LEARNING_RATE, WEIGHT_DECAY = 1e-5, 1e-6
"""For Adam (OmniRe)."""
_HERE = (0.0, 0.0, 0.0)


class CameraRefinement(nn.Module):
    """Small changes of the poses of cameras; see the module's Convention.

    Args:
        cameras: As recorded.
        origin_m: (3,) place in the world that `camera_from_world` takes for 0: means in float32
            then keep millimetres far from the world's origin.
    """

    def __init__(
        self, cameras: Mapping[FrameKey, Camera], origin_m: Sequence[float] = _HERE
    ) -> None:
        super().__init__()
        self.cameras = {FrameKey(*key): camera for key, camera in cameras.items()}
        self._rows = {key: row for row, key in enumerate(self.cameras)}
        recorded = [camera_from_world(camera, origin_m) for camera in self.cameras.values()]
        # No buffer, because `module.float()` would make it float32.
        self._recorded = torch.from_numpy(np.array(recorded).reshape(-1, 4, 4))
        self.turns_rad = nn.Parameter(torch.zeros(len(recorded), 3))
        self.shifts_m = nn.Parameter(torch.zeros(len(recorded), 3))

    def camera_from_world(self, key: FrameKey) -> Tensor:
        """(4, 4) float32, from the world around the origin, with a gradient to the refinement.

        Raises:
            ArgumentError: If the camera is none of the given.
        """
        row = self._row(key)
        # Of the inverse motion: x = turnᵀ (recorded x - shift).
        turn, shift = self._motion(row)
        recorded = self._recorded[row].to(turn.device)
        inverse = torch.cat([turn.T, -(turn.T @ shift)[:, None]], dim=1)
        return torch.cat([inverse @ recorded, recorded[3:]]).float()

    def refined(self, key: FrameKey, camera: Camera | None = None) -> Camera:
        """The camera of a key with its refined pose; as it was, bit for bit, if nothing was learnt.

        Args:
            key: One of the given.
            camera: Another camera at the recorded pose, for instance resized; the given if None.

        Raises:
            ArgumentError: If the camera is none of the given.
        """
        row = self._row(key)
        camera = self.cameras[key] if camera is None else camera
        with torch.no_grad():
            turn, shift = (part.cpu().numpy() for part in self._motion(row))
        pose = camera.world_from_camera.copy()
        pose[:3, 3] += pose[:3, :3] @ shift
        pose[:3, :3] = pose[:3, :3] @ turn
        return replace(camera, world_from_camera=pose)

    def _motion(self, row: int) -> tuple[Tensor, Tensor]:
        """Turn (3, 3) and shift (3,), float64."""
        turn = matrices_of(quaternions_of_vectors(self.turns_rad[row].double()))
        return turn, self.shifts_m[row].double()

    def _row(self, key: FrameKey) -> int:
        if key not in self._rows:
            raise ArgumentError(
                f"key {printable(key)} is none of the {len(self._rows)} refined cameras; use the "
                "recorded pose"
            )
        return self._rows[key]


def camera_from_world(camera: Camera, origin_m: Sequence[float] | NDArray[Any] = _HERE) -> Float64:
    """(4, 4) of a recorded camera, from the world around an origin (3,), in metres."""
    rotation = camera.world_from_camera[:3, :3].T
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = -rotation @ (camera.centre_world - np.asarray(origin_m, np.float64))
    return matrix
