"""Synthetic captures with exact ground truth: camera trajectories around a car and simulated detections."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from typing_extensions import assert_never

from kronc_ns.geometry.camera import Camera, project
from kronc_ns.geometry.poses import compose, invert, look_at, make_pose, transform
from kronc_ns.geometry.rotations import so3_exp
from kronc_ns.synthetic.car import CarModel, CarShape, build_car
from kronc_ns.synthetic.hull import hull_visibility
from kronc_ns.synthetic.mesh import MeshCar
from kronc_ns.synthetic.render import keypoint_visibility

Preset = Literal["carpatch", "walk"]
HEMISPHERE_RADIUS_M = 6.5


@dataclass(frozen=True)
class Capture:
    """A synthetic capture: the truth, and the detections a solver gets to see."""

    car: CarModel | MeshCar | None
    """What was captured; None where only its keypoints are known (such a capture cannot be rendered)."""
    points: Float[Tensor, "j 3"]
    """True keypoints; the world is the car's frame (x forward, y left, z up, ground z = 0), metres."""
    camera: Camera
    c2w: Float[Tensor, "n 3 4"]
    """True poses in that world, OpenCV axes."""
    keypoints: Float[Tensor, "n j 3"]
    """Detections (u, v, confidence)."""
    wild: Bool[Tensor, "n j"]
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


def hemisphere_poses(views: int, radius_m: float, rng: np.random.Generator) -> Float[Tensor, "n 3 4"]:
    """Cameras drawn uniformly from the sphere's zone 5 to 60 degrees above the car's centre, all facing it."""
    azimuth = torch.from_numpy(rng.uniform(0, 2 * math.pi, views))
    sine = torch.from_numpy(rng.uniform(math.sin(math.radians(5)), math.sin(math.radians(60)), views))
    cosine = (1 - sine.square()).sqrt()
    target = torch.tensor([0.0, 0.0, 0.7], dtype=torch.float64)
    centres = target + radius_m * torch.stack([cosine * azimuth.cos(), cosine * azimuth.sin(), sine], dim=1)
    return look_at(centres, target.expand_as(centres), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))


def walk_poses(
    views: int, rng: np.random.Generator, radius_m: float = 5.0, laps: float = 1.0, clockwise: bool = False
) -> Float[Tensor, "n 3 4"]:
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
    target = np.array([0.0, 0.0, 0.7]) + np.stack([sway(0.15), sway(0.15), sway(0.05)], axis=1)
    aimed = look_at(
        torch.from_numpy(centres), torch.from_numpy(target), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    )
    shake = so3_exp(torch.from_numpy(rng.normal(0, math.radians(1.0), (views, 3))))
    return compose(aimed, make_pose(shake, torch.zeros(views, 3, dtype=torch.float64)))


def detect(
    uv: Float[Tensor, "n j 2"],
    visible: Bool[Tensor, "n j"],
    camera: Camera,
    rng: np.random.Generator,
    noise_px: float = 0.0,
    missing: float = 0.0,
    outliers: float = 0.0,
) -> tuple[Float[Tensor, "n j 3"], Bool[Tensor, "n j"]]:
    """Simulated detector: normal pixel noise (per axis), a share of points missed, a share anywhere on the car's box.

    Returns the detections and which of them are outliers. Points outside the image are never seen. Confidence is 1
    for every detection: a detector's outliers are sure of themselves.
    """
    n, j = visible.shape
    low = torch.where(visible[..., None], uv, torch.inf).amin(1, keepdim=True)
    high = torch.where(visible[..., None], uv, -torch.inf).amax(1, keepdim=True)
    noise = torch.from_numpy(rng.normal(size=(n, j, 2)))
    anywhere = torch.from_numpy(rng.uniform(size=(n, j, 2)))
    missed, wild = torch.from_numpy(rng.uniform(size=(2, n, j))).unbind(0)
    outlier = wild < outliers
    detected = torch.where(outlier[..., None], low + (high - low) * anywhere, uv + noise_px * noise)
    size = torch.tensor([camera.width, camera.height], dtype=uv.dtype)
    seen = visible & (missed >= missing) & ((uv >= 0) & (uv < size)).all(-1) & detected.isfinite().all(-1)
    keypoints = torch.cat([torch.where(seen[..., None], detected, 0.0), seen[..., None].to(uv.dtype)], dim=-1)
    return keypoints, outlier & seen


def observe(
    subject: CarModel | MeshCar | Float[Tensor, "j 3"],
    c2w: Float[Tensor, "n 3 4"],
    camera: Camera,
    rng: np.random.Generator,
    noise_px: float = 0.0,
    missing: float = 0.0,
    outliers: float = 0.0,
) -> Capture:
    """A capture of a car (visibility by ray casting) or of bare points (by their convex hull) from given poses."""
    centres = c2w[..., 3]
    if isinstance(subject, CarModel | MeshCar):
        car, points = subject, torch.from_numpy(subject.keypoints)
        visible = torch.from_numpy(keypoint_visibility(car.mesh, car.keypoints, centres.numpy()))
    else:
        car, points = None, subject.double()
        visible = torch.from_numpy(hull_visibility(points.numpy(), centres.numpy()))
    in_camera = transform(invert(c2w), points.expand(len(c2w), -1, -1))
    visible &= in_camera[..., 2] > 0.1
    uv = camera.distort(project(in_camera, camera))
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
