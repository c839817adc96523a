"""Formulas of the projection: derivatives against complex steps; the same for numbers, arrays and tensors."""

import numpy as np
import pytest
import torch

from kronc_ns.geometry.camera import Camera, project
from kronc_ns.geometry.rotations import skew
from kronc_ns.solve import projection
from tests.solve.problems import randn

FX, FY, K1 = 400.0, 390.0, -0.07
STEP = 1e-30
U, V = 0.5 * randn(2, 50)


def by(function, *at) -> list[np.ndarray]:
    """Derivatives of a function's results by its arguments, results first."""
    columns = [
        [np.imag(result) / STEP for result in function(*(x + (1j * STEP if k == i else 0) for k, x in enumerate(at)))]
        for i in range(len(at))
    ]
    return [column[r] for r in range(len(columns[0])) for column in columns]


def assert_close(ours, theirs) -> None:
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(np.broadcast_to(a, b.shape), b, rtol=1e-12, atol=1e-12)


def test_pixels_are_opencvs():
    camera = Camera(FX, FY, 200.0, 190.0, 400, 400, k1=K1)
    expected = camera.distort(project(np.stack([U, V, np.ones_like(U)], axis=-1), camera))
    assert_close(projection.pixel(U, V, FX, FY, K1), expected.T - np.array([[camera.cx], [camera.cy]]))


def test_derivatives_by_the_place_in_the_image_plane():
    ours = projection.pixel_by_plane(U, V, FX, FY, K1)
    assert_close(ours, by(lambda u, v: projection.pixel(u, v, FX, FY, K1), U, V))


def test_derivatives_by_k1():
    ours = projection.pixel_by_k1(U, V, FX, FY)
    assert_close(ours, by(lambda k1: projection.pixel(U, V, FX, FY, k1), K1 + 0 * U))


def test_derivatives_by_the_logarithm_of_the_focal_length_are_the_pixel_itself():
    def grown(growth):
        return projection.pixel(U, V, FX * np.exp(growth), FY * np.exp(growth), K1)

    assert_close(projection.pixel(U, V, FX, FY, K1), by(grown, 0 * U))


DEPTH = 3.0 + 0.5 * randn(50, seed=1)
SEEN = np.stack([U * DEPTH, V * DEPTH, DEPTH], axis=-1)
"""Points in camera axes."""


def plane(x, y, z):
    return x / z, y / z


def test_derivatives_by_the_cameras_shift():
    ux, uz, vy, vz = projection.plane_by_shift(U, V, 1 / DEPTH)
    none = np.zeros(50)
    assert_close((ux, none, uz, none, vy, vz), by(plane, *SEEN.T))


def test_derivatives_by_the_cameras_turn():
    """exp(w) p is p + w x p to first order, and p + w x p is all that a derivative at w = 0 sees."""
    moves = -skew(SEEN).transpose(2, 1, 0)  # [axis of w, coordinate, point]

    def turned(x, y, z):
        return plane(*(p + x * moves[0, c] + y * moves[1, c] + z * moves[2, c] for c, p in enumerate(SEEN.T)))

    assert_close(projection.plane_by_turn(U, V), by(turned, *np.zeros((3, 50))))


@pytest.mark.parametrize("axis", range(3))
def test_derivatives_by_a_coordinate_of_the_point(axis):
    column = randn(3, seed=2 + axis)

    def shifted(by):
        return plane(*(p + by * c for p, c in zip(SEEN.T, column, strict=True)))

    assert_close(projection.plane_by_point(U, V, 1 / DEPTH, *column), by(shifted, np.zeros(50)))


@pytest.mark.parametrize(
    ("formula", "arguments"),
    [
        (projection.pixel, (U, V, FX, FY, K1)),
        (projection.pixel_by_plane, (U, V, FX, FY, K1)),
        (projection.pixel_by_k1, (U, V, FX, FY)),
        (projection.plane_by_turn, (U, V)),
        (projection.plane_by_shift, (U, V, 1 / DEPTH)),
        (projection.plane_by_point, (U, V, 1 / DEPTH, 0.1, 0.2, 0.3)),
    ],
)
def test_tensors_give_what_numbers_give(formula, arguments):
    of_tensors = formula(*(torch.from_numpy(x) if isinstance(x, np.ndarray) else x for x in arguments))
    of_numbers = [formula(*(float(x[k]) if isinstance(x, np.ndarray) else x for x in arguments)) for k in range(50)]
    assert_close([x.numpy() for x in of_tensors], np.array(of_numbers).T)
