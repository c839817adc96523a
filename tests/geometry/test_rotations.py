import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from kronc_ns.geometry.rotations import quaternion_from_rotation, rotation_angle_deg, skew, so3_exp, so3_log

vectors = st.lists(st.floats(-1, 1), min_size=3, max_size=3).map(np.array)
angles = st.floats(1e-9, math.pi - 1e-6)


def rotations(n: int, seed: int = 0) -> np.ndarray:
    return so3_exp(2 * np.random.default_rng(seed).normal(size=(n, 3)))


def test_exp_gives_rotations():
    r = rotations(50)
    assert_allclose(r @ r.swapaxes(1, 2), np.broadcast_to(np.eye(3), (50, 3, 3)), atol=1e-12)
    assert_allclose(np.linalg.det(r), np.ones(50))


@given(vectors, angles)
def test_log_inverts_exp(axis, angle):
    if np.linalg.norm(axis) < 1e-3:
        axis = np.array([0.0, 0.0, 1.0])
    omega = axis / np.linalg.norm(axis) * angle
    assert_allclose(so3_log(so3_exp(omega)), omega, atol=1e-7, rtol=1e-7)


def test_log_at_the_half_turn_has_length_pi():
    for axis in np.eye(3):
        half_turn = 2 * np.outer(axis, axis) - np.eye(3)
        assert np.linalg.norm(so3_log(half_turn)) == pytest.approx(math.pi)
        assert_allclose(so3_exp(so3_log(half_turn)), half_turn, atol=1e-12)


def test_skew_is_the_cross_product():
    a, b = np.random.default_rng(2).normal(size=(2, 10, 3))
    assert_allclose((skew(a) @ b[..., None])[..., 0], np.cross(a, b), atol=1e-12)


@given(angles)
def test_angle_is_the_angle(angle):
    r = so3_exp(np.array([0.6, 0.0, 0.8]) * angle)
    assert float(rotation_angle_deg(r)) == pytest.approx(math.degrees(angle), abs=1e-6)


def test_quaternion_rotates_like_the_matrix():
    r = rotations(20)
    q = quaternion_from_rotation(r)
    assert_allclose(np.linalg.norm(q, axis=1), np.ones(20))
    v = np.array([0.3, -0.2, 0.9])
    w, u = q[:, :1], q[:, 1:]
    rotated = v + 2 * np.cross(u, np.cross(u, v) + w * v)
    assert_allclose(rotated, r @ v, atol=1e-12)
