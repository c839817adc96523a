"""How well each camera is known relative to the points: covariance of a bundle adjustment without a fixed gauge.

Relative means: no common shift, turn or growth of the points that are seen counts (inner constraints; docs/solver.md),
so what remains is the camera's error relative to the object. Any generalised inverse will do, since the gauge is
projected out; without a prior a stiff spring makes the matrix regular. A camera follows the points by -W^T Y, and the
gauge's part of their error, motion G^T, is taken off it: with Z = Y L^-T and G = L^-1 gauge its covariance is
W^T W + (W^T Z + motion G^T) (W^T Z + motion G^T)^T.
"""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from kronc_ns.geometry.rotations import skew
from kronc_ns.solve import records, schur
from kronc_ns.solve.compiled import compiled
from kronc_ns.solve.linear import dot, factor, forward
from kronc_ns.solve.problem import Problem, State

_TRACE = 1e-9  # of the gauge's directions, where points are too few to tell them apart
_DAMPING = 1e-9  # keeps the gauge's zero pivots positive


def camera_covariance(
    problem: Problem, state: State, inlier: Bool[np.ndarray, "n j"], sigma_px: float, shape_weight: float
) -> Float[np.ndarray, "n 6 6"]:
    """Covariance of each camera's (rotation vector in radians, centre) in its own axes, the points held still.

    Cameras without detections get what the system knows of them: nothing (a huge covariance).
    """
    chosen = Problem(
        problem.uv,
        np.where(inlier, problem.weight, 0.0),
        problem.focal,
        problem.shape,
        refine=problem.refine,
        lens=problem.lens,
    )
    data = records.measured(chosen)
    now, work = records.estimate(data, state), records.system(data, *chosen.weight.shape)
    covariance = np.empty((len(problem.weight), 6, 6))
    schur.evaluate(data, now)
    work.weight[:] = data.own
    schur.reduce_system(data, now, work, _DAMPING, sigma_px**2 * shape_weight, sigma_px**2)
    matrix = work.matrix
    gauge, inverse, mean = _gauge(now.points, np.flatnonzero((chosen.weight > 0).any(0)), len(matrix))
    if problem.shape is None:  # a prior makes it regular, and would be made more of
        matrix += np.trace(matrix) / len(matrix) * (gauge.T @ gauge)
    if not factor(matrix):
        covariance[:] = np.nan
        return covariance
    forward(matrix, gauge)
    _cameras(data, now, work, gauge, gauge @ gauge.T, inverse, mean, sigma_px**2, covariance)
    return covariance


@compiled
def _cameras(
    data: Any, now: Any, work: Any, gauge: Any, shared: Any, inverse: Any, mean: Any, variance: float, out: Any
) -> None:
    """The covariances of all cameras."""
    size, joints = len(work.matrix), len(now.points)
    intrinsics = int(data.with_focal) + int(data.with_k1)
    points = 0 if data.points_known else 3 * joints
    z = np.empty((6, size))
    for n in range(len(out)):
        y = schur.coupling(data, work, n)
        first, count = data.first[n], data.first[n + 1] - data.first[n]
        for p in range(6):
            for i in range(size):
                z[p, i] = 0.0
            for c in range(3 if points else 0):
                for k in range(count):
                    z[p, c * joints + data.joint[first + k]] = y[p, c * count + k]
            for s in range(intrinsics):
                z[p, points + intrinsics * data.lens[n] + s] = y[p, len(y[p]) - intrinsics + s]
        forward(work.matrix, z)
        r, t, w = now.rotation[n], now.translation[n], work.whitener[n]
        _camera_covariance(r, t, mean, w, z, gauge, shared, inverse, variance, out[n])


def _gauge(
    points: Float[np.ndarray, "j 3"], seen: Int[np.ndarray, "s"], size: int
) -> tuple[Float[np.ndarray, "12 p"], Float[np.ndarray, "7 7"], Float[np.ndarray, "3"]]:
    """Orthonormal directions in which shift, turn and growth of the world move the points that are seen.

    (The last five are 0, for `forward`.) Also the matrix that makes them of the moves, and the points' mean.
    """
    mean = points[seen].mean(0) if len(seen) else np.zeros(3)
    arm = points[seen] - mean
    turned = -skew(arm)  # [point, component, axis of the turn]
    moves = np.zeros((12, size))
    for c in range(3):
        at = c * len(points) + seen
        moves[c, at] = 1.0
        moves[3:6, at] = turned[:, c].T
        moves[6, at] = arm[:, c]
    square = moves[:7] @ moves[:7].T + _TRACE * np.eye(7)
    inverse = np.linalg.inv(np.linalg.cholesky(square))
    moves[:7] = inverse @ moves[:7]
    return moves, inverse, mean


@compiled
def _camera_covariance(
    r: Any, t: Any, mean: Any, whitener: Any, z: Any, gauge: Any, shared: Any, inverse: Any, variance: Any,
    out: Any,
) -> None:  # fmt: skip
    """One camera's, with what moving the world does to it (motion): when it shifts by s, turns by w and grows by g
    about the mean m, then with a = R m + t the camera turns by -R w and moves by g a - [a] R w - R s in its own axes.
    """
    size = gauge.shape[1]
    moved, outer, inner, half = np.zeros((6, 7)), np.zeros((6, 13)), np.zeros((13, 13)), np.empty((6, 13))
    at = np.empty(3)
    for p in range(3):
        at[p] = r[p, 0] * mean[0] + r[p, 1] * mean[1] + r[p, 2] * mean[2] + t[p]
    for p in range(3):
        a, b = (p + 1) % 3, (p + 2) % 3
        for c in range(3):
            moved[p, 3 + c] = -r[p, c]
            moved[3 + p, c] = -r[p, c]
            moved[3 + p, 3 + c] = at[b] * r[a, c] - at[a] * r[b, c]
        moved[3 + p, 6] = at[p]
    for p in range(6):
        for q in range(6):
            outer[p, q] = whitener[q, p]
            inner[p, q] = dot(z[p], z[q], size)
        inner[p, p] += 1.0
        for q in range(7):
            inner[p, 6 + q] = inner[6 + q, p] = dot(z[p], gauge[q], size)
            for k in range(q + 1):
                outer[p, 6 + q] += moved[p, k] * inverse[q, k]
    for p in range(7):
        for q in range(7):
            inner[6 + p, 6 + q] = shared[p, q]
    for p in range(6):
        for q in range(13):
            half[p, q] = dot(outer[p], inner[q], 13)
    for p in range(6):
        for q in range(6):
            # the centre moves by -v (in camera axes) when the translation grows by v
            sign = -1.0 if (p < 3) != (q < 3) else 1.0
            out[p, q] = sign * variance * dot(half[p], outer[q], 13)
