"""What the solver makes of starts, and telling the right one from the wrong ones."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from kronc_ns.fit.attempts import adjust_starts, agrees, measured, misfit, problem_of, shape_prior
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.starts import start_from_poses, start_from_template
from kronc_ns.geometry.alignment import pose_errors
from kronc_ns.geometry.poses import make_pose
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.synthetic.scenes import make_capture
from tests.conftest import scene_of
from tests.fit.common import PLAIN

CONFIG = KroncConfig()


def test_an_attempt_knows_where_it_began_and_what_it_found(attempt, lap, lap_start):
    assert_allclose(pose_errors(attempt.start.c2w, lap_start)[0], 0, atol=1e-4)
    rotation, centre = pose_errors(attempt.found.c2w, lap.c2w)
    assert rotation.mean() < 0.6 < 4.0 < pose_errors(attempt.start.c2w, lap.c2w)[0].mean()
    assert centre.max() < 0.2
    assert_allclose(attempt.path[-1], attempt.found.c2w, rtol=0, atol=1e-12)
    assert attempt.converged
    assert attempt.iterations == len(attempt.history["loss"])


def test_right_starts_leave_less_unexplained_than_wrong_ones(attempt, scene, lap_start):
    backwards = start_from_poses("given", "backwards", scene, lap_start[::-1])
    turned = make_pose(lap_start[..., :3], -lap_start[..., 3])
    inside_out = start_from_poses("given", "turned", scene, turned)
    wrong = adjust_starts([backwards, inside_out], CONFIG)
    right = misfit(attempt)
    assert 0 <= right < 0.05
    assert all(right + 0.1 < misfit(other) <= 1 for other in wrong)


def test_misfit_counts_views_that_take_no_part(attempt, scene):
    half = np.arange(20) < 10
    without = replace(attempt, found=replace(attempt.found, used=attempt.found.used & half))
    share = scene.seen[~half].sum() / scene.seen.sum()
    assert misfit(without) == pytest.approx(misfit(attempt) + share, abs=0.05)


def test_starts_are_solved_together_as_they_are_alone(scene, lap, lap_start):
    small = scene_of(make_capture("walk", views=7, seed=5, noise_px=0.7))
    starts = [
        start_from_poses("given", "given", scene, lap_start),
        start_from_template(small),
        start_from_template(scene),
        start_from_poses("given", "true", scene, lap.c2w),
    ]
    together = adjust_starts(starts, CONFIG)
    for one, found in zip(starts, together, strict=True):
        (alone,) = adjust_starts([one], CONFIG)
        assert found.start is one
        assert found.found.name == one.name
        assert len(found.found.scene) == len(one.scene)
        assert_allclose(found.found.c2w, alone.found.c2w, rtol=0, atol=1e-7)
        assert_allclose(found.covariance(), alone.covariance(), rtol=1e-4, atol=1e-12)
        assert_array_equal(found.inlier, alone.inlier)


def test_another_solvers_result_is_measured_alike(attempt):
    theirs = measured(attempt.start, attempt.found, 3, {}, attempt.path)
    assert theirs.sigma_px == pytest.approx(attempt.sigma_px, rel=0.25)
    assert (theirs.inlier == attempt.inlier).mean() > 0.99
    ours, other = (np.sqrt(np.diagonal(one.covariance(), axis1=1, axis2=2)) for one in (attempt, theirs))
    assert 0.6 < np.median(other / ours) < 1.6


def test_where_nothing_agrees_nothing_is_known(attempt):
    nothing = replace(attempt, inlier=np.zeros_like(attempt.inlier))
    assert np.isnan(nothing.covariance()).all()
    assert not nothing.agreeing.any()


def test_views_agree_where_half_of_their_detections_do_or_so_many_that_it_is_no_chance():
    inliers, seen = np.array([[3, 3], [4, 8], [4, 9], [7, 20], [8, 20], [8, 33], [0, 0]]).T
    assert agrees(inliers, seen).tolist() == [False, True, False, False, True, False, False]


def test_the_solver_is_told_what_the_views_that_take_part_saw(attempt):
    used = np.arange(20) != 3
    scene = attempt.found.scene
    doubted = np.where(np.arange(66) < 33, 0.2, 0.8)[:, None] * [0, 0, 1] + [1, 1, 0]
    found = replace(attempt.found, used=used, scene=replace(scene, keypoints=scene.keypoints * doubted))
    problem = problem_of(found)
    assert_array_equal(problem.weight > 0, scene.seen & used[:, None])
    assert problem.weight[problem.weight > 0].mean() == pytest.approx(1.0), "whatever a detector's confidence means"
    assert np.ptp(problem.weight[:, :33][problem.weight[:, :33] > 0]) < 1e-12
    assert problem.weight.max() == pytest.approx(4 * problem.weight[problem.weight > 0].min())
    assert problem.shape is shape_prior(APOLLOCAR3D_66)
    assert_allclose(problem.uv, scene.uv - (scene.camera.cx, scene.camera.cy))


def test_without_a_template_a_point_seen_once_says_nothing(attempt):
    keypoints = attempt.found.scene.keypoints.copy()
    once = int(np.flatnonzero(keypoints[5, :, 2])[0])
    keypoints[np.arange(20) != 5, once] = 0
    plain = replace(attempt.found, scene=replace(attempt.found.scene, schema=PLAIN, keypoints=keypoints))
    car = replace(attempt.found, scene=replace(attempt.found.scene, keypoints=keypoints))
    assert problem_of(plain).shape is None
    assert problem_of(plain).weight[5, once] == 0
    assert problem_of(car).weight[5, once] > 0
