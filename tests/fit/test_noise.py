"""The detections' noise, made good for what the unknowns took up of it."""

import math

import numpy as np
import pytest
from scipy.stats import t as student

from kronc_ns.fit.attempts import adjust_starts
from kronc_ns.fit.noise import believed_noise
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.starts import start_from_poses
from kronc_ns.solve.problem import Problem
from kronc_ns.synthetic.scenes import make_capture
from tests.conftest import scene_of

DIAGONAL_PX = 500.0


def fitted(views: int, points: int, squares: float):
    """The noise of a fit with residuals of equal length that sum to ``squares``."""
    inlier = np.ones((views, points), dtype=bool)
    error = np.full((views, points), math.sqrt(squares / inlier.sum()))
    return believed_noise(
        Problem(np.zeros((views, points, 2)), np.ones((views, points)), (1.0, 1.0)), error, inlier, DIAGONAL_PX
    )


def test_the_freedom_is_measurements_less_unknowns():
    assert fitted(10, 30, 1.0).freedom == 2 * 300 - 6 * 10 - 3 * 30 + 7


def test_with_much_freedom_it_is_what_the_residuals_show():
    noise = fitted(100, 60, 1e5)
    assert noise.sigma_px == pytest.approx(math.sqrt(1e5 / noise.freedom), rel=1e-2)
    assert noise.widening == pytest.approx(1.0, abs=1e-3)


def test_with_none_it_is_that_of_common_detectors():
    """Two views of four points: any fit is perfect, and says nothing of the noise."""
    noise = fitted(2, 4, 0.0)
    assert noise.freedom <= 0
    assert noise.sigma_px == pytest.approx(0.002 * DIAGONAL_PX)


@pytest.mark.parametrize(("views", "points"), [(4, 10), (3, 20), (10, 10), (20, 30)])
def test_intervals_are_as_wide_as_students(views, points):
    noise = fitted(views, points, 100.0)
    expected = student.ppf(0.975, noise.freedom + 4) / student.ppf(0.975, 1e9)
    assert noise.widening == pytest.approx(expected, rel=0.01)


def test_points_of_a_single_view_do_not_count():
    inlier = np.zeros((3, 20), dtype=bool)
    inlier[:, :10] = True
    problem = Problem(np.zeros((3, 20, 2)), np.ones((3, 20)), (1.0, 1.0))
    error = np.ones((3, 20))
    alone = inlier.copy()
    alone[0, 10:] = True
    assert believed_noise(problem, error, alone, 1.0) == believed_noise(problem, error, inlier, 1.0)


def test_few_views_show_the_noise_that_they_have():
    """Six views of 2 px: what the solver's residuals show is far less, what is believed is about that."""
    shown, believed = [], []
    for seed in range(8):
        capture = make_capture("walk", views=6, seed=seed, noise_px=2.0)
        scene = scene_of(capture, capture.c2w)
        (attempt,) = adjust_starts([start_from_poses("given", "given", scene, capture.c2w)], KroncConfig())
        shown.append(attempt.sigma_px)
        believed.append(attempt.noise.sigma_px)
    assert np.mean(shown) < 1.7
    assert np.sqrt(np.mean(np.square(believed))) == pytest.approx(2.0, rel=0.15)
