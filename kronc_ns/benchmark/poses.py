"""Accuracy of the paper's solver on synthetic captures: its noise model, and the walk from the circle."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from kronc_ns.benchmark.likelihood import maximum_likelihood
from kronc_ns.config import load_config
from kronc_ns.evaluate import evaluate_poses
from kronc_ns.init import noisy_poses
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.pipeline import KroncConfig, solve_scene
from kronc_ns.scene import Scene, load_scene, read_poses
from kronc_ns.solve.solution import Solution
from kronc_ns.synthetic.scenes import Capture, Preset, make_capture


@dataclass(frozen=True)
class Setting:
    """One row of a table: a kind of capture, its detector, where the solver starts."""

    name: str
    preset: Preset
    views: int
    config: str
    noise_px: float = 0.0
    missing: float = 0.0
    outliers: float = 0.0
    pose_noise: tuple[float, float] | None = None
    """(degrees, metres) about the true poses; None: the circle."""


SETTINGS = (
    Setting(
        "hemisphere, exact keypoints, from (4 deg, 0.5 m)", "carpatch", 100, "paper_synthetic", pose_noise=(4.0, 0.5)
    ),
    Setting("hemisphere, 1 px, from (4 deg, 0.5 m)", "carpatch", 100, "paper_synthetic", 1.0, pose_noise=(4.0, 0.5)),
    Setting("walk, 2 px, 25 % missing, 3 % outliers, from the circle", "walk", 123, "phone_walk", 2.0, 0.25, 0.03),
)


def capture_scene(capture: Capture, given: torch.Tensor | None = None) -> Scene:
    """A synthetic capture as a scene in memory."""
    names = tuple(f"images/frame_{i + 1:05d}.png" for i in range(len(capture.c2w)))
    return Scene(names, capture.camera, APOLLOCAR3D_66, capture.keypoints, given)


def measure(setting: Setting, seed: int) -> dict[str, Any]:
    """Solve one capture of a setting: the figures of `kronc eval`, speed, and what the data allow at the best."""
    capture = make_capture(setting.preset, setting.views, seed, setting.noise_px, setting.missing, setting.outliers)
    given = None
    if setting.pose_noise is not None:
        given = noisy_poses(capture.c2w, *setting.pose_noise, torch.Generator().manual_seed(seed))
    scene = capture_scene(capture, given)
    reference = dict(zip(scene.names, capture.c2w, strict=True))
    init = "circular" if setting.pose_noise is None else "given"
    figures = _figures(scene, load_config(setting.config, seed=seed, solver="adam", init=init), reference)
    if setting.noise_px:
        points = capture.points
        best = maximum_likelihood(scene, capture.c2w, points, robust=setting.outliers > 0)
        bound = evaluate_poses(dict(zip(scene.names, best, strict=True)), reference).as_dict()
        figures["maximum_likelihood"] = {key: bound[key] for key in ("rotation_deg", "translation")}
    return figures


def measure_folder(folder: Path, config: KroncConfig) -> dict[str, Any]:
    """Solve a scene folder and compare with its reference.json."""
    return _figures(load_scene(folder), config, read_poses(folder / "reference.json"))


def _figures(scene: Scene, config: KroncConfig, reference: dict[str, torch.Tensor]) -> dict[str, Any]:
    solution: Solution = solve_scene(scene, config)
    poses = {name: pose for name, pose, ok in zip(scene.names, solution.c2w, solution.solved, strict=True) if ok}
    rate = solution.iterations / solution.seconds if solution.seconds else math.nan
    return {
        **evaluate_poses(poses, reference).as_dict(),
        "status": solution.status.value,
        "rmse_px": solution.rmse_px,
        "seconds": solution.seconds,
        "steps_per_s": rate,
    }
