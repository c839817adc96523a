"""Where single views stand around known points, without any initial pose: all views, all hypotheses at once.

Directions all around (and camera rolls) are tried on the object-space error, which is quadratic in the rotation once
the translation is eliminated (Schweighofer and Pinz 2008; SQPnP, Terzakis and Lourakis 2020), so a hypothesis costs
81 products whatever the number of points. The best few of each view are refined by robust least squares, in rounds that
fewer and fewer go through; the winner explains most detections by points that face the camera.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from kronc_ns.geometry.poses import look_at, make_pose, unit
from kronc_ns.geometry.rotations import rotation_angle_deg, so3_exp
from kronc_ns.solve.compiled import compiled
from kronc_ns.solve.linear import dot, exponential, inverse_factor
from kronc_ns.solve.projection import BEHIND_PX, NEAR, pixel, pixel_by_plane, plane_by_shift, plane_by_turn
from kronc_ns.solve.robust import CAUCHY, cauchy_term, cost, noise
from kronc_ns.solve.threads import in_parts

_AZIMUTHS = 24
_ELEVATIONS_DEG = (-5.0, 15.0, 35.0, 60.0)
_ROLLS_DEG = (0.0, 90.0, 180.0, 270.0)
_ROUNDS = ((4, 4), (2, 5), (1, 8))
"""How many guesses of a view go through each round of refinement, and the steps of the round."""
_RIVALS = 6
"""Guesses of a view that are refined to find the second best."""
_BEHIND = 1.3
"""A view whose rival leaves so many times less unexplained after the first round is given up."""
_START_DAMPING = 1e-3
_PARTS, _MANY = 2, 64  # guesses from which on they are refined in parts, one for each core
_SAMPLE, _SAMPLES = 4, 1000  # points OpenCV draws at a time, and how often
AWAY = -0.25
"""A point whose normal makes a larger angle with its ray (cosine below this) cannot be seen."""


@dataclass(frozen=True)
class Views:
    """M views of J points, each by itself."""

    uv: Float[np.ndarray, "m j 2"]
    """Undistorted pixels less the principal point."""
    weight: Float[np.ndarray, "m j"]
    points: Float[np.ndarray, "j 3"]
    """Z up for a sensible start; NaN where unknown."""
    label: Int[np.ndarray, "m j"]
    """Which of the points each detection is of."""
    focal: tuple[float, float]
    tolerance_px: Float[np.ndarray, "m"]
    """What a good detection may be off, the points' own uncertainty included."""
    normals: Float[np.ndarray, "j 3"]
    """Outward normals of the surface at the points; zero where unknown."""


@dataclass(frozen=True)
class Located:
    """Best pose of each view."""

    w2c: Float[np.ndarray, "m 3 4"]
    cost: Float[np.ndarray, "m"]
    """Mean robust cost of a detection, 0 (perfect) to 1 (behind the camera, on the far side, or far off)."""


def locate(views: Views, exact: bool = False, rival: Int[np.ndarray, "m"] | None = None) -> Located:
    """Pose of each of M views of known points; at least four of these should be seen.

    Where the points are ``exact`` (solved, not guessed), consensus of small samples is tried, too: it stands more
    outliers. ``rival`` is the view that a view competes with: it is given up where that one is clearly ahead.
    """
    number, rows = len(views.uv), _rows(views)
    free = np.full(number, np.inf)
    known = views.tolerance_px / 3 if exact else free  # noise that outliers do not make believe otherwise
    (guesses, steps), *later = _ROUNDS
    view, w2c = np.repeat(np.arange(number), guesses), _best_guesses(views, guesses).reshape(-1, 3, 4)
    w2c, unexplained = _refined(rows, view, w2c, free, steps)
    for kept, steps in later:
        chosen = _ahead(view, unexplained, kept, rival if kept > 1 else None)
        view, w2c, unexplained = view[chosen], w2c[chosen], unexplained[chosen]
        last = kept == 1
        if last and exact:
            left = np.unique(view)  # what is given up would take all samples, in vain
            view, w2c = np.concatenate([view, left]), np.concatenate([w2c, _consensus(views, left)])
        w2c, unexplained = _refined(rows, view, w2c, known if last else free, steps)
    chosen = _ahead(view, unexplained, 1, None)
    poses, cost = np.full((number, 3, 4), np.nan), np.full(number, np.inf)
    poses[view[chosen]], cost[view[chosen]] = w2c[chosen], unexplained[chosen]
    return Located(poses, cost)


def runner_up(views: Views, w2c: Float[np.ndarray, "m 3 4"], apart_deg: float) -> Float[np.ndarray, "m"]:
    """`Located.cost` of the best other pose of each view, turned by more than ``apart_deg`` from the one given."""
    number, rows = len(views.uv), _rows(views)
    view, others = np.repeat(np.arange(number), _RIVALS), _best_guesses(views, _RIVALS).reshape(-1, 3, 4)
    others, cost = _refined(rows, view, others, views.tolerance_px / 3, sum(steps for _, steps in _ROUNDS))
    turned = rotation_angle_deg(others[..., :3].swapaxes(-1, -2) @ w2c[view][..., :3])
    cost = np.where(np.isfinite(cost) & (turned > apart_deg), cost, np.inf)
    return cost.reshape(number, _RIVALS).min(1)


def unexplained(views: Views, w2c: Float[np.ndarray, "m 3 4"]) -> Float[np.ndarray, "m"]:
    """`Located.cost` of each view at a given pose; 1 where there is none."""
    return _refined(_rows(views), np.arange(len(w2c)), w2c, np.full(len(w2c), np.inf), 0)[1]


def _ahead(
    view: Int[np.ndarray, "k"], cost: Float[np.ndarray, "k"], kept: int, rival: Int[np.ndarray, "m"] | None
) -> Int[np.ndarray, "c"]:
    """Indices of the ``kept`` cheapest guesses of each view, of none whose rival is clearly ahead."""
    cost = np.where(np.isfinite(cost), cost, np.inf)
    order = np.lexsort((cost, view))
    begins = np.flatnonzero(np.diff(view[order], prepend=-1))
    place = np.arange(len(order)) - np.repeat(begins, np.diff(begins, append=len(order)))
    good = place < kept
    if rival is not None:
        best = np.full(len(rival), np.inf)
        best[view[order[begins]]] = cost[order[begins]]
        good &= (best <= _BEHIND * best[rival])[view[order]]
    return order[good]


class _Rows(NamedTuple):
    """`Views` as compiled loops take them: the K detections of known points in a row, view by view."""

    first: Any
    """[M + 1]"""
    point: Any
    """[K, 3]"""
    normal: Any
    """[K, 3]"""
    uv: Any
    """[K, 2]"""
    own: Any
    """[K] weight"""
    focal: Any
    """[2]"""
    tolerance: Any
    """[M]"""


def _rows(views: Views) -> _Rows:
    usable = (views.weight > 0) & np.isfinite(views.points).all(-1)[views.label]
    view, column = np.nonzero(usable)
    first = np.zeros(len(usable) + 1, np.int64)
    np.cumsum(usable.sum(1), out=first[1:])
    label = views.label[view, column]
    return _Rows(
        first,
        views.points[label],
        views.normals[label],
        views.uv[view, column],
        views.weight[view, column],
        np.array(views.focal),
        np.ascontiguousarray(views.tolerance_px),
    )


def _refined(
    rows: _Rows, view: Int[np.ndarray, "k"], w2c: Float[np.ndarray, "k 3 4"], most: Float[np.ndarray, "m"], steps: int
) -> tuple[Float[np.ndarray, "k 3 4"], Float[np.ndarray, "k"]]:
    """Every guess after so many steps of robust least squares, and what it leaves unexplained."""
    w2c, cost = w2c.copy(), np.empty(len(view))
    edges = np.linspace(0, len(view), 1 + (_PARTS if len(view) >= _MANY else 1)).astype(int)

    def run(part: int) -> None:
        of = slice(edges[part], edges[part + 1])
        _refine(rows, view[of], w2c[of], most, steps, cost[of])

    in_parts(run, len(edges) - 1)
    return w2c, cost


@compiled
def _refine(rows: Any, view: Any, w2c: Any, most: Any, steps: int, out: Any) -> None:
    """Refine guesses in place by graduated robust steps."""
    longest = 0
    for n in range(len(rows.first) - 1):
        longest = max(longest, rows.first[n + 1] - rows.first[n])
    seen, trial_seen = np.empty((5, longest)), np.empty((5, longest))  # u, v, 1 / z, error x, error y
    length, trial_length, work = np.empty(longest), np.empty(longest), np.empty(longest)
    a, off, camera, right = np.empty((6, 2 * longest)), np.empty(2 * longest), np.empty((6, 6)), np.empty(6)
    w, twist, turn, trial = np.empty((6, 6)), np.empty(6), np.empty((3, 3)), np.empty((3, 4))
    for g in range(len(view)):
        n, pose = view[g], w2c[g]
        begin, count = rows.first[n], rows.first[n + 1] - rows.first[n]
        now, then = length[:count], trial_length[:count]
        _see(rows, begin, count, pose, seen, now)
        sigma, damping = np.inf, _START_DAMPING
        for _ in range(steps):
            sigma = min(sigma, noise(now, work[:count]), most[n])
            for k in range(count):
                at, m = begin + k, count + k
                u, v, near = seen[0, k], seen[1, k], seen[2, k]
                root = np.sqrt(rows.own[at] / cauchy_term(now[k], sigma))
                xu, _, _, yv = pixel_by_plane(u, v, root * rows.focal[0], root * rows.focal[1], 0.0)
                u0, u1, u2, v0, v1, v2 = plane_by_turn(u, v)
                ux, uz, vy, vz = plane_by_shift(u, v, near)
                a[0, k], a[1, k], a[2, k], a[3, k], a[4, k], a[5, k] = xu * u0, xu * u1, xu * u2, xu * ux, 0.0, xu * uz
                a[0, m], a[1, m], a[2, m], a[3, m], a[4, m], a[5, m] = yv * v0, yv * v1, yv * v2, 0.0, yv * vy, yv * vz
                off[k], off[m] = root * seen[3, k], root * seen[4, k]
            for p in range(6):
                right[p] = dot(a[p], off, 2 * count)
                for q in range(p + 1):
                    camera[p, q] = dot(a[p], a[q], 2 * count)
                camera[p, p] = (1.0 + damping) * camera[p, p] + 1e-12
            inverse_factor(camera, w)
            for p in range(6):
                twist[p] = total = 0.0
                for q in range(p + 1):
                    total += w[p, q] * right[q]
                for q in range(p + 1):
                    twist[q] -= w[p, q] * total
            exponential(twist, turn)
            for p in range(3):
                for c in range(4):
                    trial[p, c] = turn[p, 0] * pose[0, c] + turn[p, 1] * pose[1, c] + turn[p, 2] * pose[2, c]
                trial[p, 3] += twist[3 + p]
            _see(rows, begin, count, trial, trial_seen, then)
            if cost(then, sigma, CAUCHY) < cost(now, sigma, CAUCHY):  # false for NaN
                for p in range(3):  # an assignment of arrays compiles the text of its errors, for two seconds
                    for c in range(4):
                        pose[p, c] = trial[p, c]
                seen, trial_seen = trial_seen, seen
                now, then = then, now
                damping /= 10.0
            else:
                damping *= 100.0
        out[g] = _unexplained(rows, begin, count, pose, seen, rows.tolerance[n])


@compiled
def _see(rows: Any, begin: int, count: int, pose: Any, seen: Any, length: Any) -> None:
    """Reproject a view's points: place in the image plane, 1 / z, error, and its weighted length."""
    for k in range(count):
        at = begin + k
        x, y, z = rows.point[at, 0], rows.point[at, 1], rows.point[at, 2]
        depth = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        near = 1.0 / max(depth, NEAR)
        u = (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]) * near
        v = (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]) * near
        px, py = pixel(u, v, rows.focal[0], rows.focal[1], 0.0)
        before = depth >= NEAR
        dx, dy = px - rows.uv[at, 0] if before else 0.0, py - rows.uv[at, 1] if before else 0.0
        seen[0, k], seen[1, k], seen[2, k], seen[3, k], seen[4, k] = u, v, near, dx, dy
        length[k] = np.sqrt(rows.own[at] * (dx * dx + dy * dy)) if before else BEHIND_PX


@compiled
def _unexplained(rows: Any, begin: int, count: int, pose: Any, seen: Any, tolerance: float) -> Any:
    """Weighted mean over detections: 0 where met, towards 1 where far off, 1 behind the camera or on the far side."""
    total, weight = 0.0, 1e-9
    for k in range(count):
        at = begin + k
        off = 1.0
        facing = reach = 0.0
        for c in range(3):
            # from the point to the camera: -(R^T t) - X
            ray = -rows.point[at, c]
            for p in range(3):
                ray -= pose[p, c] * pose[p, 3]
            facing += ray * rows.normal[at, c]
            reach += ray * ray
        if seen[2, k] < 1.0 / NEAR and facing >= AWAY * np.sqrt(reach):
            square = (seen[3, k] * seen[3, k] + seen[4, k] * seen[4, k]) / (tolerance * tolerance)
            off = 1.0 - 1.0 / (1.0 + square)
        total += rows.own[at] * off
        weight += rows.own[at]
    return total / weight


def _consensus(views: Views, chosen: Int[np.ndarray, "c"]) -> Float[np.ndarray, "c 3 4"]:
    """Poses (w2c) of some views by OpenCV's RANSAC over three-point poses; the identity, far off, where it finds none.

    For the few views that nothing else could place: OpenCV takes one view at a time.
    """
    import cv2

    found = np.tile(np.eye(3, 4), (len(chosen), 1, 1))
    usable = (views.weight > 0) & np.isfinite(views.points).all(-1)[views.label]
    for n, i in enumerate(chosen.tolist()):
        seen = usable[i]
        if int(seen.sum()) < _SAMPLE:
            continue
        cv2.setRNGSeed(0)
        ok, turn, shift, _ = cv2.solvePnPRansac(
            views.points[views.label[i, seen]],
            views.uv[i, seen] / views.focal,
            np.eye(3),
            np.zeros(4),
            iterationsCount=_SAMPLES,
            reprojectionError=float(views.tolerance_px[i] / views.focal[0]),
            flags=cv2.SOLVEPNP_AP3P,
        )
        if ok:
            found[n] = np.hstack([cv2.Rodrigues(turn)[0], shift])
    return found


@lru_cache(maxsize=1)
def _directions() -> tuple[Float[np.ndarray, "h 3 3"], Float[np.ndarray, "81 h"]]:
    """World-to-camera rotations of cameras all around that face the z axis, for each roll; and their products."""
    azimuth = np.arange(_AZIMUTHS) * (2 * math.pi / _AZIMUTHS)
    azimuth, elevation = (x.ravel() for x in np.meshgrid(azimuth, np.deg2rad(_ELEVATIONS_DEG), indexing="ij"))
    centre = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    upright = look_at(centre, np.zeros_like(centre), np.array([0.0, 0.0, 1.0]))[..., :3].swapaxes(-1, -2)
    roll = np.zeros((len(_ROLLS_DEG), 3))
    roll[:, 2] = np.deg2rad(_ROLLS_DEG)
    rotations = (so3_exp(roll)[:, None] @ upright).reshape(-1, 3, 3)
    flat = rotations.reshape(-1, 9)
    return rotations, np.ascontiguousarray((flat[:, :, None] * flat[:, None]).reshape(-1, 81).T)


def _best_guesses(views: Views, count: int) -> Float[np.ndarray, "m g 3 4"]:
    """The most promising poses (w2c) of each view by object-space error over distance, no two of them neighbours."""
    known = np.isfinite(views.points).all(-1)
    points = np.where(known[:, None], views.points, 0.0)[views.label]  # [m, j, 3]
    weight = np.where(known[views.label], views.weight, 0.0)
    ray = unit(np.concatenate([views.uv / views.focal, np.ones((*weight.shape, 1))], axis=-1))
    mean = (points * weight[..., None]).sum(1, keepdims=True) / np.maximum(weight.sum(1), 1e-9)[:, None, None]
    centred = points - mean
    across = (np.eye(3) - ray[..., :, None] * ray[..., None, :]) * weight[..., None, None]  # [m, j, 3, 3]
    by_detection = across.reshape(*weight.shape, 9).swapaxes(1, 2)  # [m, 9, j]
    # sum of across (R X + t), with vec(R) row by row: t = -pull vec(R)
    mixed = (by_detection @ centred).reshape(-1, 3, 9)
    pull = np.linalg.solve(across.sum(1) + 1e-9 * np.eye(3), mixed)
    outer = (centred[..., :, None] * centred[..., None, :]).reshape(*weight.shape, 9)
    square = (by_detection @ outer).reshape(-1, 3, 3, 3, 3).transpose(0, 1, 3, 2, 4).reshape(-1, 9, 9)
    square = square - mixed.swapaxes(1, 2) @ pull
    directions, products = _directions()
    flat = directions.reshape(-1, 9).T
    error = square.reshape(-1, 81) @ products
    depth = -pull[:, 2] @ flat
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.where(depth > 0, error / np.square(depth), np.inf)
    grid = error.reshape(-1, len(_ROLLS_DEG), _AZIMUTHS, len(_ELEVATIONS_DEG))
    lowest = grid <= np.minimum(np.roll(grid, 1, axis=2), np.roll(grid, -1, axis=2))  # minima over the azimuth
    error = np.where(lowest.reshape(error.shape), error, np.inf)
    best = np.argpartition(error, count, axis=1)[:, :count]
    rotation = directions[best]
    translation = -np.einsum("mip,pmg->mgi", pull, flat[:, best])
    return make_pose(rotation, translation - (rotation @ mean[:, None, 0, :, None])[..., 0])
