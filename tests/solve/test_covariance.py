"""Sigmas against the dense pseudo-inverse, and against what many draws of the noise do to the cameras."""

from dataclasses import replace

import numpy as np
import pytest

from kronc_ns.geometry.alignment import umeyama
from kronc_ns.geometry.rotations import skew, so3_log
from kronc_ns.solve.covariance import camera_covariance
from kronc_ns.solve.lm import LmConfig, adjust
from kronc_ns.solve.problem import Problem, ShapePrior, State
from tests.solve import book
from tests.solve.problems import FOCAL, SIMILARITY, moved, projections, randn, scene

DRAWS, NOISE_PX, SHAPE_M = 300, 0.5, 0.03
SIGNS = np.array([1.0, 1.0, 1.0, -1.0, -1.0, -1.0])
"""A centre moves by -v (in camera axes) when the translation grows by v."""


def covariance(problem: Problem, state: State, sigma_px: float = NOISE_PX, shape_weight: float = 1.0) -> np.ndarray:
    """At the given state, every detection an inlier."""
    return camera_covariance(problem, state, problem.weight > 0, sigma_px, shape_weight)


def gauge(problem: Problem, state: State) -> np.ndarray:
    """How all unknowns move when the world shifts, turns and grows about its origin, [P, 7]."""
    rotation, translation, points = state.rotation, state.translation, state.points
    none = np.zeros((len(rotation), 3, 3))
    turning = np.concatenate([none, -rotation, np.zeros((len(rotation), 3, 1))], axis=2)
    shifting = np.concatenate([-rotation, skew(translation) @ -rotation, translation[..., None]], axis=2)
    cameras = np.concatenate([turning, shifting], axis=1).reshape(-1, 7)
    shift = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    world = np.concatenate([shift, -skew(points), points[..., None]], axis=2).swapaxes(0, 1).reshape(-1, 7)
    return np.concatenate([cameras, world, np.zeros((len(problem.refine), 7))])


def expected_covariance(problem: Problem, state: State, sigma_px: float, shape_weight: float) -> np.ndarray:
    """By the pseudo-inverse of the whole system, with inner constraints on the points that are seen."""
    matrix, _ = book.normal_equations(problem, state, problem.weight, sigma_px**2 * shape_weight)
    scale = np.maximum(np.sqrt(np.diag(matrix)), 1e-9)
    free = np.linalg.pinv(matrix / np.outer(scale, scale), rcond=1e-11, hermitian=True) / np.outer(scale, scale)
    directions = gauge(problem, state)
    cameras, points, _ = book.unknowns(problem)
    held = np.zeros_like(directions)
    seen = np.tile((problem.weight > 0).any(0), 3)
    held[cameras : cameras + points] = directions[cameras : cameras + points] * seen[:, None]
    projector = np.eye(len(matrix)) - directions @ np.linalg.solve(held.T @ directions, held.T)
    whole = sigma_px**2 * projector @ free @ projector.T
    return np.stack([np.outer(SIGNS, SIGNS) * whole[i : i + 6, i : i + 6] for i in range(0, cameras, 6)])


def test_the_gauge_does_not_show_in_the_images():
    problem, truth = scene(views=4, joints=6, refine=("focal", "k1"))
    matrix, _ = book.normal_equations(problem, truth, problem.weight)
    directions = gauge(problem, truth)
    assert np.abs(matrix @ directions).max() < 1e-9 * np.abs(matrix).max() * np.abs(directions).max()


@pytest.mark.parametrize("refine", [(), ("focal",), ("focal", "k1")])
@pytest.mark.parametrize("variant", ["plain", "prior", "unseen"])
def test_it_is_that_of_the_whole_system_with_the_points_held_still(variant, refine):
    problem, truth = scene(views=7, joints=12, seen=0.9, refine=refine)
    state, shape_weight = replace(truth, log_growth=0.05, k1=-0.03), 0.6
    if variant == "prior":
        root = randn(36, 36, seed=4)
        problem = replace(problem, shape=ShapePrior.of(truth.points, root @ root.T))
        problem.weight[:, 7] = 0  # known beforehand only
    if variant == "unseen":
        problem.weight[:, 3] = problem.weight[2:, 5] = 0
    ours = covariance(problem, state, 0.8, shape_weight)
    expected = expected_covariance(problem, state, 0.8, shape_weight)
    scale = np.sqrt(np.diagonal(expected, axis1=1, axis2=2))
    ours, expected = (x / (scale[:, :, None] * scale[:, None]) for x in (ours, expected))
    np.testing.assert_allclose(ours, expected, rtol=0, atol=1e-5)


def test_only_inliers_count():
    problem, truth = scene(views=7, joints=12)
    inlier = (problem.weight > 0) & (randn(7, 12, seed=3) < 1.5)
    ours = camera_covariance(problem, truth, inlier, NOISE_PX, 1.0)
    left = replace(problem, weight=np.where(inlier, problem.weight, 0.0))
    np.testing.assert_array_equal(ours, covariance(left, truth))


def camera_errors(found: list[State], truths: list[State], seen: np.ndarray) -> np.ndarray:
    """(rotation vector, centre) error of every camera [draws, views, 6] in its own axes, the seen points aligned."""
    rows = []
    for state, truth in zip(found, truths, strict=True):
        aligned = umeyama(state.points[seen], truth.points[seen]).apply_to_poses(state.c2w)
        turn = so3_log(aligned[..., :3].swapaxes(1, 2) @ truth.c2w[..., :3])
        shift = (truth.c2w[..., :3].swapaxes(1, 2) @ (aligned - truth.c2w)[..., 3:])[..., 0]
        rows.append(np.concatenate([turn, shift], axis=-1))
    return np.stack(rows)


def assert_calibrated(errors: np.ndarray, expected: np.ndarray) -> None:
    """Whitened by what is expected, the errors' covariance is the identity as well as so many draws can tell."""
    whitened = np.linalg.solve(np.linalg.cholesky(expected), errors[..., None])[..., 0]
    empirical = np.einsum("dni,dnj->nij", whitened, whitened) / len(errors)
    assert np.abs(empirical - np.eye(6)).max() < 0.4  # about 4.5 standard deviations of the worst entry
    assert np.diagonal(empirical, axis1=1, axis2=2).mean() == pytest.approx(1.0, abs=0.06)


def solved(problem: Problem, truth: State) -> State:
    result = adjust(problem, truth, LmConfig(loss="none"))
    assert result.converged
    return result.state


def redrawn(problem: Problem, truth: State, draw: int, sigma_px: float | np.ndarray = NOISE_PX) -> Problem:
    noise = randn(*problem.uv.shape, seed=1000 + draw)
    return replace(problem, uv=projections(truth) + np.asarray(sigma_px)[..., None] * noise)


@pytest.mark.parametrize("variant", ["plain", "focal", "unseen"])
def test_many_draws_scatter_as_the_covariance_says(variant):
    problem, truth = scene(views=6, joints=14, refine=("focal",) if variant == "focal" else ())
    problem.weight[:] = 1.0
    if variant == "unseen":
        problem.weight[:, 3] = problem.weight[2:, 5] = 0
    found = [solved(redrawn(problem, truth, draw), truth) for draw in range(DRAWS)]
    errors = camera_errors(found, [truth] * DRAWS, (problem.weight > 0).any(0))
    assert_calibrated(errors, covariance(problem, truth))


def test_weights_are_part_of_it():
    problem, truth = scene(views=6, joints=14)
    worse = np.where(np.arange(14) % 2 == 0, 4.0, 1.0)  # every other point has four times the noise
    problem.weight[:] = worse**-2
    found = [solved(redrawn(problem, truth, draw, NOISE_PX * worse), truth) for draw in range(DRAWS)]
    assert_calibrated(camera_errors(found, [truth] * DRAWS, np.ones(14, dtype=bool)), covariance(problem, truth))


def test_shapes_drawn_from_the_prior_scatter_as_the_covariance_says():
    problem, mean = scene(views=3, joints=14)
    prior = replace(ShapePrior.of(mean.points, np.eye(42) / SHAPE_M**2), freedom=1e9)
    problem = replace(problem, weight=np.ones((3, 14)), shape=prior)
    problem.weight[1:, :5] = 0  # seen once: nothing without the prior
    truths = [replace(mean, points=mean.points + SHAPE_M * randn(14, 3, seed=5000 + draw)) for draw in range(DRAWS)]
    found = [solved(redrawn(problem, truth, draw), truth) for draw, truth in enumerate(truths)]
    assert_calibrated(camera_errors(found, truths, np.ones(14, dtype=bool)), covariance(problem, mean))


def test_the_world_does_not_matter_and_centres_scale_with_it():
    problem, truth = scene(views=6, joints=14)
    here, there = covariance(problem, truth), covariance(problem, moved(truth, SIMILARITY))
    scale = np.array([1.0] * 3 + [SIMILARITY.scale] * 3)
    np.testing.assert_allclose(there, scale[:, None] * here * scale, rtol=1e-5, atol=1e-12)


def test_it_is_symmetric_positive_and_grows_with_the_noise():
    problem, truth = scene(views=6, joints=14)
    small = covariance(problem, truth, 0.5)
    np.testing.assert_allclose(small, small.swapaxes(1, 2), rtol=1e-6, atol=1e-15)
    assert (np.linalg.eigvalsh(small) > 0).all()
    np.testing.assert_allclose(covariance(problem, truth, 1.5), 9 * small, rtol=1e-6)


def test_more_views_of_the_same_points_tell_each_camera_better():
    problem, truth = scene(views=12, joints=14, seen=1.0)
    part = replace(problem, uv=problem.uv[:4], weight=problem.weight[:4])
    whole, half = covariance(problem, truth)[:4], covariance(part, State.of(truth.c2w[:4], truth.points))
    largest = np.diagonal(half, axis1=1, axis2=2).max(1)
    assert (np.linalg.eigvalsh(half - whole) > -1e-9 * largest[:, None]).all()


def test_a_camera_that_sees_nothing_is_not_known():
    problem, truth = scene(views=6, joints=14)
    problem.weight[4] = 0
    spread = np.diagonal(covariance(problem, truth), axis1=1, axis2=2)
    assert np.isfinite(spread).all()
    assert spread[4].min() > 100 * spread[[0, 1, 2, 3, 5]].max()


@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("seed", range(5))
def test_a_view_with_too_few_points_for_a_pose_is_no_trouble_to_the_others(count, seed):
    problem, truth = scene(views=6, joints=14, seen=1.0, seed=10 * seed)
    whole = covariance(problem, truth)
    problem.weight[4, count:] = 0
    thin = covariance(problem, truth)
    assert np.isfinite(thin).all()
    kept = [0, 1, 2, 3, 5]
    before, after = (np.diagonal(x, axis1=1, axis2=2) for x in (whole, thin))
    assert (after[kept] > 0.9 * before[kept]).all()
    assert (after[kept] < 3 * before[kept]).all()
    growth = np.linalg.eigvals(np.linalg.solve(whole[4], thin[4])).real.max()  # of the variance that grows most
    assert growth > (20 if count == 3 else 1e6)


def test_a_state_that_is_no_number_has_no_covariance():
    problem, truth = scene(views=6, joints=14)
    truth.points[0] = np.nan
    assert np.isnan(covariance(problem, truth)).all()


def test_focal_lengths_are_told_along_with_the_distance():
    """What is refined makes cameras less certain, most of all along their axes."""
    problem, truth = scene(views=6, joints=14)
    assert problem.focal == FOCAL
    fixed, free = covariance(problem, truth), covariance(replace(problem, refine=("focal",)), truth)
    growth = np.diagonal(free - fixed, axis1=1, axis2=2)
    assert (growth > -1e-9).all()
    assert (growth[:, 5] > growth[:, 3:5].max(1)).all()
