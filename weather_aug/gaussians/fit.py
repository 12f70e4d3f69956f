"""Fit a drive as 3D Gaussians, on a CPU or a GPU, from frames with depth."""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from weather_aug._keys import key_of
from weather_aug.clip.types import Frame
from weather_aug.errors import ArgumentError
from weather_aug.gaussians import checkpoint, loss
from weather_aug.gaussians.densify import Densification, Relocation
from weather_aug.gaussians.frames import Target, resized, split, target_of
from weather_aug.gaussians.gather import one_thread_of_torch
from weather_aug.gaussians.initialise import scene_radius_m
from weather_aug.gaussians.model import Model, Seen
from weather_aug.gaussians.options import FitOptions
from weather_aug.gaussians.pool import Pool, position_rate
from weather_aug.gaussians.splitting import Splitting
from weather_aug.gaussians.ssim import ssim
from weather_aug.gaussians.types import Reconstruction

ELONGATION_EVERY = 10
"""Steps between two pulls at needles. All measurements of docs/reconstruction.md have it so, a
tenth of OmniRe's pull in all; what the whole of it does was not tried."""
SAVED_EVERY = 500
"""Steps between two checkpoints."""
COARSE_SHARE = 0.25
"""Of the steps, done at half the size: a quarter of the time each, and the large forms come first
(OmniRe starts at a quarter of the size)."""
LEAST_COARSE_PX = 96
"""Smaller sides are not halved."""
DEGREE_EVERY = 1000
"""Steps after which colours may change with the direction by one more degree (3DGS)."""
DENSIFIED_SHARE = {"relocation": 0.8, "gradient": 0.5}
"""Of the steps, up to which Gaussians are moved or added (as of 30,000 in gsplat and 3DGS)."""
GROWTH = 1.25
"""How many times as many Gaussians there may be in the end."""
HELD_MEMORY = 2**31
"""Bytes of prepared frames that are kept; beyond it each is prepared when it is looked at."""


class Fitted(NamedTuple):
    """A drive as Gaussians, and how well it was met."""

    reconstruction: Reconstruction
    record: dict[str, Any]
    """JSON values: `steps`, `gaussians`, `minutes`, `width`, `height`, `psnr_db` and `ssim` of the
    learnt frames, `held_out_psnr_db` and `held_out_ssim` if some were held out, and `curve`:
    (step, seconds, PSNR in dB of the pictures since the last entry)."""


def fit(
    frames: Sequence[Frame],
    options: FitOptions | None = None,
    *,
    checkpoints: Path | None = None,
    progress: bool = False,
    device: torch.device | str = "cpu",
) -> Fitted:
    """Fit `frames` of one drive as Gaussians, sky, moving objects, exposures and poses.

    The result is a function of frames and options, on one machine to the bit; it is the same
    whether the work was cut short and taken up again, and on how many threads it was done.

    Args:
        frames: Of one clip; some need depth, for a start.
        options: `FitOptions()` if None.
        checkpoints: Folder in which the state is kept each 500 steps; a fit of the same frames and
            options goes on there.
        progress: Show a bar with the PSNR.
        device: "cpu", or a CUDA device (with gsplat).

    Raises:
        ArgumentError: If there are no frames, none has depth, or an option is out of range.
        DataError: If a checkpoint is damaged.
        OutputError: If a checkpoint cannot be written.

    Sources:
        3DGS (Kerbl et al. 2023), 3DGS-MCMC (Kheradmand et al. 2024), OmniRe (Chen et al. 2025).
    """
    options = FitOptions() if options is None else options
    if not frames:
        raise ArgumentError("frames are none; there is nothing to fit")
    smaller = [resized(frame, options.scale) for frame in frames]
    learnt, held_out = split(smaller, options.held_out)
    model = Model(
        learnt,
        count=options.count if options.densify == "none" else int(options.count / GROWTH),
        sh_degree=options.sh_degree,
        sky_size=options.sky_size,
        seed=options.seed,
        device=device,
    )
    with one_thread_of_torch():
        task = _Task(model, options, learnt, checkpoints)
        task.run(progress)
        record = task.record() | _measured(model, options, learnt, "")
        if held_out:
            record |= _measured(model, options, held_out, "held_out_")
    return Fitted(model.reconstruction(), record)


class _Task:
    """A fit under way."""

    def __init__(
        self, model: Model, options: FitOptions, frames: Sequence[Frame], folder: Path | None
    ) -> None:
        self.model = model
        self.options = options
        self.folder = folder
        self.done = 0
        self.seconds = 0.0
        self.curve: list[tuple[int, float, float]] = []
        self._errors: list[float] = []
        self._radius_m = scene_radius_m(frames)
        self._fine = _Shelf(frames, 1.0, model.device)
        self._coarse = _Shelf(frames, 0.5, model.device) if _can_halve(frames) else self._fine
        self._densifiers = [
            _densification(options, pool, self._radius_m) if len(pool) else None
            for pool in model.pools
        ]
        self._head = {"options": asdict(options) | {"threads": 0}, "frames": _digest(frames)}
        self._take_up()

    def run(self, progress: bool) -> None:
        """Do all steps that are left."""
        steps = self.options.steps
        with tqdm(total=steps, initial=self.done, desc="fit", disable=not progress) as bar:
            while self.done < steps:
                started = time.perf_counter()
                self._errors.append(self._step(self.done))
                self.seconds += time.perf_counter() - started
                self.done += 1
                bar.update()
                if self.done % SAVED_EVERY == 0 or self.done == steps:
                    self._note()
                    bar.set_postfix(
                        psnr=f"{self.curve[-1][2]:.1f} dB", n=len(self.model.background)
                    )
                    self._save()

    def record(self) -> dict[str, Any]:
        """What was done, as JSON values."""
        frame = self._fine.frames[0]
        return {
            "steps": self.done,
            "gaussians": sum(len(pool) for pool in self.model.pools),
            "minutes": round(self.seconds / 60, 3),
            "width": frame.camera.width,
            "height": frame.camera.height,
            "curve": [[step, round(s, 1), round(psnr, 2)] for step, s, psnr in self.curve],
        }

    def _step(self, step: int) -> float:
        """Look at one picture; the mean squared error it had."""
        options, model = self.options, self.model
        shelf = self._coarse if step < COARSE_SHARE * options.steps else self._fine
        target = shelf.target(_which(options.seed, step, len(shelf.frames)))
        rate = position_rate(step, options.steps, self._radius_m)
        for pool in model.pools:
            pool.set_rate("means_m", rate)
        degree = min(options.sh_degree, step // DEGREE_EVERY)
        seen = model.see(target.frame, degree, options.threads)
        total = self._loss(seen, target, step)
        total.backward()
        if not options.refine:
            for parameter in (model.exposures.deltas, *model.cameras.parameters()):
                parameter.grad = None
        self._densify(seen, target, step)
        model.step()
        for pool, densifier in zip(model.pools, self._densifiers, strict=True):
            if densifier is not None:
                densifier.after_step(pool, step)
        return float((seen.picture.detach() - target.picture.image).square().mean())

    def _loss(self, seen: Seen, target: Target, step: int) -> Tensor:
        drawn = seen.drawn
        total = loss.photometric(seen.picture, target.picture)
        total = total + loss.SKY_WEIGHT * loss.sky_opacity(
            drawn.opacity, target.is_sky, target.is_known
        )
        total = total + loss.DEPTH_WEIGHT * loss.depth_loss(
            drawn.depth_m, drawn.opacity, target.depth_m
        )
        total = total + self.model.penalty()
        for pool in self.model.pools:
            if len(pool) == 0:
                continue
            log_scales = pool.parameters["log_scales"]
            if step % ELONGATION_EVERY == 0:
                total = total + loss.ELONGATION_WEIGHT * loss.elongation(log_scales)
            if self.options.densify == "relocation":
                # What nothing needs fades and shrinks, and can be moved.
                opacities = pool.parameters["logit_opacities"]
                total = total + loss.OPACITY_WEIGHT * loss.mean_opacity(opacities)
                total = total + loss.SCALE_WEIGHT * loss.mean_scale(log_scales, self._radius_m)
        return total

    def _densify(self, seen: Seen, target: Target, step: int) -> None:
        """Tell the strategies what the picture pulls at."""
        gradients, radii = seen.drawn.centres_px.grad, seen.drawn.radii_px
        if gradients is None or self.options.densify != "gradient":
            return
        still = len(self.model.background)
        for pool, densifier, part in zip(
            self.model.pools, self._densifiers, (slice(0, still), slice(still, None)), strict=True
        ):
            if densifier is None:
                continue
            own, extent = gradients[part], radii[part]
            if pool is self.model.moving:
                # Those who are not there have no row in the picture.
                own, extent = (
                    _spread(own, seen.rows, len(pool)),
                    _spread(extent, seen.rows, len(pool)),
                )
            densifier.after_backward(
                pool,
                step,
                centres_grad_px=own,
                radii_px=extent,
                width=target.frame.camera.width,
                height=target.frame.camera.height,
            )

    def _note(self) -> None:
        psnr = -10 * math.log10(max(float(np.mean(self._errors)), 1e-12))
        self.curve.append((self.done, self.seconds, psnr))
        self._errors.clear()

    def _save(self) -> None:
        if self.folder is None:
            return
        state = self.model.state()
        for row, densifier in enumerate(self._densifiers):
            if densifier is not None:
                state |= {f"densifier.{row}.{k}": v for k, v in densifier.state().items()}
        progress = {"done": self.done, "seconds": self.seconds, "curve": self.curve}
        checkpoint.save(self.folder, self._head | progress, state)

    def _take_up(self) -> None:
        """Go on where the last process stopped, if it did the same."""
        found = None if self.folder is None else checkpoint.load(self.folder)
        if found is None:
            return
        head, state = found
        # As it comes back from the file: JSON has no tuples.
        if any(head.get(k) != v for k, v in json.loads(json.dumps(self._head)).items()):
            return
        self.model.restore(state)
        for row, densifier in enumerate(self._densifiers):
            prefix = f"densifier.{row}."
            own = {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}
            if densifier is not None:
                densifier.restore(own)
        self.done, self.seconds = int(head["done"]), float(head["seconds"])
        self.curve = [(int(a), float(b), float(c)) for a, b, c in head["curve"]]


def _densification(options: FitOptions, pool: Pool, radius_m: float) -> Densification | None:
    """The strategy of a pool, which has as many Gaussians as it may have; None for none."""
    if options.densify == "none":
        return None
    # A short fit needs its first rounds early.
    start = min(500, options.steps // 4)
    stop = max(int(DENSIFIED_SHARE[options.densify] * options.steps), start + 1)
    strategy = Splitting if options.densify == "gradient" else Relocation
    cap = int(GROWTH * len(pool))
    return strategy(cap=cap, radius_m=radius_m, seed=options.seed, start=start, stop=stop)


def _spread(values: Tensor, rows: Tensor, count: int) -> Tensor:
    """Put `values` into `rows` of `count`, zero elsewhere."""
    whole = values.new_zeros((count, *values.shape[1:]))
    whole[rows] = values
    return whole


class _Shelf:
    """Frames of one size, prepared once if there is room."""

    def __init__(self, frames: Sequence[Frame], scale: float, device: torch.device) -> None:
        self.frames = [resized(frame, scale) for frame in frames]
        self._device = device
        # A picture, its blur and its variance, in single precision.
        needed = sum(frame.image.size * 4 * 3 for frame in self.frames)
        self._kept: dict[int, Target] | None = {} if needed <= HELD_MEMORY else None

    def target(self, index: int) -> Target:
        """A frame as tensors."""
        if self._kept is None:
            return target_of(self.frames[index], self._device)
        if index not in self._kept:
            self._kept[index] = target_of(self.frames[index], self._device)
        return self._kept[index]


def _can_halve(frames: Sequence[Frame]) -> bool:
    sides = [min(frame.camera.width, frame.camera.height) for frame in frames]
    return min(sides) >= 2 * LEAST_COARSE_PX


def _which(seed: int, step: int, count: int) -> int:
    """Which frame a step looks at: each once in every round, in an order of the round's own."""
    rounds, place = divmod(step, count)
    order = np.random.Generator(np.random.Philox(key=key_of("fit", seed, rounds))).permutation(
        count
    )
    return int(order[place])


def _digest(frames: Sequence[Frame]) -> str:
    digest = hashlib.sha256()
    for frame in frames:
        digest.update(f"{frame.key} {frame.time_s!r} {frame.camera.width}".encode())
        digest.update(frame.camera.world_from_camera.tobytes() + frame.camera.intrinsics.tobytes())
        for plane in (frame.image, frame.label, frame.depth_m):
            digest.update(b"" if plane is None else np.ascontiguousarray(plane).tobytes())
        for box in frame.boxes:
            digest.update(f"{box.track_id} {box.class_name} {box.size_m}".encode())
            digest.update(box.world_from_box.tobytes())
    return digest.hexdigest()


@torch.no_grad()
def _measured(
    model: Model, options: FitOptions, frames: Sequence[Frame], prefix: str
) -> dict[str, float]:
    """Mean PSNR and SSIM of frames."""
    psnrs, ssims = [], []
    for frame in frames:
        target = target_of(frame, model.device)
        picture = model.see(frame, options.sh_degree, options.threads).picture.clamp(0, 1)
        psnrs.append(loss.psnr(picture, target.picture))
        ssims.append(float(ssim(picture, target.picture)))
    return {
        f"{prefix}psnr_db": round(float(np.mean(psnrs)), 3),
        f"{prefix}ssim": round(float(np.mean(ssims)), 4),
    }
