"""How many wrong poses are expected to meet a view's detections by accident."""

import math

import numpy as np
import pytest

from kronc_ns.fit.accident import accidents

BOX_PX, RADIUS_PX = 100.0 * 100.0, 4.0


def log_alarms(n: int, k: int, radius_px: float) -> float:
    """Equation 2 of Moulon, Monasse and Marlet, ACCV 2012, for a sample of three that gives one pose."""
    share = math.pi * radius_px**2 / BOX_PX
    return math.log10((n - 3) * math.comb(n, k) * math.comb(k, 3)) + (k - 3) * math.log10(share)


def test_the_least_likely_number_counts():
    error = np.array([[1.0, 1.0, 1.0, 2.0, 3.0, 3.5, 90.0, np.nan]])
    expected = min(log_alarms(7, k, radius) for k, radius in ((4, 2.0), (5, 3.0), (6, 3.5), (7, 90.0)))
    assert accidents(error, np.array([BOX_PX]), 0.1)[0] == pytest.approx(expected, rel=1e-12)


def test_errors_below_the_noise_count_as_that():
    error = np.array([[0.0] * 6, [2.0] * 6])
    first, second = accidents(error, np.full(2, BOX_PX), 2.0)
    assert first == second == pytest.approx(log_alarms(6, 6, 2.0))


def test_views_without_enough_detections_may_be_anything():
    error = np.array([[0.1, 0.1, 0.1, np.nan], [0.1, 0.1, 0.1, np.inf], [np.nan] * 4])
    for noise_px in (0.1, math.inf):
        assert np.isinf(accidents(error, np.full(3, BOX_PX), noise_px)).all()


def test_what_is_expected_bounds_what_happens():
    """Detections that lie anywhere meet given places no oftener than said: here the three of a sample are given."""
    rng = np.random.default_rng(0)
    n, draws = 9, 400_000
    error = np.zeros((draws, n))
    off = rng.uniform(0, 100, (draws, n - 3, 2)) - rng.uniform(20, 80, (1, n - 3, 2))
    error[:, 3:] = np.hypot(off[..., 0], off[..., 1])
    error[:, :3] = 0.5
    for k in (4, 5):
        share = (np.sort(error, axis=1)[:, k - 1] <= RADIUS_PX).mean()
        of_one_sample = math.comb(n - 3, k - 3) * (math.pi * RADIUS_PX**2 / BOX_PX) ** (k - 3)
        assert share == pytest.approx(of_one_sample, rel=0.2)  # some 150 hits, the least likely of the two
        assert 10 ** log_alarms(n, k, RADIUS_PX) >= of_one_sample * math.comb(n, 3)
