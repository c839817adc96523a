"""The hot loops of `bundle` compiled for the CPU: the same results, only from the points a view really sees.

Dense tensor operations are right for a GPU; on a CPU their dispatch and the two thirds of unseen points cost most of
the time. Tests hold both against each other. The kernels release the interpreter lock.
"""

from typing import Any

import numpy as np
from numba import njit

BEHIND_PX = 1e4
"""Residual of a point behind its camera: an outlier to every robust loss."""
NEAR = 1e-6
"""Smallest z that is "in front", in world units."""
_TINY = 1e-12

_compiled = njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz", "arcp"}, error_model="numpy")


@_compiled
def reproject(
    rotation: Any,  # [B, N, 3, 3]
    translation: Any,  # [B, N, 3]
    points: Any,  # [B, J, 3]
    uv: Any,  # [B, N, 2, J]
    weight: Any,  # [B, N, J]
    focal: Any,  # [B, 2]
    plane: Any,  # out [B, N, 2, J]
    inverse_z: Any,  # out [B, N, 1, J]
    error: Any,  # out [B, N, 2, J]
    norm: Any,  # out [B, N, J]
) -> None:
    """`bundle.residuals` without intrinsics; outputs are written where a point is seen and 0 elsewhere."""
    scenes, views, joints = weight.shape
    for b in range(scenes):
        for n in range(views):
            r, t = rotation[b, n], translation[b, n]
            for j in range(joints):
                plane[b, n, 0, j] = plane[b, n, 1, j] = inverse_z[b, n, 0, j] = 0.0
                error[b, n, 0, j] = error[b, n, 1, j] = norm[b, n, j] = 0.0
                if weight[b, n, j] <= 0.0:
                    continue
                x, y, z = points[b, j, 0], points[b, j, 1], points[b, j, 2]
                depth = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + t[2]
                inverse = 1.0 / max(depth, NEAR)
                u = (r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + t[0]) * inverse
                v = (r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + t[1]) * inverse
                plane[b, n, 0, j], plane[b, n, 1, j], inverse_z[b, n, 0, j] = u, v, inverse
                if depth < NEAR:
                    norm[b, n, j] = BEHIND_PX
                    continue
                du, dv = focal[b, 0] * u - uv[b, n, 0, j], focal[b, 1] * v - uv[b, n, 1, j]
                error[b, n, 0, j], error[b, n, 1, j] = du, dv
                norm[b, n, j] = np.sqrt(weight[b, n, j] * (du * du + dv * dv))


@_compiled
def reduce_system(
    rotation: Any,  # [B, N, 3, 3]
    plane: Any,  # [B, N, 2, J]
    inverse_z: Any,  # [B, N, 1, J]
    error: Any,  # [B, N, 2, J]
    weight: Any,  # [B, N, J], IRLS weights times the detections' own
    focal: Any,  # [B, 2]
    damping: Any,  # [B]
    whitener: Any,  # out [B, N, 6, 6]
    whitened: Any,  # out [B, N, 6, 3J + 1], zeros
    point: Any,  # out [B, 3J, 3J], zeros: the points' own block; lower triangle
    product: Any,  # out [B, 3J, 3J], zeros: what eliminating the cameras takes off it; lower triangle
    gradient: Any,  # out [B, 3J], zeros: the points' own
    carried: Any,  # out [B, 3J], zeros: what the cameras hand on to the right-hand side
) -> None:
    """`bundle.linearise` and `bundle.eliminate_cameras` in one pass over the detections."""
    scenes, views, joints = weight.shape
    a = np.empty((2, 6))
    rows = np.empty((2, 3))
    camera = np.empty((6, 6))
    right = np.empty(6)
    seen = np.empty(joints, np.int64)
    columns = np.empty(3 * joints, np.int64)
    mixed = np.empty((6, 3 * joints))
    y = np.empty((6, 3 * joints))
    dots = np.empty(3 * joints)
    for b in range(scenes):
        for n in range(views):
            count = 0
            for j in range(joints):
                if weight[b, n, j] > 0.0:
                    seen[count] = j
                    count += 1
            camera[:] = 0.0
            right[:] = 0.0
            r = rotation[b, n]
            for k in range(count):
                j = seen[k]
                u, v, near = plane[b, n, 0, j], plane[b, n, 1, j], inverse_z[b, n, 0, j]
                a[0, 0], a[0, 1], a[0, 2], a[0, 3], a[0, 4], a[0, 5] = -u * v, 1 + u * u, -v, near, 0.0, -u * near
                a[1, 0], a[1, 1], a[1, 2], a[1, 3], a[1, 4], a[1, 5] = -1 - v * v, u * v, u, 0.0, near, -v * near
                root = np.sqrt(weight[b, n, j])
                for axis in range(2):
                    scale = root * focal[b, axis]
                    here = plane[b, n, axis, j]
                    off = root * error[b, n, axis, j]
                    for p in range(6):
                        a[axis, p] *= scale
                        right[p] += a[axis, p] * off
                    for c in range(3):
                        rows[axis, c] = scale * near * (r[axis, c] - here * r[2, c])
                        gradient[b, c * joints + j] += rows[axis, c] * off
                for p in range(6):
                    for q in range(p + 1):
                        camera[p, q] += a[0, p] * a[0, q] + a[1, p] * a[1, q]
                    for c in range(3):
                        mixed[p, c * count + k] = a[0, p] * rows[0, c] + a[1, p] * rows[1, c]
                for c in range(3):
                    columns[c * count + k] = c * joints + j
                    for d in range(c + 1):
                        point[b, c * joints + j, d * joints + j] += rows[0, c] * rows[0, d] + rows[1, c] * rows[1, d]
            for p in range(6):
                if camera[p, p] <= _TINY:
                    camera[p, p] = 1.0
                camera[p, p] *= 1.0 + damping[b]
            _inverse_factor(camera, whitener[b, n])
            w = whitener[b, n]
            width = 3 * count
            for p in range(6):
                total = 0.0
                for q in range(p + 1):
                    total += w[p, q] * right[q]
                whitened[b, n, p, 3 * joints] = total
                y[p, :width] = 0.0
                for q in range(p + 1):
                    factor = w[p, q]
                    for i in range(width):
                        y[p, i] += factor * mixed[q, i]
                for i in range(width):
                    whitened[b, n, p, columns[i]] = y[p, i]
                    carried[b, columns[i]] += y[p, i] * total
            for i in range(width):
                y0, y1, y2, y3, y4, y5 = y[0, i], y[1, i], y[2, i], y[3, i], y[4, i], y[5, i]
                for k in range(i + 1):
                    dots[k] = y0 * y[0, k] + y1 * y[1, k] + y2 * y[2, k] + y3 * y[3, k] + y4 * y[4, k] + y5 * y[5, k]
                into = product[b, columns[i]]
                for k in range(i + 1):
                    into[columns[k]] += dots[k]


@_compiled
def _inverse_factor(matrix: Any, out: Any) -> None:
    """Inverse of the lower Cholesky factor of a 6x6 matrix (lower triangle), which is destroyed."""
    for i in range(6):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = np.sqrt(total) if i == j else total / matrix[j, j]
    for j in range(6):
        for i in range(6):
            if i < j:
                out[i, j] = 0.0
                continue
            total = 1.0 if i == j else 0.0
            for k in range(j, i):
                total -= matrix[i, k] * out[k, j]
            out[i, j] = total / matrix[i, i]
