"""Rendered cars that no detector was trained on, and pictures without any car."""

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import trimesh
from jaxtyping import Bool, Float, UInt8

from kronc_ns.capture.detection.detector import CarImage, Detector
from kronc_ns.synthetic.scenes import walk_poses
from kronc_ns.training.appearance import draw_look
from kronc_ns.training.bodies import labelled_body
from kronc_ns.training.body import Body
from kronc_ns.training.calibration import judged
from kronc_ns.training.cameras import Shot, draw_shot
from kronc_ns.training.lighting import draw_surroundings
from kronc_ns.training.meshes import Surface, TexturedMesh
from kronc_ns.training.procedural import draw_procedural
from kronc_ns.training.rendering import render
from kronc_ns.training.shards import Picture
from kronc_ns.training.stage import Stage

UNSEEN = ("porsche_911", "md_dino246")
"""Cars kept out of training."""
DRAWN = ("sports", "mpv")
"""Styles of procedural cars that came after version 1 of the weights."""
WALK_FOCAL_PX = 420.0
"""Of the camera of `rendered_walk`."""
_BINS = 10
_VIEWS = 4  # of a drawn body


@lru_cache(maxsize=2)
def _stage(folder: Path) -> Stage:
    return Stage(labelled_body(folder), np.random.default_rng(0))


def rendered_walk(folder: Path, views: int, seed: int, output: Path) -> tuple[list[Path], Float[np.ndarray, "n 3 4"]]:
    """A walk around the car of a folder, in one paint and one place: photos, and their true poses."""
    rng, stage = np.random.default_rng(seed), _stage(folder)
    look, around = draw_look(rng, stage.body.mesh), draw_surroundings(rng, [])
    c2w = walk_poses(views, rng)
    pictures = [render(stage, look, around, Shot(WALK_FOCAL_PX, pose)).rgb for pose in c2w]
    return save_all(pictures, output), c2w


def unseen_pictures(cars: Path, count: int, seed: int) -> list[Picture]:
    """The cars kept out of training from anywhere, in any paint and place, as training pictures are drawn."""
    rng, pictures = np.random.default_rng(seed), []
    for number in range(count):
        pictures.append(_picture(_stage(cars / UNSEEN[number % len(UNSEEN)]), rng))
    return pictures


def drawn_pictures(count: int, seed: int) -> list[Picture]:
    """Procedural cars of the styles that version 1 of the weights was not trained on, drawn likewise."""
    rng, pictures = np.random.default_rng(seed), []
    for number in range(count):
        if number % _VIEWS == 0:
            stage = Stage(draw_procedural(rng, DRAWN[number // _VIEWS % len(DRAWN)]), rng)
        pictures.append(_picture(stage, rng))
    return pictures


def _picture(stage: Stage, rng: np.random.Generator) -> Picture:
    """A car from anywhere, in any paint and place."""
    shot, around = draw_shot(rng, stage.bounds), draw_surroundings(rng, [])
    return render(stage, draw_look(rng, stage.body.mesh), around, shot)


def without_car(kind: str, seed: int) -> UInt8[np.ndarray, "h w 3"]:
    """Surroundings alone (``kind`` "surroundings"), or with some other thing ("object")."""
    rng = np.random.default_rng([seed, len(kind)])
    parts = (
        [_solid(rng) for _ in range(int(rng.integers(1, 5)))]
        if kind == "object"
        else [trimesh.creation.box([0.01] * 3)]
    )
    whole: trimesh.Trimesh = trimesh.util.concatenate(parts)  # pyright: ignore[reportAssignmentType]
    surface = np.concatenate([np.full(len(part.faces), i) for i, part in enumerate(parts)])
    surfaces = tuple(Surface(str(rng.choice(["paint", "glass", "plain", "rim"])), rng.uniform(0, 1, 3)) for _ in parts)
    low = whole.bounds[0, 2]
    vertices = np.asarray(whole.vertices) - [0, 0, low]
    uv = np.zeros((len(vertices), 2))
    mesh = TexturedMesh(vertices, np.asarray(whole.vertex_normals), uv, np.asarray(whole.faces), surface, surfaces)
    stage = Stage(Body(kind, mesh, np.full((66, 3), np.nan)), rng)
    view = stage.bounds if kind == "object" else np.array([[-2.2, -0.9, 0.0], [2.2, 0.9, 1.5]])
    return render(stage, draw_look(rng, mesh), draw_surroundings(rng, []), draw_shot(rng, view)).rgb


def _solid(rng: np.random.Generator) -> trimesh.Trimesh:
    size = rng.uniform(0.3, 2.5, 3)
    kind = int(rng.integers(5))
    if kind == 0:
        solid = trimesh.creation.box(size)
    elif kind == 1:
        solid = trimesh.creation.cylinder(radius=size[0] / 2, height=size[2])
    elif kind == 2:
        solid = trimesh.creation.icosphere(subdivisions=3, radius=size[0] / 2)
    elif kind == 3:
        solid = trimesh.creation.torus(major_radius=size[0] / 2, minor_radius=size[0] / 8)
    else:
        solid = trimesh.creation.cone(radius=size[0] / 2, height=size[2])
    solid.apply_transform(trimesh.transformations.random_rotation_matrix(rng.uniform(size=3)))
    solid.apply_translation(rng.uniform([-1, -1, 0], [1, 1, 1]))
    return solid


def save_all(pictures: Sequence[UInt8[np.ndarray, "h w 3"]], output: Path) -> list[Path]:
    """Write pictures as PNG; their paths."""
    files = [output / f"{number:03d}.png" for number in range(len(pictures))]
    for file, rgb in zip(files, pictures, strict=True):
        cv2.imwrite(str(file), rgb[..., ::-1])
    return files


def judged_points(
    detector: Detector, pictures: Sequence[Picture], output: Path
) -> tuple[list[Float[np.ndarray, "_"]], list[Bool[np.ndarray, "_"]]]:
    """Of each picture the confidence of the main car's points, and which of them are right."""
    files = save_all([picture.rgb for picture in pictures], output)
    said, right = [np.zeros(0)] * len(files), [np.zeros(0, dtype=bool)] * len(files)
    for i, cars in enumerate(detector.detect([CarImage(file) for file in files])):
        for car in cars[:1]:
            known, good, _ = judged(car, pictures[i])
            said[i], right[i] = car.confidence[known], good[known]
    return said, right


def calibration_error(confidence: Float[np.ndarray, "n"], right: Bool[np.ndarray, "n"]) -> float:
    """Expected calibration error: how far the share of right points is from the confidence, over bins of equal width,
    each weighted by its points."""
    bins = np.minimum((confidence * _BINS).astype(int), _BINS - 1)
    gaps = [abs(confidence[bins == b].mean() - right[bins == b].mean()) * (bins == b).mean() for b in np.unique(bins)]
    return float(sum(gaps))
