"""The solver's equations by the book: residuals in torch, derivatives by autograd, systems dense.

Unknowns in a row: 6 of each camera (turn w and shift t of p -> exp(w) p + t), the points' (x of all, y of all, z of
all; none where they are known), the refined intrinsics of each lens (logarithm of the focal length's factor, then k1).
"""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from kronc_ns.solve.problem import Problem, State


def unknowns(problem: Problem) -> tuple[int, int, int]:
    """How many of the cameras, the points and the intrinsics."""
    views, joints = problem.weight.shape
    return 6 * views, 0 if problem.points_known else 3 * joints, problem.lenses * len(problem.refine)


def nowhere(problem: Problem) -> Tensor:
    """No change of the unknowns."""
    return torch.zeros(sum(unknowns(problem)), dtype=torch.float64)


def after(problem: Problem, state: State, change: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """(rotation, translation, points, log_growth, k1) after a change of the unknowns; the last two of each lens."""
    cameras, points, intrinsics = change.split(unknowns(problem))
    w, t = cameras.view(-1, 6).split(3, dim=1)
    x, y, z, o = *w.unbind(1), torch.zeros_like(w[:, 0])
    turn = torch.matrix_exp(torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=1).view(-1, 3, 3))
    rotation, translation = torch.from_numpy(state.rotation), torch.from_numpy(state.translation)
    world = torch.from_numpy(state.points)
    if not problem.points_known:
        world = world + points.view(3, -1).T
    none = torch.zeros(problem.lenses, dtype=torch.float64)
    by_name = dict(zip(sorted(problem.refine), intrinsics.view(problem.lenses, -1).unbind(1), strict=True))
    return (
        turn @ rotation,
        (turn @ translation[..., None])[..., 0] + t,
        world,
        torch.as_tensor(state.log_growth, dtype=torch.float64) + by_name.get("focal", none),
        torch.as_tensor(state.k1, dtype=torch.float64) + by_name.get("k1", none),
    )


def reprojection(problem: Problem, state: State, change: Tensor | None = None) -> Tensor:
    """Projection minus detection in pixels, [n, j, 2]."""
    change = nowhere(problem) if change is None else change
    rotation, translation, points, log_growth, k1 = after(problem, state, change)
    lens = torch.zeros(len(rotation), dtype=torch.long) if problem.lens is None else torch.from_numpy(problem.lens)
    log_growth, k1 = (of[lens][:, None, None] for of in (log_growth, k1))
    camera = points @ rotation.mT + translation[:, None]
    plane = camera[..., :2] / camera[..., 2:]
    bent = plane * (1 + k1 * plane.square().sum(-1, keepdim=True))
    return bent * log_growth.exp() * torch.tensor(problem.focal) - torch.from_numpy(problem.uv)


def weighted_residuals(
    problem: Problem, state: State, weight: np.ndarray, belief: float, variance: float
) -> Callable[[Tensor], Tensor]:
    """All residuals after a change of the unknowns: of the seen detections, the shape prior, and expected centres.

    Half the sum of their squares is what a step shall lower. ``weight`` [n, j] is the IRLS weights times the
    detections' own, ``belief`` the weight of the shape prior, ``variance`` that of expected centres.
    """

    def function(change: Tensor) -> Tensor:
        root = torch.from_numpy(np.sqrt(weight))[..., None]
        rows = [(root * reprojection(problem, state, change))[torch.from_numpy(weight > 0)].flatten()]
        rotation, translation, points, _, _ = after(problem, state, change)
        if problem.shape is not None and not problem.points_known:
            factor = torch.linalg.cholesky(torch.from_numpy(problem.shape.precision)).T
            rows.append(belief**0.5 * (factor @ (points.T.flatten() - torch.from_numpy(problem.shape.mean))))
        if problem.orbit is not None:
            centre = -(rotation.mT @ translation[..., None])[..., 0]
            strength = variance**0.5 / torch.from_numpy(problem.orbit.sigma)[:, None]
            rows.append((strength * (torch.from_numpy(problem.orbit.centre) - centre)).flatten())
        return torch.cat(rows)

    return function


def jacobian(
    problem: Problem, state: State, weight: np.ndarray, belief: float = 0.0, variance: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Of all residuals by all unknowns, and the residuals."""
    function = weighted_residuals(problem, state, weight, belief, variance)
    return torch.func.jacfwd(function)(nowhere(problem)).numpy(), function(nowhere(problem)).numpy()


def normal_equations(
    problem: Problem, state: State, weight: np.ndarray, belief: float = 0.0, variance: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Newton's matrix and the gradient. (A turn moves a camera's own centre not at all: it stays where it is.)"""
    rows, residual = jacobian(problem, state, weight, belief, variance)
    return rows.T @ rows, rows.T @ residual


def step(
    problem: Problem, state: State, weight: np.ndarray, damping: float, belief: float = 0.0, variance: float = 0.0
) -> State:
    """The state after a step with Marquardt's damping; unknowns that nothing is said of stay."""
    matrix, gradient = normal_equations(problem, state, weight, belief, variance)
    scale = np.where(np.diag(matrix) <= 1e-12, 1.0, np.diag(matrix))
    matrix = matrix + np.diag(scale - np.diag(matrix)) + damping * np.diag(scale)
    return moved_by(problem, state, -np.linalg.solve(matrix, gradient))


def moved_by(problem: Problem, state: State, change: np.ndarray) -> State:
    """The state after a change of the unknowns."""
    rotation, translation, points, log_growth, k1 = after(problem, state, torch.from_numpy(change))
    poses = rotation.numpy(), translation.numpy(), points.numpy()
    if problem.lenses == 1:
        return State(*poses, float(log_growth), float(k1))
    return State(*poses, log_growth.numpy(), k1.numpy())
