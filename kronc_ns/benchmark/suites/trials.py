"""Captures of every kind of trouble, drawn at random, and whether what a solver says of them is so."""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from kronc_ns.benchmark.figures import Figures
from kronc_ns.benchmark.subjects import capture_scene
from kronc_ns.benchmark.suites.pose_measures import INTERVAL
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.geometry.alignment import Similarity, umeyama
from kronc_ns.geometry.rotations import rotation_angle_deg
from kronc_ns.scene import Scene
from kronc_ns.solution import Solution, Status, ViewStatus
from kronc_ns.synthetic.scenes import (
    HEMISPHERE_RADIUS_M,
    Capture,
    default_camera,
    hemisphere_poses,
    observe,
    walk_poses,
)
from kronc_ns.synthetic.variations import noisy_poses, swap_sides

Kind = Literal["walk", "hemisphere", "junk", "two cars"]
Shape = Float[np.ndarray, "66 3"]
TUNING_TRIALS = 100_000
"""Trials from this number on are of the shapes to build on; those below are for reports."""
_JUNK, _TWO_CARS = 0.05, 0.03  # shares of trials
_WRONG_DEG, _WRONG_M = 3.0, 0.5  # mean errors from which on a scene is wrong
_RIGHT_DEG, _RIGHT_M = 1.5, 0.15  # and up to which it is right
_OFF_DEG = 5.0  # error of a view that should not be called solved
_NEAR_M = 0.1  # points that are off by more say little about the frame


@dataclass(frozen=True)
class Trial:
    """A scene, how it is to be solved, and the truth; without truth there is nothing that could be found."""

    kind: Kind
    note: str
    scene: Scene
    config: KroncConfig
    truth: Capture | None


def draw_trial(shapes: tuple[Shape, ...], seed: int) -> Trial:
    """A capture of one of the shapes: few or many views, any noise, outliers, sides taken for each other, a start that
    is poor or none, a focal length that is wrong and to be refined; sometimes what is no capture of a car."""
    rng = np.random.default_rng([seed, 18])
    views = round(math.exp(rng.uniform(math.log(4), math.log(80))))
    noise_px = rng.uniform(0.5, 4.0)
    outliers, missing, swapped = rng.uniform(0, (0.4, 0.7, 0.3)) * (rng.uniform(size=3) < (0.7, 0.8, 0.5))
    if rng.uniform() < 0.3:
        around, camera, c2w = (
            "hemisphere",
            default_camera("carpatch"),
            hemisphere_poses(views, HEMISPHERE_RADIUS_M, rng),
        )
    else:
        laps, clockwise = rng.uniform(0.15, 1.5), bool(rng.integers(2))
        around, camera = f"{laps:.2f} laps", default_camera("walk")
        c2w = walk_poses(views, rng, laps=laps, clockwise=clockwise)
    first, second = rng.choice(len(shapes), 2, replace=False)
    capture = observe(shapes[first], c2w, camera, rng, noise_px, missing, outliers)
    lot = rng.uniform()
    kind: Kind = "hemisphere" if around == "hemisphere" else "walk"
    if lot < _JUNK:
        kind, capture = "junk", _junk(capture, rng)
    elif lot < _JUNK + _TWO_CARS:
        other = observe(shapes[second], c2w, camera, rng, noise_px, missing, outliers)
        of_other = rng.permutation(views) < max(1, views // 2)
        keypoints = np.where(of_other[:, None, None], other.keypoints, capture.keypoints)
        kind, capture = "two cars", replace(capture, keypoints=keypoints)
    capture, _ = swap_sides(capture, swapped, rng)
    given, start = None, "no start"
    if rng.uniform() < 0.4:
        off = rng.uniform(2, 20), rng.uniform(0.2, 1.5)
        given, start = noisy_poses(c2w, *off, rng), f"start ({off[0]:.0f} deg, {off[1]:.1f} m)"
    scene, focal = capture_scene(capture, given), 1.0
    if rng.uniform() < 0.25:
        focal = float((1 + rng.uniform(0.1, 0.3)) ** rng.choice([-1, 1]))
        scene = replace(scene, camera=replace(camera, fx=camera.fx * focal, fy=camera.fy * focal))
    note = (
        f"{kind}, {around}, {views} views, {noise_px:.1f} px, {100 * outliers:.0f} % outliers, {100 * missing:.0f} % "
        f"missing, {100 * swapped:.0f} % swapped, {start}, focal x {focal:.2f}"
    )
    truth = None if kind in ("junk", "two cars") else capture
    return Trial(kind, note, scene, KroncConfig(refine_focal=focal != 1.0), truth)


def _junk(capture: Capture, rng: np.random.Generator) -> Capture:
    """As many keypoints as there were, anywhere in the image."""
    where = rng.uniform(size=capture.keypoints[..., :2].shape) * (capture.camera.width, capture.camera.height)
    seen = capture.keypoints[..., 2:]
    return replace(capture, keypoints=np.concatenate([np.where(seen > 0, where, 0.0), seen], axis=-1))


def judge_trial(trial: Trial, solution: Solution) -> Figures:
    """Counts of one trial, of scenes and of views; a figure that does not apply is left out."""
    converged = solution.status is Status.CONVERGED
    if trial.truth is None:
        name = trial.kind.replace(" ", "_")
        return {"scenes": 1.0, name: 1.0, f"{name}_converged": float(converged)}
    solved = solution.views_that_are(ViewStatus.SOLVED)
    rotation, centre, rotation_z, centre_z = _errors(solution, trial.truth, solved)
    figures = {"scenes": 1.0, "converged": float(converged)}
    handed_on = _errors(solution, trial.truth, solution.posed)[:2]
    usable = 2 * int(solution.posed.sum()) >= len(solved)
    if usable and handed_on[0].mean() < _RIGHT_DEG and handed_on[1].mean() < _RIGHT_M:
        figures |= {"right": 1.0, "right_not_converged": float(not converged)}
    if converged:
        wrong = rotation.mean() > _WRONG_DEG or centre.mean() > _WRONG_M
        figures |= {"converged_wrong": float(wrong), "views": float(solved.sum())}
        figures["views_off"] = float((rotation > _OFF_DEG).sum())
        figures["rotations_within"] = float((rotation_z <= INTERVAL).sum())
        figures["centres_within"] = float((centre_z <= INTERVAL).sum())
    return figures


def _errors(solution: Solution, truth: Capture, chosen: Bool[np.ndarray, "n"]) -> tuple[Float[np.ndarray, "s"], ...]:
    """Rotation (degrees) and centre (metres) of some views relative to the car, and both over their sigmas."""
    frame = _onto(solution.points, truth.points)
    c2w, true = frame.apply_to_poses(solution.c2w[chosen]), truth.c2w[chosen]
    rotation = rotation_angle_deg(c2w[..., :3].swapaxes(-1, -2) @ true[..., :3])
    centre = np.linalg.norm(c2w[..., 3] - true[..., 3], axis=-1)
    views = [solution.views[i] for i in np.flatnonzero(chosen)]
    sigmas = np.array([(v.sigma_rot_deg or math.nan, v.sigma_trans_m or math.nan) for v in views]).reshape(-1, 2)
    return rotation, centre, rotation / sigmas[:, 0], centre / (sigmas[:, 1] * frame.scale)


def _onto(points: Float[np.ndarray, "j 3"], truth: Float[np.ndarray, "j 3"]) -> Similarity:
    """The solved points onto the true ones; those that are far off count little."""
    known = np.isfinite(points).all(-1)
    if int(known.sum()) < 3:
        return Similarity.identity()
    frame = umeyama(points[known], truth[known])
    for _ in range(10):
        off = np.linalg.norm(frame.apply(points[known]) - truth[known], axis=-1)
        frame = umeyama(points[known], truth[known], 1 / (1 + (off / _NEAR_M) ** 2))
    return frame


def run_trial(shapes: tuple[Shape, ...], seed: int) -> Figures:
    """Draw a trial, solve it, judge what is said of it."""
    trial = draw_trial(shapes, seed)
    return judge_trial(trial, solve_scene(trial.scene, trial.config))
