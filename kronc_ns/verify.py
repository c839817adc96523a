"""What a solution is worth: residuals, a report on every view, an overall status with its reason."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from kronc_ns.adjustment import agrees
from kronc_ns.geometry.camera import project
from kronc_ns.geometry.poses import invert, transform
from kronc_ns.scene import Scene
from kronc_ns.solve.lm import RAYLEIGH_MEDIAN
from kronc_ns.solve.solution import Solution, Status, ViewReport, ViewStatus
from kronc_ns.starts import MIN_POINTS

MIN_VIEWS = 3
INLIER_SIGMAS = 5.0
"""A detection counts as inlier up to this many robust standard deviations of all residuals."""
POOR_FIT = 0.01
"""A median residual above this share of the image diagonal is no fit (a detector's noise is 0.1 to 0.4 %)."""
_LEAST_SIGMA_PX = 0.1
_VAGUE_DEG = 5.0
"""A median standard deviation of the rotations above this is close to degenerate."""
_PARALLAX_DEG = 3.0
"""Views that see the points from within this angle hardly tell how far these are."""
_ALIKE = 0.005
"""Keypoints that move less than this share of the diagonal between views show no other side."""
_SAMPLED_VIEWS = 16
"""So many views, evenly spread, tell whether all are alike."""
_ODD_SHAPE = 0.25
"""Weight of the shape prior below which the solved points hardly look like a car."""


def residuals_px(scene: Scene, solution: Solution) -> Float[Tensor, "n j"]:
    """Reprojection error of every detection against the solved points; NaN where there is none, inf behind a camera."""
    c2w, points = solution.c2w, solution.points
    in_camera = transform(invert(c2w), points.expand(len(c2w), -1, -1))
    error = (project(in_camera, solution.camera) - scene.uv).norm(dim=-1)
    error = torch.where(in_camera[..., 2] > 0, error, torch.inf)
    known = (scene.visibility > 0) & c2w.isfinite().all(-1).all(-1)[:, None] & points.isfinite().all(-1)
    return torch.where(known, error, math.nan)


@dataclass(frozen=True)
class Evidence:
    """What the solver knows beside poses and points."""

    sigma_rot_deg: Float[Tensor, "n"]
    sigma_trans_m: Float[Tensor, "n"]
    swapped: Bool[Tensor, "n"]
    shape_weight: float | None
    """How usual a car the points make, 1 to 0; None without a template."""
    converged: bool
    """Whether the solver came to rest within its steps."""


def inliers(scene: Scene, solution: Solution) -> tuple[Float[Tensor, "n j"], Bool[Tensor, "n j"]]:
    """Residuals as `residuals_px` gives them, and which of them are as small as the detector's noise explains."""
    error = residuals_px(scene, solution)
    measured = error[error.isfinite()]
    diagonal = math.hypot(scene.camera.width, scene.camera.height)
    sigma = max(float(measured.median()) / RAYLEIGH_MEDIAN, _LEAST_SIGMA_PX) if len(measured) else math.inf
    return error, error <= min(INLIER_SIGMAS * sigma, POOR_FIT * 3 * diagonal)


def verify(scene: Scene, solution: Solution, evidence: Evidence) -> tuple[list[ViewReport], Status, str, float, float]:
    """A report on every view, the overall status and its reason, RMSE of inliers and median residual in pixels."""
    error, inlier = inliers(scene, solution)
    seen, found = (~error.isnan()).sum(1), scene.visibility.sum(1)
    good = inlier.sum(1)
    rmse = (torch.where(inlier, error.square(), 0.0).sum(1) / good).sqrt()
    reports = [
        _report(*row)
        for row in zip(
            scene.names,
            found.int().tolist(),
            seen.tolist(),
            good.tolist(),
            agrees(good, seen).tolist(),
            rmse.tolist(),
            evidence.sigma_rot_deg.tolist(),
            evidence.sigma_trans_m.tolist(),
            evidence.swapped.tolist(),
            strict=True,
        )
    ]
    solved = torch.tensor([report.status is ViewStatus.SOLVED for report in reports])
    kept = inlier & solved[:, None]
    median = float(error[solved].nanmedian()) if solved.any() else math.nan
    total = float((torch.where(kept, error.square(), 0.0).sum() / kept.sum().clamp_min(1)).sqrt())
    measured = error[error.isfinite()]
    overall = float(measured.median()) if len(measured) else math.inf
    status, reason = _judge(scene, solution, solved, kept, overall, evidence)
    return reports, status, reason, total, median


def _report(
    name: str,
    found: int,
    seen: int,
    good: int,
    agree: bool,
    rmse: float,
    sigma_rot: float,
    sigma_trans: float,
    swapped: bool,
) -> ViewReport:
    reason = ""
    if found < MIN_POINTS:
        reason = f"{found} keypoints, at least {MIN_POINTS} are needed"
    elif seen == 0:
        reason = f"no pose was found that agrees with its {found} keypoints"
    elif not agree:
        reason = f"only {good} of {seen} keypoints agree with the other views"
    if reason:
        return ViewReport(name, ViewStatus.FAILED, found, good, None, reason=reason)
    return ViewReport(
        name, ViewStatus.SOLVED, found, good, rmse, _known(sigma_rot), _known(sigma_trans), swapped=swapped
    )


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _judge(
    scene: Scene,
    solution: Solution,
    solved: Bool[Tensor, "n"],
    kept: Bool[Tensor, "n j"],
    median_px: float,
    evidence: Evidence,
) -> tuple[Status, str]:
    share = median_px / math.hypot(scene.camera.width, scene.camera.height)
    count, views = int(solved.sum()), len(scene)
    fit = f"median reprojection error {median_px:.2f} px ({100 * share:.2f} % of the image diagonal)"
    if not math.isfinite(median_px):
        fit = "no detection meets a solved point"
    if count == 0 or (count < MIN_VIEWS and evidence.shape_weight is None):
        return Status.FAILED, f"{count} of {views} views agree with each other, expected at least {MIN_VIEWS}; {fit}"
    if share > POOR_FIT:
        return Status.FAILED, f"the keypoints do not fit together: {fit}, expected below {100 * POOR_FIT:g} %"
    vague = float(evidence.sigma_rot_deg[solved].nanmedian())
    problems = []
    if not evidence.converged:
        problems.append(f"the solver was still moving after {solution.iterations} steps: allow more")
    if count < MIN_VIEWS:
        problems.append(f"only {count} view{'s' * (count > 1)}: nothing but the car template holds them together")
    elif not _redundant(kept):
        problems.append("the views share so few keypoints that any poses would meet them: take more views")
    if share > POOR_FIT / 2:
        problems.append("the keypoints fit poorly")
    if 2 * count < views:
        problems.append(f"only {count} of {views} views are solved")
    if count > 1 and (_parallax_deg(solution, solved) < _PARALLAX_DEG or _all_alike(scene, solved)):
        problems.append("all views are from the same place: take them from around the object")
    if not vague <= _VAGUE_DEG:
        problems.append(f"the views are barely determined (median standard deviation {vague:.1f} deg): take more views")
    if evidence.shape_weight is not None and evidence.shape_weight < _ODD_SHAPE:
        problems.append("the points hardly look like a car: are the keypoints in the schema's order?")
    if problems:
        return Status.WEAK, f"{'; '.join(problems)}; {fit}"
    return Status.CONVERGED, f"{count} of {views} views solved; {fit}"


def _redundant(kept: Bool[Tensor, "n j"]) -> bool:
    """Whether the detections that agree are more than what they determine: poses and points, but for the gauge."""
    shared = kept & (kept.sum(0) >= 2)
    views, points = int(shared.any(1).sum()), int(shared.any(0).sum())
    return 2 * int(shared.sum()) > 6 * views + 3 * points - 7


def _parallax_deg(solution: Solution, solved: Bool[Tensor, "n"]) -> float:
    """Largest angle between the mean direction from which the points are seen and that of a view."""
    middle = solution.points.nanmean(0)
    direction = torch.nn.functional.normalize(solution.c2w[solved][..., 3] - middle, dim=-1)
    mean = torch.nn.functional.normalize(direction.mean(0), dim=0)
    return math.degrees(math.acos(max(-1.0, min(1.0, float((direction @ mean).min())))))


def _all_alike(scene: Scene, solved: Bool[Tensor, "n"]) -> bool:
    """Whether the views show the same picture: then poses differ by the start's doing only."""
    chosen = solved.nonzero()[:, 0]
    chosen = chosen[torch.linspace(0, len(chosen) - 1, min(len(chosen), _SAMPLED_VIEWS)).long()]
    seen = scene.visibility[chosen] > 0
    uv = torch.where((seen & (seen.sum(0) > 1))[..., None], scene.uv[chosen], math.nan)
    middle = uv.nanmedian(0).values
    return float((uv - middle).norm(dim=-1).nanmedian()) < _ALIKE * math.hypot(scene.camera.width, scene.camera.height)
