"""Robust Levenberg-Marquardt on the reprojection error, for a batch of scenes at once.

Minimised per scene (docs/solver.md): ``sum rho(|r_ij|) + sigma^2 prior``. Robust losses are met by iteratively
reweighted least squares (IRLS). With the Cauchy loss its scale follows the residuals down, so that a far start
converges (graduated robustness); at last detections beyond 4.5 sigma are left out and the rest counts in squares, so
that without outliers the result is the maximum-likelihood one.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from typing_extensions import assert_never

from kronc_ns.geometry.poses import invert, make_pose
from kronc_ns.solve import lm_cpu
from kronc_ns.solve.bundle import eliminate_cameras, linearise, move, orbit_error, residuals, solve_step
from kronc_ns.solve.lm_cpu import (
    CAUCHY_SIGMAS,
    COARSE,
    LEAST_DAMPING,
    LOOSE,
    MOST_DAMPING,
    RAYLEIGH_MEDIAN,
    ROBUST,
    ROUNDS,
    SIGMA_FLOOR_PX,
    START_DAMPING,
    TRIM_SIGMAS,
    TRIMMED,
)
from kronc_ns.solve.problem import Batched, Problem, Residuals, ShapePrior, State, array
from kronc_ns.solve.threads import aside

_HUBER_SIGMAS = 2.0
_RECORDED = 200
"""Most steps of which the poses are kept."""


@dataclass(frozen=True)
class LmConfig:
    """Parameters of the second-order solver."""

    iterations: int = 200
    """Most iterations, rejected steps included."""
    tolerance: float = 1e-6
    """Converged when a step lowers the cost by less than this share."""
    loss: Literal["cauchy", "huber", "none"] = "cauchy"
    """cauchy: outliers lose influence and are left out at last; huber: they count linearly; none: in squares."""


@dataclass(frozen=True)
class LmResult:
    """Where the solver ended, scene by scene."""

    state: State
    cost: Float[Tensor, "b"]
    """Robust cost of the detections and the priors, in units of sigma^2."""
    sigma_px: Float[Tensor, "b"]
    """Noise of the inliers per axis."""
    inlier: Bool[Tensor, "b n j"]
    shape_weight: Float[Tensor, "b"]
    """What the shape prior counted at last: 1 for a usual shape, less for an unusual one."""
    iterations: Int[Tensor, "b"]
    converged: Bool[Tensor, "b"]
    loss: Float[Tensor, "b k"]
    """Root of the mean robust squared error in pixels after each step, as far as there were `iterations`."""
    rotations: Float[Tensor, "b s n 3 3"]
    """World to camera after each of the first steps, as far as there were `iterations`."""
    translations: Float[Tensor, "b s n 3"]

    def history(self, scene: int = 0) -> dict[str, list[float]]:
        """ "step" and "loss" of a scene."""
        loss = self.loss[scene, : int(self.iterations[scene])].tolist()
        return {"step": [float(step) for step in range(1, len(loss) + 1)], "loss": loss}

    def path(self, scene: int) -> Float[Tensor, "s n 3 4"]:
        """Poses (c2w) of a scene after each step, in the gauge of the solver."""
        steps = int(self.iterations[scene])
        return invert(make_pose(self.rotations[scene, :steps], self.translations[scene, :steps]))


@dataclass(frozen=True)
class _Search(Batched):
    """Everything that changes while a batch is solved; scenes in front, so that it can be thinned out."""

    scene: Int[Tensor, "b"]
    state: State
    residual: Residuals
    sigma: Float[Tensor, "b"]
    phase: Int[Tensor, "b"]
    cost: Float[Tensor, "b"]
    damping: Float[Tensor, "b"]
    rounds: Int[Tensor, "b"]


def adjust(
    problem: Problem,
    start: State,
    config: LmConfig | None = None,
    progress: Callable[[int, float], None] | None = None,
    most_sigma_px: Float[Tensor, "b"] | None = None,
) -> LmResult:
    """Minimise from ``start``; scenes that converge leave the batch. ``progress(step, loss)`` is optional.

    ``most_sigma_px`` is for a start that is nearly right among many outliers: noise that residuals far above it do
    not make believe otherwise.
    """
    config = config or LmConfig()
    with torch.no_grad():
        run = _adjust_compiled if problem.plain and config.loss == "cauchy" else _adjust
        return run(problem, start, config, progress, most_sigma_px)


def _adjust_compiled(
    problem: Problem,
    start: State,
    config: LmConfig,
    progress: Callable[[int, float], None] | None,
    most_sigma_px: Float[Tensor, "b"] | None,
) -> LmResult:
    scenes = len(problem.uv)
    state = start.each(lambda x: x.clone(memory_format=torch.contiguous_format))
    inlier = torch.zeros(problem.weight.shape, dtype=torch.bool)
    loss, rotations, translations = _record(problem, config)
    shape = problem.shape or ShapePrior.nothing(problem.uv)
    most = problem.uv.new_full((scenes,), math.inf) if most_sigma_px is None else most_sigma_px
    with aside():
        found = lm_cpu.adjust_scenes(
            *(state.rotation.numpy(), state.translation.numpy(), state.points.numpy()),
            *(array(problem.uv), array(problem.weight), array(problem.focal)),
            *(array(_redundancy(problem)), array(most), array(shape.mean), array(shape.precision), shape.freedom),
            *(problem.points_known, config.iterations, config.tolerance),
            *(inlier.numpy(), loss.numpy(), rotations.numpy(), translations.numpy()),
        )
    found = torch.from_numpy(found)
    sigma, cost, shape_weight = found[:3]
    steps, converged = found[3].long(), found[4].bool()
    loss = (loss / _detections(problem)[:, None]).sqrt()
    if progress is not None and scenes:
        for step, value in enumerate(loss[0, : int(steps[0])].tolist(), start=1):
            progress(step, value)
    cost = cost / sigma.square()
    return LmResult(state, cost, sigma, inlier, shape_weight, steps, converged, loss, rotations, translations)


def _adjust(
    problem: Problem,
    start: State,
    config: LmConfig,
    progress: Callable[[int, float], None] | None,
    most_sigma_px: Float[Tensor, "b"] | None,
) -> LmResult:
    whole, scenes = problem, len(problem.uv)
    counts = _redundancy(problem)
    residual = residuals(problem, start)
    sigma = _robust_sigma(problem, residual) * counts
    if most_sigma_px is not None:
        sigma = torch.minimum(sigma, most_sigma_px)
    search = _Search(
        scene=torch.arange(scenes, device=problem.uv.device),
        state=start,
        residual=residual,
        sigma=sigma,
        phase=torch.full((scenes,), ROBUST, device=problem.uv.device),
        cost=sigma.new_full((scenes,), math.inf),
        damping=torch.full_like(sigma, START_DAMPING),
        rounds=torch.zeros(scenes, dtype=torch.long, device=problem.uv.device),
    )
    search = replace(search, cost=_cost(problem, search, config))
    finished = search
    steps = torch.zeros(scenes, dtype=torch.long, device=problem.uv.device)
    converged = torch.zeros(scenes, dtype=torch.bool, device=problem.uv.device)
    loss, rotations, translations = _record(problem, config)
    detections = _detections(problem)
    for step in range(1, config.iterations + 1 if scenes else 1):
        search, done = _iterate(problem, search, counts, config)
        steps[search.scene] = step
        loss[search.scene, step - 1] = (search.cost / detections[search.scene]).sqrt()
        if step <= _RECORDED:
            rotations[search.scene, step - 1] = search.state.rotation
            translations[search.scene, step - 1] = search.state.translation
        if progress is not None and search.scene[0] == 0:
            progress(step, float(loss[0, step - 1]))
        converged[search.scene[done]] = True
        leaving = done if step < config.iterations else torch.ones_like(done)
        if leaving.any():
            finished = _store(finished, search, leaving)
            keep = torch.nonzero(~leaving)[:, 0]
            if not len(keep):
                break
            problem, search, counts = problem[keep], search[keep], counts[keep]
    sigma = finished.sigma
    return LmResult(
        state=finished.state,
        cost=finished.cost / sigma.square(),
        sigma_px=sigma,
        inlier=(whole.weight > 0) & (finished.residual.norm <= TRIM_SIGMAS * sigma[:, None, None]),
        shape_weight=_shape_weight(whole, finished.residual),
        iterations=steps,
        converged=converged,
        loss=loss,
        rotations=rotations,
        translations=translations,
    )


def _record(
    problem: Problem, config: LmConfig
) -> tuple[Float[Tensor, "b k"], Float[Tensor, "b s n 3 3"], Float[Tensor, "b s n 3"]]:
    """Room for the loss of every step and the poses of the first (memory that is not written is never taken)."""
    scenes, views = problem.uv.shape[:2]
    steps = min(config.iterations, _RECORDED)
    shapes = [(scenes, config.iterations), (scenes, steps, views, 3, 3), (scenes, steps, views, 3)]
    loss, rotations, translations = (problem.uv.new_empty(shape) for shape in shapes)
    return loss, rotations, translations


def _detections(problem: Problem) -> Float[Tensor, "b"]:
    return (problem.weight > 0).sum((1, 2)).clamp_min(1).to(problem.uv.dtype)


def _iterate(problem: Problem, search: _Search, counts: Tensor, config: LmConfig) -> tuple[_Search, Bool[Tensor, "b"]]:
    """One damped step of every scene in the batch, and which scenes are finished."""
    system = linearise(
        problem,
        search.state,
        search.residual,
        _irls_weight(search, config),
        search.sigma.square(),
        _shape_weight(problem, search.residual),
    )
    trial = move(search.state, solve_step(eliminate_cameras(system, search.damping), problem.uv.shape[3]))
    attempt = replace(search, state=trial, residual=residuals(problem, trial))
    cost = _cost(problem, attempt, config)
    better = cost < search.cost  # false for NaN
    coarse = (search.phase == ROBUST) & (config.loss == "cauchy")
    still = (search.cost - cost).abs() <= torch.where(coarse, COARSE, config.tolerance) * search.cost
    damping = torch.where(better, search.damping / 10, search.damping * 10).clamp(min=LEAST_DAMPING)
    settled = still | (damping > MOST_DAMPING)
    search = _choose(better, replace(attempt, cost=cost), search)
    search = replace(search, damping=damping.clamp(max=MOST_DAMPING))
    return _anneal(problem, search, settled, counts, config)


def _anneal(
    problem: Problem, search: _Search, settled: Bool[Tensor, "b"], counts: Tensor, config: LmConfig
) -> tuple[_Search, Bool[Tensor, "b"]]:
    """Follow the residuals with the scale of the loss; move settled scenes to their next phase."""
    robust = search.phase == ROBUST
    if not (robust | settled).any():
        return search, settled
    shrunk = torch.minimum(search.sigma, _robust_sigma(problem, search.residual) * counts)
    sigma = torch.where(robust, shrunk, search.sigma)
    done = settled
    if config.loss == "cauchy":
        done = torch.zeros_like(settled)
        if settled.any():
            search, sigma, done = _next_phase(problem, replace(search, sigma=sigma), settled, shrunk, counts)
    search = replace(search, sigma=sigma)
    return replace(search, cost=_cost(problem, search, config)), done


def _next_phase(
    problem: Problem, search: _Search, settled: Bool[Tensor, "b"], shrunk: Float[Tensor, "b"], counts: Tensor
) -> tuple[_Search, Float[Tensor, "b"], Bool[Tensor, "b"]]:
    """From the graduated loss to the trimmed squares, and to the end when the choice of inliers stands."""
    robust, seen, norm, sigma = search.phase == ROBUST, problem.weight > 0, search.residual.norm, search.sigma
    inlier = seen & (norm <= TRIM_SIGMAS * sigma[:, None, None])
    found = inlier.sum((1, 2)).clamp_min(1)
    spread = (torch.where(inlier, norm.square(), 0.0).sum((1, 2)) / (2 * found)).sqrt() * counts
    spread = torch.minimum(spread.clamp_min(SIGMA_FLOOR_PX), shrunk)
    again = seen & (norm <= TRIM_SIGMAS * spread[:, None, None])
    loose = spread < LOOSE * sigma  # the scale lags far behind the residuals: on with the robust phase
    rounds = search.rounds + settled
    done = (settled & ~robust & ~loose & (again == inlier).all(2).all(1)) | (rounds >= ROUNDS)
    phase = torch.where(settled, torch.where(loose, ROBUST, TRIMMED), search.phase)
    sigma = torch.where(settled & (loose | ~robust), spread, sigma)
    return replace(search, phase=phase, rounds=rounds), sigma, done


def _choose(chosen: Bool[Tensor, "b"], yes: _Search, no: _Search) -> _Search:
    """``yes`` for the chosen scenes, else ``no``."""
    if bool(chosen.all()):
        return yes
    return yes.each(lambda a, b: torch.where(chosen.view(-1, *[1] * (a.ndim - 1)), a, b), no)


def _store(finished: _Search, search: _Search, chosen: Bool[Tensor, "b"]) -> _Search:
    """What is kept of all scenes, with the chosen ones of those still in the batch."""
    if len(chosen) == len(finished.scene) and bool(chosen.all()):
        return search
    return finished.each(lambda a, b: a.index_copy(0, search.scene[chosen], b[chosen]), search)


def _robust_sigma(problem: Problem, residual: Residuals) -> Float[Tensor, "b"]:
    """Noise per axis from the median of all residuals."""
    norm = torch.where(problem.weight > 0, residual.norm, math.nan).flatten(1)
    return (norm.nanmedian(dim=1).values / RAYLEIGH_MEDIAN).nan_to_num(1.0).clamp_min(SIGMA_FLOOR_PX)


def _redundancy(problem: Problem) -> Float[Tensor, "b"]:
    """Factor from the spread of residuals to that of the detections: the unknowns take up part of the noise."""
    seen = problem.weight > 0
    views, points = seen.any(2).sum(1), (seen.sum(1) > 1).sum(1)
    unknown = 6 * views + (0 if problem.points_known else 3 * points - 7)
    measured = 2 * seen.sum((1, 2)).clamp_min(1)
    return ((measured / (measured - unknown).clamp_min(0)).sqrt()).to(problem.uv.dtype).clamp(max=1.6)


def _irls_weight(search: _Search, config: LmConfig) -> Float[Tensor, "b n j"]:
    norm, sigma = search.residual.norm, search.sigma[:, None, None]
    match config.loss:
        case "cauchy":
            return _by_phase(
                search.phase,
                lambda: (norm * (1 / (CAUCHY_SIGMAS * sigma))).square_().add_(1.0).reciprocal_(),
                lambda: (norm <= TRIM_SIGMAS * sigma).to(norm.dtype),
            )
        case "huber":
            return (_HUBER_SIGMAS * sigma / norm.clamp_min(1e-12)).clamp(max=1.0)
        case "none":
            return torch.ones_like(norm)
        case _:
            assert_never(config.loss)


def _cost(problem: Problem, search: _Search, config: LmConfig) -> Float[Tensor, "b"]:
    """What is minimised, in squared pixels."""
    norm, sigma = search.residual.norm, search.sigma
    square = norm.square()
    match config.loss:
        case "cauchy":
            scale = sigma.square()[:, None, None]
            value = _by_phase(
                search.phase,
                lambda: torch.log1p(square / (CAUCHY_SIGMAS**2 * scale)).mul_(CAUCHY_SIGMAS**2 * scale),
                lambda: torch.minimum(square, TRIM_SIGMAS**2 * scale),
            )
        case "huber":
            knee = _HUBER_SIGMAS * sigma[:, None, None]
            value = torch.where(norm <= knee, square, 2 * knee * norm - knee.square())
        case "none":
            value = square
        case _:
            assert_never(config.loss)
    cost = value.sum((1, 2))
    if problem.shape is not None and not problem.points_known:
        surprise, size = search.residual.surprise, search.residual.pull.shape[1]
        freedom = problem.shape.freedom
        tail = ((freedom + surprise).clamp_min(freedom + size) / (freedom + size)).log_().mul_(freedom + size)
        cost = cost + sigma.square() * (surprise.clamp(max=size) + tail)
    if problem.orbit is not None:
        error = orbit_error(problem.orbit, search.state).square().sum(-1) / problem.orbit.sigma.square()
        cost = cost + sigma.square() * error.sum(1)
    return cost


def _by_phase(
    phase: Int[Tensor, "b"], robust: Callable[[], Tensor], trimmed: Callable[[], Tensor]
) -> Float[Tensor, "b n j"]:
    """What each scene's phase calls for; while all are in one phase, as a single scene is, nothing else is computed."""
    phases = set(phase.tolist())
    if len(phases) < 2:
        return trimmed() if TRIMMED in phases else robust()
    return torch.where((phase == ROBUST)[:, None, None], robust(), trimmed())


def _shape_weight(problem: Problem, residual: Residuals) -> Float[Tensor, "b"]:
    """IRLS weight of the shape prior: 1 for a usual shape, falling like a Student t's for an unusual one."""
    if problem.shape is None or problem.points_known:
        return torch.ones_like(residual.surprise)
    freedom = problem.shape.freedom
    return ((freedom + residual.pull.shape[1]) / (freedom + residual.surprise)).clamp(max=1.0)
