"""Scenes to the second-order solver and back.

Scenes that are handed in together are solved in batches; what happens to one does not depend on the others.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.starts import MIN_POINTS, Start, far_side, in_front, usable_views
from kronc_ns.keypoints.schema import KeypointSchema
from kronc_ns.keypoints.template import car_template
from kronc_ns.solve import objective
from kronc_ns.solve.lm import RAYLEIGH_MEDIAN, SIGMA_FLOOR_PX, TRIM_SIGMAS, LmResult, adjust
from kronc_ns.solve.problem import Problem, ShapePrior, State
from kronc_ns.solve.uncertainty import camera_covariance

_NO_CHANCE = 8  # a pose can be bent to meet three detections; eight do not agree by accident
_PADDING = 8  # views are padded to a multiple, so that scenes of similar size share a batch
_BATCH_VIEWS = 400  # views in a batch: what stays in the processor's cache
_STEPS_KEPT = 20  # of the poses on the way: enough to watch them move
_REFINEMENTS = 3  # more rounds of undistortion with the k1 found


@dataclass(frozen=True)
class Attempt:
    """What the solver made of a start."""

    start: Start
    """With the poses, points and camera found."""
    initial_c2w: Float[Tensor, "n 3 4"]
    """Where it began, in the frame of the initialiser."""
    inlier: Bool[Tensor, "n j"]
    sigma_px: float
    shape_weight: float
    """1 for a usual car, towards 0 the less it looks like one."""
    covariance: Float[Tensor, "n 6 6"]
    iterations: int
    converged: bool
    history: dict[str, list[float]]
    path: Float[Tensor, "s n 3 4"]
    """Poses at steps on the way, in the gauge of the solver."""
    choice: str = ""
    """Why this start was preferred to others."""

    @property
    def agreeing(self) -> Bool[Tensor, "n"]:
        """Views that `agrees` with the solved points."""
        return agrees(self.inlier.sum(1), (self.start.scene.visibility > 0).sum(1))


def agrees(inliers: Int[Tensor, "n"], seen: Int[Tensor, "n"]) -> Bool[Tensor, "n"]:
    """Whether views fit the solved points: half of their detections do, or so many that it cannot be chance."""
    return (inliers >= MIN_POINTS) & (2 * inliers >= seen) | (inliers >= _NO_CHANCE) & (4 * inliers >= seen)


@lru_cache(maxsize=8)
def shape_prior(schema: KeypointSchema) -> ShapePrior | None:
    """The template as a prior of the solver, where the schema has one."""
    template = car_template(schema)
    return None if template is None else ShapePrior.of(template.mean, template.precision())


def adjust_starts(
    starts: Sequence[Start], config: KroncConfig, progress: Callable[[int, float], None] | None = None
) -> list[Attempt]:
    """Run the solver from every start."""
    attempts: list[Attempt | None] = [None] * len(starts)
    groups: dict[tuple[int, KeypointSchema], list[int]] = defaultdict(list)
    for i, start in enumerate(starts):
        padded = -(-len(start.scene) // _PADDING) * _PADDING
        groups[padded, start.scene.schema].append(i)
    for (views, _), members in groups.items():
        size = max(1, _BATCH_VIEWS // views)
        for first in range(0, len(members), size):
            chosen = members[first : first + size]
            for i, attempt in zip(chosen, _run([starts[i] for i in chosen], views, config, progress), strict=True):
                attempts[i] = attempt
    return [attempt for attempt in attempts if attempt is not None]


def _run(
    starts: list[Start], views: int, config: KroncConfig, progress: Callable[[int, float], None] | None
) -> list[Attempt]:
    device = torch.device("cuda" if config.device == "cuda" else "cpu")
    refine = (*(("focal",) if config.refine_focal else ()), *(("k1",) if config.refine_k1 else ()))
    began = starts

    def solve() -> tuple[Problem, LmResult]:
        problem, state = _problem(starts, views, refine, shape_prior(starts[0].scene.schema))
        problem = problem.to(device)
        return problem, adjust(problem, state.each(lambda t: t.to(device)), config.lm, progress)

    problem, result = solve()
    starts = [_moved(start, result, i, refine) for i, start in enumerate(starts)]
    for _ in range(_REFINEMENTS if config.refine_k1 else 0):
        problem, result = solve()
        starts = [_moved(start, result, i, refine) for i, start in enumerate(starts)]
    inlier = result.inlier
    covariance = camera_covariance(problem, result.state, inlier, result.sigma_px, result.shape_weight)
    inlier, covariance = inlier.cpu(), covariance.cpu()
    sigma, weight = result.sigma_px.tolist(), result.shape_weight.tolist()
    iterations, converged = result.iterations.tolist(), result.converged.tolist()
    return [
        Attempt(
            start,
            first.c2w,
            inlier[i, : len(start.scene)],
            sigma[i],
            weight[i],
            covariance[i, : len(start.scene)],
            iterations[i],
            converged[i],
            result.history(i),
            on_the_way(result.path(i)[:, : len(start.scene)], start.used),
        )
        for i, (start, first) in enumerate(zip(starts, began, strict=True))
    ]


def on_the_way(path: Float[Tensor, "s n 3 4"], used: Bool[Tensor, "n"]) -> Float[Tensor, "k n 3 4"]:
    """A few of the steps, evenly spread; NaN for views that take no part."""
    chosen = torch.linspace(0, len(path) - 1, min(len(path), _STEPS_KEPT)).round().long()
    return torch.where(used[:, None, None], path[chosen].double().cpu(), math.nan)


def _problem(starts: list[Start], views: int, refine: tuple, prior: ShapePrior | None) -> tuple[Problem, State]:
    """The batch of all starts, views padded by unseen ones."""
    joints = len(starts[0].scene.schema)
    uv = torch.zeros(len(starts), views, 2, joints, dtype=torch.float64)
    weight = torch.zeros(len(starts), views, joints, dtype=torch.float64)
    c2w = torch.eye(3, 4, dtype=torch.float64).repeat(len(starts), views, 1, 1)
    for i, start in enumerate(starts):
        scene, n = start.scene, len(start.scene)
        principal = torch.tensor([scene.camera.cx, scene.camera.cy], dtype=torch.float64)
        uv[i, :n] = (scene.uv - principal).transpose(1, 2)
        m = scene.visibility * start.used[:, None]
        if prior is None:
            m = m * (m.sum(0) >= 2)  # without a prior a single view says nothing of a point
        confidence = scene.keypoints[..., 2]
        weight[i, :n] = m * confidence / (m * confidence).sum().clamp_min(1e-9) * m.sum()
        c2w[i, :n] = torch.where(start.used[:, None, None], start.c2w, c2w[i, :n])
    focal = torch.tensor([[s.scene.camera.fx, s.scene.camera.fy] for s in starts], dtype=torch.float64)
    points = torch.stack([start.points for start in starts])
    return Problem(uv, weight, focal, prior, refine=refine), State.of(c2w, points, len(refine))


def _moved(start: Start, result: LmResult, i: int, refine: tuple) -> Start:
    """The start where the solver has left it, its camera included."""
    n = len(start.scene)
    c2w = torch.where(start.used[:, None, None], result.state.c2w[i, :n].cpu(), start.c2w)
    scene = start.scene
    if refine:
        change = dict(zip(refine, result.state.intrinsics[i].tolist(), strict=True))
        growth = math.exp(change.get("focal", 0.0))
        old = scene.camera
        camera = replace(old, fx=old.fx * growth, fy=old.fy * growth, k1=old.k1 + change.get("k1", 0.0))
        scene = replace(scene, camera=camera)
    return replace(start, scene=scene, c2w=c2w, points=result.state.points[i].cpu())


def measured(
    start: Start,
    initial_c2w: Float[Tensor, "n 3 4"],
    iterations: int,
    history: dict[str, list[float]],
    path: Float[Tensor, "s n 3 4"],
) -> Attempt:
    """An attempt of another solver, with inliers and covariance as this one's have them."""
    scene = start.scene
    seen = (scene.visibility > 0) & start.used[:, None] & start.points.isfinite().all(-1)
    error = (objective.reproject(start.points, start.c2w, scene.camera) - scene.uv).norm(dim=-1)
    error = torch.where(seen & in_front(start), error, math.inf)
    finite = error[error.isfinite()]
    sigma_px = max(float(finite.median()) / RAYLEIGH_MEDIAN, SIGMA_FLOOR_PX) if len(finite) else math.nan
    inlier = error <= TRIM_SIGMAS * sigma_px
    covariance = torch.full((len(scene), 6, 6), math.nan, dtype=torch.float64)
    if inlier.any():
        known = replace(start, points=start.points.nan_to_num(0.0))
        problem, state = _problem([known], len(scene), (), None)
        one = torch.ones(1, dtype=torch.float64)
        covariance = camera_covariance(problem, state, inlier[None], one * sigma_px, one)[0]
    return Attempt(start, initial_c2w, inlier, sigma_px, 1.0, covariance, iterations, True, history, path)


def misfit(attempt: Attempt) -> float:
    """What an attempt leaves unexplained: 0 if every detection of usable views is met, 1 if none is.

    Comparable between attempts at the same scene; detections behind a camera or on the car's far side count as lost.
    """
    start = attempt.start
    scene = start.scene
    tolerance = 0.01 * math.hypot(scene.camera.width, scene.camera.height)
    counted = (scene.visibility > 0) & usable_views(scene)[:, None]
    error = (objective.reproject(start.points, start.c2w, scene.camera) - scene.uv).norm(dim=-1)
    off = (1 - 1 / (1 + (error / tolerance).square())).nan_to_num(1.0)
    lost = ~in_front(start) | far_side(start) | ~start.used[:, None]
    return float(torch.where(lost, 1.0, off)[counted].mean()) if counted.any() else 1.0
