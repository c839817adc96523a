"""Robust Levenberg-Marquardt on the reprojection error of a scene.

Minimised (docs/solver.md): ``sum rho(|r_ij|) + sigma^2 prior``, the losses as in `robust`, the steps as in `schur`.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from kronc_ns.solve import records, robust, schur
from kronc_ns.solve.compiled import is_compiled
from kronc_ns.solve.options import LmConfig
from kronc_ns.solve.problem import Problem, State

START_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-9, 1e9


@dataclass(frozen=True)
class LmResult:
    """Where the solver ended."""

    state: State
    cost: float
    """Robust cost of the detections and the priors, in units of sigma^2."""
    sigma_px: float
    """Noise of the inliers per axis."""
    inlier: Bool[np.ndarray, "n j"]
    shape_weight: float
    """What the shape prior counted at last: 1 for a usual shape, less for an unusual one."""
    converged: bool
    loss: tuple[float, ...]
    """Root of the mean robust squared error in pixels after each step."""
    path: tuple[State, ...]
    """The state after each step."""


def adjust(
    problem: Problem,
    start: State,
    config: LmConfig | None = None,
    progress: Callable[[int, float], None] | None = None,
    sigma_px: float | None = None,
) -> LmResult:
    """Minimise from ``start``. ``progress(step, loss)`` is optional.

    ``sigma_px`` is the noise where it is known: for a start that is nearly right among many outliers, or so few
    detections that they can be met exactly, the residuals do not tell it.
    """
    config = config or LmConfig()
    data, redundancy = records.measured(problem), problem.redundancy
    now, trial = records.estimate(data, start), records.estimate(data, start)
    views, joints = problem.weight.shape
    work = records.system(data, views, joints)
    detections = max(len(data.joint), 1)

    schur.evaluate(data, now)
    phase = robust.first_phase(config.loss)

    def noise() -> float:
        return robust.noise(now.length, work.order) * redundancy if sigma_px is None else sigma_px

    sigma = noise()
    cost = schur.total_cost(data, now, sigma, phase)
    damping, before, rounds, done = START_DAMPING, 0.0, 0, False
    losses: list[float] = []
    path: list[State] = []
    while len(losses) < config.iterations and not done:
        proposed = schur.propose(data, now, trial, work, sigma, phase, damping)
        gain = robust.gain(cost, proposed)
        tolerance = robust.COARSE if phase == robust.CAUCHY else config.tolerance
        better = proposed < cost  # false for NaN
        settled = (robust.next_gain(gain, before) if better else gain) <= tolerance
        if better:
            now, trial, cost, before = trial, now, proposed, gain
            damping = max(damping / 10, LEAST_DAMPING)
        else:
            damping *= 10
        settled = settled or damping > MOST_DAMPING
        damping = min(damping, MOST_DAMPING)
        if settled or phase != robust.TRIMMED:
            # follow the residuals with the scale of the loss
            shrunk = min(sigma, noise())
            if phase != robust.TRIMMED:
                sigma = shrunk
            if settled:
                rounds, before = rounds + 1, 0.0
                phase, told, done = robust.next_phase(now.length, sigma, phase, shrunk, redundancy)
                sigma = told if sigma_px is None else sigma_px
                done = done or rounds >= robust.ROUNDS
            cost = schur.total_cost(data, now, sigma, phase)
        losses.append(math.sqrt(cost / detections))
        path.append(_state(now))
        if progress is not None:
            progress(len(losses), losses[-1])
    inlier = np.zeros(problem.weight.shape, dtype=bool)
    inlier[problem.weight > 0] = now.length <= robust.INLIER_SIGMAS * sigma
    usual = 1.0
    if problem.shape is not None and not problem.points_known:
        usual = robust.shape_weight(float(now.surprise[0]), problem.shape.freedom, len(problem.shape.mean))
    state = path[-1] if path else _state(now)
    return LmResult(state, cost / sigma**2, sigma, inlier, usual, done, tuple(losses), tuple(path))


def is_ready() -> bool:
    """Whether the compiled solver is there, in this process or on disk; else the first call compiles it."""
    return is_compiled(schur.reduce_system)


def _state(now: records.Estimate) -> State:
    poses = now.rotation.copy(), now.translation.copy(), now.points.copy()
    if len(now.intrinsics) == 1:
        return State(*poses, *now.intrinsics[0].tolist())
    return State(*poses, *now.intrinsics.T.copy())
