"""How well each camera is known relative to the points: covariance of a bundle adjustment without a fixed gauge."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from kronc_ns.geometry.rotations import skew
from kronc_ns.solve import lm_cpu
from kronc_ns.solve.bundle import eliminate_cameras, linearise, residuals
from kronc_ns.solve.problem import Problem, ShapePrior, State, array
from kronc_ns.solve.threads import aside

_TRACE = 1e-9
_DAMPING = 1e-9  # keeps the gauge's zero pivots positive


def camera_covariance(
    problem: Problem,
    state: State,
    inlier: Bool[Tensor, "b n j"],
    sigma_px: Float[Tensor, "b"],
    shape_weight: Float[Tensor, "b"],
) -> Float[Tensor, "b n 6 6"]:
    """Covariance of each camera's (rotation vector in radians, centre) in its own axes, the points held still.

    Still means: no common shift, turn or growth of the points that are seen (inner constraints; docs/solver.md), so
    what remains is the camera's error relative to the object. Cameras without detections get what the system knows of
    them: nothing (a huge covariance).
    """
    weight = torch.where(inlier, problem.weight, 0.0)
    compute = _compiled if problem.plain else _dense
    return compute(problem, state, weight, sigma_px.square(), shape_weight)


def _compiled(
    problem: Problem, state: State, weight: Tensor, variance: Tensor, shape_weight: Tensor
) -> Float[Tensor, "b n 6 6"]:
    covariance = weight.new_empty(*weight.shape[:2], 6, 6)
    shape = problem.shape or ShapePrior.nothing(weight)
    with aside():
        lm_cpu.camera_covariances(
            *(array(state.rotation), array(state.translation), array(state.points)),
            *(array(problem.uv), array(weight), array(problem.focal), _DAMPING),
            *(array(variance), array(variance * shape_weight), array(shape.precision), _TRACE),
            covariance.numpy(),
        )
    return covariance


def _dense(
    problem: Problem, state: State, weight: Tensor, variance: Tensor, shape_weight: Tensor
) -> Float[Tensor, "b n 6 6"]:
    b, n, _ = weight.shape
    seen = (weight > 0).any(1)
    chosen = (weight > 0).to(weight.dtype)
    system = linearise(problem, state, residuals(problem, state), chosen, variance, shape_weight)
    reduced = eliminate_cameras(system, torch.full_like(variance, _DAMPING))
    size = reduced.rhs.shape[1]
    gauge, motion = _gauge(state, seen, size)
    # any generalised inverse will do, since the gauge is projected out below; a stiff spring makes the matrix regular
    stiffness = reduced.matrix.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None]
    matrix = reduced.matrix + stiffness * (gauge @ gauge.transpose(1, 2))
    factor = torch.linalg.cholesky_ex(matrix).L
    # A camera follows the points by -W^T Y, and the gauge's part of their error, motion gauge^T, is taken off it. With
    # Z = Y L^-T and G = L^-1 gauge its covariance is W^T W + (W^T Z + motion G^T) (W^T Z + motion G^T)^T.
    z = torch.linalg.solve_triangular(factor.mT, reduced.whitened[..., :size], upper=True, left=False)
    g = torch.linalg.solve_triangular(factor, gauge, upper=False)
    mixed, z = (z @ g).view(b, n, 6, 7), z.view(b, n, 6, size)
    own = z @ z.mT + torch.eye(6, dtype=z.dtype, device=z.device)
    shared = (g.mT @ g)[:, None].expand(b, n, 7, 7)
    inner = torch.cat([torch.cat([own, mixed], -1), torch.cat([mixed.mT, shared], -1)], -2)
    outer = torch.cat([reduced.whitener.mT, motion], -1)
    covariance = (outer @ inner @ outer.mT) * variance[:, None, None, None]
    # the centre moves by -v (in camera axes) when the translation grows by v
    sign = covariance.new_tensor([1.0, 1.0, 1.0, -1.0, -1.0, -1.0])
    return covariance * sign[:, None] * sign


def _gauge(
    state: State, seen: Bool[Tensor, "b j"], size: int
) -> tuple[Float[Tensor, "b p 7"], Float[Tensor, "b n 6 7"]]:
    """Orthonormal directions in which shift, turn and growth move the seen points, and what each does to a camera."""
    b, j = seen.shape
    dtype, identity = state.points.dtype, torch.eye(3, dtype=state.points.dtype, device=state.points.device)
    weight = seen.to(dtype)[..., None]
    mean = (state.points * weight).sum(1, keepdim=True) / weight.sum(1, keepdim=True).clamp_min(1)
    arm = (state.points - mean) * weight
    shift = identity * weight[..., None]
    turn = -skew(arm)
    moves = torch.cat([shift, turn, arm[..., None]], dim=-1)  # [b, j, 3, 7]
    flat = torch.zeros(b, size, 7, dtype=dtype, device=state.points.device)
    flat[:, : 3 * j] = moves.transpose(1, 2).flatten(1, 2)
    # What leaves all images as they are when the world shifts by s, turns by w and grows by g about the mean m:
    # with a = R m + t the camera turns by -R w and moves by g a - [a] R w - R s, all in camera axes.
    at = state.rotation @ mean[..., None] + state.translation[..., None]
    turned = -state.rotation
    moved = torch.cat(
        [
            torch.cat([torch.zeros_like(turned), turned, torch.zeros_like(at)], dim=-1),
            torch.cat([-state.rotation, -skew(at[..., 0]) @ state.rotation, at], dim=-1),
        ],
        dim=-2,
    )
    # orthonormal: flat upper^-1, with flat^T flat = upper^T upper; a trace of the identity where points are too few
    square = flat.mT @ flat
    square.diagonal(dim1=-2, dim2=-1).add_(_TRACE)
    inverse = torch.linalg.inv(torch.linalg.cholesky(square, upper=True))
    return flat @ inverse, moved @ inverse[:, None]
