"""Frequencies are switched on one after the other, smoothly."""

import math

import pytest
import torch

from kronc_ns.plugin.barf.encoding import encode, encoded_size, frequency_weights, schedule


def test_the_schedule_rises_evenly_between_its_steps():
    assert [schedule(step, 10, 30, 8) for step in (0, 10, 20, 30, 99)] == [0, 0, 4, 8, 8]
    assert schedule(0, 0, 0, 8) == 8  # all from the first step on


@pytest.mark.parametrize(
    ("alpha", "weights"),
    [(0.0, [0, 0, 0]), (0.5, [0.5, 0, 0]), (1.0, [1, 0, 0]), (2.25, [1, 1, (1 - math.cos(math.pi / 4)) / 2])],
)
def test_weights_are_switched_on_from_the_coarsest(alpha, weights):
    torch.testing.assert_close(frequency_weights(alpha, 3), torch.tensor(weights, dtype=torch.float32))


def test_the_code_holds_the_point_and_its_waves():
    x = torch.rand(5, 2)
    code = encode(x, torch.tensor([1.0, 0.5]))
    assert code.shape == (5, encoded_size(2, 2))
    torch.testing.assert_close(code[:, :2], x)
    torch.testing.assert_close(code[:, 2:4], (math.pi * x).sin())
    torch.testing.assert_close(code[:, 8:], 0.5 * (2 * math.pi * x).cos())


def test_what_is_switched_off_has_no_say_in_the_gradient():
    x = torch.rand(4, 3, requires_grad=True)
    weights = frequency_weights(0.0, 6)
    (gradient,) = torch.autograd.grad(encode(x, weights).sum(), x)
    torch.testing.assert_close(gradient, torch.ones_like(x))
