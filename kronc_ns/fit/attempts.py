"""Hypotheses to the second-order solver and back."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from jaxtyping import Bool, Float, Int

from kronc_ns.fit.noise import Noise, believed_noise
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.starts import MIN_POINTS, Hypothesis, usable_views
from kronc_ns.geometry.camera import Camera
from kronc_ns.geometry.poses import invert, make_pose
from kronc_ns.keypoints.schema import KeypointSchema
from kronc_ns.keypoints.template import car_template
from kronc_ns.scene import Scene
from kronc_ns.solve.covariance import camera_covariance
from kronc_ns.solve.lm import LmResult, adjust
from kronc_ns.solve.problem import Intrinsic, Problem, ShapePrior, State
from kronc_ns.solve.robust import INLIER_SIGMAS, noise_px

_NO_CHANCE = 8  # a pose can be bent to meet three detections; eight do not agree by accident
_STEPS_KEPT = 20  # of the poses on the way: enough to watch them move
_REFINEMENTS = 3  # more rounds of undistortion with the k1 found
_MOST_GROWTH = 3.0  # of the logarithm of a focal length: beyond, the solver flees from what does not fit
_TOLERATED = 0.01  # of the image diagonal: what a detection may be off to count as met by half


@dataclass(frozen=True)
class Attempt:
    """What the solver made of a start."""

    start: Hypothesis
    found: Hypothesis
    inlier: Bool[np.ndarray, "n j"]
    sigma_px: float
    shape_weight: float
    """1 for a usual car, towards 0 the less it looks like one."""
    problem: Problem
    state: State
    """What was solved last, and where it ended, in the solver's gauge."""
    iterations: int
    converged: bool
    history: dict[str, list[float]]
    path: Float[np.ndarray, "s n 3 4"]
    """Poses at steps on the way, in the gauge of the solver."""
    choice: str = ""
    """Why this start was preferred to others."""

    @cached_property
    def noise(self) -> Noise:
        """Of the detections, as a judge should see it."""
        camera = self.found.scene.camera
        diagonal = math.hypot(camera.width, camera.height)
        return believed_noise(self.problem, self.found.error_px, self.inlier, diagonal)

    def covariance(self) -> Float[np.ndarray, "n 6 6"]:
        """Of each camera (`camera_covariance`); NaN where nothing agrees."""
        if not self.inlier.any():
            return np.full((len(self.inlier), 6, 6), math.nan)
        of_noise = camera_covariance(self.problem, self.state, self.inlier, self.noise.sigma_px, self.shape_weight)
        return self.noise.widening**2 * of_noise

    @cached_property
    def met(self) -> Int[np.ndarray, "n"]:
        """How many detections of each view are inliers."""
        return self.inlier.sum(1)

    @cached_property
    def agreeing(self) -> Bool[np.ndarray, "n"]:
        """Views that `agrees` with the solved points."""
        return agrees(self.met, self.found.scene.visible)


def agrees(inliers: Int[np.ndarray, "n"], seen: Int[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    """Whether views fit the solved points: half of their detections do, or so many that it cannot be chance."""
    return (inliers >= MIN_POINTS) & (2 * inliers >= seen) | (inliers >= _NO_CHANCE) & (4 * inliers >= seen)


@lru_cache(maxsize=8)
def shape_prior(schema: KeypointSchema) -> ShapePrior | None:
    """The template as a prior of the solver, where the schema has one."""
    template = car_template(schema)
    return None if template is None else ShapePrior.of(template.mean, template.precision())


def adjust_starts(
    starts: Sequence[Hypothesis], config: KroncConfig, progress: Callable[[int, float], None] | None = None
) -> list[Attempt]:
    """Run the solver from every start."""
    refine: tuple[Intrinsic, ...] = (
        *(("focal",) if config.refine_focal else ()),
        *(("k1",) if config.refine_k1 else ()),
    )
    if config.device == "cuda" and all(one.scene.lenses is None for one in starts):
        from kronc_ns.solve.batched import adjust_batch  # seconds of torch's import

        def solve(found: Sequence[Hypothesis]) -> list[tuple[Problem, LmResult]]:
            problems = [problem_of(one, refine) for one in found]
            states = [State.of(_posed(one), one.points) for one in found]
            results = adjust_batch(problems, states, config.lm, "cuda", progress)
            return list(zip(problems, results, strict=True))
    else:

        def solve(found: Sequence[Hypothesis]) -> list[tuple[Problem, LmResult]]:
            problems = [problem_of(one, refine) for one in found]
            return [
                (problem, adjust(problem, State.of(_posed(one), one.points), config.lm, progress))
                for problem, one in zip(problems, found, strict=True)
            ]

    found = list(starts)
    solved: list[tuple[Problem, LmResult]] = []
    for _ in range(1 + (_REFINEMENTS if config.refine_k1 else 0)):
        solved = solve(found)
        found = [_moved(one, result) for one, (_, result) in zip(found, solved, strict=True)]
    return [_attempt(*row) for row in zip(starts, found, *zip(*solved, strict=True), strict=True)] if solved else []


def _attempt(start: Hypothesis, found: Hypothesis, problem: Problem, result: LmResult) -> Attempt:
    steps = [result.path[i] for i in kept_steps(len(result.path))]
    rotation = np.array([step.rotation for step in steps]).reshape(len(steps), len(start.scene), 3, 3)
    translation = np.array([step.translation for step in steps]).reshape(len(steps), len(start.scene), 3)
    return Attempt(
        start=start,
        found=found,
        inlier=result.inlier,
        sigma_px=result.sigma_px,
        shape_weight=result.shape_weight,
        problem=problem,
        state=result.state,
        iterations=len(result.loss),
        converged=result.converged,
        history={"step": [float(step) for step in range(1, len(result.loss) + 1)], "loss": list(result.loss)},
        path=np.where(start.used[:, None, None], invert(make_pose(rotation, translation)), math.nan),
    )


def kept_steps(count: int) -> list[int]:
    """A few of the steps on the way, evenly spread."""
    kept = min(count, _STEPS_KEPT)
    return [round(i * (count - 1) / max(kept - 1, 1)) for i in range(kept)]


def _posed(found: Hypothesis) -> Float[np.ndarray, "n 3 4"]:
    """Poses, of views that take no part any."""
    return np.where(found.used[:, None, None], found.c2w, np.eye(3, 4))


def problem_of(found: Hypothesis, refine: tuple[Intrinsic, ...] = (), with_prior: bool = True) -> Problem:
    """What the views that take part measured."""
    scene, camera = found.scene, found.scene.camera
    prior = shape_prior(scene.schema) if with_prior else None
    m = scene.visibility * found.used[:, None]
    if prior is None:
        m = m * (m.sum(0) >= 2)  # without a prior a single view says nothing of a point
    precise = m * scene.precision
    weight = precise / max(precise.sum(), 1e-9) * m.sum()
    lens = None if scene.lenses is None else scene.lenses.of_view
    return Problem(scene.uv - (camera.cx, camera.cy), weight, (camera.fx, camera.fy), prior, refine=refine, lens=lens)


def _moved(start: Hypothesis, result: LmResult) -> Hypothesis:
    """The start where the solver has left it, its camera included."""
    state, scene = result.state, start.scene
    if np.any(state.log_growth) or np.any(state.k1):
        scene = _refined(scene, np.atleast_1d(state.log_growth), np.atleast_1d(state.k1))
    c2w = np.where(start.used[:, None, None], state.c2w, start.c2w)
    return replace(start, scene=scene, c2w=c2w, points=state.points)


def _refined(scene: Scene, log_growth: Float[np.ndarray, "g"], k1: Float[np.ndarray, "g"]) -> Scene:
    """The scene with what was found of the intrinsics of its cameras."""

    def changed(camera: Camera, lens: int) -> Camera:
        growth = math.exp(max(-_MOST_GROWTH, min(_MOST_GROWTH, log_growth[lens])))
        return replace(camera, fx=camera.fx * growth, fy=camera.fy * growth, k1=camera.k1 + float(k1[lens]))

    if scene.lenses is None:
        return replace(scene, camera=changed(scene.camera, 0))
    cameras = tuple(changed(camera, lens) for lens, camera in enumerate(scene.lenses.cameras))
    usual = cameras[scene.lenses.cameras.index(scene.camera)]
    return replace(scene, camera=usual, lenses=replace(scene.lenses, cameras=cameras))


def measured(
    start: Hypothesis, found: Hypothesis, iterations: int, history: dict[str, list[float]], path: np.ndarray
) -> Attempt:
    """An attempt of another solver, with inliers and covariance as this one's have them."""
    scene = found.scene
    counted = scene.seen & found.used[:, None]
    error = np.where(counted, found.error_px, math.inf)
    sigma_px = noise_px(error[np.isfinite(error)])
    inlier = error <= INLIER_SIGMAS * sigma_px
    points = np.where(np.isfinite(found.points), found.points, 0.0)
    return Attempt(
        start=start,
        found=found,
        inlier=inlier,
        sigma_px=sigma_px,
        shape_weight=1.0,
        problem=problem_of(found, with_prior=False),
        state=State.of(_posed(found), points),
        iterations=iterations,
        converged=True,
        history=history,
        path=path,
    )


def misfit(attempt: Attempt) -> float:
    """What an attempt leaves unexplained: 0 if every detection of usable views is met, 1 if none is.

    Comparable between attempts at the same scene; detections behind a camera or on the car's far side count as lost.
    """
    found = attempt.found
    scene = found.scene
    counted = scene.seen & usable_views(scene)[:, None]
    if not counted.any():
        return 1.0
    tolerance = _TOLERATED * math.hypot(scene.camera.width, scene.camera.height)
    off = 1 - 1 / (1 + (found.error_px / tolerance) ** 2)
    return float(np.where(found.far_side | ~found.used[:, None], 1.0, off)[counted].mean())
