"""Normal equations and steps of many scenes as tensors, against the same book as the compiled ones."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

from kronc_ns.solve import tensors
from kronc_ns.solve.problem import Problem, State
from tests.solve import book
from tests.solve.problems import BELIEF, VARIANCE, VARIANTS, evaluated, posed
from tests.solve.test_schur import assert_alike


def linearised(
    problems: list[Problem], states: list[State], weights: list[np.ndarray]
) -> tuple[tensors.Problems, tensors.States, tensors.Linearisation]:
    """``weights`` are those of the book: IRLS times the detections' own."""
    problem, state = tensors.stack(problems, states, "cpu")
    irls = np.zeros(problem.weight.shape)
    for i, weight in enumerate(weights):
        own = problems[i].weight
        irls[i, : len(weight)] = np.divide(weight, own, out=np.zeros_like(weight), where=own > 0)
    ones = torch.ones(len(problems), dtype=torch.float64)
    residual = tensors.residuals(problem, state)
    system = tensors.linearise(problem, state, residual, torch.from_numpy(irls), VARIANCE * ones, BELIEF * ones)
    return problem, state, system


def stepped(
    problems: list[Problem], states: list[State], weights: list[np.ndarray], damping: list[float]
) -> list[State]:
    problem, state, system = linearised(problems, states, weights)
    after = tensors.step(system, state, torch.tensor(damping, dtype=torch.float64), problem.refine)
    return [after.scene(i, len(one.weight)) for i, one in enumerate(problems)]


@pytest.mark.parametrize("variant", VARIANTS)
def test_normal_equations_are_those_of_autograd(variant):
    problem, state, weight = posed(variant)
    problem = replace(problem, refine=tuple(sorted(problem.refine)))  # as the book has them
    _, _, system = linearised([problem], [state], [weight])
    cameras = book.unknowns(problem)[0]
    coupling = system.coupling[0].flatten(0, 1)
    matrix = torch.cat(
        [
            torch.cat([torch.block_diag(*system.camera[0]), coupling], dim=1),
            torch.cat([coupling.T, system.other[0]], dim=1),
        ]
    )
    gradient = torch.cat([system.camera_gradient[0].flatten(), system.other_gradient[0]])
    expected, slope = book.normal_equations(problem, state, weight, BELIEF, VARIANCE)
    assert len(expected) == cameras + system.other.shape[1]
    np.testing.assert_allclose(matrix, expected, rtol=1e-9, atol=1e-7)
    np.testing.assert_allclose(gradient, slope, rtol=1e-9, atol=1e-7)


@pytest.mark.parametrize("variant", VARIANTS)
def test_residuals_are_the_compiled_ones(variant):
    problem, state, _ = posed(variant)
    ours, theirs = tensors.residuals(*tensors.stack([problem], [state], "cpu")), evaluated(problem, state)
    seen = problem.weight > 0
    np.testing.assert_allclose(ours.length[0][seen], theirs.length, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(ours.error[0].mT[seen], theirs.error.T, rtol=1e-9, atol=1e-10)
    assert (ours.length[0][~seen] == 0).all()
    if problem.shape is not None:
        np.testing.assert_allclose(ours.surprise, theirs.surprise, rtol=1e-10)
        np.testing.assert_allclose(ours.pull[0], theirs.pull, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("damping", [1e-3, 10.0])
@pytest.mark.parametrize("variant", VARIANTS)
def test_a_step_is_that_of_the_whole_system(variant, damping):
    problem, state, weight = posed(variant)
    (ours,) = stepped([problem], [state], [weight], [damping])
    assert_alike(ours, book.step(problem, state, weight, damping, BELIEF, VARIANCE))


@pytest.mark.parametrize("variant", ["plain", "everything"])
def test_a_batch_is_its_scenes_one_by_one(variant):
    """Also where they differ in their views."""
    problems, states, weights = zip(*(posed(variant, views) for views in (4, 6, 5)), strict=True)
    problems = tuple(replace(problem, shape=problems[0].shape) for problem in problems)
    damping = [1e-3, 1.0, 10.0]
    together = stepped(list(problems), list(states), list(weights), damping)
    for ours, *alone in zip(together, problems, states, weights, damping, strict=True):
        assert_alike(ours, stepped(*([x] for x in alone))[0])


def test_unseen_points_and_empty_views_stay_where_they_are():
    problem, state, weight = posed("plain")
    problem.weight[2] = problem.weight[:, 4] = weight[2] = weight[:, 4] = 0
    problem.uv[2], problem.uv[:, 4] = 1e5, -1e5  # ignored
    (after,) = stepped([problem], [state], [weight], [1e-3])
    np.testing.assert_allclose(after.rotation[2], state.rotation[2], rtol=0, atol=1e-15)
    np.testing.assert_allclose(after.translation[2], state.translation[2], rtol=0, atol=1e-15)
    np.testing.assert_array_equal(after.points[4], state.points[4])
    assert_alike(after, book.step(problem, state, weight, 1e-3))


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_step_stays_on_one_gpu(variant):
    """Fake tensors know their device though there is none: mixing it with another raises."""
    problem, state, _ = posed(variant)
    with FakeTensorMode(allow_non_fake_inputs=True):
        on_gpu, at = tensors.stack([problem, problem], [state, state], "cuda")
        one = torch.ones(2, dtype=torch.float64, device="cuda")
        system = tensors.linearise(on_gpu, at, tensors.residuals(on_gpu, at), on_gpu.weight, one, one)
        after = tensors.step(system, at, one, problem.refine)
        for result in vars(after).values():
            assert result.device.type == "cuda"
