"""Textured car meshes in glTF files, as arrays.

glTF is y-up; a file's (x, y, z) is (x, -z, y) in the world of this package: x forward, y left, z up, ground z = 0.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float, Int, UInt8
from PIL import Image

from kronc_ns.errors import KroncError

_FROM_GLTF = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


@dataclass(frozen=True, eq=False)
class Surface:
    """What a group of triangles is made of."""

    name: str
    """As the file calls it: paint, glass, light_front, tyre, ..."""
    rgb: Float[np.ndarray, "3"]
    """0 to 1, multiplies the texture."""
    texture: UInt8[np.ndarray, "h w 3"] | None = None
    """Colours over uv in 0..1, the first row at v = 1."""


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """All triangles of a car; metres, world axes."""

    vertices: Float[np.ndarray, "v 3"]
    normals: Float[np.ndarray, "v 3"]
    uv: Float[np.ndarray, "v 2"]
    faces: Int[np.ndarray, "f 3"]
    surface: Int[np.ndarray, "f"]
    """Index into ``surfaces`` of each triangle."""
    surfaces: tuple[Surface, ...]

    def geometry(self) -> trimesh.Trimesh:
        """For casting rays."""
        return trimesh.Trimesh(self.vertices, self.faces, vertex_normals=self.normals, process=False)


def load_textured_mesh(file: Path) -> TexturedMesh:
    """Read a .glb of true size; raises `KroncError` where it cannot be read."""
    if not file.is_file():
        raise KroncError(f"{file} does not exist: expected a car as .glb")
    try:
        scene = trimesh.load_scene(file)
    except Exception as error:  # trimesh raises whatever the file's content makes it stumble over
        raise KroncError(f"{file} cannot be read as glTF: {error}") from None
    vertices, normals, uvs, faces, surface, surfaces = [], [], [], [], [], []
    offset = 0
    for name in scene.graph.nodes_geometry:
        transform, key = scene.graph[name]
        part = scene.geometry[key].copy()
        part.apply_transform(transform)
        vertices.append(part.vertices @ _FROM_GLTF.T)
        normals.append(part.vertex_normals @ _FROM_GLTF.T)
        uv = getattr(part.visual, "uv", None)
        uvs.append(np.zeros((len(part.vertices), 2)) if uv is None else uv)
        faces.append(part.faces + offset)
        surface.append(np.full(len(part.faces), len(surfaces)))
        surfaces.append(_surface(getattr(part.visual, "material", None)))
        offset += len(part.vertices)
    return TexturedMesh(
        np.concatenate(vertices),
        np.concatenate(normals),
        np.concatenate(uvs),
        np.concatenate(faces),
        np.concatenate(surface),
        tuple(surfaces),
    )


def _surface(material: object) -> Surface:
    factor = getattr(material, "baseColorFactor", None)
    rgb = np.ones(3) if factor is None else np.asarray(factor, dtype=np.float64)[:3] / 255
    image: Image.Image | None = getattr(material, "baseColorTexture", None)
    texture = None if image is None else np.asarray(image.convert("RGB"))
    return Surface(str(getattr(material, "name", "") or "body"), rgb, texture)
