"""Compiled algebra against LAPACK."""

import numpy as np
import pytest

from kronc_ns.geometry.rotations import so3_exp
from kronc_ns.solve import linear
from tests.solve.problems import randn

SIZES = [1, 2, 3, 4, 5, 6, 9, 31]
GARBAGE = 1e300
"""In upper triangles, which nobody reads."""


def positive(size: int) -> np.ndarray:
    root = randn(size, size + 2, seed=size)
    return root @ root.T


def lower_with_garbage(matrix: np.ndarray) -> np.ndarray:
    return np.where(np.tri(len(matrix), dtype=bool), matrix, GARBAGE)


@pytest.mark.parametrize("size", [0, *SIZES])
def test_dot(size):
    x, y = randn(2, size + 3)
    assert linear.dot(x, y, size) == pytest.approx(x[:size] @ y[:size], rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 9.9e-5, 1.01e-4, 1e-2, 1.0, 3.0, np.pi, 6.0])
def test_the_exponential_is_rodrigues(angle):
    """On both sides of where its series takes over."""
    vector = angle * np.array([2.0, -3.0, 6.0]) / 7
    out = np.full((3, 3), np.nan)
    linear.exponential(np.array([*vector, 1.0, 1.0, 1.0]), out)  # of a twist, the turn
    np.testing.assert_allclose(out, so3_exp(vector), rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("size", SIZES)
def test_factor(size):
    matrix = positive(size)
    factored = lower_with_garbage(matrix)
    assert linear.factor(factored)
    np.testing.assert_allclose(np.tril(factored), np.linalg.cholesky(matrix), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("size", SIZES)
def test_inverse_factor(size):
    matrix, out = positive(size), np.full((size, size), np.nan)
    linear.inverse_factor(lower_with_garbage(matrix), out)
    np.testing.assert_allclose(out @ matrix @ out.T, np.eye(size), atol=1e-9)
    np.testing.assert_array_equal(out, np.tril(out))


@pytest.mark.parametrize("size", SIZES)
def test_solve(size):
    matrix, rhs = positive(size), randn(size, seed=50)
    solution = rhs.copy()
    assert linear.solve(lower_with_garbage(matrix), solution)
    np.testing.assert_allclose(matrix @ solution, rhs, atol=1e-9)


@pytest.mark.parametrize("spoilt", [-1.0, 0.0, np.nan])
@pytest.mark.parametrize("at", [0, 3, 5])
def test_what_is_not_positive_definite_has_no_solution(spoilt, at):
    matrix = np.eye(6)
    matrix[at, at] = spoilt
    assert not linear.factor(matrix.copy())
    assert not linear.solve(matrix.copy(), np.ones(6))


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("rows", [6, 12])
def test_forward(size, rows):
    lower, x = np.linalg.cholesky(positive(size)), randn(rows, size + 1, seed=60)
    y = x.copy()
    linear.forward(lower_with_garbage(lower), y)
    np.testing.assert_allclose(y[:, :size] @ lower.T, x[:, :size], atol=1e-9)
    np.testing.assert_array_equal(y[:, size], x[:, size])
