"""The second-order solver: exact recovery, maximum likelihood without outliers, and little harm with them."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from kronc_ns.geometry.alignment import pose_errors
from kronc_ns.geometry.camera import Camera
from kronc_ns.keypoints.schema import KeypointSchema
from kronc_ns.scene import Scene
from kronc_ns.solve.bundle import residuals
from kronc_ns.solve.lm import LmConfig, LmResult, adjust
from kronc_ns.solve.problem import OrbitPrior, Problem, ShapePrior, State, focal_of
from tests.likelihood import maximum_likelihood
from tests.solve.problems import FOCAL, SIMILARITY, moved, randn, scene, started


def errors(result: LmResult, truth: State, i: int = 0) -> tuple[Tensor, Tensor]:
    return pose_errors(result.state.c2w[i], truth.c2w[i])


@pytest.mark.parametrize("loss", ["cauchy", "huber", "none"])
def test_exact_keypoints_give_exact_poses(loss):
    problem, truth = scene(views=10, joints=15)
    result = adjust(problem, started(truth, 7.0, 0.5), LmConfig(loss=loss, tolerance=1e-9))
    assert result.converged.all()
    rotation, translation = errors(result, truth)
    assert rotation.max() < 1e-4
    assert translation.max() < 1e-5
    assert residuals(problem, result.state).norm.max() < 1e-3
    assert (result.inlier == (problem.weight > 0)).all()


def as_scene(problem: Problem) -> Scene:
    """The first scene of a batch, of a camera with its principal point in the middle of 400 x 400 pixels."""
    views, _, joints = problem.uv.shape[1:]
    schema = KeypointSchema("dots", tuple(f"dot {j}" for j in range(joints)), tuple(range(joints)))
    keypoints = torch.cat([problem.uv[0].mT + 200, (problem.weight[0] > 0).double()[..., None]], dim=-1)
    return Scene(tuple(map(str, range(views))), Camera(*FOCAL, 200.0, 200.0, 400, 400), schema, keypoints)


@pytest.mark.parametrize("loss", ["cauchy", "none"])
def test_without_outliers_the_result_is_the_maximum_likelihood_one(loss):
    problem, truth = scene(views=8, joints=14, noise_px=1.0, seen=0.9)
    problem = replace(problem, weight=(problem.weight > 0).double())
    result = adjust(problem, started(truth), LmConfig(loss=loss))
    best = maximum_likelihood(as_scene(problem), truth.c2w[0], truth.points[0], robust=False)
    limit, ours = pose_errors(best, truth.c2w[0])[0], pose_errors(result.state.c2w[0], best)[0]
    assert limit.mean() > 0.1
    assert ours.max() < 0.02 * limit.mean()


def test_three_in_ten_outliers_barely_move_it():
    problem, truth = scene(views=20, joints=40, batch=3, noise_px=1.0, outliers=0.3, seen=0.8)
    wild = (residuals(problem, truth).norm > 15) & (problem.weight > 0)
    assert 0.25 < float(wild.sum() / (problem.weight > 0).sum()) < 0.35
    clean = replace(problem, weight=torch.where(wild, 0.0, problem.weight))
    start = started(truth, 4.0, 0.3)
    robust, oracle, blind = adjust(problem, start), adjust(clean, start), adjust(problem, start, LmConfig(loss="none"))
    assert (robust.inlier & wild).sum() < 0.01 * wild.sum()
    for i in range(3):
        ours, best, naive = (errors(result, truth, i)[0].mean() for result in (robust, oracle, blind))
        assert ours < 1.1 * best
        assert naive > 5 * best


def test_huber_lies_between():
    problem, truth = scene(views=20, joints=40, noise_px=1.0, outliers=0.1, seen=0.8)
    start = started(truth, 4.0, 0.3)
    cauchy, huber, none = (
        errors(adjust(problem, start, LmConfig(loss=loss)), truth)[0].mean() for loss in ("cauchy", "huber", "none")
    )
    assert cauchy < huber < 0.5 * none


@pytest.mark.parametrize("outliers", [0.0, 0.3])
def test_the_noise_is_told_from_the_residuals_whatever_the_outliers(outliers):
    problem, truth = scene(views=20, joints=40, batch=8, noise_px=1.5, outliers=outliers, seen=0.9)
    problem = replace(problem, weight=(problem.weight > 0).double())
    result = adjust(problem, started(truth, 1.0, 0.05))
    assert float(result.sigma_px.mean()) == pytest.approx(1.5, rel=0.06)


def test_weights_count_as_inverse_variances():
    """Half of the detections have ten times the noise: saying so in their weights helps."""
    problem, truth = scene(views=10, joints=20, batch=20, noise_px=1.0, seen=0.9)
    coarse = torch.rand(problem.weight.shape, generator=torch.Generator().manual_seed(0)) < 0.5
    exact = residuals(problem, truth).error  # projection minus detection
    problem = replace(
        problem,
        uv=problem.uv - torch.where(coarse, 9.0, 0.0)[:, :, None] * exact,  # ten times the noise
        weight=torch.where(problem.weight > 0, torch.where(coarse, 0.01, 1.0), 0.0).double(),
    )
    start = started(truth, 1.0, 0.05)
    weighted, flat = adjust(problem, start), adjust(replace(problem, weight=(problem.weight > 0).double()), start)
    assert float(weighted.sigma_px.mean()) == pytest.approx(1.0, rel=0.15)
    better = [errors(weighted, truth, i)[0].mean() < errors(flat, truth, i)[0].mean() for i in range(20)]
    assert sum(better) >= 18


@pytest.mark.parametrize("loss", ["huber", "none"])
def test_the_cost_never_increases(loss):
    problem, truth = scene(views=10, joints=20, noise_px=1.0, outliers=0.2)
    history = adjust(problem, started(truth, 10.0, 0.8), LmConfig(loss=loss)).history()
    assert history["step"] == list(range(1, len(history["step"]) + 1))
    assert len(history["loss"]) > 3
    assert all(later <= earlier for earlier, later in zip(history["loss"], history["loss"][1:], strict=False))


def test_a_scene_does_not_depend_on_the_others_in_its_batch():
    """An easy scene leaves the batch early, a hard one late, and each ends where it ends alone."""
    problem, truth = scene(views=9, joints=16, batch=3, noise_px=1.0, outliers=0.1)
    near, far = started(truth, 0.1, 0.01), started(truth, 12.0, 0.8)
    start = near.each(lambda a, b: torch.cat([a[:1], b[1:2], a[2:]]), far)
    together = adjust(problem, start)
    assert len(set(together.iterations.tolist())) > 1
    for i in range(3):
        chosen = torch.tensor([i])
        alone = adjust(problem[chosen], start[chosen])
        assert alone.iterations[0] == together.iterations[i]
        torch.testing.assert_close(alone.state.c2w[0], together.state.c2w[i], rtol=0, atol=1e-8)
        torch.testing.assert_close(alone.state.points[0], together.state.points[i], rtol=0, atol=1e-8)
        torch.testing.assert_close(alone.cost[0], together.cost[i], rtol=1e-6, atol=0)
        torch.testing.assert_close(alone.sigma_px[0], together.sigma_px[i], rtol=1e-8, atol=0)
        assert alone.inlier[0].equal(together.inlier[i])
        assert alone.history() == together.history(i)


def test_same_input_same_bits():
    problem, truth = scene(views=6, joints=12, batch=2, noise_px=1.0, outliers=0.1)
    first, second = (adjust(problem, started(truth)) for _ in range(2))
    for part in ("rotation", "translation", "points"):
        assert torch.equal(getattr(first.state, part), getattr(second.state, part))
    assert torch.equal(first.cost, second.cost)
    assert first.history() == second.history()


def test_everything_is_double_precision():
    problem, truth = scene(noise_px=1.0)
    result = adjust(problem, started(truth))
    parts = (*vars(result.state).values(), result.cost, result.sigma_px, result.shape_weight)
    assert {part.dtype for part in parts} == {torch.float64}


def test_the_start_is_left_as_it_was():
    problem, truth = scene(noise_px=1.0)
    start = started(truth)
    before = start.each(lambda x: x.clone())
    adjust(problem, start)
    assert all(a.equal(b) for a, b in zip(vars(start).values(), vars(before).values(), strict=True))


def test_the_world_it_starts_in_does_not_matter():
    problem, truth = scene(views=8, joints=16, noise_px=1.0, outliers=0.1)
    start = started(truth)
    here, there = adjust(problem, start), adjust(problem, moved(start, SIMILARITY))
    rotation, translation = pose_errors(there.state.c2w[0], here.state.c2w[0])
    assert rotation.max() < 1e-3
    assert translation.max() < 1e-4
    torch.testing.assert_close(here.cost, there.cost, rtol=1e-2, atol=0)


def test_a_camera_that_looks_away_does_not_harm_the_others():
    problem, truth = scene(views=8, joints=16, noise_px=0.5)
    start = started(truth)
    start.rotation[:, 2, [0, 2]] *= -1
    start.translation[:, 2, [0, 2]] *= -1
    result = adjust(problem, start)
    kept = torch.arange(8) != 2
    rotation, _ = pose_errors(result.state.c2w[0][kept], truth.c2w[0][kept])
    assert rotation.mean() < 0.3
    assert result.state.c2w.isfinite().all()
    assert not result.inlier[0, 2].any()


def test_points_that_start_behind_cameras_do_not_harm_the_poses():
    problem, truth = scene(views=8, joints=16, noise_px=0.5, seen=1.0)
    start = started(truth)
    start.points[0, :3] *= 12  # metres beyond the cameras, behind some
    assert (residuals(problem, start).norm > 5000).any()
    result = adjust(problem, start)
    assert errors(result, truth)[0].mean() < 0.3
    assert result.inlier[:, :, 3:].all()


def test_too_few_iterations_are_no_convergence():
    problem, truth = scene(views=8, joints=16, noise_px=1.0)
    result = adjust(problem, started(truth), LmConfig(iterations=2))
    assert not result.converged.any()
    assert result.iterations.tolist() == [2]
    assert result.state.c2w.isfinite().all()


def test_progress_is_told_every_step():
    problem, truth = scene(views=6, joints=12, noise_px=1.0)
    calls = []
    result = adjust(problem, started(truth), progress=lambda step, loss: calls.append((step, loss)))
    assert [step for step, _ in calls] == list(range(1, int(result.iterations[0]) + 1))
    assert [loss for _, loss in calls] == result.history()["loss"]


def test_empty_views_and_unseen_points_stay_where_they_were():
    problem, truth = scene(views=8, joints=16, noise_px=0.5)
    problem.weight[:, 3] = 0
    problem.weight[:, :, 5] = 0
    start = started(truth)
    result = adjust(problem, start)
    assert result.state.c2w[:, 3].equal(start.c2w[:, 3])
    assert result.state.points[:, 5].equal(start.points[:, 5])
    kept = torch.arange(8) != 3
    assert pose_errors(result.state.c2w[0][kept], truth.c2w[0][kept])[0].mean() < 0.3


def test_nothing_to_see_ends_at_once():
    problem, truth = scene()
    result = adjust(replace(problem, weight=torch.zeros_like(problem.weight)), started(truth))
    assert result.state.c2w.isfinite().all()
    assert result.iterations.max() < 20
    assert not result.inlier.any()


def test_a_batch_of_no_scenes_has_no_results():
    problem, truth = scene()
    nobody = torch.zeros(0, dtype=torch.long)
    result = adjust(problem[nobody], started(truth)[nobody])
    assert result.state.c2w.shape == (0, 8, 3, 4)
    assert len(result.converged) == 0


@pytest.mark.parametrize("factor", [0.75, 1.25])
def test_a_wrong_focal_length_is_found(factor):
    problem, truth = scene(views=12, joints=20, refine=("focal",))
    wrong = replace(problem, focal=factor * problem.focal)
    result = adjust(wrong, started(truth, unknown=1), LmConfig(tolerance=1e-9))
    torch.testing.assert_close(focal_of(wrong, result.state), problem.focal, rtol=1e-4, atol=0)
    assert errors(result, truth)[0].max() < 0.01


def test_a_shape_prior_holds_the_world_and_what_is_seen_once():
    problem, truth = scene(views=8, joints=16, noise_px=1.0, seen=1.0)
    problem.weight[:, 1:, 4] = 0  # one view only: its depth is open without a prior
    mean = truth.points[0] + 0.02 * randn(16, 3, seed=3)
    prior = ShapePrior.of(mean, torch.eye(48, dtype=torch.float64) / 0.02**2)
    result = adjust(replace(problem, shape=prior), moved(started(truth), SIMILARITY))
    assert (result.state.points - truth.points).norm(dim=-1).max() < 0.08
    assert (result.state.c2w - truth.c2w)[..., 3].norm(dim=-1).max() < 0.15
    assert float(result.shape_weight) > 0.9


def test_data_overrule_the_prior_of_another_shape():
    problem, truth = scene(views=12, joints=16, noise_px=0.5, seen=1.0)
    prior = ShapePrior.of(truth.points[0] * 1.5 + 0.1, torch.eye(48, dtype=torch.float64) / 0.05**2)
    stretched = ShapePrior.of(
        truth.points[0] * torch.tensor([1.6, 1.0, 0.7], dtype=torch.float64),
        torch.eye(48, dtype=torch.float64) / 0.05**2,
    )
    alike, odd = (adjust(replace(problem, shape=shape), started(truth)) for shape in (prior, stretched))
    assert float(odd.shape_weight) < float(alike.shape_weight)
    best = errors(adjust(problem, started(truth)), truth)[0].mean()
    assert errors(odd, truth)[0].mean() < 2 * best


def test_an_orbit_carries_views_that_see_nothing():
    problem, truth = scene(views=8, joints=16, noise_px=0.5)
    problem.weight[:, 3] = 0
    expected = truth.c2w[..., 3] + 0.01 * randn(1, 8, 3, seed=4)
    sigma = torch.full((1, 8), math.inf, dtype=torch.float64)
    sigma[0, 3] = 0.1
    result = adjust(replace(problem, orbit=OrbitPrior(expected, sigma)), started(truth))
    torch.testing.assert_close(result.state.c2w[0, 3, :, 3], expected[0, 3], rtol=0, atol=1e-3)


@pytest.mark.parametrize("variant", ["plain", "shape", "points known"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_compiled_loop_takes_the_tensors_way(variant, seed):
    """An orbit that expects nothing keeps a problem from being compiled and changes nothing else."""
    problem, truth = scene(10, 14, 2, noise_px=0.7, outliers=0.15, seed=10 * seed)
    problem.weight[0, 2] = 0
    if variant == "shape":
        root = randn(42, 42, seed=seed)
        problem = replace(problem, shape=ShapePrior.of(truth.points[0], root @ root.T / 14))
    problem = replace(problem, points_known=variant == "points known")
    start = started(truth, 8.0, 0.5, seed=seed)
    if problem.points_known:
        start = replace(start, points=truth.points)
    nowhere = OrbitPrior(truth.c2w[..., 3], torch.full(problem.uv.shape[:2], torch.inf, dtype=torch.float64))
    steps: list[tuple[int, float]] = []
    ours = adjust(problem, start, progress=lambda *step: steps.append(step))
    theirs = adjust(replace(problem, orbit=nowhere), start)
    assert ours.iterations.tolist() == theirs.iterations.tolist()
    assert ours.converged.all()
    assert theirs.converged.all()
    assert torch.equal(ours.inlier, theirs.inlier)
    for name in ("cost", "sigma_px", "shape_weight"):
        torch.testing.assert_close(getattr(ours, name), getattr(theirs, name), rtol=1e-7, atol=1e-9)
    residual = [residuals(problem, result.state).norm for result in (ours, theirs)]
    torch.testing.assert_close(*residual, rtol=1e-5, atol=1e-5)  # the gauge is free
    assert ours.path(0)[-1].equal(ours.state.c2w[0])
    spread = [
        result.path(1)[..., 3].sub(result.path(1)[..., 3].mean(1, True)).norm(dim=-1) for result in (ours, theirs)
    ]
    torch.testing.assert_close(*spread, rtol=1e-5, atol=1e-5)
    assert steps == list(zip(range(1, len(steps) + 1), ours.history()["loss"], strict=True))
    torch.testing.assert_close(torch.tensor(ours.history()["loss"]), torch.tensor(theirs.history()["loss"]))
