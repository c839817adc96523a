"""Bundle adjustment of many points that few cameras see each, compiled for the CPU: the points are eliminated.

The sightings of a point stand in a row: those of point p are ``first[p]:first[p + 1]``. The unknowns of the reduced
system are six of each camera, as in `schur` (turn, then shift in its own axes), and the K refined intrinsics of each
lens. Minimised is ``sum weight * scale^2 log(1 + |r|^2 / scale^2)`` over the sightings, Cauchy's loss with a scale of
their own. Nothing fixes the gauge: damping keeps its seven directions still. Derivation: docs/solver.md, section 5.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from kronc_ns.geometry.rotations import so3_exp
from kronc_ns.solve.compiled import compiled, is_compiled
from kronc_ns.solve.projection import (
    BEHIND_PX,
    NEAR,
    pixel,
    pixel_by_k1,
    pixel_by_plane,
    plane_by_point,
    plane_by_shift,
    plane_by_turn,
)

Array = NDArray[Any]

_START_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-3, 1e-9, 1e6
_TINY = 1e-9  # added to pivots, which may be zero


class Sightings(NamedTuple):
    """What is measured: S sightings of P points by N cameras through G lenses."""

    first: Array
    """[P + 1]"""
    camera: Array
    """[S] by which camera"""
    uv: Array
    """[S, 2] undistorted pixels less the principal point"""
    weight: Array
    """[S] inverse variance along one axis, 1 / px^2"""
    scale: Array
    """[S] of the Cauchy loss, in pixels"""
    focal: Array
    """[2]"""
    lens: Array
    """[N] which of the lenses each camera has"""
    with_focal: bool
    with_k1: bool

    @property
    def intrinsics(self) -> int:
        """Refined intrinsics of a lens."""
        return int(self.with_focal) + int(self.with_k1)

    @property
    def unknowns(self) -> int:
        """Of the reduced system."""
        return 6 * len(self.lens) + self.intrinsics * (int(self.lens.max(initial=0)) + 1)

    @property
    def of_point(self) -> Int[np.ndarray, "s"]:
        """Which point each sighting is of."""
        return np.repeat(np.arange(len(self.first) - 1), np.diff(self.first))


class Unknowns(NamedTuple):
    """What is sought."""

    rotation: Array
    """[N, 3, 3] world to camera"""
    translation: Array
    """[N, 3] world to camera"""
    points: Array
    """[P, 3]"""
    intrinsics: Array
    """[G, 2]: logarithm of the focal length's factor, k1 beyond what the pixels are undistorted by"""


class Reduced(NamedTuple):
    """The reduced system, and what is needed to get back to the points."""

    matrix: Array
    """[F, F], the whole of it"""
    gradient: Array
    """[F]"""
    inverse: Array
    """[P, 3, 3] of the points' blocks"""
    pull: Array
    """[P, 3] the points' gradients"""
    mixed: Array
    """[S, 6 + K, 3] camera and intrinsics against point"""


@dataclass(frozen=True)
class Bundled:
    """Where an adjustment ended."""

    now: Unknowns
    cost: float


def is_ready() -> bool:
    """Whether the compiled adjustment is there, in this process or on disk; else the first call compiles it."""
    return is_compiled(_reduce)


def adjust(data: Sightings, start: Unknowns, steps: int, tolerance: float) -> Bundled:
    """Levenberg-Marquardt until a step gains less than ``tolerance`` of the cost, or ``steps`` are done."""
    now, damping = start, _START_DAMPING
    cost = total_cost(data, now)
    room = _room(data)
    for _ in range(steps):
        _reduce(data, now, damping, False, room)
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
    _errors(data, now, error)
    return np.hypot(error[:, 0], error[:, 1])


def total_cost(data: Sightings, now: Unknowns) -> float:
    """What is minimised."""
    square = error_px(data, now) ** 2 / data.scale**2
    return float((data.weight * data.scale**2 * np.log1p(square)).sum())


def normal_matrix(data: Sightings, now: Unknowns) -> Float[np.ndarray, "f f"]:
    """The reduced system without damping; its seven gauge directions are (nearly) zero."""
    room = _room(data)
    _reduce(data, now, 0.0, False, room)
    return room.matrix


def sandwich(
    data: Sightings, now: Unknowns, group: Int[np.ndarray, "s"], common_px: float
) -> tuple[Float[np.ndarray, "f f"], Float[np.ndarray, "f f"]]:
    """What the covariance at a minimum is made of (Huber, 1967): the reduced system with the loss's own curvature, and
    the summed outer products of what each point pulls the reduced unknowns by.

    The sightings of one point may err together, and those of a ``group`` (below 0: of none) have an error of
    ``common_px`` along each axis in common. The curvature of Cauchy's loss is, on average over directions, its IRLS
    weight squared: with the weight itself covariances would come out too small.
    """
    room, scores = _room(data), np.zeros((data.unknowns, data.unknowns))
    _reduce(data, now, 0.0, True, room)
    _scores(data, now, room, scores)
    common = np.zeros((2 * (int(group.max(initial=-1)) + 1), data.unknowns))
    _common_scores(data, now, room, group, common)
    return room.matrix, scores + common_px**2 * (common.T @ common)


def gauge_of(now: Unknowns, unknowns: int) -> Float[np.ndarray, "f 7"]:
    """How shift, turn and growth of the world move the reduced unknowns: directions that change no image."""
    moves = np.zeros((unknowns, 7))
    for n, (r, t) in enumerate(zip(now.rotation, now.translation, strict=True)):
        at = 6 * n
        moves[at + 3 : at + 6, :3] = -r  # the world moves by s: t becomes t - R s
        moves[at : at + 3, 3:6] = -r  # it turns by w about its origin: R becomes R exp(-w)
        for axis in range(3):  # ... and t, on which a turn in camera axes acts as well, stays
            moves[at + 3 : at + 6, 3 + axis] = np.cross(r[:, axis], t)
        moves[at + 3 : at + 6, 6] = t
    return moves


def _room(data: Sightings) -> Reduced:
    size, points, sightings = data.unknowns, len(data.first) - 1, len(data.camera)
    return Reduced(
        np.empty((size, size)),
        np.empty(size),
        np.empty((points, 3, 3)),
        np.empty((points, 3)),
        np.empty((sightings, 6 + data.intrinsics, 3)),
    )


def _solved(room: Reduced) -> Float[np.ndarray, "f"] | None:
    """The step of the reduced unknowns."""
    try:
        change = np.linalg.solve(room.matrix, -room.gradient)
    except np.linalg.LinAlgError:
        return None
    return change if np.isfinite(change).all() else None


def _moved(data: Sightings, now: Unknowns, room: Reduced, change: Float[np.ndarray, "f"]) -> Unknowns:
    """The unknowns one step ahead."""
    views = len(now.rotation)
    twist = change[: 6 * views].reshape(views, 6)
    turn = so3_exp(twist[:, :3])
    points = now.points.copy()
    _follow(data, room, change, points)
    intrinsics = now.intrinsics.copy()
    of_lens = change[6 * views :].reshape(len(intrinsics), -1)
    for column, (unknown, refined) in enumerate(((0, data.with_focal), (1, data.with_k1))):
        if refined:
            intrinsics[:, unknown] += of_lens[:, column if data.with_focal else 0]
    return Unknowns(turn @ now.rotation, (turn @ now.translation[..., None])[..., 0] + twist[:, 3:], points, intrinsics)


@compiled
def _errors(data: Any, now: Any, out: Any) -> None:
    """Projection minus sighting."""
    for p in range(len(data.first) - 1):
        x, y, z = now.points[p, 0], now.points[p, 1], now.points[p, 2]
        for o in range(data.first[p], data.first[p + 1]):
            n = data.camera[o]
            r, t, lens = now.rotation[n], now.translation[n], now.intrinsics[data.lens[n]]
            depth = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + t[2]
            if depth < NEAR:
                out[o, 0], out[o, 1] = BEHIND_PX, 0.0
                continue
            u = (r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + t[0]) / depth
            v = (r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + t[1]) / depth
            growth = np.exp(lens[0])
            px, py = pixel(u, v, data.focal[0] * growth, data.focal[1] * growth, lens[1])
            out[o, 0], out[o, 1] = px - data.uv[o, 0], py - data.uv[o, 1]


@compiled
def _sighting(data: Any, now: Any, p: int, o: int, camera: Any, point: Any, off: Any) -> Any:
    """IRLS weight of a sighting, with its derivatives by camera and intrinsics [2, 6 + K] and by the point [2, 3] and
    its error and the loss's factor [3]; 0 behind the camera."""
    n = data.camera[o]
    r, t, lens = now.rotation[n], now.translation[n], now.intrinsics[data.lens[n]]
    x, y, z = now.points[p, 0], now.points[p, 1], now.points[p, 2]
    depth = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + t[2]
    if depth < NEAR:
        return 0.0
    near = 1.0 / depth
    u = (r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + t[0]) * near
    v = (r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + t[1]) * near
    growth, k1 = np.exp(lens[0]), lens[1]
    fx, fy = data.focal[0] * growth, data.focal[1] * growth
    px, py = pixel(u, v, fx, fy, k1)
    off[0], off[1] = px - data.uv[o, 0], py - data.uv[o, 1]
    xu, xv, yu, yv = pixel_by_plane(u, v, fx, fy, k1)
    u0, u1, u2, v0, v1, v2 = plane_by_turn(u, v)
    ux, uz, vy, vz = plane_by_shift(u, v, near)
    camera[0, 0], camera[0, 1], camera[0, 2] = xu * u0 + xv * v0, xu * u1 + xv * v1, xu * u2 + xv * v2
    camera[1, 0], camera[1, 1], camera[1, 2] = yu * u0 + yv * v0, yu * u1 + yv * v1, yu * u2 + yv * v2
    camera[0, 3], camera[0, 4], camera[0, 5] = xu * ux, xv * vy, xu * uz + xv * vz
    camera[1, 3], camera[1, 4], camera[1, 5] = yu * ux, yv * vy, yu * uz + yv * vz
    at = 6
    if data.with_focal:
        camera[0, at], camera[1, at] = px, py
        at += 1
    if data.with_k1:
        camera[0, at], camera[1, at] = pixel_by_k1(u, v, fx, fy)
    for c in range(3):
        du, dv = plane_by_point(u, v, near, r[0, c], r[1, c], r[2, c])
        point[0, c], point[1, c] = xu * du + xv * dv, yu * du + yv * dv
    square = (off[0] * off[0] + off[1] * off[1]) / (data.scale[o] * data.scale[o])
    off[2] = 1.0 / (1.0 + square)
    return data.weight[o] * off[2]


@compiled
def _columns(data: Any, o: int, intrinsics: int, out: Any) -> None:
    """Where a sighting's derivatives belong among the reduced unknowns."""
    n = data.camera[o]
    for k in range(6):
        out[k] = 6 * n + k
    for k in range(intrinsics):
        out[6 + k] = 6 * len(data.lens) + intrinsics * data.lens[n] + k


@compiled
def _invert(m: Any, damping: float, out: Any) -> None:
    """Inverse of a point's block, damped by Marquardt's rule."""
    a, d, h = (1.0 + damping) * m[0, 0] + _TINY, (1.0 + damping) * m[1, 1] + _TINY, (1.0 + damping) * m[2, 2] + _TINY
    b, c, e = m[0, 1], m[0, 2], m[1, 2]
    c00, c01, c02 = d * h - e * e, c * e - b * h, b * e - c * d
    inverse = 1.0 / (a * c00 + b * c01 + c * c02)
    out[0, 0], out[0, 1], out[0, 2] = c00 * inverse, c01 * inverse, c02 * inverse
    out[1, 0], out[1, 1], out[1, 2] = c01 * inverse, (a * h - c * c) * inverse, (b * c - a * e) * inverse
    out[2, 0], out[2, 1], out[2, 2] = c02 * inverse, (b * c - a * e) * inverse, (a * d - b * b) * inverse


@compiled
def _reduce(data: Any, now: Any, damping: float, curved: bool, room: Any) -> None:
    """Normal equations and Schur complement of the points, point by point; ``curved``: with the loss's curvature."""
    intrinsics = int(data.with_focal) + int(data.with_k1)
    width, size = 6 + intrinsics, len(room.gradient)
    matrix, gradient = room.matrix, room.gradient
    for i in range(size):
        gradient[i] = 0.0
        for k in range(size):
            matrix[i, k] = 0.0
    diagonal = np.zeros(size)
    camera, point, off, block = np.empty((2, 8)), np.empty((2, 3)), np.empty(3), np.empty((3, 3))
    here, there, half = np.empty(8, np.int64), np.empty(8, np.int64), np.empty((8, 3))
    for p in range(len(data.first) - 1):
        begin, end = data.first[p], data.first[p + 1]
        pull = room.pull[p]
        for c in range(3):
            pull[c] = 0.0
            for d in range(3):
                block[c, d] = 0.0
        for o in range(begin, end):
            mixed = room.mixed[o]
            weight = _sighting(data, now, p, o, camera, point, off)
            if weight == 0.0:
                for k in range(width):
                    for c in range(3):
                        mixed[k, c] = 0.0
                continue
            bend = weight * off[2] if curved else weight
            _columns(data, o, intrinsics, here)
            for c in range(3):
                pull[c] += weight * (point[0, c] * off[0] + point[1, c] * off[1])
                for d in range(3):
                    block[c, d] += bend * (point[0, c] * point[0, d] + point[1, c] * point[1, d])
            for k in range(width):
                gradient[here[k]] += weight * (camera[0, k] * off[0] + camera[1, k] * off[1])
                for m in range(width):
                    value = bend * (camera[0, k] * camera[0, m] + camera[1, k] * camera[1, m])
                    matrix[here[k], here[m]] += value
                    if m == k:
                        diagonal[here[k]] += value
                for c in range(3):
                    mixed[k, c] = bend * (camera[0, k] * point[0, c] + camera[1, k] * point[1, c])
        inverse = room.inverse[p]
        _invert(block, damping, inverse)
        for o in range(begin, end):
            _columns(data, o, intrinsics, here)
            for k in range(width):
                w0, w1, w2 = room.mixed[o, k, 0], room.mixed[o, k, 1], room.mixed[o, k, 2]
                for c in range(3):
                    half[k, c] = w0 * inverse[0, c] + w1 * inverse[1, c] + w2 * inverse[2, c]
                gradient[here[k]] -= half[k, 0] * pull[0] + half[k, 1] * pull[1] + half[k, 2] * pull[2]
            for other in range(begin, end):
                _columns(data, other, intrinsics, there)
                for k in range(width):
                    row = matrix[here[k]]
                    h0, h1, h2 = half[k, 0], half[k, 1], half[k, 2]
                    for m in range(width):
                        w = room.mixed[other, m]
                        row[there[m]] -= h0 * w[0] + h1 * w[1] + h2 * w[2]
    for i in range(size):
        matrix[i, i] += damping * diagonal[i] + _TINY


@compiled
def _follow(data: Any, room: Any, change: Any, points: Any) -> None:
    """Move the points after the reduced unknowns."""
    intrinsics = int(data.with_focal) + int(data.with_k1)
    here, right = np.empty(8, np.int64), np.empty(3)
    for p in range(len(data.first) - 1):
        for c in range(3):
            right[c] = -room.pull[p, c]
        for o in range(data.first[p], data.first[p + 1]):
            _columns(data, o, intrinsics, here)
            for k in range(6 + intrinsics):
                moved = change[here[k]]
                for c in range(3):
                    right[c] -= room.mixed[o, k, c] * moved
        for c in range(3):
            inverse = room.inverse[p, c]
            points[p, c] += inverse[0] * right[0] + inverse[1] * right[1] + inverse[2] * right[2]


@compiled
def _scores(data: Any, now: Any, room: Any, out: Any) -> None:
    """Outer products of the points' pulls on the reduced unknowns."""
    intrinsics = int(data.with_focal) + int(data.with_k1)
    width, most = 6 + intrinsics, 1
    for p in range(len(data.first) - 1):
        most = max(most, data.first[p + 1] - data.first[p])
    camera, point, off = np.empty((2, 8)), np.empty((2, 3)), np.empty(3)
    pulls, columns = np.empty((most, 8)), np.empty((most, 8), np.int64)
    shift = np.empty(3)
    for p in range(len(data.first) - 1):
        begin, end = data.first[p], data.first[p + 1]
        inverse, pull = room.inverse[p], room.pull[p]
        for c in range(3):
            shift[c] = inverse[c, 0] * pull[0] + inverse[c, 1] * pull[1] + inverse[c, 2] * pull[2]
        for o in range(begin, end):
            weight = _sighting(data, now, p, o, camera, point, off)
            _columns(data, o, intrinsics, columns[o - begin])
            for k in range(width):
                own = weight * (camera[0, k] * off[0] + camera[1, k] * off[1]) if weight > 0.0 else 0.0
                w = room.mixed[o, k]
                pulls[o - begin, k] = own - (w[0] * shift[0] + w[1] * shift[1] + w[2] * shift[2])
        for i in range(end - begin):
            for j in range(end - begin):
                for k in range(width):
                    row, own = out[columns[i, k]], pulls[i, k]
                    for m in range(width):
                        row[columns[j, m]] += own * pulls[j, m]


@compiled
def _common_scores(data: Any, now: Any, room: Any, group: Any, out: Any) -> None:
    """What an error of a pixel along x, and along y, in all sightings of a group pulls the reduced unknowns by."""
    intrinsics = int(data.with_focal) + int(data.with_k1)
    width = 6 + intrinsics
    camera, point, off = np.empty((2, 8)), np.empty((2, 3)), np.empty(3)
    columns, shift = np.empty(8, np.int64), np.empty(3)
    for p in range(len(data.first) - 1):
        begin, end = data.first[p], data.first[p + 1]
        inverse = room.inverse[p]
        for o in range(begin, end):
            if group[o] < 0:
                continue
            weight = _sighting(data, now, p, o, camera, point, off)
            if weight == 0.0:
                continue
            weight *= off[2]
            for axis in range(2):
                row = out[2 * group[o] + axis]
                _columns(data, o, intrinsics, columns)
                for k in range(width):
                    row[columns[k]] += weight * camera[axis, k]
                for c in range(3):
                    shift[c] = weight * (
                        inverse[c, 0] * point[axis, 0] + inverse[c, 1] * point[axis, 1] + inverse[c, 2] * point[axis, 2]
                    )
                for other in range(begin, end):
                    _columns(data, other, intrinsics, columns)
                    for k in range(width):
                        w = room.mixed[other, k]
                        row[columns[k]] -= w[0] * shift[0] + w[1] * shift[1] + w[2] * shift[2]
