"""Robust losses: each weight is its cost's derivative, formulas mean the same everywhere, and the phases."""

import math

import numpy as np
import pytest
import torch

from kronc_ns.solve import robust
from kronc_ns.solve.robust import CAUCHY, HUBER, SQUARES, TRIMMED

SIGMA = 0.8
KNEES = {CAUCHY: (), TRIMMED: (robust.INLIER_SIGMAS * SIGMA,), HUBER: (robust.HUBER_SIGMAS * SIGMA,), SQUARES: ()}
PHASES = list(KNEES)
LENGTHS = np.concatenate([np.linspace(1e-3, 8.0, 997), [0.0, 1e2, 1e4]])
FORMULAS = {
    CAUCHY: lambda length, sigma: robust.cauchy_cost(robust.cauchy_term(length, sigma).log(), sigma),
    TRIMMED: robust.trimmed_cost,
    HUBER: robust.huber_cost,
    SQUARES: lambda length, sigma: length * length,
}
FREEDOM, SIZE = 20.0, 198


def weights(length: np.ndarray, phase: int, own: np.ndarray | None = None) -> np.ndarray:
    out = np.full(len(length), np.nan)
    robust.weigh(length, np.ones(len(length)) if own is None else own, SIGMA, phase, out)
    return out


def costs(length: np.ndarray, phase: int, sigma: float = SIGMA) -> np.ndarray:
    """Of each length by itself."""
    return np.array([robust.cost(np.array([one]), sigma, phase) for one in length])


@pytest.mark.parametrize("phase", PHASES)
def test_the_weight_is_the_derivative_of_the_cost_by_the_squared_length(phase):
    away = np.abs(np.subtract.outer(LENGTHS, KNEES[phase])).min(1, initial=1.0) > 1e-9
    square = torch.from_numpy(LENGTHS[away & (LENGTHS > 0)] ** 2).requires_grad_()
    total = FORMULAS[phase](square.sqrt(), SIGMA).sum()
    (expected,) = torch.autograd.grad(total, square)
    np.testing.assert_allclose(weights(square.detach().sqrt().numpy(), phase), expected.numpy(), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("phase", PHASES)
def test_compiled_loops_and_tensors_have_one_cost(phase):
    of_tensors = FORMULAS[phase](torch.from_numpy(LENGTHS), SIGMA).numpy()
    np.testing.assert_allclose(costs(LENGTHS, phase), of_tensors, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("formula", [robust.cauchy_term, robust.trimmed_cost, robust.huber_weight, robust.huber_cost])
def test_formulas_of_detections_are_the_same_for_numbers_and_tensors(formula):
    of_tensors = formula(torch.from_numpy(LENGTHS), torch.full((len(LENGTHS),), SIGMA, dtype=torch.float64))
    np.testing.assert_allclose([formula(x, SIGMA) for x in LENGTHS.tolist()], of_tensors.numpy(), rtol=1e-12)


@pytest.mark.parametrize("phase", PHASES)
def test_the_farther_off_the_more_it_costs_and_the_less_it_weighs(phase):
    length = np.sort(LENGTHS)
    assert (np.diff(costs(length, phase)) >= 0).all()
    assert (np.diff(weights(length, phase)) <= 0).all()
    assert weights(np.zeros(1), phase)[0] == pytest.approx(1.0)
    assert costs(np.zeros(1), phase)[0] == 0.0


@pytest.mark.parametrize("phase", PHASES)
def test_small_residuals_count_in_squares(phase):
    small = np.array([1e-4, 1e-3])
    np.testing.assert_allclose(costs(small, phase), small**2, rtol=1e-6)


@pytest.mark.parametrize("phase", [TRIMMED, HUBER])
def test_the_cost_is_continuous_at_the_knee_and_so_is_hubers_weight(phase):
    (knee,) = KNEES[phase]
    around = knee * np.array([1 - 1e-12, 1 + 1e-12])
    np.testing.assert_allclose(*costs(around, phase), rtol=1e-10)
    if phase == HUBER:
        np.testing.assert_allclose(*weights(around, phase), rtol=1e-10)
    else:
        np.testing.assert_array_equal(weights(around, phase), [1.0, 0.0])


@pytest.mark.parametrize("phase", PHASES)
def test_a_detections_own_weight_multiplies(phase):
    own = np.random.default_rng(0).random(len(LENGTHS))
    np.testing.assert_allclose(weights(LENGTHS, phase, own), own * weights(LENGTHS, phase))


@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 16, 23])
def test_costs_add_up_however_many_there_are(phase, count):
    length = LENGTHS[::-1][:count].copy()
    assert robust.cost(length, SIGMA, phase) == pytest.approx(costs(length, phase).sum(), rel=1e-12, abs=1e-12)


def test_far_off_detections_do_not_overflow():
    """As far as a point just before the camera may be seen, at the least noise that is believed."""
    assert math.isfinite(robust.cost(np.full(8, 1e12), robust.SIGMA_FLOOR_PX, CAUCHY))


def shape_cost(surprise, freedom=FREEDOM, size=SIZE):
    usual, rest = robust.shape_excess(surprise, freedom, size)
    return usual + (freedom + size) * rest.log()


def test_the_shapes_weight_is_the_derivative_of_its_cost():
    surprise = torch.linspace(0.5, 3000.0, 1000, dtype=torch.float64).requires_grad_()
    (expected,) = torch.autograd.grad(shape_cost(surprise).sum(), surprise)
    ours = robust.shape_weight(surprise.detach(), FREEDOM, SIZE)
    torch.testing.assert_close(ours, expected, rtol=1e-9, atol=1e-12)
    assert (ours.diff() <= 0).all()
    assert (shape_cost(surprise).diff() > 0).all()


def test_the_shapes_formulas_are_the_same_for_numbers_and_tensors():
    surprise = torch.linspace(0.0, 3000.0, 500, dtype=torch.float64)
    usual, rest = (x.numpy() for x in robust.shape_excess(surprise, FREEDOM, SIZE))
    numbers = np.array([robust.shape_excess(x, FREEDOM, SIZE) for x in surprise.tolist()])
    np.testing.assert_allclose(numbers, np.stack([usual, rest], axis=1), rtol=1e-12)
    of_numbers = [robust.shape_weight(x, FREEDOM, SIZE) for x in surprise.tolist()]
    np.testing.assert_allclose(of_numbers, robust.shape_weight(surprise, FREEDOM, SIZE).numpy(), rtol=1e-12)


def test_a_shape_of_usual_surprise_counts_in_full():
    """As large as the number of coordinates: the mean of its distribution."""
    assert robust.shape_weight(float(SIZE), FREEDOM, SIZE) == 1.0
    below, above = (float(shape_cost(torch.tensor(SIZE + d, dtype=torch.float64))) for d in (-1e-9, 1e-9))
    assert below == pytest.approx(above, abs=1e-8)
    assert robust.shape_weight(10.0 * SIZE, FREEDOM, SIZE) < 0.2


@pytest.mark.parametrize("count", [1, 2, 3, 4, 10, 101, 1000])
@pytest.mark.parametrize("kind", ["scattered", "sorted", "reversed", "alike", "two values"])
def test_the_noise_is_the_lower_median_over_that_of_unit_noise(count, kind):
    length = np.abs(np.random.default_rng(count).normal(size=count)) + 0.1
    length = {
        "scattered": length,
        "sorted": np.sort(length),
        "reversed": np.sort(length)[::-1].copy(),
        "alike": np.full(count, 0.7),
        "two values": np.where(np.arange(count) % 2, 0.3, 0.9),
    }[kind]
    before, work = length.copy(), np.empty(count)
    expected = np.sort(length)[(count - 1) // 2] / robust.RAYLEIGH_MEDIAN
    assert robust.noise(length, work) == pytest.approx(expected)
    assert robust.noise_px(length) == pytest.approx(expected)
    np.testing.assert_array_equal(length, before)


def test_noise_per_axis_is_told_from_lengths():
    draws = np.random.default_rng(0).normal(size=(20000, 2)) * 1.7
    assert robust.noise_px(np.linalg.norm(draws, axis=1)) == pytest.approx(1.7, rel=0.02)


def test_no_detector_is_believed_to_be_perfect():
    assert robust.noise(np.zeros(5), np.empty(5)) == robust.SIGMA_FLOOR_PX
    assert robust.noise_px(np.zeros(5)) == robust.SIGMA_FLOOR_PX


def test_nothing_has_no_noise():
    assert robust.noise(np.empty(0), np.empty(0)) == 1.0
    assert math.isnan(robust.noise_px(np.empty(0)))
    assert robust.noise(np.full(3, np.inf), np.empty(3)) == 1.0


def test_what_begins_with_a_loss():
    assert [robust.first_phase(loss) for loss in ("cauchy", "huber", "none")] == [CAUCHY, HUBER, SQUARES]


def rayleigh(sigma: float, count: int = 4000) -> np.ndarray:
    return np.linalg.norm(np.random.default_rng(3).normal(size=(count, 2)), axis=1) * sigma


@pytest.mark.parametrize("phase", [HUBER, SQUARES])
def test_losses_of_one_phase_are_over_when_settled(phase):
    assert robust.next_phase(rayleigh(1.0), 1.3, phase, 1.3, 1.0) == (phase, 1.3, True)


def test_a_settled_graduated_loss_is_followed_by_trimmed_squares():
    phase, sigma, done = robust.next_phase(rayleigh(1.0), 1.1, CAUCHY, 1.1, 1.0)
    assert (phase, sigma, done) == (TRIMMED, 1.1, False)


def test_a_scale_that_lags_behind_goes_on_graduated():
    for before in (CAUCHY, TRIMMED):
        phase, sigma, done = robust.next_phase(rayleigh(1.0), 3.0, before, 3.0, 1.0)
        assert (phase, done) == (CAUCHY, False)
        assert sigma == pytest.approx(1.0, rel=0.03)


def test_trimmed_squares_end_when_the_choice_of_inliers_stands():
    inliers = rayleigh(1.0)
    clear = np.concatenate([inliers[inliers < 4.0], [50.0]])
    phase, sigma, done = robust.next_phase(clear, 1.1, TRIMMED, 1.1, 1.0)
    assert (phase, done) == (TRIMMED, True)
    assert sigma == pytest.approx(1.0, rel=0.03)
    assert robust.next_phase(np.append(clear, 1.05 * robust.INLIER_SIGMAS), 1.1, TRIMMED, 1.1, 1.0)[2] is False


def test_redundancy_makes_up_for_what_the_unknowns_took():
    clear = rayleigh(1.0) / 1.4
    assert robust.next_phase(clear, 1.1, TRIMMED, 1.1, 1.4)[1] == pytest.approx(1.0, rel=0.03)
    assert robust.next_phase(clear, 1.1, TRIMMED, 0.9, 1.4)[1] == 0.9  # never more than the residuals show


def test_the_next_gain_goes_on_as_gains_shrank():
    assert robust.gain(200.0, 150.0) == robust.gain(200.0, 250.0) == pytest.approx(0.25)
    assert robust.next_gain(0.01, 0.1) == pytest.approx(0.001)
    assert robust.next_gain(0.1, 0.01) == 0.1  # gains that grow say nothing of an end
    assert robust.next_gain(0.1, 0.0) == 0.1
    assert robust.next_gain(0.0, 0.0) == robust.gain(0.0, 0.0) == 0.0
    assert math.isnan(robust.next_gain(math.nan, 0.1))
