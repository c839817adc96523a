"""Normal equations of a bundle adjustment with the points eliminated (Schur complement), compiled for the CPU.

The points are many and few cameras see each: what a point adds to the reduced system are blocks of the cameras that see
it. Derivation: docs/solver.md, section 5.
"""

import os
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int
from numpy.typing import NDArray

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
from kronc_ns.solve.sightings import Sightings, Unknowns
from kronc_ns.solve.threads import in_parts

Array = NDArray[Any]

_TINY = 1e-9  # added to pivots, which may be zero
_WORTH_SHARING = 2_000  # points, below which a thread takes longer to start than to work


class Reduced(NamedTuple):
    """The reduced system, and what is needed to get back to the points. Made once, filled by `reduce` step by step."""

    matrix: Array
    """[T, F, F] by each thread; of the first the whole, once `reduce` has ended"""
    gradient: Array
    """[T, F]"""
    diagonal: Array
    """[T, F] of the cameras' own normal matrix, which damping goes by"""
    inverse: Array
    """[P, 3, 3] of the points' blocks"""
    pull: Array
    """[P, 3] the points' gradients"""
    mixed: Array
    """[S, 3, 6 + K] point against camera and intrinsics"""
    share: Array
    """[T + 1] the points of thread t are share[t] .. share[t + 1]"""

    @staticmethod
    def of(data: Sightings) -> "Reduced":
        """Room for the system of these sightings."""
        size, points, sightings = data.unknowns, len(data.first) - 1, len(data.camera)
        share = _shares(data.first)
        parts = len(share) - 1
        return Reduced(
            np.empty((parts, size, size)),
            np.empty((parts, size)),
            np.empty((parts, size)),
            np.empty((points, 3, 3)),
            np.empty((points, 3)),
            np.empty((sightings, 3, 6 + data.intrinsics)),
            share,
        )


def is_ready() -> bool:
    """Whether the compiled loops are there, in this process or on disk; else the first call compiles them."""
    return is_compiled(_reduce)


def reduce(data: Sightings, now: Unknowns, damping: float, curved: bool, room: Reduced) -> None:
    """Fill ``room`` at ``now``, damped by Marquardt's rule; ``curved``: with the loss's own curvature in place of the
    IRLS weights."""
    in_parts(lambda part: _reduce(data, now, damping, curved, part, room), len(room.share) - 1)
    _complete(damping, room)


def _shares(first: Int[np.ndarray, "p1"]) -> Int[np.ndarray, "t1"]:
    """Bounds of as many points for each core as are equal work: pairs of a point's sightings."""
    points = len(first) - 1
    parts = min(os.cpu_count() or 1, max(1, points // _WORTH_SHARING))
    work = np.cumsum(np.diff(first) ** 2)
    cuts = np.searchsorted(work, work[-1] * np.arange(1, parts) / parts) if parts > 1 else []
    return np.array([0, *cuts, points], np.int64)


@compiled
def errors(data: Any, now: Any, out: Any) -> None:
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
def sighting(data: Any, now: Any, p: int, o: int, camera: Any, point: Any, off: Any) -> Any:
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
def columns_of(data: Any, o: int, intrinsics: int, out: Any) -> None:
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
def _reduce(data: Any, now: Any, damping: float, curved: bool, part: int, room: Any) -> None:
    """One thread's share of the points: the upper blocks of the matrix, the gradient, the diagonal before the points
    are eliminated."""
    intrinsics = int(data.with_focal) + int(data.with_k1)
    width, poses = 6 + intrinsics, 6 * len(data.lens)
    matrix, gradient, diagonal = room.matrix[part], room.gradient[part], room.diagonal[part]
    size = len(gradient)
    for i in range(size):
        gradient[i] = diagonal[i] = 0.0
        for k in range(size):
            matrix[i, k] = 0.0
    camera, point, off, block = np.empty((2, 8)), np.empty((2, 3)), np.empty(3), np.empty((3, 3))
    here, half = np.empty(8, np.int64), np.empty((8, 3))
    lenses = np.zeros((3, size - poses))  # a point against the intrinsics of all lenses
    for p in range(room.share[part], room.share[part + 1]):
        begin, end = data.first[p], data.first[p + 1]
        pull = room.pull[p]
        for c in range(3):
            pull[c] = 0.0
            for d in range(3):
                block[c, d] = 0.0
            for k in range(size - poses):
                lenses[c, k] = 0.0
        for o in range(begin, end):
            mixed = room.mixed[o]
            weight = sighting(data, now, p, o, camera, point, off)
            if weight == 0.0:
                for c in range(3):
                    for k in range(width):
                        mixed[c, k] = 0.0
                continue
            bend = weight * off[2] if curved else weight
            columns_of(data, o, intrinsics, here)
            for c in range(3):
                pull[c] += weight * (point[0, c] * off[0] + point[1, c] * off[1])
                for d in range(3):
                    block[c, d] += bend * (point[0, c] * point[0, d] + point[1, c] * point[1, d])
                for k in range(width):
                    mixed[c, k] = bend * (camera[0, k] * point[0, c] + camera[1, k] * point[1, c])
                for k in range(6, width):
                    lenses[c, here[k] - poses] += mixed[c, k]
            for k in range(width):
                gradient[here[k]] += weight * (camera[0, k] * off[0] + camera[1, k] * off[1])
                diagonal[here[k]] += bend * (camera[0, k] * camera[0, k] + camera[1, k] * camera[1, k])
                row, x, y = matrix[here[k]], bend * camera[0, k], bend * camera[1, k]
                for m in range(width):
                    row[here[m]] += x * camera[0, m] + y * camera[1, m]
        inverse = room.inverse[p]
        _invert(block, damping, inverse)
        for o in range(begin, end):
            columns_of(data, o, intrinsics, here)
            mixed, i = room.mixed[o], here[0]
            for k in range(6):
                w0, w1, w2 = mixed[0, k], mixed[1, k], mixed[2, k]
                for c in range(3):
                    half[k, c] = w0 * inverse[0, c] + w1 * inverse[1, c] + w2 * inverse[2, c]
                h0, h1, h2 = half[k, 0], half[k, 1], half[k, 2]
                gradient[i + k] -= h0 * pull[0] + h1 * pull[1] + h2 * pull[2]
                for m in range(size - poses):
                    matrix[i + k, poses + m] -= h0 * lenses[0, m] + h1 * lenses[1, m] + h2 * lenses[2, m]
            for other in range(begin, end):
                j = 6 * data.camera[other]
                if j < i:
                    continue
                others = room.mixed[other]
                for k in range(6):
                    row, h0, h1, h2 = matrix[i + k], half[k, 0], half[k, 1], half[k, 2]
                    for m in range(6):
                        row[j + m] -= h0 * others[0, m] + h1 * others[1, m] + h2 * others[2, m]
        for k in range(size - poses):
            w0, w1, w2 = lenses[0, k], lenses[1, k], lenses[2, k]
            h0 = w0 * inverse[0, 0] + w1 * inverse[1, 0] + w2 * inverse[2, 0]
            h1 = w0 * inverse[0, 1] + w1 * inverse[1, 1] + w2 * inverse[2, 1]
            h2 = w0 * inverse[0, 2] + w1 * inverse[1, 2] + w2 * inverse[2, 2]
            gradient[poses + k] -= h0 * pull[0] + h1 * pull[1] + h2 * pull[2]
            for m in range(size - poses):
                matrix[poses + k, poses + m] -= h0 * lenses[0, m] + h1 * lenses[1, m] + h2 * lenses[2, m]


@compiled
def _complete(damping: float, room: Any) -> None:
    """Add up the threads' shares, mirror the upper half, damp."""
    whole, gradient, diagonal = room.matrix[0], room.gradient[0], room.diagonal[0]
    size = len(gradient)
    for part in range(1, len(room.gradient)):
        for i in range(size):
            gradient[i] += room.gradient[part, i]
            diagonal[i] += room.diagonal[part, i]
            for k in range(i, size):
                whole[i, k] += room.matrix[part, i, k]
    for i in range(size):
        whole[i, i] += damping * diagonal[i] + _TINY
        for k in range(i):
            whole[i, k] = whole[k, i]


@compiled
def follow(data: Any, room: Any, change: Any, points: Any) -> None:
    """Move the points after the reduced unknowns."""
    intrinsics = int(data.with_focal) + int(data.with_k1)
    here, right = np.empty(8, np.int64), np.empty(3)
    for p in range(len(data.first) - 1):
        for c in range(3):
            right[c] = -room.pull[p, c]
        for o in range(data.first[p], data.first[p + 1]):
            columns_of(data, o, intrinsics, here)
            for k in range(6 + intrinsics):
                moved = change[here[k]]
                for c in range(3):
                    right[c] -= room.mixed[o, c, k] * moved
        for c in range(3):
            inverse = room.inverse[p, c]
            points[p, c] += inverse[0] * right[0] + inverse[1] * right[1] + inverse[2] * right[2]
