"""Matches between two views whose poses are roughly known: near the epipolar line, at a possible depth, of like size.

Pixels are undistorted and less the principal point, of a camera whose focal length is the same along both axes.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int

from kronc_ns.refine.grid import CELL_PX, Grid
from kronc_ns.solve.compiled import compiled

_RATIO = 0.85  # of the distances of the best and the next best descriptor
_APART_PX = 4.0  # the next best is no neighbour of the best
_SIMILAR = 0.8  # least product of two descriptors
_SIZES = 1.6  # most ratio of two sizes, less what the distances explain
_DEPTHS = 1.07  # most ratio of a depth to what the other view allows
_NEAR = 0.2  # least depth, of the unit of the world
STILL_PX, _STILL_SIMILAR = 1.0, 0.88


@dataclass(frozen=True)
class Seen:
    """The features of one view, as its pose has them."""

    uv: Float[np.ndarray, "k 2"]
    size: Float[np.ndarray, "k"]
    descriptor: Float32[np.ndarray, "k 128"]
    nearest: Float[np.ndarray, "k"]
    """Least z-depth that is possible."""
    farthest: Float[np.ndarray, "k"]
    grid: Grid


@dataclass(frozen=True)
class Matches:
    """Features of two views that belong together."""

    here: Int[np.ndarray, "m"]
    there: Int[np.ndarray, "m"]
    similarity: Float[np.ndarray, "m"]
    """Product of the descriptors."""
    ratio: Float[np.ndarray, "m"]
    """Distance of the descriptors over that of the next best; the larger of both directions."""


def match(
    a: Seen,
    b: Seen,
    b_from_a: tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]],
    focal: float,
    tolerance: tuple[float, float],
    distance: tuple[float, float],
) -> Matches:
    """Features of a and b that choose each other.

    ``tolerance`` is the half width of the band in pixels at the car and infinitely far, ``distance`` how far the car is
    from a and from b.
    """
    r, t = np.ascontiguousarray(b_from_a[0]), b_from_a[1]
    back = np.ascontiguousarray(r.T)
    best, similarity, ratio = _chosen(a, b, r, t, focal, tolerance, distance[0])
    best_back, _, ratio_back = _chosen(b, a, back, -back @ t, focal, tolerance, distance[1])
    here = np.flatnonzero(best >= 0)
    here = here[best_back[best[here]] == here]
    there = best[here]
    return Matches(here, there, similarity[here], np.maximum(ratio[here], ratio_back[there]))


def standing_still(a: Seen, b: Seen) -> Int[np.ndarray, "k"]:
    """1 for every feature of a that b has, too, at the same place in the image, else 0."""
    found = np.zeros(len(a.uv), np.int64)
    if len(a.uv) and len(b.uv):
        _find_still(a.uv, a.descriptor, b.uv, b.descriptor, b.grid, found)
    return found


def _chosen(a: Seen, b: Seen, r: Any, t: Any, focal: float, tolerance: tuple[float, float], distance: float) -> Any:
    count = len(a.uv)
    best, similarity, ratio = np.full(count, -1, np.int64), np.zeros(count), np.zeros(count)
    if count and len(b.uv):
        _choose(
            (a.uv, a.size, a.descriptor, a.nearest, a.farthest),
            (b.uv, b.size, b.descriptor, b.nearest, b.farthest),
            b.grid, r, t, focal, tolerance[0], tolerance[1], distance, best, similarity, ratio,
        )  # fmt: skip
    return best, similarity, ratio


@compiled
def _choose(
    a: Any, b: Any, grid: Any, r: Any, t: Any, focal: float, at_car: float, far: float, distance: float,
    best: Any, similarity: Any, ratio: Any,
) -> None:  # fmt: skip
    """For each feature of a the best of b in its band."""
    uv_a, size_a, words_a, low_a, high_a = a
    uv_b, size_b, words_b, low_b, high_b = b
    candidate, score = np.empty(len(uv_b), np.int64), np.empty(len(uv_b), np.float32)
    widest = max(at_car, far)
    edge_x, edge_y = grid.columns * CELL_PX, grid.rows * CELL_PX
    for i in range(len(uv_a)):
        x, y = uv_a[i, 0] / focal, uv_a[i, 1] / focal
        d0 = r[0, 0] * x + r[0, 1] * y + r[0, 2]
        d1 = r[1, 0] * x + r[1, 1] * y + r[1, 2]
        d2 = r[2, 0] * x + r[2, 1] * y + r[2, 2]
        low, high = low_a[i], high_a[i]
        if d2 > 1e-9:  # in front of b, too
            low = max(low, (_NEAR - t[2]) / d2)
        elif d2 < -1e-9:
            high = min(high, (_NEAR - t[2]) / d2)
        elif t[2] < _NEAR:
            continue
        if high <= low:
            continue
        begin, end = 1.0 / (low * d2 + t[2]), 1.0 / (high * d2 + t[2])
        px, py = (low * d0 + t[0]) * begin * focal, (low * d1 + t[1]) * begin * focal
        qx, qy = (high * d0 + t[0]) * end * focal, (high * d1 + t[1]) * end * focal
        ex, ey = qx - px, qy - py
        length = np.sqrt(ex * ex + ey * ey)
        if length > 1e-9:
            ex, ey = ex / length, ey / length
        else:
            ex, ey = 1.0, 0.0
        # the part of the segment that lies in the view: u from least to most along (ex, ey)
        least, most = -widest, length + widest
        sx, sy = px - grid.low[0], py - grid.low[1]
        for start, slope, edge in ((sx, ex, edge_x), (sy, ey, edge_y)):
            if abs(slope) > 1e-9:
                one, two = (-widest - start) / slope, (edge + widest - start) / slope
                least, most = max(least, min(one, two)), min(most, max(one, two))
            elif start < -widest or start > edge + widest:
                most = least - 1.0
        if most < least:
            continue
        # cells that the band touches: columns (or rows, of a steep line) in turn, and a few cells of each
        steep = abs(ey) > abs(ex)
        along, across = (ey, ex) if steep else (ex, ey)
        s_along, s_across = (sy, sx) if steep else (sx, sy)
        count_along, count_across = (grid.rows, grid.columns) if steep else (grid.columns, grid.rows)
        one, two = s_along + least * along, s_along + most * along
        reach = widest * 1.5
        first = max(0, int(np.floor((min(one, two) - reach) / CELL_PX)))
        last = min(count_along - 1, int(np.floor((max(one, two) + reach) / CELL_PX)))
        found = 0
        for cell in range(first, last + 1):
            u0 = min(max((cell * CELL_PX - s_along) / along, least), most)
            u1 = min(max(((cell + 1) * CELL_PX - s_along) / along, least), most)
            v0, v1 = s_across + u0 * across, s_across + u1 * across
            begin_cell = max(0, int(np.floor((min(v0, v1) - reach) / CELL_PX)))
            end_cell = min(count_across - 1, int(np.floor((max(v0, v1) + reach) / CELL_PX)))
            for other in range(begin_cell, end_cell + 1):
                number = cell * grid.columns + other if steep else other * grid.columns + cell
                for k in range(grid.first[number], grid.first[number + 1]):
                    j = grid.order[k]
                    dx, dy = uv_b[j, 0] - px, uv_b[j, 1] - py
                    off = abs(dx * ey - dy * ex)
                    if off > widest:
                        continue
                    u = dx * ex + dy * ey
                    if u < -widest or u > length + widest:
                        continue
                    # depth along the ray, by the place along the line
                    mx, my = uv_b[j, 0] / focal, uv_b[j, 1] / focal
                    gx, gy = d0 - mx * d2, d1 - my * d2
                    z = (gx * (mx * t[2] - t[0]) + gy * (my * t[2] - t[1])) / max(gx * gx + gy * gy, 1e-18)
                    if z < low:
                        z = low if z > -1e-3 or u < 0.5 * length else high
                    z = min(z, high)
                    depth = z * d2 + t[2]
                    if depth * _DEPTHS < low_b[j] or depth > high_b[j] * _DEPTHS:
                        continue
                    if off > far + (at_car - far) * min(distance / z, 1.0):
                        continue
                    sizes = size_b[j] * depth / (size_a[i] * z)
                    if sizes > _SIZES or sizes * _SIZES < 1.0:
                        continue
                    candidate[found] = j
                    found += 1
        top, chosen = np.float32(-1.0), -1
        for k in range(found):
            product = np.float32(0.0)
            for c in range(128):
                product += words_a[i, c] * words_b[candidate[k], c]
            score[k] = product
            if product > top:
                top, chosen = product, candidate[k]
        if chosen < 0 or top < _SIMILAR:
            continue
        second = np.float32(-1.0)
        for k in range(found):
            j = candidate[k]
            dx, dy = uv_b[j, 0] - uv_b[chosen, 0], uv_b[j, 1] - uv_b[chosen, 1]
            if score[k] > second and dx * dx + dy * dy > _APART_PX * _APART_PX:
                second = score[k]
        # descriptors have length 1: |p - q|^2 = 2 - 2 p q
        square = max(2.0 - 2.0 * top, 0.0) / max(2.0 - 2.0 * second, 1e-9)
        if square <= _RATIO * _RATIO:
            best[i], similarity[i], ratio[i] = chosen, top, np.sqrt(square)


@compiled
def _find_still(uv_a: Any, words_a: Any, uv_b: Any, words_b: Any, grid: Any, out: Any) -> None:
    """1 where b has a feature of the same look within `STILL_PX`."""
    for i in range(len(uv_a)):
        x, y = uv_a[i, 0] - grid.low[0], uv_a[i, 1] - grid.low[1]
        for row in range(int(np.floor((y - STILL_PX) / CELL_PX)), int(np.floor((y + STILL_PX) / CELL_PX)) + 1):
            if row < 0 or row >= grid.rows:
                continue
            for column in range(int(np.floor((x - STILL_PX) / CELL_PX)), int(np.floor((x + STILL_PX) / CELL_PX)) + 1):
                if column < 0 or column >= grid.columns:
                    continue
                number = row * grid.columns + column
                for k in range(grid.first[number], grid.first[number + 1]):
                    j = grid.order[k]
                    dx, dy = uv_a[i, 0] - uv_b[j, 0], uv_a[i, 1] - uv_b[j, 1]
                    if dx * dx + dy * dy > STILL_PX * STILL_PX:
                        continue
                    product = np.float32(0.0)
                    for c in range(128):
                        product += words_a[i, c] * words_b[j, c]
                    if product > _STILL_SIMILAR:
                        out[i] = 1
