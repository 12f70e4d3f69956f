"""Weather for pictures without a scene: what the transforms of all host libraries share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from weather_aug._checks import finite
from weather_aug._keys import uniforms
from weather_aug.clip.depth_sources import DepthSource
from weather_aug.clip.types import Camera, Frame, FrameKey
from weather_aug.edit.ambience import Ambience, ambience_of
from weather_aug.errors import ArgumentError, printable
from weather_aug.render.compose import RenderedFrame, render
from weather_aug.render.options import DEFAULT_OPTIONS, RenderOptions
from weather_aug.scene.policy import WeatherPolicy
from weather_aug.transforms.given import checked_options, checked_policy, given_depth, rgb_uint8
from weather_aug.transforms.masks import MaskIds, hidden_in
from weather_aug.weather import Weather

UInt8 = NDArray[np.uint8]

STREET_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Street axes of a level camera whose own axes are the world's."""
EXPOSURE_S = 0.005
CAMERA = "image"


class Drawn(NamedTuple):
    """What was drawn for one picture, or for one stack of pictures."""

    weather: Weather
    seed: int
    """Of the particles."""
    speed_m_per_s: float

    def to_dict(self) -> dict[str, Any]:
        """JSON values, so that a replay can store them."""
        return {"weather": self.weather.to_dict(), "seed": self.seed, "speed": self.speed_m_per_s}

    @classmethod
    def from_dict(cls, state: dict[str, Any]) -> Drawn:
        """The inverse of `to_dict`."""
        return cls(Weather.from_dict(state["weather"]), state["seed"], state["speed"])


class Weathered(NamedTuple):
    """A picture in weather, in the caller's own types."""

    image: NDArray[Any]
    """(H, W, 3), of the given picture's dtype."""
    mask: NDArray[Any] | None
    """(H, W), of the given mask's dtype, its ignore index where the surface cannot be seen."""
    shot: RenderedFrame
    """What else is known: `invalid`, `transmittance`, `depth`, `loss_weight`."""


@dataclass(frozen=True)
class Weathering:
    """How pictures get weather that come without a scene.

    Convention:
        Pictures are (H, W, 3) RGB, uint8 or float32 in [0, 1] (which is worked on in 8 bits); masks
        are (H, W) integers. Depth is what the caller gives (z-depth in metres, of the whole
        picture, so weather comes before crops and flips), or what `depth` finds.

    Raises:
        ArgumentError: If a value is outside its range.
    """

    policy: WeatherPolicy = field(default_factory=WeatherPolicy)
    speed_m_per_s: tuple[float, float] = (0.0, 15.0)
    """Range of the car's speed, which leans and lengthens the streaks."""
    camera_height_m: float = 1.5
    """Of a camera that is not given, over the ground."""
    hfov_deg: float = 60.0
    """Horizontal field of view of a camera that is not given."""
    options: RenderOptions = DEFAULT_OPTIONS
    ids: MaskIds = field(default_factory=MaskIds)
    depth: DepthSource = field(default_factory=DepthSource)

    def __post_init__(self) -> None:
        try:
            low, high = (finite("speed_m_per_s", v, 0, 100) for v in self.speed_m_per_s)
        except (TypeError, ValueError) as error:
            raise ArgumentError(f"speed_m_per_s must be a range (low, high): {error}") from None
        if low > high:
            raise ArgumentError(
                f"speed_m_per_s must be a range (low, high), got {self.speed_m_per_s}"
            )
        object.__setattr__(self, "speed_m_per_s", (low, high))
        finite("camera_height_m", self.camera_height_m, 0.1, 100)
        finite("hfov_deg", self.hfov_deg, 5, 150)
        object.__setattr__(self, "options", checked_options(self.options))

    @classmethod
    def of(cls, policy: WeatherPolicy | dict[str, Any] | None = None, **how: Any) -> Weathering:
        """From the flat arguments that the transforms of host libraries take.

        Args:
            policy: Or its `to_dict` form; the default policy if None.
            how: Fields of this class, of `MaskIds` (`taxonomy`, `ignore_index`, `unknown_ids`), and
                of `DepthSource` as `depth_cache` and `depth_network`.

        Raises:
            ArgumentError: If a name is none of these, or a value is outside its range.
        """
        known = ("speed_m_per_s", "camera_height_m", "hfov_deg", "options")
        ids = ("taxonomy", "ignore_index", "unknown_ids")
        depths = {"depth_cache": "cache", "depth_network": "network"}
        unknown = sorted(set(how) - {*known, *ids, *depths}, key=str)
        if unknown:
            raise ArgumentError(
                f"there is no argument {printable(unknown[0])}; there are policy, "
                f"{', '.join((*known, *ids, *depths))}"
            )
        return cls(
            policy=checked_policy(policy),
            ids=MaskIds(**{name: how[name] for name in ids if name in how}),
            depth=DepthSource(**{to: how[name] for name, to in depths.items() if name in how}),
            **{name: how[name] for name in known if how.get(name) is not None},
        )

    def to_dict(self) -> dict[str, Any]:
        """The flat arguments as JSON values: `Weathering.of(**fields)` is equal to this.

        Raises:
            ArgumentError: If depth comes from a function, which cannot be written down.
        """
        if not isinstance(self.depth.network, str | None):
            raise ArgumentError(
                "depth_network is a function, which cannot be written down; give the folder or "
                "name of a model instead"
            )
        return {
            "policy": self.policy.to_dict(),
            "speed_m_per_s": list(self.speed_m_per_s),
            "camera_height_m": self.camera_height_m,
            "hfov_deg": self.hfov_deg,
            "options": self.options.to_dict(),
            **self.ids.to_dict(),
            "depth_cache": self.depth.cache,
            "depth_network": self.depth.network,
        }

    def draw(self, key: int) -> Drawn:
        """Weather, particles and speed of one draw; `key` is of `Draws.key`."""
        drawn = self.policy.draw(key % 2**62, 0, 0)
        low, high = self.speed_m_per_s
        speed = low + (high - low) * float(uniforms(key, 1)[0])
        return Drawn(drawn.weather, drawn.seed, speed)

    def render(
        self,
        image: NDArray[Any],
        drawn: Drawn,
        *,
        mask: NDArray[Any] | None = None,
        depth: NDArray[Any] | None = None,
        camera: Camera | None = None,
    ) -> Weathered:
        """One picture in the weather that was drawn for it; inputs are not changed.

        Args:
            image: (H, W, 3) RGB, uint8 or float32 in [0, 1], any layout.
            drawn: Of `draw`.
            mask: (H, W) ids, or None.
            depth: (H, W) float z-depth in metres; unknown depth (NaN, 0, below 0) counts as far, as
                does `inf`.
            camera: Of the picture; a level one if None.

        Raises:
            ArgumentError: If an array has another type, shape or range than stated, or depth is
                unknown on more than half of the pixels outside the sky.
            DataError: If the mask holds an id that its taxonomy does not declare.
        """
        frame = self.frame(image, drawn, mask=mask, depth=depth, camera=camera)
        return self.handed_back(image, mask, self._rendered(frame, drawn, light_of(frame)))

    def render_stack(
        self,
        images: Sequence[NDArray[Any]],
        drawn: Drawn,
        *,
        fps: float,
        masks: Sequence[NDArray[Any]] | None = None,
        depths: Sequence[NDArray[Any]] | None = None,
        cameras: Sequence[Camera] | None = None,
    ) -> list[Weathered]:
        """Pictures of one drive in one weather: the same drops fly on, under one light.

        Args:
            images: Pictures of one size, in the order in which they were taken.
            drawn: One draw for all.
            fps: Pictures a second, above 0.
            masks: One for each picture, or None.
            depths: One for each picture, or None.
            cameras: One for each picture, or None.

        Raises:
            ArgumentError: As `render` does, or if there are not as many of each.
        """
        fps = finite("fps", fps, 1e-3, 1e4)
        known = {"mask": masks, "depth": depths, "camera": cameras}
        of_each = {name: _one_each(name, given, len(images)) for name, given in known.items()}
        light = None
        done = []
        for k, image in enumerate(images):
            given = {name: values[k] for name, values in of_each.items()}
            frame = self.frame(image, drawn, time_s=k / fps, **given)
            light = light or light_of(frame)
            shot = self._rendered(frame, drawn, light)
            done.append(self.handed_back(image, given["mask"], shot))
        return done

    def frame(
        self,
        image: NDArray[Any],
        drawn: Drawn,
        *,
        mask: NDArray[Any] | None = None,
        depth: NDArray[Any] | None = None,
        camera: Camera | None = None,
        time_s: float = 0.0,
    ) -> Frame:
        """What is known of a picture before there is weather in it; see `render`."""
        picture = rgb_uint8(image)
        shape = picture.shape[:2]
        label = None if mask is None else self.ids.train_ids(mask, shape)
        if camera is None:
            camera = self._camera(shape, drawn.speed_m_per_s, time_s)
        elif not isinstance(camera, Camera):
            raise ArgumentError(f"camera must be a Camera, got {type(camera).__name__}")
        if depth is None:
            depth = self.depth.depth_m(picture, label, camera, self.camera_height_m)
        else:
            depth = given_depth(depth, shape, label)
        return Frame(FrameKey(0, CAMERA), time_s, camera, picture, label, depth)

    def handed_back(
        self, image: NDArray[Any], mask: NDArray[Any] | None, shot: RenderedFrame
    ) -> Weathered:
        """A rendered picture and its mask in the types in which they came.

        Raises:
            ArgumentError: If the mask is of another type or size than the picture's.
        """
        done: NDArray[Any] = shot.image
        if image.dtype != np.uint8:
            # What the weather leaves alone keeps its finer value.
            same = shot.image == shot.frame.image
            done = np.where(same, image, shot.image / np.float32(255)).astype(np.float32)
        if mask is None:
            return Weathered(done, None, shot)
        self.ids.check(mask, shot.image.shape[:2])
        hidden = hidden_in(shot.label, shot.label_full, shot.invalid, self.options.labels)
        return Weathered(done, self.ids.marked(mask, hidden), shot)

    def _rendered(self, frame: Frame, drawn: Drawn, light: Ambience) -> RenderedFrame:
        return render(frame, drawn.weather, seed=drawn.seed, ambience=light, options=self.options)

    def _camera(self, shape: tuple[int, int], speed_m_per_s: float, time_s: float) -> Camera:
        camera = default_camera(shape, speed_m_per_s, self.hfov_deg)
        if time_s == 0.0:
            return camera
        pose = camera.world_from_camera.copy()
        pose[:3, 3] = camera.velocity_m_per_s * time_s
        return replace(camera, world_from_camera=pose)


def _one_each(name: str, values: Any, count: int) -> list[Any]:
    if not isinstance(values, Sequence | np.ndarray | None):
        raise ArgumentError(f"{name}s must be a sequence, got {type(values).__name__}")
    found = [None] * count if values is None else list(values)
    if len(found) != count:
        raise ArgumentError(f"{name}s must hold one for each of {count} pictures, got {len(found)}")
    return found


def light_of(frame: Frame) -> Ambience:
    """Light in a picture, on a street that runs as its camera looks."""
    return ambience_of(frame, STREET_AXES @ frame.camera.world_from_camera[:3, :3].T)


def default_camera(shape: tuple[int, int], speed_m_per_s: float, hfov_deg: float = 60.0) -> Camera:
    """A level camera that drives forward, for pictures of (H, W) that come without one."""
    height, width = shape
    focal_px = 0.5 * width / np.tan(np.radians(hfov_deg / 2))
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
