"""Ray-cast images of a procedural car: colour, mask and depth, with or without a car park around it.

World axes as in the car: x forward, y left, z up, ground at z = 0, metres. Cameras are OpenCV (x right, y down,
z forward) and the centre of the top-left pixel is (0.5, 0.5). Colours are shaded in display space, without gamma.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Float32, Int, UInt8

from kronc_ns.geometry.camera import Camera, rays
from kronc_ns.geometry.poses import unit
from kronc_ns.synthetic.car import CarModel
from kronc_ns.synthetic.car_paint import METRES_PER_TEXEL
from kronc_ns.synthetic.surroundings import SUN, shade_surroundings, sky_colour, surroundings_distance
from kronc_ns.synthetic.texture import sample

RAYS_PER_CHUNK = 400_000


@dataclass(frozen=True)
class Rendering:
    """One rendered view."""

    rgba: UInt8[np.ndarray, "h w 4"]
    """Straight alpha: the share of the pixel the car covers, or 255 with a background."""
    mask: UInt8[np.ndarray, "h w"]
    """255 where the car is the nearest surface at the pixel centre."""
    depth: Float32[np.ndarray, "h w"]
    """z-depth in metres of the nearest surface at the pixel centre, 0 where there is none."""


def keypoint_visibility(
    mesh: trimesh.Trimesh,
    points: Float[np.ndarray, "j 3"],
    centres: Float[np.ndarray, "n 3"],
    tolerance_m: float = 0.02,
) -> Bool[np.ndarray, "n j"]:
    """Whether the straight line from each camera centre reaches each surface point unobstructed (metres, world)."""
    ray = points[None] - centres[:, None]
    distance = np.linalg.norm(ray, axis=-1)
    start = np.broadcast_to(centres[:, None], ray.shape).reshape(-1, 3)
    hit_distance, _ = _first_hit(mesh, start, (ray / distance[..., None]).reshape(-1, 3))
    return hit_distance.reshape(distance.shape) >= distance - tolerance_m


def _first_hit(
    mesh: trimesh.Trimesh, start: Float[np.ndarray, "n 3"], direction: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Distance along unit rays to the nearest face, and its index; infinite and -1 for a miss."""
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
    camera: Camera,
    *,
    ground: bool,
    samples: int = 2,
) -> Rendering:
    """Renders the car from a camera with samples x samples rays a pixel; `ground` adds the car park."""
    width, height = camera.width, camera.height
    fine = camera.scaled(float(samples))
    colour = np.empty((height, width, 4), np.float32)
    band = max(1, RAYS_PER_CHUNK // (width * samples**2))
    for top in range(0, height, band):
        rows = np.arange(top * samples, min(top + band, height) * samples)
        ray, footprint = _camera_rays(c2w, fine, rows)
        rgba = _shade_rays(car, c2w[:, 3], ray, footprint, ground)
        colour[top : top + band] = rgba.reshape(-1, samples, width, samples, 4).mean((1, 3))
    colour[..., :3] /= np.maximum(colour[..., 3:], 1e-6)
    rgba = np.round(np.clip(colour, 0, 1) * 255).astype(np.uint8)
    return Rendering(rgba, *trace_mask_and_depth(car.mesh, c2w, camera, ground=ground))


def trace_mask_and_depth(
    mesh: trimesh.Trimesh,
    c2w: Float[np.ndarray, "3 4"],
    camera: Camera,
    *,
    ground: bool,
) -> tuple[UInt8[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Mask and depth as in `Rendering`, by one ray through each pixel's centre."""
    ray, _ = _camera_rays(c2w, camera, np.arange(camera.height))
    start = np.broadcast_to(c2w[:, 3], ray.shape)
    distance, face = _first_hit(mesh, start, ray)
    if ground:
        distance = np.minimum(distance, surroundings_distance(start, ray))
    z = np.where(np.isfinite(distance), distance * (ray @ c2w[:, 2]), 0)
    mask = np.where(face >= 0, 255, 0).astype(np.uint8)
    shape = camera.height, camera.width
    return mask.reshape(shape), z.astype(np.float32).reshape(shape)


def _camera_rays(
    c2w: Float[np.ndarray, "3 4"], camera: Camera, rows: Int[np.ndarray, "h"]
) -> tuple[Float[np.ndarray, "n 3"], float]:
    """Unit rays in the world through the pixel centres of rows (n = h width), and the angle of a pixel in radians."""
    pixels = np.stack(np.meshgrid(np.arange(camera.width) + 0.5, rows + 0.5), -1).reshape(-1, 2)
    ray = rays(camera.undistort(pixels), camera) @ c2w[:, :3].T
    return unit(ray), 1 / min(camera.fx, camera.fy)


def _shade_rays(
    car: CarModel, eye: Float[np.ndarray, "3"], ray: Float[np.ndarray, "n 3"], footprint: float, ground: bool
) -> Float32[np.ndarray, "n 4"]:
    """Premultiplied colour and coverage in 0..1 along rays from `eye`."""
    start = np.broadcast_to(eye, ray.shape)
    distance, face = _first_hit(car.mesh, start, ray)
    hit = face >= 0
    out = np.zeros((len(ray), 4), np.float32)
    point = eye + distance[hit, None] * ray[hit]
    out[hit, :3] = _shade_car(car, point, ray[hit], face[hit], footprint * distance[hit])
    out[hit, 3] = 1
    if ground:
        out[~hit, :3] = shade_surroundings(start[~hit], ray[~hit], footprint, lambda p: _contact_shadow(car, p))
        out[~hit, 3] = 1
    return out


def _shade_car(
    car: CarModel,
    p: Float[np.ndarray, "n 3"],
    ray: Float[np.ndarray, "n 3"],
    face: Int[np.ndarray, "n"],
    footprint: Float[np.ndarray, "n"],
) -> Float[np.ndarray, "n 3"]:
    """Colour of points on the car: layers over the base colour, sun, sky, sheen and reflections."""
    normal = interpolated_normal(car.mesh, face, p)
    normal *= -np.sign(np.einsum("ni,ni->n", car.mesh.face_normals[face], ray) *
                       np.einsum("ni,ni->n", car.mesh.face_normals[face], normal))[:, None]  # fmt: skip
    colour, gloss = albedo(car, p, normal, face, footprint)
    cos_view = np.clip(-np.einsum("ni,ni->n", normal, ray), 0, 1)
    occluded = np.clip(0.45 + 0.55 * (p[:, 2] - 0.05) / 0.5, 0.45, 1)
    sky = (0.52 + 0.24 * normal[:, 2]) * occluded
    light = sky + 0.48 * np.clip(normal @ SUN, 0, None)
    half = unit(SUN - ray)
    sheen = gloss * 0.40 * np.clip(np.einsum("ni,ni->n", normal, half), 0, None) ** (20 + 60 * gloss)
    fresnel = gloss**2 * (0.12 + 0.60 * (1 - cos_view) ** 3)
    mirror = ray + 2 * cos_view[:, None] * normal
    horizon = np.clip(0.5 + 3.0 * mirror[:, 2], 0, 1)[:, None]
    reflection = horizon * sky_colour(mirror) + (1 - horizon) * np.array([0.30, 0.29, 0.28])
    shaded = colour * light[:, None] * (1 - fresnel[:, None]) + reflection * fresnel[:, None] + sheen[:, None]
    return np.clip(shaded, 0, 1)


def interpolated_normal(
    mesh: trimesh.Trimesh, face: Int[np.ndarray, "n"], p: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Unit normals interpolated from the vertices of each face at points on it."""
    corner = mesh.faces[face]
    bary = trimesh.triangles.points_to_barycentric(mesh.vertices[corner], p)
    return unit(np.einsum("nk,nki->ni", bary, mesh.vertex_normals[corner]))


def albedo(
    car: CarModel,
    p: Float[np.ndarray, "n 3"],
    normal: Float[np.ndarray, "n 3"],
    face: Int[np.ndarray, "n"],
    footprint: Float[np.ndarray, "n"],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Colour and gloss in 0..1 after the material's layers are painted over its base, for pixels `footprint` m wide."""
    base = np.array([(*m.rgb, 255 * m.gloss) for m in car.materials]) / 255
    value = base[car.face_material[face]]
    for name, layer in car.layers.items():
        wears = np.array([name in m.layers for m in car.materials])
        facing = normal @ layer.facing
        on = np.flatnonzero(wears[car.face_material[face]] & (facing > layer.min_cos))
        column = (p[on] @ layer.right - layer.corner[0]) / METRES_PER_TEXEL
        row = (layer.corner[1] - p[on] @ layer.up) / METRES_PER_TEXEL
        texel = sample(layer.levels, column, row, footprint[on] / METRES_PER_TEXEL)
        value[on] = value[on] * (1 - texel[:, 3:4]) + texel[:, [0, 1, 2, 4]]
    return value[:, :3], value[:, 3]


def _contact_shadow(car: CarModel, p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Brightness of the ground at p: dark under the car, fading out beside it, more so away from the sun."""
    edge = np.abs(p[:, :2] + 0.18 * SUN[:2]) - np.array([car.shape.length / 2 - 0.12, car.shape.width / 2 - 0.08])
    distance = np.hypot(*np.maximum(edge, 0).T) + np.minimum(edge.max(1), 0)
    step = np.clip((distance + 0.30) / 0.85, 0, 1)
    return 0.22 + 0.78 * step**2 * (3 - 2 * step)
