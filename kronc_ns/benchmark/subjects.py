"""Captures whose true poses are known, and what is done to them before they are solved."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from kronc_ns.errors import KroncError
from kronc_ns.files.scene_folder import load_scene
from kronc_ns.files.transforms import read_poses
from kronc_ns.fit.car_frame import template_frame
from kronc_ns.geometry.camera import rays
from kronc_ns.geometry.triangulation import triangulate
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.keypoints.template import car_template
from kronc_ns.scene import Scene
from kronc_ns.synthetic.scenes import Capture, Preset, make_capture

_UNLIKE_A_CAR = 1.5
"""No car is so many times larger or smaller than its proportions tell."""


@dataclass(frozen=True)
class Subject:
    """A capture and the truth about it."""

    name: str
    scene: Scene
    truth: Float[np.ndarray, "n 3 4"]
    folder: Path | None = None
    """Where its images are; None where it was never rendered."""

    @property
    def points(self) -> Float[np.ndarray, "j 3"]:
        """Keypoints where true poses and detections see them; NaN where fewer than two views do."""
        points = triangulate(self.truth, rays(self.scene.uv, self.scene.camera), self.scene.visibility)
        return np.where((self.scene.seen.sum(0) >= 2)[:, None], points, math.nan)


def capture_scene(capture: Capture, given: Float[np.ndarray, "n 3 4"] | None = None) -> Scene:
    """A synthetic capture as a scene in memory."""
    names = tuple(f"images/frame_{i + 1:05d}.png" for i in range(len(capture.c2w)))
    return Scene(names, capture.camera, APOLLOCAR3D_66, capture.keypoints, given)


def procedural(seed: int, preset: Preset = "carpatch", views: int = 100) -> Subject:
    """A random car with exact keypoints."""
    capture = make_capture(preset, views, seed)
    return Subject(f"procedural car {seed}", capture_scene(capture), capture.c2w)


def from_folder(folder: Path) -> Subject:
    """A scene folder with its reference.json; views without a reference are left out.

    Where the reference cannot be in metres, the template says how large the car is.
    """
    if not (folder / "reference.json").is_file():
        raise KroncError(f"{folder}: expected a scene folder with the true poses in reference.json")
    scene, reference = load_scene(folder), read_poses(folder / "reference.json")
    known = np.array([name in reference for name in scene.names])
    scene = chosen_views(scene, known)
    if len(scene) < 3:
        raise KroncError(f"{folder}: {len(scene)} views of keypoints.json are in reference.json, expected at least 3")
    truth = np.stack([reference[name] for name in scene.names])
    return _in_metres(Subject(folder.resolve().name, replace(scene, given_c2w=None), truth, folder))


def _in_metres(subject: Subject) -> Subject:
    """A reference in which the car has no car's size, such as a COLMAP model, scaled by what cars measure."""
    template, points = car_template(subject.scene.schema), subject.points
    if template is None or np.isfinite(points).all(-1).sum() < 3:
        return subject
    scale = template_frame(points, template).scale
    if 1 / _UNLIKE_A_CAR < scale < _UNLIKE_A_CAR:
        return subject
    truth = subject.truth.copy()
    truth[..., 3] *= scale
    return replace(subject, truth=truth)


def with_noise(subject: Subject, noise_px: float, rng: np.random.Generator) -> Subject:
    """Detections with normal noise, ``noise_px`` of standard deviation along each axis."""
    scene = subject.scene
    keypoints = scene.keypoints.copy()
    keypoints[..., :2] += noise_px * rng.normal(size=scene.uv.shape) * scene.seen[..., None]
    return replace(subject, scene=replace(scene, keypoints=keypoints))


def with_outliers(subject: Subject, share: float, rng: np.random.Generator) -> Subject:
    """A share of the detections of each view moved anywhere in the box around them."""
    scene = subject.scene
    keypoints = scene.keypoints.copy()
    for view, seen in enumerate(scene.seen):
        moved = seen & (rng.random(len(seen)) < share)
        if moved.any():
            low, high = keypoints[view, seen, :2].min(0), keypoints[view, seen, :2].max(0)
            keypoints[view, moved, :2] = rng.uniform(low, high, (int(moved.sum()), 2))
    return replace(subject, scene=replace(scene, keypoints=keypoints))


def thinned(subject: Subject, views: int) -> Subject:
    """So many of the views, evenly spread over a capture in which the first follows the last, as on a lap."""
    if not 3 <= views <= len(subject.truth):
        raise KroncError(f"{views} views of {subject.name}: expected 3 to {len(subject.truth)}")
    keep = np.zeros(len(subject.truth), dtype=bool)
    keep[np.arange(views) * len(keep) // views] = True
    return replace(subject, scene=chosen_views(subject.scene, keep), truth=subject.truth[keep])


def chosen_views(scene: Scene, keep: Bool[np.ndarray, "n"]) -> Scene:
    """The scene of the views in ``keep``."""

    def names(of: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(name for name, kept in zip(of, keep, strict=True) if kept)

    return replace(
        scene,
        names=names(scene.names),
        keypoints=scene.keypoints[keep],
        sigma_px=None if scene.sigma_px is None else scene.sigma_px[keep],
        given_c2w=None if scene.given_c2w is None else scene.given_c2w[keep],
        given_depths=None if scene.given_depths is None else scene.given_depths[keep],
        masks=None if scene.masks is None else names(scene.masks),
        lenses=None if scene.lenses is None else scene.lenses.chosen(keep),
    )
