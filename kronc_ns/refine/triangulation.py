"""Each track's point in space."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from kronc_ns.refine.tracks import Cameras, Tracks
from kronc_ns.solve.compiled import compiled
from kronc_ns.solve.projection import BEHIND_PX


def place(
    tracks: Tracks,
    uv: Float[np.ndarray, "f 2"],
    view: Int[np.ndarray, "f"],
    cameras: Cameras,
    scale_px: float,
) -> tuple[Tracks, Float[np.ndarray, "s"]]:
    """Every track's point by robust triangulation, and the length of each sighting's error in pixels.

    ``scale_px`` is that of the Cauchy loss.
    """
    points, error = np.zeros((len(tracks), 3)), np.zeros(len(tracks.feature))
    if len(tracks):
        _place(
            tracks.first,
            view[tracks.feature],
            np.ascontiguousarray(uv[tracks.feature]) / cameras.focal,
            cameras.rotation,
            cameras.translation,
            cameras.centre,
            scale_px / cameras.focal,
            points,
            error,
        )
    return Tracks(tracks.first, tracks.feature, points), error * cameras.focal


@compiled
def _solve3(m: Any, b: Any, out: Any) -> None:
    """Solution of a symmetric system of three."""
    c00 = m[1, 1] * m[2, 2] - m[1, 2] * m[1, 2]
    c01 = m[0, 2] * m[1, 2] - m[0, 1] * m[2, 2]
    c02 = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
    inverse = 1.0 / (m[0, 0] * c00 + m[0, 1] * c01 + m[0, 2] * c02)
    c11, c12 = m[0, 0] * m[2, 2] - m[0, 2] * m[0, 2], m[0, 1] * m[0, 2] - m[0, 0] * m[1, 2]
    c22 = m[0, 0] * m[1, 1] - m[0, 1] * m[0, 1]
    out[0] = (c00 * b[0] + c01 * b[1] + c02 * b[2]) * inverse
    out[1] = (c01 * b[0] + c11 * b[1] + c12 * b[2]) * inverse
    out[2] = (c02 * b[0] + c12 * b[1] + c22 * b[2]) * inverse


@compiled
def _off(x: Any, r: Any, t: Any, u: float, v: float) -> Any:
    """Error in the image plane (two numbers) and depth; a huge one behind the camera."""
    z = r[2, 0] * x[0] + r[2, 1] * x[1] + r[2, 2] * x[2] + t[2]
    if z < 1e-3:
        return BEHIND_PX, BEHIND_PX, z
    p = (r[0, 0] * x[0] + r[0, 1] * x[1] + r[0, 2] * x[2] + t[0]) / z
    q = (r[1, 0] * x[0] + r[1, 1] * x[1] + r[1, 2] * x[2] + t[1]) / z
    return p - u, q - v, z


@compiled
def _misfit(x: Any, begin: Any, end: Any, view: Any, plane: Any, rotation: Any, translation: Any, scale: float) -> Any:
    """Cauchy's loss of a point's sightings."""
    total = 0.0
    for o in range(begin, end):
        du, dv, _ = _off(x, rotation[view[o]], translation[view[o]], plane[o, 0], plane[o, 1])
        total += np.log(1.0 + (du * du + dv * dv) / (scale * scale))
    return total


@compiled
def _place(
    first: Any, view: Any, plane: Any, rotation: Any, translation: Any, centre: Any, scale: float, points: Any,
    error: Any,
) -> None:  # fmt: skip
    """The point of each track: the best of those where two of its rays pass each other, then refined by all."""
    matrix, right, trial, best = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    for p in range(len(first) - 1):
        begin, end = first[p], first[p + 1]
        count = end - begin
        least = 1e300
        for i in range(count):
            for j in range(i + 1, count):
                if count > 5 and not (j == i + 1 or j == i + count // 2 or (i == 0 and j == count - 1)):
                    continue
                for a in range(3):
                    right[a] = 0.0
                    for b in range(3):
                        matrix[a, b] = 1e-9 if a == b else 0.0
                for o in (begin + i, begin + j):
                    r, c = rotation[view[o]], centre[view[o]]
                    u, v = plane[o, 0], plane[o, 1]
                    norm = np.sqrt(u * u + v * v + 1.0)
                    ray = (
                        (r[0, 0] * u + r[1, 0] * v + r[2, 0]) / norm,
                        (r[0, 1] * u + r[1, 1] * v + r[2, 1]) / norm,
                        (r[0, 2] * u + r[1, 2] * v + r[2, 2]) / norm,
                    )
                    for a in range(3):
                        for b in range(3):
                            part = (1.0 if a == b else 0.0) - ray[a] * ray[b]
                            matrix[a, b] += part
                            right[a] += part * c[b]
                _solve3(matrix, right, trial)
                cost = _misfit(trial, begin, end, view, plane, rotation, translation, scale)
                if cost < least:
                    least = cost
                    for a in range(3):
                        best[a] = trial[a]
        damping = 1e-3
        for _ in range(15):
            for a in range(3):
                right[a] = 0.0
                for b in range(3):
                    matrix[a, b] = 0.0
            for o in range(begin, end):
                r = rotation[view[o]]
                du, dv, z = _off(best, r, translation[view[o]], plane[o, 0], plane[o, 1])
                if z < 1e-3:
                    continue
                weight = 1.0 / (1.0 + (du * du + dv * dv) / (scale * scale))
                pu, pv = du + plane[o, 0], dv + plane[o, 1]
                by_u = ((r[0, 0] - pu * r[2, 0]) / z, (r[0, 1] - pu * r[2, 1]) / z, (r[0, 2] - pu * r[2, 2]) / z)
                by_v = ((r[1, 0] - pv * r[2, 0]) / z, (r[1, 1] - pv * r[2, 1]) / z, (r[1, 2] - pv * r[2, 2]) / z)
                for a in range(3):
                    right[a] -= weight * (by_u[a] * du + by_v[a] * dv)
                    for b in range(3):
                        matrix[a, b] += weight * (by_u[a] * by_u[b] + by_v[a] * by_v[b])
            for a in range(3):
                matrix[a, a] = matrix[a, a] * (1.0 + damping) + 1e-12
            _solve3(matrix, right, trial)
            for a in range(3):
                trial[a] += best[a]
            cost = _misfit(trial, begin, end, view, plane, rotation, translation, scale)
            if cost < least:
                gain = least - cost
                least = cost
                damping *= 0.2
                for a in range(3):
                    best[a] = trial[a]
                if gain < 1e-4:
                    break
            else:
                damping *= 10.0
                if damping > 1e3:
                    break
        for a in range(3):
            points[p, a] = best[a]
        for o in range(begin, end):
            du, dv, _ = _off(best, rotation[view[o]], translation[view[o]], plane[o, 0], plane[o, 1])
            error[o] = np.sqrt(du * du + dv * dv)
