"""A plain folder of pictures, with label and depth folders if there are any.

Convention:
    Every picture is a time step of one camera, "front", that stands `height_m` above flat ground
    and looks along it. The world is right-handed with x right, y down, z forward and its origin on
    the ground below the first picture's camera. Nothing is known about the motion: the camera
    stands still, and the pictures count as unrelated, each in its own light, unless
    `speed_m_per_s` says that they are a drive.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import finite
from weather_aug.clip.completion import completed, depth_jump, sharpened
from weather_aug.clip.images import read_image, read_label, read_only, resized_image, resized_label
from weather_aug.clip.prior import geometric_prior_depth
from weather_aug.clip.records import (
    checked_scale,
    chosen_indices,
    folder_at,
    folder_name,
    read_array,
    scaled_size,
    shown,
)
from weather_aug.clip.sky import sky_mask
from weather_aug.clip.types import Camera, Frame, FrameKey, check_key
from weather_aug.errors import ArgumentError, ClipError, printable
from weather_aug.taxonomy import SKY, TAXONOMIES
from weather_aug.taxonomy import taxonomy as taxonomy_called

Float32 = NDArray[np.float32]

CAMERA = "front"
EXPOSURE_S = 0.005
DEPTH_PNG_STEPS_PER_M = 256.0
MIN_DEPTH_M, MAX_DEPTH_M = 0.1, 1000.0

_PICTURES = (".png", ".jpg", ".jpeg")
_IMAGE_ENDINGS = ("_leftImg8bit", "_rgb_anon", "_rgb_ref_anon")
_LABEL_ENDINGS_BY_TAXONOMY = {
    "cityscapes": ("_gtFine_labelIds", "_gtCoarse_labelIds", "_gt_labelIds"),
    "train_ids": ("_gtFine_labelTrainIds", "_gtCoarse_labelTrainIds", "_gt_labelTrainIds"),
}
_OTHER_ENDINGS = (
    "_gtFine_color",
    "_gtFine_instanceIds",
    "_gtFine_instanceTrainIds",
    "_gtCoarse_color",
    "_gtCoarse_instanceIds",
    "_gt_labelColor",
    "_gt_invIds",
    "_gt_invGray",
)
_DEPTH_ENDINGS = ("_depth", "_disparity", "_leftImg8bit", "_rgb_anon")


class FolderClip:
    """Pictures of a folder, paired with labels and depth by relative path and stem.

    Endings of Cityscapes (_leftImg8bit, _gtFine_labelIds, _gtFine_labelTrainIds) and ACDC
    (_rgb_anon, _gt_labelTrainIds) are stripped before pairing. Depth comes from the depth folder if
    there is one, otherwise from the labels by `geometric_prior_depth`, otherwise it is None.

    Depth files are float .npy in metres (NaN, 0 and less unknown, `inf` sky) or 16-bit PNG in
    1/256 m (0 unknown, KITTI's convention). Unknown depth is sky where the label, or without label
    `sky_mask`, says so, and completed along the picture's edges elsewhere.

    Args:
        root: Folder that the others are relative to.
        images: Folder of the pictures, searched with its subfolders.
        labels: Folder of label PNGs, or None.
        depth: Folder of depth files, or None.
        taxonomy: What the label ids mean, see `weather_aug.taxonomy`. None takes it from the ending
            of the label files: "train_ids" of `labelTrainIds`, "cityscapes" of `labelIds`.
        frames: Which pictures to offer, by their order; None for all.
        scale: Everything is scaled down by this factor, in (0, 1].
        height_m: Height of the camera over the ground, metres.
        hfov_deg: Horizontal field of view, degrees; not used where `focal_px` is given.
        focal_px: Focal length in pixels of the unscaled picture, or None.
        pitch_deg: How far the camera looks down, degrees.
        speed_m_per_s: Forward speed of the camera that took the pictures one after another; None if
            they are unrelated.
        fps: Pictures a second.

    Raises:
        ClipError: If a folder is missing or empty, or a picture has no label or depth file.
        ArgumentError: If an option is outside what is accepted, or labels whose file names do not
            say what their ids mean are given without a taxonomy.
    """

    def __init__(
        self,
        root: str | os.PathLike[str],
        *,
        images: str = ".",
        labels: str | None = None,
        depth: str | None = None,
        taxonomy: str | None = None,
        frames: slice | None = None,
        scale: float = 1.0,
        height_m: float = 1.5,
        hfov_deg: float = 60.0,
        focal_px: float | None = None,
        pitch_deg: float = 0.0,
        speed_m_per_s: float | None = None,
        fps: float = 10.0,
    ) -> None:
        top = folder_at(root, "image folder")
        if taxonomy is None and labels is not None:
            taxonomy = _taxonomy_of(top / labels)
        self._taxonomy = None if taxonomy is None else taxonomy_called(taxonomy)
        self._scale = checked_scale(scale)
        self.camera_height_m = self._height_m = finite("height_m", height_m, 0.1, 100.0)
        self._hfov_rad = math.radians(finite("hfov_deg", hfov_deg, 5.0, 150.0))
        self._focal_px = None if focal_px is None else finite("focal_px", focal_px, 10.0, 1e5)
        self._pitch_rad = math.radians(finite("pitch_deg", pitch_deg, -30.0, 30.0))
        self.is_drive = speed_m_per_s is not None
        speed_m_per_s = 0.0 if speed_m_per_s is None else speed_m_per_s
        self._speed_m_per_s = finite("speed_m_per_s", speed_m_per_s, -100.0, 100.0)
        self._fps = finite("fps", fps, 1e-3, 1e4)
        self.name = folder_name("folder", top.resolve().name, "" if images == "." else images)
        self.cameras: tuple[str, ...] = (CAMERA,)
        self.up_world = read_only(np.array([0.0, -1.0, 0.0]))
        aside = [top / name for name in (labels, depth) if name is not None]
        picture_paths = _by_stem(top / images, _PICTURES, _IMAGE_ENDINGS, aside)
        stems = sorted(picture_paths)
        self._images = [picture_paths[stem] for stem in stems]
        self._labels = self._depths = None
        if labels is not None:
            endings = _LABEL_ENDINGS_BY_TAXONOMY.get(taxonomy or "", ())
            known = [e for group in _LABEL_ENDINGS_BY_TAXONOMY.values() for e in group]
            others = {*known, *_OTHER_ENDINGS} - set(endings)
            found = _by_stem(top / labels, (".png",), endings, (), skip=tuple(others))
            self._labels = _paired(picture_paths, stems, found, "label", top / labels)
        if depth is not None:
            found = _by_stem(top / depth, (".npy", ".png"), _DEPTH_ENDINGS, ())
            self._depths = _paired(picture_paths, stems, found, "depth file", top / depth)
        indices = chosen_indices(frames, len(stems))
        self.keys = tuple(FrameKey(index, CAMERA) for index in indices)

    def frame(self, key: FrameKey) -> Frame:
        """Read one picture with its label and depth; see `Clip.frame`."""
        key = check_key(self, key)
        index = key.time_index
        whole = read_image(self._images[index])
        height, width = whole.shape[:2]
        size = scaled_size(width, height, self._scale)
        image = resized_image(whole, *size)
        camera = self._camera(index, width, height).resized(*size)
        label = None
        if self._labels is not None:
            label = read_only(resized_label(self._label(self._labels[index], index, whole), *size))
        depth_m = self._depth(index, whole, image, label, camera)
        if depth_m is not None:
            depth_m = read_only(depth_m)
        return Frame(key, index / self._fps, camera, read_only(image), label, depth_m)

    def label(self, key: FrameKey) -> NDArray[np.uint8] | None:
        """(H, W) train ids of one picture, which is not read for it; None where nobody labelled."""
        index = check_key(self, key).time_index
        if self._labels is None:
            return None
        ids = self._train_ids(self._labels[index], read_label(self._labels[index]))
        return read_only(resized_label(ids, *scaled_size(ids.shape[1], ids.shape[0], self._scale)))

    def _camera(self, index: int, width: int, height: int) -> Camera:
        focal_px = self._focal_px or 0.5 * width / math.tan(0.5 * self._hfov_rad)
        intrinsics = [[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]]
        sine, cosine = math.sin(self._pitch_rad), math.cos(self._pitch_rad)
        forward_m = self._speed_m_per_s * index / self._fps
        world_from_camera = np.eye(4)
        world_from_camera[1:3, 1:3] = [[cosine, sine], [-sine, cosine]]
        world_from_camera[:3, 3] = (0.0, -self._height_m, forward_m)
        return Camera(
            np.array(intrinsics),
            world_from_camera,
            width,
            height,
            exposure_s=EXPOSURE_S,
            velocity_m_per_s=np.array([0.0, 0.0, self._speed_m_per_s]),
        )

    def _label(self, path: Path, index: int, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        ids = read_label(path)
        _like_picture(path, ids.shape, self._images[index], image)
        return self._train_ids(path, ids)

    def _train_ids(self, path: Path, ids: NDArray[np.integer]) -> NDArray[np.uint8]:
        assert self._taxonomy is not None, "labels have a taxonomy"
        return self._taxonomy.train_ids(ids, where=shown(path))

    def _depth(
        self,
        index: int,
        whole: NDArray[np.uint8],
        image: NDArray[np.uint8],
        label: NDArray[np.uint8] | None,
        camera: Camera,
    ) -> Float32 | None:
        if self._depths is not None:
            path = self._depths[index]
            metres = read_depth(path)
            _like_picture(path, metres.shape, self._images[index], whole)
            size = (camera.width, camera.height)
            metres = cv2.resize(metres, size, interpolation=cv2.INTER_NEAREST_EXACT)
            return _whole_depth(metres, image, label, camera.focal_px[1], path)
        if label is None:
            return None
        return geometric_prior_depth(
            label,
            focal_px=camera.focal_px[1],
            principal_px=camera.principal_px,
            camera_height_m=self._height_m,
            pitch_rad=self._pitch_rad,
        )


def read_depth(path: Path) -> Float32:
    """(H, W) float32 metres of a depth file; NaN where unknown, `inf` in the sky.

    Raises:
        ClipError: If the file is neither a (H, W) float .npy nor a 16-bit grey PNG.
    """
    if path.suffix.lower() == ".npy":
        metres = read_array(path)
        if metres.ndim != 2 or metres.dtype.kind != "f" or metres.size == 0:
            raise ClipError(
                f"{shown(path)} must be floats of shape (H, W), is {metres.dtype} {metres.shape}"
            )
        # The package's depth is float32; what does not fit is as far as the sky.
        with np.errstate(over="ignore"):
            narrow = metres.astype(np.float32)
        return np.where(narrow > 0, narrow, np.nan).astype(np.float32)
    steps = read_label(path)
    if steps.dtype != np.uint16:
        raise ClipError(f"{shown(path)} has 8 bits; depth PNGs have 16, in 1/256 m")
    metres = steps.astype(np.float32) / np.float32(DEPTH_PNG_STEPS_PER_M)
    return np.where(steps > 0, metres, np.nan).astype(np.float32)


def _whole_depth(
    metres: Float32,
    image: NDArray[np.uint8],
    label: NDArray[np.uint8] | None,
    focal_px: float,
    path: Path,
) -> Float32:
    """Replace unknown depth (NaN): sky where it is sky, completed elsewhere."""
    unknown = np.isnan(metres)
    if not unknown.any():
        return np.clip(metres, MIN_DEPTH_M, None)
    known = np.isfinite(metres)
    if not known.any():
        raise ClipError(f"{shown(path)} holds no finite depth; leave the depth folder out")
    looks_like_sky = sky_mask(image) if label is None else label == SKY
    sky = np.isinf(metres) | (unknown & looks_like_sky)
    inverse = np.where(known, 1 / np.where(known, metres, 1), 0).astype(np.float32)
    confidence = np.where(known, 100, 0).astype(np.float32)
    filled = completed(inverse, confidence, image, barrier=sky)
    filled = sharpened(filled, min_jump=depth_jump(focal_px))
    depth = np.where(known, metres, 1 / np.clip(filled, 1 / MAX_DEPTH_M, 1 / MIN_DEPTH_M))
    return np.where(sky, np.inf, np.maximum(depth, MIN_DEPTH_M)).astype(np.float32)


def _taxonomy_of(folder: Path) -> str:
    """The taxonomy that the endings of the label files tell; train ids where there are both."""
    files = folder_at(folder, "folder").rglob("*")
    stems = [path.stem for path in files if path.suffix.lower() == ".png"]
    for name in ("train_ids", "cityscapes"):
        if any(stem.endswith(_LABEL_ENDINGS_BY_TAXONOMY[name]) for stem in stems):
            return name
    if not stems:
        raise ClipError(f"{shown(folder)} holds no .png files; check the path")
    raise ArgumentError(
        f"the file names in {shown(folder)} do not say what the label ids mean; choose "
        f"taxonomy= from {', '.join(TAXONOMIES)}"
    )


def _by_stem(
    folder: Path,
    suffixes: tuple[str, ...],
    endings: Iterable[str],
    aside: Iterable[Path],
    skip: tuple[str, ...] = (),
) -> dict[str, Path]:
    """Files below `folder` by relative path without suffix and data-set ending."""
    folder_at(folder, "folder")
    others = [path.resolve() for path in aside if path.resolve() != folder.resolve()]
    found: dict[str, Path] = {}
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower() not in suffixes or path.stem.endswith(skip or ("\0",)):
            continue
        if any(path.resolve().is_relative_to(other) for other in others):
            continue
        stem = path.stem
        for ending in endings:
            stem = stem.removesuffix(ending)
        name = path.relative_to(folder).with_name(stem).as_posix()
        if name in found:
            raise ClipError(
                f"{shown(path)} and {shown(found[name])} have one name; keep one of them"
            )
        found[name] = path
    if not found:
        raise ClipError(f"{shown(folder)} holds no {' or '.join(suffixes)} files; check the path")
    return found


def _paired(
    pictures: dict[str, Path], stems: list[str], found: dict[str, Path], what: str, folder: Path
) -> list[Path]:
    missing = [stem for stem in stems if stem not in found]
    if missing:
        raise ClipError(
            f"{shown(pictures[missing[0]])} has no {what} in {shown(folder)} "
            f"({len(missing)} of {len(stems)} have none, {printable(missing[0])!r} first); add it, "
            "remove the picture, or check taxonomy= if the file has a data set's ending"
        )
    return [found[stem] for stem in stems]


def _like_picture(
    path: Path, shape: tuple[int, ...], image_path: Path, image: NDArray[np.uint8]
) -> None:
    if shape != image.shape[:2]:
        raise ClipError(
            f"{shown(path)} is {shape[1]}x{shape[0]}, its picture {shown(image_path)} is "
            f"{image.shape[1]}x{image.shape[0]}; they must have one size"
        )
