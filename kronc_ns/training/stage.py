"""A body made ready for casting rays: the scene, what its surfaces wear, how much sky they see."""

from typing import Any

import cv2
import numpy as np
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh
from jaxtyping import Float, Float32, UInt8

from kronc_ns.geometry.poses import unit
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.training.body import Body
from kronc_ns.training.shading import LEVELS

SURFACE_M = 0.004
"""Rays start so far off the surface."""
SHADOW_M = 5.0
"""From the car's centre: where its shadow may fall."""
_SKY_RAYS = 400_000  # in all, from the vertices of a body
_VIEWS = ("left", "right", "front", "rear", "top")
_VISIBLE_M = 0.04  # by how much a surface may lie before a keypoint that counts as visible
_RECESS_M, _HUB_RECESS_M = 0.06, 0.22  # and by how much more at most where it lies deeper
_DIRECTIONS, _FAR_M = 128, 10.0


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
        self.recess = self._recess()
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
        start = np.repeat(mesh.vertices + 2 * SURFACE_M * mesh.normals, rays, axis=0)
        blocked = self.blocked(start, directions.reshape(-1, 3)).reshape(-1, rays)
        return (1 - blocked.mean(1)).astype(np.float32)

    def _open_ground(self, rng: np.random.Generator, rays: int = 96) -> Float32[np.ndarray, "40 40"]:
        """The same for places on the ground, over a square of 2 `SHADOW_M`."""
        axis = (np.arange(40) + 0.5) / 40 * 2 * SHADOW_M - SHADOW_M
        places = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
        start = np.repeat(np.column_stack([places, np.full(len(places), 0.002)]), rays, axis=0)
        directions = unit(np.array([0, 0, 1.0]) + unit(rng.standard_normal((len(start), 3))))
        share = (1 - self.blocked(start, directions).reshape(40, 40, rays).mean(2)).astype(np.float32)
        return cv2.GaussianBlur(share, (0, 0), 0.8)

    def sky_above(self, place: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """`ground_open` between its cells; beyond them that of the nearest one."""
        size = len(self.ground_open)
        cell = np.clip((place + SHADOW_M) / (2 * SHADOW_M) * size - 0.5, 0, size - 1.001)
        i, j = np.floor(cell).astype(int).T
        a, b = (cell - np.floor(cell)).T
        near = (1 - b) * self.ground_open[i, j] + b * self.ground_open[i, j + 1]
        return (1 - a) * near + a * ((1 - b) * self.ground_open[i + 1, j] + b * self.ground_open[i + 1, j + 1])

    def _recess(self) -> Float[np.ndarray, "66"]:
        """How far before each keypoint a surface may lie when it is seen: some lie behind spokes or in seams.

        That is how far they lie behind the surface for the tenth of all directions from where they lie best.
        """
        index = np.arange(_DIRECTIONS) + 0.5
        turn, up = np.pi * (1 + 5**0.5) * index, 1 - 1.2 * index / _DIRECTIONS
        across = np.sqrt(1 - up**2)
        outwards = np.column_stack([across * np.cos(turn), across * np.sin(turn), up])
        points = np.where(self.body.present[:, None], self.body.keypoints, 0.0)
        start = points[:, None] + _FAR_M * outwards
        found = self.hit(start.reshape(-1, 3), np.broadcast_to(-1.0 * outwards, start.shape).reshape(-1, 3))
        reach = np.where(found["primID"] < 0, _FAR_M, found["tfar"].astype(np.float64))
        before = (_FAR_M - reach).reshape(len(points), -1)
        recess = np.clip(np.quantile(before, 0.1, axis=1), 0, _RECESS_M)
        for wheel in APOLLOCAR3D_66.wheels:  # hubs: as one sees them from beside, past spokes or not
            beside = outwards[:, 1] * np.sign(points[wheel, 1]) > 0.7
            recess[wheel] = np.clip(np.quantile(before[wheel, beside], 0.7), 0, _HUB_RECESS_M) if beside.any() else 0.0
        return recess + _VISIBLE_M


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
