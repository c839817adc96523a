"""Scenes to the second-order solver and back: where it may start, what it makes of a start, repair of odd views.

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

from kronc_ns import objective
from kronc_ns.frame import rough_frame
from kronc_ns.geometry.camera import rays
from kronc_ns.geometry.poses import invert
from kronc_ns.init import Direction, circular_poses, triangulate
from kronc_ns.keypoints.schema import KeypointSchema
from kronc_ns.keypoints.template import car_template
from kronc_ns.options import KroncConfig
from kronc_ns.scene import Scene
from kronc_ns.solve.bundle import Problem, ShapePrior, State
from kronc_ns.solve.lm import LmResult, adjust
from kronc_ns.solve.resection import AWAY, locate, unexplained
from kronc_ns.solve.uncertainty import camera_covariance

MIN_POINTS = 4
"""A view with fewer keypoints cannot be placed by them alone (three points have up to four poses)."""
_NO_CHANCE = 8  # a pose can be bent to meet three detections; eight do not agree by accident
_ALL_LAPS = (0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0)
_TEMPLATE_TOLERANCE = 0.03  # of the car's extent in the image: about 13 cm on the car
_TOLERANCE_SIGMAS = 3.0  # likewise, once the points are solved
_LOST = 0.8  # mean robust cost of a view's detections from which on its pose says nothing
_SWAP_GAIN = 0.7  # a view is taken for left-right swapped where that lowers its cost below this share
_ODD_SHARE = 0.3  # share of a view's detections on the far side of the car that makes the view suspect
_REPAIRS = 3
_PADDING = 8  # views are padded to a multiple, so that scenes of similar size share a batch
_BATCH_VIEWS = 400  # views in a batch: what stays in the processor's cache
_REFINEMENTS = 4  # rounds of undistortion with the k1 found


@dataclass(frozen=True)
class Start:
    """Where the solver may start."""

    name: str
    scene: Scene
    """Keypoints with left and right put right, as far as that is known."""
    c2w: Float[Tensor, "n 3 4"]
    points: Float[Tensor, "j 3"]
    used: Bool[Tensor, "n"]
    """Views that take part."""
    swapped: Bool[Tensor, "n"]
    """Views whose detections had left and right confused."""


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


def usable_views(scene: Scene) -> Bool[Tensor, "n"]:
    """Views with enough keypoints to be solved."""
    return scene.visibility.sum(1) >= MIN_POINTS


def start_from_poses(name: str, scene: Scene, c2w: Float[Tensor, "n 3 4"]) -> Start:
    """Start at given poses; carried into the car's frame where there is a template."""
    used = usable_views(scene)
    m = scene.visibility * used[:, None]
    points = triangulate(c2w, rays(scene.uv, scene.camera), m)
    template = car_template(scene.schema)
    if template is not None:
        known = m.sum(0) >= 2
        frame = rough_frame(torch.where(known[:, None], points, math.nan), template)
        c2w = frame.apply_to_poses(c2w)
        points = torch.where(known[:, None], frame.apply(points), template.mean)
    return Start(name, scene, c2w, points, used, torch.zeros_like(used))


def start_from_template(scene: Scene) -> Start:
    """Start at the template's pose in each view by itself; left and right are put right where that fits better."""
    template = car_template(scene.schema)
    assert template is not None
    used = usable_views(scene)
    c2w, cost, swapped = _locate(scene, template.mean, used, None)
    keypoints = torch.where(swapped[:, None, None], mirrored(scene.keypoints, scene.schema), scene.keypoints)
    return Start(
        "template",
        replace(scene, keypoints=keypoints),
        c2w,
        template.mean.clone(),
        used & (cost < _LOST),
        swapped,
    )


def circles(scene: Scene, config: KroncConfig) -> list[Start]:
    """Starts at level circles: as the options say and, with ``init="auto"``, both ways and other shares of a lap."""
    kinds: list[tuple[Direction, float]] = [(config.direction, config.laps)]
    if config.init == "auto":
        ways: tuple[Direction, ...] = ("ccw", "cw")
        kinds += [(way, laps) for laps in _ALL_LAPS for way in ways if (way, laps) != kinds[0]]
    return [
        start_from_poses(
            "circular" if config.init == "circular" else f"circular ({way}, {laps:g} lap{'s' if laps > 1 else ''})",
            scene,
            circular_poses(len(scene), config.radius_m, way, laps),
        )
        for way, laps in kinds
    ]


def mirrored(keypoints: Float[Tensor, "n j 3"], schema: KeypointSchema) -> Float[Tensor, "n j 3"]:
    """Detections with left and right exchanged."""
    return keypoints[:, torch.tensor(schema.flip)]


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
    for _ in range(_REFINEMENTS if config.refine_k1 else 1):
        problem, state = _problem(starts, views, refine, shape_prior(starts[0].scene.schema))
        problem, state = (x.each(lambda t: t.to(device)) for x in (problem, state))
        result = adjust(problem, state, config.lm, progress)
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
            result.history if i == 0 else {},
        )
        for i, (start, first) in enumerate(zip(starts, began, strict=True))
    ]


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
    config: KroncConfig,
) -> Attempt:
    """An attempt of another solver, with inliers and covariance as this one's have them."""
    scene = start.scene
    seen = (scene.visibility > 0) & start.used[:, None] & start.points.isfinite().all(-1)
    error = (objective.reproject(start.points, start.c2w, scene.camera) - scene.uv).norm(dim=-1)
    error = torch.where(seen & in_front(start), error, math.inf)
    finite = error[error.isfinite()]
    sigma_px = max(float(finite.median()) / 1.177, 0.05) if len(finite) else math.nan
    inlier = error <= 4.5 * sigma_px
    covariance = torch.full((len(scene), 6, 6), math.nan, dtype=torch.float64)
    if inlier.any():
        known = replace(start, points=start.points.nan_to_num(0.0))
        problem, state = _problem([known], len(scene), (), None)
        one = torch.ones(1, dtype=torch.float64)
        covariance = camera_covariance(problem, state, inlier[None], one * sigma_px, one)[0]
    return Attempt(start, initial_c2w, inlier, sigma_px, 1.0, covariance, iterations, True, history)


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
    return float(torch.where(lost, 1.0, off)[counted].mean())


def in_front(start: Start) -> Bool[Tensor, "n j"]:
    """Whether each point lies before each camera."""
    return ((start.points - start.c2w[:, None, :, 3]) * start.c2w[:, None, :, 2]).sum(-1) > 0


def far_side(start: Start) -> Bool[Tensor, "n j"]:
    """Whether each point looks away from each camera; never, where the schema has no template."""
    template = car_template(start.scene.schema)
    if template is None:
        return torch.zeros(len(start.scene), len(start.scene.schema), dtype=torch.bool)
    ray = torch.nn.functional.normalize(start.c2w[:, None, :, 3] - start.points, dim=-1)
    return (ray * template.normals).sum(-1) < AWAY


def repair(attempts: Sequence[Attempt], config: KroncConfig) -> list[Attempt]:
    """Find views that disagree or look through the car, locate them anew (also left-right swapped), solve again."""
    attempts = list(attempts)
    suspects: list[Bool[Tensor, "n"]] = [torch.empty(0, dtype=torch.bool)] * len(attempts)
    active = list(range(len(attempts)))
    for _ in range(_REPAIRS):
        changed: list[int] = []
        for i in active:
            suspect = _suspects(attempts[i])
            if suspect.any() and not torch.equal(suspect, suspects[i]):
                suspects[i] = suspect
                attempts[i] = replace(attempts[i], start=_relocated(attempts[i], suspect))
                changed.append(i)
        if not changed:
            break
        solved = adjust_starts([attempts[i].start for i in changed], config)
        for i, attempt in zip(changed, solved, strict=True):
            attempts[i] = replace(
                attempt,
                initial_c2w=attempts[i].initial_c2w,
                iterations=attempts[i].iterations + attempt.iterations,
                history=attempts[i].history,
            )
        active = changed
    return attempts


def _suspects(attempt: Attempt) -> Bool[Tensor, "n"]:
    start = attempt.start
    seen = start.scene.visibility > 0
    away = (far_side(start) & seen).sum(1) > _ODD_SHARE * seen.sum(1)
    few = 2 * attempt.inlier.sum(1) < seen.sum(1)
    return usable_views(start.scene) & (~attempt.agreeing | few | away)


def _relocated(attempt: Attempt, suspect: Bool[Tensor, "n"]) -> Start:
    """The start with suspect views where they fit the solved points best, or left out."""
    start = attempt.start
    scene = start.scene
    trusted = (attempt.inlier & ~suspect[:, None]).sum(0) >= 2
    points = torch.where(trusted[:, None], start.points, math.nan)
    c2w, cost, swapped = _locate(scene, points, suspect, attempt.sigma_px)
    better = suspect & (cost < _present_cost(start, points, attempt.sigma_px))
    swapped &= better
    keypoints = torch.where(swapped[:, None, None], mirrored(scene.keypoints, scene.schema), scene.keypoints)
    return replace(
        start,
        scene=replace(scene, keypoints=keypoints),
        c2w=torch.where(better[:, None, None], c2w, start.c2w),
        used=torch.where(better, cost < _LOST, start.used & (attempt.agreeing | ~suspect)),
        swapped=start.swapped ^ swapped,
    )


def _present_cost(start: Start, points: Float[Tensor, "j 3"], sigma_px: float) -> Float[Tensor, "n"]:
    """Cost of every view where it is, as `locate` reckons it; inf where it has no pose."""
    scene, template = start.scene, car_template(start.scene.schema)
    error = (objective.reproject(points, start.c2w, scene.camera) - scene.uv).norm(dim=-1)
    cost = unexplained(
        torch.where(in_front(start), error, math.inf),
        torch.where(points.isfinite().all(-1), scene.visibility, 0.0),
        start.c2w,
        points.expand(len(scene), -1, -1),
        torch.full((len(scene),), _TOLERANCE_SIGMAS * sigma_px, dtype=torch.float64),
        None if template is None else template.normals,
    )
    return torch.where(start.used, cost.nan_to_num(math.inf), math.inf)


def _locate(
    scene: Scene, points: Float[Tensor, "j 3"], chosen: Bool[Tensor, "n"], sigma_px: float | None
) -> tuple[Float[Tensor, "n 3 4"], Float[Tensor, "n"], Bool[Tensor, "n"]]:
    """Pose, cost and whether left and right are swapped, of the chosen views by themselves (others: NaN, inf, no)."""
    template, camera = car_template(scene.schema), scene.camera
    index = chosen.nonzero()[:, 0]
    has_sides = any(j != f for j, f in enumerate(scene.schema.flip))
    variants = [scene.keypoints[index]]
    if has_sides:
        variants.append(mirrored(scene.keypoints[index], scene.schema))
    detected = torch.cat(variants)
    m = detected[..., 2] > 0
    uv = camera.undistort(detected[..., :2]) - torch.tensor([camera.cx, camera.cy], dtype=torch.float64)
    if sigma_px is None:
        spread = torch.where(m[..., None], uv, -math.inf).amax(1) - torch.where(m[..., None], uv, math.inf).amin(1)
        tolerance = _TEMPLATE_TOLERANCE * spread.amax(1)
    else:
        tolerance = torch.full((len(detected),), _TOLERANCE_SIGMAS * sigma_px, dtype=torch.float64)
    focal = torch.tensor([camera.fx, camera.fy], dtype=torch.float64)
    found = locate(
        points.expand(len(detected), -1, -1),
        uv.transpose(1, 2).contiguous(),
        m.to(torch.float64),
        focal.expand(len(detected), 2),
        tolerance,
        None if template is None else template.normals,
        exact=sigma_px is not None,
    )
    poses, costs = invert(found.w2c).unflatten(0, (len(variants), -1)), found.cost.view(len(variants), -1)
    flipped = costs[-1] < _SWAP_GAIN * costs[0]
    c2w = torch.full((len(scene), 3, 4), math.nan, dtype=torch.float64)
    cost = torch.full((len(scene),), math.inf, dtype=torch.float64)
    swapped = torch.zeros(len(scene), dtype=torch.bool)
    c2w[index] = torch.where(flipped[:, None, None], poses[-1], poses[0])
    cost[index] = torch.where(flipped, costs[-1], costs[0])
    swapped[index] = flipped
    return c2w, cost, swapped
