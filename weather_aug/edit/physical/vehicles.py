"""Which vehicles are on the street: from tracked boxes, else from their pixels and the depth.

What nobody tracked is guessed from one picture, and only where the guess is safe: a whole vehicle
that stands on the road before a camera that looks along it. The rest is left out, because lamps and
spray in a wrong place are worse than none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import finite, like_image
from weather_aug._keys import key_of
from weather_aug.clip.types import Box, Frame
from weather_aug.errors import ArgumentError
from weather_aug.taxonomy import TRAIN_ID

Float64 = NDArray[np.float64]
UInt8 = NDArray[np.uint8]

RANGE_M = 120.0
"""Vehicles farther away are left out."""
GUESS_RANGE_M = 60.0
"""Without boxes: farther away a street's bends undo the guess."""
STANDING_M_PER_S = 1.0
LANE_HALF_M = 2.2
"""Who is no farther than this beside the camera's way drives, or waits, in its lane."""
ONCOMING_M = 5.0
"""Without boxes: on the side of the oncoming lane as far as this, somebody comes."""
SIDEWAYS_COSINE = 0.8
"""A heading more than 37 degrees off the street crosses it."""
STEP_PX = 4
"""Without boxes the class map is looked at in every fourth row and column."""
LEAST_SIDES = (4, 4)
"""Rows and columns of that grid which a vehicle must fill."""
LEAST_FILL = 0.55
"""Share of its rectangle that a whole vehicle fills."""
LEAST_WIDTH = 0.6
"""Share of a vehicle's width that must be seen."""
DEPTH_JUMP = 0.15
"""Relative step of the depth at which one vehicle ends and the next one begins."""
FOOTING_M, FOOTING_SHARE = 0.5, 0.015
"""How far the lowest row may be off the road: this plus this share of its distance."""
LANE_M, PLACE_M = 3.5, 24.0
"""Without boxes: what is in the same cell of this size is taken for the same vehicle."""
SIDE_ALLOWANCE_M = 0.9
"""A rectangle wider than a vehicle along the street by more than this shows one across it."""

_SIZES_M = {"car": (4.4, 1.8, 1.5), "truck": (7.5, 2.4, 3.2), "bus": (11.0, 2.5, 3.1)}
"""Length, width, height where no box tells them."""
_ALIASES = {"caravan": "bus", "rv": "bus", "van": "car", "coach": "bus", "lorry": "truck"}
_LARGE = frozenset({"truck", "bus"})


@dataclass(frozen=True, eq=False)
class Vehicle:
    """A car, lorry or bus on the street at one moment; arrays are read-only, world axes, metres."""

    kind: str
    """"car", "truck" or "bus"."""
    centre_world: Float64
    """(3,) on the ground, below the middle."""
    heading_world: Float64
    """(3,) unit vector from its rear to its front."""
    size_m: tuple[float, float, float]
    """Length, width, height."""
    velocity_m_per_s: Float64
    """(3,) of its centre."""
    parked: bool
    """Whether nobody drives it, or nothing tells which way: it has neither lamps nor spray."""
    key: int
    """What draws about it are keyed by: in every frame and camera the same where it is tracked;
    else of its coarse place, which a vehicle may leave for the next one."""

    @property
    def is_large(self) -> bool:
        """Whether it is a lorry or a bus."""
        return self.kind in _LARGE


def vehicles_of(
    frame: Frame,
    classes: UInt8 | None,
    axes_world: Float64,
    camera_height_m: float,
    *,
    left_hand_traffic: bool = False,
) -> tuple[Vehicle, ...]:
    """Vehicles on the street around a camera, in the order of their boxes or pixels.

    From the frame's boxes if it has any; they hide nothing, so that all cameras of a moment get the
    same vehicles. Else from the connected car, lorry and bus pixels: distance from the depth, width
    from the columns, and from the place beside the camera's way who drives along, who comes and who
    is parked. A lorry or car across the street counts as parked.

    Args:
        frame: Boxes, or depth; its camera's velocity is the way the camera goes.
        classes: (H, W) train ids for frames without boxes; None finds nothing there.
        axes_world: (3, 3) rows along the street, to the left, up; unit vectors in world axes.
        camera_height_m: Of the camera over the road, metres, in [0.1, 10].
        left_hand_traffic: Whether those who come are on the right.

    Raises:
        ArgumentError: If the axes are not (3, 3), the classes are not uint8 of the picture's shape,
            or the height is out of range.
    """
    axes_world = np.asarray(axes_world, np.float64)
    if axes_world.shape != (3, 3):
        raise ArgumentError(f"axes_world must be (3, 3), got {axes_world.shape}")
    camera_height_m = finite("camera_height_m", camera_height_m, 0.1, 10.0)
    way = _way_of(frame, axes_world)
    if frame.boxes:
        found = (_from_box(box, frame, way) for box in frame.boxes)
        return tuple(vehicle for vehicle in found if vehicle is not None)
    if classes is None or frame.depth_m is None:
        return ()
    like_image("classes", classes, (frame.camera.height, frame.camera.width))
    if classes.dtype != np.uint8:
        raise ArgumentError(f"classes must be uint8 train ids, got {classes.dtype}")
    return _from_pixels(frame, classes, way, camera_height_m, 1.0 if left_hand_traffic else -1.0)


class _Way(NamedTuple):
    """Where the camera goes: level unit vectors in world axes, and its level speed."""

    ahead: Float64
    left: Float64
    up: Float64
    speed_m_per_s: float


def _way_of(frame: Frame, axes_world: Float64) -> _Way:
    up = axes_world[2]
    velocity = frame.camera.velocity_m_per_s
    level = velocity - (velocity @ up) * up
    speed = float(np.linalg.norm(level))
    # Of a rig that stands only the street's first heading is known.
    ahead = level / speed if speed > STANDING_M_PER_S else axes_world[0]
    return _Way(ahead, np.cross(up, ahead), up, speed)


def kind_of(class_name: str) -> str | None:
    """Which kind of vehicle a data set's class is: "car", "truck" or "bus"; None for others."""
    words = class_name.lower().replace("/", " ").replace("_", " ").replace(".", " ").split()
    for word in words:
        word = _ALIASES.get(word, word)
        if word in _SIZES_M:
            return word
    return None


def _from_box(box: Box, frame: Frame, way: _Way) -> Vehicle | None:
    kind = kind_of(box.class_name)
    if kind is None:
        return None
    centre = box.world_from_box[:3, 3] - 0.5 * box.size_m[2] * way.up
    offset = centre - frame.camera.centre_world
    heading = _level(box.world_from_box[:3, 0], way.up)
    if heading is None or float(np.linalg.norm(offset)) > RANGE_M:
        return None
    along = float(heading @ way.ahead)
    in_lane = along > SIDEWAYS_COSINE and abs(float(offset @ way.left)) <= LANE_HALF_M
    if box.velocity_m_per_s is None:
        parked = not in_lane and along > -SIDEWAYS_COSINE
        velocity = np.zeros(3) if parked else way.speed_m_per_s * heading
    else:
        velocity = box.velocity_m_per_s
        # Who waits in the camera's lane has its lamps on; who stands elsewhere is parked.
        parked = not in_lane and float(np.linalg.norm(velocity)) < STANDING_M_PER_S
    key = key_of("vehicle-track", box.track_id) & _KEY_BITS
    return Vehicle(kind, _shared(centre), heading, box.size_m, _shared(velocity), parked, key)


_KEY_BITS = 2**64 - 1


def _level(vector: Float64, up: Float64) -> Float64 | None:
    """Unit vector of the level part; None of what stands upright."""
    level = vector - (vector @ up) * up
    length = float(np.linalg.norm(level))
    return _shared(level / length) if length > 0.3 else None


def _shared(array: Float64) -> Float64:
    array = np.array(array, np.float64)
    array.flags.writeable = False
    return array


class _Blob(NamedTuple):
    """Connected pixels of one kind; edges in whole pixels of the picture."""

    kind: str
    left: float
    right: float
    bottom: float
    depth_m: float


def _from_pixels(
    frame: Frame, classes: UInt8, way: _Way, camera_height_m: float, side: float
) -> tuple[Vehicle, ...]:
    camera_axes = frame.camera.world_from_camera[:3, :3].T
    # Seen from the side nothing tells which way a vehicle drives.
    if float((camera_axes @ way.ahead)[2]) < SIDEWAYS_COSINE:
        return ()
    found = (_from_blob(blob, frame, way, camera_height_m, side) for blob in _blobs(frame, classes))
    return tuple(vehicle for vehicle in found if vehicle is not None)


def _blobs(frame: Frame, classes: UInt8) -> list[_Blob]:
    """Whole vehicles, by kind and in the order of their pixels."""
    sampled = classes[::STEP_PX, ::STEP_PX]
    depth = np.asarray(frame.depth_m)[::STEP_PX, ::STEP_PX]
    blobs: list[_Blob] = []
    for kind in _SIZES_M:
        mask = sampled == TRAIN_ID[kind]
        if not mask.any():
            continue
        # Only the rows and columns that hold the kind are looked at closely.
        rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
        part = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
        shape = mask.shape
        blobs += _blobs_of(kind, mask[part], depth[part], (int(rows[0]), int(columns[0])), shape)
    return blobs


def _blobs_of(
    kind: str,
    mask: NDArray[np.bool_],
    depth: NDArray[Any],
    corner: tuple[int, int],
    shape: tuple[int, ...],
) -> list[_Blob]:
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        log_depth = np.log(depth.astype(np.float32))
        known = mask & np.isfinite(log_depth)
        # A pixel before a step belongs to nobody, so that two cars in a row are two.
        known[:, :-1] &= ~(np.abs(np.diff(log_depth, axis=1)) > DEPTH_JUMP)
        known[:-1] &= ~(np.abs(np.diff(log_depth, axis=0)) > DEPTH_JUMP)
    _, names, stats, _ = cv2.connectedComponentsWithStats(known.astype(np.uint8), connectivity=4)
    blobs = []
    for name, (left, top, width, height, area) in enumerate(stats.tolist()):
        cut = (
            corner[1] + left == 0
            or corner[1] + left + width == shape[1]
            or corner[0] + top + height == shape[0]
        )
        small = height < LEAST_SIDES[0] or width < LEAST_SIDES[1]
        if name == 0 or cut or small or area < LEAST_FILL * width * height:
            continue
        inside = (slice(top, top + height), slice(left, left + width))
        depths_m = depth[inside][names[inside] == name].astype(np.float64)
        first, start = top + corner[0], left + corner[1]
        edges = (STEP_PX * start, STEP_PX * (start + width), STEP_PX * (first + height))
        # The nearest fifth: the face that looks at the camera, not the roof and the side behind.
        near_m = float(np.quantile(depths_m, 0.2))
        blobs.append(_Blob(kind, *edges, near_m))
    return blobs


def _from_blob(
    blob: _Blob, frame: Frame, way: _Way, camera_height_m: float, side: float
) -> Vehicle | None:
    """The vehicle that a blob shows, None where it does not stand whole on the road.

    `side` is -1 for right-hand traffic, 1 for left-hand.
    """
    camera = frame.camera
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    rotation, near_m = camera.world_from_camera[:3, :3], blob.depth_m
    if not 1.0 < near_m < GUESS_RANGE_M:
        return None
    # The grid's rectangle ends somewhere between two of its lines: half a step off on average.
    left, right, bottom = blob.left - 0.5, blob.right - 0.5 - STEP_PX / 2, blob.bottom - STEP_PX / 2
    ends = [
        rotation @ (near_m * np.array([(u - cx) / fx, (bottom - cy) / fy, 1.0]))
        for u in (left, right)
    ]
    foot_m = float(ends[0] @ way.up) + camera_height_m
    if abs(foot_m) > FOOTING_M + FOOTING_SHARE * near_m:
        return None
    length, width, height = _SIZES_M[blob.kind]
    edges_m = sorted(float(end @ way.left) for end in ends)
    aside_m = _middle_aside(edges_m, width)
    distance_m = float(0.5 * (ends[0] + ends[1]) @ way.ahead)
    shown_side_m = max(abs(aside_m) - 0.5 * width, 0.0) * length / (near_m + length)
    seen_m = edges_m[1] - edges_m[0]
    if seen_m < LEAST_WIDTH * width:
        # Something hides a part of it: neither its place nor its side is known.
        return None
    across = seen_m > width + shown_side_m + SIDE_ALLOWANCE_M
    along = _direction(aside_m * -side, across)
    heading = way.ahead if along >= 0 else -way.ahead
    middle = (distance_m + 0.5 * length) * way.ahead + aside_m * way.left
    centre = camera.centre_world + middle - camera_height_m * way.up
    velocity = along * way.speed_m_per_s * way.ahead
    size_m = (length, width, height)
    key = _key_of_place(along, distance_m, aside_m, centre, way)
    return Vehicle(
        blob.kind, _shared(centre), _shared(heading), size_m, _shared(velocity), along == 0, key
    )


def _middle_aside(edges_m: list[float], width_m: float) -> float:
    """How far to the left the middle of the near face is.

    The rectangle's edge away from the camera's way belongs to the near face, the other one may show
    the side; a vehicle straight ahead shows its face alone.
    """
    low, high = edges_m
    if low > 0:
        return max(high - 0.5 * width_m, 0.5 * (low + high))
    if high < 0:
        return min(low + 0.5 * width_m, 0.5 * (low + high))
    return 0.5 * (low + high)


def _direction(aside_m: float, across: bool) -> int:
    """1 for who drives along, -1 for who comes, 0 for who is parked or crosses.

    `aside_m` counts towards the lane of those who come.
    """
    if across or aside_m < -LANE_HALF_M or aside_m > ONCOMING_M:
        return 0
    return 1 if aside_m <= LANE_HALF_M else -1


def _key_of_place(
    along: int, distance_m: float, aside_m: float, centre_world: Float64, way: _Way
) -> int:
    """Key of a vehicle that nobody tracks, by a place it keeps for as long as may be.

    Who drives along keeps its distance to the camera; who comes or stands is near one place of the
    world for the second or two in which it passes.
    """
    if along > 0:
        lane, gap = math.floor(aside_m / LANE_M + 0.5), math.floor(distance_m / 12.0)
        return key_of("vehicle-ahead", lane, gap) & _KEY_BITS
    level = centre_world - (centre_world @ way.up) * way.up
    cells = (math.floor(float(place) / PLACE_M + 0.5) for place in level)
    return key_of("vehicle-place", along + 1, *cells) & _KEY_BITS
