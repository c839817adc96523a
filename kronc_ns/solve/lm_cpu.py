"""`lm` with the Cauchy loss compiled for the CPU, one scene after the other; tests hold it against the tensors.

Dense tensor operations are right for a GPU; on a CPU their dispatch and the two thirds of points that a view does not
see cost most of the time. Here the K detections of a scene stand in a row, view by view: those of view n are
``first[n]:first[n + 1]``. P is the number of the points' coordinates, 3J, or 0 where the points are known.

All of it stands in one file, constants too, because numba's cache on disk notices changes of a function's own file
only.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from kronc_ns.solve.compiled import compiled

Array = NDArray[Any]

BEHIND_PX = 1e4
"""Residual of a point behind its camera: an outlier to every robust loss."""
NEAR = 1e-6
"""Smallest z that is "in front", in world units."""
TINY = 1e-12
"""Diagonal entries up to this say nothing; their unknowns stay where they are."""
RAYLEIGH_MEDIAN = 1.1774
"""Median norm of 2D normal noise, in standard deviations per axis."""
CAUCHY_SIGMAS = 3.0
TRIM_SIGMAS = 4.5
"""One good detection in 25,000 lies farther out."""
SIGMA_FLOOR_PX = 0.05
COARSE = 1e-2
"""Tolerance of the graduated phase."""
LOOSE = 0.7
"""A scale that lags behind the residuals by more than this goes on with the robust phase."""
ROUNDS = 8
START_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-9, 1e9
ROBUST, TRIMMED = 0, 1


def adjust_scenes(
    rotation: Array,  # in and out [B, N, 3, 3]
    translation: Array,  # in and out [B, N, 3]
    points: Array,  # in and out [B, J, 3]
    uv: Array,  # [B, N, 2, J]
    weight: Array,  # [B, N, J]
    focal: Array,  # [B, 2]
    redundancy: Array,  # [B]
    most_sigma: Array,  # [B]
    mean: Array,  # [3J] of the shape prior
    precision: Array,  # [3J, 3J] of the shape prior; [0, 0] without one
    freedom: float,
    points_known: bool,
    iterations: int,
    tolerance: float,
    inlier: Array,  # out [B, N, J]
    losses: Array,  # out [B, iterations], cost after every step
    rotations: Array,  # out [B, S, N, 3, 3], the first S steps
    translations: Array,  # out [B, S, N, 3]
) -> Array:
    """`lm.adjust` of every scene: rows of sigma, cost in squared pixels, shape weight, steps, converged."""
    found = np.empty((len(uv), 5))
    for b in range(len(uv)):
        found[b] = _adjust(
            rotation[b], translation[b], points[b], uv[b], weight[b], focal[b], redundancy[b], most_sigma[b], mean,
            precision, freedom, points_known, iterations, tolerance, inlier[b], losses[b],
            rotations[b], translations[b],
        )  # fmt: skip
    return found.T


def camera_covariances(
    rotation: Array,  # [B, N, 3, 3]
    translation: Array,  # [B, N, 3]
    points: Array,  # [B, J, 3]
    uv: Array,  # [B, N, 2, J]
    weight: Array,  # [B, N, J], 0 for outliers
    focal: Array,  # [B, 2]
    damping: float,
    variance: Array,  # [B], of the inliers
    strength: Array,  # [B], weight of the shape prior
    precision: Array,  # [3J, 3J] of the shape prior; [0, 0] without one
    trace: float,
    covariance: Array,  # out [B, N, 6, 6]
) -> None:
    """`uncertainty.camera_covariance` of every scene."""
    views, size = rotation.shape[1], 3 * points.shape[1]
    matrix, rhs, pull = np.empty((size, size)), np.empty(size), np.zeros(size)
    whitener = np.empty((views, 6, 6))
    for b in range(len(uv)):
        first, joint, measured, own = detections(uv[b], weight[b])
        seen, error, norm = np.empty((len(joint), 3)), np.empty((len(joint), 2)), np.empty(len(joint))
        project(rotation[b], translation[b], points[b], first, joint, measured, own, focal[b], seen, error, norm)
        whitened = np.zeros((views, 6, size + 1))
        reduce_system(
            rotation[b], first, joint, seen, error, own, focal[b], damping, strength[b], precision, pull,
            whitener, whitened, matrix, rhs,
        )  # fmt: skip
        gauge, inverse, mean = _gauge(points[b], joint, trace)
        _relative_covariances(
            rotation[b], translation[b], mean, gauge, inverse, matrix, whitener, whitened, variance[b], covariance[b]
        )


@compiled
def _relative_covariances(
    rotation: Any, translation: Any, mean: Any, gauge: Any, inverse: Any, matrix: Any, whitener: Any, whitened: Any,
    variance: Any, covariance: Any,
) -> None:  # fmt: skip
    """Those of all cameras of a scene; see `uncertainty` for the equations."""
    size = len(matrix)
    stiffness = 0.0
    for i in range(size):
        stiffness += matrix[i, i] / size
    for i in range(size):
        for p in range(7):
            factor = stiffness * gauge[p, i]
            for k in range(i + 1):
                matrix[i, k] += factor * gauge[p, k]
    if not _factor(matrix):
        covariance[:] = np.nan
        return
    _forward(matrix, gauge)
    shared = np.empty((7, 7))
    for p in range(7):
        for q in range(7):
            shared[p, q] = _dot(gauge[p], gauge[q], size)
    for n in range(len(rotation)):
        z = whitened[n]
        _forward(matrix, z)
        _camera_covariance(
            rotation[n], translation[n], mean, whitener[n], z, gauge, shared, inverse, variance, covariance[n]
        )


@compiled
def _gauge(points: Any, joint: Any, trace: Any) -> Any:
    """Orthonormal directions [12, 3J] in which shift, turn and growth of the world move the points that are seen.

    (The last five are 0, for `_forward`.) Also the 7x7 matrix that makes them of the moves, and the points' mean.
    """
    joints = len(points)
    moves, square, inverse, mean = np.zeros((12, 3 * joints)), np.empty((7, 7)), np.empty((7, 7)), np.zeros(3)
    seen, count = np.zeros(joints), 0.0
    for j in joint:
        count += 1.0 - seen[j]
        seen[j] = 1.0
    for j in range(joints):
        for c in range(3):
            mean[c] += seen[j] * points[j, c] / max(count, 1.0)
    for j in range(joints):
        if seen[j] > 0.0:
            x, y, z = points[j, 0] - mean[0], points[j, 1] - mean[1], points[j, 2] - mean[2]
            for c in range(3):
                moves[c, c * joints + j] = 1.0
            moves[3, joints + j], moves[3, 2 * joints + j] = -z, y
            moves[4, j], moves[4, 2 * joints + j] = z, -x
            moves[5, j], moves[5, joints + j] = -y, x
            moves[6, j], moves[6, joints + j], moves[6, 2 * joints + j] = x, y, z
    for p in range(7):
        for q in range(7):
            square[p, q] = _dot(moves[p], moves[q], 3 * joints)
        square[p, p] += trace
    _inverse_factor(square, inverse)
    for p in range(6, -1, -1):
        for i in range(3 * joints):
            moves[p, i] *= inverse[p, p]
        for q in range(p):
            for i in range(3 * joints):
                moves[p, i] += inverse[p, q] * moves[q, i]
    return moves, inverse, mean


@compiled
def _camera_covariance(
    r: Any, t: Any, mean: Any, whitener: Any, z: Any, gauge: Any, shared: Any, inverse: Any, variance: Any,
    out: Any,
) -> None:  # fmt: skip
    """One camera's: W^T W + (W^T Z + motion G^T) (W^T Z + motion G^T)^T, see `uncertainty`."""
    size = gauge.shape[1]
    moved, outer, inner, half = np.zeros((6, 7)), np.zeros((6, 13)), np.zeros((13, 13)), np.empty((6, 13))
    at = np.empty(3)
    for p in range(3):
        at[p] = r[p, 0] * mean[0] + r[p, 1] * mean[1] + r[p, 2] * mean[2] + t[p]
    for p in range(3):
        a, b = (p + 1) % 3, (p + 2) % 3
        for c in range(3):
            moved[p, 3 + c] = -r[p, c]
            moved[3 + p, c] = -r[p, c]
            moved[3 + p, 3 + c] = at[b] * r[a, c] - at[a] * r[b, c]
        moved[3 + p, 6] = at[p]
    for p in range(6):
        for q in range(6):
            outer[p, q] = whitener[q, p]
            inner[p, q] = _dot(z[p], z[q], size)
        inner[p, p] += 1.0
        for q in range(7):
            inner[p, 6 + q] = inner[6 + q, p] = _dot(z[p], gauge[q], size)
            for k in range(q + 1):
                outer[p, 6 + q] += moved[p, k] * inverse[q, k]
    for p in range(7):
        for q in range(7):
            inner[6 + p, 6 + q] = shared[p, q]
    for p in range(6):
        for q in range(13):
            half[p, q] = _dot(outer[p], inner[q], 13)
    for p in range(6):
        for q in range(6):
            # the centre moves by -v (in camera axes) when the translation grows by v
            sign = -1.0 if (p < 3) != (q < 3) else 1.0
            out[p, q] = sign * variance * _dot(half[p], outer[q], 13)


@compiled
def _adjust(
    to_rotation: Any, to_translation: Any, to_points: Any, uv: Any, weight: Any, focal: Any, redundancy: Any,
    most_sigma: Any, mean: Any, precision: Any, freedom: Any, points_known: Any, iterations: Any, tolerance: Any,
    inlier: Any, losses: Any, rotations: Any, translations: Any,
) -> Any:  # fmt: skip
    """One scene: sigma, cost, weight of the shape prior, steps, converged."""
    first, joint, measured, own = detections(uv, weight)
    rotation, translation, points = to_rotation.copy(), to_translation.copy(), to_points.copy()
    count, views, joints = len(joint), len(rotation), len(points)
    size = 0 if points_known else 3 * joints
    seen, error, norm = np.empty((count, 3)), np.empty((count, 2)), np.empty(count)
    trial_seen, trial_error, trial_norm = np.empty((count, 3)), np.empty((count, 2)), np.empty(count)
    trial_rotation, trial_translation = np.empty((views, 3, 3)), np.empty((views, 3))
    trial_points = np.empty((joints, 3))
    irls, work, whitener, unwanted = np.empty(count), np.empty(count), np.empty((views, 6, 6)), np.empty((0, 6, 1))
    matrix, rhs, pull, trial_pull = np.empty((size, size)), np.empty(size), np.empty(size), np.empty(size)
    with_prior = len(precision) > 0 and size > 0
    surprise = trial_surprise = 0.0

    project(rotation, translation, points, first, joint, measured, own, focal, seen, error, norm)
    if with_prior:
        surprise = _surprise(points, mean, precision, pull)
    sigma = min(_robust_sigma(norm, work) * redundancy, most_sigma)
    phase, rounds, damping = ROBUST, 0, START_DAMPING
    cost = _cost(norm, sigma, phase, surprise, freedom, size if with_prior else 0)
    step = 0
    done = False
    while step < iterations and not done:
        step += 1
        _weigh(norm, sigma, phase, own, irls)
        strength = sigma * sigma * min(1.0, (freedom + size) / (freedom + surprise)) if with_prior else 0.0
        reduce_system(
            rotation, first, joint, seen, error, irls, focal, damping, strength, precision, pull,
            whitener, unwanted, matrix, rhs,
        )  # fmt: skip
        trial_cost = np.nan
        if _solve(matrix, rhs):
            _move(
                rotation, translation, points, first, joint, seen, error, irls, focal, whitener, rhs,
                trial_rotation, trial_translation, trial_points,
            )  # fmt: skip
            project(
                trial_rotation, trial_translation, trial_points, first, joint, measured, own, focal,
                trial_seen, trial_error, trial_norm,
            )  # fmt: skip
            if with_prior:
                trial_surprise = _surprise(trial_points, mean, precision, trial_pull)
            trial_cost = _cost(trial_norm, sigma, phase, trial_surprise, freedom, size if with_prior else 0)
        limit = COARSE if phase == ROBUST else tolerance
        settled = abs(cost - trial_cost) <= limit * cost  # false for NaN, as is the next
        if trial_cost < cost:
            rotation, trial_rotation = trial_rotation, rotation
            translation, trial_translation = trial_translation, translation
            points, trial_points = trial_points, points
            seen, trial_seen = trial_seen, seen
            error, trial_error = trial_error, error
            norm, trial_norm = trial_norm, norm
            pull, trial_pull = trial_pull, pull
            surprise, cost = trial_surprise, trial_cost
            damping = max(damping / 10, LEAST_DAMPING)
        else:
            damping *= 10
        settled = settled or damping > MOST_DAMPING
        damping = min(damping, MOST_DAMPING)
        if phase == ROBUST or settled:
            # follow the residuals with the scale of the loss
            shrunk = min(sigma, _robust_sigma(norm, work) * redundancy)
            if phase == ROBUST:
                sigma = shrunk
            if settled:
                rounds += 1
                phase, sigma, done = _next_phase(norm, sigma, phase, shrunk, redundancy)
                done = done or rounds >= ROUNDS
            cost = _cost(norm, sigma, phase, surprise, freedom, size if with_prior else 0)
        losses[step - 1] = cost
        if step <= len(rotations):
            _copy_poses(rotation, translation, rotations[step - 1], translations[step - 1])
    usual = min(1.0, (freedom + size) / (freedom + surprise)) if with_prior else 1.0
    _copy_poses(rotation, translation, to_rotation, to_translation)
    for n in range(views):
        for k in range(first[n], first[n + 1]):
            inlier[n, joint[k]] = norm[k] <= TRIM_SIGMAS * sigma
    for j in range(joints):
        for c in range(3):
            to_points[j, c] = points[j, c]
    return sigma, cost, usual, float(step), 1.0 if done else 0.0


@compiled
def _copy_poses(rotation: Any, translation: Any, to_rotation: Any, to_translation: Any) -> None:
    for n in range(len(rotation)):
        for p in range(3):
            to_translation[n, p] = translation[n, p]
            for q in range(3):
                to_rotation[n, p, q] = rotation[n, p, q]


@compiled
def _next_phase(norm: Any, sigma: Any, phase: Any, shrunk: Any, redundancy: Any) -> Any:
    """From the graduated loss to the trimmed squares, and to the end when the choice of inliers stands."""
    total, found = 0.0, 0
    for k in range(len(norm)):
        if norm[k] <= TRIM_SIGMAS * sigma:
            total += norm[k] * norm[k]
            found += 1
    spread = min(max(np.sqrt(total / (2 * max(found, 1))) * redundancy, SIGMA_FLOOR_PX), shrunk)
    stands = True
    for k in range(len(norm)):
        if (norm[k] <= TRIM_SIGMAS * sigma) != (norm[k] <= TRIM_SIGMAS * spread):
            stands = False
    if spread < LOOSE * sigma:
        return ROBUST, spread, False
    if phase == ROBUST:
        return TRIMMED, sigma, False
    return TRIMMED, spread, stands


@compiled
def _robust_sigma(norm: Any, work: Any) -> Any:
    """Noise per axis from the (lower) median of all residuals; ``work`` is as long as ``norm``."""
    if len(norm) == 0:
        return 1.0
    for k in range(len(norm)):
        work[k] = norm[k]
    median = _select(work, (len(work) - 1) // 2) / RAYLEIGH_MEDIAN
    return max(median, SIGMA_FLOOR_PX) if median < np.inf else 1.0


@compiled
def _select(values: Any, rank: Any) -> Any:
    """The value of the given rank, by Hoare's selection; reorders ``values``."""
    low, high = 0, len(values) - 1
    while low < high:
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if rank <= j:
            high = j
        elif rank >= i:
            low = i
        else:
            break
    return values[rank]


@compiled
def _weigh(norm: Any, sigma: Any, phase: Any, own: Any, irls: Any) -> None:
    """IRLS weights times the detections' own."""
    inverse = 1.0 / (CAUCHY_SIGMAS * sigma)
    for k in range(len(norm)):
        if phase == ROBUST:
            relative = norm[k] * inverse
            irls[k] = own[k] / (1.0 + relative * relative)
        else:
            irls[k] = own[k] if norm[k] <= TRIM_SIGMAS * sigma else 0.0


@compiled
def _cost(norm: Any, sigma: Any, phase: Any, surprise: Any, freedom: Any, size: Any) -> Any:
    """What is minimised, in squared pixels; ``size`` is 0 without a shape prior."""
    total = 0.0
    if phase == ROBUST:
        scale = CAUCHY_SIGMAS * CAUCHY_SIGMAS * sigma * sigma
        for begin in range(0, len(norm), 8):  # one logarithm for eight: their product cannot overflow
            product = 1.0
            for k in range(begin, min(begin + 8, len(norm))):
                product *= 1.0 + norm[k] * norm[k] / scale
            total += np.log(product)
        total *= scale
    else:
        most = TRIM_SIGMAS * TRIM_SIGMAS * sigma * sigma
        for k in range(len(norm)):
            square = norm[k] * norm[k]
            total += most if square > most else square
    if size:
        tail = np.log(max(freedom + surprise, freedom + size) / (freedom + size)) * (freedom + size)
        total += sigma * sigma * (min(surprise, size) + tail)
    return total


@compiled
def _surprise(points: Any, mean: Any, precision: Any, pull: Any) -> Any:
    """Squared Mahalanobis distance of the points; ``pull`` [3J] becomes half its gradient."""
    joints = len(points)
    deviation = np.empty(3 * joints)
    for c in range(3):
        for j in range(joints):
            deviation[c * joints + j] = points[j, c] - mean[c * joints + j]
    total = 0.0
    for i in range(3 * joints):
        pull[i] = 0.0
        for k in range(3 * joints):
            pull[i] += precision[i, k] * deviation[k]
        total += pull[i] * deviation[i]
    return total


@compiled
def detections(uv: Any, weight: Any) -> Any:
    """Row of the detections of uv [N, 2, J] with weight [N, J] > 0: first [N + 1], joint [K], uv [K, 2], weight [K]."""
    views, joints = weight.shape
    first = np.zeros(views + 1, np.int64)
    count = 0
    for n in range(views):
        for j in range(joints):
            count += weight[n, j] > 0.0
    joint, measured, own = np.empty(count, np.int64), np.empty((count, 2)), np.empty(count)
    k = 0
    for n in range(views):
        for j in range(joints):
            if weight[n, j] > 0.0:
                joint[k], measured[k, 0], measured[k, 1], own[k] = j, uv[n, 0, j], uv[n, 1, j], weight[n, j]
                k += 1
        first[n + 1] = k
    return first, joint, measured, own


@compiled
def project(
    rotation: Any,  # [N, 3, 3]
    translation: Any,  # [N, 3]
    points: Any,  # [J, 3]
    first: Any,  # [N + 1]
    joint: Any,  # [K]
    measured: Any,  # [K, 2]
    own: Any,  # [K]
    focal: Any,  # [2]
    seen: Any,  # out [K, 3]: normalised image coordinates, 1 / z
    error: Any,  # out [K, 2]: projection minus detection in pixels; 0 behind the camera
    norm: Any,  # out [K]: its weighted length; BEHIND_PX behind the camera
) -> None:
    """`bundle.residuals` without intrinsics."""
    for n in range(len(rotation)):
        r, t = rotation[n], translation[n]
        for k in range(first[n], first[n + 1]):
            j = joint[k]
            x, y, z = points[j, 0], points[j, 1], points[j, 2]
            depth = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + t[2]
            inverse = 1.0 / max(depth, NEAR)
            u = (r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + t[0]) * inverse
            v = (r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + t[1]) * inverse
            seen[k, 0], seen[k, 1], seen[k, 2] = u, v, inverse
            error[k, 0] = error[k, 1] = 0.0
            norm[k] = BEHIND_PX
            if not depth < NEAR:
                du, dv = focal[0] * u - measured[k, 0], focal[1] * v - measured[k, 1]
                error[k, 0], error[k, 1] = du, dv
                norm[k] = np.sqrt(own[k] * (du * du + dv * dv))


@compiled
def reduce_system(
    rotation: Any,  # [N, 3, 3]
    first: Any,  # [N + 1]
    joint: Any,  # [K]
    seen: Any,  # [K, 3], from `project`
    error: Any,  # [K, 2], from `project`
    weight: Any,  # [K], IRLS weights times the detections' own
    focal: Any,  # [2]
    damping: Any,
    strength: Any,  # weight of the shape prior
    precision: Any,  # [3J, 3J], its inverse covariance; [0, 0] without one
    pull: Any,  # [P], half its gradient
    whitener: Any,  # out [N, 6, 6]: inverse Cholesky factors of the cameras' blocks
    whitened: Any,  # out [N, 6, P + 1], zeros: cameras against points, and their gradient; [0, ...] if not wanted
    matrix: Any,  # out [P, P], lower triangle
    rhs: Any,  # out [P]
) -> None:
    """`bundle.linearise` and `bundle.eliminate_cameras` in one pass over the detections."""
    size = len(rhs)
    joints = size // 3
    most = 0
    for n in range(len(rotation)):
        most = max(most, first[n + 1] - first[n])
    a, rows, off = np.empty((6, 2 * most)), np.empty((3, 2 * most)), np.empty(2 * most)
    camera, right = np.empty((6, 6)), np.empty(6)
    columns = np.empty(3 * most, np.uint64)  # unsigned: else every access asks whether it counts from the end
    mixed, y, dots = np.empty((6, 3 * most)), np.empty((6, 3 * most)), np.empty((2, 3 * most))
    diagonal = np.empty(size)
    with_prior = len(precision) > 0
    for i in range(size):
        for k in range(i + 1):
            matrix[i, k] = strength * precision[i, k] if with_prior else 0.0
        rhs[i] = -strength * pull[i] if with_prior else 0.0
        diagonal[i] = matrix[i, i]
    for n in range(len(rotation)):
        begin, count = first[n], first[n + 1] - first[n]
        _rows(seen[begin:], error[begin:], weight[begin:], focal, rotation[n], count, a, rows, off)
        for p in range(6):
            right[p] = _dot(a[p], off, 2 * count)
            for q in range(p + 1):
                camera[p, q] = _dot(a[p], a[q], 2 * count)
            camera[p, p] = _damped(camera[p, p], damping)
        w = whitener[n]
        _inverse_factor(camera, w)
        width = 3 * count if size else 0
        if width:
            for c in range(3):
                for k in range(count):
                    columns[c * count + k] = c * joints + joint[begin + k]
                for p in range(6):
                    into = mixed[p, c * count :]
                    for k in range(count):
                        into[k] = a[p, k] * rows[c, k] + a[p, count + k] * rows[c, count + k]
                for k in range(count):
                    i = columns[c * count + k]
                    rhs[i] -= rows[c, k] * off[k] + rows[c, count + k] * off[count + k]
                    diagonal[i] += rows[c, k] * rows[c, k] + rows[c, count + k] * rows[c, count + k]
                    for d in range(c + 1):
                        square = rows[c, k] * rows[d, k] + rows[c, count + k] * rows[d, count + k]
                        matrix[i, columns[d * count + k]] += square
        for p in range(6):
            for i in range(width):
                y[p, i] = 0.0
            total = 0.0
            for q in range(p + 1):
                factor = w[p, q]
                total += factor * right[q]
                for i in range(width):
                    y[p, i] += factor * mixed[q, i]
            for i in range(width):
                rhs[columns[i]] += y[p, i] * total
            if n < len(whitened):
                whitened[n, p, size] = total
                for i in range(width):
                    whitened[n, p, columns[i]] = y[p, i]
        # two rows at a time share the loads; the last row of an odd width is computed twice
        for i in range(0, width, 2):
            m = min(i + 1, width - 1)
            y0, y1, y2, y3, y4, y5 = y[0, i], y[1, i], y[2, i], y[3, i], y[4, i], y[5, i]
            z0, z1, z2, z3, z4, z5 = y[0, m], y[1, m], y[2, m], y[3, m], y[4, m], y[5, m]
            for k in range(m + 1):
                x0, x1, x2, x3, x4, x5 = y[0, k], y[1, k], y[2, k], y[3, k], y[4, k], y[5, k]
                dots[0, k] = y0 * x0 + y1 * x1 + y2 * x2 + y3 * x3 + y4 * x4 + y5 * x5
                dots[1, k] = z0 * x0 + z1 * x1 + z2 * x2 + z3 * x3 + z4 * x4 + z5 * x5
            upper, lower = matrix[columns[i]], matrix[columns[m]]
            for k in range(i + 1):
                upper[columns[k]] -= dots[0, k]
            if m > i:
                for k in range(m + 1):
                    lower[columns[k]] -= dots[1, k]
    for i in range(size):
        matrix[i, i] += _damped(diagonal[i], damping) - diagonal[i]


@compiled
def _move(
    rotation: Any, translation: Any, points: Any, first: Any, joint: Any, seen: Any, error: Any, weight: Any,
    focal: Any, whitener: Any, change: Any, to_rotation: Any, to_translation: Any, to_points: Any,
) -> None:  # fmt: skip
    """The rest of `bundle.solve_step`, and `bundle.move`: each camera's step for the points' change, all applied."""
    most = 0
    for n in range(len(rotation)):
        most = max(most, first[n + 1] - first[n])
    a, rows, off = np.empty((6, 2 * most)), np.empty((3, 2 * most)), np.empty(2 * most)
    right, step, turn = np.empty(6), np.empty(6), np.empty((3, 3))
    joints = len(change) // 3
    for j in range(len(points)):
        for c in range(3):
            to_points[j, c] = points[j, c] + (change[c * joints + j] if joints else 0.0)
    for n in range(len(rotation)):
        r, t, w = rotation[n], translation[n], whitener[n]
        begin, count = first[n], first[n + 1] - first[n]
        _rows(seen[begin:], error[begin:], weight[begin:], focal, r, count, a, rows, off)
        if joints:
            for k in range(count):
                for c in range(3):
                    moved = change[c * joints + joint[begin + k]]
                    off[k] += rows[c, k] * moved
                    off[count + k] += rows[c, count + k] * moved
        for p in range(6):
            right[p] = _dot(a[p], off, 2 * count)
        for p in range(6):
            step[p] = total = 0.0
            for q in range(p + 1):
                total += w[p, q] * right[q]
            for q in range(p + 1):
                step[q] -= w[p, q] * total
        _exponential(step, turn)
        for p in range(3):
            to_translation[n, p] = turn[p, 0] * t[0] + turn[p, 1] * t[1] + turn[p, 2] * t[2] + step[3 + p]
            for c in range(3):
                to_rotation[n, p, c] = turn[p, 0] * r[0, c] + turn[p, 1] * r[1, c] + turn[p, 2] * r[2, c]


@compiled
def _rows(seen: Any, error: Any, weight: Any, focal: Any, r: Any, count: Any, a: Any, rows: Any, off: Any) -> None:
    """Derivatives of the first ``count`` weighted projections, along x and then along y, and the errors themselves.

    By the camera, a [6, 2 count], and by the point, rows [3, 2 count]; off [2 count].
    """
    for k in range(count):
        u, v, near, root = seen[k, 0], seen[k, 1], seen[k, 2], np.sqrt(weight[k])
        along, down, m = root * focal[0], root * focal[1], count + k
        a[0, k], a[1, k], a[2, k] = -along * u * v, along * (1.0 + u * u), -along * v
        a[3, k], a[4, k], a[5, k] = along * near, 0.0, -along * u * near
        a[0, m], a[1, m], a[2, m] = -down * (1.0 + v * v), down * u * v, down * u
        a[3, m], a[4, m], a[5, m] = 0.0, down * near, -down * v * near
        off[k], off[m] = root * error[k, 0], root * error[k, 1]
        for c in range(3):
            rows[c, k] = along * near * (r[0, c] - u * r[2, c])
            rows[c, m] = down * near * (r[1, c] - v * r[2, c])


@compiled
def _dot(x: Any, y: Any, count: Any) -> Any:
    """Sum of products of the first ``count`` entries."""
    total = 0.0
    for k in range(count):
        total += x[k] * y[k]
    return total


@compiled
def _damped(entry: Any, damping: Any) -> Any:
    """A diagonal entry with Marquardt's damping, kept off zero."""
    return (1.0 + damping) * (1.0 if entry <= TINY else entry)


@compiled
def _exponential(w: Any, out: Any) -> None:
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
def _inverse_factor(matrix: Any, out: Any) -> None:
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


@compiled
def _factor(matrix: Any) -> Any:
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
def _solve(matrix: Any, rhs: Any) -> Any:
    """Solve in place by Cholesky's factors; False where the matrix is not positive definite."""
    if not _factor(matrix):
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


@compiled
def _forward(factor: Any, rows: Any) -> None:
    """Every row x becomes the solution y of ``factor`` y = x; entries past its size stay. Rows in multiples of 6."""
    for p in range(0, len(rows), 6):
        x0, x1, x2, x3, x4, x5 = rows[p], rows[p + 1], rows[p + 2], rows[p + 3], rows[p + 4], rows[p + 5]
        for i in range(len(factor)):
            row, inverse = factor[i], 1.0 / factor[i, i]
            s0 = s1 = s2 = s3 = s4 = s5 = 0.0
            for k in range(i):
                f = row[k]
                s0 += f * x0[k]
                s1 += f * x1[k]
                s2 += f * x2[k]
                s3 += f * x3[k]
                s4 += f * x4[k]
                s5 += f * x5[k]
            x0[i] = (x0[i] - s0) * inverse
            x1[i] = (x1[i] - s1) * inverse
            x2[i] = (x2[i] - s2) * inverse
            x3[i] = (x3[i] - s3) * inverse
            x4[i] = (x4[i] - s4) * inverse
            x5[i] = (x5[i] - s5) * inverse
