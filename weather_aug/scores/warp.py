"""Warp error: how far two pictures of one street differ where they show the same surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import like_image
from weather_aug.clip.types import Camera, Float64, Frame
from weather_aug.errors import ArgumentError, printable
from weather_aug.taxonomy import CLASSES, SKY, TRAIN_ID

Mask = NDArray[np.bool_]
Sky = Literal["out", "rotation"]

DEPTH_TOLERANCE_M = 0.2
DEPTH_TOLERANCE_SHARE = 0.05
"""Two depths are of one surface if they differ by less than the larger of both."""
BOX_MARGIN_M = 0.3
"""Boxes are drawn tightly, and depth is soft at outlines."""
EDGE_PX = 1e-6
"""A place that rounding has put outside by no more than this is on the border."""
MIN_SIZE_PX = 2
_MOVES = np.isin(np.arange(256), range(TRAIN_ID["person"], len(CLASSES)))
"""(256,) by train id: person, rider and all vehicles."""


@dataclass(frozen=True, eq=False)
class WarpError:
    """How far picture b, brought into view a, is from picture a; sRGB in [0, 1].

    Papers give one number and call it warp error: of estimated flow it is mostly `squared`. Values
    of 0.04 for neighbours of a drive, as WeatherEdit gives them, are most likely `absolute`: such a
    square would be a typical difference of 0.2, as of pictures that have nothing in common.
    """

    absolute: float
    """Mean over the compared pixels and the channels of |a - b|."""
    squared: float
    """Mean of (a - b)^2."""
    contrast: float
    """Mean absolute deviation of picture a from its own mean over the same pixels. Whatever takes
    contrast away takes error away with it: a grey wall is steady, and fog is halfway there."""
    share: float
    """Compared pixels among all pixels of a."""
    count: int
    """Compared pixels."""


@dataclass(frozen=True, eq=False)
class Correspondence:
    """Where the surfaces of view a are in view b; it knows geometry, not colours.

    Measure the clear and the edited pictures with one correspondence: their errors then are of the
    same pixels, and their ratio tells of the editing alone. Arrays are read-only.
    """

    shape_a: tuple[int, int]
    """(height, width) of view a."""
    shape_b: tuple[int, int]
    """(height, width) of view b."""
    pixels_a: NDArray[np.int64]
    """(N,) flat indices of the pixels of a that are compared, ascending."""
    columns_b: Float64
    """(N,) where they are in b, pixels, in [0, width - 1]."""
    rows_b: Float64
    """(N,) in [0, height - 1]."""

    @property
    def count(self) -> int:
        """Number of pixels compared."""
        return len(self.pixels_a)

    @property
    def share(self) -> float:
        """Compared pixels among all of view a, in [0, 1]."""
        return self.count / (self.shape_a[0] * self.shape_a[1])

    @property
    def mask(self) -> Mask:
        """(H, W) of view a: the pixels that are compared."""
        mask = np.zeros(self.shape_a, bool)
        mask.flat[self.pixels_a] = True
        return mask

    def error(self, image_a: NDArray[Any], image_b: NDArray[Any]) -> WarpError:
        """Compare two pictures of these views; b is sampled bilinearly, in sRGB.

        Args:
            image_a: (H, W, 3) uint8, or float in [0, 1], sRGB.
            image_b: (H, W, 3) of view b, likewise.

        Raises:
            ArgumentError: If a picture has another shape or type, or nothing can be compared.
        """
        a = _srgb("image_a", image_a, self.shape_a).reshape(-1, 3)[self.pixels_a]
        if not self.count:
            raise ArgumentError(
                "frame_a and frame_b show no common surface, so there is nothing to compare; "
                "choose neighbours in time or cameras that overlap, and look at the depth"
            )
        corners = _corners(self.columns_b, self.rows_b, self.shape_b)
        off = a - _bilinear(_srgb("image_b", image_b, self.shape_b).reshape(-1, 3), corners)
        return WarpError(
            absolute=float(np.abs(off).mean()),
            squared=float(np.square(off).mean()),
            contrast=float(np.abs(a - a.mean(axis=0)).mean()),
            share=self.share,
            count=self.count,
        )


def warp_error(
    frame_a: Frame,
    frame_b: Frame,
    image_a: NDArray[Any] | None = None,
    image_b: NDArray[Any] | None = None,
    *,
    movers: bool = False,
    sky: Sky = "out",
    mask: Mask | None = None,
) -> WarpError:
    """Difference of two pictures of one street, the second brought into the first's view.

    The frames tell depth and cameras; the pictures may be any of these views, such as rendered
    ones. See `correspondence` for what is compared; use it to compare several pictures of a pair.

    Args:
        frame_a: View to compare in; with depth.
        frame_b: Another moment of the same camera, or another camera of the same moment; with
            depth.
        image_a: (H, W, 3) uint8, or float in [0, 1], sRGB; the frame's own if None.
        image_b: Likewise.
        movers: See `correspondence`.
        sky: See `correspondence`.
        mask: See `correspondence`.

    Raises:
        ArgumentError: If an argument does not fit, or the frames show no common surface.

    Source:
        The warp error of WeatherEdit (Qian et al.), whose definition is not published. Where Lai
        et al., "Learning Blind Video Temporal Consistency" (2018), follow estimated flow, the
        correspondence here comes from depth and cameras.
    """
    found = correspondence(frame_a, frame_b, movers=movers, sky=sky, mask=mask)
    return found.error(
        frame_a.image if image_a is None else image_a,
        frame_b.image if image_b is None else image_b,
    )


def correspondence(
    frame_a: Frame,
    frame_b: Frame,
    *,
    movers: bool = False,
    sky: Sky = "out",
    mask: Mask | None = None,
) -> Correspondence:
    """Find the pixels of a whose surface b shows too, and where.

    A surface of a is visible in b if its depth there and b's own depth differ by less than the
    larger of 0.2 m and 5 %. Depth in between pixels is interpolated as its inverse, which is exact
    on planes.

    Args:
        frame_a: View to compare in; with depth.
        frame_b: The other view; with depth.
        movers: Compare people and vehicles too. If not, what a label calls person to bicycle, or a
            3D box holds, is left out, in either frame; without labels and boxes nobody tells.
        sky: "out" leaves the sky out; "rotation" compares it as what is infinitely far, where both
            frames have sky.
        mask: (H, W) bool of view a; only these pixels are compared. All if None.

    Raises:
        ArgumentError: If a frame has no depth or its depth is not positive, or an option is none of
            those listed.
    """
    if sky not in get_args(Sky):
        raise ArgumentError(f"sky must be 'out' or 'rotation', got {printable(sky)!r}")
    depth_a, depth_b = _depth("frame_a", frame_a), _depth("frame_b", frame_b)
    sky_a, sky_b = _sky(frame_a, depth_a), _sky(frame_b, depth_b)
    wanted = np.ones(depth_a.shape, bool) if mask is None else _checked_mask(mask, depth_a.shape)
    if sky == "out":
        wanted = wanted & ~sky_a
    barred_b = np.zeros(depth_b.shape, bool)
    if not movers:
        wanted = wanted & ~_movers(frame_a, depth_a)
        barred_b = _movers(frame_b, depth_b)
    pixels = np.flatnonzero(wanted)
    far = sky_a.flat[pixels]
    columns, rows, z = _projected(frame_a.camera, frame_b.camera, depth_a, pixels, far)
    inside = (z > 0) & _within(columns, rows, depth_b.shape)
    pixels, far = pixels[inside], far[inside]
    columns = np.clip(columns[inside], 0, depth_b.shape[1] - 1)
    rows, z = np.clip(rows[inside], 0, depth_b.shape[0] - 1), z[inside]
    corners = _corners(columns, rows, depth_b.shape)
    shown = _agreeing(corners, depth_b, sky_b, far, z) & ~barred_b.flat[corners[0]].any(axis=0)
    return Correspondence(
        (frame_a.camera.height, frame_a.camera.width),
        (frame_b.camera.height, frame_b.camera.width),
        _read_only(pixels[shown]),
        _read_only(columns[shown]),
        _read_only(rows[shown]),
    )


def _projected(
    camera_a: Camera, camera_b: Camera, depth_a: Float64, pixels: NDArray[np.int64], far: Mask
) -> tuple[Float64, Float64, Float64]:
    """Columns, rows and z-depth in b of pixels of a; of far ones by rotation, their z up to scale.

    Points behind b have a z that is not positive, and no place.
    """
    points = _rays(camera_a, pixels) * np.where(far, 1.0, depth_a.flat[pixels])[:, None]
    camera_b_from_a = np.linalg.inv(camera_b.world_from_camera) @ camera_a.world_from_camera
    shift = np.where(far[:, None], 0.0, camera_b_from_a[:3, 3])
    x, y, z = (points @ camera_b_from_a[:3, :3].T + shift).T
    ahead = np.where(z > 0, z, 1.0)
    (fx, fy), (cx, cy) = camera_b.focal_px, camera_b.principal_px
    return fx * x / ahead + cx, fy * y / ahead + cy, z


def _rays(camera: Camera, pixels: NDArray[np.int64]) -> Float64:
    """(N, 3) rays with z = 1 through the centres of pixels given by flat index, camera axes."""
    rows, columns = np.divmod(pixels, camera.width)
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    return np.stack([(columns - cx) / fx, (rows - cy) / fy, np.ones(len(pixels))], axis=1)


def _within(columns: Float64, rows: Float64, shape: tuple[int, ...]) -> Mask:
    height, width = shape
    low, right, bottom = -EDGE_PX, width - 1 + EDGE_PX, height - 1 + EDGE_PX
    return (columns >= low) & (columns <= right) & (rows >= low) & (rows <= bottom)


def _agreeing(
    corners: tuple[NDArray[np.int64], Float64], depth_b: Float64, sky_b: Mask, far: Mask, z: Float64
) -> Mask:
    """Whether b shows at each place what a does: sky there, or a surface as far away.

    A place whose four pixels are partly sky is on an outline, where colours mix.
    """
    sky = sky_b.flat[corners[0]]
    near = ~sky.any(axis=0)
    inverse = np.divide(1.0, depth_b, out=np.zeros_like(depth_b), where=~sky_b)
    z_b = 1.0 / np.where(near, _bilinear(inverse.reshape(-1, 1), corners)[:, 0], 1.0)
    tolerance = np.maximum(DEPTH_TOLERANCE_M, DEPTH_TOLERANCE_SHARE * z_b)
    return np.where(far, sky.all(axis=0), near & (np.abs(z - z_b) < tolerance))


def _corners(
    columns: Float64, rows: Float64, shape: tuple[int, ...]
) -> tuple[NDArray[np.int64], Float64]:
    """Flat indices (4, N) of the pixels around places in a picture, and their weights."""
    height, width = shape
    left = np.clip(np.floor(columns), 0, width - 2).astype(np.int64)
    top = np.clip(np.floor(rows), 0, height - 2).astype(np.int64)
    x, y = columns - left, rows - top
    first = top * width + left
    indices = np.stack([first, first + 1, first + width, first + width + 1])
    return indices, np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y])


def _bilinear(values: Float64, corners: tuple[NDArray[np.int64], Float64]) -> Float64:
    """(N, C) of flat values (H * W, C)."""
    indices, weights = corners
    taken = [w[:, None] * values[index] for index, w in zip(indices, weights, strict=True)]
    return taken[0] + taken[1] + taken[2] + taken[3]


def _movers(frame: Frame, depth_m: Float64) -> Mask:
    """(H, W): what a label calls person to bicycle, or lies in a 3D box."""
    found = np.zeros(depth_m.shape, bool)
    if frame.label is not None:
        found = _MOVES[frame.label]
    if not frame.boxes:
        return found
    pixels = np.flatnonzero(np.isfinite(depth_m))
    points = _rays(frame.camera, pixels) * depth_m.flat[pixels][:, None]
    boxed = np.zeros(len(pixels), bool)
    for box in frame.boxes:
        box_from_camera = np.linalg.inv(box.world_from_box) @ frame.camera.world_from_camera
        points_box = points @ box_from_camera[:3, :3].T + box_from_camera[:3, 3]
        reach = np.array(box.size_m) / 2 + BOX_MARGIN_M
        boxed |= (np.abs(points_box) <= reach).all(axis=1)
    found.flat[pixels[boxed]] = True
    return found


def _sky(frame: Frame, depth_m: Float64) -> Mask:
    sky = np.isinf(depth_m)
    return sky if frame.label is None else sky | (frame.label == SKY)


def _depth(name: str, frame: Frame) -> Float64:
    if not isinstance(frame, Frame):
        raise ArgumentError(f"{name} must be a Frame, got {type(frame).__name__}")
    if frame.depth_m is None:
        raise ArgumentError(
            f"{name}, frame {frame.key}, has no depth; frames of a scene and of a clip with stereo "
            "or LiDAR have it"
        )
    depth_m = np.asarray(frame.depth_m, np.float64)
    if min(depth_m.shape) < MIN_SIZE_PX:
        raise ArgumentError(f"{name}: a picture of {depth_m.shape} is too small to sample")
    if not (depth_m > 0).all():
        raise ArgumentError(
            f"{name}, frame {frame.key}: depth must be above 0 m everywhere, `inf` for the sky; "
            "leave unmeasured pixels out with mask= and give them any positive depth"
        )
    return depth_m


def _checked_mask(mask: Any, shape: tuple[int, ...]) -> Mask:
    if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
        got = mask.dtype if isinstance(mask, np.ndarray) else type(mask).__name__
        raise ArgumentError(f"mask must be a bool array, True where to compare, got {got}")
    like_image("mask", mask, (shape[0], shape[1]))
    return mask


def _srgb(name: str, image: Any, shape: tuple[int, int]) -> Float64:
    """(H, W, 3) float64 in [0, 1]."""
    if not isinstance(image, np.ndarray):
        raise ArgumentError(f"{name} must be a numpy array, got {type(image).__name__}")
    if image.shape != (*shape, 3):
        raise ArgumentError(f"{name} must have its frame's shape {(*shape, 3)}, got {image.shape}")
    if image.dtype == np.uint8:
        return image / 255.0
    if image.dtype.kind != "f" or not ((image >= 0) & (image <= 1)).all():
        raise ArgumentError(f"{name} must be uint8, or float in [0, 1], got {image.dtype}")
    return np.asarray(image, np.float64)


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    array.flags.writeable = False
    return array
