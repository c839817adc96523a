"""Bundle adjustment of many points that few cameras see each: the points are eliminated.

The sightings of a point stand in a row: those of point p are ``first[p]:first[p + 1]``. The unknowns of the reduced
system are six of each camera, as in `schur` (turn, then shift in its own axes), and the K refined intrinsics of each
lens. Minimised is ``sum weight * scale^2 log(1 + |r|^2 / scale^2)`` over the sightings, Cauchy's loss with a scale of
their own. Nothing fixes the gauge: damping keeps its seven directions still. Derivation: docs/solver.md, section 5.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from kronc_ns.geometry.rotations import so3_exp
from kronc_ns.solve.elimination import Reduced, errors, follow, reduce
from kronc_ns.solve.sightings import Sightings, Unknowns

_START_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-3, 1e-9, 1e6


@dataclass(frozen=True)
class Bundled:
    """Where an adjustment ended."""

    now: Unknowns
    cost: float


def adjust(data: Sightings, start: Unknowns, steps: int, tolerance: float) -> Bundled:
    """Levenberg-Marquardt until a step gains less than ``tolerance`` of the cost, or ``steps`` are done."""
    now, damping = start, _START_DAMPING
    cost = total_cost(data, now)
    room = Reduced.of(data)
    for _ in range(steps):
        reduce(data, now, damping, False, room)
        change = _solved(room)
        if change is None:
            damping = min(10 * damping, _MOST_DAMPING)
            continue
        trial = _moved(data, now, room, change)
        proposed = total_cost(data, trial)
        settled = abs(cost - proposed) <= tolerance * cost
        if proposed < cost:  # false for NaN
            now, cost = trial, proposed
            damping = max(damping / 10, _LEAST_DAMPING)
        else:
            damping *= 10
        if settled or damping > _MOST_DAMPING:
            break
    return Bundled(now, cost)


def error_px(data: Sightings, now: Unknowns) -> Float[np.ndarray, "s"]:
    """Length of each sighting's reprojection error; `BEHIND_PX` behind the camera."""
    error = np.empty((len(data.camera), 2))
    errors(data, now, error)
    return np.hypot(error[:, 0], error[:, 1])


def total_cost(data: Sightings, now: Unknowns) -> float:
    """What is minimised."""
    square = error_px(data, now) ** 2 / data.scale**2
    return float((data.weight * data.scale**2 * np.log1p(square)).sum())


def normal_matrix(data: Sightings, now: Unknowns) -> Float[np.ndarray, "f f"]:
    """The reduced system without damping; its seven gauge directions are (nearly) zero."""
    room = Reduced.of(data)
    reduce(data, now, 0.0, False, room)
    return room.matrix[0]


def _solved(room: Reduced) -> Float[np.ndarray, "f"] | None:
    """The step of the reduced unknowns."""
    try:
        change = np.linalg.solve(room.matrix[0], -room.gradient[0])
    except np.linalg.LinAlgError:
        return None
    return change if np.isfinite(change).all() else None


def _moved(data: Sightings, now: Unknowns, room: Reduced, change: Float[np.ndarray, "f"]) -> Unknowns:
    """The unknowns one step ahead."""
    views = len(now.rotation)
    twist = change[: 6 * views].reshape(views, 6)
    turn = so3_exp(twist[:, :3])
    points = now.points.copy()
    follow(data, room, change, points)
    intrinsics = now.intrinsics.copy()
    of_lens = change[6 * views :].reshape(len(intrinsics), -1)
    for column, (unknown, refined) in enumerate(((0, data.with_focal), (1, data.with_k1))):
        if refined:
            intrinsics[:, unknown] += of_lens[:, column if data.with_focal else 0]
    return Unknowns(turn @ now.rotation, (turn @ now.translation[..., None])[..., 0] + twist[:, 3:], points, intrinsics)
