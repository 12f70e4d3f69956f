"""RandomWeather for albumentations 2.0: weather as one line of a Compose."""

from __future__ import annotations

import sys
from dataclasses import asdict, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import finite, image_uint8, like_image
from weather_aug._extras import require
from weather_aug._keys import key_of, uniforms
from weather_aug.clip.prior import geometric_prior_depth
from weather_aug.clip.types import Camera, Frame, FrameKey
from weather_aug.edit.ambience import ambience_of
from weather_aug.errors import ArgumentError, printable
from weather_aug.render.compose import RenderedFrame, render
from weather_aug.render.options import DEFAULT_OPTIONS, RenderOptions
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.taxonomy import IGNORE, SKY
from weather_aug.weather import Weather

# Without it the import below would fail with no word on which extra to install.
require("albumentations", extra="albumentations", to="use RandomWeather in a Compose")

import albumentations as A  # noqa: E402
from albumentations.core.transforms_interface import BaseTransformInitSchema  # noqa: E402

UInt8 = NDArray[np.uint8]

STREET_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Street axes of a level camera whose own axes are the world's."""
DEFAULT_FOV_DEG = 60.0
EXPOSURE_S = 0.005
_PICTURES = ("image", "images", "volume", "volumes")
"""Kinds of targets that hold pictures; depth and mask belong to one picture alone."""


class RandomWeather(A.DualTransform):
    """Rain, snow or fog drawn from a policy, over an image and its label mask.

    Convention:
        `image` is (H, W, 3) uint8 RGB; `mask` is (H, W) uint8 Cityscapes train ids and comes back
        with 255 where the weather hides the surface. Only the key `mask` does: weather moves
        nothing, so every other target (`masks`, further masks such as instance maps or depth,
        `bboxes`, `keypoints`) passes through unchanged. A second picture is refused, because it
        would need a depth and a camera of its own.

        `depth` (H, W) float, metres along the optical axis, and `camera` (`weather_aug.Camera`)
        are taken from the call where given; else depth is the geometric prior of the mask (ground
        plane, standing objects, sky). Unknown depth (NaN, 0, below 0) counts as far, as does `inf`,
        so complete a sparse depth first; one that is unknown on more than half of the pixels
        outside the sky is refused. Where no mask says what is sky, `inf` is sky.

        Put the transform before crops and flips: depth and camera belong to the whole picture.
        Randomness is the transform's own generator (`Compose(seed=…)`), mixed with the DataLoader
        worker's seed.

    Args:
        policy: Which weather how often, or its `to_dict` form.
        speed_m_per_s: Range of the car's speed, which leans and lengthens the streaks.
        camera_height_m: Of the geometric prior.
        max_particles: Budget of the renderer, instead of the one in `options`.
        options: Choices besides the weather, or their fields as a dict; effects are left out by
            name, as in `RenderOptions(without=("drops", "noise"))`.
        p: Probability of any weather.

    Raises:
        MissingExtraError: At import, if albumentations is not installed.
        ArgumentError: If an argument is out of range, an additional target is a picture, or at a
            call there is no `image`, more than one picture, too little depth, or neither depth nor
            a mask to take a prior from.
    """

    class InitSchema(BaseTransformInitSchema):
        """Types of the constructor's arguments."""

        policy: Any
        speed_m_per_s: tuple[float, float]
        camera_height_m: float
        max_particles: int | None
        options: Any

    def __init__(
        self,
        policy: WeatherPolicy | dict[str, Any] | None = None,
        speed_m_per_s: tuple[float, float] = (0.0, 15.0),
        camera_height_m: float = 1.5,
        max_particles: int | None = None,
        p: float = 0.5,
        options: RenderOptions | dict[str, Any] | None = None,
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
        chosen = _options(options)
        if max_particles is not None:
            chosen = replace(chosen, max_particles=max_particles)
        # As JSON values, so that a pipeline can be written down.
        self.options = asdict(chosen) | {"without": list(chosen.without)}
        self.max_particles = chosen.max_particles

    def get_params(self) -> dict[str, Any]:
        """Draw weather, seed and speed: JSON values only, so that a replay can store them."""
        key = key_of("albumentations", int(self.random_generator.integers(2**62)), _worker_seed())
        draw = WeatherPolicy.from_dict(self.policy).draw(key % 2**62, 0, 0)
        low, high = self.speed_m_per_s
        speed = low + (high - low) * float(uniforms(key, 1)[0])
        return {"weather": draw.weather.to_dict(), "seed": draw.seed, "speed": speed}

    def add_targets(self, additional_targets: dict[str, str]) -> None:
        """Take further targets of a Compose; refuse pictures as soon as it is made."""
        super().add_targets(additional_targets)
        for name, kind in self._additional_targets.items():
            if kind in _PICTURES:
                raise _second_picture(name)

    def update_transform_params(
        self, params: dict[str, Any], data: dict[str, Any]
    ) -> dict[str, Any]:
        """Nothing to add: what depends on the data is checked and read when it is rendered."""
        return params

    def apply_with_params(
        self, params: dict[str, Any], *args: Any, **kwargs: Any
    ) -> dict[str, Any]:
        """Render `image`, mark in `mask` what is hidden, and hand on everything else as it is."""
        for name in _PICTURES[1:]:
            if kwargs.get(name) is not None:
                raise _second_picture(name)
        if kwargs.get("image") is None:
            raise ArgumentError("RandomWeather needs a picture: pass image=… (H, W, 3) uint8")
        shot = self._render(params, kwargs)
        done = kwargs | {"image": shot.image}
        if shot.label is not None:
            done["mask"] = np.where(shot.label != shot.label_full, IGNORE, kwargs["mask"])
        return done

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
            options=_options(self.options),
        )

    def _depth(self, depth: Any, label: UInt8 | None, camera: Camera) -> NDArray[Any]:
        if depth is not None:
            depth = np.asarray(depth)
            like_image("depth", depth, (camera.height, camera.width))
            _check_known(depth, label)
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


def _options(options: Any) -> RenderOptions:
    if options is None:
        return DEFAULT_OPTIONS
    if isinstance(options, RenderOptions):
        return options
    if not isinstance(options, dict):
        raise ArgumentError(
            f"options must be RenderOptions, or a dict of its fields, got {type(options).__name__}"
        )
    known = [field.name for field in fields(RenderOptions)]
    unknown = sorted(set(options) - set(known), key=str)
    if unknown:
        raise ArgumentError(
            f"RenderOptions has no field {printable(unknown[0])}; it has {', '.join(known)}"
        )
    return RenderOptions(**options)


def _worker_seed() -> int:
    """Seed of this DataLoader worker, 0 outside one.

    Albumentations 2.0.8 gives every worker the same generator; without this, two workers draw the
    same weather.
    """
    torch = sys.modules.get("torch")
    info = torch.utils.data.get_worker_info() if torch is not None else None
    return 0 if info is None else int(info.seed)


def _second_picture(name: str) -> ArgumentError:
    return ArgumentError(
        f"RandomWeather weathers the target image alone, and {printable(name)!r} is another "
        "picture: call the pipeline once for each picture, or declare what is no picture as 'mask'"
    )


def _check_known(depth: NDArray[Any], label: UInt8 | None) -> None:
    """Refuse a depth that is mostly holes, which the renderer would silently take for far."""
    if depth.dtype.kind != "f":
        raise ArgumentError(f"depth must be a float array in metres, got {depth.dtype}")
    known = np.isfinite(depth) & (depth > 0)
    surface = np.ones(depth.shape, bool) if label is None else label != SKY
    open_sky = depth == np.inf
    if label is not None:
        open_sky &= label == IGNORE
    expected = int(np.count_nonzero(surface & ~open_sky))
    found = int(np.count_nonzero(surface & known))
    if surface.any() and (found == 0 or 2 * found < expected):
        raise ArgumentError(
            f"depth is known (finite and above 0) on {found / max(expected, 1):.0%} of the pixels "
            "outside the sky, and unknown depth counts as far: complete the depth first, or leave "
            "it out to take a geometric prior from the mask"
        )


def _label(mask: Any, shape: tuple[int, int]) -> UInt8 | None:
    if mask is None:
        return None
    if not isinstance(mask, np.ndarray):
        raise ArgumentError(f"mask must be a numpy array, got {type(mask).__name__}")
    like_image("mask", mask, shape)
    if not np.can_cast(np.uint8, mask.dtype) or mask.dtype.kind not in "iu":
        raise ArgumentError(f"mask must be an integer array that holds 0..255, got {mask.dtype}")
    low, high = int(mask.min()), int(mask.max())
    if low < 0 or high > 255:
        raise ArgumentError(
            f"mask must hold train ids in 0..255, found {low if low < 0 else high}; map its ids "
            "to train ids first"
        )
    return np.ascontiguousarray(mask, dtype=np.uint8)
