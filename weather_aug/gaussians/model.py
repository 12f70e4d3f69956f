"""All that a fit learns of a drive, and how it draws a recorded frame from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from weather_aug.clip.types import Frame, FrameKey
from weather_aug.errors import ArgumentError, DataError
from weather_aug.gaussians import actors, exposure, refine, sky
from weather_aug.gaussians.actors import ActorPoses, actors_of, offset_bases, placed
from weather_aug.gaussians.exposure import Exposures, exposed, nearest
from weather_aug.gaussians.harmonics import colours_seen
from weather_aug.gaussians.initialise import OPACITY, actor_points, initial_gaussians
from weather_aug.gaussians.pool import Pool
from weather_aug.gaussians.rasterise import Drawn, rasterise
from weather_aug.gaussians.refine import CameraRefinement
from weather_aug.gaussians.sky import SkyMap
from weather_aug.gaussians.types import Gaussians, Pinhole, Reconstruction

MAX_COORDINATE_M = 1e4
"""Farther from the world's origin, float32 does not keep millimetres."""
OFFSET_RATE = 1e-3
"""Learning rate of the offsets of deformable actors, metres."""


class Seen(NamedTuple):
    """A recorded frame, drawn."""

    picture: Tensor
    """(H, W, 3) sRGB as the camera recorded it."""
    drawn: Drawn
    rows: Tensor
    """(M',) which of the actors' Gaussians follow those of the background in `drawn`."""


class Model:
    """Gaussians that stand still and that move, sky, exposures, poses; each with its optimiser.

    Args:
        frames: What to learn from.
        count: Gaussians of the background.
        sh_degree: Of the colours, 0..3.
        sky_size: Texels along a side of the sky's faces.
        seed: Of the thinning.
        opacity: Of each Gaussian at first.
        device: Where the tensors live.

    Raises:
        ArgumentError: If the frames lie too far from the world's origin, or have no depth.
    """

    def __init__(
        self,
        frames: Sequence[Frame],
        *,
        count: int,
        sh_degree: int,
        sky_size: int,
        seed: int,
        opacity: float = OPACITY,
        device: torch.device | str = "cpu",
    ) -> None:
        _check_places(frames)
        self.device = torch.device(device)
        movers = actors_of(frames)
        tracks = {actor.track_id for actor in movers}
        standing = initial_gaussians(
            frames,
            count=count,
            seed=seed,
            sh_degree=sh_degree,
            opacity=opacity,
            left_out=tracks,
        )
        self.background = Pool.of(standing, device=device)
        each = [
            actor_points(frames, actor.track_id, sh_degree=sh_degree, opacity=opacity)
            for actor in movers
        ]
        owners = np.repeat(np.arange(len(movers)), [len(points) for points in each])
        terms = actors.OFFSET_TERMS
        self.moving = Pool.of(
            _joined(each, standing.sh.shape[1]),
            {"offsets_m": OFFSET_RATE},
            more={"offsets_m": np.zeros((len(owners), terms, 3), np.float32)},
            device=device,
            owners=owners.astype(np.int64),
        )
        self.poses = ActorPoses(movers).to(device)
        self.sky = SkyMap.of(frames, sky_size).to(device)
        self.exposures = Exposures(frame.key for frame in frames).to(device)
        self.cameras = CameraRefinement({frame.key: frame.camera for frame in frames}).to(device)
        self._others = torch.optim.Adam(
            [
                {"params": [self.sky.faces], "lr": sky.LEARNING_RATE},
                {"params": [self.exposures.deltas], "lr": exposure.LEARNING_RATE},
                {
                    "params": list(self.cameras.parameters()),
                    "lr": refine.LEARNING_RATE,
                    "weight_decay": refine.WEIGHT_DECAY,
                },
                {"params": [self.poses.rotations_rad], "lr": actors.ROTATION_LEARNING_RATE},
                {"params": [self.poses.translations_m], "lr": actors.TRANSLATION_LEARNING_RATE},
            ],
            fused=True,
        )

    @property
    def pools(self) -> tuple[Pool, Pool]:
        """Of what stands still and of what moves."""
        return self.background, self.moving

    @property
    def has_actors(self) -> bool:
        """Whether anything moves."""
        return len(self.moving) > 0

    def see(self, frame: Frame, degree: int, threads: int = 1) -> Seen:
        """Draw a recorded frame, or one that was held out, with gradients.

        Args:
            frame: Its camera, key and time count.
            degree: Highest degree of the colours.
            threads: Of the CPU's kernels.
        """
        is_learnt = frame.key in self.cameras.cameras
        if is_learnt:
            camera_from_world = self.cameras.camera_from_world(frame.key)
        else:
            camera_from_world = torch.from_numpy(refine.camera_from_world(frame.camera)).float()
        camera_from_world = camera_from_world.to(self.device)
        centre = -camera_from_world[:3, :3].T @ camera_from_world[:3, 3]
        means, quaternions, scales, opacities, sh, rows = self._gathered(frame.time_s)
        pinhole = Pinhole.of(frame.camera)
        drawn = rasterise(
            means,
            quaternions,
            scales,
            opacities,
            colours_seen(sh, means, centre, degree),
            camera_from_world,
            pinhole,
            background=self.sky.background(pinhole, _world_from_camera(camera_from_world)),
            threads=threads,
        )
        if is_learnt:
            return Seen(self.exposures(frame.key, drawn.colours), drawn, rows)
        matrix = nearest(self.exposures.by_key(), frame.key)
        matrix_here = torch.from_numpy(matrix).to(self.device)
        return Seen(exposed(drawn.colours, matrix_here), drawn, rows)

    def _gathered(self, time_s: float) -> tuple[Tensor, ...]:
        """Means, quaternions, scales, opacities and colours at a moment; rows of the actors'."""
        still = self.background
        own = (
            still.parameters["means_m"],
            still.parameters["quaternions"],
            still.scales_m,
            still.opacities,
            still.sh,
        )
        if not self.has_actors:
            return (*own, torch.zeros(0, dtype=torch.int64, device=self.device))
        poses, present = self.poses.poses(time_s)
        owners = self.moving.constants["owners"]
        rows = torch.nonzero(present[owners])[:, 0]
        means, quaternions = placed(
            self.moving.parameters["means_m"][rows],
            self.moving.parameters["quaternions"][rows],
            owners[rows],
            self.moving.parameters["offsets_m"][rows],
            poses,
            torch.from_numpy(offset_bases(self.poses.actors, time_s)).to(self.device),
        )
        there = (
            means,
            quaternions,
            self.moving.scales_m[rows],
            self.moving.opacities[rows],
            self.moving.sh[rows],
        )
        return (*(torch.cat(pair) for pair in zip(own, there, strict=True)), rows)

    def penalty(self) -> Tensor:
        """What exposures, poses and offsets pay for leaving what was recorded."""
        total = exposure.PENALTY_WEIGHT * self.exposures.penalty()
        if self.has_actors:
            total = total + actors.SMOOTHNESS_WEIGHT * self.poses.smoothness()
            offsets = self.moving.parameters["offsets_m"]
            total = total + actors.OFFSETS_WEIGHT * actors.offsets_penalty(offsets)
        return total

    def step(self) -> None:
        """One step of all optimisers, then no gradients."""
        for pool in self.pools:
            pool.step()
            pool.zero_grad()
        self._others.step()
        self._others.zero_grad()
        with torch.no_grad():
            # As `to_sky` has it, so that what is stored shows what was learnt.
            self.sky.faces.clamp_(0.0, 1.0)

    def state(self) -> dict[str, Tensor]:
        """All that is needed to go on, by name; see `Pool.state`."""
        state = {f"background.{name}": value for name, value in self.background.state().items()}
        state |= {f"moving.{name}": value for name, value in self.moving.state().items()}
        for row, parameter in enumerate(self._learnt()):
            state[f"others.{row}"] = parameter.detach().cpu().clone()
            for name, value in self._others.state[parameter].items():
                state[f"others.{row}.{name}"] = value.detach().cpu().clone()
        return state

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Become the model of `state`.

        Raises:
            DataError: If `state` is not what `Model.state` gives for these frames and options.
        """
        for prefix, pool in zip(("background.", "moving."), self.pools, strict=True):
            own = {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}
            pool.restore(own)
        for row, parameter in enumerate(self._learnt()):
            kept = state.get(f"others.{row}")
            if kept is None or kept.shape != parameter.shape:
                raise DataError("the state of a fit is of other frames; start the fit anew")
            with torch.no_grad():
                parameter.copy_(kept)
            prefix = f"others.{row}."
            self._others.state[parameter] = {
                # Adam keeps its count of steps on the CPU.
                k.removeprefix(prefix): v.clone() if k.endswith("step") else v.to(self.device)
                for k, v in state.items()
                if k.startswith(prefix)
            }

    def _learnt(self) -> list[nn.Parameter]:
        return [value for group in self._others.param_groups for value in group["params"]]

    def reconstruction(self) -> Reconstruction:
        """The drive as it is learnt now, as plain arrays."""
        recorded = self.cameras.cameras
        offsets = self.moving.parameters["offsets_m"].detach().cpu().numpy().copy()
        return Reconstruction(
            background=self.background.gaussians(),
            sky=self.sky.to_sky(),
            actors=self.poses.refined(),
            actor_gaussians=self.moving.gaussians(),
            owners=self.moving.constants["owners"].cpu().numpy().astype(np.int32),
            offsets_m=offsets,
            cameras={FrameKey(*key): self.cameras.refined(key) for key in recorded},
            exposures=self.exposures.by_key(),
        )


def _world_from_camera(camera_from_world: Tensor) -> Tensor:
    """The inverse of a rigid motion, without its gradient."""
    rotation, shift = camera_from_world[:3, :3].detach(), camera_from_world[:3, 3:].detach()
    inverse = torch.eye(4, dtype=rotation.dtype, device=rotation.device)
    inverse[:3] = torch.cat([rotation.T, -rotation.T @ shift], dim=1)
    return inverse


def _check_places(frames: Sequence[Frame]) -> None:
    for frame in frames:
        largest = float(np.abs(frame.camera.centre_world).max())
        if largest > MAX_COORDINATE_M:
            raise ArgumentError(
                f"frame {frame.key} was taken {largest:.0f} m from the world's origin; shift the "
                f"poses so that the drive lies within {MAX_COORDINATE_M:.0f} m of it"
            )


def _joined(parts: Sequence[Gaussians], coefficients: int) -> Gaussians:
    """All Gaussians of `parts`, one after the other."""
    none = Gaussians(
        means_m=np.zeros((0, 3), np.float32),
        quaternions=np.zeros((0, 4), np.float32),
        log_scales=np.zeros((0, 3), np.float32),
        logit_opacities=np.zeros(0, np.float32),
        sh=np.zeros((0, coefficients, 3), np.float32),
        class_scores=np.zeros((0, 0), np.float16),
    )
    names = ("means_m", "quaternions", "log_scales", "logit_opacities", "sh", "class_scores")
    return Gaussians(
        **{name: np.concatenate([getattr(p, name) for p in (none, *parts)]) for name in names}
    )
