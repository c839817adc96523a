"""Many scenes at once on tensors: what the compiled loop finds, step by step."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from kronc_ns.solve.batched import adjust_batch
from kronc_ns.solve.lm import LmConfig, LmResult, adjust
from kronc_ns.solve.problem import Problem, ShapePrior, State
from tests.solve.problems import VARIANTS, lengths, orbit_prior, randn, scene, started


def problem_of(variant: str, seed: int, views: int = 10) -> tuple[Problem, State]:
    """With outliers and an empty view, and a start off the solution."""
    options = VARIANTS[variant]
    problem, truth = scene(views, 14, noise_px=0.7, outliers=0.15, seed=10 * seed)
    root = randn(42, 42, seed=seed)
    problem = replace(
        problem,
        refine=tuple(name for name in options if name in ("focal", "k1")),
        shape=ShapePrior.of(truth.points, root @ root.T / 14) if "shape" in options else None,
        orbit=orbit_prior(truth) if "orbit" in options else None,
        points_known="known" in options,
    )
    problem.weight[2] = 0
    start = started(truth, 8.0, 0.5, seed=seed)
    return problem, replace(start, points=truth.points) if problem.points_known else start


def assert_same(ours: LmResult, theirs: LmResult, problem: Problem, rtol: float | None = None) -> None:
    """But for the gauge: where it is free rounding drifts along it, and comes back in second order."""
    free = problem.shape is None and problem.orbit is None and not problem.points_known
    rtol = rtol or (1e-8 if free else 1e-9)
    assert len(ours.loss) == len(theirs.loss)
    assert ours.converged == theirs.converged
    np.testing.assert_array_equal(ours.inlier, theirs.inlier)
    np.testing.assert_allclose(ours.loss, theirs.loss, rtol=100 * rtol)
    for name in ("cost", "sigma_px", "shape_weight"):
        assert getattr(ours, name) == pytest.approx(getattr(theirs, name), rel=rtol), name
    here, there = lengths(problem, ours.state), lengths(problem, theirs.state)
    np.testing.assert_allclose(here, there, rtol=1e-6, atol=1e-6)


CASES = [
    *((variant, 0) for variant in VARIANTS),
    *((v, seed) for v in ("plain", "shape", "points known") for seed in (1, 2)),
]


@pytest.mark.parametrize(("variant", "seed"), CASES)
def test_tensors_take_the_compiled_loops_way(variant, seed):
    problem, start = problem_of(variant, seed)
    ours, (theirs,) = adjust(problem, start), adjust_batch([problem], [start], device="cpu")
    assert ours.converged
    assert_same(ours, theirs, problem)
    for here, there in zip(ours.path, theirs.path, strict=True):
        (spread, expected) = (np.linalg.norm(s.c2w[..., 3] - s.c2w[..., 3].mean(0), axis=-1) for s in (here, there))
        np.testing.assert_allclose(spread, expected, rtol=1e-5)


@pytest.mark.parametrize("loss", ["huber", "none"])
def test_so_they_do_with_every_loss(loss):
    problem, start = problem_of("everything", 0)
    config = LmConfig(loss=loss)
    (theirs,) = adjust_batch([problem], [start], config, "cpu")
    assert_same(adjust(problem, start, config), theirs, problem)


@pytest.mark.parametrize("iterations", [1, 3])
def test_so_they_do_where_the_steps_run_out(iterations):
    problem, start = problem_of("plain", 0)
    config = LmConfig(iterations=iterations)
    (theirs,) = adjust_batch([problem], [start], config, "cpu")
    assert not theirs.converged
    assert_same(adjust(problem, start, config), theirs, problem)


def test_a_scene_does_not_depend_on_the_others_in_its_batch():
    """An easy scene leaves the batch early, a hard one late, and each ends where it ends alone."""
    problems, starts = [], []
    for draw, (views, off) in enumerate([(9, 0.1), (11, 12.0), (16, 0.1), (17, 3.0), (4, 6.0)]):
        problem, truth = scene(views, joints=16, noise_px=1.0, outliers=0.1, draw=draw)
        problems.append(problem)
        starts.append(started(truth, off, off / 15))
    together = adjust_batch(problems, starts, device="cpu")
    assert len({len(result.loss) for result in together}) > 2
    for problem, start, found in zip(problems, starts, together, strict=True):
        (alone,) = adjust_batch([problem], [start], device="cpu")
        assert_same(found, alone, problem)
        np.testing.assert_allclose(found.state.c2w, alone.state.c2w, rtol=0, atol=1e-8)
        np.testing.assert_allclose(found.state.points, alone.state.points, rtol=0, atol=1e-8)


def test_scenes_of_different_kinds_keep_their_order():
    rows = [problem_of(variant, 0) for variant in ("everything", "plain", "points known", "orbit", "shape", "focal")]
    rows.insert(3, scene(6, 9, noise_px=0.5))
    for row, found in zip(rows, adjust_batch(*map(list, zip(*rows, strict=True)), device="cpu"), strict=True):
        assert_same(found, adjust(*row), row[0])


def test_progress_tells_the_steps_of_the_first():
    rows = [problem_of("plain", seed) for seed in range(3)]
    calls = []
    found = adjust_batch(
        *map(list, zip(*rows, strict=True)), device="cpu", progress=lambda step, loss: calls.append((step, loss))
    )
    assert calls == list(enumerate(found[0].loss, start=1))


def test_nothing_to_see_ends_at_once():
    problem, start = problem_of("plain", 0)
    (found,) = adjust_batch([replace(problem, weight=np.zeros_like(problem.weight))], [start], device="cpu")
    assert np.isfinite(found.state.c2w).all()
    assert len(found.loss) < 20
    assert not found.inlier.any()


def test_same_input_same_bits_in_double_precision():
    problem, start = problem_of("everything", 0)
    first, second = (adjust_batch([problem], [start], device="cpu")[0] for _ in range(2))
    assert first.loss == second.loss
    for part in ("rotation", "translation", "points"):
        assert getattr(first.state, part).dtype == np.float64
        np.testing.assert_array_equal(getattr(first.state, part), getattr(second.state, part))


def test_no_scenes_have_no_results():
    assert adjust_batch([], [], device="cpu") == []


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA GPU on this machine")
@pytest.mark.parametrize("variant", VARIANTS)
def test_cuda_agrees_with_the_cpu(variant):
    rows = [problem_of(variant, seed) for seed in range(3)]
    for row, found in zip(rows, adjust_batch(*map(list, zip(*rows, strict=True)), device="cuda"), strict=True):
        assert_same(found, adjust(*row), row[0], rtol=1e-7)
