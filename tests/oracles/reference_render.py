"""The renderer again, slowly: float64, every pixel of every particle, exp and powers as they are.

Shares no code with the kernels; it takes the particles' positions, because those are random.
"""

import numpy as np

EPS2D = 0.3
CUT = 1 / 255


def linear(srgb):
    srgb = np.asarray(srgb, float) / 255
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def srgb(light):
    light = np.clip(light, 0, 1)
    high = 1.055 * np.maximum(light, 1e-12) ** (1 / 2.4) - 0.055
    return 255 * np.where(light <= 0.0031308, 12.92 * light, high)


def rays(camera):
    """(H, W, 2) x/z and y/z of each pixel."""
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    v, u = np.mgrid[: camera.height, : camera.width]
    return np.stack([(u - cx) / fx, (v - cy) / fy], axis=-1)


def optical_depth(z, ray, up, fog, inverse_height, haze, precipitation, resolved):
    """Optical depth to depth z; `resolved(z)` is carried by drawn particles on the axis."""
    norm = np.sqrt(1 + (ray**2).sum(-1))
    rise = ray @ up[:2] + up[2]
    sine = rise / norm
    path = np.where(np.isinf(z), np.minimum(1000 / np.maximum(sine, 0.05), 20000), z * norm)
    z = path / norm
    h = np.maximum(path * sine * inverse_height, -8)
    share = np.where(np.abs(h) < 1e-3, 1 - h / 2, -np.expm1(-h) / np.where(h == 0, 1, h))
    air = (fog * share + haze) * path
    return np.minimum(air + np.maximum(precipitation * z - resolved(z), 0) * norm, 60)


def covariance(position, velocity, diameter, camera, *, compensate=True):
    """Mean (2,), covariance (2, 2) and peak opacity of one particle on the picture."""
    x, y, z = (float(v) for v in position)
    fx, fy = camera.focal_px
    cx, cy = camera.principal_px
    jacobian = np.array([[fx / z, 0, -fx * x / z**2], [0, fy / z, -fy * y / z**2]])
    turning = np.cross(camera.angular_velocity_rad_per_s, [x, y, z])
    sweep = jacobian @ (camera.exposure_s * (np.asarray(velocity, float) - turning))
    sharp = (diameter / (2 * np.sqrt(2))) ** 2 * jacobian @ jacobian.T
    blur = camera.aperture_m * fx * (1 / z - 1 / 6)
    soft = sharp + np.outer(sweep, sweep) / 12 + np.eye(2) * (EPS2D + blur**2 / 16)
    peak = np.sqrt(np.linalg.det(sharp) / np.linalg.det(soft)) if compensate else 1.0
    return np.array([cx + fx * x / z, cy + fy * y / z]), soft, peak


def splat(light, transmittance, depth, particles, camera, colour_at, *, compensate=True):
    """Blend particles (N, 7) far to near into linear light (H, W, 3), in place."""
    v, u = np.mgrid[: camera.height, : camera.width]
    for row in particles[np.argsort(-particles[:, 2], kind="stable")]:
        centre, soft, peak = covariance(row[:3], row[3:6], row[6], camera, compensate=compensate)
        peak = min(peak + CUT, 0.99)
        offset = np.stack([u - centre[0], v - centre[1]], axis=-1)
        power = np.einsum("hwi,ij,hwj->hw", offset, np.linalg.inv(soft), offset)
        alpha = np.where(power <= 2 * np.log(peak / CUT), peak * np.exp(-power / 2), 0)
        alpha = alpha * np.clip((depth - row[2]) / 0.2 + 0.5, 0, 1)
        light += alpha[..., None] * (colour_at(row[:3]) - light)
        transmittance *= 1 - alpha
