"""Classes of Gaussians from the frames' labels, and how much of the frames each one made up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from weather_aug.clip.types import Frame
from weather_aug.errors import ArgumentError
from weather_aug.gaussians.gather import camera_of, gather, one_thread_of_torch, rasterised
from weather_aug.gaussians.types import CLASSES, Float32, Reconstruction
from weather_aug.taxonomy import SKY

STEPS = 4
_LEAST = 1e-6


@one_thread_of_torch()
def fit_labels(
    reconstruction: Reconstruction,
    frames: Sequence[Frame],
    *,
    steps: int = STEPS,
    threads: int = 1,
    progress: bool = False,
) -> Reconstruction:
    """The reconstruction with class scores, and `support`, from its recorded frames.

    A pixel's class is taken as drawn from the Gaussians' scores, blended as their colours are, and
    from the sky with the light that comes through. The scores are those under which the labels are
    most likely, as maximising the cross-entropy's likelihood finds them: each step hands every
    labelled pixel out to the Gaussians by their share in it, and makes what a Gaussian received its
    scores. The first step is a vote; each later one makes the labels more likely, without a
    learning rate.

    Args:
        reconstruction: Geometry is left as it is.
        frames: Recorded frames, in any order; those without a label count for `support` only.
        steps: Passes over the frames, at least 1.
        threads: Of the rasteriser. The result does not depend on it.
        progress: Show a bar.

    Returns:
        With `class_scores` (N, 19) float16 that add up to 1, or to 0 for Gaussians that no labelled
        pixel showed, of background and actors; with `support` (N,).

    Raises:
        ArgumentError: If no frame has a label, or `steps` is below 1.

    Sources:
        Dempster, Laird, Rubin 1977: EM for the shares of a mixture. Votes by the backward pass:
        the gradient of blended one-hot planes is each Gaussian's weight in them.
    """
    if steps < 1:
        raise ArgumentError(f"steps must be at least 1, got {steps}")
    labelled = [(frame, frame.label) for frame in frames if frame.label is not None]
    if not labelled:
        raise ArgumentError("no frame has a label; give frames of a labelled clip")
    ids = _ids_in([label for _, label in labelled])
    count = len(reconstruction.background) + len(reconstruction.actor_gaussians)
    scores = torch.full((count, len(ids)), 1 / len(ids))
    bar = tqdm(total=steps * len(labelled), desc="labels", unit="frame", disable=not progress)
    with bar:
        for _ in range(steps):
            received = torch.zeros_like(scores)
            for frame, label in labelled:
                rows, given = _handed_out(reconstruction, frame, label, ids, scores, threads)
                received[rows] += given
                bar.update()
            total = received.sum(dim=1, keepdim=True)
            scores = torch.where(total > _LEAST, received / total.clamp_min(_LEAST), scores)
    whole = np.zeros((count, CLASSES), np.float16)
    whole[:, ids] = torch.where(total > _LEAST, scores, 0.0).numpy()
    first, second = np.split(whole, [len(reconstruction.background)])
    return replace(
        reconstruction,
        background=replace(reconstruction.background, class_scores=first),
        actor_gaussians=replace(reconstruction.actor_gaussians, class_scores=second),
        support=recorded_support(reconstruction, frames, threads=threads, progress=progress),
    )


@one_thread_of_torch()
def recorded_support(
    reconstruction: Reconstruction,
    frames: Sequence[Frame],
    *,
    threads: int = 1,
    progress: bool = False,
) -> Float32:
    """(N,) how many pixels of `frames` each of the background's Gaussians made up."""
    background = len(reconstruction.background)
    support = torch.zeros(background + len(reconstruction.actor_gaussians))
    for frame in tqdm(frames, desc="support", unit="frame", disable=not progress):
        gathered = gather(reconstruction, frame.time_s, colours=False, labels=False)
        plane = torch.zeros(len(gathered.rows), 1, requires_grad=True)
        drawn = rasterised(gathered, camera_of(reconstruction, frame), plane, threads)
        (weights,) = torch.autograd.grad(drawn.colours, plane, torch.ones_like(drawn.colours))
        support[gathered.rows] += weights[:, 0]
    return support[:background].numpy()


def _ids_in(labels: Sequence[NDArray[np.uint8]]) -> NDArray[np.intp]:
    """Train ids that the labels hold, rising, the sky's among them."""
    present = np.zeros(256, bool)
    for label in labels:
        present[np.unique(label)] = True
    present[SKY] = True
    return np.flatnonzero(present[:CLASSES])


def _handed_out(
    reconstruction: Reconstruction,
    frame: Frame,
    label: NDArray[np.uint8],
    ids: NDArray[np.intp],
    scores: Tensor,
    threads: int,
) -> tuple[Tensor, Tensor]:
    """Rows of the Gaussians in a frame, and what each gets of the labelled pixels by class."""
    gathered = gather(reconstruction, frame.time_s, colours=False, labels=False)
    own = scores[gathered.rows].requires_grad_()
    drawn = rasterised(gathered, camera_of(reconstruction, frame), own, threads)
    likelihood = drawn.colours.detach().clone()
    likelihood[..., np.searchsorted(ids, SKY)] += 1 - drawn.opacity.detach()
    place = np.full(256, -1)
    place[ids] = np.arange(len(ids))
    target = torch.from_numpy(place[label])[..., None]
    inverse = 1 / likelihood.gather(2, target.clamp_min(0)).clamp_min(_LEAST)
    shares = torch.zeros_like(likelihood)
    shares.scatter_(2, target.clamp_min(0), torch.where(target >= 0, inverse, 0.0))
    (per_score,) = torch.autograd.grad(drawn.colours, own, shares)
    return gathered.rows, own.detach() * per_score
