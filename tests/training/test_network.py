import numpy as np
import pytest
import torch

from kronc_ns.training.loss import loss
from kronc_ns.training.network import INPUT_SIZE, POINTS, STRIDE, Answer, KeypointNetwork

ROWS, COLUMNS = INPUT_SIZE[1] // STRIDE, INPUT_SIZE[0] // STRIDE


def test_answers_are_probabilities_over_the_cells():
    torch.manual_seed(0)
    rgb = torch.randint(0, 255, (2, 3, INPUT_SIZE[1], INPUT_SIZE[0]), dtype=torch.uint8)
    answer = KeypointNetwork().eval()(rgb)
    assert answer.heat.shape == (2, POINTS, ROWS, COLUMNS)
    assert answer.visible.shape == (2, POINTS)
    assert answer.mask.shape == (2, ROWS, COLUMNS)
    torch.testing.assert_close(answer.heat.exp().sum((2, 3)), torch.ones(2, POINTS))


def _target_map(u: float, v: float) -> torch.Tensor:
    y, x = torch.meshgrid(torch.arange(ROWS) + 0.5, torch.arange(COLUMNS) + 0.5, indexing="ij")
    squared = ((STRIDE * x - u) ** 2 + (STRIDE * y - v) ** 2) / (0.9 * STRIDE) ** 2
    return (-squared / 2).flatten().softmax(0).reshape(ROWS, COLUMNS)


def _answer(heat: torch.Tensor, visible: float) -> Answer:
    everywhere = heat.log().clamp_min(-60).expand(1, POINTS, ROWS, COLUMNS)
    return Answer(everywhere, torch.full((1, POINTS), visible), torch.full((1, ROWS, COLUMNS), -20.0))


def _keypoints(u: float, v: float, state: int) -> torch.Tensor:
    return torch.tensor([float(u), float(v), float(state)]).expand(1, POINTS, 3)


def test_loss_of_places_is_the_divergence_from_a_normal_distribution():
    truth, other = _target_map(101.3, 77.8), _target_map(110.0, 70.0)
    empty = torch.zeros(1, ROWS, COLUMNS)
    exact = loss(_answer(truth, 20.0), _keypoints(101.3, 77.8, 1), empty)
    wrong = loss(_answer(other, 20.0), _keypoints(101.3, 77.8, 1), empty)
    assert float(exact.place) == pytest.approx(0, abs=1e-4)
    divergence = float((truth * (truth.clamp_min(1e-30) / other.clamp_min(1e-30)).log()).sum())
    assert float(wrong.place) == pytest.approx(divergence, rel=1e-3)


def test_hidden_points_have_no_place_and_unknown_ones_no_loss():
    empty = torch.zeros(1, ROWS, COLUMNS)
    hidden = loss(_answer(_target_map(10, 10), -20.0), _keypoints(200, 100, 2), empty)
    unknown = loss(_answer(_target_map(10, 10), 3.0), _keypoints(200, 100, 0), empty)
    for parts in (hidden, unknown):
        assert float(parts.total) == pytest.approx(0, abs=1e-6)


def test_a_point_outside_the_input_does_not_break_the_loss():
    parts = loss(_answer(_target_map(10, 10), 0.0), _keypoints(-500, 900, 2), torch.zeros(1, ROWS, COLUMNS))
    assert np.isfinite(float(parts.total))
