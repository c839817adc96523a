"""Bundle adjustment with the cameras eliminated: residuals, normal equations and covariance of a batch of scenes.

A camera moves as p -> exp(w) p + v in its own axes, a point as X -> X + d. Only the system of the point coordinates
(and shared intrinsics) is factorised, 3J + K unknowns, so the cost grows linearly with the views. Nothing fixes the
gauge. Derivation: docs/solver.md.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from kronc_ns.geometry.rotations import so3_exp
from kronc_ns.solve.lm_cpu import BEHIND_PX, NEAR, TINY
from kronc_ns.solve.problem import OrbitPrior, Problem, Residuals, State, focal_of


def residuals(problem: Problem, state: State) -> Residuals:
    """Reproject all points."""
    plane, inverse_z, error, norm = _reproject(problem, state)
    if problem.shape is None or problem.points_known:
        nothing = norm.new_zeros(len(norm))
        return Residuals(plane, inverse_z, error, norm, nothing, nothing[:, None])
    deviation = state.points.transpose(1, 2).flatten(1) - problem.shape.mean
    pull = deviation @ problem.shape.precision
    return Residuals(plane, inverse_z, error, norm, (pull * deviation).sum(1), pull)


def _reproject(problem: Problem, state: State) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    camera = torch.matmul(state.rotation, state.points.transpose(-1, -2)[:, None]) + state.translation[..., None]
    z = camera[:, :, 2:]
    behind = z < NEAR
    inverse_z = z.clamp_min(NEAR).reciprocal()
    plane = camera[:, :, :2] * inverse_z
    image = plane
    if "k1" in problem.refine:
        k1 = state.intrinsics[:, problem.refine.index("k1"), None, None, None]
        image = plane * (1 + k1 * plane.square().sum(2, keepdim=True))
    seen = problem.weight > 0
    error = torch.addcmul(-problem.uv, image, focal_of(problem, state)[:, None, :, None])
    error.masked_fill_(behind | ~seen[:, :, None], 0.0)
    norm = error.square().sum(2).mul_(problem.weight).sqrt_()
    norm.masked_fill_(behind[:, :, 0] & seen, BEHIND_PX)
    return plane, inverse_z, error, norm


@dataclass(frozen=True)
class Linearisation:
    """Normal equations of a batch, the cameras' blocks apart from the points' (and intrinsics')."""

    camera: Float[Tensor, "b n 6 6"]
    coupling: Float[Tensor, "b n 6 q"]
    """Cameras against the p = 3J + K other unknowns; the last of the q = p + 1 columns is the cameras' gradient."""
    point: Float[Tensor, "b p p"]
    point_gradient: Float[Tensor, "b p"]


def linearise(
    problem: Problem,
    state: State,
    residual: Residuals,
    weight: Float[Tensor, "b n j"],
    variance: Float[Tensor, "b"],
    shape_weight: Float[Tensor, "b"],
) -> Linearisation:
    """Gauss-Newton normal equations with IRLS weights (in addition to the detections' own)."""
    b, n, _, j = residual.plane.shape
    focal = focal_of(problem, state)[:, None, :, None]
    root = (weight * problem.weight).sqrt()[:, :, None]
    scale = root * focal  # [b, n, 2, j]
    # a point n = (x, y, 1) z of the camera moves by w x n z + v: E holds -[n]x and 1/z, for either axis of the image
    # the rows against (w, v) are E_0 - x E_2 and E_1 - y E_2; A[b, n, 6, 2, j] is scaled to pixels
    x, y = residual.plane.unbind(2)
    e = x.new_zeros(b, n, 6, 3, j)
    e[:, :, 1, 0], e[:, :, 0, 1] = 1.0, -1.0
    torch.neg(y, out=e[:, :, 2, 0])
    e[:, :, 2, 1] = x
    e[:, :, 0, 2] = y
    torch.neg(x, out=e[:, :, 1, 2])
    e[:, :, 3:].diagonal(dim1=2, dim2=3).copy_(residual.inverse_z.transpose(2, 3))
    a = torch.mul(e[:, :, :, 2:], residual.plane[:, :, None])
    torch.sub(e[:, :, :, :2], a, out=a)
    a.mul_(scale[:, :, None])
    error = root * residual.error
    flat = a.view(b, n, 6, 2 * j)
    camera = flat @ flat.transpose(-1, -2)
    camera_gradient = flat @ error.reshape(b, n, 2 * j, 1)
    if problem.orbit is not None:
        _add_orbit(problem.orbit, state, variance, camera, camera_gradient[..., 0])
    _fill_diagonal(camera)
    if problem.points_known:
        return Linearisation(camera, camera_gradient, x.new_zeros(b, 0, 0), x.new_zeros(b, 0))

    k = len(problem.refine)
    size = 3 * j + k
    # the same rows against the points: B[b, n, 3, 2, j]
    turn = state.rotation
    rows = x.new_empty(b, n, 3, 2, j)
    torch.mul(residual.plane[:, :, None], turn[:, :, 2, :, None, None], out=rows)
    rows.neg_().add_(turn[:, :, :2].transpose(2, 3)[..., None]).mul_((scale * residual.inverse_z)[:, :, None])
    coupling = x.new_empty(b, n, 6, size + 1)
    coupling[..., size:] = camera_gradient
    mixed = coupling[..., : 3 * j].unflatten(-1, (3, j))
    torch.mul(a[:, :, :, None, 0], rows[:, :, None, :, 0], out=mixed)
    mixed.addcmul_(a[:, :, :, None, 1], rows[:, :, None, :, 1])
    by_point = rows.permute(0, 4, 2, 1, 3).reshape(b, j, 3, 2 * n)
    error_by_point = error.permute(0, 3, 1, 2).reshape(b, j, 2 * n, 1)
    point = x.new_zeros(b, size, size)
    blocks = point[:, : 3 * j, : 3 * j].unflatten(2, (3, j)).unflatten(1, (3, j)).diagonal(dim1=2, dim2=4)
    blocks.copy_((by_point @ by_point.transpose(-1, -2)).permute(0, 2, 3, 1))
    gradient = x.new_empty(b, size)
    gradient[:, : 3 * j] = (by_point @ error_by_point)[..., 0].transpose(1, 2).flatten(1)
    if k:
        columns = _intrinsic_columns(problem, residual.plane, scale)  # [b, n, k, 2, j]
        flat_columns = columns.flatten(3)
        coupling[..., 3 * j : size] = flat @ flat_columns.transpose(-1, -2)
        by_column = columns.permute(0, 4, 2, 1, 3).reshape(b, j, k, 2 * n)
        cross = (by_point @ by_column.transpose(-1, -2)).transpose(1, 2).reshape(b, 3 * j, k)
        point[:, : 3 * j, 3 * j :] = cross
        point[:, 3 * j :, : 3 * j] = cross.transpose(1, 2)
        point[:, 3 * j :, 3 * j :] = (by_column @ by_column.transpose(-1, -2)).sum(1)
        gradient[:, 3 * j :] = (by_column @ error_by_point)[..., 0].sum(1)
    _add_shape(problem, residual, variance * shape_weight, point, gradient)
    _fill_diagonal(point)
    return Linearisation(camera, coupling, point, gradient)


def _add_shape(problem: Problem, residual: Residuals, strength: Tensor, point: Tensor, gradient: Tensor) -> None:
    if problem.shape is not None:
        size = len(problem.shape.mean)
        point[:, :size, :size].addcmul_(strength[:, None, None].expand(len(point), size, 1), problem.shape.precision)
        gradient[:, :size].addcmul_(strength[:, None], residual.pull)


def _add_orbit(orbit: OrbitPrior, state: State, variance: Tensor, camera: Tensor, camera_gradient: Tensor) -> None:
    strength = variance[:, None] / orbit.sigma.square()
    camera[:, :, 3:, 3:].diagonal(dim1=2, dim2=3).add_(strength[..., None])
    camera_gradient[:, :, 3:].addcmul_(strength[..., None], orbit_error(orbit, state))


def orbit_error(orbit: OrbitPrior, state: State) -> Float[Tensor, "b n 3"]:
    """Expected minus present camera centre, in camera axes (it grows with the translation)."""
    return state.translation + (state.rotation @ orbit.centre[..., None])[..., 0]


def _intrinsic_columns(problem: Problem, plane: Tensor, scale: Tensor) -> Float[Tensor, "b n k 2 j"]:
    """Derivatives of the projection by the refined intrinsics, about k1 = 0."""
    along = scale * plane
    columns = {"focal": along, "k1": along * plane.square().sum(2, keepdim=True)}
    return torch.stack([columns[name] for name in problem.refine], dim=2)


@dataclass(frozen=True)
class Reduced:
    """The system left when the cameras are eliminated."""

    whitener: Float[Tensor, "b n 6 6"]
    """Inverse Cholesky factors of the cameras' blocks."""
    whitened: Float[Tensor, "b c q"]
    """The c = 6N rows of the cameras times ``whitener``; the last column is their gradient."""
    matrix: Float[Tensor, "b p p"]
    """Symmetric; only the lower triangle is sure to be there."""
    rhs: Float[Tensor, "b p"]


def eliminate_cameras(system: Linearisation, damping: Float[Tensor, "b"]) -> Reduced:
    """Schur complement of the cameras, with Marquardt's damping on all unknowns."""
    b, n = system.camera.shape[:2]
    growth = 1 + damping[:, None]
    camera = system.camera.clone()
    camera.diagonal(dim1=-2, dim2=-1).mul_(growth[:, None])
    factor = torch.linalg.cholesky_ex(camera).L
    whitener = torch.linalg.solve_triangular(factor, torch.eye(6).to(factor), upper=False)
    whitened = whitener @ system.coupling
    size = system.point.shape[-1]
    tall = whitened.view(b, 6 * n, size + 1)
    point = system.point.clone()
    point.diagonal(dim1=-2, dim2=-1).mul_(growth)
    product = tall[..., :size].transpose(1, 2) @ tall
    matrix = point.sub_(product[..., :size])
    return Reduced(whitener, tall, matrix, product[..., size] - system.point_gradient)


def _fill_diagonal(matrix: Tensor) -> None:
    """Keep the diagonal off zero (an unseen point, an empty view): its unknowns then stay where they are."""
    diagonal = matrix.diagonal(dim1=-2, dim2=-1)
    diagonal.masked_fill_(diagonal <= TINY, 1.0)


@dataclass(frozen=True)
class Step:
    """A proposed change of the unknowns."""

    camera: Float[Tensor, "b n 6"]
    points: Float[Tensor, "b j 3"]
    intrinsics: Float[Tensor, "b k"]


def solve_step(reduced: Reduced, joints: int) -> Step:
    """Solve for the points, then each camera."""
    b, size = reduced.rhs.shape
    factor, trouble = torch.linalg.cholesky_ex(reduced.matrix)
    change = torch.cholesky_solve(reduced.rhs[..., None], factor)[..., 0] if size else reduced.rhs
    change = torch.where((trouble == 0)[:, None], change, torch.nan)
    one = torch.cat([change, change.new_ones(b, 1)], dim=1)[..., None]
    back = (reduced.whitened @ one).view(b, -1, 6, 1)
    camera = -(reduced.whitener.mT @ back)[..., 0]
    points = change[:, : 3 * joints].view(b, 3, -1).transpose(1, 2) if size else change.new_zeros(b, joints, 3)
    return Step(camera, points, change[:, 3 * joints :])


def move(state: State, step: Step) -> State:
    """The state after a step."""
    turn = so3_exp(step.camera[..., :3])
    return State(
        rotation=turn @ state.rotation,
        translation=(turn @ state.translation[..., None])[..., 0] + step.camera[..., 3:],
        points=state.points + step.points,
        intrinsics=state.intrinsics + step.intrinsics,
    )
