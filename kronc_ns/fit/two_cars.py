"""Whether views that seem to show one car show two, some views the one and some the other.

Two cars that are alike are met by the points of neither, but by those between them: views of the one are off by d to
one side, views of the other by d to the other. To first order, with the cameras' share taken out of residuals r_i and
of their derivatives B_i by the points, r_i = s_i B_i d + noise, s_i = 1 or -1. The best s is sought from the leading
eigenvector of g_i^T H^-1 g_k, with g_i = B_i^T r_i and H = sum B_i^T B_i + sigma^2 P, P what is known of the difference
of two cars. The habits of a detector are explained by this, too, but only to a quarter.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from kronc_ns.fit.attempts import Attempt
from kronc_ns.geometry.poses import unit
from kronc_ns.solve.problem import Problem
from kronc_ns.solve.projection import pixel, pixel_by_plane, plane_by_point, plane_by_shift, plane_by_turn

_EXACT = 0.0005
"""Share of the image diagonal: residuals up to this are none of a detector's."""
_FREEDOM = 3
"""Degrees of freedom for each point without which two shapes explain too much by chance."""
_ALIKE = 2.0
"""Times what noise would do, by which neighbouring views are off alike, or to opposite sides: less is no other car."""
_SAMPLED = 12  # views that are compared with the nearest one
_ROUNDS = 20  # few are needed
_FLAT = 1e-9  # of the largest singular value: a direction in which the camera does not move the points
_UNKNOWN_M = 1.0  # what two objects may differ by where nothing is known of their shape, in units of the scene


class TwoCars(NamedTuple):
    """What two shapes explain."""

    explained: float
    """Share of the inliers' squared residuals, beyond what two shapes explain of noise; 0 where there are too few
    detections to tell, or nothing suspect."""
    other: Bool[np.ndarray, "n"]
    """The smaller group of views."""


class _Seen(NamedTuple):
    """Points (k) in views (m); 0 where there is no inlier."""

    plane: tuple[Float[np.ndarray, "m k"], ...]
    """u, v and 1 / z."""
    scale: tuple[Float[np.ndarray, "m 1"], ...]
    """Focal lengths fx, fy and k1."""
    root: Float[np.ndarray, "m k"]
    """Root of each detection's weight."""
    residual: Float[np.ndarray, "m k 2"]
    """Times that."""


def two_cars(attempt: Attempt) -> TwoCars:
    """What two shapes, each of some of the views, explain of the residuals of a fit by one."""
    sigma_px, camera = attempt.noise.sigma_px, attempt.found.scene.camera
    views, points = np.flatnonzero(attempt.inlier.any(1)), np.flatnonzero(attempt.inlier.sum(0) >= 2)
    other = np.zeros(len(attempt.inlier), dtype=bool)
    freedom = 2 * int(attempt.inlier[:, points].sum()) - 6 * len(views) - 3 * len(points)
    of_detector = _EXACT * math.hypot(camera.width, camera.height) < sigma_px < math.inf
    if not of_detector or not len(points) or freedom < _FREEDOM * len(points):
        return TwoCars(0.0, other)
    if _likeness(attempt, views, points) < _ALIKE:
        return TwoCars(0.0, other)
    explained, side = _split(attempt, views, points)
    by_chance = 3 * len(points) / (freedom + 3 * len(points))
    other[views] = side == (1 if 2 * (side > 0).sum() <= len(views) else -1)
    return TwoCars(max(explained - by_chance, 0.0) / (1 - by_chance) if other.any() else 0.0, other)


def _seen(attempt: Attempt, views: Int[np.ndarray, "m"], points: Int[np.ndarray, "k"]) -> _Seen:
    problem, state, inlier = attempt.problem, attempt.state, attempt.inlier
    lens = np.zeros(len(inlier), dtype=int) if problem.lens is None else problem.lens
    growth, k1 = (np.atleast_1d(x)[lens[views]][:, None] for x in (np.exp(state.log_growth), state.k1))
    fx, fy = problem.focal[0] * growth, problem.focal[1] * growth
    at = state.points[points] @ state.rotation[views].swapaxes(-1, -2) + state.translation[views, None]
    chosen = np.ix_(views, points)
    at = np.where(inlier[chosen][..., None], at, 1.0)  # others may lie in the camera's plane
    near = 1 / at[..., 2]
    u, v = at[..., 0] * near, at[..., 1] * near
    root = np.where(inlier[chosen], np.sqrt(problem.weight[chosen]), 0.0)
    residual = (np.stack(pixel(u, v, fx, fy, k1), axis=-1) - problem.uv[chosen]) * root[..., None]
    return _Seen((u, v, near), (fx, fy, k1), root, residual)


def _likeness(attempt: Attempt, views: Int[np.ndarray, "m"], points: Int[np.ndarray, "k"]) -> float:
    """How much more the residuals of some views and of their nearest views are alike, up to the sign, than noise is."""
    found, weight = attempt.found, attempt.problem.weight
    towards = unit(found.c2w[views][..., 3] - found.points[points].mean(0))
    some = np.linspace(0, len(views) - 1, min(len(views), _SAMPLED)).astype(int)
    closeness = towards[some] @ towards.T
    closeness[np.arange(len(some)), some] = -math.inf
    nearest = closeness.argmax(1)
    one, other = (np.ix_(views[of], points) for of in (some, nearest))
    both = attempt.inlier[one] & attempt.inlier[other]
    here, there = (
        (np.where(both[..., None], found.off_px[of], 0.0) * np.sqrt(weight[of])[..., None]).reshape(len(some), -1)
        for of in (one, other)
    )
    squares = np.square(here).sum(1) * np.square(there).sum(1)
    alike = np.square((here * there).sum(1)) / np.maximum(squares, np.finfo(float).tiny)
    return float((alike * 2 * both.sum(1)).mean())


def _split(
    attempt: Attempt, views: Int[np.ndarray, "m"], points: Int[np.ndarray, "k"]
) -> tuple[float, Float[np.ndarray, "m"]]:
    """The share of the squared residuals that two shapes explain, and which views are of which (1 or -1)."""
    seen = _seen(attempt, views, points)
    by_camera, by_point = _derivatives(attempt.state.rotation[views], seen)
    count, size = len(views), 3 * len(points)
    across, stretch, _ = np.linalg.svd(by_camera.reshape(count, -1, 6), full_matrices=False)
    across = across * (stretch > _FLAT * stretch[:, :1])[:, None]
    residual = seen.residual.reshape(count, -1)
    residual = residual - (across @ (across.swapaxes(-1, -2) @ residual[..., None]))[..., 0]
    gradient = np.einsum("mkab,mka->mkb", by_point, residual.reshape(count, -1, 2)).reshape(count, size)
    shared = np.einsum("mkab,mkac->kbmc", by_point, across.reshape(count, -1, 2, 6)).reshape(size, -1)
    own = np.zeros((len(points), 3, len(points), 3))
    own[np.arange(len(points)), :, np.arange(len(points))] = np.einsum("mkab,mkac->kbc", by_point, by_point)
    information = (
        own.reshape(size, size) - shared @ shared.T + attempt.noise.sigma_px**2 * _prior(attempt.problem, points)
    )
    whitened = np.linalg.solve(np.linalg.cholesky(information), gradient.T)
    gram = whitened.T @ whitened
    side = np.where(np.linalg.eigh(gram)[1][:, -1] < 0, -1.0, 1.0)
    for _ in range(_ROUNDS):
        better = np.where(gram @ side < 0, -1.0, 1.0)
        if (better == side).all():
            break
        side = better
    return float(np.square(whitened @ side).sum() / np.square(residual).sum()), side


def _derivatives(
    rotation: Float[np.ndarray, "m 3 3"], seen: _Seen
) -> tuple[Float[np.ndarray, "m k 2 6"], Float[np.ndarray, "m k 2 3"]]:
    """Of the residuals by cameras (turn, shift in their own axes) and by points."""
    (u, v, near), (fx, fy, k1) = seen.plane, seen.scale
    by_plane = np.stack(pixel_by_plane(u, v, fx, fy, k1), axis=-1) * seen.root[..., None]
    shift = np.zeros((*u.shape, 2, 3))
    shift[..., 0, 0], shift[..., 0, 2], shift[..., 1, 1], shift[..., 1, 2] = plane_by_shift(u, v, near)
    turn = np.stack(np.broadcast_arrays(*plane_by_turn(u, v)), axis=-1).reshape(shift.shape)
    point = [np.stack(plane_by_point(u, v, near, *rotation[..., axis].T[..., None]), axis=-1) for axis in range(3)]
    by_plane = by_plane.reshape(*u.shape, 2, 2)
    return by_plane @ np.concatenate([turn, shift], axis=-1), by_plane @ np.stack(point, axis=-1)


def _prior(problem: Problem, points: Int[np.ndarray, "k"]) -> Float[np.ndarray, "p p"]:
    """Inverse covariance of half the difference of two shapes, which is half that of one; order 3 * point + axis."""
    if problem.shape is None:
        return np.eye(3 * len(points)) / _UNKNOWN_M**2
    total = len(problem.shape.mean) // 3
    rows = (points[:, None] + total * np.arange(3)).ravel()
    # points that are not seen may be anywhere: they are left out of the covariance, not of its inverse
    return 2 * np.linalg.inv(np.linalg.inv(problem.shape.precision)[np.ix_(rows, rows)])
