"""The second-order solver: exact recovery, maximum likelihood without outliers, and little harm with them."""

import math
from dataclasses import replace

import numpy as np
import pytest

from kronc_ns.geometry.alignment import pose_errors
from kronc_ns.geometry.camera import Camera
from kronc_ns.keypoints.schema import KeypointSchema
from kronc_ns.scene import Scene
from kronc_ns.solve import robust
from kronc_ns.solve.lm import LmConfig, adjust
from kronc_ns.solve.problem import OrbitPrior, Problem, ShapePrior, State
from tests.likelihood import maximum_likelihood
from tests.solve import book
from tests.solve.problems import (
    FOCAL,
    HALF_TURN,
    SIMILARITY,
    errors,
    evaluated,
    lengths,
    moved,
    projections,
    randn,
    scene,
    started,
)


def as_seen(problem: Problem) -> Problem:
    """All detections count alike."""
    return replace(problem, weight=(problem.weight > 0).astype(float))


@pytest.mark.parametrize("loss", ["cauchy", "huber", "none"])
def test_exact_keypoints_give_exact_poses(loss):
    problem, truth = scene(views=10, joints=15)
    result = adjust(problem, started(truth, 7.0, 0.5), LmConfig(loss=loss, tolerance=1e-9))
    assert result.converged
    rotation, translation = errors(result.state, truth)
    assert rotation.max() < 1e-4
    assert translation.max() < 1e-5
    assert lengths(problem, result.state).max() < 1e-3
    np.testing.assert_array_equal(result.inlier, problem.weight > 0)


def as_scene(problem: Problem, focal: tuple[float, float] = FOCAL) -> Scene:
    """Of a camera with its principal point in the middle of 400 x 400 pixels."""
    views, joints = problem.weight.shape
    schema = KeypointSchema("dots", tuple(f"dot {j}" for j in range(joints)), tuple(range(joints)))
    keypoints = np.concatenate([problem.uv + 200, (problem.weight > 0)[..., None]], axis=-1)
    return Scene(tuple(map(str, range(views))), Camera(*focal, 200.0, 200.0, 400, 400), schema, keypoints)


@pytest.mark.parametrize("loss", ["cauchy", "none"])
def test_without_outliers_the_result_is_the_maximum_likelihood_one(loss):
    problem, truth = scene(views=8, joints=14, noise_px=1.0, seen=0.9)
    problem = as_seen(problem)
    result = adjust(problem, started(truth), LmConfig(loss=loss))
    best = maximum_likelihood(as_scene(problem), truth.c2w, truth.points, robust=False)
    limit, ours = pose_errors(best, truth.c2w)[0], pose_errors(result.state.c2w, best)[0]
    assert limit.mean() > 0.1
    assert ours.max() < 0.02 * limit.mean()


@pytest.mark.parametrize("refine", [(), ("focal",)])
@pytest.mark.parametrize("loss", ["none", "cauchy"])
def test_bundle_adjustment_by_ceres_ends_at_the_same_place(loss, refine):
    """What ends in squares without outliers ends where Ceres does."""
    pytest.importorskip("pycolmap")
    from kronc_ns.benchmark.peers.ceres import bundle_adjustment

    focal = (FOCAL[0], FOCAL[0]) if refine else FOCAL  # pycolmap refines one
    problem, truth = scene(views=10, joints=20, noise_px=1.0, seen=0.9)
    uv = problem.uv * (np.array(focal) / FOCAL)
    problem = replace(as_seen(problem), uv=uv, focal=focal, refine=refine)
    start = started(truth, 2.0, 0.1)
    ours = adjust(problem, start, LmConfig(loss=loss, tolerance=1e-12))
    theirs = bundle_adjustment(
        as_scene(problem, focal), start.c2w, start.points, refine_focal=bool(refine), function_tolerance=1e-14
    )
    assert ours.converged
    assert theirs.converged
    assert ours.inlier.sum() == (problem.weight > 0).sum()
    rotation, translation = pose_errors(ours.state.c2w, theirs.c2w)
    assert rotation.max() < 1e-4
    assert translation.max() < 1e-5
    assert pose_errors(theirs.c2w, truth.c2w)[0].mean() > 0.05  # noise moved both
    assert focal[0] * math.exp(ours.state.log_growth) == pytest.approx(theirs.focal_px, rel=1e-6)


def test_three_in_ten_outliers_barely_move_it():
    for draw in range(3):
        problem, truth = scene(views=20, joints=40, noise_px=1.0, outliers=0.3, seen=0.8, draw=draw)
        wild = lengths(problem, truth) > 15
        assert 0.25 < wild.sum() / (problem.weight > 0).sum() < 0.35
        clean = replace(problem, weight=np.where(wild, 0.0, problem.weight))
        start = started(truth, 4.0, 0.3)
        found = adjust(problem, start)
        ours, best, naive = (
            errors(result.state, truth)[0].mean()
            for result in (found, adjust(clean, start), adjust(problem, start, LmConfig(loss="none")))
        )
        assert (found.inlier & wild).sum() < 0.01 * wild.sum()
        assert ours < 1.1 * best
        assert naive > 5 * best


def test_huber_lies_between():
    problem, truth = scene(views=20, joints=40, noise_px=1.0, outliers=0.1, seen=0.8)
    start = started(truth, 4.0, 0.3)
    cauchy, huber, none = (
        errors(adjust(problem, start, LmConfig(loss=loss)).state, truth)[0].mean()
        for loss in ("cauchy", "huber", "none")
    )
    assert cauchy < huber < 0.5 * none


@pytest.mark.parametrize("outliers", [0.0, 0.3])
def test_the_noise_is_told_from_the_residuals_whatever_the_outliers(outliers):
    sigmas = []
    for draw in range(8):
        problem, truth = scene(views=20, joints=40, noise_px=1.5, outliers=outliers, seen=0.9, draw=draw)
        sigmas.append(adjust(as_seen(problem), started(truth, 1.0, 0.05)).sigma_px)
    assert np.mean(sigmas) == pytest.approx(1.5, rel=0.06)


def test_weights_count_as_inverse_variances():
    """Half of the detections have ten times the noise: saying so in their weights helps."""
    sigmas, better = [], []
    for draw in range(20):
        problem, truth = scene(views=10, joints=20, noise_px=1.0, seen=0.9, draw=draw)
        coarse = np.random.default_rng(draw).random(problem.weight.shape) < 0.5
        noise = problem.uv - projections(truth)
        flat = replace(as_seen(problem), uv=problem.uv + 9 * coarse[..., None] * noise)
        weighted = replace(flat, weight=flat.weight * np.where(coarse, 0.01, 1.0))
        start = started(truth, 1.0, 0.05)
        told, untold = adjust(weighted, start), adjust(flat, start)
        sigmas.append(told.sigma_px)
        better.append(errors(told.state, truth)[0].mean() < errors(untold.state, truth)[0].mean())
    assert np.mean(sigmas) == pytest.approx(1.0, rel=0.15)
    assert sum(better) >= 18


@pytest.mark.parametrize("loss", ["huber", "none"])
def test_the_cost_never_increases(loss):
    problem, truth = scene(views=10, joints=20, noise_px=1.0, outliers=0.2)
    result = adjust(problem, started(truth, 10.0, 0.8), LmConfig(loss=loss))
    assert len(result.loss) > 3
    assert (np.diff(result.loss) <= 0).all()


@pytest.mark.parametrize("size", [(6, 12), (30, 45)])
def test_same_input_same_bits(size):
    """Also where parts are reduced on two cores."""
    problem, truth = scene(*size, noise_px=1.0, outliers=0.1)
    first, second = (adjust(problem, started(truth)) for _ in range(2))
    for name, value in vars(first.state).items():
        np.testing.assert_array_equal(value, getattr(second.state, name))
    assert first.cost == second.cost
    assert first.loss == second.loss


def test_everything_is_double_precision():
    problem, truth = scene(noise_px=1.0)
    state = adjust(problem, started(truth)).state
    assert {part.dtype for part in (state.rotation, state.translation, state.points)} == {np.dtype(np.float64)}


def test_the_start_is_left_as_it_was():
    problem, truth = scene(noise_px=1.0)
    start, again = started(truth), started(truth)
    adjust(problem, start)
    for name, value in vars(again).items():
        np.testing.assert_array_equal(getattr(start, name), value)


def test_the_world_it_starts_in_does_not_matter():
    problem, truth = scene(views=8, joints=16, noise_px=1.0, outliers=0.1)
    start = started(truth)
    here, there = adjust(problem, start), adjust(problem, moved(start, SIMILARITY))
    rotation, translation = errors(there.state, here.state)
    assert rotation.max() < 1e-3
    assert translation.max() < 1e-4
    assert there.cost == pytest.approx(here.cost, rel=1e-2)


def turned_away(state: State, view: int) -> State:
    """With a camera that looks the other way."""
    rotation, translation = state.rotation.copy(), state.translation.copy()
    rotation[view] *= HALF_TURN[:, None]
    translation[view] *= HALF_TURN
    return replace(state, rotation=rotation, translation=translation)


def only(state: State, views: np.ndarray) -> State:
    """Without the other cameras."""
    return replace(state, rotation=state.rotation[views], translation=state.translation[views])


def test_a_camera_that_looks_away_does_not_harm_the_others():
    problem, truth = scene(views=8, joints=16, noise_px=0.5)
    result = adjust(problem, turned_away(started(truth), 2))
    kept = np.arange(8) != 2
    without = replace(problem, uv=problem.uv[kept], weight=problem.weight[kept])
    best = adjust(without, only(started(truth), kept)).state
    assert errors(only(result.state, kept), best)[0].max() < 0.01
    assert np.isfinite(result.state.c2w).all()
    assert not result.inlier[2].any()


def test_points_that_start_behind_cameras_do_not_harm_the_poses():
    problem, truth = scene(views=8, joints=16, noise_px=0.5, seen=1.0)
    start = started(truth)
    start.points[:3] *= 12  # metres beyond the cameras, behind some
    assert (lengths(problem, start) > 5000).any()
    result = adjust(problem, start)
    assert errors(result.state, truth)[0].mean() < 0.3
    assert result.inlier[:, 3:].all()


def test_too_few_iterations_are_no_convergence():
    problem, truth = scene(views=8, joints=16, noise_px=1.0)
    result = adjust(problem, started(truth), LmConfig(iterations=2))
    assert not result.converged
    assert len(result.loss) == 2
    assert np.isfinite(result.state.c2w).all()


@pytest.mark.parametrize("seed", range(4))
def test_the_default_tolerance_ends_where_a_small_one_does(seed):
    """What the next step is expected to gain is all that is left."""
    problem, truth = scene(views=20, joints=24, noise_px=1.0, seed=seed)
    start = started(truth)
    found, exact = (
        adjust(problem, start, LmConfig(tolerance=tolerance)) for tolerance in (LmConfig().tolerance, 1e-14)
    )
    assert len(found.loss) < len(exact.loss)
    assert found.cost == pytest.approx(exact.cost, rel=1e-7)
    np.testing.assert_array_equal(found.inlier, exact.inlier)
    moved, of_noise = (errors(found.state, end)[0] for end in (exact.state, truth))
    assert moved.max() < 0.01 * of_noise.mean()


def test_no_iterations_leave_the_start():
    problem, truth = scene(views=8, joints=16, noise_px=1.0)
    start = started(truth)
    result = adjust(problem, start, LmConfig(iterations=0))
    assert not result.converged
    assert (result.loss, result.path) == ((), ())
    np.testing.assert_array_equal(result.state.points, start.points)


def test_progress_and_path_tell_every_step():
    problem, truth = scene(views=6, joints=12, noise_px=1.0)
    calls = []
    result = adjust(problem, started(truth), progress=lambda step, loss: calls.append((step, loss)))
    assert calls == list(enumerate(result.loss, start=1))
    assert len(result.path) == len(result.loss)
    assert result.path[-1] is result.state
    off = [errors(state, truth)[0].mean() for state in result.path]
    assert off[0] > 1.5 * off[-1]


def test_empty_views_and_unseen_points_stay_where_they_were():
    problem, truth = scene(views=8, joints=16, noise_px=0.5)
    problem.weight[3] = problem.weight[:, 5] = 0
    start = started(truth)
    found = adjust(problem, start).state
    np.testing.assert_array_equal(found.c2w[3], start.c2w[3])
    np.testing.assert_array_equal(found.points[5], start.points[5])
    views, points = np.arange(8) != 3, np.arange(16) != 5
    part = replace(problem, uv=problem.uv[views][:, points], weight=problem.weight[views][:, points])
    alone = adjust(part, replace(only(start, views), points=start.points[points])).state
    np.testing.assert_allclose(only(found, views).c2w, alone.c2w, atol=1e-6)


def test_nothing_to_see_ends_at_once():
    problem, truth = scene()
    result = adjust(replace(problem, weight=np.zeros_like(problem.weight)), started(truth))
    assert np.isfinite(result.state.c2w).all()
    assert len(result.loss) < 20
    assert not result.inlier.any()


@pytest.mark.parametrize("factor", [0.75, 1.25])
def test_a_wrong_focal_length_is_found(factor):
    problem, truth = scene(views=12, joints=20, refine=("focal",))
    wrong = replace(problem, focal=(factor * FOCAL[0], factor * FOCAL[1]))
    result = adjust(wrong, started(truth), LmConfig(tolerance=1e-9))
    assert factor * math.exp(result.state.log_growth) == pytest.approx(1.0, rel=1e-4)
    assert errors(result.state, truth)[0].max() < 0.01


@pytest.mark.parametrize("refine", [("k1",), ("focal", "k1")])
def test_the_lens_is_found(refine):
    straight, truth = scene(views=12, joints=20, refine=refine)
    bent = book.reprojection(straight, replace(truth, log_growth=0.1 * ("focal" in refine), k1=-0.05)).numpy()
    result = adjust(replace(straight, uv=straight.uv + bent), started(truth), LmConfig(tolerance=1e-9))
    assert result.state.k1 == pytest.approx(-0.05, abs=1e-4)
    assert result.state.log_growth == pytest.approx(0.1 * ("focal" in refine), abs=1e-4)
    assert errors(result.state, truth)[0].max() < 0.01


def test_what_is_not_refined_stays():
    problem, truth = scene(noise_px=1.0)
    found = adjust(problem, replace(started(truth), log_growth=0.01, k1=0.002)).state
    assert (found.log_growth, found.k1) == (0.01, 0.002)
    known = adjust(replace(problem, points_known=True), replace(started(truth), points=truth.points)).state
    np.testing.assert_array_equal(known.points, truth.points)


def test_known_points_are_an_anchor():
    problem, truth = scene(noise_px=0.5, points_known=True)
    found = adjust(problem, replace(started(truth), points=truth.points)).state
    assert np.abs(found.c2w - truth.c2w).max() < 0.05


def test_a_shape_prior_holds_the_world_and_what_is_seen_once():
    problem, truth = scene(views=8, joints=16, noise_px=1.0, seen=1.0)
    problem.weight[1:, 4] = 0  # one view only: its depth is open without a prior
    mean = truth.points + 0.02 * randn(16, 3, seed=4)
    prior = ShapePrior.of(mean, np.eye(48) / 0.02**2)
    result = adjust(replace(problem, shape=prior), moved(started(truth), SIMILARITY))
    assert np.linalg.norm(result.state.points - truth.points, axis=-1).max() < 0.08
    assert np.linalg.norm((result.state.c2w - truth.c2w)[..., 3], axis=-1).max() < 0.15
    assert result.shape_weight > 0.9


def test_data_overrule_the_prior_of_another_shape():
    problem, truth = scene(views=12, joints=16, noise_px=0.5, seen=1.0)
    alike = ShapePrior.of(truth.points * 1.5 + 0.1, np.eye(48) / 0.05**2)
    stretched = ShapePrior.of(truth.points * np.array([1.6, 1.0, 0.7]), np.eye(48) / 0.05**2)
    usual, odd = (adjust(replace(problem, shape=shape), started(truth)) for shape in (alike, stretched))
    assert odd.shape_weight < usual.shape_weight
    best = errors(adjust(problem, started(truth)).state, truth)[0].mean()
    assert errors(odd.state, truth)[0].mean() < 2 * best


def test_an_orbit_carries_views_that_see_nothing():
    problem, truth = scene(views=8, joints=16, noise_px=0.5)
    problem.weight[3] = 0
    expected = truth.c2w[..., 3] + 0.01 * randn(8, 3, seed=4)
    sigma = np.where(np.arange(8) == 3, 0.1, math.inf)
    result = adjust(replace(problem, orbit=OrbitPrior(expected, sigma)), started(truth))
    np.testing.assert_allclose(result.state.c2w[3, :, 3], expected[3], atol=1e-3)


def test_expectations_of_nothing_change_nothing():
    problem, truth = scene(views=8, joints=16, noise_px=0.5, outliers=0.1)
    nowhere = OrbitPrior(truth.c2w[..., 3] + 1.0, np.full(8, math.inf))
    ours, theirs = (adjust(one, started(truth)) for one in (problem, replace(problem, orbit=nowhere)))
    assert ours.loss == theirs.loss
    np.testing.assert_array_equal(ours.state.points, theirs.state.points)


def test_noise_that_is_known_is_not_told_from_the_residuals():
    """Few right detections among many wrong ones: the median residual would make all of them inliers."""
    problem, truth = scene(views=10, joints=30, noise_px=0.5, outliers=0.55, seen=1.0)
    problem = replace(problem, points_known=True)
    start = replace(started(truth, 0.5, 0.02), points=truth.points)
    believing, doubting = adjust(problem, start), adjust(problem, start, sigma_px=1.0)
    assert doubting.sigma_px == 1.0
    assert errors(doubting.state, truth)[0].mean() <= errors(believing.state, truth)[0].mean()
    wild = lengths(problem, truth) > 15
    assert (doubting.inlier & wild).sum() < 0.02 * wild.sum()


def test_the_cost_is_that_of_the_state():
    """In units of sigma^2, at what the last phase calls for."""
    problem, truth = scene(views=8, joints=16, noise_px=1.0, outliers=0.1)
    result = adjust(problem, started(truth))
    length = evaluated(problem, result.state).length
    expected = robust.cost(length, result.sigma_px, robust.TRIMMED) / result.sigma_px**2
    assert result.cost == pytest.approx(expected)
    assert result.loss[-1] == pytest.approx(math.sqrt(expected / len(length)) * result.sigma_px)
