"""RandomWeather for albumentations 2.0: weather as one line of a Compose."""

from __future__ import annotations

import sys
from typing import Any

import albumentations as A
import numpy as np
from albumentations.core.transforms_interface import BaseTransformInitSchema
from numpy.typing import NDArray

from weather_aug._checks import finite, image_uint8, like_image
from weather_aug._keys import key_of, uniforms
from weather_aug.clip.prior import geometric_prior_depth
from weather_aug.clip.types import Camera, Frame, FrameKey
from weather_aug.errors import ArgumentError
from weather_aug.render.compose import DEFAULT_OPTIONS, RenderedFrame, RenderOptions, render
from weather_aug.render.light import ambience_of
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.taxonomy import IGNORE
from weather_aug.weather import Weather

UInt8 = NDArray[np.uint8]

STREET_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Street axes of a level camera whose own axes are the world's."""
DEFAULT_FOV_DEG = 60.0
EXPOSURE_S = 0.005


class RandomWeather(A.DualTransform):
    """Rain, snow or fog drawn from a policy, over an image and its label mask.

    Convention:
        `image` is (H, W, 3) uint8 RGB; `mask` is (H, W) uint8 Cityscapes train ids and comes back
        with 255 where the weather hides the surface. `depth` (H, W) float, metres along the optical
        axis, and `camera` (`weather_aug.Camera`) are taken from the call where given; else depth is
        the geometric prior of the mask (ground plane, standing objects, sky). Put it before crops
        and flips: depth and camera belong to the whole picture. Randomness is the transform's
        own generator (`Compose(seed=…)`), mixed with the DataLoader worker's seed.

    Args:
        policy: Which weather how often, or its `to_dict` form.
        speed_m_per_s: Range of the car's speed, which leans and lengthens the streaks.
        camera_height_m: Of the geometric prior.
        max_particles: Budget of the renderer.
        p: Probability of any weather.

    Raises:
        ArgumentError: If an argument is out of range, or at a call an image has no depth and no
            mask to take a prior from.
    """

    class InitSchema(BaseTransformInitSchema):
        """Types of the constructor's arguments."""

        policy: Any
        speed_m_per_s: tuple[float, float]
        camera_height_m: float
        max_particles: int

    def __init__(
        self,
        policy: WeatherPolicy | dict[str, Any] | None = None,
        speed_m_per_s: tuple[float, float] = (0.0, 15.0),
        camera_height_m: float = 1.5,
        max_particles: int = DEFAULT_OPTIONS.max_particles,
        p: float = 0.5,
    ) -> None:
        super().__init__(p=p)
        if isinstance(policy, WeatherPolicy):
            policy = policy.to_dict()
        self.policy = WeatherPolicy.from_dict(policy or {}).to_dict()
        low, high = (finite("speed_m_per_s", v, 0, 100) for v in speed_m_per_s)
        if low > high:
            raise ArgumentError(f"speed_m_per_s must be a range (low, high), got {speed_m_per_s}")
        self.speed_m_per_s = (low, high)
        self.camera_height_m = finite("camera_height_m", camera_height_m, 0.1, 100)
        self.max_particles = RenderOptions(max_particles).max_particles

    def get_params(self) -> dict[str, Any]:
        """Draw weather, seed and speed: JSON values only, so that a replay can store them."""
        key = key_of("albumentations", int(self.random_generator.integers(2**62)), _worker_seed())
        draw = WeatherPolicy.from_dict(self.policy).draw(key % 2**62, 0, 0)
        low, high = self.speed_m_per_s
        speed = low + (high - low) * float(uniforms(key, 1)[0])
        return {"weather": draw.weather.to_dict(), "seed": draw.seed, "speed": speed}

    def apply_with_params(
        self, params: dict[str, Any], *args: Any, **kwargs: Any
    ) -> dict[str, Any]:
        """Render the frame once, then hand it to each target."""
        shot = self._render(params, kwargs)
        done: dict[str, Any] = super().apply_with_params(params | {"shot": shot}, *args, **kwargs)
        return done

    def apply(self, img: UInt8, shot: RenderedFrame, **params: Any) -> UInt8:
        """The picture in weather."""
        return shot.image

    def apply_to_mask(self, mask: NDArray[Any], shot: RenderedFrame, **params: Any) -> NDArray[Any]:
        """The mask with 255 where the weather hides the surface; depth passes through."""
        if mask.dtype.kind == "f" or shot.label is None:
            return mask
        return np.where(shot.label != shot.label_full, IGNORE, mask)

    def _render(self, params: dict[str, Any], data: dict[str, Any]) -> RenderedFrame:
        image = image_uint8("image", data["image"])
        label = _label(data.get("mask"), image.shape[:2])
        camera = data.get("camera") or default_camera(image.shape[:2], params["speed"])
        depth = self._depth(data.get("depth"), label, camera)
        frame = Frame(FrameKey(0, "image"), 0.0, camera, image, label, depth)
        return render(
            frame,
            Weather.from_dict(params["weather"]),
            seed=params["seed"],
            ambience=ambience_of(frame, STREET_AXES @ camera.world_from_camera[:3, :3].T),
            options=RenderOptions(self.max_particles),
        )

    def _depth(self, depth: Any, label: UInt8 | None, camera: Camera) -> NDArray[Any]:
        if depth is not None:
            depth = np.asarray(depth)
            like_image("depth", depth, (camera.height, camera.width))
            return depth
        if label is None:
            raise ArgumentError(
                "RandomWeather needs depth to know what is far: pass depth=… (metres), or a mask "
                "of train ids to take a geometric prior from"
            )
        return geometric_prior_depth(
            label,
            focal_px=camera.focal_px[1],
            principal_px=camera.principal_px,
            camera_height_m=self.camera_height_m,
        )


def default_camera(shape: tuple[int, int], speed_m_per_s: float) -> Camera:
    """A level camera of 60 degrees that drives forward, for pictures that come without one."""
    height, width = shape
    focal_px = 0.5 * width / np.tan(np.radians(DEFAULT_FOV_DEG / 2))
    intrinsics = np.array(
        [[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]]
    )
    return Camera(
        intrinsics,
        np.eye(4),
        width,
        height,
        exposure_s=EXPOSURE_S,
        velocity_m_per_s=np.array([0.0, 0.0, speed_m_per_s]),
    )


def _worker_seed() -> int:
    """Seed of this DataLoader worker, 0 outside one.

    Albumentations 2.0.8 gives every worker the same generator; without this, two workers draw the
    same weather.
    """
    torch = sys.modules.get("torch")
    info = torch.utils.data.get_worker_info() if torch is not None else None
    return 0 if info is None else int(info.seed)


def _label(mask: Any, shape: tuple[int, int]) -> UInt8 | None:
    if mask is None:
        return None
    like_image("mask", mask, shape)
    if not np.can_cast(np.uint8, mask.dtype) or mask.dtype.kind not in "iu":
        raise ArgumentError(f"mask must be an integer array that holds 0..255, got {mask.dtype}")
    if mask.min() < 0 or mask.max() > 255:
        raise ArgumentError(f"mask must hold train ids in 0..255, got up to {mask.max()}")
    return np.ascontiguousarray(mask, dtype=np.uint8)
