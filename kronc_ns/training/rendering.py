"""Pictures of cars by casting rays: paint, glass one can see into, lamps, shadows, surroundings.

Rays are cast by embree, light is added up by `shading`. World axes as everywhere: x forward, y left, z up, ground at
z = 0, metres.
"""

from typing import Any

import cv2
import numpy as np
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh
from jaxtyping import Float, Float32, UInt8

from kronc_ns.geometry.poses import unit
from kronc_ns.training.appearance import Look
from kronc_ns.training.body import Body
from kronc_ns.training.cameras import SIZE, Shot
from kronc_ns.training.lighting import Surroundings
from kronc_ns.training.shading import GLASS, GLOSS, LEVELS, shade, shade_ground
from kronc_ns.training.shards import Picture

_VISIBLE_M = 0.04  # by how much a surface may lie before a keypoint that counts as visible
_SURFACE_M = 0.004  # rays start off the surface
_PANES = 2  # windows that one looks through
_SHADOW_M = 5.0  # from the car's centre: where its shadow may fall
_SKY_RAYS = 400_000  # in all, from the vertices of a body
_VIEWS = ("left", "right", "front", "rear", "top")


class Stage:
    """A body made ready for rays; keep it for all its pictures."""

    def __init__(self, body: Body, rng: np.random.Generator) -> None:
        mesh = body.mesh
        self.body = body
        self.bounds = np.stack([mesh.vertices.min(0), mesh.vertices.max(0)])
        corners = mesh.vertices[mesh.faces]
        self._scene = rtcore_scene.EmbreeScene()  # pyright: ignore[reportAttributeAccessIssue]
        self._triangles = TriangleMesh(self._scene, corners.astype(np.float32))
        self.faces = mesh.faces
        self.face_normal = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) + 1e-12)
        self.occlusion = self._open_sky(rng)
        self.ground_open = self._open_ground(rng)
        self.mesh = (
            mesh.normals.astype(np.float32),
            mesh.uv.astype(np.float32),
            self.occlusion,
            mesh.surface.astype(np.int64),
            self.face_normal.astype(np.float32),
        )
        self.texels, self.texture_at = _packed_textures(mesh.surfaces)
        self.decals, self.decal_texels = _packed_decals(body)

    def hit(self, start: Float[np.ndarray, "n 3"], direction: Float[np.ndarray, "n 3"]) -> dict[str, np.ndarray]:
        """Face (``primID``, -1: none), distance ``tfar`` and weights ``u``, ``v`` of its second and third corner."""
        return self._scene.run(
            np.ascontiguousarray(start, np.float32), np.ascontiguousarray(direction, np.float32), output=True
        )

    def blocked(self, start: Float[np.ndarray, "n 3"], direction: Float[np.ndarray, "n 3"]) -> np.ndarray:
        """Whether each ray meets the car."""
        start, direction = np.ascontiguousarray(start, np.float32), np.ascontiguousarray(direction, np.float32)
        return self._scene.run(start, direction, query="OCCLUDED") == 0

    def _open_sky(self, rng: np.random.Generator) -> Float32[np.ndarray, "v"]:
        """Share of the hemisphere that each vertex sees, weighted by the cosine."""
        mesh = self.body.mesh
        rays = int(np.clip(_SKY_RAYS // len(mesh.vertices), 4, 24))
        directions = unit(mesh.normals[:, None] + unit(rng.standard_normal((len(mesh.normals), rays, 3))))
        start = np.repeat(mesh.vertices + 2 * _SURFACE_M * mesh.normals, rays, axis=0)
        blocked = self.blocked(start, directions.reshape(-1, 3)).reshape(-1, rays)
        return (1 - blocked.mean(1)).astype(np.float32)

    def _open_ground(self, rng: np.random.Generator, rays: int = 64) -> Float32[np.ndarray, "40 40"]:
        """The same for places on the ground, over a square of 2 `_SHADOW_M`."""
        axis = (np.arange(40) + 0.5) / 40 * 2 * _SHADOW_M - _SHADOW_M
        places = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
        start = np.repeat(np.column_stack([places, np.full(len(places), 0.002)]), rays, axis=0)
        directions = unit(np.array([0, 0, 1.0]) + unit(rng.standard_normal((len(start), 3))))
        return (1 - self.blocked(start, directions).reshape(40, 40, rays).mean(2)).astype(np.float32)


def render(stage: Stage, look: Look, around: Surroundings, shot: Shot, rng: np.random.Generator) -> Picture:
    """One picture with the car's mask and keypoints; edges are smoothed by casting four more rays a pixel."""
    width, height = SIZE
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1).reshape(-1, 2)
    light = _packed_light(around)
    colour, surface = _trace(stage, look, around, light, shot, pixels)
    exposure = _exposure(colour, surface, around)
    shown = _displayed(colour, surface, around, exposure)
    kind = surface.reshape(height, width)
    edge = np.zeros((height, width), dtype=bool)
    edge[:, 1:] |= kind[:, 1:] != kind[:, :-1]
    edge[1:] |= kind[1:] != kind[:-1]
    edge[:, :-1] |= edge[:, 1:]
    edge[:-1] |= edge[1:]
    at = np.flatnonzero(edge)
    if len(at):
        offsets = np.array([[-0.375, -0.125], [0.125, -0.375], [0.375, 0.125], [-0.125, 0.375]])
        fine = (pixels[at, None] + offsets).reshape(-1, 2)
        again, which = _trace(stage, look, around, light, shot, fine)
        shown[at] = _displayed(again, which, around, exposure).reshape(-1, 4, 3).mean(1)
    rgb = np.round(255 * shown).astype(np.uint8).reshape(height, width, 3)
    mask = np.where(kind >= 0, 255, 0).astype(np.uint8)
    return Picture(rgb, mask, keypoints_seen(stage, shot), stage.body.name)


def keypoints_seen(stage: Stage, shot: Shot) -> Float[np.ndarray, "66 3"]:
    """u, v and state (0: no such point, 1: visible, 2: hidden or outside) of the body's keypoints."""
    present = stage.body.present
    points = np.where(present[:, None], stage.body.keypoints, 0.0)
    uv, depth = shot.project(points)
    eye = shot.c2w[:, 3]
    way = points - eye
    distance = np.linalg.norm(way, axis=1)
    found = stage.hit(np.broadcast_to(eye, way.shape), way / distance[:, None])
    free = (found["primID"] < 0) | (found["tfar"] > distance - _VISIBLE_M)
    inside = (depth > 0.05) & (uv > 0).all(1) & (uv < SIZE).all(1)
    state = np.where(present, np.where(free & inside, 1.0, 2.0), 0.0)
    return np.column_stack([np.where(depth[:, None] > 0.05, uv, -1e3), state])


def _trace(
    stage: Stage, look: Look, around: Surroundings, light: tuple[np.ndarray, ...], shot: Shot, pixels: np.ndarray
) -> tuple[Float[np.ndarray, "n 3"], np.ndarray]:
    """Radiance along the rays of pixels, and the surface of the car that each meets (-1: none)."""
    direction = shot.rays(pixels)
    start = np.broadcast_to(shot.c2w[:, 3], direction.shape)
    first = stage.hit(start, direction)
    face = first["primID"]
    surface = np.where(face >= 0, stage.body.mesh.surface[face], -1)
    colour = np.zeros((len(pixels), 3))
    active, found, origin = np.arange(len(pixels)), first, start
    share = np.ones(len(pixels))
    for pane in range(_PANES + 1):
        on = found["primID"] >= 0
        if (~on).any():
            miss = active[~on]
            behind = _surroundings(stage, around, light, origin[~on], direction[miss])
            colour[miss] += share[miss, None] * behind
        if not on.any():
            break
        active, origin = active[on], origin[on]
        found = {name: values[on] for name, values in found.items()}
        at, radiance = _on_car(stage, look, light, found, origin, direction[active], shot.focal_px)
        hit_surface = stage.body.mesh.surface[found["primID"]]
        clear = (look.kind[hit_surface] == GLASS) & (look.tint > 0.02) & (pane < _PANES)
        colour[active] += share[active, None] * radiance
        active, origin = active[clear], at[clear] + 1e-3 * direction[active[clear]]
        if not len(active):
            break
        share[active] *= look.tint
        found = stage.hit(origin, direction[active])
    return colour, surface


def _on_car(
    stage: Stage,
    look: Look,
    light: tuple[np.ndarray, ...],
    found: dict[str, np.ndarray],
    start: Float[np.ndarray, "n 3"],
    direction: Float[np.ndarray, "n 3"],
    focal_px: float,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Where rays meet the car, and the radiance that comes back."""
    face = found["primID"].astype(np.int64)
    at = start + found["tfar"][:, None] * direction
    weight = np.column_stack([1 - found["u"] - found["v"], found["u"], found["v"]])
    normal = stage.face_normal[face]
    facing = np.where((normal * direction).sum(1) > 0, -1.0, 1.0)
    sunlit = np.zeros(len(face))
    if light[5].any():
        turned = np.flatnonzero(facing * (normal @ light[4]) > 0)
        off = at[turned] + 2 * _SURFACE_M * (facing[:, None] * normal)[turned]
        sunlit[turned] = ~stage.blocked(off, np.broadcast_to(light[4], off.shape))
    paint = (
        look.kind,
        look.rgb,
        stage.texels,
        stage.texture_at,
        stage.decals,
        stage.decal_texels,
        GLOSS,
        look.flake,
        look.dirt,
        look.dirt_rgb,
    )
    out = np.empty((len(face), 3))
    footprint = found["tfar"] / focal_px
    shade(face, at, direction, footprint, stage.faces[face], weight, sunlit, stage.mesh, paint, light, out)
    return at, out


def _surroundings(
    stage: Stage,
    around: Surroundings,
    light: tuple[np.ndarray, ...],
    start: Float[np.ndarray, "n 3"],
    direction: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "n 3"]:
    """Radiance along rays that miss the car: the ground near it, else the panorama."""
    out = _panorama(around.sharp, direction)
    falling = direction[:, 2] < -1e-6
    distance = np.where(falling, start[:, 2] / np.where(falling, -direction[:, 2], 1.0), np.inf)
    place = start[:, :2] + np.where(falling, distance, 0.0)[:, None] * direction[:, :2]
    radius = np.linalg.norm(place, axis=1)
    on = np.flatnonzero(falling & (radius < around.ground_radius_m))
    if not len(on):
        return out
    place, near = place[on], radius[on] < 1.4 * _SHADOW_M
    shadow, dark = np.ones(len(on)), np.ones(len(on))
    if near.any():
        p = place[near]
        cell = np.clip(((p + _SHADOW_M) / (2 * _SHADOW_M) * 40 - 0.5), 0, 38.999)
        i, j = np.floor(cell).astype(int).T
        a, b = (cell - np.floor(cell)).T
        grid = stage.ground_open
        sky = (1 - a) * ((1 - b) * grid[i, j] + b * grid[i, j + 1]) + a * (
            (1 - b) * grid[i + 1, j] + b * grid[i + 1, j + 1]
        )
        dark[near] = 1 - around.shadow * (1 - sky)
        if light[5].any():
            off = np.column_stack([p, np.full(len(p), 0.003)])
            hidden = stage.blocked(off, np.broadcast_to(light[4], off.shape))
            shadow[near] = 1 - around.shadow * hidden
    ground = np.empty((len(on), 3))
    shade_ground(place, distance[on], shadow, dark, around.ground, around.ground_m, light, ground)
    out[on] = ground
    return out


def _panorama(image: Float32[np.ndarray, "h w 3"], direction: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Bilinear look-up of unit directions."""
    height, width = image.shape[:2]
    column = (np.arctan2(direction[:, 1], direction[:, 0]) / (2 * np.pi) + 0.5) * width - 0.5
    row = np.arccos(np.clip(direction[:, 2], -1, 1)) / np.pi * height - 0.5
    shape = (-1, 480) if len(direction) % 480 == 0 else (1, -1) if len(direction) < 32_000 else None
    if shape is None:  # OpenCV takes no longer rows
        half = len(direction) // 2
        return np.concatenate([_panorama(image, direction[:half]), _panorama(image, direction[half:])])
    found = cv2.remap(
        image,
        column.astype(np.float32).reshape(shape),
        row.astype(np.float32).reshape(shape),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_WRAP,
    )
    return found.reshape(-1, 3).astype(np.float64)


def _exposure(colour: np.ndarray, surface: np.ndarray, around: Surroundings) -> float:
    """As a camera meters: the scene's mean comes out as a grey."""
    on_car = surface >= 0
    level = np.clip(colour, 0, 6).mean()
    if around.backdrop is not None and on_car.any():
        level = np.clip(colour[on_car], 0, 6).mean()
        # the light of a studio, whatever the paint
        level = 0.5 * level + 0.5 * 0.35
    return around.exposure**2.2 / max(level, 1e-3) * 1.6


def _displayed(
    colour: np.ndarray, surface: np.ndarray, around: Surroundings, exposure: float
) -> Float[np.ndarray, "n 3"]:
    """Values 0 to 1 for a display, with a shoulder where film and sensors clip."""
    linear = colour * exposure
    shown = np.clip(linear / (1 + 0.25 * linear) * 1.15, 0, 1) ** (1 / 2.2)
    if around.backdrop is not None:
        shown = np.where((surface >= 0)[:, None], shown, around.backdrop)
    return shown


def _packed_light(around: Surroundings) -> tuple[np.ndarray, ...]:
    mean = around.ground.mean((0, 1))
    up = around.diffuse[0].mean(0)
    bounced = mean * (up + max(float(around.sun[2]), 0.0) * around.sun_rgb)
    return (
        around.sharp,
        around.glossy,
        around.rough,
        around.diffuse,
        around.sun.astype(np.float64),
        around.sun_rgb.astype(np.float64),
        np.concatenate([0.8 * bounced, mean]).astype(np.float64),
    )


def _packed_textures(surfaces: Any) -> tuple[np.ndarray, np.ndarray]:
    """All textures one after the other, and start, height and width of each surface's (height 0: none)."""
    at, parts, start = np.zeros((len(surfaces), 3), np.int64), [np.zeros((1, 3), np.uint8)], 1
    for index, surface in enumerate(surfaces):
        if surface.texture is not None:
            at[index] = start, *surface.texture.shape[:2]
            parts.append(surface.texture.reshape(-1, 3))
            start += len(parts[-1])
    return np.concatenate(parts), at


def _packed_decals(body: Body) -> tuple[np.ndarray, np.ndarray]:
    """Rows of view, left, top, metres per texel, gloss, then start, height, width of each level, then 1 for each
    surface that takes the decal; and all texels."""
    names = [surface.name for surface in body.mesh.surfaces]
    rows, parts, start = np.zeros((len(body.decals), 5 + 3 * LEVELS + len(names))), [], 0
    for index, decal in enumerate(body.decals):
        rows[index, :5] = _VIEWS.index(decal.view), *decal.corner, decal.metres_per_texel, decal.glossy
        rows[index, 5 + 3 * LEVELS :] = [decal.surfaces is None or name in decal.surfaces for name in names]
        for level, image in enumerate(_shrunk(decal.rgba)):
            rows[index, 5 + 3 * level : 8 + 3 * level] = start, *image.shape[:2]
            parts.append(image.reshape(-1, 4))
            start += len(parts[-1])
    return rows, np.concatenate(parts) if parts else np.zeros((1, 4), np.uint8)


def _shrunk(rgba: UInt8[np.ndarray, "h w 4"]) -> list[UInt8[np.ndarray, "_ _ 4"]]:
    """An image in halves of its size; colours count by their alpha."""
    alpha = rgba[..., 3:].astype(np.float32)
    whole = np.concatenate([rgba[..., :3] * (alpha / 255), alpha], axis=2)
    levels = [rgba]
    for level in range(1, LEVELS):
        size = (max(1, rgba.shape[1] >> level), max(1, rgba.shape[0] >> level))
        small = cv2.resize(whole, size, interpolation=cv2.INTER_AREA)
        colour = small[..., :3] * 255 / np.maximum(small[..., 3:], 1)
        levels.append(np.concatenate([colour, small[..., 3:]], axis=2).clip(0, 255).astype(np.uint8))
    return levels
