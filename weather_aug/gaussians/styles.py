"""The colours of a whole scene in other weathers, over the geometry that it has.

With the geometry held, a picture is linear in the colours: each pixel is a weighted mean of the
colours of Gaussians and sky. So a weather's colours are a linear least-squares fit to its edited
frames. Conjugate gradients solve it: no learning rate, each iteration draws each frame once and
carries one gradient back. All weathers share these passes, as further channels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from weather_aug.clip.types import Camera, Frame
from weather_aug.errors import ArgumentError, DataError, printable
from weather_aug.gaussians.exposure import nearest
from weather_aug.gaussians.gather import (
    Gathered,
    camera_of,
    gather,
    one_thread_of_torch,
    rasterised,
)
from weather_aug.gaussians.harmonics_kernels import C0, C1
from weather_aug.gaussians.sky import SkyMap
from weather_aug.gaussians.types import Pinhole, Reconstruction, Style

STEPS = 8
"""More gain 0.2 dB at most."""
TIE = 0.01
"""Share of a Gaussian's pixels that hold it to the scene's own colours. It keeps the colours of
those that hide each other from running away in opposite directions."""
LEAST_TIE_PX = 0.01
LEAST_DETERMINANT = 1e-3
"""Of an exposure that can be undone."""
LEAST_LIGHT = 1 / 512
"""Of the sky, that comes through: less is not half a level of a picture."""


class _Colours(NamedTuple):
    """Colours of everything, or changes of them; C channels, three of each style."""

    sh: Tensor
    """(K, N + M, C) coefficients."""
    sky: Tensor
    """(6, S, S, C)."""

    def plus(self, factor: Tensor, other: _Colours) -> _Colours:
        """Sum with `factor` (C,) times `other`."""
        return _Colours(self.sh + factor * other.sh, self.sky + factor * other.sky)

    def times(self, other: _Colours) -> _Colours:
        return _Colours(self.sh * other.sh, self.sky * other.sky)

    def dot(self, other: _Colours) -> Tensor:
        """(C,) inner products."""
        return (self.sh * other.sh).sum((0, 1)) + (self.sky * other.sky).sum((0, 1, 2))


def fit_style(
    reconstruction: Reconstruction,
    frames: Sequence[Frame],
    name: str,
    *,
    steps: int = STEPS,
    threads: int = 1,
    progress: bool = False,
) -> Reconstruction:
    """The reconstruction with one more style; see `fit_styles`, which is faster for several."""
    return fit_styles(
        reconstruction, {name: frames}, steps=steps, threads=threads, progress=progress
    )


@one_thread_of_torch()
def fit_styles(
    reconstruction: Reconstruction,
    edited: Mapping[str, Sequence[Frame]],
    *,
    steps: int = STEPS,
    threads: int = 1,
    progress: bool = False,
) -> Reconstruction:
    """The reconstruction with styles fitted to edited frames; its geometry is left as it is.

    A style's colours have harmonics up to degree 1, and start from the scene's own, where they stay
    for what no frame shows. What no frame shows of the sky changes as much as the rest on average.

    Args:
        reconstruction: The drive.
        edited: The recorded frames by name of the weather, edited, with the exposure that they were
            recorded with; the same keys for each name. Each frame is read once.
        steps: Iterations, at least 1; each draws all frames once, and so does the start.
        threads: Of the rasteriser. The result does not depend on it.
        progress: Show a bar.

    Raises:
        ArgumentError: If there are no frames, the names' keys differ, or `steps` is below 1.
        DataError: If an exposure cannot be undone.

    Sources:
        Hestenes and Stiefel 1952, with the diagonal as preconditioner.
    """
    if steps < 1:
        raise ArgumentError(f"steps must be at least 1, got {steps}")
    frames = _checked(edited)
    start = _start(reconstruction, len(edited))
    total = (steps + 1) * len(frames)
    with tqdm(total=total, desc="styles", unit="frame", disable=not progress) as bar:
        pictures = _Pictures(reconstruction, frames, threads, bar)
        residual, weights = pictures.start(start, edited)
        change = _solved(pictures, residual, weights, steps)
    unseen = weights.sky == 0
    mean = (weights.sky * change.sky).sum((0, 1, 2)) / weights.sky.sum().clamp_min(1e-6)
    change = change._replace(sky=torch.where(unseen, mean, change.sky))
    fitted = start.plus(torch.ones(3 * len(edited)), change)
    fitted = fitted._replace(sky=_halved(fitted.sky, weights.sky))
    count = len(reconstruction.background)
    added = {
        name: Style(
            sh=sh[:, :count].transpose(0, 1).half().numpy(),
            actor_sh=sh[:, count:].transpose(0, 1).half().numpy(),
            # Unbounded: little of it comes through where it is far from 0..1.
            sky=sky.half().numpy(),
        )
        for name, sh, sky in zip(edited, fitted.sh.split(3, 2), fitted.sky.split(3, 3), strict=True)
    }
    return replace(reconstruction, styles={**reconstruction.styles, **added})


def _halved(faces: Tensor, weights: Tensor) -> Tensor:
    """Faces (6, S, S, C) with half as many texels along each side, by weights (6, S, S, 1)."""
    side = faces.shape[1]
    if side == 1:
        return faces
    blocks = (6, side // 2, 2, side // 2, 2)
    # A trace where nothing was seen, so that the mean there is a plain one.
    held = weights.reshape(*blocks, 1) + 1e-6
    return (faces.reshape(*blocks, -1) * held).sum((2, 4)) / held.sum((2, 4))


def _solved(pictures: _Pictures, residual: _Colours, weights: _Colours, steps: int) -> _Colours:
    """Change of the colours that minimises Σ (picture - target)² + tie · change²."""
    tie = _Colours(*(TIE * weight + LEAST_TIE_PX for weight in weights))
    inverse = _Colours(*(1 / (weight + pull) for weight, pull in zip(weights, tie, strict=True)))
    change = _Colours(*(torch.zeros_like(part) for part in residual))
    ahead = inverse.times(residual)
    direction = ahead
    size = residual.dot(ahead)
    for _ in range(steps):
        mapped, square = pictures.normal(direction)
        mapped = _Colours(*(m + t * d for m, t, d in zip(mapped, tie, direction, strict=True)))
        square = square + direction.dot(tie.times(direction))
        # A style that is met already has nothing to go on with.
        length = torch.where(square > 0, size / square.clamp_min(_TINY), 0.0)
        change = change.plus(length, direction)
        residual = residual.plus(-length, mapped)
        ahead = inverse.times(residual)
        before, size = size, residual.dot(ahead)
        direction = ahead.plus(
            torch.where(before > 0, size / before.clamp_min(_TINY), 0.0), direction
        )
    return change


_TINY = 1e-30


class _Pictures:
    """The linear map from colours to the pictures of all frames, and back."""

    def __init__(
        self, reconstruction: Reconstruction, frames: Sequence[Frame], threads: int, bar: tqdm[None]
    ) -> None:
        self._reconstruction, self._threads, self._bar = reconstruction, threads, bar
        self._moments = [(camera_of(reconstruction, frame), frame.time_s) for frame in frames]

    def start(
        self, colours: _Colours, edited: Mapping[str, Sequence[Frame]]
    ) -> tuple[_Colours, _Colours]:
        """What the edited frames ask to change, and how many pixels each colour makes up.

        The latter has one channel.
        """
        back, weights = _zeros(colours, colours.sky.shape[-1]), _zeros(colours, 1)
        for index, view in enumerate(self._views()):
            frames = [frames[index] for frames in edited.values()]
            target = torch.cat([self._without_exposure(frame) for frame in frames], dim=2)
            # One more plane: its slope is each Gaussian's weight.
            planes = torch.cat([view.planes(colours, 0.5), torch.zeros(view.count, 1)], dim=1)
            blended, carried = self._blended(view, planes)
            residual = target - blended[..., :-1] - view.sky_picture(colours)
            slope = carried(torch.cat([residual, torch.ones_like(residual[..., :1])], dim=2))
            view.add(back, slope[:, :-1], view.basis)
            view.add(weights, slope[:, -1:], view.basis.abs())
            view.add_sky(back, residual)
            view.add_sky(weights, torch.ones_like(residual[..., :1]))
        return back, weights

    def normal(self, change: _Colours) -> tuple[_Colours, Tensor]:
        """A change drawn and carried back, and the sum (C,) of its squares in the pictures."""
        channels = change.sky.shape[-1]
        back, square = _zeros(change, channels), torch.zeros(channels)
        for view in self._views():
            blended, carried = self._blended(view, view.planes(change, 0.0))
            picture = blended + view.sky_picture(change)
            square += picture.square().sum((0, 1))
            view.add(back, carried(picture), view.basis)
            view.add_sky(back, picture)
        return back, square

    def _views(self) -> Iterator[_View]:
        for camera, time_s in self._moments:
            gathered = gather(
                self._reconstruction,
                time_s,
                origin_m=camera.centre_world,
                colours=False,
                labels=False,
            )
            yield _View(gathered, camera, len(self._reconstruction.background))
            self._bar.update()

    def _blended(self, view: _View, planes: Tensor) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """Planes blended by the Gaussians, and the way back from pictures to planes."""
        planes.requires_grad_()
        drawn = rasterised(view.gathered, view.camera, planes, self._threads)
        view.through = 1 - drawn.opacity.detach()

        def carried(picture: Tensor) -> Tensor:
            (slope,) = torch.autograd.grad(drawn.colours, planes, picture)
            return slope

        return drawn.colours.detach(), carried

    def _without_exposure(self, frame: Frame) -> Tensor:
        """(H, W, 3) sRGB as the scene has it."""
        matrix = nearest(self._reconstruction.exposures, frame.key).astype(np.float64)
        if not abs(np.linalg.det(matrix[:, :3])) > LEAST_DETERMINANT:
            raise DataError(f"frame {frame.key}: its exposure cannot be undone; fit the scene anew")
        inverse = np.linalg.inv(matrix[:, :3])
        scene = frame.image / 255.0 @ inverse.T - inverse @ matrix[:, 3]
        return torch.from_numpy(scene.astype(np.float32))


class _View:
    """One frame's Gaussians and sky."""

    through: Tensor
    """(H, W) light of the sky that comes through, once the Gaussians were drawn."""

    def __init__(self, gathered: Gathered, camera: Camera, background: int) -> None:
        self.gathered, self.camera = gathered, camera
        self.count = len(gathered.rows)
        self.basis = _basis(gathered.means_m)
        self._split = background
        self._movers = gathered.rows[background:]

    def planes(self, colours: _Colours, offset: float) -> Tensor:
        """(R, C) colours as seen from here, unbounded."""
        planes = torch.full((self.count, colours.sh.shape[2]), offset)
        still, moving = planes[: self._split], planes[self._split :]
        for sh, basis in zip(colours.sh, self.basis, strict=False):
            still.addcmul_(sh[: self._split], basis[: self._split, None])
            moving.addcmul_(sh[self._movers], basis[self._split :, None])
        return planes

    def add(self, back: _Colours, slope: Tensor, basis: Tensor) -> None:
        """Add to `back` what the slopes (R, C) of the colours seen mean for the coefficients."""
        for sh, values in zip(back.sh, basis, strict=False):
            sh[: self._split].addcmul_(slope[: self._split], values[: self._split, None])
            sh.index_add_(0, self._movers, slope[self._split :] * values[self._split :, None])

    def sky_picture(self, colours: _Colours) -> Tensor:
        """(H, W, C) of the sky's light that comes through."""
        parts = [self._map(faces)[1].detach() for faces in colours.sky.split(3, dim=3)]
        return torch.cat(parts, dim=2) * self.through[..., None]

    def add_sky(self, back: _Colours, picture: Tensor) -> None:
        """Add to `back` what changes (H, W, C) of the picture mean for the sky."""
        scaled = picture * self.through[..., None]
        for sky, part in zip(back.sky.split(3, 3), scaled.split(3, 2), strict=True):
            faces, behind = self._map(torch.zeros(*sky.shape[:3], 3))
            channels = sky.shape[3]
            (slope,) = torch.autograd.grad(behind, faces, part.expand(-1, -1, 3).contiguous())
            sky += slope[..., :channels]

    def _map(self, faces: Tensor) -> tuple[Tensor, Tensor]:
        sky = SkyMap(faces.shape[1])
        sky.faces.data = faces.contiguous()
        needed = self.through > LEAST_LIGHT
        pinhole = Pinhole.of(self.camera)
        return sky.faces, sky.background(pinhole, self.camera.world_from_camera, needed)


def _basis(towards: Tensor) -> Tensor:
    """(4, R) real harmonics of degree 0 and 1 in directions (R, 3), as of `colours_seen`."""
    x, y, z = torch.nn.functional.normalize(towards, dim=1).unbind(1)
    return torch.stack([torch.full_like(x, C0), -C1 * y, C1 * z, -C1 * x])


def _start(reconstruction: Reconstruction, styles: int) -> _Colours:
    """The scene's own colours for each style, up to degree 1."""
    own = reconstruction.background.sh, reconstruction.actor_gaussians.sh
    sh = np.concatenate([part[:, :4].astype(np.float32) for part in own])
    by_coefficient = torch.from_numpy(np.ascontiguousarray(sh.transpose(1, 0, 2)))
    sky = torch.from_numpy(reconstruction.sky.faces.astype(np.float32))
    return _Colours(by_coefficient.repeat(1, 1, styles), sky.repeat(1, 1, 1, styles))


def _zeros(like: _Colours, channels: int) -> _Colours:
    return _Colours(*(torch.zeros(*part.shape[:-1], channels) for part in like))


def _checked(edited: Mapping[str, Sequence[Frame]]) -> Sequence[Frame]:
    """The frames of the first style, after a look at all."""
    if not edited or not all(len(frames) for frames in edited.values()):
        raise ArgumentError("edited must hold frames; give the edited frames by name of a weather")
    first = next(iter(edited.values()))
    keys = [frame.key for frame in first]
    for name, frames in edited.items():
        if [frame.key for frame in frames] != keys:
            raise ArgumentError(
                f"the frames of style {printable(name)!r} are not those of the others; edit the "
                "same frames in the same order for each"
            )
    return first
