"""Synthetic captures with exact ground truth: camera trajectories around a car and simulated detections."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from typing_extensions import assert_never

from kronc_ns.geometry.camera import Camera, reproject
from kronc_ns.geometry.poses import camera_z, compose, look_at, make_pose
from kronc_ns.geometry.rotations import so3_exp
from kronc_ns.synthetic.car import CarModel, CarShape, build_car
from kronc_ns.synthetic.hull import hull_visibility
from kronc_ns.synthetic.mesh import MeshCar
from kronc_ns.synthetic.render import keypoint_visibility

Preset = Literal["carpatch", "walk"]
HEMISPHERE_RADIUS_M = 6.5
_AIM = np.array([0.0, 0.0, 0.7])  # what cameras face: the middle of the car
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Capture:
    """A synthetic capture: the truth, and the detections a solver gets to see."""

    car: CarModel | MeshCar | None
    """What was captured; None where only its keypoints are known (such a capture cannot be rendered)."""
    points: Float[np.ndarray, "j 3"]
    """True keypoints; the world is the car's frame (x forward, y left, z up, ground z = 0), metres."""
    camera: Camera
    c2w: Float[np.ndarray, "n 3 4"]
    """True poses in that world, OpenCV axes."""
    keypoints: Float[np.ndarray, "n j 3"]
    """Detections (u, v, confidence)."""
    wild: Bool[np.ndarray, "n j"]
    """Which detections are outliers: nothing but chance relates them to their point."""


def default_camera(preset: Preset, width: int | None = None) -> Camera:
    """Intrinsics of a preset, resized to ``width``: 400x400, f = 555 (CarPatch) or 480x270, f = 400 (a phone)."""
    match preset:
        case "carpatch":
            camera = Camera(555.0, 555.0, 200.0, 200.0, 400, 400)
        case "walk":
            camera = Camera(400.0, 400.0, 240.0, 135.0, 480, 270)
        case _:
            assert_never(preset)
    return camera if width is None else camera.scaled(width / camera.width)


def hemisphere_poses(views: int, radius_m: float, rng: np.random.Generator) -> Float[np.ndarray, "n 3 4"]:
    """Cameras drawn uniformly from the sphere's zone 5 to 60 degrees above the car's centre, all facing it."""
    azimuth = rng.uniform(0, 2 * math.pi, views)
    sine = rng.uniform(math.sin(math.radians(5)), math.sin(math.radians(60)), views)
    cosine = np.sqrt(1 - sine**2)
    centres = _AIM + radius_m * np.stack([cosine * np.cos(azimuth), cosine * np.sin(azimuth), sine], axis=1)
    return look_at(centres, np.broadcast_to(_AIM, centres.shape), _UP)


def walk_poses(
    views: int, rng: np.random.Generator, radius_m: float = 5.0, laps: float = 1.0, clockwise: bool = False
) -> Float[np.ndarray, "n 3 4"]:
    """A person with a phone on a lap: radius, pace and height sway smoothly, the aim jitters by about a degree."""
    phase = np.arange(views) / views

    def sway(amplitude: float) -> np.ndarray:
        harmonics = np.arange(1, 5)
        weights = rng.normal(size=4) / harmonics
        shifts = rng.uniform(0, 2 * math.pi, 4)
        wave = (weights * np.sin(2 * math.pi * laps * harmonics * phase[:, None] + shifts)).sum(1)
        return amplitude * wave

    start = rng.uniform(0, 2 * math.pi)
    azimuth = start + (-1 if clockwise else 1) * (2 * math.pi * laps * phase + sway(0.12))
    radius = radius_m + sway(0.3)
    height = 1.5 + sway(0.05) + rng.normal(0, 0.01, views)
    centres = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], axis=1)
    targets = _AIM + np.stack([sway(0.15), sway(0.15), sway(0.05)], axis=1)
    shake = so3_exp(rng.normal(0, math.radians(1.0), (views, 3)))
    return compose(look_at(centres, targets, _UP), make_pose(shake, np.zeros((views, 3))))


def detect(
    uv: Float[np.ndarray, "n j 2"],
    visible: Bool[np.ndarray, "n j"],
    camera: Camera,
    rng: np.random.Generator,
    noise_px: float = 0.0,
    missing: float = 0.0,
    outliers: float = 0.0,
) -> tuple[Float[np.ndarray, "n j 3"], Bool[np.ndarray, "n j"]]:
    """Simulated detector: normal pixel noise (per axis), a share of points missed, a share anywhere on the car's box.

    Returns the detections and which of them are outliers. Points outside the image are never seen. Confidence is 1
    for every detection: a detector's outliers are sure of themselves.
    """
    n, j = visible.shape
    inside = ((uv >= 0) & (uv < (camera.width, camera.height))).all(-1)
    low = np.where(visible[..., None], uv, np.inf).min(1, keepdims=True)
    high = np.where(visible[..., None], uv, -np.inf).max(1, keepdims=True)
    noise = rng.normal(size=(n, j, 2))
    anywhere = rng.uniform(size=(n, j, 2))
    missed, wild = rng.uniform(size=(2, n, j))
    outlier = wild < outliers
    with np.errstate(invalid="ignore"):  # where nothing is visible there is no box
        detected = np.where(outlier[..., None], low + (high - low) * anywhere, uv + noise_px * noise)
    seen = visible & inside & (missed >= missing) & np.isfinite(detected).all(-1)
    keypoints = np.concatenate([np.where(seen[..., None], detected, 0.0), seen[..., None]], axis=-1)
    return keypoints, outlier & seen


def observe(
    subject: CarModel | MeshCar | Float[np.ndarray, "j 3"],
    c2w: Float[np.ndarray, "n 3 4"],
    camera: Camera,
    rng: np.random.Generator,
    noise_px: float = 0.0,
    missing: float = 0.0,
    outliers: float = 0.0,
) -> Capture:
    """A capture of a car (visibility by ray casting) or of bare points (by their convex hull) from given poses."""
    centres = c2w[..., 3]
    if isinstance(subject, CarModel | MeshCar):
        car, points = subject, subject.keypoints
        visible = keypoint_visibility(car.mesh, points, centres)
    else:
        car, points = None, subject
        visible = hull_visibility(points, centres)
    visible &= camera_z(c2w, points) > 0.1
    uv = camera.distort(reproject(points, c2w, camera))
    keypoints, wild = detect(uv, visible, camera, rng, noise_px, missing, outliers)
    return Capture(car, points, camera, c2w, keypoints, wild)


def make_capture(
    preset: Preset = "walk",
    views: int = 100,
    seed: int = 0,
    noise_px: float = 0.0,
    missing: float = 0.0,
    outliers: float = 0.0,
    camera: Camera | None = None,
    car: CarModel | MeshCar | None = None,
) -> Capture:
    """A car (the procedural one), a trajectory, ray-cast visibility and simulated detections, drawn from ``seed``."""
    rng = np.random.default_rng(seed)
    camera = camera or default_camera(preset)
    match preset:
        case "carpatch":
            c2w = hemisphere_poses(views, HEMISPHERE_RADIUS_M, rng)
        case "walk":
            c2w = walk_poses(views, rng)
        case _:
            assert_never(preset)
    return observe(car or build_car(CarShape()), c2w, camera, rng, noise_px, missing, outliers)
