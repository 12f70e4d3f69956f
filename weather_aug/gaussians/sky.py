"""What is behind all Gaussians: a cube map that is learnt, sampled and filled.

Convention:
    Faces and texels are in OpenGL's layout, see `types.Sky`. Colours between texel centres are
    bilinear, over the edges between faces as well; where three faces meet, two of the three texels
    count. The map is at infinity: only the rotation of a camera matters, and the sky gives no
    gradient to it, because a smooth sky would pull at poses that the street fixes far better.
    float32 on a CPU goes through compiled loops, all else through torch.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from weather_aug.clip.types import Frame
from weather_aug.errors import ArgumentError
from weather_aug.gaussians import sky_kernels
from weather_aug.gaussians.cube import table_of, texel_directions, texels_of
from weather_aug.gaussians.types import Pinhole, Sky
from weather_aug.taxonomy import TRAIN_ID

Float32 = NDArray[np.float32]
Bools = NDArray[np.bool_]

SIZE = 256
"""Texels along the side of a face: 0.45 degrees each in its middle, 0.15 across a corner."""
MAX_SIZE = 4096
LEARNING_RATE = 0.01
"""For Adam (OmniRe)."""
UNKNOWN = 0.5
"""Of a map that nothing has been learnt about."""


class SkyMap(nn.Module):
    """A cube map to be learnt; see the module's Convention.

    Args:
        size: Texels along the side of a face, a power of 2 up to 4096.
        colour: sRGB of the whole map at first.

    Raises:
        ArgumentError: If the size is no power of 2 up to 4096.
    """

    seen: Tensor
    """(6, S, S) bool: a recorded frame showed sky there."""

    def __init__(
        self, size: int = SIZE, colour: tuple[float, float, float] = (UNKNOWN,) * 3
    ) -> None:
        super().__init__()
        size = _checked_size(size)
        self.faces = nn.Parameter(torch.tensor(colour).repeat(6, size, size, 1))
        """(6, S, S, 3) sRGB; learning may leave 0..1, `to_sky` does not."""
        self.register_buffer("seen", torch.zeros(6, size, size, dtype=torch.bool))

    @classmethod
    def of(cls, frames: Iterable[Frame], size: int = SIZE) -> SkyMap:
        """A map of the mean colours of all recorded sky pixels, unseen texels from around them.

        Sky is where the depth is `inf`; of a frame without depth, where the label says so; a frame
        with neither shows none. Without any sky the map is grey.

        Args:
            frames: Read once, one after the other.
            size: Texels along the side of a face, a power of 2 up to 4096.

        Raises:
            ArgumentError: If the size is no power of 2 up to 4096.
        """
        size = _checked_size(size)
        inner, rim = np.zeros((2, 6 * size * size, 4), np.float32)
        for frame in frames:
            _gather(inner, rim, frame)
        # Pixels beside what is no sky show some of that, too: they tell where sky was seen, and
        # its colour only if there are no others.
        sums = (inner if inner.any() else rim).reshape(6, size, size, 4)
        weights = sums[..., 3:]
        colours = (sums[..., :3] / np.where(weights > 0, weights, 1)).astype(np.float32)
        known = weights[..., 0] > 0
        sky = cls(size)
        with torch.no_grad():
            sky.faces.copy_(torch.from_numpy(_filled(colours, known.astype(np.float32))))
        sky.seen = torch.from_numpy((inner + rim)[:, 3] > 0).reshape(6, size, size)
        return sky

    def colours(self, directions_world: Tensor) -> Tensor:
        """Colours (..., 3), sRGB, in directions (..., 3) of any length above 0.

        Gradients go to the map only.
        """
        flat = directions_world.detach().reshape(-1, 3)
        if _is_compiled(self.faces):
            sampled: Tensor = _Sampled.apply(self.faces, flat)
        else:
            sampled = _sampled(self.faces, flat)
        return sampled.reshape(directions_world.shape)

    def background(
        self,
        pinhole: Pinhole,
        world_from_camera: Tensor | NDArray[Any],
        needed: Tensor | None = None,
    ) -> Tensor:
        """Colours (H, W, 3), sRGB, behind a picture.

        Args:
            pinhole: Lens and size of the picture.
            world_from_camera: (4, 4); it gets no gradient.
            needed: (H, W) bool; other pixels, for instance those that Gaussians hide, are 0.

        Raises:
            ArgumentError: If `needed` is not bool of the picture's size.
        """
        shape = (pinhole.height, pinhole.width)
        if needed is not None and (needed.shape != shape or needed.dtype != torch.bool):
            raise ArgumentError(
                f"needed must be bool {shape} like the picture, got {needed.dtype} "
                f"{tuple(needed.shape)}"
            )
        matrix = _world_from_pixel(pinhole, world_from_camera)
        if _is_compiled(self.faces):
            mask = np.ones(shape, bool) if needed is None else needed.contiguous().cpu().numpy()
            picture: Tensor = _Pictured.apply(self.faces, matrix, mask)
            return picture
        colours = _sampled(self.faces, _directions(matrix, shape, self.faces)).reshape(*shape, 3)
        return colours if needed is None else torch.where(needed[..., None], colours, 0.0)

    def to_sky(self) -> Sky:
        """The map as plain arrays, its colours in 0..1."""
        faces = self.faces.detach().float().clamp(0.0, 1.0).cpu().numpy().copy()
        return Sky(faces, self.seen.cpu().numpy().copy())


def sky_colours(sky: Sky, directions_world: NDArray[Any]) -> Float32:
    """Colours (..., 3), sRGB, of a sky in directions (..., 3) of any length above 0."""
    faces, size = _flat(sky)
    directions = np.ascontiguousarray(directions_world, np.float32)
    out = np.empty_like(directions)
    sky_kernels.sample(faces, table_of(size), directions.reshape(-1, 3), out.reshape(-1, 3))
    return out


def sky_picture(
    sky: Sky,
    pinhole: Pinhole,
    world_from_camera: NDArray[Any],
    needed: Bools | None = None,
) -> Float32:
    """Colours (H, W, 3), sRGB, of a sky behind a picture; see `SkyMap.background`."""
    faces, size = _flat(sky)
    shape = (pinhole.height, pinhole.width)
    mask = np.ones(shape, bool) if needed is None else np.ascontiguousarray(needed, bool)
    if mask.shape != shape:
        raise ArgumentError(f"needed must be bool {shape} like the picture, got {mask.shape}")
    out = np.zeros((shape[0] * shape[1], 3), np.float32)
    matrix = _world_from_pixel(pinhole, world_from_camera)
    sky_kernels.sample_picture(faces, table_of(size), matrix, mask, out)
    return out.reshape(*shape, 3)


def sky_seen(sky: Sky, directions_world: NDArray[Any]) -> Bools:
    """(...) whether a recorded frame showed sky in directions (..., 3)."""
    seen: Bools = sky.seen.reshape(-1)[texels_of(directions_world, sky.seen.shape[1])]
    return seen


def _world_from_pixel(pinhole: Pinhole, world_from_camera: Tensor | NDArray[Any]) -> Float32:
    """(3, 3) map of (column, row, 1) to directions in world axes."""
    if isinstance(world_from_camera, Tensor):
        world_from_camera = world_from_camera.detach().cpu().numpy()
    camera_from_pixel = np.array(
        [
            [1 / pinhole.fx_px, 0, -pinhole.cx_px / pinhole.fx_px],
            [0, 1 / pinhole.fy_px, -pinhole.cy_px / pinhole.fy_px],
            [0, 0, 1],
        ]
    )
    return (world_from_camera[:3, :3] @ camera_from_pixel).astype(np.float32)


def _directions(world_from_pixel: Float32, shape: tuple[int, int], like: Tensor) -> Tensor:
    """(H W, 3) of all pixels."""
    rows, columns = torch.meshgrid(*(torch.arange(side) for side in shape), indexing="ij")
    pixels = torch.stack([columns, rows, torch.ones_like(rows)], -1).reshape(-1, 3).to(like)
    return pixels @ torch.from_numpy(world_from_pixel).to(like).T


def _is_compiled(faces: Tensor) -> bool:
    return faces.device.type == "cpu" and faces.dtype == torch.float32


def _sampled(faces: Tensor, directions: Tensor) -> Tensor:
    """`sky_kernels.sample` in torch, for any device and type: (N, 3)."""
    size = faces.shape[1]
    wide = size + 2
    table = torch.from_numpy(table_of(size).reshape(-1).astype(np.int64)).to(faces.device)
    x, y, z = directions.to(faces.dtype).unbind(-1)
    major = directions.abs().argmax(-1, keepdim=True)
    value = directions.to(faces.dtype).gather(-1, major)
    face = 2 * major + (value <= 0)
    across = torch.stack([-z, z, x, x, x, -x], -1).gather(-1, face) / value.abs()
    down = torch.stack([-y, -y, z, -z, -y, -y], -1).gather(-1, face) / value.abs()
    column, row = ((0.5 * size * (place + 1) + 0.5)[:, 0] for place in (across, down))
    left, top = (place.floor().nan_to_num().clamp(0, size) for place in (column, row))
    corner = (face[:, 0] * wide + top.long()) * wide + left.long()
    flat = faces.reshape(-1, 3)
    right, lower = (column - left)[:, None], (row - top)[:, None]
    upper_row = torch.lerp(flat[table[corner]], flat[table[corner + 1]], right)
    lower_row = torch.lerp(flat[table[corner + wide]], flat[table[corner + wide + 1]], right)
    return torch.lerp(upper_row, lower_row, lower)


class _Sampled(torch.autograd.Function):
    """Colours of directions, differentiable in the faces."""

    @staticmethod
    def forward(ctx: Any, faces: Tensor, directions: Tensor) -> Tensor:
        ctx.directions = directions.to(torch.float32).contiguous().cpu().numpy()
        ctx.faces_shape = faces.shape
        out = np.empty_like(ctx.directions)
        flat = faces.detach().contiguous().numpy().reshape(-1, 3)
        sky_kernels.sample(flat, table_of(faces.shape[1]), ctx.directions, out)
        return torch.from_numpy(out)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        to_faces = np.zeros((ctx.faces_shape[:3].numel(), 3), np.float32)
        table = table_of(ctx.faces_shape[1])
        sky_kernels.scatter(grad.contiguous().numpy(), table, ctx.directions, to_faces)
        return torch.from_numpy(to_faces).reshape(ctx.faces_shape), None


class _Pictured(torch.autograd.Function):
    """A picture of the sky, differentiable in the faces."""

    @staticmethod
    def forward(ctx: Any, faces: Tensor, world_from_pixel: Float32, needed: Bools) -> Tensor:
        ctx.view = world_from_pixel, needed
        ctx.faces_shape = faces.shape
        out = np.zeros((needed.size, 3), np.float32)
        flat = faces.detach().contiguous().numpy().reshape(-1, 3)
        sky_kernels.sample_picture(flat, table_of(faces.shape[1]), world_from_pixel, needed, out)
        return torch.from_numpy(out).reshape(*needed.shape, 3)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        to_faces = np.zeros((ctx.faces_shape[:3].numel(), 3), np.float32)
        table = table_of(ctx.faces_shape[1])
        flat = grad.contiguous().numpy().reshape(-1, 3)
        sky_kernels.scatter_picture(flat, table, *ctx.view, to_faces)
        return torch.from_numpy(to_faces).reshape(ctx.faces_shape), None, None


def _checked_size(size: int) -> int:
    if not (isinstance(size, int) and 1 <= size <= MAX_SIZE and size & (size - 1) == 0):
        raise ArgumentError(f"size must be a power of 2 up to {MAX_SIZE}, got {size!r}")
    return size


def _flat(sky: Sky) -> tuple[Float32, int]:
    """Faces (T, 3) and their side."""
    faces = np.ascontiguousarray(sky.faces, np.float32)
    return faces.reshape(-1, 3), faces.shape[1]


def _gather(inner: Float32, rim: Float32, frame: Frame) -> None:
    """Add the colours and the weights of a frame's sky pixels to flat texels (T, 4) of two maps.

    The rim are those pixels that touch what is no sky.
    """
    sky = _sky_of(frame)
    if not sky.any():
        return
    table = table_of(math.isqrt(len(inner) // 6))
    # cv2 takes what is outside the picture for sky.
    core = cv2.erode(sky.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    pinhole = Pinhole.of(frame.camera)
    matrix = _world_from_pixel(pinhole, frame.camera.world_from_camera)
    # Pixels wider than the texels in a corner of a face, a third of those in its middle, would
    # leave gaps.
    steps = math.ceil(1.5 * (table.shape[1] - 2) / min(pinhole.fx_px, pinhole.fy_px))
    values = np.ones((sky.size, 4), np.float32)
    values[:, :3] = frame.image.reshape(-1, 3) / np.float32(255.0)
    values /= np.float32(steps**2)
    shifts = (np.arange(steps) + 0.5) / steps - 0.5
    for across, down in itertools.product(shifts, shifts):
        shift = np.array([[1, 0, across], [0, 1, down], [0, 0, 1]])
        moved = (matrix @ shift).astype(np.float32)
        sky_kernels.scatter_picture(values, table, moved, core, inner)
        sky_kernels.scatter_picture(values, table, moved, sky & ~core, rim)


def _sky_of(frame: Frame) -> Bools:
    if frame.depth_m is not None:
        return np.isposinf(frame.depth_m)
    if frame.label is not None:
        return np.asarray(frame.label == TRAIN_ID["sky"])
    return np.zeros(frame.image.shape[:2], bool)


def _filled(colours: Float32, trust: Float32) -> Float32:
    """(6, S, S, 3) colours, each as far as it is trusted (6, S, S) in 0..1, else from around it.

    Around it is a map of half the size, made of the same, filled in the same way: so a single texel
    among unknown ones soon loses its say.
    """
    size = trust.shape[1]
    if trust.min() == 1.0:
        return colours
    if size == 1:
        total = float(trust.sum())
        weights = trust[..., None] / np.float32(total if total > 0 else 1.0)
        around = (weights * colours).sum(axis=(0, 1, 2)) if total > 0 else UNKNOWN
        return (trust[..., None] * colours + (1 - trust[..., None]) * around).astype(np.float32)
    blocks = (6, size // 2, 2, size // 2, 2)
    sums = (trust[..., None] * colours).reshape(*blocks, 3).sum(axis=(2, 4))
    trusts = trust.reshape(blocks).sum(axis=(2, 4))
    means = sums / np.where(trusts > 0, trusts, np.float32(1.0))[..., None]
    coarse = _filled(means, trusts / np.float32(4.0))
    unsure = trust < 1.0
    directions = np.ascontiguousarray(texel_directions(size)[unsure])
    around = np.empty_like(directions)
    sky_kernels.sample(coarse.reshape(-1, 3), table_of(size // 2), directions, around)
    filled = colours.copy()
    share = trust[unsure][:, None]
    filled[unsure] = share * colours[unsure] + (1 - share) * around
    return filled
