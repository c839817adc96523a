"""`lm` for many scenes at once on tensors: for CUDA, where dispatch and not arithmetic costs. Same results and records.

Scenes that converge leave the batch. Nothing on a CPU takes this path but the tests, which hold both solvers together.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from kronc_ns.solve import robust
from kronc_ns.solve.lm import LEAST_DAMPING, MOST_DAMPING, START_DAMPING, LmResult
from kronc_ns.solve.options import LmConfig
from kronc_ns.solve.problem import Problem, State
from kronc_ns.solve.tensors import Batched, Problems, Residuals, States, linearise, orbit_error, residuals, stack, step

_PADDING = 8  # views are padded to a multiple, so that scenes of similar size share a batch


@dataclass(frozen=True)
class _Search(Batched):
    """Everything that changes while a batch is solved; scenes in front, so that it can be thinned out."""

    scene: Int[Tensor, "b"]
    state: States
    residual: Residuals
    sigma: Float[Tensor, "b"]
    phase: Int[Tensor, "b"]
    cost: Float[Tensor, "b"]
    damping: Float[Tensor, "b"]
    rounds: Int[Tensor, "b"]
    gain: Float[Tensor, "b"]
    """Of the last step of this phase, 0 before there was one."""


def gpu_is_there() -> bool:
    """Whether torch finds a CUDA GPU."""
    return torch.cuda.is_available()


def adjust_batch(
    problems: Sequence[Problem],
    starts: Sequence[State],
    config: LmConfig | None = None,
    device: str = "cuda",
    progress: Callable[[int, float], None] | None = None,
) -> list[LmResult]:
    """`lm.adjust` of every problem. ``progress`` is told the steps of the first."""
    config = config or LmConfig()
    groups: dict[tuple[object, ...], list[int]] = defaultdict(list)
    for i, problem in enumerate(problems):
        views = -(-len(problem.weight) // _PADDING)
        groups[views, problem.weight.shape[1], problem.refine, problem.points_known, id(problem.shape)].append(i)
    results: dict[int, LmResult] = {}
    with torch.no_grad():
        for members in groups.values():
            chosen = [problems[i] for i in members]
            report = progress if members[0] == 0 else None
            found = _adjust(chosen, [starts[i] for i in members], config, device, report)
            results |= dict(zip(members, found, strict=True))
    return [results[i] for i in range(len(problems))]


def _adjust(
    problems: Sequence[Problem],
    starts: Sequence[State],
    config: LmConfig,
    device: str,
    progress: Callable[[int, float], None] | None,
) -> list[LmResult]:
    problem, start = stack(problems, starts, device)
    count = len(problems)
    residual = residuals(problem, start)
    sigma = _noise(problem, residual) * problem.redundancy
    scenes = torch.arange(count, device=sigma.device)
    search = _Search(
        scene=scenes,
        state=start,
        residual=residual,
        sigma=sigma,
        phase=torch.full_like(scenes, robust.first_phase(config.loss)),
        cost=torch.full_like(sigma, torch.inf),
        damping=torch.full_like(sigma, START_DAMPING),
        rounds=torch.zeros_like(scenes),
        gain=torch.zeros_like(sigma),
    )
    search = replace(search, cost=_cost(problem, search))
    detections = (problem.weight > 0).sum((1, 2)).clamp_min(1)
    losses: list[list[float]] = [[] for _ in problems]
    paths: list[list[State]] = [[] for _ in problems]
    finished: dict[int, tuple[_Search, int, bool]] = {}
    for number in range(1, config.iterations + 1):
        search, done = _iterate(problem, search, config)
        loss = (search.cost / detections[search.scene]).sqrt().tolist()
        for place, (b, value) in enumerate(zip(search.scene.tolist(), loss, strict=True)):
            losses[b].append(value)
            paths[b].append(search.state.scene(place, len(problems[b].weight)))
        if progress is not None and losses[0] and len(losses[0]) == number:
            progress(number, losses[0][-1])
        leaving = done if number < config.iterations else torch.ones_like(done)
        for place in torch.nonzero(leaving)[:, 0].tolist():
            finished[int(search.scene[place])] = (search, place, bool(done[place]))
        keep = torch.nonzero(~leaving)[:, 0]
        if not len(keep):
            break
        if len(keep) < len(leaving):
            problem, search = problem[keep], search[keep]
    return [_result(problems[b], *finished[b], losses[b], paths[b]) for b in range(count)]


def _result(
    problem: Problem, search: _Search, place: int, converged: bool, losses: list[float], path: list[State]
) -> LmResult:
    sigma, (views, _) = float(search.sigma[place]), problem.weight.shape
    length = search.residual.length[place, :views].cpu().numpy()
    usual = 1.0
    if problem.shape is not None and not problem.points_known:
        surprise = float(search.residual.surprise[place])
        usual = robust.shape_weight(surprise, problem.shape.freedom, len(problem.shape.mean))
    return LmResult(
        state=path[-1],
        cost=float(search.cost[place]) / sigma**2,
        sigma_px=sigma,
        inlier=(problem.weight > 0) & (length <= robust.INLIER_SIGMAS * sigma),
        shape_weight=usual,
        converged=converged,
        loss=tuple(losses),
        path=tuple(path),
    )


def _iterate(problem: Problems, search: _Search, config: LmConfig) -> tuple[_Search, Bool[Tensor, "b"]]:
    """One damped step of every scene in the batch, and which scenes are finished."""
    variance, belief = search.sigma.square(), torch.zeros_like(search.sigma)
    if problem.shape is not None:
        size = len(problem.shape.mean)
        belief = variance * robust.shape_weight(search.residual.surprise, problem.shape.freedom, size)
    system = linearise(problem, search.state, search.residual, _weight(search), variance, belief)
    trial = step(system, search.state, search.damping, problem.refine)
    attempt = replace(search, state=trial, residual=residuals(problem, trial))
    cost = _cost(problem, attempt)
    better = cost < search.cost  # false for NaN
    coarse = search.phase == robust.CAUCHY
    gain = robust.gain(search.cost, cost)
    expected = torch.where(better, robust.next_gain(gain, search.gain), gain)
    still = expected <= torch.where(coarse, robust.COARSE, config.tolerance)
    damping = torch.where(better, (search.damping / 10).clamp_min(LEAST_DAMPING), search.damping * 10)
    settled = still | (damping > MOST_DAMPING)
    search = _choose(better, replace(attempt, cost=cost, gain=gain), search)
    return _follow(problem, replace(search, damping=damping.clamp(max=MOST_DAMPING)), settled)


def _follow(problem: Problems, search: _Search, settled: Bool[Tensor, "b"]) -> tuple[_Search, Bool[Tensor, "b"]]:
    """Follow the residuals with the scale of the loss; move settled scenes on (`robust.next_phase`)."""
    phase, length, seen = search.phase, search.residual.length, problem.weight > 0
    shrunk = torch.minimum(search.sigma, _noise(problem, search.residual) * problem.redundancy)
    sigma = torch.where(phase != robust.TRIMMED, shrunk, search.sigma)
    inlier = seen & (length <= robust.INLIER_SIGMAS * sigma[:, None, None])
    squares, found = torch.where(inlier, length.square(), 0.0).sum((1, 2)), inlier.sum((1, 2)).clamp_min(1)
    spread = robust.spread_px(squares, found, problem.redundancy).clamp_min(robust.SIGMA_FLOOR_PX)
    spread = torch.minimum(spread, shrunk)
    again = seen & (length <= robust.INLIER_SIGMAS * spread[:, None, None])
    stands = (again == inlier).all(2).all(1)
    graduated = (phase == robust.CAUCHY) | (phase == robust.TRIMMED)
    loose = spread < robust.LOOSE * sigma  # the scale lags far behind the residuals: on with the graduated phase
    over = ~graduated | (phase == robust.TRIMMED) & ~loose & stands
    rounds = search.rounds + settled
    done = settled & (over | (rounds >= robust.ROUNDS))
    to_spread = settled & graduated & (loose | (phase == robust.TRIMMED))
    following = torch.where(loose, robust.CAUCHY, robust.TRIMMED)
    search = replace(
        search,
        phase=torch.where(settled & graduated, following, phase),
        sigma=torch.where(to_spread, spread, sigma),
        rounds=rounds,
        gain=torch.where(settled, 0.0, search.gain),
    )
    return replace(search, cost=_cost(problem, search)), done


def _choose(chosen: Bool[Tensor, "b"], yes: _Search, no: _Search) -> _Search:
    """``yes`` for the chosen scenes, else ``no``."""
    return yes.each(lambda a, b: torch.where(chosen.view(-1, *[1] * (a.ndim - 1)), a, b), no)


def _noise(problem: Problems, residual: Residuals) -> Float[Tensor, "b"]:
    """`robust.noise` of every scene."""
    length = torch.where(problem.weight > 0, residual.length, torch.nan).flatten(1)
    sigma = length.nanmedian(dim=1).values / robust.RAYLEIGH_MEDIAN
    return torch.where(sigma.isfinite(), sigma.clamp_min(robust.SIGMA_FLOOR_PX), 1.0)


def _by_phase(phase: Int[Tensor, "b"], values: dict[int, Callable[[], Tensor]]) -> Float[Tensor, "b n j"]:
    """What each scene's phase calls for; nothing is computed for a phase that no scene is in."""
    present = [values[p]() for p in sorted({*phase.tolist()})]
    numbers = sorted({*phase.tolist()})
    result = present[0]
    for number, value in zip(numbers[1:], present[1:], strict=True):
        result = torch.where((phase == number)[:, None, None], value, result)
    return result


def _weight(search: _Search) -> Float[Tensor, "b n j"]:
    """IRLS weights."""
    length, sigma = search.residual.length, search.sigma[:, None, None]
    return _by_phase(
        search.phase,
        {
            robust.CAUCHY: lambda: 1.0 / robust.cauchy_term(length, sigma),
            robust.TRIMMED: lambda: (length <= robust.INLIER_SIGMAS * sigma).to(length.dtype),
            robust.HUBER: lambda: robust.huber_weight(length, sigma),
            robust.SQUARES: lambda: torch.ones_like(length),
        },
    )


def _cost(problem: Problems, search: _Search) -> Float[Tensor, "b"]:
    """What is minimised, in squared pixels."""
    length, sigma = search.residual.length, search.sigma[:, None, None]
    cost = _by_phase(
        search.phase,
        {
            robust.CAUCHY: lambda: robust.cauchy_cost(robust.cauchy_term(length, sigma).log(), sigma),
            robust.TRIMMED: lambda: robust.trimmed_cost(length, sigma),
            robust.HUBER: lambda: robust.huber_cost(length, sigma),
            robust.SQUARES: lambda: length.square(),
        },
    ).sum((1, 2))
    if problem.shape is not None:
        freedom, size = problem.shape.freedom, len(problem.shape.mean)
        usual, rest = robust.shape_excess(search.residual.surprise, freedom, size)
        cost = cost + search.sigma.square() * (usual + (freedom + size) * rest.log())
    off = orbit_error(problem, search.state).square().sum(-1)
    return cost + search.sigma.square() * (problem.strength * off).sum(1)
