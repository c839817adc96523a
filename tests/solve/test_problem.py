"""What the solver is told: states, priors and how much there is to learn."""

from dataclasses import replace

import numpy as np
import pytest

from kronc_ns.solve.problem import ShapePrior, State
from kronc_ns.solve.robust import REDUNDANCY_MOST
from tests.solve.problems import randn, scene


def test_states_and_poses_are_inverse():
    _, truth = scene()
    again = State.of(truth.c2w, truth.points)
    np.testing.assert_allclose(again.rotation, truth.rotation, atol=1e-15)
    np.testing.assert_allclose(again.translation, truth.translation, atol=1e-14)
    assert (again.log_growth, again.k1) == (0.0, 0.0)


def test_the_prior_of_a_shape_is_reordered_with_its_covariance():
    joints = 6
    mean, offset, root = 0.5 * randn(joints, 3, seed=21), randn(joints, 3, seed=23), randn(18, 18, seed=20)
    prior = ShapePrior.of(mean, root @ root.T)
    planar = (mean + offset).T.ravel() - prior.mean
    expected = offset.ravel() @ root @ root.T @ offset.ravel()
    assert planar @ prior.precision @ planar == pytest.approx(expected)


def test_redundancy_counts_unknowns_that_take_up_noise():
    problem, _ = scene(views=8, joints=12, seen=1.0)
    assert problem.redundancy == pytest.approx((192 / (192 - (48 + 36 - 7))) ** 0.5)
    assert replace(problem, points_known=True).redundancy == pytest.approx((192 / (192 - 48)) ** 0.5)
    problem.weight[:, 3] = 0
    problem.weight[1:, 5] = 0  # seen once: fits whatever the noise
    problem.weight[2] = 0
    measured = 2 * int((problem.weight > 0).sum())
    assert problem.redundancy == pytest.approx((measured / (measured - (42 + 30 - 7))) ** 0.5)


def test_redundancy_has_its_bounds():
    problem, _ = scene(views=2, joints=4, seen=1.0)
    assert problem.redundancy == REDUNDANCY_MOST
    many, _ = scene(views=200, joints=60, seen=1.0)
    assert 1.0 < many.redundancy < 1.1
