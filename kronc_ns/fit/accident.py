"""Whether a wrong pose could meet a view's detections by accident."""

import numpy as np
from jaxtyping import Float

_BENT = 3
"""Detections that a pose can always be bent to meet."""
_LEAST_PX = 1e-3
"""Of an error: none is known better."""


def accidents(
    error_px: Float[np.ndarray, "n j"], box_px: Float[np.ndarray, "n"], noise_px: float
) -> Float[np.ndarray, "n"]:
    """Decimal logarithm of how many poses would be expected to meet a view's detections as well, if these lay anywhere.

    The number of false alarms of a contrario RANSAC (Moulon, Monasse and Marlet, ACCV 2012): of n detections every
    three give a pose, and each other one lies within e of its place by chance with probability pi e^2 over the area of
    their box; over the k best, for the k that are the least likely. ``error_px`` are reprojection errors, NaN where
    there is no detection, errors below the noise counting as that; ``box_px`` are areas. Infinite where fewer than four
    detections are met at all.
    """
    count, most = (~np.isnan(error_px)).sum(1), error_px.shape[1]
    floor = max(noise_px, _LEAST_PX)
    reach = np.sort(np.where(np.isnan(error_px), np.inf, np.maximum(error_px, floor)), axis=1)[:, _BENT:]
    met = np.broadcast_to(np.arange(_BENT + 1, most + 1), reach.shape)
    finite = np.isfinite(reach)
    n = np.where(finite, count[:, None], met)
    area = np.pi * np.where(finite, reach, 1.0) ** 2
    share = np.where(finite, np.minimum(area / np.maximum(box_px, _LEAST_PX)[:, None], 1.0), 1.0)
    factorial = np.concatenate([[0.0], np.cumsum(np.log10(np.arange(1, most + 1)))])
    choices = factorial[n] - factorial[n - met] - factorial[met - _BENT] - factorial[_BENT]  # of k among n, 3 among k
    alarms = np.log10(n - _BENT) + choices + (met - _BENT) * np.log10(share)
    return np.where(finite, alarms, np.inf).min(1, initial=np.inf)
