"""What a result is worth: residuals, a report on every view, an overall status with its reason."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from kronc_ns.fit.accident import accidents
from kronc_ns.fit.attempts import agrees
from kronc_ns.fit.doubt import plenty
from kronc_ns.fit.noise import Noise
from kronc_ns.fit.starts import MIN_POINTS
from kronc_ns.fit.two_cars import TwoCars
from kronc_ns.geometry.camera import Camera, lengths, reproject
from kronc_ns.geometry.poses import posed, unit
from kronc_ns.scene import Scene
from kronc_ns.solution import Solution, Status, ViewReport, ViewStatus
from kronc_ns.solve.robust import INLIER_SIGMAS, noise_px

MIN_VIEWS = 3
POOR_FIT = 0.01
"""A median residual above this share of the image diagonal is no fit (a detector's noise is 0.1 to 0.4 %)."""
_NOISY, _NEARLY_ALL = 0.0065, 0.8
"""Noise above this share of the image diagonal, with less than this share of the views solved, is that of two cars that
are taken for one; a poor detector has the noise, but its views fit all the same."""
_TWO_CARS, _TOGETHER, _HABITS = 0.31, 0.72, 0.45
"""Share of the squared residuals that two shapes explain, from which on they are two (two cars come to 0.4 to 0.8,
mostly); and from which on where more than this share of neighbouring views are of the same one, as the habits of a
detector would have it, which come to 0.34."""
_LEAST_FREEDOM, _LEAST_OF_VIEW = 20, 2.0
"""Measurements beyond the unknowns without which a fit tells little of its noise; and of a solved view, of whose points
each takes three, shared by those that see it: fewer, and points are bent to where a wrong pose sees them."""
SURE_DEG, SURE_SHARE = 2.0, 0.03
"""Most standard deviation of a solved view's rotation, and of its centre as a share of the distance: with more, errors
of 5 degrees are no rarity."""
_FEW_DEG, _FEW_SHARE = 4.0, 2.0
"""Of k solved views the root mean squares of these, times sqrt(1 + 4 / k) and sqrt(1 + 2 / k), may be no more, either:
errors of few views are largely one, so that with more a mean error of 3 degrees or half a metre is no rarity."""
_LEAST_LEAD = 3.0
"""Detections by which a solved view's pose is better than any other."""
_MOST_ACCIDENTS = -4.0
"""Decimal logarithm of the number of wrong poses that are expected to meet a solved view's detections as well."""
_LEAST_SOLVED, _ALL_AGREE, _CLEAN = 0.5, 0.97, 0.005
"""Share of views without which the others' poses are not believed: below it, one scene in 18 that would converge has a
view that is off by more than 5 degrees, one in 100 above it; and two cars that are taken for one hardly pass it. Unless
this share of views at least is vague at worst, with noise below this share of the diagonal: then nothing speaks against
the poses but that they are not known well."""
_PARALLAX_DEG = 3.0
"""Views that see the points from within this angle hardly tell how far these are."""
_ALIKE = 0.005
"""Keypoints that move less than this share of the diagonal between views show no other side."""
_SAMPLED_VIEWS = 16
"""So many views, evenly spread, tell whether all are alike."""
_ODD_SHAPE = 0.5
"""Weight of the shape prior below which the solved points hardly look like a car; ten real and rendered captures have
0.54 to 1."""


@dataclass(frozen=True)
class Evidence:
    """Poses and points as they will be handed on, and what the solver knows beside them."""

    camera: Camera
    c2w: Float[np.ndarray, "n 3 4"]
    """NaN for views that took no part."""
    points: Float[np.ndarray, "j 3"]
    """NaN where unknown."""
    sigma_rot_deg: Float[np.ndarray, "n"]
    sigma_trans_m: Float[np.ndarray, "n"]
    swapped: Bool[np.ndarray, "n"]
    lead: Float[np.ndarray, "n"]
    """By how many detections each view's pose is better than any other (`doubt.lead`)."""
    shape_weight: float | None
    """How usual a car the points make, 1 to 0; None without a template."""
    converged: bool
    """Whether the solver came to rest within its steps."""
    iterations: int
    noise: Noise
    """Of the detections."""
    two_cars: TwoCars
    """What two shapes would explain."""


@dataclass(frozen=True)
class Verdict:
    """How far each view and the whole can be trusted."""

    views: tuple[ViewReport, ...]
    status: Status
    reason: str
    rmse_px: float
    """Root mean square reprojection error over all inliers of solved views; NaN where there is none."""
    median_px: float
    """Median reprojection error over all detections in solved views; NaN where there is none."""
    vague: Bool[np.ndarray, "n"]
    """Views that agree with the others, but are not placed well enough to count as solved."""

    @property
    def solved(self) -> Bool[np.ndarray, "n"]:
        """Which views were solved."""
        return np.array([view.status is ViewStatus.SOLVED for view in self.views], dtype=bool)


def inliers(scene: Scene, solution: Solution) -> tuple[Float[np.ndarray, "n j"], Bool[np.ndarray, "n j"]]:
    """`residuals_px` of a solution, and which of them are as small as the detector's noise explains."""
    error = residuals_px(scene, solution.camera, solution.c2w, solution.points)
    return error, _small(scene, error)


def residuals_px(
    scene: Scene, camera: Camera, c2w: Float[np.ndarray, "n 3 4"], points: Float[np.ndarray, "j 3"]
) -> Float[np.ndarray, "n j"]:
    """Reprojection error of every detection against the solved points; NaN where there is none, inf behind a camera."""
    error = lengths(reproject(points, c2w, camera) - scene.uv)
    return np.where(scene.seen & posed(c2w)[:, None] & np.isfinite(points).all(-1), error, math.nan)


def _small(scene: Scene, error: Float[np.ndarray, "n j"]) -> Bool[np.ndarray, "n j"]:
    finite = error[np.isfinite(error)]
    if not len(finite):
        return np.zeros(error.shape, dtype=bool)
    return error <= min(INLIER_SIGMAS * noise_px(finite), 3 * POOR_FIT * _diagonal(scene))


def judge(scene: Scene, evidence: Evidence) -> Verdict:
    """A report on every view and the overall status."""
    error = residuals_px(scene, evidence.camera, evidence.c2w, evidence.points)
    inlier = _small(scene, error)
    counted, found, good = (~np.isnan(error)).sum(1), scene.visible, inlier.sum(1)
    rmse = np.sqrt(np.where(inlier, error**2, 0.0).sum(1) / np.maximum(good, 1))
    agree = agrees(good, counted)
    distance = _distance(evidence)
    sure = (evidence.sigma_rot_deg <= SURE_DEG) & (evidence.sigma_trans_m <= SURE_SHARE * distance)
    alone = evidence.lead >= _LEAST_LEAD
    meant = plenty(good, found)
    if (few := ~meant).any():
        meant[few] = accidents(error[few], _boxes(scene, few), evidence.noise.sigma_px) <= _MOST_ACCIDENTS
    held = int(agree.sum()) < MIN_VIEWS  # by the template alone, and never called converged
    checked = held | (_freedom_of_views(inlier) >= _LEAST_OF_VIEW)
    solved = (found >= MIN_POINTS) & (counted > 0) & agree & alone & meant & checked & sure
    told = (np.arange(len(scene)), found, counted, good, agree, alone, meant, checked)
    columns = (fact[~solved].tolist() for fact in told)
    reasons = {facts[0]: _reason(_Facts(*facts), evidence) for facts in zip(*columns, strict=True)}
    views = _reports(scene, evidence, found, good, rmse * scene.enlargement, reasons)
    kept = inlier & solved[:, None]
    of_solved = error[solved][~np.isnan(error[solved])]
    finite = error[np.isfinite(error)]
    median = float(np.median(finite)) if len(finite) else math.inf
    vague = agree & alone & meant & ~(checked & sure)
    status, reason = _overall(scene, evidence, solved, vague, agree, median)
    return Verdict(
        views,
        status,
        reason,
        float(np.sqrt(np.where(kept, error**2, 0.0).sum() / max(kept.sum(), 1))),
        float(np.median(of_solved)) if len(of_solved) else math.nan,
        vague,
    )


class _Facts(NamedTuple):
    """Of one view."""

    view: int
    found: int
    """Keypoints."""
    seen: int
    """Of those, how many are of solved points."""
    good: int
    """Of those, how many agree."""
    agree: bool
    alone: bool
    """Whether no other pose fits nearly as well."""
    meant: bool
    """Whether a wrong pose would hardly meet them as well."""
    checked: bool
    """Whether enough of its points are known from other views."""


def _reason(of: _Facts, evidence: Evidence) -> str:
    """Why a view is not solved."""
    if of.found < MIN_POINTS:
        return f"{of.found} keypoints, at least {MIN_POINTS} are needed"
    if of.seen == 0:
        return f"no pose was found that agrees with its {of.found} keypoints"
    if not of.agree:
        return f"only {of.good} of {of.seen} keypoints agree with the other views"
    if not of.alone:
        return f"its {of.seen} keypoints fit another pose nearly as well"
    if not of.meant:
        return f"{of.good} of its {of.seen} keypoints might agree by accident"
    if not of.checked:
        return f"the {of.good} keypoints that agree are seen by too few other views to check its pose"
    rotation, centre = known(evidence.sigma_rot_deg[of.view]), known(evidence.sigma_trans_m[of.view])
    spread = "unknown" if rotation is None or centre is None else f"{rotation:.1f} deg, {centre:.2g} m"
    return f"the {of.good} keypoints that agree do not place it well (standard deviation {spread})"


def _reports(
    scene: Scene,
    evidence: Evidence,
    found: Int[np.ndarray, "n"],
    good: Int[np.ndarray, "n"],
    rmse: Float[np.ndarray, "n"],
    reasons: Mapping[int, str],
) -> tuple[ViewReport, ...]:
    """On every view; those without a reason against it are solved."""
    columns = (
        x.tolist() for x in (found, good, rmse, evidence.sigma_rot_deg, evidence.sigma_trans_m, evidence.swapped)
    )
    return tuple(
        ViewReport(name, ViewStatus.FAILED, seen, met, None, reason=reasons[i])
        if i in reasons
        else ViewReport(name, ViewStatus.SOLVED, seen, met, off, known(turn), known(shift), swapped=swapped)
        for i, (name, seen, met, off, turn, shift, swapped) in enumerate(zip(scene.names, *columns, strict=True))
    )


def _freedom_of_views(inlier: Bool[np.ndarray, "n j"]) -> Float[np.ndarray, "n"]:
    """Measurements of each view less its unknowns, and less its share of the unknowns of its points."""
    support = np.maximum(inlier.sum(0), 2)  # what a single view sees is held by the template at most
    return np.where(inlier, 2 - 3 / support, 0.0).sum(1) - 6


def _boxes(scene: Scene, chosen: Bool[np.ndarray, "n"]) -> Float[np.ndarray, "m"]:
    """Areas of the boxes around the detections of some views, in square pixels."""
    seen, uv = scene.seen[chosen][..., None], scene.uv[chosen]
    sides = np.where(seen, uv, -math.inf).max(1) - np.where(seen, uv, math.inf).min(1)
    return np.where(seen.any((1, 2)), sides.prod(-1), 0.0)


def known(value: float) -> float | None:
    """A number for a report; None where it is not finite."""
    return float(value) if math.isfinite(value) else None


def _overall(
    scene: Scene,
    evidence: Evidence,
    solved: Bool[np.ndarray, "n"],
    vague: Bool[np.ndarray, "n"],
    agreeing: Bool[np.ndarray, "n"],
    median_px: float,
) -> tuple[Status, str]:
    share = median_px / _diagonal(scene)
    count, sure, views = int(agreeing.sum()), int(solved.sum()), len(scene)
    with_template = evidence.shape_weight is not None
    fit = f"median reprojection error {median_px:.2f} px ({100 * share:.2f} % of the image diagonal)"
    if not math.isfinite(median_px):
        fit = "no detection meets a solved point"
    if count == 0 or (count < MIN_VIEWS and not with_template):
        return Status.FAILED, f"{count} of {views} views agree with each other, expected at least {MIN_VIEWS}; {fit}"
    if share > POOR_FIT:
        return Status.FAILED, f"the keypoints do not fit together: {fit}, expected below {100 * POOR_FIT:g} %"
    sigma_px, diagonal = evidence.noise.sigma_px, _diagonal(scene)
    undisputed = int((solved | vague).sum()) >= _ALL_AGREE * views and sigma_px <= _CLEAN * diagonal
    problems = []
    if not evidence.converged:
        problems.append(f"the solver was still moving after {evidence.iterations} steps: allow more")
    if count < MIN_VIEWS:
        problems.append(f"only {count} view{'s' * (count > 1)}: nothing but the car template holds them together")
    elif evidence.noise.freedom < _LEAST_FREEDOM:
        problems.append("the views share so few keypoints that any poses would meet them: take more views")
    if sigma_px > _NOISY * diagonal and sure < _NEARLY_ALL * views:
        problems.append(f"the keypoints fit poorly (noise {sigma_px:.1f} px): are they all of one car, and right?")
    explained, together, other_car = evidence.two_cars
    if explained > (_HABITS if together > _TOGETHER else _TWO_CARS):
        other = np.flatnonzero(other_car)
        problems.append(
            f"about {len(other)} of {views} views, {scene.names[other[0]]} the first, seem to show another car than "
            f"the rest (two shapes explain {100 * explained:.0f} % of what one misses): give one car at a time"
        )
    if 2 * count < views:
        problems.append(f"only {count} of {views} views are solved")
    elif sure < MIN_VIEWS or (sure < _LEAST_SOLVED * views and not undisputed):
        sigma = evidence.sigma_rot_deg[agreeing]
        typical = float(np.median(sigma[np.isfinite(sigma)])) if np.isfinite(sigma).any() else math.nan
        problems.append(
            f"only {sure} of {views} views are well determined (median standard deviation {typical:.1f} deg): "
            "take more views, or from nearer"
        )
    elif spread := _vague(evidence, solved):
        problems.append(
            f"the {sure} solved of {views} views are known to {spread} only: take more views, or from nearer"
        )
    if count > 1 and (_parallax_deg(evidence, agreeing) < _PARALLAX_DEG or _all_alike(scene, agreeing)):
        problems.append("all views are from the same place: take them from around the object")
    if evidence.shape_weight is not None and evidence.shape_weight < _ODD_SHAPE:
        problems.append("the points hardly look like a car: are the keypoints in the schema's order?")
    if problems:
        return Status.WEAK, f"{'; '.join(problems)}; {fit}"
    return Status.CONVERGED, f"{sure} of {views} views solved; {fit}"


def _vague(evidence: Evidence, solved: Bool[np.ndarray, "n"]) -> str:
    """How well solved views are known, if that is not enough."""
    share = evidence.sigma_trans_m[solved] / _distance(evidence)[solved]
    degrees, share = (float(np.sqrt(np.square(sigma).mean())) for sigma in (evidence.sigma_rot_deg[solved], share))
    alike_deg, alike_share = (math.sqrt(1 + few / int(solved.sum())) for few in (_FEW_DEG, _FEW_SHARE))
    enough = alike_deg * degrees <= SURE_DEG and alike_share * share <= SURE_SHARE
    return "" if enough else f"{degrees:.1f} deg and {100 * share:.1f} % of the distance"


def _distance(evidence: Evidence) -> Float[np.ndarray, "n"]:
    """Of each camera from the middle of the points."""
    known = np.isfinite(evidence.points).all(-1)
    middle = evidence.points[known].mean(0) if known.any() else np.zeros(3)
    return np.linalg.norm(evidence.c2w[..., 3] - middle, axis=-1)


def _parallax_deg(evidence: Evidence, solved: Bool[np.ndarray, "n"]) -> float:
    """Largest angle between the mean direction from which the points are seen and that of a view."""
    known = np.isfinite(evidence.points).all(-1)
    middle = evidence.points[known].mean(0) if known.any() else np.zeros(3)
    direction = unit(evidence.c2w[solved][..., 3] - middle)
    mean = unit(direction.mean(0))
    return math.degrees(math.acos(max(-1.0, min(1.0, float((direction @ mean).min())))))


def _all_alike(scene: Scene, solved: Bool[np.ndarray, "n"]) -> bool:
    """Whether the views show the same picture: then poses differ by the start's doing only."""
    chosen = np.flatnonzero(solved)
    chosen = chosen[np.linspace(0, len(chosen) - 1, min(len(chosen), _SAMPLED_VIEWS)).astype(int)]
    seen = scene.seen[chosen]
    seen = seen & (seen.sum(0) > 1)
    if not seen.any():
        return False
    uv = np.where(seen[..., None], scene.uv[chosen], math.inf)
    middle = np.sort(uv, axis=0)[np.maximum(seen.sum(0) - 1, 0) // 2, np.arange(seen.shape[1])]
    off = uv[seen] - np.broadcast_to(middle, uv.shape)[seen]
    return float(np.median(lengths(off))) < _ALIKE * _diagonal(scene)


def _diagonal(scene: Scene) -> float:
    return math.hypot(scene.camera.width, scene.camera.height)
