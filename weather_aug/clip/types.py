"""Clip, Frame, Camera, Box: a recorded drive in memory, frozen.

Convention:
    Cameras are pinhole with OpenCV axes (x right, y down, z forward) and pixel centres at integer
    coordinates. The world is right-handed, in metres; its up direction is a unit vector of the
    clip, never assumed to be an axis. `a_from_b` maps coordinates of b to coordinates of a.
    Images are (H, W, 3) uint8 RGB (sRGB). Labels are (H, W) uint8 Cityscapes train ids, 255 is
    ignore. Depth is (H, W), the distance along the optical axis (z, not the ray length) in metres;
    `inf` is the sky and everything beyond measure. Arrays handed out are read-only.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import MAX_PIXELS
from weather_aug.errors import CalibrationError, ClipError, DataError, printable

Float64 = NDArray[np.float64]
Window = tuple[int, int, int, int]
"""(top, left, height, width) of a part of a picture, pixels."""

RIGID_TOLERANCE = 1e-4
MAX_SPEED_M_PER_S = 150.0
MAX_TURNING_RAD_PER_S = 6.0
FAR_DEPTH_M = 60000.0
"""float16 ends here; a greater depth is the sky or beyond measure."""


class FrameKey(NamedTuple):
    """Which picture of a clip: the time step and the camera."""

    time_index: int
    camera: str

    def __str__(self) -> str:
        return f"{self.time_index:06d}_{self.camera}"


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated pinhole camera at one moment; see the module's Convention.

    Raises:
        CalibrationError: If the intrinsics are singular, the focal length is not positive, the pose
            is not a finite rigid motion (to 1e-4), or the motion is faster than a car's.
    """

    intrinsics: Float64
    """(3, 3), pixels."""
    world_from_camera: Float64
    """(4, 4), metres."""
    width: int
    height: int
    exposure_s: float = 0.005
    """How long the shutter is open, seconds; it sets the length and opacity of streaks."""
    aperture_m: float = 0.0015
    """Diameter of the entrance pupil, metres; it sets the blur of particles near the lens."""
    velocity_m_per_s: Float64 = field(default_factory=lambda: np.zeros(3))
    """(3,), of the camera centre, in world axes."""
    angular_velocity_rad_per_s: Float64 = field(default_factory=lambda: np.zeros(3))
    """(3,), in camera axes."""

    def __post_init__(self) -> None:
        for name, shape in _CAMERA_SHAPES.items():
            object.__setattr__(self, name, _frozen_array(name, getattr(self, name), shape))
        if not (self.width > 0 and self.height > 0 and self.width * self.height <= MAX_PIXELS):
            raise CalibrationError(f"camera size {self.width}x{self.height} is not usable")
        if not (np.isfinite(self.exposure_s) and 0 < self.exposure_s <= 1):
            raise CalibrationError(f"exposure_s must be in (0, 1] s, got {self.exposure_s!r}")
        if not (np.isfinite(self.aperture_m) and 0 <= self.aperture_m <= 0.1):
            raise CalibrationError(f"aperture_m must be in [0, 0.1] m, got {self.aperture_m!r}")
        speed = float(np.linalg.norm(self.velocity_m_per_s))
        turning = float(np.linalg.norm(self.angular_velocity_rad_per_s))
        if speed > MAX_SPEED_M_PER_S or turning > MAX_TURNING_RAD_PER_S:
            raise CalibrationError(
                f"the camera moves at {speed:.3g} m/s and turns at {turning:.3g} rad/s, as no car "
                "does; look for a jump in the poses or times"
            )
        _check_intrinsics(self.intrinsics)
        _check_rigid("world_from_camera", self.world_from_camera)

    @property
    def centre_world(self) -> Float64:
        """(3,) position of the camera, metres."""
        return self.world_from_camera[:3, 3]

    @property
    def focal_px(self) -> tuple[float, float]:
        """Focal lengths (fx, fy), pixels."""
        return float(self.intrinsics[0, 0]), float(self.intrinsics[1, 1])

    @property
    def principal_px(self) -> tuple[float, float]:
        """Principal point (cx, cy), pixels."""
        return float(self.intrinsics[0, 2]), float(self.intrinsics[1, 2])

    def resized(self, width: int, height: int) -> Camera:
        """Return the same camera with its picture resampled to `width` x `height`."""
        scale = np.diag([width / self.width, height / self.height, 1.0])
        # Pixel centres sit at integers, so the picture starts half a pixel before 0.
        half = np.eye(3)
        half[:2, 2] = 0.5
        intrinsics = np.linalg.inv(half) @ scale @ half @ self.intrinsics
        return replace(self, intrinsics=intrinsics, width=width, height=height)


_CAMERA_SHAPES = {
    "intrinsics": (3, 3),
    "world_from_camera": (4, 4),
    "velocity_m_per_s": (3,),
    "angular_velocity_rad_per_s": (3,),
}


@dataclass(frozen=True, eq=False)
class Box:
    """A tracked 3D box at one moment.

    Raises:
        CalibrationError: If the pose is not a finite rigid motion (to 1e-4), a side is not positive
            and finite, or the velocity is not finite or beyond 150 m/s.
    """

    track_id: int
    class_name: str
    world_from_box: Float64
    """(4, 4), metres; the box is centred on its own origin."""
    size_m: tuple[float, float, float]
    """Extent along the box's own x (ahead), y (to the left) and z (up)."""
    velocity_m_per_s: Float64 | None = None
    """(3,), of the box's centre, in world axes; None where unknown."""

    def __post_init__(self) -> None:
        pose = _frozen_array("world_from_box", self.world_from_box, (4, 4))
        _check_rigid("world_from_box", pose)
        object.__setattr__(self, "world_from_box", pose)
        size = _frozen_array("size_m", self.size_m, (3,))
        if not (size > 0).all():
            raise CalibrationError(f"size_m must be positive, got {size.tolist()}")
        object.__setattr__(self, "size_m", tuple(size.tolist()))
        if self.velocity_m_per_s is None:
            return
        velocity = _frozen_array("velocity_m_per_s", self.velocity_m_per_s, (3,))
        speed = float(np.linalg.norm(velocity))
        if speed > MAX_SPEED_M_PER_S:
            raise CalibrationError(
                f"box {self.track_id} moves at {speed:.3g} m/s, as nothing on a street does; look "
                "for a jump in its track"
            )
        object.__setattr__(self, "velocity_m_per_s", velocity)


@dataclass(frozen=True, eq=False)
class Frame:
    """One picture and everything known about it; see the module's Convention.

    Raises:
        DataError: If label or depth have another shape or type than the image demands.
    """

    key: FrameKey
    time_s: float
    camera: Camera
    image: NDArray[np.uint8]
    """(H, W, 3)."""
    label: NDArray[np.uint8] | None = None
    """(H, W) train ids, or None where nobody labelled the frame."""
    depth_m: NDArray[Any] | None = None
    """(H, W) float16 or float32 z-depth in metres, `inf` for the sky; None where unknown."""
    normals_world: NDArray[np.float32] | None = None
    """(H, W, 3) unit surface normals in world axes, zero where there is no surface; or None."""
    boxes: tuple[Box, ...] = ()

    def __post_init__(self) -> None:
        shape = (self.camera.height, self.camera.width)
        if self.image.shape != (*shape, 3) or self.image.dtype != np.uint8:
            raise DataError(
                f"frame {self.key}: image is {self.image.dtype} {self.image.shape}, the camera "
                f"expects uint8 {(*shape, 3)}; check the calibration's image size"
            )
        if self.label is not None and (self.label.shape != shape or self.label.dtype != np.uint8):
            raise DataError(
                f"frame {self.key}: label is {self.label.dtype} {self.label.shape}, the image is "
                f"{shape}; a label must have its image's size"
            )
        if self.depth_m is not None and (
            self.depth_m.shape != shape or self.depth_m.dtype.kind != "f"
        ):
            raise DataError(
                f"frame {self.key}: depth is {self.depth_m.dtype} {self.depth_m.shape}, the image "
                f"is {shape}; depth must be a float array of the image's size"
            )


@runtime_checkable
class Clip(Protocol):
    """A recorded drive: frames by (time index, camera name).

    Convention:
        `keys` is ordered by time, then by camera. `frame` reads from disk each time and keeps
        nothing; two calls give equal frames. A clip holds paths and small tables only, so that it
        can be pickled to a worker.

        A clip of unrelated pictures, each in its own light, says so by an attribute
        `is_drive = False`; without the attribute a clip is a drive, under one light.
    """

    @property
    def name(self) -> str:
        """What the clip is called, usable as a folder name."""

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras."""

    @property
    def keys(self) -> tuple[FrameKey, ...]:
        """Keys of all frames."""

    @property
    def up_world(self) -> Float64:
        """(3,) unit vector against gravity."""

    def frame(self, key: FrameKey) -> Frame:
        """Read one frame.

        Raises:
            ClipError: If the clip has no such frame or a file of it cannot be read.
        """


def check_key(clip: Clip, key: FrameKey) -> FrameKey:
    """Return `key`, or refuse one that the clip does not have."""
    key = FrameKey(*key)
    if key not in clip.keys:
        raise ClipError(
            f"clip {clip.name} has no frame {printable(key)}; it has {len(clip.keys)} frames of "
            f"cameras {', '.join(clip.cameras)}"
        )
    return key


def _frozen_array(name: str, value: Any, shape: tuple[int, ...]) -> Float64:
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise CalibrationError(f"{name} must be numbers of shape {shape}") from None
    if array.shape != shape:
        raise CalibrationError(f"{name} must have shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        raise CalibrationError(f"{name} holds NaN or infinity; repair the calibration or pose file")
    array.flags.writeable = False
    return array


def _check_intrinsics(intrinsics: Float64) -> None:
    fx, fy = intrinsics[0, 0], intrinsics[1, 1]
    if not (fx > 0 and fy > 0):
        raise CalibrationError(f"focal lengths must be positive, got fx={fx:g}, fy={fy:g}")
    pinhole = np.array([[fx, 0, intrinsics[0, 2]], [0, fy, intrinsics[1, 2]], [0, 0, 1]])
    if not np.allclose(intrinsics, pinhole, rtol=0, atol=1e-6 * max(fx, fy)):
        raise CalibrationError(
            "intrinsics must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; rectify the camera first"
        )


def _check_rigid(name: str, matrix: Float64) -> None:
    rotation = matrix[:3, :3]
    off_rigid = np.abs(rotation.T @ rotation - np.eye(3)).max()
    last_row = np.abs(matrix[3] - (0, 0, 0, 1)).max()
    if off_rigid > RIGID_TOLERANCE or last_row > RIGID_TOLERANCE:
        raise CalibrationError(f"{name} is not a rigid motion (off by {off_rigid:.2g})")
    if np.linalg.det(rotation) < 0:
        raise CalibrationError(f"{name} is a reflection; its rotation has determinant -1")
