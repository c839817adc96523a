"""Sigmas against what many draws of the noise do to the cameras."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from kronc_ns.geometry.alignment import umeyama
from kronc_ns.geometry.rotations import so3_log
from kronc_ns.solve.bundle import residuals
from kronc_ns.solve.lm import LmConfig, adjust
from kronc_ns.solve.problem import OrbitPrior, Problem, ShapePrior, State
from kronc_ns.solve.uncertainty import camera_covariance
from tests.solve.problems import SIMILARITY, moved, randn, scene

DRAWS, NOISE_PX, SHAPE_M = 300, 0.5, 0.03


def covariance(problem: Problem, state: State, sigma_px: float = NOISE_PX) -> Tensor:
    """Of the first scene, at the given state, every detection an inlier."""
    first = torch.tensor([0])
    problem, state = problem[first], state[first]
    one = torch.ones(1, dtype=torch.float64)
    return camera_covariance(problem, state, problem.weight > 0, one * sigma_px, one)[0]


def camera_errors(found: State, truth: State, seen: Tensor) -> Tensor:
    """(rotation vector, centre) error of every camera [draws, views, 6] in its own axes, the seen points aligned."""
    rows = []
    for points, true_points, poses, truths in zip(found.points, truth.points, found.c2w, truth.c2w, strict=True):
        aligned = umeyama(points[seen], true_points[seen]).apply_to_poses(poses)
        turn = so3_log(aligned[..., :3].mT @ truths[..., :3])
        shift = (truths[..., :3].mT @ (aligned - truths)[..., 3:])[..., 0]
        rows.append(torch.cat([turn, shift], dim=-1))
    return torch.stack(rows)


def assert_calibrated(errors: Tensor, expected: Tensor) -> None:
    """Whitened by what is expected, the errors' covariance is the identity as well as so many draws can tell."""
    whitened = torch.linalg.solve_triangular(torch.linalg.cholesky(expected), errors[..., None], upper=False)[..., 0]
    empirical = torch.einsum("dni,dnj->nij", whitened, whitened) / len(errors)
    identity = torch.eye(6, dtype=torch.float64)
    assert (empirical - identity).abs().max() < 0.4  # about 4.5 standard deviations of the worst entry
    assert float(empirical.diagonal(dim1=1, dim2=2).mean()) == pytest.approx(1.0, abs=0.06)


@pytest.mark.parametrize("variant", ["plain", "focal", "unseen"])
def test_many_draws_scatter_as_the_covariance_says(variant):
    problem, truth = scene(
        views=6, joints=14, batch=DRAWS, noise_px=NOISE_PX, seen=1.0, refine=("focal",) if variant == "focal" else ()
    )
    problem = replace(problem, weight=torch.ones_like(problem.weight))
    truth = replace(truth, intrinsics=torch.zeros(DRAWS, len(problem.refine), dtype=torch.float64))
    if variant == "unseen":
        problem.weight[:, :, 3] = 0
        problem.weight[:, 2:, 5] = 0
    result = adjust(problem, truth, LmConfig(loss="none"))
    assert result.converged.all()
    seen = (problem.weight[0] > 0).any(0)
    assert_calibrated(camera_errors(result.state, truth, seen), covariance(problem, truth))


def test_weights_are_part_of_it():
    problem, truth = scene(views=6, joints=14, batch=DRAWS, noise_px=NOISE_PX, seen=1.0)
    exact = residuals(problem, truth).error
    worse = (torch.arange(14) % 2 == 0).double() * 3 + 1  # every other point has four times the noise
    uv = problem.uv - (worse - 1) * exact
    problem = replace(problem, uv=uv, weight=worse.pow(-2).expand_as(problem.weight).contiguous())
    result = adjust(problem, truth, LmConfig(loss="none"))
    assert_calibrated(camera_errors(result.state, truth, torch.ones(14, dtype=torch.bool)), covariance(problem, truth))


def test_shapes_drawn_from_the_prior_scatter_as_the_covariance_says():
    problem, truth = scene(views=3, joints=14, batch=DRAWS, seen=1.0)
    mean = truth.points[0]
    precision = torch.eye(42, dtype=torch.float64) / SHAPE_M**2
    truth = replace(truth, points=truth.points + SHAPE_M * randn(DRAWS, 14, 3, seed=31))
    exact = residuals(replace(problem, weight=torch.ones_like(problem.weight)), truth).error + problem.uv
    problem = replace(
        problem,
        uv=exact + NOISE_PX * randn(*exact.shape, seed=32),
        weight=torch.ones_like(problem.weight),
        shape=replace(ShapePrior.of(mean, precision), freedom=1e9),
    )
    problem.weight[:, 1:, :5] = 0  # seen once: nothing without the prior
    result = adjust(problem, truth, LmConfig(loss="none"))
    assert_calibrated(camera_errors(result.state, truth, torch.ones(14, dtype=torch.bool)), covariance(problem, truth))


def test_the_world_does_not_matter_and_centres_scale_with_it():
    problem, truth = scene(views=6, joints=14, noise_px=NOISE_PX)
    here, there = covariance(problem, truth), covariance(problem, moved(truth, SIMILARITY))
    scale = torch.tensor([1.0] * 3 + [float(SIMILARITY.scale)] * 3, dtype=torch.float64)
    torch.testing.assert_close(there, scale[:, None] * here * scale, rtol=1e-5, atol=1e-12)


def test_it_is_symmetric_positive_and_grows_with_the_noise():
    problem, truth = scene(views=6, joints=14)
    small = covariance(problem, truth, 0.5)
    torch.testing.assert_close(small, small.mT)
    assert (torch.linalg.eigvalsh(small) > 0).all()
    torch.testing.assert_close(covariance(problem, truth, 1.5), 9 * small, rtol=1e-6, atol=0)


def test_more_views_of_the_same_points_tell_each_camera_better():
    problem, truth = scene(views=12, joints=14, seen=1.0)
    few = torch.arange(4)
    part = replace(problem, uv=problem.uv[:, few], weight=problem.weight[:, few])
    state = State.of(truth.c2w[:, few], truth.points)
    whole, half = covariance(problem, truth)[few], covariance(part, state)
    assert (torch.linalg.eigvalsh(half - whole) > -1e-9 * half.diagonal(dim1=1, dim2=2).amax(1)[:, None]).all()


def test_a_camera_that_sees_nothing_is_not_known():
    problem, truth = scene(views=6, joints=14)
    problem.weight[:, 4] = 0
    spread = covariance(problem, truth).diagonal(dim1=1, dim2=2)
    assert spread.isfinite().all()
    assert spread[4].min() > 100 * spread[[0, 1, 2, 3, 5]].max()


def test_a_batch_is_its_scenes_one_by_one():
    problem, truth = scene(views=5, joints=10, batch=3)
    sigma = NOISE_PX * torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    together = camera_covariance(problem, truth, problem.weight > 0, sigma, torch.ones(3, dtype=torch.float64))
    for i in range(3):
        chosen = torch.tensor([i])
        torch.testing.assert_close(
            covariance(problem[chosen], truth[chosen], float(sigma[i])), together[i], rtol=1e-6, atol=1e-12
        )


@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("seed", range(5))
def test_a_view_with_too_few_points_for_a_pose_is_no_trouble_to_the_others(count, seed):
    problem, truth = scene(views=6, joints=14, seen=1.0, seed=10 * seed)
    whole = covariance(problem, truth)
    problem.weight[:, 4, count:] = 0
    thin = covariance(problem, truth)
    assert thin.isfinite().all()
    kept = [0, 1, 2, 3, 5]
    assert (thin[kept].diagonal(dim1=1, dim2=2) > 0.9 * whole[kept].diagonal(dim1=1, dim2=2)).all()
    assert (thin[kept].diagonal(dim1=1, dim2=2) < 3 * whole[kept].diagonal(dim1=1, dim2=2)).all()
    assert thin[4].diagonal().max() > 3 * whole[4].diagonal().max()


@pytest.mark.parametrize("with_prior", [False, True])
def test_the_compiled_covariances_are_those_of_the_tensors(with_prior):
    """An orbit that expects nothing keeps a problem from being compiled and changes nothing else."""
    problem, truth = scene(7, 12, 3, noise_px=1.0)
    problem.weight[0, 2], problem.weight[1, :, 4] = 0, 0
    inlier = (problem.weight > 0) & (randn(*problem.weight.shape, seed=3) < 1.5)
    if with_prior:
        root = randn(36, 36, seed=4)
        problem = replace(problem, shape=ShapePrior.of(truth.points[0], root @ root.T / 12))
    sigma, shape_weight = 0.5 + randn(2, 3, seed=5).abs()
    nowhere = OrbitPrior(truth.c2w[..., 3], torch.full(inlier.shape[:2], torch.inf, dtype=torch.float64))
    ours = camera_covariance(problem, truth, inlier, sigma, shape_weight)
    theirs = camera_covariance(replace(problem, orbit=nowhere), truth, inlier, sigma, shape_weight)
    torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-9)
