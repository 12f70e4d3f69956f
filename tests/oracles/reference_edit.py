"""The physical editor again, slowly: float64, whole pictures at a time, powers as they are.

Written from the physics and from what the kernels promise; it shares with them the numbers of the
noise tile, which are random, the layers of a frame, the table of materials and the named constants
of taste (how a camera exposes, how bright slush is), so that only arithmetic is compared. The rings
of drops are not in it.
"""

from collections import namedtuple

import numpy as np
from oracles.reference_render import linear, srgb

from weather_aug.edit.physical import ground_rows as taste
from weather_aug.edit.physical import look
from weather_aug.edit.physical.layers import NAMES
from weather_aug.edit.physical.materials import MATERIALS
from weather_aug.edit.physical.noise import noise_tile
from weather_aug.taxonomy import GROUND, ROAD, SKY, TRAIN_ID

WEIGHTS = np.array([0.2126, 0.7152, 0.0722])
GREY = 0.18
CELL_M, CELLS, COARSE = 0.06, 512, 16
"""Of the noise: side of a fine cell, cells of the tile, how much larger a coarse cell is."""
SHARES = 0.62, 0.38
"""Of the coarse and the fine look."""

View = namedtuple("View", "depth along left height sine size_m")


def tone(weather, without):
    """Function of linear light, and matrix (3, 3): weather-physics 6.1, step 3."""
    o = 0.0 if "relight" in without else weather.overcast

    def curve(light):
        gain = 1 - 0.15 * o * (1 - 0.8)
        return gain * GREY * (light / GREY) ** (1 - 0.18 * o) if o else light

    saturation, white = 1 - 0.28 * o, 1 + o * (np.array([0.96, 1.0, 1.05]) - 1)
    matrix = saturation * np.eye(3) + (1 - saturation) * WEIGHTS[None, :]
    return curve, white[:, None] * matrix


def exposure(weather, ambience, illumination, without):
    """Gain of the automatic exposure."""
    o = 0.0 if "relight" in without else weather.overcast
    snow = 0.0 if "snow_cover" in without else weather.snow_cover
    film = 0.0 if "film" in without else weather.wetness
    street = look.CANYON_SHARE * (ambience.airlight @ WEIGHTS) / illumination
    followed = np.clip(street ** (look.EXPOSING_POWER * o), *look.EXPOSURE_RANGE)
    return followed * (1 - look.SNOW_EXPOSURE_LOSS * snow) * (1 + look.WET_EXPOSURE * film)


def spread(plane, step, shape):
    """(H, W) of a map on the small grid, bilinear between the cells' centres."""
    for axis, size in enumerate(shape):
        plane = np.moveaxis(plane, axis, 0)
        place = np.clip((np.arange(size) + 0.5) / step - 0.5, 0, len(plane) - 1)
        low = np.minimum(place.astype(int), max(len(plane) - 2, 0))
        high = np.minimum(low + 1, len(plane) - 1)
        part = (place - low)[:, None]
        plane = np.moveaxis((1 - part) * plane[low] + part * plane[high], 0, axis)
    return plane


def view_of(frame, ambience, plane):
    """Where each pixel's surface is on the street, how flat it is seen and how large."""
    camera = frame.camera
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(u.shape)], -1)
    street = rays @ (ambience.axes_world @ camera.world_from_camera[:3, :3]).T
    depth = np.asarray(frame.depth_m, float)
    bad = ~((depth > 0) & (depth < 60000.0))
    if frame.label is not None:
        bad |= frame.label == SKY
    depth = np.where(bad, np.inf, depth)
    near = np.minimum(depth, 1e4)
    origin = ambience.axes_world @ camera.centre_world
    points = origin + near[..., None] * street
    climb = street[..., 2] - street[..., :2] @ plane[1:]
    above = origin[2] - plane[0] - plane[1:] @ origin[:2]
    sine = np.maximum(-climb / np.linalg.norm(rays, axis=-1), 0.004)
    size = near / fy / np.maximum(sine, 0.02)
    return View(depth, points[..., 0], points[..., 1], above + near * climb, sine, size)


def look_up(level, u, v):
    """Bilinear value of a periodic square (n, n) at cells (u, v) of level 0."""
    size = len(level)
    x, y = u * size / CELLS - 0.5, v * size / CELLS - 0.5
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    px, py = x - column, y - row

    def at(r, c):
        return level[r % size, c % size] / 255.0

    above = (1 - px) * at(row, column) + px * at(row, column + 1)
    below = (1 - px) * at(row + 1, column) + px * at(row + 1, column + 1)
    return (1 - py) * above + py * below


def levels():
    """The tile and its smaller copies."""
    tile, start, size, found = noise_tile(), 0, CELLS, []
    while start < len(tile):
        found.append(tile[start : start + size * size].reshape(size, size).astype(float))
        start, size = start + size * size, size // 2
    return found


def evenly(value):
    """Distribution function of the sum of two independent numbers, even in [0, each share]."""
    a, b = SHARES
    square = np.maximum(value, 0) ** 2
    for less in (a, b):
        square = square - np.maximum(value - less, 0) ** 2
    return square / (2 * a * b)


def noise(along, left, size_m, offset_m=0.0):
    """Noise in [0, 1] of places on the ground, seen in pixels of a size."""
    copies = levels()
    wide = np.maximum(size_m / CELL_M / 1.5, 1e-9)
    wanted = np.clip(np.ceil(np.log2(wide)), 0, len(copies) - 1).astype(int)
    turned = 0.8 * along + 0.6 * left, 0.8 * left - 0.6 * along
    coarse_m, cells = COARSE * CELL_M, offset_m / CELL_M
    total = np.zeros(np.shape(along))
    for k in np.unique(wanted):
        here = wanted == k
        fine = look_up(copies[k], (along + offset_m) / CELL_M, (left - offset_m) / CELL_M)
        slow = turned[0] / coarse_m - cells, turned[1] / coarse_m + cells
        coarse = look_up(copies[max(k - 4, 0)], *slow)
        total = np.where(here, SHARES[0] * coarse + SHARES[1] * fine, total)
    return evenly(total)


def noise_of_row(view, ground, camera, offset_m):
    """(H, W) noise of the pixels' places: of every fourth column, and straight between those.

    On what stands it is that of the ground along a slope, of four pixels; far away it is 1/2.
    """
    width = view.depth.shape[1]
    columns = np.minimum(np.arange(0, width + 4, 4), width - 1)
    knots = View(*(part[:, columns] for part in view))
    on_ground = ground[:, columns]
    slope = np.where(on_ground, 0.0, 0.6 * knots.height)
    oblique = 4 * np.minimum(knots.depth, 1e4) / camera.focal_px[1]
    size = np.where(on_ground, knots.size_m, oblique)
    value = noise(knots.along + slope, knots.left + slope, size, offset_m)
    value = np.where(knots.depth < 2000.0, value, 0.5)
    first, part = np.arange(width) // 4, np.arange(width) % 4 / 4
    return value[:, first] + part * (value[:, first + 1] - value[:, first])


def smooth(low, high, value):
    with np.errstate(invalid="ignore", divide="ignore"):
        t = np.clip(np.nan_to_num((value - low) / (high - low)), 0, 1)
    return t * t * (3 - 2 * t)


def cover(amount, fuzz, value):
    """How far places of this noise are covered when a share `amount` of all is."""
    soft = np.maximum(np.minimum(fuzz, np.minimum(amount, 1 - amount)), 1e-3)
    threshold = 1 + 1e-3 - amount * (1 + 2e-3)
    return smooth(threshold - soft, threshold + soft, value)


def wheel_tracks(lateral_m, value):
    """How far in a wheel's track: two a lane, fewer drive on the lanes beside."""
    side = lateral_m + taste.WANDER_M * (value - 0.5)
    lane = np.floor(side / 3.5 + 0.5)
    off = np.abs(np.abs(side - 3.5 * lane) - 0.75)
    driven = np.maximum(1 - 0.45 * np.abs(lane), 0)
    return driven * (1 - smooth(0.3 * taste.TRACK_M, 1.7 * taste.TRACK_M, off))


def film_ratio(albedo):
    """Wet albedo over dry: Lekner and Dorf."""
    outside, inside = 0.066, 1 - (1 - 0.066) / 1.333**2
    return (1 - outside) * (1 - inside) / (1 - inside * albedo)


def fresnel(sine):
    n2 = 1.333**2
    inside = np.sqrt(n2 - 1 + sine**2)
    across = (sine - inside) / (sine + inside)
    along = (n2 * sine - inside) / (n2 * sine + inside)
    return 0.5 * (across**2 + along**2)


def below_top(depth, kinds, fy):
    """How far each pixel is below the upper edge of its own thing, metres."""
    out = np.full(depth.shape, 99.0)
    for y in range(1, len(depth)):
        above, z = depth[y - 1], depth[y]
        with np.errstate(invalid="ignore"):
            same = (kinds[y] == kinds[y - 1]) & (np.abs(z - above) < 1.5 + 0.2 * z)
            fresh = np.where(above > 1.05 * z + 0.3, 0.0, 99.0)
        out[y] = np.where(same, out[y - 1] + z / fy, fresh)
    return out


def edited(frame, layers, weather, ambience, without=()):
    """(H, W, 3) sRGB."""
    labelled, shape = frame.label is not None, frame.image.shape[:2]
    kinds, has = layers.classes, lambda effect: effect not in without
    maps = {n: layers.maps[i].astype(float) for i, n in enumerate(NAMES)}
    curve, matrix = tone(weather, without)
    gain = exposure(weather, ambience, np.median(maps["illumination"]), without)

    def at(name):
        return spread(maps[name], layers.step, shape)

    for name in ("illumination", "luminance"):
        maps[name] = curve(maps[name])
    image = frame.image / 255.0
    light = curve(linear(frame.image))
    overcast = weather.overcast if has("relight") else 0.0
    ground = np.isin(kinds, GROUND)
    strength = overcast * (1 - 0.18 * overcast)
    luma = image @ WEIGHTS
    lines = at("ground_slope") * luma + at("ground_offset")
    lines = np.minimum(np.maximum(lines, at("ground_least")), at("ground_most")) * strength
    tinted = lines[..., None] + np.maximum(lines, 0)[..., None] * layers.tint
    standing = np.clip(at("object_slope") * luma + at("object_offset"), np.log(0.75), np.log(2.5))
    exponent = np.where(ground[..., None], tinted, strength * standing[..., None])
    light = light * np.exp(exponent) * gain @ matrix.T
    view = view_of(frame, ambience, layers.plane)
    lit, mean = at("illumination"), at("luminance")
    white = ambience.airlight @ WEIGHTS
    tint = ambience.airlight / white * np.array([1.0, 1.0, 1.02])
    snow = weather.snow_cover if has("snow_cover") else 0.0
    road_snow = weather.road_snow_cover if has("snow_cover") else 0.0
    deep_m = weather.snow_depth_m if has("snow_cover") else 0.0
    film = weather.wetness if has("film") else 0.0
    shine = weather.wetness if has("mirror") else 0.0
    most = look.SNOW_SHARE_OF_SKY * white
    bright = np.clip(0.85 * lit * gain, 0.62 * most, most)

    def laid(under, share, luminance):
        return under + share[..., None] * (luminance[..., None] * tint - under)

    rain = min(weather.rain_mm_per_h / look.FLOODING_MM_PER_H, 1.0)
    flooded_film = look.FILM_FLOODED * weather.wetness**2 + look.RAIN_FLOODED * rain**0.5
    mirror = {}
    for kind in ("sharp", "rough"):
        sky = maps[f"{kind}_sky"]
        left = np.maximum(1 - sky, 0)
        shown = np.stack([maps[f"{kind}_{c}"] for c in ("red", "green", "blue")], -1)
        shown = curve(np.maximum(shown, 0) / np.maximum(left, 0.01)[..., None]) * gain @ matrix.T
        mixed = left[..., None] * shown + sky[..., None] * ambience.airlight
        mirror[kind] = np.stack([spread(mixed[..., c], layers.step, shape) for c in range(3)], -1)
    # Wheel tracks wander where snow is drawn only.
    snowy = snow > 0 or road_snow > 0
    value = noise_of_row(view, ground, frame.camera, 0.0) if snowy else np.full(shape, 0.5)
    tracks = wheel_tracks(at("lateral_m"), value) if has("tracks") else np.zeros(shape)
    fuzz = np.minimum(0.07 + 0.25 * view.size_m, 0.5)
    edges = below_top(view.depth, kinds, frame.camera.focal_px[1])
    oblique = np.minimum(view.depth / frame.camera.focal_px[1], 1.0)
    on_walls = value
    done = light.copy()
    for name, material in MATERIALS.items():
        here = kinds == TRAIN_ID[name]
        if not here.any():
            continue
        now = light
        if film * material.porosity > 0:
            albedo = np.clip(now / (gain * np.maximum(lit, 0.02))[..., None], 0.01, 0.95)
            now = now * (1 + film * material.porosity * (film_ratio(albedo) - 1))
        is_ground = TRAIN_ID[name] in GROUND
        is_road = TRAIN_ID[name] == ROAD
        if is_ground and shine * material.mirror > 0:
            rut = tracks if is_road else np.zeros(shape)
            pools = weather.puddles if is_road and has("puddles") else 0.0
            lie = noise_of_row(view, ground, frame.camera, 11.3)
            pool = (
                cover(pools * (1 + taste.RUT_WATER * rut), fuzz, lie) if pools else np.zeros(shape)
            )
            water = shine * material.mirror * np.ones(shape)
            if not labelled:
                water = water * (1 - smooth(0.05, 0.20, view.height))
            flooded = flooded_film + pool * (1 - flooded_film)
            stones = water * (1 - flooded) * 0.5 * fresnel(np.sqrt(view.sine**2 + 0.25**2))
            calm = water * flooded * fresnel(view.sine)
            kept = (1 - stones - calm) * (1 - taste.POOL_DARKENING * pool)
            sharp = mirror["rough"] + pool[..., None] * (mirror["sharp"] - mirror["rough"])
            now = kept[..., None] * now + stones[..., None] * mirror["rough"]
            now = now + calm[..., None] * sharp
        if is_ground:
            amount = road_snow if is_road else snow * material.cover
            if amount > 0:
                rut = tracks if is_road else np.zeros(shape)
                softer = taste.TRACK_SOFTNESS if is_road else 0.0
                share = (1 - (1 - taste.TRACK_COVER) * rut) * cover(amount, fuzz + softer, value)
                under = np.minimum(now @ WEIGHTS / (0.12 * gain * lit), 2.0)
                least = taste.SLUSH if is_road else taste.CLEAN
                shade = (least + (1.02 - least) * value) * (1 - taste.SHOWING_THROUGH * (1 - under))
                now = laid(now, share, bright * shade)
        elif snow * material.cover > 0 and (material.cap_m > 0 or material.leaf > 0):
            lies = bright * (0.81 + 0.11 * on_walls)
            amount = snow * material.cover
            if material.leaf > 0:
                usual = np.maximum(mean, 0.002)
                detail = np.clip(0.5 + 0.7 * (now @ WEIGHTS / (usual * gain) - 1), 0, 1)
                share = cover(0.8 * amount, 0.5, 0.25 * on_walls + 0.75 * detail)
                lies = lies * np.minimum(0.25 + 4 * mean / np.maximum(lit, 0.02), 0.85)
            else:
                uneven = 0.6 + 0.8 * on_walls
                edge = material.cap_m * snow * uneven + 0.4 * deep_m
                share = np.clip((edge - edges) / np.maximum(oblique, 1e-5), 0, 1)
                if material.level > 0 and labelled:
                    level = smooth(0.55, 0.85, at("facing_up"))
                    oblique_fuzz = 0.07 + 0.25 * oblique
                    share = np.maximum(share, cover(amount * level, oblique_fuzz, on_walls))
            buried = deep_m * (0.6 + 0.8 * on_walls)
            lies_on = (
                snow
                * material.buried
                * (1 - smooth(0.7 * buried, 1.1 * buried + 1e-6, view.height))
            )
            share = np.where(view.depth < 30.0, np.maximum(share, lies_on), share)
            now = laid(now, share, lies)
        done = np.where(here[..., None], now, done)
    if has("sky") and weather.overcast > 0:
        feature = image @ np.array([-0.5, 0.0, 1.5])
        matte = np.clip(at("matte_slope") * feature + at("matte_offset"), 0, 1)
        up = sine_up(frame, ambience, layers.plane)
        sky = ambience.airlight * (1 + 0.6 * np.maximum(up, 0))[..., None]
        done = done + weather.overcast * matte[..., None] * (sky - done)
    return np.floor(srgb(done) + 0.5).astype(np.uint8)


def sine_up(frame, ambience, plane):
    """(H, W) how far each pixel's ray climbs over the road's plane, for a metre of its way."""
    camera = frame.camera
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(u.shape)], -1)
    street = rays @ (ambience.axes_world @ camera.world_from_camera[:3, :3]).T
    return (street[..., 2] - street[..., :2] @ plane[1:]) / np.linalg.norm(rays, axis=-1)
