"""The detections' noise as a judge should see it: what residuals show, made good for what the unknowns took up of it.

A solver that fits N cameras and J points to few detections meets them better than it should. The noise per axis is
S^2 = (R + f S0^2) / (D + f), with R the inliers' summed squares, D the measurements less the unknowns, and S0 the noise
of common detectors, believed as if f degrees of freedom had shown it (the mean of an inverse gamma posterior). What is
still unknown of S itself makes intervals wider, as Student's t is wider than a normal.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from kronc_ns.solve.problem import Problem

_COMMON = 0.002
"""Of the image diagonal: the noise of common detectors."""
_FREEDOM = 4.0
"""Degrees of freedom that the common noise is worth."""
_NORMAL = 1.959964
"""Half width of the normal interval that holds 95 %."""


@dataclass(frozen=True)
class Noise:
    """Of detections."""

    sigma_px: float
    """Standard deviation along one axis."""
    widening: float
    """How many times wider an interval is because ``sigma_px`` is itself but estimated."""
    freedom: int
    """Measurements less unknowns; below 1 nothing is left to check a fit by."""


def believed_noise(
    problem: Problem, error_px: Float[np.ndarray, "n j"], inlier: Bool[np.ndarray, "n j"], diagonal_px: float
) -> Noise:
    """The noise of a fit's inliers; detections of points that no other view sees are met anyhow and do not count."""
    counted = inlier & (inlier.sum(0) >= 2)
    unknown = 6 * int(counted.any(1).sum()) + 3 * int(counted.any(0).sum()) - 7
    unknown += problem.lenses * len(problem.refine)
    freedom = 2 * int(counted.sum()) - unknown
    squares = float((problem.weight[counted] * np.square(error_px[counted])).sum())
    return posterior(squares, freedom, diagonal_px)


def posterior(squares_px: float, freedom: int, diagonal_px: float) -> Noise:
    """The noise of a fit with so many degrees of freedom whose inliers have these summed squares."""
    known = max(freedom, 0) + _FREEDOM
    sigma_px = math.sqrt((squares_px + _FREEDOM * (_COMMON * diagonal_px) ** 2) / known)
    return Noise(sigma_px, _student(known) / _NORMAL, freedom)


def _student(freedom: float) -> float:
    """Half width of Student's interval that holds 95 % (Cornish and Fisher's expansion, good to 1 % from 4 on)."""
    z = _NORMAL
    return z + (z**3 + z) / (4 * freedom) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * freedom**2)
