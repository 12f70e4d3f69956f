"""Picture, depth, label and normals of a reconstructed drive from anywhere in it."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from weather_aug.clip.types import Camera, FrameKey
from weather_aug.errors import ArgumentError, printable
from weather_aug.gaussians.gather import (
    Gathered,
    Weights,
    exposure_of,
    gather,
    rasterised,
    sky_of,
)
from weather_aug.gaussians.rasterise import NEAR_M, Drawn
from weather_aug.gaussians.rotations import matrices_of
from weather_aug.gaussians.sky import sky_picture
from weather_aug.gaussians.types import Float32, Pinhole, Reconstruction, Sky
from weather_aug.taxonomy import IGNORE, SKY

FIELDS = ("image", "depth", "label", "seen", "normals")
SURFACE_OPACITY = 0.5
"""Below it a pixel shows the sky rather than a surface."""
CLEAR_SCORE = 0.4
"""A class that less of a pixel votes for is not named."""
LEAST_FLATNESS = 0.1
MAX_LOOKERS = 48
SUPPORT_PX = 1.0
"""A Gaussian that made up fewer pixels of all recorded frames together was not seen."""


class View(NamedTuple):
    """What a camera sees of a reconstructed drive; fields nobody asked for are None."""

    opacity: Float32
    """(H, W) in 0..1: how much of the pixel is Gaussians; the rest is sky."""
    image: NDArray[np.uint8] | None
    """(H, W, 3) sRGB."""
    depth_m: Float32 | None
    """(H, W) z-depth, `inf` where sky is."""
    label: NDArray[np.uint8] | None
    """(H, W) train ids, 255 where no class is clear or the sky was never seen; None as well if the
    reconstruction has no class scores."""
    seen: NDArray[np.bool_] | None
    """(H, W): recorded frames showed what is here; None as well without `support`."""
    normals_world: Float32 | None
    """(H, W, 3) unit normals in world axes, turned to the camera; zero where no surface is."""


def view(
    reconstruction: Reconstruction,
    camera: Camera,
    time_s: float,
    *,
    style: str | Weights | None = None,
    amount: float = 1.0,
    without: Collection[int] = (),
    poses: Mapping[int, ArrayLike] | None = None,
    key: FrameKey | None = None,
    want: Collection[str] = FIELDS,
    threads: int = 1,
) -> View:
    """Look at a drive at `time_s` through `camera`, wherever it stands.

    A surface counts as seen if recorded frames showed it, from the same side.

    Args:
        reconstruction: The drive.
        camera: Any.
        time_s: Moment, in the clip's time; it places the actors.
        style: A weather's colours, as of `gather`.
        amount: In 0..1, of the style.
        without: Track ids of actors to leave out.
        poses: (4, 4) by track id: actors put elsewhere.
        key: A frame whose exposure, or that of its camera's recorded frame nearest in time, to
            apply to the image; the scene's own colours if None.
        want: Which of `FIELDS` to draw; each costs time.
        threads: Of the rasteriser. The result does not depend on it.

    Raises:
        ArgumentError: If a style, track, field or frame is unknown, or a number leaves its range.
    """
    wanted = _known_fields(want)
    exposure = None if key is None else exposure_of(reconstruction, key)
    with torch.no_grad():
        gathered = gather(
            reconstruction,
            time_s,
            style=style,
            amount=amount,
            without=without,
            poses=poses,
            origin_m=camera.centre_world,
            colours="image" in wanted,
            labels="label" in wanted,
        )
        planes = _planes(reconstruction, camera, gathered, wanted)
        drawn, parts = _drawn(gathered, camera, planes, threads)
    opacity = drawn.opacity.numpy()
    through = np.float32(1) - opacity
    image = depth_m = label = seen = normals = None
    if "image" in wanted:
        sky = sky_of(reconstruction, style, amount)
        behind = _behind(sky.faces, camera, through)
        image = _bytes(parts["image"] + through[..., None] * behind, exposure)
    if "depth" in wanted:
        depth_m = np.where(opacity >= SURFACE_OPACITY, drawn.depth_m.numpy(), np.float32(np.inf))
    if parts.keys() & {"label", "seen"}:
        # Sky that no frame showed is no known class.
        was_seen = np.repeat(reconstruction.sky.seen[..., None], 3, axis=3)
        known_sky = through * _behind(was_seen, camera, through)[..., 0]
    if "label" in parts:
        label = _label(parts["label"], _claimed(gathered.class_scores), known_sky)
    if "seen" in parts:
        seen = parts["seen"][..., 0] + known_sky >= 0.5
    if "normals" in wanted:
        normals = _unit(parts["normals"], opacity)
    return View(opacity, image, depth_m, label, seen, normals)


def facings(reconstruction: Reconstruction) -> Float32:
    """(N, 3) for each of the background's Gaussians, towards where it was recorded from.

    A camera sees the same side of it if the way there has a positive product with this vector.
    Zero where no recorded camera looked, so that nothing is known.

    The vector is Σ⁻¹ d: d is the mean direction to those recorded cameras in whose pictures the
    Gaussian's centre lies, and Σ its covariance, so that of a flat one the side counts and of a
    round one the hemisphere. A camera's share is 1/distance², as that of its pixels. What stood in
    between is not looked at.
    """
    known = _FACINGS.get(reconstruction)
    if known is None:
        known = _FACINGS[reconstruction] = _facings(reconstruction)
    return known


_FACINGS: WeakKeyDictionary[Reconstruction, Float32] = WeakKeyDictionary()
"""They take half a second for 300,000 Gaussians and are the same for every view."""


def _facings(reconstruction: Reconstruction) -> Float32:
    background = reconstruction.background
    means = torch.from_numpy(np.array(background.means_m, np.float32))
    cameras = list(reconstruction.cameras.values())
    # A drive's cameras lie close together; these few look at all that the rest look at.
    picked = np.unique(np.linspace(0, len(cameras) - 1, min(len(cameras), MAX_LOOKERS)).round())
    total = torch.zeros_like(means)
    for camera in (cameras[int(index)] for index in picked):
        towards = torch.from_numpy(camera.centre_world.astype(np.float32)) - means
        pixels_from_world = camera.intrinsics @ camera.world_from_camera[:3, :3].T
        x, y, z = (-towards @ torch.from_numpy(pixels_from_world.T.astype(np.float32))).unbind(1)
        inside = (z > NEAR_M) & (x > -0.5 * z) & (x < (camera.width - 0.5) * z)
        inside &= (y > -0.5 * z) & (y < (camera.height - 0.5) * z)
        distance = towards.norm(dim=1).clamp_min(NEAR_M)
        total += torch.where(inside, distance**-3, 0.0)[:, None] * towards
    axes = _axes(torch.from_numpy(np.array(background.quaternions, np.float32)))
    scales = torch.from_numpy(np.exp(background.log_scales, dtype=np.float32))
    # A fitted sheet is never as flat as its thinnest axis; its edge would decide by chance.
    widest = scales.amax(dim=1, keepdim=True)
    inverse = 1 / (scales**2 + (LEAST_FLATNESS * widest) ** 2)
    local = inverse * torch.einsum("nij,ni->nj", axes, total)
    return (widest * torch.einsum("nij,nj->ni", axes, local)).numpy()


def _planes(
    reconstruction: Reconstruction, camera: Camera, gathered: Gathered, wanted: Collection[str]
) -> dict[str, Tensor]:
    """What to blend, (R, C) by field; a field that cannot be drawn is not among them."""
    planes = {}
    if "image" in wanted:
        planes["image"] = gathered.colours_seen(camera.centre_world)
    if gathered.class_scores.shape[1]:
        planes["label"] = gathered.class_scores[:, _claimed(gathered.class_scores)]
    if "seen" in wanted and len(reconstruction.support):
        planes["seen"] = _same_side(reconstruction, gathered)[:, None]
    if "normals" in wanted:
        planes["normals"] = _normals(gathered)
    return planes


def _claimed(class_scores: Tensor) -> NDArray[np.intp]:
    """Train ids that any Gaussian has, and the sky's."""
    is_claimed = (class_scores.amax(dim=0) > 0).numpy()
    is_claimed[SKY] = True
    return np.flatnonzero(is_claimed)


def _same_side(reconstruction: Reconstruction, gathered: Gathered) -> Tensor:
    """(R,) 1 for Gaussians whose side towards the camera, at the origin, was recorded, else 0."""
    count = len(reconstruction.background)
    supported = torch.from_numpy(reconstruction.support >= SUPPORT_PX)
    facing = torch.from_numpy(facings(reconstruction))
    product = -(gathered.means_m[:count] * facing).sum(dim=1)
    unknown = (facing == 0).all(dim=1)
    # What is known of actors' Gaussians is that a recorded frame made them.
    seen = torch.ones(len(gathered.means_m))
    seen[:count] = (supported & ((product > 0) | unknown)).float()
    return seen


def _normals(gathered: Gathered) -> Tensor:
    """(R, 3) shortest axes, turned to the camera, which is at the origin."""
    axes = _axes(gathered.quaternions)
    shortest = gathered.scales_m.argmin(dim=1)
    normals = axes.gather(2, shortest[:, None, None].expand(-1, 3, 1))[..., 0]
    away = (normals * gathered.means_m).sum(dim=1, keepdim=True) > 0
    return torch.where(away, -normals, normals)


def _axes(quaternions: Tensor) -> Tensor:
    """(R, 3, 3), the Gaussians' axes as columns."""
    return matrices_of(torch.nn.functional.normalize(quaternions, dim=1))


def _drawn(
    gathered: Gathered, camera: Camera, planes: Mapping[str, Tensor], threads: int
) -> tuple[Drawn, dict[str, Float32]]:
    """One pass over all planes, and the picture of each field, (H, W, C)."""
    # Depth and opacity come with any channel.
    stacked = torch.cat([*planes.values()], dim=1) if planes else gathered.opacities[:, None]
    drawn = rasterised(gathered, camera, stacked, threads)
    sizes = [plane.shape[1] for plane in planes.values()]
    parts = torch.split(drawn.colours, sizes, dim=2) if planes else ()
    return drawn, {name: part.numpy() for name, part in zip(planes, parts, strict=True)}


def _behind(faces: NDArray[Any], camera: Camera, through: Float32) -> Float32:
    """(H, W, 3) of a cube map behind a picture; 0 where not half a level would come through."""
    sky = Sky(faces, np.ones(faces.shape[:3], bool))
    return sky_picture(sky, Pinhole.of(camera), camera.world_from_camera, through > 1 / 512)


def _label(shares: Float32, ids: NDArray[np.intp], sky: Float32) -> NDArray[np.uint8]:
    """Classes that claim most of their pixels; the light of the sky claims for the sky."""
    shares[..., np.searchsorted(ids, SKY)] += sky
    best, place = torch.from_numpy(shares).max(dim=2)
    label = ids.astype(np.uint8)[place.numpy()]
    label[best.numpy() < CLEAR_SCORE] = IGNORE
    return label


def _unit(normals: Float32, opacity: Float32) -> Float32:
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    is_surface = (opacity[..., None] >= SURFACE_OPACITY) & (length > 1e-6)
    return np.where(is_surface, normals / np.maximum(length, 1e-6), np.float32(0))


def _bytes(image: Float32, exposure: Float32 | None) -> NDArray[np.uint8]:
    if exposure is not None:
        image = image @ exposure[:, :3].T + exposure[:, 3]
    return np.rint(np.clip(image, 0, 1) * np.float32(255)).astype(np.uint8)


def _known_fields(want: Collection[str]) -> frozenset[str]:
    unknown = {want} if isinstance(want, str) else set(want) - set(FIELDS)
    if unknown:
        raise ArgumentError(
            f"want must be a collection out of {FIELDS}, got {printable(sorted(unknown)[0])!r}"
        )
    return frozenset(want)
