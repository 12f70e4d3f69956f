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


def gaussians(row, camera, *, compensate=True):
    """Means (M, 2), covariance (2, 2) and peak opacity of one particle's splats on the picture."""
    x, y, z = (float(v) for v in row[:3])
    fx, fy = camera.focal_px
    cx, cy = camera.principal_px
    jacobian = np.array([[fx / z, 0, -fx * x / z**2], [0, fy / z, -fy * y / z**2]])
    turning = np.cross(camera.angular_velocity_rad_per_s, [x, y, z])
    sweep = jacobian @ (camera.exposure_s * (np.asarray(row[3:6], float) - turning))
    xx, xy, xz, yy, yz, zz = row[6:12]
    solid = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    sharp = jacobian @ solid @ jacobian.T
    blur = camera.aperture_m * fx * (1 / z - 1 / 6)
    filtered = np.eye(2) * (EPS2D + blur**2 / 16)
    width2 = np.trace(sharp + filtered) / 2
    parts = 1
    if sweep @ sweep > 144 and width2 > 1:
        parts = min(int(np.ceil(np.sqrt(sweep @ sweep / (9 * width2)))), 16)
    spread = 1 / 12 if parts == 1 else 0.2
    soft = sharp + filtered + np.outer(sweep, sweep) / parts**2 * spread
    shrunk = np.sqrt(np.linalg.det(sharp) / np.linalg.det(soft)) / parts if compensate else 1.0
    mean = np.array([cx + fx * x / z, cy + fy * y / z])
    steps = (np.arange(parts) + 0.5) / parts - 0.5
    return mean + steps[:, None] * sweep, soft, row[12] * shrunk


def splat(light, transmittance, depth, particles, camera, colour_at, *, compensate=True):
    """Blend particles (N, 13) far to near into linear light (H, W, 3), in place."""
    v, u = np.mgrid[: camera.height, : camera.width]
    for row in particles[np.argsort(-particles[:, 2], kind="stable")]:
        means, soft, peak = gaussians(row, camera, compensate=compensate)
        peak = min(peak + CUT, 0.99)
        if peak <= CUT:
            continue
        for mean in means:
            offset = np.stack([u - mean[0], v - mean[1]], axis=-1)
            power = np.einsum("hwi,ij,hwj->hw", offset, np.linalg.inv(soft), offset)
            alpha = np.where(power <= 2 * np.log(peak / CUT), peak * np.exp(-power / 2), 0)
            alpha = alpha * np.clip((depth - row[2]) * 5 + 0.5, 0, 1)
            light += alpha[..., None] * (colour_at(row[:3]) - light)
            transmittance *= 1 - alpha
