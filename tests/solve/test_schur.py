"""The normal equations, the elimination of the cameras and the gauge."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from kronc_ns.geometry import rotations
from kronc_ns.geometry.rotations import skew
from kronc_ns.solve.bundle import (
    Linearisation,
    Step,
    eliminate_cameras,
    linearise,
    move,
    orbit_error,
    residuals,
    solve_step,
)
from kronc_ns.solve.problem import OrbitPrior, Problem, ShapePrior, State
from kronc_ns.solve.uncertainty import camera_covariance
from tests.solve.problems import SIMILARITY, moved, randn, scene, started

VIEWS, JOINTS = 4, 6
VARIANTS = {
    "plain": {},
    "focal": {"refine": ("focal",)},
    "focal and k1": {"refine": ("focal", "k1")},
    "shape": {"shape": True},
    "orbit": {"orbit": True},
    "everything": {"refine": ("k1", "focal"), "shape": True, "orbit": True},
}


def shape_prior(joints: int) -> ShapePrior:
    root = randn(3 * joints, 3 * joints, seed=20)
    return ShapePrior.of(0.5 * randn(joints, 3, seed=21), root @ root.T / joints)


def orbit_prior(truth: State) -> OrbitPrior:
    centre = truth.c2w[..., 3] + 0.1 * randn(*truth.translation.shape, seed=22)
    sigma = torch.full(centre.shape[:2], 0.2, dtype=torch.float64)
    sigma[:, 1] = torch.inf  # nothing is expected of this view
    return OrbitPrior(centre, sigma)


def posed(variant: str, batch: int = 1) -> tuple[Problem, State, Tensor]:
    """A problem, a state off the solution (k1 = 0) and IRLS weights."""
    options = VARIANTS[variant]
    problem, truth = scene(VIEWS, JOINTS, batch, noise_px=2.0, refine=options.get("refine", ()))
    problem = replace(
        problem,
        shape=shape_prior(JOINTS) if "shape" in options else None,
        orbit=orbit_prior(truth) if "orbit" in options else None,
    )
    state = started(truth, unknown=len(problem.refine))
    if "focal" in problem.refine:
        state.intrinsics[:, problem.refine.index("focal")] = 0.1
    weight = torch.rand(batch, VIEWS, JOINTS, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    return problem, state, weight


VARIANCE, SHAPE_WEIGHT = torch.tensor([2.3], dtype=torch.float64), torch.tensor([0.7], dtype=torch.float64)


def systems(variant: str, batch: int = 1) -> tuple[Problem, State, Tensor, Linearisation]:
    problem, state, weight = posed(variant, batch)
    ones = torch.ones(batch, dtype=torch.float64)
    arguments = (VARIANCE * ones, SHAPE_WEIGHT * ones)
    return problem, state, weight, linearise(problem, state, residuals(problem, state), weight, *arguments)


def step_of(flat: Tensor, unknown: int) -> Step:
    """(cameras, points in planar order, intrinsics) as a step of one scene."""
    cameras, points = flat[: 6 * VIEWS].view(1, VIEWS, 6), flat[6 * VIEWS :][: 3 * JOINTS]
    return Step(cameras, points.view(1, 3, JOINTS).mT, flat[6 * VIEWS + 3 * JOINTS :].view(1, unknown))


def reprojection(problem: Problem, state: State) -> Tensor:
    """Projection minus detection in pixels by the book, [b, n, 2, j]."""
    camera = state.rotation @ state.points.mT[:, None] + state.translation[..., None]
    plane = camera[:, :, :2] / camera[:, :, 2:]
    unknown = dict(zip(problem.refine, state.intrinsics.unbind(1), strict=True))
    zero = torch.zeros(len(plane), dtype=torch.float64)
    bent = plane * (1 + unknown.get("k1", zero)[:, None, None, None] * plane.square().sum(2, keepdim=True))
    return bent * (problem.focal * unknown.get("focal", zero).exp()[:, None])[:, None, :, None] - problem.uv


def weighted_residuals(problem: Problem, state: State, weight: Tensor):
    """All residuals of a step from ``state``, such that half their squares' sum is what the step shall lower."""

    def function(flat: Tensor) -> Tensor:
        trial = move(state, step_of(flat, len(problem.refine)))
        rows = [((weight * problem.weight).sqrt()[:, :, None] * reprojection(problem, trial)).flatten()]
        if problem.shape is not None:
            root = torch.linalg.cholesky(problem.shape.precision).T
            deviation = trial.points.mT.flatten() - problem.shape.mean
            rows.append((VARIANCE * SHAPE_WEIGHT).sqrt() * (root @ deviation))
        if problem.orbit is not None:
            rows.append(
                (VARIANCE.sqrt() / problem.orbit.sigma[..., None] * orbit_error(problem.orbit, trial)).flatten()
            )
        return torch.cat(rows)

    return function


def dense(system: Linearisation) -> tuple[Tensor, Tensor]:
    """Matrix and gradient of one scene's whole system."""
    cameras, size = 6 * VIEWS, system.point.shape[-1]
    matrix = torch.zeros(cameras + size, cameras + size, dtype=torch.float64)
    matrix[:cameras, :cameras] = torch.block_diag(*system.camera[0])
    coupling = system.coupling[0].reshape(cameras, size + 1)
    matrix[:cameras, cameras:] = coupling[:, :size]
    matrix[cameras:, :cameras] = coupling[:, :size].T
    matrix[cameras:, cameras:] = system.point[0]
    return matrix, torch.cat([coupling[:, size], system.point_gradient[0]])


@pytest.mark.parametrize("variant", VARIANTS)
def test_gradient_and_gauss_newton_blocks_are_those_of_autograd(variant):
    problem, state, weight, system = systems(variant)
    function = weighted_residuals(problem, state, weight)
    zero = torch.zeros(6 * VIEWS + 3 * JOINTS + len(problem.refine), dtype=torch.float64)
    jacobian = torch.func.jacfwd(function)(zero)
    if problem.orbit is not None:  # turning moves a centre only in second order of how far it is from expected
        jacobian[-3 * VIEWS :] = orbit_jacobian(problem, state, len(zero))
    matrix, gradient = dense(system)
    torch.testing.assert_close(matrix, jacobian.T @ jacobian, rtol=1e-9, atol=1e-7)
    torch.testing.assert_close(gradient, jacobian.T @ function(zero), rtol=1e-9, atol=1e-7)


def orbit_jacobian(problem: Problem, state: State, size: int) -> Tensor:
    rows = torch.zeros(VIEWS, 3, size, dtype=torch.float64)
    for i in range(VIEWS):
        rows[i, :, 6 * i + 3 : 6 * i + 6] = VARIANCE.sqrt() / problem.orbit.sigma[0, i] * torch.eye(3)
    return rows.flatten(0, 1)


def test_the_orbits_error_is_the_centres_distance_from_where_it_is_expected():
    problem, state, _ = posed("orbit")
    error = orbit_error(problem.orbit, state)
    torch.testing.assert_close(error.norm(dim=-1), (problem.orbit.centre - state.c2w[..., 3]).norm(dim=-1))
    torch.testing.assert_close((state.rotation.mT @ error[..., None])[..., 0], problem.orbit.centre - state.c2w[..., 3])


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("damping", [1e-3, 10.0])
def test_eliminating_the_cameras_gives_the_step_of_the_whole_system(variant, damping):
    problem, _, _, system = systems(variant)
    step = solve_step(eliminate_cameras(system, torch.tensor([damping], dtype=torch.float64)), JOINTS)
    matrix, gradient = dense(system)
    damped = matrix + damping * matrix.diagonal().diag()
    expected = step_of(torch.linalg.solve(damped, -gradient), len(problem.refine))
    for ours, theirs in zip(vars(step).values(), vars(expected).values(), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("variant", VARIANTS)
def test_errors_are_projections_less_detections_where_something_is_seen(variant):
    problem, state, _ = posed(variant, batch=2)
    if "k1" in problem.refine:
        state.intrinsics[:, problem.refine.index("k1")] = -0.07
    found, seen = residuals(problem, state), problem.weight > 0
    expected = torch.where(seen[:, :, None], reprojection(problem, state), 0.0)
    torch.testing.assert_close(found.error, expected, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(found.norm, (expected.square().sum(2) * problem.weight).sqrt(), rtol=1e-9, atol=1e-9)


def test_a_damped_step_lowers_the_cost():
    problem, state, weight, system = systems("everything")
    function = weighted_residuals(problem, state, weight)
    step = solve_step(eliminate_cameras(system, torch.tensor([1e-3], dtype=torch.float64)), JOINTS)
    flat = torch.cat([step.camera.flatten(), step.points.mT.flatten(), step.intrinsics.flatten()])
    assert function(flat).square().sum() < 0.5 * function(torch.zeros_like(flat)).square().sum()


def test_no_similarity_of_the_world_shows_in_the_images():
    problem, truth = scene(noise_px=1.0)
    state = started(truth)
    here, there = residuals(problem, state), residuals(problem, moved(state, SIMILARITY))
    torch.testing.assert_close(there.error, here.error, rtol=1e-9, atol=1e-8)
    torch.testing.assert_close(there.norm, here.norm, rtol=1e-9, atol=1e-8)


def gauge_directions(points: Tensor) -> Tensor:
    """Shift, turn and growth of the points in planar order, [3J, 7]."""
    moves = [torch.eye(3, dtype=torch.float64).expand(len(points), 3, 3), -skew(points), points[..., None]]
    return torch.cat(moves, dim=-1).transpose(0, 1).flatten(0, 1)


def test_the_reduced_matrix_has_the_seven_null_vectors_of_the_gauge_and_no_more():
    problem, truth = scene(views=6, joints=10, seen=1.0)
    weight = torch.ones_like(problem.weight)
    one = torch.ones(1, dtype=torch.float64)
    system = linearise(problem, truth, residuals(problem, truth), weight, one, one)
    matrix = eliminate_cameras(system, torch.zeros(1, dtype=torch.float64)).matrix[0]
    gauge = gauge_directions(truth.points[0])
    assert (matrix @ gauge).norm() < 1e-9 * matrix.norm() * gauge.norm()
    values = torch.linalg.eigvalsh(matrix)
    assert values[6] < 1e-9 * values[-1] < 1e-3 * values[7]


def test_a_shape_prior_leaves_no_gauge():
    problem, truth = scene(views=6, joints=10, seen=1.0)
    problem = replace(problem, shape=shape_prior(10))
    one = torch.ones(1, dtype=torch.float64)
    system = linearise(problem, truth, residuals(problem, truth), torch.ones_like(problem.weight), one, one)
    values = torch.linalg.eigvalsh(eliminate_cameras(system, torch.zeros(1, dtype=torch.float64)).matrix[0])
    assert values[0] > 1e-9 * values[-1]


@pytest.mark.parametrize("variant", ["plain", "everything"])
def test_a_batch_is_its_scenes_one_by_one(variant):
    problem, state, weight, system = systems(variant, batch=3)
    damping = torch.tensor([1e-3, 1.0, 10.0], dtype=torch.float64)
    together = solve_step(eliminate_cameras(system, damping), JOINTS)
    for i in range(3):
        chosen = torch.tensor([i])
        one, at = problem[chosen], state[chosen]
        single = linearise(one, at, residuals(one, at), weight[chosen], VARIANCE, SHAPE_WEIGHT)
        step = solve_step(eliminate_cameras(single, damping[chosen]), JOINTS)
        for ours, theirs in zip(vars(step).values(), vars(together).values(), strict=True):
            torch.testing.assert_close(ours, theirs[chosen], rtol=1e-8, atol=1e-10)


def test_unseen_points_and_empty_views_stay_where_they_are():
    problem, state, weight = posed("plain")
    problem.weight[:, 2] = 0
    problem.weight[:, :, 4] = 0
    problem.uv[:, 2], problem.uv[:, :, :, 4] = 1e5, -1e5  # ignored
    one = torch.ones(1, dtype=torch.float64)
    system = linearise(problem, state, residuals(problem, state), weight, one, one)
    step = solve_step(eliminate_cameras(system, 1e-3 * one), JOINTS)
    assert (step.camera[:, 2] == 0).all()
    assert (step.points[:, 4] == 0).all()
    assert all(part.isfinite().all() for part in vars(step).values())
    assert (step.camera[:, [0, 1, 3]].abs().amax(-1) > 0).all()
    assert (step.points[:, [0, 1, 2, 3, 5]].abs().amax(-1) > 0).all()


def test_nothing_seen_at_all_moves_nothing():
    problem, state, weight = posed("plain")
    problem = replace(problem, weight=torch.zeros_like(problem.weight))
    one = torch.ones(1, dtype=torch.float64)
    system = linearise(problem, state, residuals(problem, state), weight, one, one)
    step = solve_step(eliminate_cameras(system, 1e-3 * one), JOINTS)
    assert all((part == 0).all() for part in vars(step).values())


def test_points_behind_a_camera_are_far_off_and_pull_at_nothing():
    problem, truth = scene(VIEWS, JOINTS, seen=1.0)
    turned = replace(truth, rotation=truth.rotation.clone(), translation=truth.translation.clone())
    turned.rotation[:, 1, [0, 2]] *= -1
    turned.translation[:, 1, [0, 2]] *= -1  # half a turn about the camera's y axis
    found = residuals(problem, turned)
    assert (found.norm[:, 1] > 1e3).all()
    assert (found.error[:, 1] == 0).all()
    assert found.norm[:, [0, 2, 3]].max() < 1e-9
    assert found.inverse_z.isfinite().all()


def test_a_step_and_its_opposite_are_the_identity_to_first_order():
    _, state, _ = posed("focal")
    step = step_of(1e-4 * randn(6 * VIEWS + 3 * JOINTS + 1), 1)
    back = Step(-step.camera, -step.points, -step.intrinsics)
    there_and_back = move(move(state, step), back)
    for ours, theirs in zip(vars(there_and_back).values(), vars(state).values(), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-6)
    identity = torch.eye(3, dtype=torch.float64).expand(1, VIEWS, 3, 3)
    torch.testing.assert_close(there_and_back.rotation @ there_and_back.rotation.mT, identity)


def test_states_and_poses_are_inverse():
    _, truth = scene(batch=2)
    torch.testing.assert_close(State.of(truth.c2w, truth.points).rotation, truth.rotation)
    torch.testing.assert_close(State.of(truth.c2w, truth.points).translation, truth.translation)


def test_the_prior_of_a_shape_is_reordered_with_its_covariance():
    mean, prior = 0.5 * randn(JOINTS, 3, seed=21), shape_prior(JOINTS)
    root = randn(3 * JOINTS, 3 * JOINTS, seed=20)
    offset = randn(JOINTS, 3, seed=23)
    planar = (mean + offset).T.flatten() - prior.mean
    expected = offset.flatten() @ (root @ root.T / JOINTS) @ offset.flatten()
    torch.testing.assert_close(planar @ prior.precision @ planar, expected)


@pytest.mark.parametrize("variant", ["plain", "everything"])
def test_a_step_and_its_covariance_stay_on_one_gpu(variant, monkeypatch):
    """Fake tensors know their device though there is none: mixing it with another raises."""
    monkeypatch.setattr(rotations, "_generators", rotations._generators.__wrapped__)  # no fake one is to be kept
    problem, truth, _, _ = systems(variant, batch=2)
    problem = replace(problem, shape=shape_prior(problem.uv.shape[3]))
    with FakeTensorMode(allow_non_fake_inputs=True):
        gpu = torch.device("cuda")
        problem, state = problem.to(gpu), truth.each(lambda x: x.to(gpu))
        one = torch.ones(2, dtype=torch.float64, device=gpu)
        system = linearise(problem, state, residuals(problem, state), problem.weight, one, one)
        state = move(state, solve_step(eliminate_cameras(system, one), problem.uv.shape[3]))
        covariance = camera_covariance(problem, state, problem.weight > 0, one, one)
        for result in (state.points, state.c2w, covariance):
            assert result.device.type == "cuda"
