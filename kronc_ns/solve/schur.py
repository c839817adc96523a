"""One step of bundle adjustment with the cameras eliminated, compiled for the CPU.

Only the system of the P other unknowns is factorised: the points' coordinates (3J, or none where they are known) and K
refined intrinsics; so the cost grows linearly with the views. Nothing fixes the gauge. The detections of a scene stand
in a row, view by view: those of view n are ``first[n]:first[n + 1]``. Derivation: docs/solver.md.
"""

import math
from typing import Any

import numpy as np

from kronc_ns.solve.compiled import compiled, compiled_briefly
from kronc_ns.solve.linear import dot, exponential, inverse_factor, solve
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
from kronc_ns.solve.records import Estimate, Measured, System
from kronc_ns.solve.robust import cost, shape_excess, shape_weight, weigh

TINY = 1e-12
"""Diagonal entries up to this say nothing; their unknowns stay where they are."""


@compiled_briefly
def evaluate(data: Measured, now: Estimate) -> None:
    """Reproject all points, and see how unusual they are: everything in ``now`` that follows from its unknowns."""
    for n in range(len(now.rotation)):
        r, t, lens = now.rotation[n], now.translation[n], now.intrinsics[data.lens[n]]
        growth, k1 = np.exp(lens[0]), lens[1]
        fx, fy = data.focal[0] * growth, data.focal[1] * growth
        for k in range(data.first[n], data.first[n + 1]):
            j = data.joint[k]
            x, y, z = now.points[j, 0], now.points[j, 1], now.points[j, 2]
            depth = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + t[2]
            near = 1.0 / max(depth, NEAR)
            u = (r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + t[0]) * near
            v = (r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + t[1]) * near
            now.seen[0, k], now.seen[1, k], now.seen[2, k] = u, v, near
            now.error[0, k] = now.error[1, k] = 0.0
            now.length[k] = BEHIND_PX
            if not depth < NEAR:
                px, py = pixel(u, v, fx, fy, k1)
                dx, dy = px - data.uv[0, k], py - data.uv[1, k]
                now.error[0, k], now.error[1, k] = dx, dy
                now.length[k] = np.sqrt(data.own[k] * (dx * dx + dy * dy))
    if len(data.mean) and not data.points_known:
        joints, total = len(now.points), 0.0
        deviation = np.empty(3 * joints)
        for c in range(3):
            for j in range(joints):
                deviation[c * joints + j] = now.points[j, c] - data.mean[c * joints + j]
        for i in range(3 * joints):
            now.pull[i] = dot(data.precision[i], deviation, 3 * joints)
            total += now.pull[i] * deviation[i]
        now.surprise[0] = total


def total_cost(data: Measured, now: Estimate, sigma: float, phase: int) -> float:
    """What is minimised, in squared pixels: detections and priors."""
    total = cost(now.length, sigma, phase)
    if len(data.mean) and not data.points_known:
        size = len(data.mean)
        usual, rest = shape_excess(float(now.surprise[0]), data.freedom, size)
        total += sigma * sigma * (usual + (data.freedom + size) * math.log(rest))
    if len(data.strength):
        off = now.translation + (now.rotation @ data.centre[..., None])[..., 0]
        total += sigma * sigma * float(data.strength @ np.square(off).sum(1))
    return total


@compiled
def orbit_error(data: Measured, now: Estimate, n: int, c: int) -> Any:
    """Expected minus present centre of camera n along its axis c (it grows with the translation)."""
    r, centre = now.rotation[n], data.centre[n]
    return now.translation[n, c] + r[c, 0] * centre[0] + r[c, 1] * centre[1] + r[c, 2] * centre[2]


def propose(
    data: Measured, now: Estimate, trial: Estimate, work: System, sigma: float, phase: int, damping: float
) -> float:
    """Cost of ``trial``, one damped step ahead of ``now``; NaN where there is no step.

    In Python, since a compiled caller would be compiled together with all that it calls.
    """
    weigh(now.length, data.own, sigma, phase, work.weight)
    belief = 0.0
    if len(data.mean):
        belief = sigma * sigma * shape_weight(float(now.surprise[0]), data.freedom, len(data.mean))
    reduce_system(data, now, work, damping, belief, sigma * sigma)
    if not step(data, now, trial, work):
        return math.nan
    evaluate(data, trial)
    return total_cost(data, trial, sigma, phase)


@compiled
def reduce_system(data: Measured, now: Estimate, work: System, damping: float, belief: float, variance: float) -> None:
    """Normal equations and Schur complement of the cameras in one pass over the detections.

    ``work.weight`` is given; ``belief`` is the weight of the shape prior, ``variance`` that of expected centres.
    """
    matrix, rhs = work.matrix, work.rhs
    size, joints = len(rhs), len(now.points)
    shared = int(data.with_focal) + int(data.with_k1)
    points = size - shared * len(now.intrinsics)
    most = 0
    for n in range(len(now.rotation)):
        most = max(most, data.first[n + 1] - data.first[n])
    a, rows, off = np.empty((6, 2 * most)), np.empty((3, 2 * most)), np.empty(2 * most)
    lens, camera, right = np.empty((2, 2 * most)), np.empty((6, 6)), np.empty(6)
    widest = 3 * most + shared
    columns = np.empty(widest, np.uint64)  # unsigned: else every access asks whether it counts from the end
    mixed, dots = np.empty((6, widest)), np.empty((2, widest))
    diagonal = np.empty(size)
    with_prior = len(data.precision) > 0 and points > 0
    for i in range(size):
        for k in range(i + 1):
            matrix[i, k] = belief * data.precision[i, k] if with_prior and i < points else 0.0
        rhs[i] = -belief * now.pull[i] if with_prior and i < points else 0.0
        diagonal[i] = matrix[i, i]
    for n in range(len(now.rotation)):
        begin, count = data.first[n], data.first[n + 1] - data.first[n]
        fill_rows(data, now, work.weight, n, a, rows, off, lens)
        for p in range(6):
            right[p] = dot(a[p], off, 2 * count)
            for q in range(p + 1):
                camera[p, q] = dot(a[p], a[q], 2 * count)
        if len(data.strength):
            for c in range(3):
                camera[3 + c, 3 + c] += variance * data.strength[n]
                right[3 + c] += variance * data.strength[n] * orbit_error(data, now, n, c)
        for p in range(6):
            camera[p, p] = damped(camera[p, p], damping)
        w = work.whitener[n]
        inverse_factor(camera, w)
        width = 3 * count if points else 0
        if width:
            for c in range(3):
                for k in range(count):
                    columns[c * count + k] = c * joints + data.joint[begin + k]
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
        own = points + shared * data.lens[n]  # of the view's lens
        for s in range(shared):
            row, i = lens[s], own + s
            columns[width + s] = i
            rhs[i] -= dot(row, off, 2 * count)
            for p in range(6):
                mixed[p, width + s] = dot(a[p], row, 2 * count)
            for c in range(3 if width else 0):
                for k in range(count):
                    product = rows[c, k] * row[k] + rows[c, count + k] * row[count + k]
                    matrix[i, columns[c * count + k]] += product
            for d in range(s + 1):
                matrix[i, own + d] += dot(row, lens[d], 2 * count)
            diagonal[i] += dot(row, row, 2 * count)
        width += shared
        y = coupling(data, work, n)
        m0, m1, m2, m3, m4, m5 = mixed[0], mixed[1], mixed[2], mixed[3], mixed[4], mixed[5]
        for p in range(6):
            row, total = y[p], dot(w[p], right, 6)
            w0, w1, w2, w3, w4, w5 = w[p, 0], w[p, 1], w[p, 2], w[p, 3], w[p, 4], w[p, 5]
            for i in range(width):
                row[i] = w0 * m0[i] + w1 * m1[i] + w2 * m2[i] + w3 * m3[i] + w4 * m4[i] + w5 * m5[i]
            for i in range(width):
                rhs[columns[i]] += row[i] * total
            work.gradient[n, p] = total
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
        matrix[i, i] += damped(diagonal[i], damping) - diagonal[i]


@compiled
def coupling(data: Measured, work: System, n: int) -> Any:
    """Six rows of view n against the unknowns that it sees (`System.coupling`)."""
    shared = int(data.with_focal) + int(data.with_k1)
    each = 0 if data.points_known else 3
    begin = 6 * (each * data.first[n] + shared * n)
    width = each * (data.first[n + 1] - data.first[n]) + shared
    return work.coupling[begin : begin + 6 * width].reshape(6, width)


@compiled
def step(data: Measured, now: Estimate, to: Estimate, work: System) -> Any:
    """Solve for the other unknowns, then each camera; False where the system is not positive definite."""
    if not solve(work.matrix, work.rhs):
        return False
    most = 0
    for n in range(len(now.rotation)):
        most = max(most, data.first[n + 1] - data.first[n])
    change, joints = work.rhs, len(now.points)
    points = 0 if data.points_known else 3 * joints
    shared = int(data.with_focal) + int(data.with_k1)
    moved, twist, turn = np.empty(3 * most + shared), np.empty(6), np.empty((3, 3))
    for j in range(joints):
        for c in range(3):
            to.points[j, c] = now.points[j, c] + (change[c * joints + j] if points else 0.0)
    for g in range(len(now.intrinsics)):
        to.intrinsics[g, 0], to.intrinsics[g, 1] = now.intrinsics[g, 0], now.intrinsics[g, 1]
        for s in range(shared):
            to.intrinsics[g, 0 if data.with_focal and s == 0 else 1] += change[points + shared * g + s]
    for n in range(len(now.rotation)):
        r, t, w, y = now.rotation[n], now.translation[n], work.whitener[n], coupling(data, work, n)
        begin, count = data.first[n], data.first[n + 1] - data.first[n]
        width = 3 * count if points else 0
        for c in range(3 if points else 0):
            for k in range(count):
                moved[c * count + k] = change[c * joints + data.joint[begin + k]]
        for s in range(shared):
            moved[width + s] = change[points + shared * data.lens[n] + s]
        for p in range(6):
            twist[p] = 0.0
            total = work.gradient[n, p] + dot(y[p], moved, width + shared)
            for q in range(p + 1):
                twist[q] -= w[p, q] * total
        exponential(twist, turn)
        for p in range(3):
            to.translation[n, p] = turn[p, 0] * t[0] + turn[p, 1] * t[1] + turn[p, 2] * t[2] + twist[3 + p]
            for c in range(3):
                to.rotation[n, p, c] = turn[p, 0] * r[0, c] + turn[p, 1] * r[1, c] + turn[p, 2] * r[2, c]
    return True


@compiled
def fill_rows(data: Measured, now: Estimate, weight: Any, n: int, a: Any, rows: Any, off: Any, lens: Any) -> None:
    """Derivatives of view n's weighted projections, along x and then along y, and the errors themselves.

    By the camera a [6, 2 count], by the point rows [3, 2 count], by the refined intrinsics lens [K, 2 count];
    off [2 count].
    """
    g, r = data.lens[n], now.rotation[n]
    growth, k1 = np.exp(now.intrinsics[g, 0]), now.intrinsics[g, 1]
    fx, fy = data.focal[0] * growth, data.focal[1] * growth
    begin, count = data.first[n], data.first[n + 1] - data.first[n]
    for k in range(count):
        at, m = begin + k, count + k
        u, v, near, root = now.seen[0, at], now.seen[1, at], now.seen[2, at], np.sqrt(weight[at])
        xu, xv, yu, yv = pixel_by_plane(u, v, root * fx, root * fy, k1)
        u0, u1, u2, v0, v1, v2 = plane_by_turn(u, v)
        ux, uz, vy, vz = plane_by_shift(u, v, near)
        a[0, k], a[1, k], a[2, k] = xu * u0 + xv * v0, xu * u1 + xv * v1, xu * u2 + xv * v2
        a[3, k], a[4, k], a[5, k] = xu * ux, xv * vy, xu * uz + xv * vz
        a[0, m], a[1, m], a[2, m] = yu * u0 + yv * v0, yu * u1 + yv * v1, yu * u2 + yv * v2
        a[3, m], a[4, m], a[5, m] = yu * ux, yv * vy, yu * uz + yv * vz
        off[k], off[m] = root * now.error[0, at], root * now.error[1, at]
        for c in range(3):
            du, dv = plane_by_point(u, v, near, r[0, c], r[1, c], r[2, c])
            rows[c, k] = xu * du + xv * dv
            rows[c, m] = yu * du + yv * dv
    if data.with_focal or data.with_k1:
        for k in range(count):
            at, m, s = begin + k, count + k, 0
            u, v, root = now.seen[0, at], now.seen[1, at], np.sqrt(weight[at])
            if data.with_focal:
                lens[0, k], lens[0, m] = pixel(u, v, root * fx, root * fy, k1)
                s = 1
            if data.with_k1:
                lens[s, k], lens[s, m] = pixel_by_k1(u, v, root * fx, root * fy)


@compiled
def damped(entry: Any, damping: Any) -> Any:
    """A diagonal entry with Marquardt's damping, kept off zero."""
    return (1.0 + damping) * (1.0 if entry <= TINY else entry)
