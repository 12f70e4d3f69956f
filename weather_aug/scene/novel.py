"""Frames that no camera took: a reconstructed drive from beside the way, at any moment."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import fields, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from weather_aug.clip.types import MAX_SPEED_M_PER_S, Box, Camera, Frame
from weather_aug.gaussians.actors import pose_at
from weather_aug.gaussians.draw import View, view
from weather_aug.gaussians.gather import Weights, camera_of
from weather_aug.gaussians.types import CLASSES, Actor, Gaussians, Reconstruction, Sky
from weather_aug.render.compose import RenderedFrame
from weather_aug.render.options import RenderOptions
from weather_aug.scene.backdrop import under_snow
from weather_aug.scene.viewpoint import Viewpoint, moved
from weather_aug.taxonomy import IGNORE
from weather_aug.weather import Weather

Float64 = NDArray[np.float64]
Mask = NDArray[np.bool_]
Poses = Mapping[int, ArrayLike]

PLANES = ("image", "depth", "label", "seen", "normals")
"""Of a novel frame; only the last can be done without."""
AT_ITS_TIME_S = 1e-3
"""A frame so near in time is the recorded moment."""


class NovelFrame(NamedTuple):
    """A frame drawn from Gaussians."""

    frame: Frame
    seen: Mask
    """(H, W): recorded frames showed what is there."""

    def masked(self) -> NovelFrame:
        """The same with the label 255 where nothing recorded tells what is there."""
        if self.frame.label is None:
            return self
        label = np.where(self.seen, self.frame.label, np.uint8(IGNORE))
        return self._replace(frame=replace(self.frame, label=label))


def novel_camera(
    reconstruction: Reconstruction,
    recorded: Frame,
    axes_world: Float64,
    viewpoint: Viewpoint | None,
) -> Camera:
    """The camera of a recorded frame, refined where it was, at a viewpoint; None is there."""
    return moved(camera_of(reconstruction, recorded), axes_world, viewpoint or Viewpoint())


def novel_frame(
    reconstruction: Reconstruction,
    recorded: Frame,
    camera: Camera,
    time_s: float,
    *,
    style: str | Weights | None = None,
    amount: float = 1.0,
    without: Collection[int] = (),
    poses: Poses | None = None,
    want: Collection[str] = PLANES,
) -> NovelFrame:
    """What `camera` would have taken at `time_s`, with the most likely label everywhere.

    Args:
        reconstruction: The drive.
        recorded: The frame whose exposure the picture has, and whose boxes nobody tracked further.
        camera: Any.
        time_s: In the clip's time.
        style: A weather's colours, or weights of several.
        amount: In 0..1, of the style.
        without: Track ids of actors to leave out.
        poses: (4, 4) `world_from_actor` by track id: actors put elsewhere.
        want: Which planes to draw, as of `gaussians.draw.view`; the first four are needed.

    Raises:
        ArgumentError: If a style or a track is unknown, or a number leaves its range.
    """
    key = recorded.key
    shown = view(
        reconstruction,
        camera,
        time_s,
        style=style,
        amount=amount,
        without=without,
        poses=poses,
        key=key if key in reconstruction.exposures else None,
        want=want,
    )
    seen = np.ones(shown.opacity.shape, bool) if shown.seen is None else shown.seen
    boxes = boxes_at(reconstruction.actors, recorded, time_s, without, poses or {})
    assert shown.image is not None
    label = None if shown.label is None else _guessed(shown.label, seen)
    frame = Frame(
        *(key, time_s, camera, shown.image, label),
        *(_stored_depth(shown), shown.normals_world, boxes),
    )
    return NovelFrame(frame, seen)


def _guessed(label: NDArray[np.uint8], seen: Mask) -> NDArray[np.uint8]:
    """The label with the nearest pixel's class where nothing was seen and no class is known."""
    known = label != IGNORE
    blank = ~known & ~seen
    if not blank.any() or not known.any():
        return label
    _, nearest = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    class_by_seed = np.zeros(int(nearest.max()) + 1, np.uint8)
    class_by_seed[nearest[known]] = label[known]
    return np.where(blank, class_by_seed[nearest], label)


def _stored_depth(shown: View) -> NDArray[np.float16]:
    """As a scene stores it, so that kernels need not be compiled for another type."""
    assert shown.depth_m is not None
    with np.errstate(over="ignore"):
        return shown.depth_m.astype(np.float16)


def boxes_at(
    actors: Sequence[Actor],
    recorded: Frame,
    time_s: float,
    without: Collection[int],
    poses: Poses,
) -> tuple[Box, ...]:
    """Boxes of what is there: first all that was recorded and is no actor, then the actors.

    An actor's velocity is the recorded box's at its moment, else its track's; of one put elsewhere
    it turns with it.
    """
    tracks = {actor.track_id for actor in actors}
    standing = [box for box in recorded.boxes if box.track_id not in tracks]
    moving = [
        _box_of(actor, recorded, time_s, poses.get(actor.track_id))
        for actor in actors
        if actor.track_id not in without
    ]
    return (*standing, *(box for box in moving if box is not None))


def _box_of(actor: Actor, recorded: Frame, time_s: float, put: ArrayLike | None) -> Box | None:
    pose = pose_at(actor, time_s)
    velocity = None if pose is None else _velocity_of(actor, recorded, time_s)
    if put is not None:
        there = np.asarray(put, np.float64)
        if pose is not None and velocity is not None:
            velocity = there[:3, :3] @ pose[:3, :3].T @ velocity
        pose = there
    if pose is None:
        return None
    return Box(actor.track_id, actor.class_name, pose, actor.size_m, velocity)


def _velocity_of(actor: Actor, recorded: Frame, time_s: float) -> Float64 | None:
    """(3,) m/s of an actor in the world; None where neither box nor track tell."""
    if abs(time_s - recorded.time_s) <= AT_ITS_TIME_S:
        for box in recorded.boxes:
            if box.track_id == actor.track_id:
                return box.velocity_m_per_s
    times_s, places = actor.times_s, actor.world_from_actor[:, :3, 3]
    before = max(int(np.searchsorted(times_s, time_s, side="left")) - 1, 0)
    after = min(int(np.searchsorted(times_s, time_s, side="right")), len(times_s) - 1)
    if before >= after:
        return None
    velocity = (places[after] - places[before]) / (times_s[after] - times_s[before])
    return velocity if np.linalg.norm(velocity) <= MAX_SPEED_M_PER_S else None


def honest(
    shot: RenderedFrame, novel: NovelFrame, lying: Weather, options: RenderOptions
) -> RenderedFrame:
    """The render of a novel frame with what its label cannot claim.

    Args:
        shot: In the weather, by `carried_options` if the frame shows a style.
        novel: What was rendered: dressed by the most likely labels, so that no seam shows where
            the recorded frames end.
        lying: What lies on the ground in the frame's style; see `lying_in`.
        options: As they were asked for, not `carried_options`.
    """
    shot = under_snow(shot, novel.frame, lying, options)
    top, left, height, width = shot.window
    unseen = ~novel.seen[top : top + height, left : left + width]
    label, full = shot.label, shot.label_full
    invalid = shot.invalid | unseen
    if label is not None and full is not None:
        label, full = (np.where(unseen, np.uint8(IGNORE), plane) for plane in (label, full))
    frame = novel.masked().frame
    return replace(shot, label=label, label_full=full, invalid=invalid, frame=frame)


def warm_up() -> None:
    """Compile or load what draws Gaussians now, before worker processes are started."""
    point = Gaussians(
        np.array([[0.0, 0.0, 5.0]], np.float32),
        np.array([[1.0, 0.0, 0.0, 0.0]], np.float32),
        np.zeros((1, 3), np.float32),
        np.zeros(1, np.float32),
        np.zeros((1, 1, 3), np.float32),
        np.ones((1, CLASSES), np.float16),
    )
    none = Gaussians(*(getattr(point, field.name)[:0] for field in fields(Gaussians)))
    sky = Sky(np.zeros((6, 2, 2, 3), np.float32), np.ones((6, 2, 2), np.bool_))
    camera = Camera(np.array([[16.0, 0, 8], [0, 16, 8], [0, 0, 1]]), np.eye(4), 16, 16)
    owners, offsets = np.zeros(0, np.int32), np.zeros((0, 0, 3), np.float32)
    support = np.ones(1, np.float32)
    one = Reconstruction(point, sky, (), none, owners, offsets, {}, {}, {}, support)
    view(one, camera, 0.0)
