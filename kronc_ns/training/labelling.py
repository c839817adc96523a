"""Keypoints on meshes that have none: pictures to read them off, and clicks cast onto the surface.

A label is a place in an orthographic view: ``"left"`` (x, z), ``"front"`` (y, z), ``"rear"`` (y, z) or ``"top"``
(x, y), metres in the world. It is cast against the mesh along the view's direction, which gives the point on the
surface; its mirror image is its partner's.

    python -m kronc_ns.training.labelling picture MESH.glb left OUT.png --window 0.5 2.4 0 1.2
    python -m kronc_ns.training.labelling check MESH.glb LABELS.json OUT.png --azimuth 40
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import cv2
import numpy as np
import trimesh
import tyro
from jaxtyping import Bool, Float, UInt8

from kronc_ns.errors import KroncError
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.training.meshes import TexturedMesh, load_textured_mesh

View: TypeAlias = Literal["left", "front", "rear", "top"]
_FAR_M = 20.0
# origin of the view's rays as a function of (a, b), and their direction
_DIRECTION = {"left": (0, -1, 0), "front": (-1, 0, 0), "rear": (1, 0, 0), "top": (0, 0, -1)}
_AXES = {"left": (0, 2), "front": (1, 2), "rear": (1, 2), "top": (0, 1)}
_FLIPPED = ("left", "rear")  # drawn with the first axis growing to the left: what a viewer there sees


@dataclass(frozen=True, eq=False)
class Labels:
    """Keypoints of a mesh."""

    points: Float[np.ndarray, "66 3"]
    """Metres; NaN where the car has no such feature."""

    @property
    def present(self) -> Bool[np.ndarray, "66"]:
        """Which features the car has."""
        return np.isfinite(self.points).all(1)


def cast(mesh: trimesh.Trimesh, view: View, ab: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """The surface points that one sees at places of an orthographic view; NaN where nothing is hit."""
    start, direction = _rays(view, ab)
    found = np.full((len(ab), 3), np.nan)
    located, ray, _ = mesh.ray.intersects_location(start, direction, multiple_hits=False)
    found[ray] = located
    return found


def read_labels(file: Path, mesh: trimesh.Trimesh) -> Labels:
    """Cast ``{"points": {"0": ["front", 0.61, 0.70], ...}}`` (left half; null: the car has none) onto the mesh.

    ``"middle"``: y of the plane of symmetry, where it is not 0.
    """
    content = json.loads(file.read_text())
    middle = content.get("middle", 0.0)
    points = np.full((len(APOLLOCAR3D_66), 3), np.nan)
    for key, label in content["points"].items():
        if label is None:
            continue
        view, a, b = label
        at = cast(mesh, view, np.array([[a, b]]))[0]
        if not np.isfinite(at).all():
            raise KroncError(f"{file}: point {key} at {view} ({a}, {b}) lies beside the car: expected a place on it")
        points[int(key)] = at
        points[APOLLOCAR3D_66.flip[int(key)]] = at * (1, -1, 1) + (0, 2 * middle, 0)
    return Labels(points)


def _rays(view: View, ab: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    direction = np.array(_DIRECTION[view], dtype=float)
    start = np.zeros((len(ab), 3)) - _FAR_M * direction
    start[:, list(_AXES[view])] = ab
    return start, np.broadcast_to(direction, start.shape)


def _colours(
    mesh: TexturedMesh, geometry: trimesh.Trimesh, start: np.ndarray, direction: np.ndarray
) -> Float[np.ndarray, "n 3"]:
    """Lambert shading with a light at the eye; white where nothing is hit."""
    located, ray, face = geometry.ray.intersects_location(start, direction, multiple_hits=False)
    out = np.ones((len(start), 3))
    corner = mesh.faces[face]
    weight = trimesh.triangles.points_to_barycentric(mesh.vertices[corner], located)
    normal = np.einsum("nk,nki->ni", weight, mesh.normals[corner])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-9
    rgb = np.array([s.rgb for s in mesh.surfaces])[mesh.surface[face]]
    uv = np.einsum("nk,nki->ni", weight, mesh.uv[corner])
    for index, surface in enumerate(mesh.surfaces):
        on = np.flatnonzero(mesh.surface[face] == index)
        if surface.texture is None or not len(on):
            continue
        height, width = surface.texture.shape[:2]
        column = np.floor(uv[on, 0] * width).astype(np.int64) % width
        row = np.floor((1 - uv[on, 1]) * height).astype(np.int64) % height
        rgb[on] = rgb[on] * surface.texture[row, column] / 255
    facing = np.abs(np.einsum("ni,ni->n", normal, direction[ray]))
    light = np.clip(normal @ np.array([0.3, 0.4, 0.86]), 0, 1)
    out[ray] = np.clip((rgb**0.6) * (0.25 + 0.5 * facing[:, None] + 0.35 * light[:, None]), 0, 1)
    return out


def picture(
    mesh: TexturedMesh, view: View, window: tuple[float, float, float, float], width: int = 1400
) -> UInt8[np.ndarray, "h w 3"]:
    """An orthographic view (RGB) of ``window`` (a0, a1, b0, b1) with a grid in metres."""
    a0, a1, b0, b1 = window
    scale = width / (a1 - a0)
    height = round((b1 - b0) * scale)
    a = a0 + (np.arange(width) + 0.5) / scale
    a = a[::-1] if view in _FLIPPED else a
    b = b1 - (np.arange(height) + 0.5) / scale
    places = np.stack(np.meshgrid(a, b), -1).reshape(-1, 2)
    start, direction = _rays(view, places)
    image = (255 * _colours(mesh, mesh.geometry(), start, direction)).astype(np.uint8).reshape(height, width, 3)
    step = next(s for s in (0.02, 0.05, 0.1, 0.2, 0.5) if s * scale >= 55)
    for value in np.arange(np.ceil(a0 / step), a1 / step) * step:
        column = round((value - a0) * scale)
        column = width - 1 - column if view in _FLIPPED else column
        image[:, column : column + 1] = (image[:, column : column + 1] // 2) + np.array([0, 0, 110], np.uint8)
        cv2.putText(image, f"{value:.2f}", (column + 2, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (220, 0, 0), 1, cv2.LINE_AA)
    for value in np.arange(np.ceil(b0 / step), b1 / step) * step:
        row = min(round((b1 - value) * scale), height - 1)
        image[row : row + 1] = (image[row : row + 1] // 2) + np.array([0, 110, 0], np.uint8)
        cv2.putText(image, f"{value:.2f}", (2, row - 2), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (220, 0, 0), 1, cv2.LINE_AA)
    return image


def overlay(
    mesh: TexturedMesh,
    points: Float[np.ndarray, "66 3"],
    azimuth_deg: float,
    elevation_deg: float = 12.0,
    width: int = 1400,
) -> UInt8[np.ndarray, "h w 3"]:
    """A perspective view (RGB) from an azimuth (0: front, 90: the car's left) with the points that are visible."""
    geometry = mesh.geometry()
    azimuth, elevation = np.deg2rad([azimuth_deg, elevation_deg])
    target = (geometry.bounds[0] + geometry.bounds[1]) / 2
    back = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    eye = target + 1.9 * geometry.extents[0] * back
    right = np.cross([0, 0, 1.0], back)
    right /= np.linalg.norm(right)
    axes = np.stack([right, -np.cross(back, right), -back])  # x right, y down, z forward
    height, focal = round(0.55 * width), 1.45 * width
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1).reshape(-1, 2)
    local = np.column_stack([(pixels - [width / 2, height / 2]) / focal, np.ones(len(pixels))])
    direction = local @ axes
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    start = np.broadcast_to(eye, direction.shape)
    image = (255 * _colours(mesh, geometry, start, direction)).astype(np.uint8).reshape(height, width, 3)
    for index in np.flatnonzero(np.isfinite(points).all(1)):
        way = points[index] - eye
        distance = np.linalg.norm(way)
        hit, _, _ = geometry.ray.intersects_location(eye[None], (way / distance)[None], multiple_hits=False)
        if len(hit) and np.linalg.norm(hit[0] - eye) < distance - 0.03:
            continue
        x, y, z = axes @ way
        at = (round(width / 2 + focal * x / z), round(height / 2 + focal * y / z))
        cv2.circle(image, at, 4, (255, 0, 200), 1, cv2.LINE_AA)
        cv2.circle(image, at, 1, (255, 255, 0), -1)
        cv2.putText(
            image, str(index), (at[0] + 5, at[1] - 4), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 0, 0), 1, cv2.LINE_AA
        )
    return image


@dataclass
class Picture:
    """Draw an orthographic view with a grid in metres."""

    mesh: tyro.conf.Positional[Path]
    view: tyro.conf.Positional[View]
    output: tyro.conf.Positional[Path]
    window: tuple[float, float, float, float] | None = None
    """a0 a1 b0 b1 in metres; default: the whole car."""

    def run(self) -> None:
        """Draw and write."""
        mesh = load_textured_mesh(self.mesh)
        low, high = mesh.vertices.min(0), mesh.vertices.max(0)
        a, b = _AXES[self.view]
        window = self.window or (low[a] - 0.1, high[a] + 0.1, low[b] - 0.05, high[b] + 0.1)
        cv2.imwrite(str(self.output), picture(mesh, self.view, window)[..., ::-1])


@dataclass
class Check:
    """Draw the labels that are visible in a perspective view."""

    mesh: tyro.conf.Positional[Path]
    labels: tyro.conf.Positional[Path]
    """Labels, or ``keypoints3d.json``."""
    output: tyro.conf.Positional[Path]
    azimuth: float = 40.0
    """Degrees; 0: front, 90: the car's left, 180: rear."""
    elevation: float = 12.0
    """Degrees."""

    def run(self) -> None:
        """Draw and write."""
        mesh = load_textured_mesh(self.mesh)
        content = json.loads(self.labels.read_text())
        points = (
            np.array(content["keypoints"])
            if "keypoints" in content
            else read_labels(self.labels, mesh.geometry()).points
        )
        cv2.imwrite(str(self.output), overlay(mesh, points, self.azimuth, self.elevation)[..., ::-1])


if __name__ == "__main__":
    command = tyro.cli(
        Annotated[Picture, tyro.conf.subcommand("picture")] | Annotated[Check, tyro.conf.subcommand("check")]
    )
    command.run()
