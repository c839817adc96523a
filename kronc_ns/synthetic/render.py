"""Ray-cast images of a procedural car: colour, mask and depth, with or without a car park around it.

World axes as in the car: x forward, y left, z up, ground at z = 0, metres. Cameras are OpenCV (x right, y down,
z forward) and the centre of the top-left pixel is (0.5, 0.5). Colours are shaded in display space, without gamma.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import trimesh
from jaxtyping import Bool, Float

from kronc_ns.synthetic.car import CarModel
from kronc_ns.synthetic.car_paint import METRES_PER_TEXEL, mip_levels

SUN = np.array([0.45, 0.52, 0.73]) / np.linalg.norm([0.45, 0.52, 0.73])
"""Direction to the sun."""
WALL_RADIUS_M, WALL_HEIGHT_M, GROUND_HALF_M = 25.0, 14.0, 26.0
RAYS_PER_CHUNK = 400_000


@dataclass(frozen=True)
class Rendering:
    """One rendered view."""

    rgba: np.ndarray
    """[H,W,4] uint8, straight alpha: the share of the pixel the car covers, or 255 with a background."""
    mask: np.ndarray
    """[H,W] uint8: 255 where the car is the nearest surface at the pixel centre."""
    depth: np.ndarray
    """[H,W] float32: z-depth in metres of the nearest surface at the pixel centre, 0 where there is none."""


def keypoint_visibility(
    mesh: trimesh.Trimesh,
    points: Float[np.ndarray, "j 3"],
    centres: Float[np.ndarray, "n 3"],
    tolerance_m: float = 0.02,
) -> Bool[np.ndarray, "n j"]:
    """Whether the straight line from each camera centre [n,3] reaches each surface point [j,3] unobstructed."""
    ray = points[None] - centres[:, None]
    distance = np.linalg.norm(ray, axis=-1)
    start = np.broadcast_to(centres[:, None], ray.shape).reshape(-1, 3)
    hit_distance, _ = _first_hit(mesh, start, (ray / distance[..., None]).reshape(-1, 3))
    return hit_distance.reshape(distance.shape) >= distance - tolerance_m


def _first_hit(mesh: trimesh.Trimesh, start: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance [n] along unit rays to the nearest face and its index [n]; infinite and -1 for a miss."""
    face = np.asarray(mesh.ray.intersects_first(start, direction))
    hit = np.flatnonzero(face >= 0)
    distance = np.full(len(face), np.inf)
    normal = mesh.face_normals[face[hit]]
    anchor = mesh.vertices[mesh.faces[face[hit], 0]]
    slope = np.einsum("ni,ni->n", normal, direction[hit])
    offset = np.einsum("ni,ni->n", normal, anchor - start[hit])
    distance[hit] = offset / np.where(np.abs(slope) < 1e-9, 1e-9, slope)
    return distance, face


def render_view(
    car: CarModel,
    c2w: Float[np.ndarray, "3 4"],
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    width: int,
    height: int,
    *,
    ground: bool,
    samples: int = 2,
) -> Rendering:
    """Renders the car from a pinhole camera with samples x samples rays a pixel; `ground` adds the car park."""
    fine = (cx * samples, cy * samples, fx * samples, fy * samples)
    colour = np.empty((height, width, 4), np.float32)
    band = max(1, RAYS_PER_CHUNK // (width * samples**2))
    for top in range(0, height, band):
        rows = np.arange(top * samples, min(top + band, height) * samples)
        ray, footprint = _camera_rays(c2w, fine, rows, width * samples)
        rgba = _shade_rays(car, c2w[:, 3], ray, footprint, ground)
        colour[top : top + band] = rgba.reshape(-1, samples, width, samples, 4).mean((1, 3))
    colour[..., :3] /= np.maximum(colour[..., 3:], 1e-6)
    rgba = np.round(np.clip(colour, 0, 1) * 255).astype(np.uint8)
    ray, _ = _camera_rays(c2w, (cx, cy, fx, fy), np.arange(height), width)
    start = np.broadcast_to(c2w[:, 3], ray.shape)
    distance, face = _first_hit(car.mesh, start, ray)
    if ground:
        distance = np.minimum(distance, np.minimum(_ground_distance(start, ray), _wall_hit(start, ray)[0]))
    z = np.where(np.isfinite(distance), distance * (ray @ c2w[:, 2]), 0)
    mask = np.where(face >= 0, 255, 0).astype(np.uint8)
    return Rendering(rgba, mask.reshape(height, width), z.astype(np.float32).reshape(height, width))


def _camera_rays(
    c2w: np.ndarray, intrinsics: tuple[float, ...], rows: np.ndarray, width: int
) -> tuple[np.ndarray, float]:
    """Unit rays [rows * width, 3] in the world through pixel centres, and the angle of a pixel in radians."""
    cx, cy, fx, fy = intrinsics
    u, v = np.meshgrid((np.arange(width) + 0.5 - cx) / fx, (rows + 0.5 - cy) / fy)
    ray = np.stack([u, v, np.ones_like(u)], -1).reshape(-1, 3) @ c2w[:, :3].T
    return ray / np.linalg.norm(ray, axis=1, keepdims=True), 1 / min(fx, fy)


def _shade_rays(car: CarModel, eye: np.ndarray, ray: np.ndarray, footprint: float, ground: bool) -> np.ndarray:
    """Premultiplied colour and coverage [n,4] in 0..1 along rays from `eye`."""
    start = np.broadcast_to(eye, ray.shape)
    distance, face = _first_hit(car.mesh, start, ray)
    hit = face >= 0
    out = np.zeros((len(ray), 4), np.float32)
    point = eye + distance[hit, None] * ray[hit]
    out[hit, :3] = _shade_car(car, point, ray[hit], face[hit], footprint * distance[hit])
    out[hit, 3] = 1
    if ground:
        out[~hit, :3] = _shade_surroundings(car, start[~hit], ray[~hit], footprint)
        out[~hit, 3] = 1
    return out


def _shade_car(car: CarModel, p: np.ndarray, ray: np.ndarray, face: np.ndarray, footprint: np.ndarray) -> np.ndarray:
    """Colour [n,3] of points on the car: layers over the base colour, sun, sky, sheen and reflections."""
    normal = _interpolated_normal(car.mesh, face, p)
    normal *= -np.sign(np.einsum("ni,ni->n", car.mesh.face_normals[face], ray) *
                       np.einsum("ni,ni->n", car.mesh.face_normals[face], normal))[:, None]  # fmt: skip
    colour, gloss = _albedo(car, p, normal, face, footprint)
    cos_view = np.clip(-np.einsum("ni,ni->n", normal, ray), 0, 1)
    occluded = np.clip(0.45 + 0.55 * (p[:, 2] - 0.05) / 0.5, 0.45, 1)
    sky = (0.52 + 0.24 * normal[:, 2]) * occluded
    light = sky + 0.48 * np.clip(normal @ SUN, 0, None)
    half = SUN - ray
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    sheen = gloss * 0.40 * np.clip(np.einsum("ni,ni->n", normal, half), 0, None) ** (20 + 60 * gloss)
    fresnel = gloss**2 * (0.12 + 0.60 * (1 - cos_view) ** 3)
    mirror = ray + 2 * cos_view[:, None] * normal
    horizon = np.clip(0.5 + 3.0 * mirror[:, 2], 0, 1)[:, None]
    reflection = horizon * _sky_colour(mirror) + (1 - horizon) * np.array([0.30, 0.29, 0.28])
    shaded = colour * light[:, None] * (1 - fresnel[:, None]) + reflection * fresnel[:, None] + sheen[:, None]
    return np.clip(shaded, 0, 1)


def _interpolated_normal(mesh: trimesh.Trimesh, face: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Unit normals [n,3] interpolated from the vertices of each face at points on it."""
    corner = mesh.faces[face]
    bary = trimesh.triangles.points_to_barycentric(mesh.vertices[corner], p)
    normal = np.einsum("nk,nki->ni", bary, mesh.vertex_normals[corner])
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _albedo(
    car: CarModel, p: np.ndarray, normal: np.ndarray, face: np.ndarray, footprint: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Colour [n,3] in 0..1 and gloss [n] after the material's layers are painted over its base."""
    base = np.array([(*m.rgb, 255 * m.gloss) for m in car.materials]) / 255
    value = base[car.face_material[face]]
    for name, layer in car.layers.items():
        wears = np.array([name in m.layers for m in car.materials])
        facing = normal @ layer.facing
        on = np.flatnonzero(wears[car.face_material[face]] & (facing > layer.min_cos))
        column = (p[on] @ layer.right - layer.corner[0]) / METRES_PER_TEXEL
        row = (layer.corner[1] - p[on] @ layer.up) / METRES_PER_TEXEL
        texel = _sample(layer.levels, column, row, footprint[on] / METRES_PER_TEXEL)
        value[on] = value[on] * (1 - texel[:, 3:4]) + texel[:, [0, 1, 2, 4]]
    return value[:, :3], value[:, 3]


def _sample(levels: tuple[np.ndarray, ...], column: np.ndarray, row: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Bilinear texture values [n,C] in 0..1 at texel coordinates of level 0, from the level that fits `size` texels."""
    level = np.clip(np.round(np.log2(np.maximum(size, 1))), 0, len(levels) - 1).astype(int)
    out = np.empty((len(column), levels[0].shape[2]), np.float32)
    for i in np.unique(level):
        on, image = level == i, levels[i]
        x, y = column[on] / 2**i - 0.5, row[on] / 2**i - 0.5
        x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
        wx, wy = (x - x0).astype(np.float32)[:, None], (y - y0).astype(np.float32)[:, None]
        xa, xb = (np.clip(x0 + d, 0, image.shape[1] - 1) for d in (0, 1))
        ya, yb = (np.clip(y0 + d, 0, image.shape[0] - 1) for d in (0, 1))
        upper = image[ya, xa] * (1 - wx) + image[ya, xb] * wx
        lower = image[yb, xa] * (1 - wx) + image[yb, xb] * wx
        out[on] = (upper * (1 - wy) + lower * wy) / 255
    return out


def _ground_distance(start: np.ndarray, ray: np.ndarray) -> np.ndarray:
    """Distance [n] along unit rays to the ground plane, infinite above the horizon."""
    falling = ray[:, 2] < -1e-6
    return np.where(falling, start[:, 2] / np.where(falling, -ray[:, 2], 1), np.inf)


def _wall_hit(start: np.ndarray, ray: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance [n] to the far side of the cylinder of buildings (infinite through its sky) and its texture [n,4]."""
    a = np.maximum((ray[:, :2] ** 2).sum(1), 1e-12)
    b = (start[:, :2] * ray[:, :2]).sum(1)
    root = b**2 - a * ((start[:, :2] ** 2).sum(1) - WALL_RADIUS_M**2)
    distance = np.where(root > 0, (np.sqrt(np.maximum(root, 0)) - b) / a, np.inf)
    finite = np.where(np.isfinite(distance) & (distance > 0), distance, 0)
    p = start + finite[:, None] * ray
    levels = _wall_levels()
    texel_m = 2 * np.pi * WALL_RADIUS_M / levels[0].shape[1]
    column = (np.arctan2(p[:, 1], p[:, 0]) / (2 * np.pi) + 0.5) * levels[0].shape[1]
    texture = _sample(levels, column, (WALL_HEIGHT_M - p[:, 2]) / texel_m, np.full(len(p), 1.5))
    texture *= ((finite > 0) & (p[:, 2] > 0) & (p[:, 2] < WALL_HEIGHT_M))[:, None]
    return np.where(texture[:, 3] > 0.5, distance, np.inf), texture


def _sky_colour(ray: np.ndarray) -> np.ndarray:
    """Sky [n,3] along unit rays: pale at the horizon, blue above, with soft clouds."""
    up = np.clip(ray[:, 2], 0, 1)[:, None]
    sky = np.array([0.80, 0.85, 0.90]) * (1 - up**0.6) + np.array([0.36, 0.56, 0.86]) * up**0.6
    x, y = (ray[:, i] / (0.25 + up[:, 0]) for i in (0, 1))
    cloud = np.sin(3.1 * x + 1.3 * np.sin(2.3 * y)) + np.sin(4.3 * y + 1.7 * np.sin(1.9 * x + 0.5))
    cover = 0.55 * np.clip(0.5 * cloud, 0, 1)[:, None] * np.clip(4 * up, 0, 1)
    return sky * (1 - cover) + 0.96 * cover


def _shade_surroundings(car: CarModel, start: np.ndarray, ray: np.ndarray, footprint: float) -> np.ndarray:
    """Colour [n,3] of ground, distant buildings and sky."""
    distance = _ground_distance(start, ray)
    wall_distance, wall = _wall_hit(start, ray)
    out = _sky_colour(ray) * (1 - wall[:, 3:]) + wall[:, :3]
    on = np.flatnonzero((distance < wall_distance) & np.isfinite(distance))
    p = start[on] + distance[on, None] * ray[on]
    levels = _ground_levels()
    texel_m = 2 * GROUND_HALF_M / levels[0].shape[0]
    size = footprint * distance[on] / np.maximum(-ray[on, 2], 0.02) ** 0.35 / texel_m
    colour = _sample(levels, (GROUND_HALF_M - p[:, 1]) / texel_m, (GROUND_HALF_M - p[:, 0]) / texel_m, size)
    haze = np.clip((distance[on] - 25) / 120, 0, 1)[:, None]
    out[on] = (colour * _contact_shadow(car, p)[:, None]) * (1 - haze) + np.array([0.80, 0.85, 0.90]) * haze
    return out


def _contact_shadow(car: CarModel, p: np.ndarray) -> np.ndarray:
    """Brightness [n] of the ground at p: dark under the car, fading out beside it, more so away from the sun."""
    edge = np.abs(p[:, :2] + 0.18 * SUN[:2]) - np.array([car.shape.length / 2 - 0.12, car.shape.width / 2 - 0.08])
    distance = np.hypot(*np.maximum(edge, 0).T) + np.minimum(edge.max(1), 0)
    step = np.clip((distance + 0.30) / 0.85, 0, 1)
    return 0.22 + 0.78 * step**2 * (3 - 2 * step)


@lru_cache(maxsize=1)
def _ground_levels() -> tuple[np.ndarray, ...]:
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
def _wall_levels() -> tuple[np.ndarray, ...]:
    """Mip levels of the panorama around the car park [H,W,4], alpha 0 where the sky shows."""
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
