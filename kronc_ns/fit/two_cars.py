"""Whether views that seem to show one car show two, some views the one and some the other.

Two cars that are alike are met by the points of neither, but by those between them: views of the one are off by d to
one side, views of the other by d to the other. To first order, with the cameras' share taken out of residuals r_i and
of their derivatives B_i by the points, r_i = s_i B_i d + noise, s_i = 1 or -1. The best s is sought from the leading
eigenvector of g_i^T H^-1 g_k, with g_i = B_i^T r_i and H = sum B_i^T B_i + 2 sigma^2 P, P what is known of a car. What
they explain by chance is told by drawing noise. The habits of a detector are explained by this, too, but to a third at
most, and with views side by side on the same side, since habits change slowly along a walk.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from kronc_ns.fit.attempts import Attempt
from kronc_ns.geometry.poses import unit
from kronc_ns.solve.problem import Problem
from kronc_ns.solve.projection import pixel, pixel_by_plane, plane_by_point, plane_by_shift, plane_by_turn

_EXACT = 0.0005
"""Share of the image diagonal: residuals up to this are none of a detector's."""
_FEWEST = 4
"""Views, without which there are no two of either car; and points, without which cameras take up everything."""
_ALIKE, _COMMON = 2.0, 10.0
"""Times what noise would do, by which neighbouring views are off alike, or to opposite sides: less is no other car,
where such views have so many points in common on the mean."""
_HARDLY = 0.05
"""Share explained beyond the usual, below which noise is not drawn to see what is usual."""
_DRAWS, _SEED = 16, 0
"""Draws of noise that tell what two shapes explain by chance."""
_UNLIKELY = 3.0
"""Standard deviations of that, beyond which it is none."""
_SAMPLED = 12  # views that are compared with the nearest one
_ROUNDS = 12  # few are needed
_FLAT = 1e-9  # of the largest singular value: a direction in which the camera does not move the points
_UNKNOWN_M = 1.0  # what two objects may differ by where nothing is known of their shape, in units of the scene


class TwoCars(NamedTuple):
    """What two shapes explain."""

    explained: float
    """Share of the inliers' squared residuals, beyond what two shapes explain of noise; 0 where it may be chance."""
    together: float
    """Share of the views whose nearest view is of the same shape: about half where two cars are mixed."""
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
    nothing = TwoCars(0.0, 1.0, np.zeros(len(attempt.inlier), dtype=bool))
    of_detector = _EXACT * math.hypot(camera.width, camera.height) < sigma_px < math.inf
    if not of_detector or min(len(views), len(points)) < _FEWEST:
        return nothing
    alike, common = _likeness(attempt, views, points)
    if alike < _ALIKE and common >= _COMMON:
        return nothing
    seen = _seen(attempt, views, points)
    split = _Split.of(attempt, points, _derivatives(attempt.state.rotation[views], seen))
    (explained,), (side,) = split.best(split.without_cameras(seen.residual[None]))
    unknown = 3 * len(points)
    measured = 2 * int(np.count_nonzero(seen.root)) - 6 * len(views)
    if explained <= unknown / max(measured, unknown) + _HARDLY:
        return nothing
    drawn = np.random.default_rng(_SEED).normal(scale=sigma_px, size=(_DRAWS, *seen.residual.shape))
    by_chance, _ = split.best(split.as_fitted(np.where(seen.root[..., None] > 0, drawn, 0.0)))
    usual = float(by_chance.mean())
    smaller = side == (1 if 2 * (side > 0).sum() <= len(views) else -1)
    if explained <= usual + _UNLIKELY * float(by_chance.std()) or not smaller.any():
        return nothing
    together = float((smaller == smaller[_nearest(attempt, views, points, np.arange(len(views)))]).mean())
    other = np.zeros(len(attempt.inlier), dtype=bool)
    other[views] = smaller
    return TwoCars((float(explained) - usual) / (1 - usual), together, other)


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


def _likeness(attempt: Attempt, views: Int[np.ndarray, "m"], points: Int[np.ndarray, "k"]) -> tuple[float, float]:
    """How much more the residuals of some views and of their nearest views are alike, up to the sign, than noise is;
    and how many points such views have in common."""
    found, weight = attempt.found, attempt.problem.weight
    some = np.linspace(0, len(views) - 1, min(len(views), _SAMPLED)).astype(int)
    nearest = _nearest(attempt, views, points, some)
    one, other = (np.ix_(views[of], points) for of in (some, nearest))
    both = attempt.inlier[one] & attempt.inlier[other]
    here, there = (
        (np.where(both[..., None], found.off_px[of], 0.0) * np.sqrt(weight[of])[..., None]).reshape(len(some), -1)
        for of in (one, other)
    )
    squares = np.square(here).sum(1) * np.square(there).sum(1)
    alike = np.square((here * there).sum(1)) / np.maximum(squares, np.finfo(float).tiny)
    common = both.sum(1)
    return float((alike * 2 * common).mean()), float(common.mean())


def _nearest(
    attempt: Attempt, views: Int[np.ndarray, "m"], points: Int[np.ndarray, "k"], some: Int[np.ndarray, "s"]
) -> Int[np.ndarray, "s"]:
    """Which other view sees the points from about the direction of each of some views."""
    found = attempt.found
    towards = unit(found.c2w[views][..., 3] - found.points[points].mean(0))
    closeness = towards[some] @ towards.T
    closeness[np.arange(len(some)), some] = -math.inf
    return closeness.argmax(1)


@dataclass(frozen=True)
class _Split:
    """A fit by one shape to first order, and by two; of several residuals (d) at a time."""

    across: Float[np.ndarray, "m r 6"]
    """What each camera can do to its r = 2k residuals, orthonormal."""
    by_point: Float[np.ndarray, "m k 2 3"]
    one: Float[np.ndarray, "p p"]
    """The information on a shape, p = 3k."""
    two: Float[np.ndarray, "p p"]
    """Inverse of Cholesky's factor of that on half the difference of two."""

    @staticmethod
    def of(
        attempt: Attempt,
        points: Int[np.ndarray, "k"],
        derivatives: tuple[Float[np.ndarray, "m k 2 6"], Float[np.ndarray, "m k 2 3"]],
    ) -> "_Split":
        """From the derivatives of the residuals by cameras and by points."""
        by_camera, by_point = derivatives
        count, size = len(by_camera), 3 * len(points)
        across, stretch, _ = np.linalg.svd(by_camera.reshape(count, -1, 6), full_matrices=False)
        across = across * (stretch > _FLAT * stretch[:, :1])[:, None]
        # [k, 3, 2] @ [k, 2, 6] of every view, side by side
        shared = by_point.swapaxes(-1, -2) @ across.reshape(count, -1, 2, 6)
        shared = shared.transpose(1, 2, 0, 3).reshape(size, -1)
        own = np.zeros((len(points), 3, len(points), 3))
        each = np.arange(len(points))
        own[each, :, each] = (by_point.swapaxes(-1, -2) @ by_point).sum(0)
        measured = own.reshape(size, size) - shared @ shared.T
        prior = attempt.noise.sigma_px**2 * _prior(attempt.problem, points)
        two = np.linalg.inv(np.linalg.cholesky(measured + 2 * prior))
        return _Split(across, by_point, measured + prior, two)

    def without_cameras(self, residual: Float[np.ndarray, "d m k 2"]) -> Float[np.ndarray, "d m k 2"]:
        """What cameras cannot take up."""
        rows = residual.reshape(*residual.shape[:2], -1, 1)
        return (rows - self.across @ (self.across.swapaxes(-1, -2) @ rows)).reshape(residual.shape)

    def as_fitted(self, noise: Float[np.ndarray, "d m k 2"]) -> Float[np.ndarray, "d m k 2"]:
        """What is left of noise by a fit with one shape."""
        left = self.without_cameras(noise)
        shape = np.linalg.solve(self.one, self._pulls(left).sum(1).T).T
        moved = self.by_point @ shape.reshape(len(shape), 1, -1, 3, 1)
        return left - self.without_cameras(moved[..., 0])

    def best(self, left: Float[np.ndarray, "d m k 2"]) -> tuple[Float[np.ndarray, "d"], Float[np.ndarray, "d m"]]:
        """The share of the squares that two shapes explain, and which views are of which (1 or -1)."""
        whitened = self._pulls(left) @ self.two.T
        strongest = np.square(whitened).sum(-1).argmax(-1)
        leading = whitened[np.arange(len(left)), strongest]
        for _ in range(_ROUNDS):
            leading = unit(_summed(_along(whitened, leading), whitened))
        side = np.where(_along(whitened, leading) < 0, -1.0, 1.0)
        for _ in range(_ROUNDS):
            side = np.where(_along(whitened, _summed(side, whitened)) < 0, -1.0, 1.0)
        return np.square(_summed(side, whitened)).sum(-1) / np.square(left).sum((1, 2, 3)), side

    def _pulls(self, left: Float[np.ndarray, "d m k 2"]) -> Float[np.ndarray, "d m p"]:
        """Of each view's residuals on the points."""
        return (left[..., None, :] @ self.by_point).reshape(*left.shape[:2], -1)


def _along(rows: Float[np.ndarray, "d m p"], direction: Float[np.ndarray, "d p"]) -> Float[np.ndarray, "d m"]:
    return (rows @ direction[..., None])[..., 0]


def _summed(side: Float[np.ndarray, "d m"], rows: Float[np.ndarray, "d m p"]) -> Float[np.ndarray, "d p"]:
    return (side[:, None] @ rows)[:, 0]


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
    """Inverse covariance of a shape; order 3 * point + axis. That of half the difference of two is twice as much."""
    if problem.shape is None:
        return np.eye(3 * len(points)) / (2 * _UNKNOWN_M**2)
    total = len(problem.shape.mean) // 3
    rows = (points[:, None] + total * np.arange(3)).ravel()
    # points that are not seen may be anywhere: they are left out of the covariance, not of its inverse
    return np.linalg.inv(np.linalg.inv(problem.shape.precision)[np.ix_(rows, rows)])
