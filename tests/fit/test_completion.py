"""Views that could not be solved: placed between their neighbours, or left out."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from kronc_ns.fit.completion import complete
from kronc_ns.fit.noise import Noise
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.fit.two_cars import TwoCars
from kronc_ns.fit.verdict import Evidence, judge
from kronc_ns.geometry.alignment import pose_errors
from kronc_ns.geometry.poses import posed
from kronc_ns.solution import Solution, Status, ViewStatus
from kronc_ns.synthetic.scenes import Capture, make_capture
from kronc_ns.synthetic.variations import empty_views, shuffle
from tests.conftest import scene_of

COMPLETED, MEASURED = KroncConfig(), KroncConfig(min_status="solved")


@pytest.fixture(scope="module")
def walk() -> tuple[Capture, np.ndarray]:
    """A walk of 30 views of which three are empty; and which."""
    return empty_views(make_capture("walk", views=30, seed=2, noise_px=1.0), 0.1, np.random.default_rng(4))


@pytest.fixture(scope="module")
def whole(walk) -> Solution:
    return solve_scene(scene_of(walk[0]), COMPLETED)


def test_views_without_keypoints_are_placed_between_their_neighbours_or_left_out(walk, whole):
    capture, empty = walk
    measured = solve_scene(scene_of(capture), MEASURED)
    assert whole.status is measured.status is Status.CONVERGED
    assert_array_equal(whole.views_that_are(ViewStatus.COMPLETED), empty)
    assert_array_equal(measured.views_that_are(ViewStatus.FAILED), empty)
    assert_array_equal(whole.c2w[~empty], measured.c2w[~empty])
    assert np.isnan(measured.c2w[empty]).all()
    rotation, centre = pose_errors(whole.c2w, capture.c2w)
    assert rotation[empty].max() < 6
    assert centre[empty].max() < 0.4
    sigma = np.array([[view.sigma_rot_deg, view.sigma_trans_m] for view in whole.views])
    assert (sigma[empty].min(0) > 1.5 * np.median(sigma[~empty], axis=0)).all()
    for view in (view for view, hidden in zip(whole.views, empty, strict=True) if hidden):
        assert view.reason == "placed between its neighbours: 0 keypoints, at least 4 are needed"
        assert view.rmse_px is None


def test_a_solution_says_which_views_have_a_pose_and_how_it_came_about(walk, whole):
    """Completed views have one, failed views none; every view is of one kind."""
    _, empty = walk
    assert whole.posed.all()
    kinds = np.array([whole.views_that_are(status) for status in ViewStatus])
    assert (kinds.sum(0) == 1).all()
    assert_array_equal(whole.views_that_are(ViewStatus.SOLVED), ~empty)
    measured = solve_scene(scene_of(walk[0]), MEASURED)
    assert_array_equal(measured.posed, ~empty)
    for solution in (whole, measured):
        assert_array_equal(posed(solution.c2w), solution.posed)
        assert not np.isfinite(solution.depths[empty]).any(), "nothing was detected there"


def evidence_of(solution: Solution) -> Evidence:
    def sigma(name: str) -> np.ndarray:
        return np.array([getattr(view, name) or np.nan for view in solution.views])

    return Evidence(
        camera=solution.camera,
        c2w=solution.c2w,
        points=solution.points,
        sigma_rot_deg=sigma("sigma_rot_deg"),
        sigma_trans_m=sigma("sigma_trans_m"),
        swapped=np.zeros(len(solution.views), dtype=bool),
        shape_weight=1.0,
        converged=True,
        iterations=10,
        lead=np.full(len(solution.views), np.inf),
        noise=Noise(1.0, 1.0, 500),
        two_cars=TwoCars(0.0, 1.0, np.zeros(len(solution.views), dtype=bool)),
    )


def test_where_all_is_solved_or_nothing_nothing_is_placed(scene, solution):
    evidence = evidence_of(solution)
    verdict = judge(scene, evidence)
    assert verdict.solved.all()
    c2w, views = complete(scene, evidence, verdict)
    assert_array_equal(c2w, solution.c2w)
    assert views == verdict.views
    nowhere = replace(evidence, c2w=np.full_like(solution.c2w, np.nan))
    verdict = judge(scene, nowhere)
    assert not verdict.solved.any()
    c2w, views = complete(scene, nowhere, verdict)
    assert np.isnan(c2w).all()
    assert views == verdict.views


def test_a_vague_view_keeps_its_own_pose_where_the_walk_does_not_tell_it_better(scene, solution):
    """Of two vague views one is surer than the walk between its neighbours, the other is not."""
    evidence = evidence_of(solution)
    rotation, centre = evidence.sigma_rot_deg.copy(), evidence.sigma_trans_m.copy()
    centre[5], rotation[12] = 0.4, 90.0
    vague = replace(evidence, sigma_rot_deg=rotation, sigma_trans_m=centre)
    verdict = judge(scene, vague)
    c2w, views = complete(scene, vague, verdict)
    assert [i for i, view in enumerate(views) if view.status is ViewStatus.COMPLETED] == [5, 12]
    assert_array_equal(c2w[5], solution.c2w[5])
    assert views[5].sigma_trans_m == pytest.approx(0.4)
    assert "deg, 0.4 m)" in views[5].reason
    assert not np.array_equal(c2w[12], solution.c2w[12])
    assert views[12].reason.startswith("placed between its neighbours: ")
    assert views[12].sigma_rot_deg < 30


@pytest.fixture(scope="module")
def aimed(request, walk) -> Solution:
    """The walk when its empty views tell a few keypoints, too few to solve them."""
    capture, empty = walk
    full = make_capture("walk", views=30, seed=2, noise_px=1.0).keypoints
    keypoints = capture.keypoints.copy()
    for view in np.flatnonzero(empty):
        seen = np.flatnonzero(full[view, :, 2])
        told = seen[np.linspace(0, len(seen) - 1, request.param).astype(int)]
        keypoints[view, told] = full[view, told]
    return solve_scene(scene_of(replace(capture, keypoints=keypoints)))


@pytest.mark.parametrize("aimed", [2, 3], indirect=True)
def test_few_keypoints_turn_a_placed_view_nearer_to_the_truth(walk, whole, aimed):
    capture, empty = walk
    assert_array_equal(aimed.views_that_are(ViewStatus.COMPLETED), empty)
    by_walk, by_points = (pose_errors(solution.c2w, capture.c2w)[0][empty] for solution in (whole, aimed))
    assert by_points.mean() < 0.7 * by_walk.mean()


@pytest.mark.parametrize("aimed", [2, 3], indirect=True)
def test_few_keypoints_hardly_move_a_placed_view(walk, whole, aimed):
    """Points that can be met exactly are not exact for that."""
    _, empty = walk
    moved = np.linalg.norm((aimed.c2w - whole.c2w)[empty][..., 3], axis=-1)
    sigma = np.array([view.sigma_trans_m for view in whole.views])[empty]
    assert (moved < 2 * sigma).all()


def test_views_in_any_order_are_not_completed():
    capture = shuffle(make_capture("walk", views=20, seed=2, noise_px=1.0), np.random.default_rng(0))
    capture, empty = empty_views(capture, 0.1, np.random.default_rng(4))
    solution = solve_scene(scene_of(capture))
    assert_array_equal(solution.views_that_are(ViewStatus.FAILED), empty)
    assert_array_equal(solution.posed, ~empty)
