"""Photos on which detectors are measured, none of them trained on: turntables, walks, photos with outlines of parts."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float

from kronc_ns.capture.detection.detector import CarDetection, CarImage, Detector
from kronc_ns.capture.detection.finding import find_cars
from kronc_ns.capture.detection.guided import GuidedDetector, second_look
from kronc_ns.capture.images import upright_size
from kronc_ns.errors import KroncError
from kronc_ns.files.keypoints import match_keypoints, sigma_of
from kronc_ns.files.output import read_json
from kronc_ns.files.photos import photos as read_photos
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.geometry.camera import Camera
from kronc_ns.geometry.poses import posed
from kronc_ns.refine.options import RefineConfig
from kronc_ns.refine.pipeline import refine_scene
from kronc_ns.scene import Scene
from kronc_ns.solution import Solution, Status

ASSUMED_FOV_DEG = 65.0
"""Field of view where nothing tells the focal length, as `ns-process-data kronc` has it."""
PHOTOS = (".png", ".jpg", ".jpeg")
WHEELS = (7, 20, 37, 50)
_NEAR_VIEWS, _AGREE_DEG = 3, 30.0
ON_PART: dict[str, tuple[int, ...]] = {
    "front_left_light": (0, 1, 2, 3),
    "front_right_light": (54, 55, 56, 57),
    "back_left_light": (22, 23, 25, 26),
    "back_right_light": (31, 32, 34, 35),
    "front_glass": (8, 49),
    "back_glass": (24, 33),
}
"""Points that lie on the outline of a part."""
ON_SIDE: dict[str, tuple[int, ...]] = {
    "front_left_light": (0, 1, 2, 3),
    "front_right_light": (54, 55, 56, 57),
    "back_left_light": (22, 23, 25, 26),
    "back_right_light": (31, 32, 34, 35),
    "front_left_door": (12, 13, 14),
    "front_right_door": (43, 44, 45),
    "back_left_door": (17, 18),
    "back_right_door": (39, 40),
}
"""Points that tell a car's sides apart, and the part that each lies on or beside."""


@dataclass(frozen=True)
class PartPhoto:
    """A photo with outlines of a car's parts."""

    path: Path
    outlines: dict[str, list[Float[np.ndarray, "_ 2"]]]
    """Part -> polygons in pixels; left and right are the car's own."""

    @property
    def diagonal(self) -> float:
        """Of the box around all parts."""
        points = np.concatenate([polygon for polygons in self.outlines.values() for polygon in polygons])
        return float(np.linalg.norm(np.ptp(points, axis=0)))


def photos_in(folder: Path) -> list[Path]:
    """Image files in the order of their names."""
    found = sorted(file for file in folder.iterdir() if file.suffix.lower() in PHOTOS)
    if not found:
        raise KroncError(f"{folder} holds no photos: expected {', '.join(PHOTOS)}")
    return found


def read_part_photos(folder: Path) -> list[PartPhoto]:
    """``annotations.json`` (COCO polygons of parts) and ``images/``."""
    content = read_json(folder / "annotations.json")
    names = {part["id"]: part["name"] for part in content["categories"]}
    outlines: dict[int, dict[str, list[np.ndarray]]] = {image["id"]: {} for image in content["images"]}
    for annotation in content["annotations"]:
        polygons = [np.array(p, dtype=np.float64).reshape(-1, 2) for p in annotation["segmentation"]]
        outlines[annotation["image_id"]].setdefault(names[annotation["category_id"]], []).extend(polygons)
    files = {image["id"]: folder / "images" / image["file_name"] for image in content["images"]}
    return [PartPhoto(files[key], parts) for key, parts in outlines.items() if parts]


def main_car(detector: Detector, path: Path) -> CarDetection | None:
    """The first car that is reported."""
    cars = next(iter(detector.detect([CarImage(path)])))
    return cars[0] if cars and not cars[0].turned_deg else None


def solve_photos(
    detector: Detector, photos: Sequence[Path], focal_px: float | None, centre: tuple[float, float] | None = None
) -> tuple[Solution, Solution]:
    """What `ns-process-data kronc` does with photos of one size: keypoints, poses, a second look; image features."""
    sizes = [upright_size(path) for path in photos]
    if len({*sizes}) != 1:
        raise KroncError(f"{photos[0].parent} holds photos of {len({*sizes})} sizes: expected one")
    width, height = sizes[0]
    focal = focal_px or max(width, height) / 2 / np.tan(np.deg2rad(ASSUMED_FOV_DEG) / 2)
    middle = centre or (width / 2, height / 2)
    camera = Camera(focal, focal, *middle, width, height)
    names = tuple(path.name for path in photos)
    found = find_cars(detector, [CarImage(path) for path in photos], names, sizes, photos[0].parent)
    rows, _ = match_keypoints(found, names, camera)
    scene = Scene(names, camera, detector.schema, rows, sigma_px=sigma_of(found, names, rows))
    config = KroncConfig(refine_focal=focal_px is None)
    solution = solve_scene(scene, config)
    if isinstance(detector, GuidedDetector) and solution.status is not Status.FAILED:
        scene, solution, _ = second_look(detector, photos[0].parent, scene, solution, config)
    right = scene.with_sides_swapped(solution.swapped)
    pictures = read_photos(photos[0].parent, right)
    return solution, refine_scene(right, solution, pictures, RefineConfig(refine_focal=focal_px is None))


def turn_steps(c2w: Float[np.ndarray, "n 3 4"]) -> tuple[Float[np.ndarray, "m"], Bool[np.ndarray, "m"]]:
    """Of a turn at constant steps, by the cameras around the car's upright axis: how far each azimuth is off the line
    through all (degrees), and which are off by more than 90. Views without a pose are left out."""
    number = np.flatnonzero(posed(c2w))
    azimuth = np.rad2deg(np.arctan2(c2w[number, 1, 3], c2w[number, 0, 3]))
    i, j = np.triu_indices(len(number), 1)
    near = (number[j] - number[i]) <= _NEAR_VIEWS
    step = float(np.median(_wrapped(azimuth[j] - azimuth[i])[near] / (number[j] - number[i])[near]))
    residual = _wrapped(azimuth - step * number)
    # views that are wrong must not move the line: it goes through the view with which most agree
    agreeing = np.abs(_wrapped(residual[:, None] - residual[None])) < _AGREE_DEG
    residual = _wrapped(residual - residual[agreeing.sum(0).argmax()])
    sound = np.abs(residual) < _AGREE_DEG
    if sound.sum() >= 3:
        residual = residual - np.polyval(np.polyfit(number[sound], residual[sound], 1), number)
    return residual, np.abs(residual) > 90.0


def _wrapped(degrees: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    return (degrees + 180.0) % 360.0 - 180.0


def wheel_errors(photo: PartPhoto, car: CarDetection) -> Float[np.ndarray, "k"]:
    """Distance of each wheel centre that was found from the nearest wheel outline's centroid, in box diagonals."""
    centroids = np.array([_centroid(polygon) for polygon in photo.outlines.get("wheel", [])])
    found = [car.uv[j] for j in WHEELS if car.confidence[j] > 0]
    if not len(centroids) or not found:
        return np.zeros(0)
    return np.array([np.linalg.norm(centroids - uv, axis=1).min() for uv in found]) / photo.diagonal


def part_errors(photo: PartPhoto, car: CarDetection) -> Float[np.ndarray, "k"]:
    """Distance of each corner of lights and glass that was found from the outline of its part, in box diagonals."""
    errors = [
        outline_distance(photo.outlines[part], car.uv[j]) / photo.diagonal
        for part, points in ON_PART.items()
        if part in photo.outlines
        for j in points
        if car.confidence[j] > 0
    ]
    return np.array(errors)


def takes_left_for_right(photo: PartPhoto, car: CarDetection) -> bool | None:
    """Whether most points that tell the sides lie nearer to the part of the other side; None where none can tell."""
    right = wrong = 0
    for part, points in ON_SIDE.items():
        other = part.replace("left", "RIGHT").replace("right", "left").replace("RIGHT", "right")
        if part not in photo.outlines and other not in photo.outlines:
            continue
        for j in points:
            if car.confidence[j] <= 0:
                continue
            own, opposite = (
                outline_distance(photo.outlines[name], car.uv[j], inside_is_zero=True)
                if name in photo.outlines
                else np.inf
                for name in (part, other)
            )
            right += own < opposite
            wrong += own > opposite
    return None if right + wrong == 0 else wrong > right


def outline_distance(
    polygons: Sequence[Float[np.ndarray, "_ 2"]], uv: Float[np.ndarray, "2"], inside_is_zero: bool = False
) -> float:
    """Pixels from a place to the nearest outline."""
    signed = [cv2.pointPolygonTest(p.astype(np.float32), (float(uv[0]), float(uv[1])), True) for p in polygons]
    return min(max(-s, 0.0) if inside_is_zero else abs(s) for s in signed)


def _centroid(polygon: Float[np.ndarray, "_ 2"]) -> Float[np.ndarray, "2"]:
    moments = cv2.moments(polygon.astype(np.float32))
    if abs(moments["m00"]) < 1e-6:
        return polygon.mean(0)
    return np.array([moments["m10"], moments["m01"]]) / moments["m00"]
