"""Robust losses by iteratively reweighted least squares (IRLS): each one's weight and cost, the noise, the phases.

Lengths are those of weighted residuals in pixels; ``sigma`` is the noise per axis. Formulas serve numbers in compiled
loops and tensors alike. With the Cauchy loss its scale follows the residuals down (graduated robustness) and at last
what is beyond `INLIER_SIGMAS` is left out and the rest counts in squares: maximum likelihood without outliers.
"""

import math
from typing import Any

import numpy as np
from jaxtyping import Float
from numba.extending import overload
from typing_extensions import assert_never

from kronc_ns.solve.compiled import compiled, compiled_briefly, formula
from kronc_ns.solve.options import Loss

INLIER_SIGMAS = 4.5
"""A detection is an inlier up to here; one good one in 25,000 lies farther out."""
SIGMA_FLOOR_PX = 0.05
"""Less noise is believed of no detector."""
RAYLEIGH_MEDIAN = 1.1774
"""Median length of 2D normal noise, in standard deviations per axis."""
CAUCHY_SIGMAS = 3.0
HUBER_SIGMAS = 2.0
REDUNDANCY_MOST = 1.6
"""Residuals are believed to show so many times less than the noise, at most."""

CAUCHY, TRIMMED, HUBER, SQUARES = 0, 1, 2, 3
"""Phases: the graduated Cauchy loss, trimmed squares after it; Huber's loss, or squares, throughout."""
COARSE = 1e-2
"""Tolerance of the graduated phase: the share of the cost that the next step may still gain."""
LOOSE = 0.7
"""A scale that lags behind the residuals by more than this goes on with the graduated phase."""
ROUNDS = 8
"""Most changes of phase."""


def first_phase(loss: Loss) -> int:
    """The phase that a loss begins with."""
    match loss:
        case "cauchy":
            return CAUCHY
        case "huber":
            return HUBER
        case "none":
            return SQUARES
        case _:
            assert_never(loss)


def noise_px(lengths: Float[np.ndarray, "k"]) -> float:
    """Noise per axis from the (lower) median of residual lengths, NaN where there is none."""
    if not len(lengths):
        return math.nan
    middle = (len(lengths) - 1) // 2
    return max(float(np.partition(lengths, middle)[middle]) / RAYLEIGH_MEDIAN, SIGMA_FLOOR_PX)


def least(a, b):  # numba wants its overload's signature to the letter
    """The smaller, of numbers or of a tensor and a number or tensor."""
    return min(a, b) if isinstance(a, (int, float)) else a.clip(max=b)


@overload(least)
def _least(a, b):
    def implementation(a, b):
        return min(a, b)

    return implementation


@formula
def cauchy_term(length: Any, sigma: Any) -> Any:
    """What the Cauchy loss takes the logarithm of; the inverse is its weight."""
    relative = length * (1.0 / (CAUCHY_SIGMAS * sigma))
    return 1.0 + relative * relative


@formula
def cauchy_cost(logarithm: Any, sigma: Any) -> Any:
    """Cost in squared pixels of detections whose terms have this (summed) logarithm."""
    return CAUCHY_SIGMAS * CAUCHY_SIGMAS * sigma * sigma * logarithm


@formula
def trimmed_cost(length: Any, sigma: Any) -> Any:
    """Squares up to `INLIER_SIGMAS`, constant beyond; the weight is 1 and 0."""
    return least(length * length, INLIER_SIGMAS * INLIER_SIGMAS * sigma * sigma)


@formula
def huber_weight(length: Any, sigma: Any) -> Any:
    """Weight of Huber's loss."""
    return least(HUBER_SIGMAS * sigma / (length + 1e-12), 1.0)


@formula
def huber_cost(length: Any, sigma: Any) -> Any:
    """Huber's loss: squares up to `HUBER_SIGMAS`, linear beyond."""
    near = least(length, HUBER_SIGMAS * sigma)
    return near * (2.0 * length - near)


@formula
def shape_weight(surprise: Any, freedom: Any, size: Any) -> Any:
    """IRLS weight of the shape prior: 1 for a usual shape, falling like a Student t's for an unusual one."""
    return least((freedom + size) / (freedom + surprise), 1.0)


@formula
def shape_excess(surprise: Any, freedom: Any, size: Any) -> Any:
    """(surprise that counts in full, argument of the logarithm of the rest): the prior's cost is the first plus
    (freedom + size) times the second's logarithm.
    """
    usual = least(surprise, 1.0 * size)
    return usual, (freedom + size + (surprise - usual)) / (freedom + size)


@formula
def spread_px(squares: Any, count: Any, redundancy: Any) -> Any:
    """Noise per axis from the summed squares of so many inliers, before the floor."""
    return (squares / (2.0 * count)) ** 0.5 * redundancy


def gain(cost: Any, proposed: Any) -> Any:
    """The share of its cost by which a step changes it."""
    return abs(cost - proposed) / (cost + 1e-12)


def next_gain(last: Any, before: Any) -> Any:
    """What the next step is expected to gain, if gains go on to shrink as from the one ``before`` (0: unknown)."""
    return last * least(last / (before + 1e-12), 1.0)


@compiled_briefly
def weigh(length: Any, own: Any, sigma: Any, phase: Any, out: Any) -> None:
    """IRLS weights times the detections' ``own``."""
    for k in range(len(length)):
        if phase == CAUCHY:
            out[k] = own[k] / cauchy_term(length[k], sigma)
        elif phase == TRIMMED:
            out[k] = own[k] if length[k] <= INLIER_SIGMAS * sigma else 0.0
        elif phase == HUBER:
            out[k] = own[k] * huber_weight(length[k], sigma)
        else:
            out[k] = own[k]


@compiled_briefly
def cost(length: Any, sigma: Any, phase: Any) -> Any:
    """What detections cost together, in squared pixels."""
    total = 0.0
    if phase == CAUCHY:
        for begin in range(0, len(length), 8):  # one logarithm for eight: their product cannot overflow
            product = 1.0
            for k in range(begin, min(begin + 8, len(length))):
                product *= cauchy_term(length[k], sigma)
            total += np.log(product)
        return cauchy_cost(total, sigma)
    for k in range(len(length)):
        if phase == TRIMMED:
            total += trimmed_cost(length[k], sigma)
        elif phase == HUBER:
            total += huber_cost(length[k], sigma)
        else:
            total += length[k] * length[k]
    return total


@compiled_briefly
def noise(length: Any, work: Any) -> Any:
    """`noise_px` of all residuals, 1 where there are none; ``work`` is as long as ``length``."""
    if len(length) == 0:
        return 1.0
    for k in range(len(length)):
        work[k] = length[k]
    median = _select(work, (len(work) - 1) // 2) / RAYLEIGH_MEDIAN
    return max(median, SIGMA_FLOOR_PX) if median < np.inf else 1.0


@compiled_briefly
def next_phase(length: Any, sigma: Any, phase: Any, shrunk: Any, redundancy: Any) -> Any:
    """Phase, sigma and whether it is over, when a phase has settled; ``shrunk`` is the noise that residuals show.

    From the graduated loss to the trimmed squares, and to the end when the choice of inliers stands.
    """
    if phase in (HUBER, SQUARES):
        return phase, sigma, True
    squares, count = 0.0, 0
    for k in range(len(length)):
        if length[k] <= INLIER_SIGMAS * sigma:
            squares += length[k] * length[k]
            count += 1
    spread = min(max(spread_px(squares, max(count, 1), redundancy), SIGMA_FLOOR_PX), shrunk)
    stands = True
    for k in range(len(length)):
        if (length[k] <= INLIER_SIGMAS * sigma) != (length[k] <= INLIER_SIGMAS * spread):
            stands = False
    if spread < LOOSE * sigma:
        return CAUCHY, spread, False
    if phase == CAUCHY:
        return TRIMMED, sigma, False
    return TRIMMED, spread, stands


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
