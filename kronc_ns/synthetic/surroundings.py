"""A car park around the car: a textured floor, a ring of buildings, trees and cars, a sky; the same for every renderer.

World axes as in the car: x forward, y left, z up, ground at z = 0, metres. Colours are in display space.
"""

from collections.abc import Callable
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from kronc_ns.synthetic.texture import mip_levels, sample

SUN = np.array([0.45, 0.52, 0.73]) / np.linalg.norm([0.45, 0.52, 0.73])
"""Direction to the sun."""
WALL_RADIUS_M, WALL_HEIGHT_M, GROUND_HALF_M = 25.0, 14.0, 26.0


def ground_distance(start: Float[np.ndarray, "n 3"], ray: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Distance along unit rays to the ground plane, infinite above the horizon."""
    falling = ray[:, 2] < -1e-6
    return np.where(falling, start[:, 2] / np.where(falling, -ray[:, 2], 1), np.inf)


def wall_hit(
    start: Float[np.ndarray, "n 3"], ray: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 4"]]:
    """Distance along unit rays to the far side of the cylinder of buildings (infinite through its sky); its texture."""
    a = np.maximum((ray[:, :2] ** 2).sum(1), 1e-12)
    b = (start[:, :2] * ray[:, :2]).sum(1)
    root = b**2 - a * ((start[:, :2] ** 2).sum(1) - WALL_RADIUS_M**2)
    distance = np.where(root > 0, (np.sqrt(np.maximum(root, 0)) - b) / a, np.inf)
    finite = np.where(np.isfinite(distance) & (distance > 0), distance, 0)
    p = start + finite[:, None] * ray
    levels = wall_levels()
    texel_m = 2 * np.pi * WALL_RADIUS_M / levels[0].shape[1]
    column = (np.arctan2(p[:, 1], p[:, 0]) / (2 * np.pi) + 0.5) * levels[0].shape[1]
    texture = sample(levels, column, (WALL_HEIGHT_M - p[:, 2]) / texel_m, np.full(len(p), 1.5))
    texture *= ((finite > 0) & (p[:, 2] > 0) & (p[:, 2] < WALL_HEIGHT_M))[:, None]
    return np.where(texture[:, 3] > 0.5, distance, np.inf), texture


def sky_colour(ray: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Sky along unit rays: pale at the horizon, blue above, with soft clouds."""
    up = np.clip(ray[:, 2], 0, 1)[:, None]
    sky = np.array([0.80, 0.85, 0.90]) * (1 - up**0.6) + np.array([0.36, 0.56, 0.86]) * up**0.6
    x, y = (ray[:, i] / (0.25 + up[:, 0]) for i in (0, 1))
    cloud = np.sin(3.1 * x + 1.3 * np.sin(2.3 * y)) + np.sin(4.3 * y + 1.7 * np.sin(1.9 * x + 0.5))
    cover = 0.55 * np.clip(0.5 * cloud, 0, 1)[:, None] * np.clip(4 * up, 0, 1)
    return sky * (1 - cover) + 0.96 * cover


def surroundings_distance(start: Float[np.ndarray, "n 3"], ray: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Distance along unit rays to the ground or the buildings, infinite where the sky shows."""
    return np.minimum(ground_distance(start, ray), wall_hit(start, ray)[0])


def shade_surroundings(
    start: Float[np.ndarray, "n 3"],
    ray: Float[np.ndarray, "n 3"],
    footprint: float,
    shadow: Callable[[np.ndarray], np.ndarray],
) -> Float[np.ndarray, "n 3"]:
    """Colour of ground, distant buildings and sky along unit rays whose pixels are `footprint` radians wide.

    ``shadow`` gives the brightness [m] of ground points [m,3].
    """
    distance = ground_distance(start, ray)
    wall_distance, wall = wall_hit(start, ray)
    out = sky_colour(ray) * (1 - wall[:, 3:]) + wall[:, :3]
    on = np.flatnonzero((distance < wall_distance) & np.isfinite(distance))
    p = start[on] + distance[on, None] * ray[on]
    levels = ground_levels()
    texel_m = 2 * GROUND_HALF_M / levels[0].shape[0]
    size = footprint * distance[on] / np.maximum(-ray[on, 2], 0.02) ** 0.35 / texel_m
    colour = sample(levels, (GROUND_HALF_M - p[:, 1]) / texel_m, (GROUND_HALF_M - p[:, 0]) / texel_m, size)
    haze = np.clip((distance[on] - 25) / 120, 0, 1)[:, None]
    out[on] = (colour * shadow(p)[:, None]) * (1 - haze) + np.array([0.80, 0.85, 0.90]) * haze
    return out


@lru_cache(maxsize=1)
def ground_levels() -> tuple[UInt8[np.ndarray, "_ _ 3"], ...]:
    """Mip levels of the car park floor seen from above: row 0 is at the largest x, column 0 at the largest y."""
    rng, size = np.random.default_rng(11), 3072
    scale = size / (2 * GROUND_HALF_M)
    grain = np.zeros((size, size), np.float32)
    for cells, strength in ((16, 14), (64, 12), (256, 14), (1024, 18), (size // 2, 20), (size, 26)):
        noise = rng.standard_normal((cells, cells), dtype=np.float32)
        grain += strength / 2 * cv2.resize(noise, (size, size), interpolation=cv2.INTER_CUBIC)
    image = np.clip(112 + grain[..., None] * np.array([1.0, 0.98, 0.94], np.float32), 0, 255).astype(np.uint8)

    def pixel(x: float, y: float) -> tuple[int, int]:
        return round((GROUND_HALF_M - y) * scale), round((GROUND_HALF_M - x) * scale)

    def stroke(a: tuple[float, float], b: tuple[float, float], rgb: tuple[int, int, int], width_m: float) -> None:
        cv2.line(image, pixel(*a), pixel(*b), rgb, max(1, round(width_m * scale)), cv2.LINE_AA)

    for _ in range(120):
        at, axes = tuple(rng.integers(0, size, 2).tolist()), tuple(rng.integers(3, 20, 2).tolist())
        shade = int(rng.integers(84, 128))
        cv2.ellipse(image, at, axes, float(rng.uniform(0, 180)), 0, 360, (shade, shade, shade - 6), -1, cv2.LINE_AA)
    for _ in range(60):
        path = np.cumsum(np.vstack([rng.integers(0, size, (1, 2)), rng.integers(-30, 31, (14, 2))]), axis=0)
        cv2.polylines(image, [path.astype(np.int32)], False, (62, 61, 60), 1, cv2.LINE_AA)
    for row in (0.0, 11.6, -11.6):
        for k in range(-9, 10):
            y = 1.55 + 2.9 * k
            stroke((row - 2.9, y), (row + 2.5, y), (226, 226, 220), 0.11)
            at = pixel(row - 3.6, y - 1.2)
            cv2.putText(
                image, f"{k + 40 + int(row)}", at, cv2.FONT_HERSHEY_SIMPLEX, 0.8, (214, 196, 70), 2, cv2.LINE_AA
            )
        stroke((row + 2.5, -26.0), (row + 2.5, 26.0), (226, 226, 220), 0.11)
    for y in np.arange(-24.0, 25.0, 6.0):
        stroke((5.4, y - 0.9), (5.4, y + 0.9), (232, 232, 226), 0.16)
        cv2.fillPoly(
            image, [np.array([pixel(5.4, y + 1.7), pixel(5.9, y + 0.7), pixel(4.9, y + 0.7)])], (232, 232, 226)
        )
    paving = slice(pixel(-4.0, 0.0)[1], pixel(-7.0, 0.0)[1])
    tint = rng.integers(-22, 23, (8, 130, 1)) + np.array([26, 6, -14])
    tiles = cv2.resize(tint.astype(np.float32), (size, paving.stop - paving.start), interpolation=cv2.INTER_NEAREST)
    image[paving] = np.clip(image[paving] + tiles, 0, 255).astype(np.uint8)
    for x in np.linspace(-7.0, -4.0, 9):
        stroke((x, -26.0), (x, 26.0), (74, 70, 66), 0.03)
    for x, y in ((3.6, 2.2), (-3.2, -3.4), (4.4, -5.2), (-9.0, 6.0)):
        cv2.circle(image, pixel(x, y), round(0.36 * scale), (70, 68, 66), -1, cv2.LINE_AA)
        cv2.circle(image, pixel(x, y), round(0.28 * scale), (128, 124, 118), 2, cv2.LINE_AA)
    return mip_levels(image)


@lru_cache(maxsize=1)
def wall_levels() -> tuple[UInt8[np.ndarray, "_ _ 4"], ...]:
    """Mip levels of the panorama around the car park, alpha 0 where the sky shows."""
    rng, width = np.random.default_rng(5), 4096
    scale = width / (2 * np.pi * WALL_RADIUS_M)
    height = round(WALL_HEIGHT_M * scale)
    image = np.zeros((height, width, 4), np.uint8)

    def block(x0: float, x1: float, z0: float, z1: float, rgb: np.ndarray) -> None:
        corner, other = (round(x0), round(height - z1 * scale)), (round(x1), round(height - z0 * scale))
        cv2.rectangle(image, corner, other, (*(int(v) for v in rgb), 255), -1)

    x = 0.0
    while x < width:
        wide, tall = rng.uniform(5, 12) * scale, rng.uniform(4.5, 12.5)
        facade = rng.uniform(105, 205) + rng.uniform(-16, 16, 3)
        block(x, x + wide, 0.0, tall, facade)
        block(x, x + wide, tall - 0.35, tall, facade * 0.6)
        step, sill = rng.uniform(1.5, 2.6) * scale, rng.uniform(1.1, 1.7)
        for left in np.arange(x + 0.4 * step, x + wide - 0.7 * step, step):
            for z in np.arange(0.9, tall - sill - 0.5, sill + 1.1):
                block(left - 3, left + 0.5 * step + 3, z - 0.12, z + sill + 0.1, facade * 0.75 + 50)
                block(left, left + 0.5 * step, z, z + sill, rng.uniform(35, 90) + np.array([0, 6, 16]))
        x += wide
    for _ in range(34):
        at, crown = rng.uniform(0.02, 0.98) * width, rng.uniform(2.2, 4.6)
        block(at - 4, at + 4, 0.0, crown, np.array([74, 58, 44]))
        for _ in range(26):
            centre = (round(at + rng.normal(0, 0.8 * scale)), round(height - (crown + rng.normal(0, 0.7)) * scale))
            green = rng.uniform(0.6, 1.2) * np.array([66, 98, 46])
            cv2.circle(image, centre, round(rng.uniform(0.3, 0.7) * scale), (*green.tolist(), 255), -1, cv2.LINE_AA)
    for _ in range(22):
        at, rgb = rng.uniform(0.01, 0.97) * width, rng.uniform(50, 210) + rng.uniform(-40, 40, 3)
        block(at, at + 4.3 * scale, 0.3, 0.95, rgb)
        block(at + 0.8 * scale, at + 3.6 * scale, 0.95, 1.45, rgb * 0.8)
        block(at + 1.0 * scale, at + 3.4 * scale, 1.0, 1.36, np.array([40, 48, 56]))
        for wheel in (0.85, 3.45):
            centre = (round(at + wheel * scale), round(height - 0.33 * scale))
            cv2.circle(image, centre, round(0.33 * scale), (28, 28, 30, 255), -1, cv2.LINE_AA)
    return mip_levels(image)
