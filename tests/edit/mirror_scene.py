"""A plane, boxes on it and the sky, traced in float64: what a road really mirrors."""

from dataclasses import dataclass, replace

import numpy as np

from weather_aug.clip.types import Camera, Frame, FrameKey
from weather_aug.colour import srgb_from_linear
from weather_aug.edit.physical.mirror_seen import Seen
from weather_aug.edit.physical.site import site_of
from weather_aug.taxonomy import ROAD, SKY, TRAIN_ID

CAMERA_HEIGHT_M = 1.5
SKY_LIGHT = np.array([[0.5, 0.6, 0.7], [0.8, 0.9, 1.0]])
ROAD_LIGHT = np.array([0.1, 0.1, 0.1])
BOXES = (
    ("car", (8.0, 12.0), (-1.0, 1.0), (0.0, 1.5), (0.6, 0.1, 0.1)),
    ("car", (14.0, 18.0), (3.0, 5.0), (0.0, 1.4), (0.1, 0.2, 0.6)),
    ("building", (15.0, 40.0), (-20.0, -7.0), (0.0, 5.0), (0.5, 0.4, 0.2)),
    ("building", (30.0, 50.0), (6.0, 20.0), (0.0, 30.0), (0.3, 0.5, 0.3)),
    ("building", (60.0, 70.0), (-6.0, 5.0), (0.0, 8.0), (0.25, 0.2, 0.4)),
)
"""Class, ranges of x (ahead), y (left) and z (up), metres, and light."""
BAND_M = 1.0


@dataclass(frozen=True)
class Scene:
    """A camera over the plane z = 0, turned by pitch and roll."""

    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    width: int = 320
    height: int = 180
    boxes: tuple = BOXES

    @property
    def camera(self):
        pitch, roll = np.radians([self.pitch_deg, self.roll_deg])
        pitched = np.array(
            [[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]]
        )
        rolled = np.array(
            [[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]]
        )
        pose = np.eye(4)
        pose[:3, :3] = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]) @ pitched @ rolled
        pose[2, 3] = CAMERA_HEIGHT_M
        focal = 0.8 * self.width
        centre = ((self.width - 1) / 2, (self.height - 1) / 2)
        intrinsics = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1.0]])
        return Camera(intrinsics, pose, self.width, self.height)

    def rays(self):
        """Origin (3,) and rays (H, W, 3) of one metre of depth."""
        camera = self.camera
        columns, rows = np.meshgrid(np.arange(self.width), np.arange(self.height))
        pixels = np.stack([columns, rows, np.ones_like(rows)], -1).astype(float)
        rays = pixels @ np.linalg.inv(camera.intrinsics).T @ camera.world_from_camera[:3, :3].T
        return camera.centre_world, rays

    def seen(self, origins, rays, *, with_road=True):
        """Distance in rays, class and light of what rays (..., 3) meet first."""
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.where(rays[..., 2] < 0, -origins[..., 2] / rays[..., 2], np.inf)
        if not with_road:
            distance = np.full(rays.shape[:-1], np.inf)
        classes = np.where(np.isfinite(distance), ROAD, SKY)
        sine = rays[..., 2] / np.linalg.norm(rays, axis=-1)
        sky = SKY_LIGHT[0] + np.clip(sine, 0, 1)[..., None] * (SKY_LIGHT[1] - SKY_LIGHT[0])
        light = np.where(np.isfinite(distance)[..., None], ROAD_LIGHT, sky)
        for name, *ranges, colour in self.boxes:
            low, high = np.array(ranges).T
            with np.errstate(divide="ignore", invalid="ignore"):
                a, b = (low - origins) / rays, (high - origins) / rays
            enters = np.fmin(a, b).max(-1)
            hit = (enters <= np.fmax(a, b).min(-1)) & (enters > 1e-6) & (enters < distance)
            up = (origins + np.where(hit, enters, 0.0)[..., None] * rays)[..., 2]
            band = 0.5 + 0.5 * (np.floor(up / BAND_M) % 2)
            distance = np.where(hit, enters, distance)
            classes = np.where(hit, TRAIN_ID[name], classes)
            light = np.where(hit[..., None], band[..., None] * np.array(colour), light)
        return distance, classes, light

    def frame(self):
        origin, rays = self.rays()
        depth, classes, light = self.seen(np.broadcast_to(origin, rays.shape), rays)
        image = np.round(255 * srgb_from_linear(light)).astype(np.uint8)
        return Frame(
            FrameKey(0, "front"),
            0.0,
            self.camera,
            image,
            classes.astype(np.uint8),
            np.where(classes == SKY, np.inf, depth).astype(np.float32),
        )

    def site(self):
        return site_of(self.frame(), np.eye(3), CAMERA_HEIGHT_M)

    def mirrored(self):
        """What the road mirrors, by tracing: light (H, W, 3), and where the picture shows it."""
        origin = self.camera.centre_world
        down, (road, away), (distance, classes, light) = self._traced_from_the_road()
        surface = down & (classes != SKY)
        points = road + np.where(surface, distance, 1.0)[..., None] * away
        camera = self.camera
        from_camera = (points - origin) @ camera.world_from_camera[:3, :3]
        pixels = from_camera @ camera.intrinsics.T
        pixels = np.round(pixels[..., :2] / pixels[..., 2:]).astype(int)
        inside = ((pixels >= 0) & (pixels < (self.width, self.height))).all(-1) & surface
        depth = self.frame().depth_m
        column, row = np.where(inside[..., None], pixels, 0).reshape(-1, 2).T
        shown = depth[row, column].reshape(inside.shape)
        known = inside & (np.abs(shown - from_camera[..., 2]) < 0.02 * shown)
        return light, down & (known | (classes == SKY))

    def seen_in_the_road(self):
        """What a render of the mirror image shows: exactly what the road mirrors, on 1:1 cells."""
        down, (road, away), (distance, classes, light) = self._traced_from_the_road()
        surface = down & (classes != SKY)
        ahead = self.camera.world_from_camera[:3, 2]
        # A mirror image lies as far behind the road as the thing before it, along the old ray.
        depth = (road - self.camera.centre_world) @ ahead
        depth = depth + np.where(surface, distance, 0.0) * ((away * (1, 1, -1)) @ ahead)
        srgb = srgb_from_linear(np.where(surface[..., None], light, 0.0))
        return Seen(*(a.astype(np.float32) for a in (srgb, depth, surface)))

    def _traced_from_the_road(self):
        """Where rays go down, (place, direction) of their mirrored rays, and what those meet."""
        origin, rays = self.rays()
        down = rays[..., 2] < -1e-9
        way = np.where(down, -origin[2] / np.where(down, rays[..., 2], 1.0), 1.0)
        road = origin + way[..., None] * rays
        away = rays * np.array([1.0, 1.0, -1.0])
        return down, (road, away), self.seen(road, away, with_road=False)


def sunk(site, metres):
    """The site with its road too deep."""
    return replace(site, plane=site.plane - np.array([metres, 0.0, 0.0]))
