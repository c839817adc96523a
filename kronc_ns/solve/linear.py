"""Small dense linear algebra for compiled loops: lower triangles, in place.

(LAPACK is reached from compiled loops through scipy alone, which takes longer to import than a scene to solve.)
"""

from typing import Any

import numpy as np

from kronc_ns.solve.compiled import compiled, compiled_briefly


@compiled
def dot(x: Any, y: Any, count: Any) -> Any:
    """Sum of products of the first ``count`` entries."""
    total = 0.0
    for k in range(count):
        total += x[k] * y[k]
    return total


@compiled
def exponential(w: Any, out: Any) -> None:
    """Rotation of the rotation vector in the first three entries of ``w`` (Rodrigues)."""
    square = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    angle = np.sqrt(square)
    if angle < 1e-4:  # the next term of either series is below rounding
        sine, versine = 1.0 - square / 6.0, 0.5 - square / 24.0
    else:
        sine, versine = np.sin(angle) / angle, (1.0 - np.cos(angle)) / square
    for p in range(3):
        for q in range(3):
            out[p, q] = versine * w[p] * w[q]
        out[p, p] += 1.0 - versine * square
    out[0, 1] -= sine * w[2]
    out[1, 0] += sine * w[2]
    out[0, 2] += sine * w[1]
    out[2, 0] -= sine * w[1]
    out[1, 2] -= sine * w[0]
    out[2, 1] += sine * w[0]


@compiled
def inverse_factor(matrix: Any, out: Any) -> None:
    """Inverse of the lower Cholesky factor of a small matrix (lower triangle), which is destroyed."""
    size = len(matrix)
    for i in range(size):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = np.sqrt(total) if i == j else total / matrix[j, j]
    for j in range(size):
        for i in range(size):
            if i < j:
                out[i, j] = 0.0
                continue
            total = 1.0 if i == j else 0.0
            for k in range(j, i):
                total -= matrix[i, k] * out[k, j]
            out[i, j] = total / matrix[i, i]


@compiled_briefly
def factor(matrix: Any) -> Any:
    """Cholesky's factor in place of the lower triangle; False where it is not positive definite."""
    size = len(matrix)
    for j in range(size):
        row = matrix[j]
        total = row[j]
        for k in range(j):
            total -= row[k] * row[k]
        if not total > 0.0:
            return False
        row[j] = np.sqrt(total)
        inverse = 1.0 / row[j]
        i = j + 1
        while i + 3 < size:  # four rows at a time share the loads
            r0, r1, r2, r3 = matrix[i], matrix[i + 1], matrix[i + 2], matrix[i + 3]
            s0 = s1 = s2 = s3 = 0.0
            for k in range(j):
                x = row[k]
                s0 += r0[k] * x
                s1 += r1[k] * x
                s2 += r2[k] * x
                s3 += r3[k] * x
            r0[j] = (r0[j] - s0) * inverse
            r1[j] = (r1[j] - s1) * inverse
            r2[j] = (r2[j] - s2) * inverse
            r3[j] = (r3[j] - s3) * inverse
            i += 4
        while i < size:
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * row[k]
            matrix[i, j] = total * inverse
            i += 1
    return True


@compiled
def solve(matrix: Any, rhs: Any) -> Any:
    """Solve in place by Cholesky's factors; False where the matrix is not positive definite."""
    if not factor(matrix):
        return False
    size = len(rhs)
    for i in range(size):
        for k in range(i):
            rhs[i] -= matrix[i, k] * rhs[k]
        rhs[i] /= matrix[i, i]
    for i in range(size - 1, -1, -1):
        rhs[i] /= matrix[i, i]
        for k in range(i):
            rhs[k] -= matrix[i, k] * rhs[i]
    return True


@compiled_briefly
def forward(lower: Any, rows: Any) -> None:
    """Every row x becomes the solution y of ``lower`` y = x; entries past its size stay. Rows in multiples of 6."""
    size = len(lower)
    for p in range(0, len(rows), 6):
        x0, x1, x2, x3, x4, x5 = rows[p], rows[p + 1], rows[p + 2], rows[p + 3], rows[p + 4], rows[p + 5]
        if size % 2:
            for x in (x0, x1, x2, x3, x4, x5):
                x[0] /= lower[0, 0]
        for i in range(size % 2, size, 2):  # two unknowns at a time share the loads
            row, next_row = lower[i], lower[i + 1]
            s0 = s1 = s2 = s3 = s4 = s5 = 0.0
            t0 = t1 = t2 = t3 = t4 = t5 = 0.0
            for k in range(i):
                f, g = row[k], next_row[k]
                s0 += f * x0[k]
                s1 += f * x1[k]
                s2 += f * x2[k]
                s3 += f * x3[k]
                s4 += f * x4[k]
                s5 += f * x5[k]
                t0 += g * x0[k]
                t1 += g * x1[k]
                t2 += g * x2[k]
                t3 += g * x3[k]
                t4 += g * x4[k]
                t5 += g * x5[k]
            a, b, c = 1.0 / row[i], 1.0 / next_row[i + 1], next_row[i]
            for x, s, t in ((x0, s0, t0), (x1, s1, t1), (x2, s2, t2), (x3, s3, t3), (x4, s4, t4), (x5, s5, t5)):
                x[i] = (x[i] - s) * a
                x[i + 1] = (x[i + 1] - t - c * x[i]) * b
