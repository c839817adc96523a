"""One step, compiled: rows of derivatives, normal equations, the elimination of the cameras and the gauge."""

import math
from dataclasses import replace

import numpy as np
import pytest

from kronc_ns.geometry.rotations import skew
from kronc_ns.solve import records, robust, schur
from kronc_ns.solve.problem import Problem, State
from tests.solve import book
from tests.solve.problems import (
    BELIEF,
    HALF_TURN,
    SEVERAL_LENSES,
    SIMILARITY,
    VARIANCE,
    VARIANTS,
    evaluated,
    lengths,
    moved,
    posed,
    randn,
    scene,
    shape_prior,
    started,
)


def state_of(now: records.Estimate) -> State:
    lenses = now.intrinsics[0].tolist() if len(now.intrinsics) == 1 else now.intrinsics.T
    return State(now.rotation, now.translation, now.points, *lenses)


class Step:
    """A step of the compiled solver."""

    def __init__(self, problem: Problem, state: State, weight: np.ndarray, damping: float) -> None:
        data = records.measured(problem)
        self.now, self.to = evaluated(problem, state), records.estimate(data, state)
        self.work = records.system(data, *problem.weight.shape)
        self.work.weight[:] = weight[problem.weight > 0]
        schur.reduce_system(data, self.now, self.work, damping, BELIEF, VARIANCE)
        lower = np.tril(self.work.matrix)
        self.matrix, self.rhs = lower + np.tril(lower, -1).T, self.work.rhs.copy()
        self.solved = schur.step(data, self.now, self.to, self.work)
        self.state = state_of(self.to)


def assert_alike(ours: State, theirs: State, rtol: float = 1e-7, atol: float = 1e-9) -> None:
    for name, value in vars(theirs).items():
        np.testing.assert_allclose(getattr(ours, name), value, rtol=rtol, atol=atol, err_msg=name)


@pytest.mark.parametrize("variant", ["plain", "focal", "k1", "focal and k1", "two lenses"])
def test_the_rows_of_every_view_are_the_derivatives_of_its_projections(variant):
    """Focal lengths differ and the lens bends."""
    problem, state, weight = posed(variant)
    data, now = records.measured(problem), evaluated(problem, state)
    jacobian, residual = (x.reshape(-1, 2, *x.shape[1:]) for x in book.jacobian(problem, state, weight))
    cameras, points, _ = book.unknowns(problem)
    joints = problem.weight.shape[1]
    for n in range(len(problem.weight)):
        of = slice(data.first[n], data.first[n + 1])
        count, expected = of.stop - of.start, jacobian[of]
        a, rows, off, lens = (np.full((*size, 2 * count), np.nan) for size in ((6,), (3,), (), (2,)))
        schur.fill_rows(data, now, weight[problem.weight > 0], n, a, rows, off, lens)
        by_point = cameras + data.joint[of, None, None] + joints * np.arange(3)
        assert_rows(a, expected[..., 6 * n : 6 * n + 6])
        assert_rows(rows, np.take_along_axis(expected, by_point, axis=2))
        own = 0 if problem.lens is None else problem.lens[n]
        lenses = expected[..., cameras + points :].reshape(*expected.shape[:2], problem.lenses, -1)
        assert_rows(lens[: len(problem.refine)], lenses[..., own, :])
        assert not np.delete(lenses, own, axis=2).any(), "other lenses change nothing"
        assert_rows(off[None], residual[of, :, None])


def assert_rows(ours: np.ndarray, expected: np.ndarray) -> None:
    """Rows [k, 2 count], along x and then along y, against [count, 2, k]."""
    np.testing.assert_allclose(ours, expected.T.reshape(ours.shape), rtol=1e-10, atol=1e-9)


@pytest.mark.parametrize("variant", [*VARIANTS, *SEVERAL_LENSES])
def test_errors_are_projections_less_detections(variant):
    problem, state, _ = posed(variant)
    found, seen = evaluated(problem, state), problem.weight > 0
    expected = book.reprojection(problem, state).numpy()[seen]
    np.testing.assert_allclose(found.error.T, expected, rtol=1e-9, atol=1e-9)
    length = np.sqrt((expected**2).sum(1) * problem.weight[seen])
    np.testing.assert_allclose(found.length, length, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("damping", [1e-3, 10.0])
@pytest.mark.parametrize("variant", [*VARIANTS, *SEVERAL_LENSES])
def test_a_step_is_that_of_the_whole_system(variant, damping):
    problem, state, weight = posed(variant)
    ours = Step(problem, state, weight, damping)
    assert ours.solved
    assert_alike(ours.state, book.step(problem, state, weight, damping, BELIEF, VARIANCE))


@pytest.mark.parametrize("variant", [*VARIANTS, *SEVERAL_LENSES])
def test_the_reduced_system_is_the_schur_complement_of_the_cameras(variant):
    problem, state, weight = posed(variant)
    ours = Step(problem, state, weight, 1e-3)
    matrix, gradient = book.normal_equations(problem, state, weight, BELIEF, VARIANCE)
    matrix += 1e-3 * np.diag(np.diag(matrix))
    cameras = 6 * len(problem.weight)
    coupling = np.linalg.solve(matrix[:cameras, :cameras], matrix[:cameras, cameras:])
    complement = matrix[cameras:, cameras:] - matrix[cameras:, :cameras] @ coupling
    np.testing.assert_allclose(ours.matrix, complement, rtol=1e-9, atol=1e-9 * np.abs(matrix).max())
    expected = coupling.T @ gradient[:cameras] - gradient[cameras:]
    np.testing.assert_allclose(ours.rhs, expected, rtol=1e-9, atol=1e-9 * np.abs(gradient).max())


@pytest.mark.parametrize("variant", ["plain", "shape", "orbit", "everything", "two lenses, everything"])
@pytest.mark.parametrize("phase", [robust.CAUCHY, robust.HUBER, robust.SQUARES, robust.TRIMMED])
def test_the_gradient_of_the_cost_vanishes_where_steps_do(variant, phase):
    """What is reduced is the cost that is compared: after many steps any other direction costs more."""
    problem, state, _ = posed(variant)
    state = replace(state, log_growth=0.0, k1=0.0)
    data, sigma = records.measured(problem), 3.0
    now, trial = evaluated(problem, state), evaluated(problem, state)
    work = records.system(data, *problem.weight.shape)
    cost, damping = schur.total_cost(data, now, sigma, phase), 1e-3
    for _ in range(100):
        proposed = schur.propose(data, now, trial, work, sigma, phase, damping)
        better = proposed < cost
        damping = max(damping / 10, 1e-9) if better else min(10 * damping, 1e9)
        if better:
            now, trial, cost = trial, now, proposed
    here = state_of(now)
    for k in range(20):
        change = 1e-4 * randn(sum(book.unknowns(problem)), seed=k)
        there = book.moved_by(problem, here, change)
        assert schur.total_cost(data, evaluated(problem, there), sigma, phase) > cost - 1e-9 * cost


def test_a_damped_step_lowers_the_cost():
    problem, state, weight = posed("everything")

    def squares(at: State) -> float:
        function = book.weighted_residuals(problem, at, weight, BELIEF, VARIANCE)
        return float(function(book.nowhere(problem)).square().sum())

    assert squares(Step(problem, state, weight, 1e-3).state) < 0.5 * squares(state)


@pytest.mark.parametrize("variant", [*VARIANTS, *SEVERAL_LENSES])
def test_cameras_stay_rigid(variant):
    problem, state, weight = posed(variant)
    rotation = Step(problem, state, weight, 1e-3).state.rotation
    np.testing.assert_allclose(
        rotation @ rotation.swapaxes(1, 2), np.broadcast_to(np.eye(3), rotation.shape), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0)


def test_no_similarity_of_the_world_shows_in_the_images():
    problem, truth = scene(noise_px=1.0)
    state = started(truth)
    here, there = evaluated(problem, state), evaluated(problem, moved(state, SIMILARITY))
    np.testing.assert_allclose(there.error, here.error, rtol=1e-9, atol=1e-8)
    np.testing.assert_allclose(there.length, here.length, rtol=1e-9, atol=1e-8)


def gauge_directions(points: np.ndarray) -> np.ndarray:
    """Shift, turn and growth of the points in planar order, [3J, 7]."""
    shift = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    return np.concatenate([shift, -skew(points), points[..., None]], axis=2).swapaxes(0, 1).reshape(-1, 7)


def test_the_reduced_matrix_has_the_seven_null_vectors_of_the_gauge_and_no_more():
    problem, truth = scene(views=6, joints=10, seen=1.0)
    matrix = Step(problem, truth, np.ones_like(problem.weight), 0.0).matrix
    gauge = gauge_directions(truth.points)
    assert np.linalg.norm(matrix @ gauge) < 1e-9 * np.linalg.norm(matrix) * np.linalg.norm(gauge)
    values = np.linalg.eigvalsh(matrix)
    assert values[6] < 1e-9 * values[-1] < 1e-3 * values[7]


def test_a_shape_prior_leaves_no_gauge():
    problem, truth = scene(views=6, joints=10, seen=1.0)
    problem = replace(problem, shape=shape_prior(10))
    values = np.linalg.eigvalsh(Step(problem, truth, np.ones_like(problem.weight), 0.0).matrix)
    assert values[0] > 1e-9 * values[-1]


def test_the_orbits_error_is_the_centres_distance_from_where_it_is_expected():
    problem, state, _ = posed("orbit")
    data, now = records.measured(problem), evaluated(problem, state)
    error = np.array([[schur.orbit_error(data, now, n, c) for c in range(3)] for n in range(len(state.rotation))])
    expected = problem.orbit.centre - state.c2w[..., 3]
    np.testing.assert_allclose((state.rotation.swapaxes(1, 2) @ error[..., None])[..., 0], expected)


def test_unseen_points_and_empty_views_stay_where_they_are():
    problem, state, weight = posed("plain")
    problem.weight[2] = problem.weight[:, 4] = 0
    problem.uv[2], problem.uv[:, 4] = 1e5, -1e5  # ignored
    weight[problem.weight == 0] = 0
    after = Step(problem, state, weight, 1e-3).state
    assert all(np.isfinite(part).all() for part in vars(after).values())
    views, points = [0, 1, 3], [0, 1, 2, 3, 5]
    np.testing.assert_array_equal(after.rotation[2], state.rotation[2])
    np.testing.assert_array_equal(after.translation[2], state.translation[2])
    np.testing.assert_array_equal(after.points[4], state.points[4])
    assert (np.abs(after.translation - state.translation)[views].max(1) > 0).all()
    assert (np.abs(after.points - state.points)[points].max(1) > 0).all()


@pytest.mark.parametrize("variant", ["plain", "focal and k1", "points known"])
def test_nothing_seen_at_all_moves_nothing(variant):
    problem, state, weight = posed(variant)
    problem = replace(problem, weight=np.zeros_like(problem.weight))
    assert_alike(Step(problem, state, 0 * weight, 1e-3).state, state, rtol=0, atol=0)


def test_points_behind_a_camera_are_far_off_and_pull_at_nothing():
    problem, truth = scene(4, 6, seen=1.0)
    truth.rotation[1] *= HALF_TURN[:, None]
    truth.translation[1] *= HALF_TURN
    length = lengths(problem, truth)
    assert (length[1] > 1e3).all()
    assert length[[0, 2, 3]].max() < 1e-9
    found = evaluated(problem, truth)
    assert np.abs(found.error).max() < 1e-9
    assert np.isfinite(found.seen).all()
    assert_alike(Step(problem, truth, problem.weight, 1e-3).state, truth)


def test_no_step_is_nan_not_an_answer():
    problem, state, _ = posed("plain")
    state.points[0] = np.nan
    data, now = records.measured(problem), evaluated(problem, state)
    work = records.system(data, *problem.weight.shape)
    assert math.isnan(schur.propose(data, now, records.estimate(data, state), work, 1.0, robust.CAUCHY, 1e-3))


def test_arrays_of_any_layout_are_compiled_once():
    """What numba compiles depends on the strides' kind, and it takes seconds."""
    problem, state, weight = posed("everything")
    expected = Step(problem, state, weight, 1e-3).state
    functions = [value for value in vars(schur).values() if hasattr(value, "signatures")]
    ready = [len(function.signatures) for function in functions]
    assert sum(ready) > 2
    orbit = replace(
        problem.orbit, centre=np.asfortranarray(problem.orbit.centre), sigma=np.repeat(problem.orbit.sigma, 2)[::2]
    )
    shape = replace(
        problem.shape, mean=np.repeat(problem.shape.mean, 2)[::2], precision=np.asfortranarray(problem.shape.precision)
    )
    turned = replace(
        problem, uv=np.asfortranarray(problem.uv), weight=np.asfortranarray(problem.weight), orbit=orbit, shape=shape
    )
    at = State(
        *(np.asfortranarray(x) for x in (state.rotation, state.translation, state.points)), state.log_growth, state.k1
    )
    assert_alike(Step(turned, at, weight, 1e-3).state, expected, rtol=0, atol=1e-12)
    assert [len(function.signatures) for function in functions] == ready
