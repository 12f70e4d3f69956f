"""Compiled loops of the renderer: project particles, order them, shade the picture band by band.

All colours are linear light. Serial, without fast-math, so that the same arguments give the same
bits in every process; every pixel goes through the same operations whether the whole picture or a
window of it is rendered.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from weather_aug._compiled import compiled

BAND_ROWS = 16
DEPTH_KEYS = 4096
FAR_DEPTH_M = 60000.0
"""float16 ends here; a greater depth is the sky or beyond measure."""
FAINTEST = 1.0 / 255.0
"""Opacity at which a particle's footprint is cut."""


class Optics(NamedTuple):
    """Camera of the whole picture, float32."""

    fx: np.float32
    fy: np.float32
    cx: np.float32
    cy: np.float32
    exposure_s: np.float32
    aperture_m: np.float32
    turn_x: np.float32
    turn_y: np.float32
    turn_z: np.float32
    up_x: np.float32
    up_y: np.float32
    up_z: np.float32
    area_px: np.float32


class Medium(NamedTuple):
    """What is between the camera and the surfaces, float32; extinctions in 1/m."""

    fog_per_m: np.float32
    inverse_height_per_m: np.float32
    haze_per_m: np.float32
    precipitation_per_m: np.float32
    resolved_step_m: np.float32


class Tone(NamedTuple):
    """How the weather's light changes the recorded colours, float32."""

    overcast: np.float32
    sky_luminance: np.float32
    zenith_gain: np.float32


@compiled
def survival(optical_depth):
    """exp(-x) for x in [-16, 80] to 2e-5, in operations that give equal bits on every machine."""
    x = optical_depth * np.float32(-0.015625)
    one = np.float32(1.0)
    p = one + x * np.float32(1.0 / 6.0)
    p = one + x * np.float32(0.2) * p
    p = one + x * np.float32(0.25) * p
    p = one + x * np.float32(1.0 / 3.0) * p
    p = one + x * np.float32(0.5) * p
    p = one + x * p
    p = p * p
    p = p * p
    p = p * p
    p = p * p
    p = p * p
    return p * p


@compiled
def _mean_of_thin_layer(heights):
    """(1 - exp(-h)) / h for small h, where the difference would cancel."""
    h = heights * np.float32(0.25)
    h = np.float32(1.0) - h
    h = np.float32(1.0) - heights * np.float32(1.0 / 3.0) * h
    return np.float32(1.0) - heights * np.float32(0.5) * h


@compiled
def path_optical_depth(z, ray_x, ray_y, optics, medium, resolved_depth):
    """Optical depth of the air from the camera to depth z along the ray (ray_x, ray_y, 1)."""
    zero, one = np.float32(0.0), np.float32(1.0)
    norm = np.sqrt(one + ray_x * ray_x + ray_y * ray_y)
    rise = optics.up_x * ray_x + optics.up_y * ray_y + optics.up_z
    if z >= np.float32(FAR_DEPTH_M):
        sine = max(rise / norm, np.float32(0.05))
        z = min(np.float32(1000.0) / sine, np.float32(20000.0)) / norm
    path_m = z * norm
    heights = min(max(z * rise * medium.inverse_height_per_m, np.float32(-8.0)), np.float32(80.0))
    if abs(heights) < np.float32(0.05):
        share = _mean_of_thin_layer(heights)
    else:
        share = (one - survival(heights)) / heights
    last = np.int32(resolved_depth.shape[0] - 1)
    # Compared as a float first: the sky's bin does not fit an integer's range on every machine.
    position = min(z * (one / medium.resolved_step_m), np.float32(last))
    resolved = resolved_depth[np.int32(position)]
    tau = (medium.fog_per_m * share + medium.haze_per_m) * path_m
    tau += max(medium.precipitation_per_m * z - resolved, zero) * norm
    return min(tau, np.float32(60.0))


@compiled
def project(particles, optics, medium, resolved_depth, colour, airlight, window, splats):
    """Turn particles into screen-space Gaussians, keeping those that touch the window.

    A disc of diameter D is a Gaussian of standard deviation D / (2 sqrt 2) and peak opacity 1
    (equal area). A uniform sweep q adds q q^T / 12, defocus of diameter c adds c^2 / 16, the pixel
    filter 0.3 px^2; the peak falls by the square root of the ratio of determinants, so that the
    opacity integrated over the picture is the silhouette's, whatever the resolution or exposure.

    Args:
        particles: (N, 7) float32, as `ParticleField.particles` returns them.
        optics: Camera.
        medium: Air.
        resolved_depth: Optical depth of resolved particles by depth.
        colour: (3,) float32 of a particle.
        airlight: (3,) float32.
        window: (top, left, height, width).
        splats: (N, 12) float32 out: u, v, conic a b c, reach^2, peak, depth, rgb, covers.

    Returns:
        Number of splats.
    """
    count = 0
    one = np.float32(1.0)
    twelfth = np.float32(1.0 / 12.0)
    top, left, height, width = window
    large_area = np.float32(1e-3) * optics.area_px
    for i in range(particles.shape[0]):
        x, y, z = particles[i, 0], particles[i, 1], particles[i, 2]
        inverse = one / z
        tx, ty = x * inverse, y * inverse
        sx, sy = optics.fx * inverse, optics.fy * inverse
        t = optics.exposure_s
        ux = t * (particles[i, 3] - (optics.turn_y * z - optics.turn_z * y))
        uy = t * (particles[i, 4] - (optics.turn_z * x - optics.turn_x * z))
        uz = t * (particles[i, 5] - (optics.turn_x * y - optics.turn_y * x))
        qx, qy = sx * (ux - tx * uz), sy * (uy - ty * uz)
        s2 = np.float32(0.125) * particles[i, 6] * particles[i, 6]
        a0 = s2 * sx * sx * (one + tx * tx)
        b0 = s2 * sx * sy * tx * ty
        c0 = s2 * sy * sy * (one + ty * ty)
        blur = optics.aperture_m * (inverse - np.float32(1.0 / 6.0))
        soft_x = blur * optics.fx
        soft = np.float32(0.3) + soft_x * soft_x * np.float32(0.0625)
        a = a0 + qx * qx * twelfth + soft
        b = b0 + qx * qy * twelfth
        c = c0 + qy * qy * twelfth + soft
        det = a * c - b * b
        peak = np.sqrt(max(a0 * c0 - b0 * b0, np.float32(0.0)) / det) + np.float32(FAINTEST)
        peak = min(peak, np.float32(0.99))
        reach2 = np.float32(2.0) * np.float32(np.log(np.float64(peak / np.float32(FAINTEST))))
        if reach2 <= np.float32(0.0):
            continue
        u, v = optics.cx + optics.fx * tx, optics.cy + optics.fy * ty
        half_u, half_v = np.sqrt(reach2 * a), np.sqrt(reach2 * c)
        if u + half_u < left or u - half_u > left + width - 1:
            continue
        if v + half_v < top or v - half_v > top + height - 1:
            continue
        through = survival(path_optical_depth(z, tx, ty, optics, medium, resolved_depth))
        row = splats[count]
        row[0], row[1] = u, v
        row[2], row[3], row[4] = c / det, -b / det, a / det
        row[5], row[6], row[7] = reach2, peak, z
        for k in range(3):
            row[8 + k] = through * colour[k] + (one - through) * airlight[k]
        area = np.float32(np.pi) * reach2 * np.sqrt(det)
        row[11] = one if area > large_area else np.float32(0.0)
        count += 1
    return count


@compiled
def order_by_band(splats, window, bands):
    """Indices of splats band by band, far to near inside each, and where each band starts.

    Counting sorts only, so that equal depths keep the field's own order in any window.
    """
    n = splats.shape[0]
    keys = np.empty(n, np.int32)
    starts = np.zeros(DEPTH_KEYS + 1, np.int64)
    for i in range(n):
        # Inverse depth from 0 (far) to 2 (the near limit of 0.5 m).
        key = np.int32(min(np.float32(2047.0) / splats[i, 7], np.float32(DEPTH_KEYS - 1)))
        keys[i] = key
        starts[key + 1] += 1
    for k in range(DEPTH_KEYS):
        starts[k + 1] += starts[k]
    far_to_near = np.empty(n, np.int32)
    for i in range(n):
        far_to_near[starts[keys[i]]] = i
        starts[keys[i]] += 1

    top, _, height, _ = window
    band_starts = np.zeros(bands + 1, np.int64)
    first = np.empty(n, np.int32)
    last = np.empty(n, np.int32)
    for i in range(n):
        half = np.sqrt(splats[i, 5] * splats[i, 2] / _det(splats[i]))
        low = max(np.int64(np.floor(splats[i, 1] - half)) - top, 0)
        high = min(np.int64(np.ceil(splats[i, 1] + half)) - top, height - 1)
        first[i], last[i] = low // BAND_ROWS, high // BAND_ROWS
        for band in range(first[i], last[i] + 1):
            band_starts[band + 1] += 1
    for band in range(bands):
        band_starts[band + 1] += band_starts[band]
    order = np.empty(band_starts[bands], np.int32)
    fill = band_starts[:-1].copy()
    for k in range(n):
        i = far_to_near[k]
        for band in range(first[i], last[i] + 1):
            order[fill[band]] = i
            fill[band] += 1
    return order, band_starts


@compiled
def _det(splat):
    """Determinant of the conic, the inverse of the covariance's."""
    return splat[2] * splat[4] - splat[3] * splat[3]


@compiled
def _transmittance_row(depth, ray_x, ray_y, optics, medium, resolved_depth, tau, slant, out):
    """`path_optical_depth` and `survival` of one row, in loops that the compiler can vectorise."""
    zero, one = np.float32(0.0), np.float32(1.0)
    across = one + ray_y * ray_y
    rise_y = optics.up_y * ray_y + optics.up_z
    far, nearly_flat = np.float32(FAR_DEPTH_M), np.float32(0.05)
    layer_m, longest_m = np.float32(1000.0), np.float32(20000.0)
    width = depth.shape[0]
    for x in range(width):
        norm = np.sqrt(across + ray_x[x] * ray_x[x])
        rise = optics.up_x * ray_x[x] + rise_y
        sine = rise / norm
        sine = sine if sine > nearly_flat else nearly_flat
        beyond_m = layer_m / sine
        beyond_m = beyond_m if beyond_m < longest_m else longest_m
        z = depth[x]
        z = z if z < far else beyond_m / norm
        slant[x] = norm
        out[x] = z
        tau[x] = medium.haze_per_m * z * norm
    if medium.inverse_height_per_m == zero:
        for x in range(width):
            tau[x] += medium.fog_per_m * out[x] * slant[x]
    else:
        lowest, highest, thin = np.float32(-8.0), np.float32(80.0), np.float32(0.05)
        for x in range(width):
            rise = optics.up_x * ray_x[x] + rise_y
            heights = out[x] * rise * medium.inverse_height_per_m
            heights = heights if heights > lowest else lowest
            heights = heights if heights < highest else highest
            away = heights if abs(heights) >= thin else thin
            share = (one - survival(away)) / away
            share = share if abs(heights) >= thin else _mean_of_thin_layer(heights)
            tau[x] += medium.fog_per_m * share * out[x] * slant[x]
    if medium.precipitation_per_m > zero:
        last = np.float32(resolved_depth.shape[0] - 1)
        per_metre = one / medium.resolved_step_m
        for x in range(width):
            position = out[x] * per_metre
            position = position if position < last else last
            rest = medium.precipitation_per_m * out[x] - resolved_depth[np.int32(position)]
            tau[x] += (rest if rest > zero else zero) * slant[x]
    most = np.float32(60.0)
    for x in range(width):
        out[x] = survival(tau[x] if tau[x] < most else most)


@compiled
def _decode_row(image, linear, red, green, blue):
    for x in range(image.shape[0]):
        red[x] = linear[image[x, 0]]
        green[x] = linear[image[x, 1]]
        blue[x] = linear[image[x, 2]]


@compiled
def _overcast_row(sky, ray_x, ray_y, optics, matrix, tone, airlight, red, green, blue):
    """Change the colours of one row, and its sky towards an overcast one."""
    zero, one = np.float32(0.0), np.float32(1.0)
    a0, a1, a2 = airlight[0], airlight[1], airlight[2]
    across = one + ray_y * ray_y
    rise_y = optics.up_y * ray_y + optics.up_z
    brightest = np.float32(3.0) / tone.sky_luminance
    for x in range(sky.shape[0]):
        r, g, b = red[x], green[x], blue[x]
        y = np.float32(0.2126) * r + np.float32(0.7152) * g + np.float32(0.0722) * b
        # Leaves and wires inside the sky's label are dark: they stay what they are.
        matte = y * brightest - np.float32(0.9)
        matte = matte if matte > zero else zero
        matte = matte if matte < one else one
        weight = tone.overcast * matte if sky[x] else zero
        sine = (optics.up_x * ray_x[x] + rise_y) / np.sqrt(across + ray_x[x] * ray_x[x])
        brighter = one + tone.zenith_gain * (sine if sine > zero else zero)
        r_new = matrix[0, 0] * r + matrix[0, 1] * g + matrix[0, 2] * b
        g_new = matrix[1, 0] * r + matrix[1, 1] * g + matrix[1, 2] * b
        b_new = matrix[2, 0] * r + matrix[2, 1] * g + matrix[2, 2] * b
        red[x] = r_new + weight * (a0 * brighter - r_new)
        green[x] = g_new + weight * (a1 * brighter - g_new)
        blue[x] = b_new + weight * (a2 * brighter - b_new)


@compiled
def _fog_row(through, airlight, red, green, blue, gap):
    """Veil one row, and say how far (linear light) its surfaces are from the airlight."""
    a0, a1, a2 = airlight[0], airlight[1], airlight[2]
    for x in range(through.shape[0]):
        t = through[x]
        dr, dg, db = red[x] - a0, green[x] - a1, blue[x] - a2
        red[x], green[x], blue[x] = a0 + t * dr, a1 + t * dg, a2 + t * db
        dr, dg, db = abs(dr), abs(dg), abs(db)
        most = dr if dr > dg else dg
        gap[x] = most if most > db else db


@compiled
def encode_row(light):
    """Turn linear light into sRGB levels plus one half, in place, to 0.1 of a level.

    A polynomial in the square root on the power branch (largest error 0.083 levels), the exact
    line below it; every 8-bit level survives decoding and encoding.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    for x in range(light.shape[0]):
        v = light[x]
        v = v if v > zero else zero
        v = v if v < one else one
        s = np.sqrt(v)
        p = np.float32(-1.6236571) + s * np.float32(0.5173023)
        p = np.float32(2.0315735) + s * p
        p = np.float32(-1.4027363) + s * p
        p = np.float32(1.5179509) + s * p
        p = np.float32(-0.0401096) + s * p
        p = p if v > np.float32(0.0031308) else np.float32(12.92) * v
        light[x] = p * np.float32(255.0) + np.float32(0.5)


@compiled
def _blend_splat(splat, rows, window, falloff, planes, covered):
    """Blend one splat over rows [rows[0], rows[1]) of the window; `planes` starts at rows[0]."""
    u, v = splat[0], splat[1]
    a, b, c, reach2, peak, z = splat[2], splat[3], splat[4], splat[5], splat[6], splat[7]
    red, green, blue = splat[8], splat[9], splat[10]
    large = splat[11] > np.float32(0.0)
    top, left, _, width = window
    scale = np.float32(falloff.shape[0] / 12.5)
    last_slot = np.int32(falloff.shape[0] - 1)
    near_edge, one = np.float32(0.1), np.float32(1.0)
    inverse_a = one / a
    det = a * c - b * b
    half_v = np.sqrt(reach2 * a / det)
    y0 = max(np.int64(np.ceil(v - half_v)) - top, rows[0])
    y1 = min(np.int64(np.floor(v + half_v)) - top, rows[1] - 1)
    for y in range(y0, y1 + 1):
        dy = np.float32(y + top) - v
        room = a * reach2 - det * dy * dy
        if room <= np.float32(0.0):
            continue
        middle = u - b * dy * inverse_a
        half = np.sqrt(room) * inverse_a
        x0 = max(np.int64(np.ceil(middle - half)) - left, 0)
        x1 = min(np.int64(np.floor(middle + half)) - left, width - 1)
        row = planes[y - rows[0]]
        for x in range(x0, x1 + 1):
            ahead = row[4, x] - z
            if ahead <= -near_edge:
                continue
            dx = np.float32(x + left) - u
            power = (a * dx + np.float32(2.0) * b * dy) * dx + c * dy * dy
            alpha = peak * falloff[min(np.int32(power * scale), last_slot)]
            if ahead < near_edge:
                alpha *= np.float32(0.5) + np.float32(5.0) * ahead
            row[0, x] += alpha * (red - row[0, x])
            row[1, x] += alpha * (green - row[1, x])
            row[2, x] += alpha * (blue - row[2, x])
            row[3, x] *= one - alpha
            if large and alpha > np.float32(0.5):
                covered[y, x] = 1


@compiled
def compose(
    image,
    depth,
    sky,
    window,
    optics,
    medium,
    resolved_depth,
    linear,
    matrix,
    tone,
    airlight,
    splats,
    order,
    band_starts,
    falloff,
    least_contrast,
    out,
    through,
    distinct,
    covered,
):
    """Render the window: tone, fog and particles in linear light, band by band.

    Args:
        image: (H, W, 3) uint8 of the window.
        depth: (H, W) float32 z-depth of the window, `inf` for far.
        sky: (H, W) bool of the window.
        window: (top, left, height, width) in the whole picture.
        optics: Camera of the whole picture.
        medium: Air.
        resolved_depth: Optical depth of resolved particles by depth.
        linear: (256,) float32 toned linear light by sRGB level.
        matrix: (3, 3) float32 colour matrix after it.
        tone: Sky.
        airlight: (3,) float32.
        splats: (N, 12) float32.
        order: Splat indices by band.
        band_starts: (bands + 1,).
        falloff: exp(-x / 2) for x in [0, 12.5), float32.
        least_contrast: Linear difference from the airlight that can just be seen.
        out: (3, H, W) uint8 out.
        through: (H, W) float32 out: transmittance of air and particles.
        distinct: (H, W) uint8 out: 1 where what is left of the surface's difference from the
            airlight can be seen.
        covered: (H, W) uint8, zero: set where a large particle hides the surface.
    """
    top, left, height, width = window
    ray_x = np.empty(width, np.float32)
    for x in range(width):
        ray_x[x] = (np.float32(x + left) - optics.cx) / optics.fx
    # Red, green, blue, transmittance and depth of a band's rows side by side. The odd stride keeps
    # them apart in the cache: planes of equal page offset would evict each other at every pixel.
    stride = (width + 15) // 16 * 16 + 80
    planes = np.empty((BAND_ROWS, 5, stride), np.float32)
    gap = np.empty((BAND_ROWS, width), np.float32)
    tau = np.empty(width, np.float32)
    slant = np.empty(width, np.float32)
    overcast = tone.overcast > np.float32(0.0)
    for band in range(band_starts.shape[0] - 1):
        y0 = band * BAND_ROWS
        y1 = min(y0 + BAND_ROWS, height)
        for y in range(y0, y1):
            k = y - y0
            ray_y = (np.float32(y + top) - optics.cy) / optics.fy
            red, green, blue = planes[k, 0, :width], planes[k, 1, :width], planes[k, 2, :width]
            clear = planes[k, 3, :width]
            planes[k, 4, :width] = depth[y]
            _transmittance_row(
                depth[y], ray_x, ray_y, optics, medium, resolved_depth, tau, slant, clear
            )
            _decode_row(image[y], linear, red, green, blue)
            if overcast:
                _overcast_row(
                    sky[y], ray_x, ray_y, optics, matrix, tone, airlight, red, green, blue
                )
            _fog_row(clear, airlight, red, green, blue, gap[k])
        for k in range(band_starts[band], band_starts[band + 1]):
            _blend_splat(splats[order[k]], (y0, y1), window, falloff, planes, covered)
        for y in range(y0, y1):
            k = y - y0
            for channel in range(3):
                encode_row(planes[k, channel, :width])
                _quantise_row(planes[k, channel, :width], out[channel, y])
            through[y] = planes[k, 3, :width]
            _distinct_row(gap[k], through[y], least_contrast, distinct[y])


@compiled
def _quantise_row(levels, out):
    for x in range(levels.shape[0]):
        out[x] = np.uint8(np.int32(levels[x]))


@compiled
def _distinct_row(gap, through, least_contrast, out):
    for x in range(gap.shape[0]):
        out[x] = np.uint8(1) if gap[x] * through[x] >= least_contrast else np.uint8(0)


@compiled
def widen_depth(half, out):
    """Turn float16 bits into float32 depth, far and unknown as `inf`; numpy does it slower.

    Args:
        half: (N,) uint16 bits of float16 values.
        out: (N,) int32 view of the float32 output.
    """
    values = out.view(np.float32)
    for i in range(half.shape[0]):
        bits = np.int32(half[i])
        # Exponent and mantissa at their float32 places; the exponent's bias is repaired below.
        out[i] = (bits & np.int32(0x7FFF)) << np.int32(13)
        # Negative numbers lose their sign here, so they become 0, which means unknown.
        out[i] = out[i] if bits < np.int32(0x8000) else np.int32(0)
    for i in range(values.shape[0]):
        z = values[i] * np.float32(2.0**112)
        values[i] = (
            z if (z > np.float32(0.0)) & (z < np.float32(FAR_DEPTH_M)) else np.float32(np.inf)
        )


@compiled
def clean_depth(depth):
    """Set far and unknown depth (NaN, 0, negative) to `inf`, in place; (N,) float32."""
    for i in range(depth.shape[0]):
        z = depth[i]
        depth[i] = (
            z if (z > np.float32(0.0)) & (z < np.float32(FAR_DEPTH_M)) else np.float32(np.inf)
        )


@compiled
def raise_sky(label, sky_id, depth):
    """Set the depth of what is labelled sky to `inf`, in place."""
    for i in range(depth.shape[0]):
        depth[i] = depth[i] if label[i] != sky_id else np.float32(np.inf)


@compiled
def read_labels(label, through, near_distinct, covered, limits, ignore, sky_id, out, invalid):
    """Labels and invalid mask by the rules of `weather_aug.render.label`; all arrays are (N,).

    Args:
        label: uint8 train ids.
        through: float32 transmittance.
        near_distinct: uint8, 1 where something distinct is near.
        covered: uint8.
        limits: Transmittances below which a surface is hazy, doubtful, hidden.
        ignore: Id of what cannot be seen.
        sky_id: Id of the sky.
        out: uint8 out.
        invalid: uint8 out.
    """
    hazy, doubtful, hidden = limits
    for i in range(label.shape[0]):
        t = through[i]
        surface = label[i] != sky_id
        unseen = surface & ((t < hidden) | ((t < hazy) & (near_distinct[i] == 0)))
        unseen = unseen | (covered[i] != 0)
        out[i] = ignore if unseen else label[i]
        invalid[i] = np.uint8(1) if unseen | (surface & (t < doubtful)) else np.uint8(0)
