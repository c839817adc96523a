"""What the rows of the suite of poses measure on one seed."""

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from kronc_ns.benchmark.figures import Figures
from kronc_ns.benchmark.paper import START
from kronc_ns.benchmark.peers.adam import FROM_POSES
from kronc_ns.benchmark.peers.ceres import bundle_adjustment
from kronc_ns.benchmark.subjects import capture_scene
from kronc_ns.benchmark.suites.captures import (
    DEFAULT,
    best_poses,
    noisy_start,
    solution_figures,
    solve_capture,
)
from kronc_ns.errors import KroncError
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.geometry.alignment import umeyama
from kronc_ns.geometry.rotations import rotation_angle_deg
from kronc_ns.solution import Solution, ViewStatus
from kronc_ns.synthetic.scenes import Capture, Preset, make_capture
from kronc_ns.synthetic.variations import empty_views, limit_points, swap_sides

INTERVAL = 1.73
"""Half width, in standard deviations of the whole error, of an interval that holds 95 % of the errors' lengths.

The deviation is the root of the covariance's trace. If the error is one-dimensional, 95 % are within 1.96 of it; if
equal in two dimensions, within 1.73 (root of chi-square's 5.99 over 2); if equal in three, within 1.61 (root of 7.81
over 3). Camera errors lie between, their ellipsoids having one or two long axes: with right deviations 1.73 covers
91.6 % (one dimension) to 97.1 % (three).
"""


def from_start(seed: int, start: tuple[float, float] = START, views: int = 100, adam: bool = False) -> dict[str, float]:
    """Hemisphere, 1 px, from noisy poses; with ``adam`` the paper's 10,000 steps beside."""
    capture = make_capture("carpatch", views, seed, noise_px=1.0)
    given = noisy_start(capture, seed, start)
    _, figures = solve_capture(capture, DEFAULT, given, best_poses(capture))
    if adam:
        _, slow = solve_capture(capture, FROM_POSES, given)
        figures |= {f"adam_{name}": slow[name] for name in ("rotation_deg", "centre_cm", "seconds")}
    return figures


def by_views(seed: int, views: int, paper_cm: float) -> Figures:
    """So many views, and the noise at which maximum likelihood would be at the paper's error."""
    figures = from_start(seed, views=views)
    # errors grow linearly with the noise
    return {**figures, "limit_is_the_papers_at_px": paper_cm / figures["best_centre_cm"]}


def without_pose(capture: Capture) -> Figures:
    """From nothing but the detections."""
    return solve_capture(capture, DEFAULT, best=best_poses(capture))[1]


def many_outliers(seed: int) -> Figures:
    """30 % outliers, beside the oracle and beside the optimum of the very same noise without outliers."""
    capture = make_capture("carpatch", 100, seed, noise_px=1.0, outliers=0.3)
    clean = make_capture("carpatch", 100, seed, noise_px=1.0)  # outliers replace detections: the others are the same
    solution, figures = solve_capture(capture, DEFAULT, noisy_start(capture, seed), best_poses(capture))
    to_clean = solution_figures(solution, capture.c2w, best_poses(clean))
    return {**figures, "rotation_to_clean": to_clean["rotation_ratio"], "centre_to_clean": to_clean["centre_ratio"]}


def wrong_focal(seed: int, factor: float) -> Figures:
    """A focal length wrong by ``factor``, refined; the yardstick refines it, too."""
    capture = make_capture("carpatch", 100, seed, noise_px=1.0)
    true = capture.camera
    best = bundle_adjustment(capture_scene(capture), capture.c2w, capture.points, refine_focal=True)
    wrong = replace(capture, camera=replace(true, fx=true.fx * factor, fy=true.fy * factor))
    config = replace(DEFAULT, refine_focal=True)
    solution, figures = solve_capture(wrong, config, noisy_start(capture, seed), best.c2w)
    off, best_off = (abs(focal / true.fx - 1) for focal in (solution.camera.fx, best.focal_px))
    return {**figures, "focal_percent": 100 * off, "best_focal_percent": 100 * best_off}


def swapped_sides(capture: Capture, rng: np.random.Generator, start: bool, seed: int) -> Figures:
    """A tenth of the views with left and right swapped; the yardstick sees them as they were."""
    given = noisy_start(capture, seed) if start else None
    swapped, truth = swap_sides(capture, 0.1, rng)
    solution, figures = solve_capture(swapped, DEFAULT, given, best_poses(capture))
    found = np.array([view.swapped for view in solution.views])
    counts = {"found": found & truth, "missed": ~found & truth, "wrong": found & ~truth}
    return {**figures, **{name: float(which.sum()) for name, which in counts.items()}}


def few_points(capture: Capture, rng: np.random.Generator) -> Capture:
    """At most 12 keypoints a view."""
    return limit_points(capture, 12, rng)


def emptied_views(capture: Capture, rng: np.random.Generator) -> Figures:
    """A fifth of a walk's views without keypoints: where they are put, in the frame of the others."""
    emptied, empty = empty_views(capture, 0.2, rng)
    solution = solve_scene(capture_scene(emptied), DEFAULT)
    measured = solution.views_that_are(ViewStatus.SOLVED)
    completed = solution.views_that_are(ViewStatus.COMPLETED) & empty
    if measured.sum() < 3:
        raise KroncError(f"{measured.sum()} views are solved: no errors can be given")
    frame = umeyama(solution.c2w[measured][..., 3], capture.c2w[measured][..., 3])
    rotation, centre = _raw_errors(frame.apply_to_poses(solution.c2w), capture.c2w)
    figures = solution_figures(solution, capture.c2w)
    figures["completed_percent"] = float(100 * completed.sum() / empty.sum())
    if completed.any():
        figures["completed_rotation_deg"] = float(np.median(rotation[completed]))
        figures["completed_centre_cm"] = float(100 * np.median(centre[completed]))
    return {**figures, "solved_rotation_deg": float(rotation[measured].mean())}


def coverage(seed: int, preset: Preset) -> Figures:
    """Share of views whose error, relative to the car's points, is inside the 95 % interval of their sigmas."""
    capture = make_capture(preset, 100, seed, noise_px=1.0)
    solution, figures = solve_capture(capture, DEFAULT, noisy_start(capture, seed))
    known = np.isfinite(solution.points).all(-1)
    frame = umeyama(solution.points[known], capture.points[known])
    measured = solution.views_that_are(ViewStatus.SOLVED)
    sigma_rotation, sigma_centre = _sigmas(solution)
    rotation, centre = _raw_errors(frame.apply_to_poses(solution.c2w[measured]), capture.c2w[measured])
    rotation_z, centre_z = rotation / sigma_rotation, centre / (sigma_centre * frame.scale)
    return {
        **figures,
        "rotation_percent": float(100 * (rotation_z <= INTERVAL).mean()),
        "centre_percent": float(100 * (centre_z <= INTERVAL).mean()),
        # 1 where the deviations are right, whatever the shape of the ellipsoids
        "rotation_error_over_sigma": float(np.sqrt((rotation_z**2).mean())),
        "centre_error_over_sigma": float(np.sqrt((centre_z**2).mean())),
    }


def _raw_errors(
    c2w: Float[np.ndarray, "n 3 4"], truth: Float[np.ndarray, "n 3 4"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Rotation (degrees) and centre (metres) error of every view as it stands."""
    relative = c2w[..., :3].swapaxes(-1, -2) @ truth[..., :3]
    return rotation_angle_deg(relative), np.linalg.norm(c2w[..., 3] - truth[..., 3], axis=-1)


def _sigmas(solution: Solution) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Standard deviations of rotation (degrees) and centre (metres) of the solved views."""
    solved = [view for view in solution.views if view.status is ViewStatus.SOLVED]
    if any(view.sigma_rot_deg is None or view.sigma_trans_m is None for view in solved):
        raise KroncError(f"solver {solution.solver!r} leaves solved views without sigmas")
    rotation = np.array([view.sigma_rot_deg or math.nan for view in solved])
    return rotation, np.array([view.sigma_trans_m or math.nan for view in solved])
