"""Cars in glTF files, with the keypoints beside them: read, and written from the procedural car.

glTF is y-up; a file's (x, y, z) is (x, -z, y) in the world of this package: x forward, y left, z up, ground z = 0.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float, Int, UInt8
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from kronc_ns.errors import KroncError
from kronc_ns.files.keypoints import describe_schema, read_schema
from kronc_ns.files.output import atomic_path, read_json, write_json
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.synthetic.car import CarModel
from kronc_ns.synthetic.render import albedo, interpolated_normal

KEYPOINTS_FILE = "keypoints3d.json"
_FROM_GLTF = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
_EDGE_M, _TILE = 0.06, 8
_FACES_PER_CHUNK = 10_000


@dataclass(frozen=True)
class MeshCar:
    """A car as somebody modelled it."""

    file: Path
    """The glTF file, for a renderer that reads its materials."""
    mesh: trimesh.Trimesh
    """All its triangles, metres."""
    keypoints: Float[np.ndarray, "66 3"]
    """Points on its surface in the ApolloCar3D order."""


def load_mesh_car(file: Path) -> MeshCar:
    """Read a .glb or .gltf of true size and ``keypoints3d.json`` beside it.

    The JSON holds ``{"schema": "apollocar3d-66", "keypoints": [[x, y, z], ...]}`` in metres. Raises `KroncError`
    where either is missing or not as expected.
    """
    if file.suffix.lower() not in (".glb", ".gltf") or not file.is_file():
        raise KroncError(f"{file} is no mesh that can be read: expected a .glb or .gltf file")
    points = _read_points(file.parent / KEYPOINTS_FILE)
    try:
        mesh = trimesh.load_scene(file).to_mesh()
    except Exception as error:  # trimesh raises whatever the file's content makes it stumble over
        raise KroncError(f"{file} cannot be read as glTF: {error}") from None
    if not len(mesh.faces):
        raise KroncError(f"{file} holds no triangles: expected a car")
    bare = trimesh.Trimesh(mesh.vertices @ _FROM_GLTF.T, mesh.faces, process=False)
    outside = np.maximum(bare.bounds[0] - points, points - bare.bounds[1]).max()
    if outside > 0.1 * bare.extents.max():
        raise KroncError(
            f"{file.parent / KEYPOINTS_FILE} has points {outside:.2f} m outside the mesh: expected metres, x forward, "
            "y left, z up (glTF's x, -z, y)"
        )
    return MeshCar(file, bare, points)


def _read_points(file: Path) -> Float[np.ndarray, "66 3"]:
    content: Any = read_json(file)
    if not isinstance(content, dict) or "keypoints" not in content:
        raise KroncError(f'{file}: expected {{"schema": ..., "keypoints": [[x, y, z], ...]}}')
    if read_schema(content.get("schema"), file) != APOLLOCAR3D_66:
        raise KroncError(f"{file}: expected schema {APOLLOCAR3D_66.name!r}")
    try:
        points = np.asarray(content["keypoints"], dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        points = np.zeros(0)
    if points.shape != (len(APOLLOCAR3D_66), 3) or not np.isfinite(points).all():
        raise KroncError(
            f"{file}: expected {len(APOLLOCAR3D_66)} keypoints of three finite numbers, got {points.shape}"
        )
    return points


def write_mesh_car(car: CarModel, file: Path) -> MeshCar:
    """Write the procedural car as .glb with its paint baked into a texture, and its keypoints beside it.

    Every triangle, cut to at most `_EDGE_M`, has a tile of the texture of its own.
    """
    solid = np.flatnonzero(car.mesh.area_faces > 1e-12)  # without the collapsed triangles at poles
    cut = trimesh.remesh.subdivide_to_size(
        car.mesh.vertices, car.mesh.faces[solid], _EDGE_M, max_iter=10, return_index=True
    )
    vertices, faces, part_of = cut  # pyright: ignore[reportAssignmentType] # three with return_index
    source = solid[part_of]
    corners = vertices[faces]
    side = math.ceil(math.sqrt(len(faces)))
    tiles = np.zeros((side * side, _TILE, _TILE, 4), np.uint8)
    for chunk in np.array_split(np.arange(len(faces)), math.ceil(len(faces) / _FACES_PER_CHUNK)):
        tiles[chunk] = _paint(car, corners[chunk], source[chunk])
    atlas = tiles.reshape(side, side, _TILE, _TILE, 4).swapaxes(1, 2).reshape(side * _TILE, side * _TILE, 4)
    row, column = np.divmod(np.arange(len(faces)), side)
    texel = np.stack([column, row], 1)[:, None] * _TILE + np.array([[0, 0], [_TILE - 1, 0], [0, _TILE - 1]]) + 0.5
    gloss = atlas[..., 3:]
    rough = np.concatenate([0 * gloss, 255 - gloss, 0 * gloss], axis=2)  # glTF: green is roughness, blue metalness
    material = PBRMaterial(
        baseColorTexture=Image.fromarray(atlas[..., :3]),
        metallicRoughnessTexture=Image.fromarray(rough),
        metallicFactor=0.0,
        roughnessFactor=1.0,
    )
    uv = texel.reshape(-1, 2) / (side * _TILE) * (1, -1) + (0, 1)
    normals = interpolated_normal(car.mesh, np.repeat(source, 3), corners.reshape(-1, 3))
    mesh = trimesh.Trimesh(
        corners.reshape(-1, 3) @ _FROM_GLTF,
        np.arange(3 * len(faces)).reshape(-1, 3),
        vertex_normals=normals @ _FROM_GLTF,
        visual=TextureVisuals(uv, material=material),
        process=False,
    )
    with atomic_path(file) as temporary:
        mesh.export(temporary, file_type="glb")
    schema = describe_schema(APOLLOCAR3D_66)
    write_json(file.parent / KEYPOINTS_FILE, {"schema": schema, "keypoints": car.keypoints.tolist()})
    return load_mesh_car(file)


def _paint(
    car: CarModel, corners: Float[np.ndarray, "f 3 3"], source: Int[np.ndarray, "f"]
) -> UInt8[np.ndarray, "f t t 4"]:
    """Tiles of red, green, blue, gloss; a triangle's corners are their top left, right and bottom."""
    b, a = np.meshgrid(*[np.linspace(0, 1, _TILE)] * 2, indexing="ij")
    weights = np.stack([1 - a - b, a, b], -1).reshape(-1, 3)  # also beyond the third edge, for filters to read
    points = (weights @ corners).reshape(-1, 3)
    face = np.repeat(source, _TILE**2)
    normal = interpolated_normal(car.mesh, face, points)
    colour, gloss = albedo(car, points, normal, face, np.full(len(points), _EDGE_M / _TILE))
    shade = np.concatenate([colour, gloss[:, None]], axis=1)
    return np.round(255 * np.clip(shade, 0, 1)).astype(np.uint8).reshape(-1, _TILE, _TILE, 4)
