import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from kronc_ns.geometry.rotations import (
    quaternion_from_rotation,
    rotation_angle_deg,
    rotation_from_r6,
    rotation_to_r6,
    skew,
    so3_exp,
    so3_log,
)

torch.set_default_dtype(torch.float32)
vectors = st.lists(st.floats(-1, 1), min_size=3, max_size=3).map(lambda v: torch.tensor(v, dtype=torch.float64))
angles = st.floats(1e-9, math.pi - 1e-6)


def rotations(n: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return so3_exp(torch.randn(n, 3, dtype=torch.float64, generator=generator) * 2)


def test_exp_gives_rotations():
    r = rotations(50)
    torch.testing.assert_close(r @ r.transpose(1, 2), torch.eye(3, dtype=r.dtype).expand_as(r))
    torch.testing.assert_close(torch.linalg.det(r), torch.ones(50, dtype=r.dtype))


@given(vectors, angles)
def test_log_inverts_exp(axis, angle):
    if axis.norm() < 1e-3:
        axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    omega = axis / axis.norm() * angle
    torch.testing.assert_close(so3_log(so3_exp(omega)), omega, atol=1e-7, rtol=1e-7)


def test_log_at_the_half_turn_has_length_pi():
    for axis in torch.eye(3, dtype=torch.float64):
        half_turn = 2 * torch.outer(axis, axis) - torch.eye(3, dtype=torch.float64)
        assert so3_log(half_turn).norm() == pytest.approx(math.pi)
        torch.testing.assert_close(so3_exp(so3_log(half_turn)), half_turn)


def test_r6_round_trip_and_scale_invariance():
    r = rotations(50)
    torch.testing.assert_close(rotation_from_r6(rotation_to_r6(r)), r)
    torch.testing.assert_close(rotation_from_r6(3.7 * rotation_to_r6(r)), r)


def test_r6_of_anything_is_a_rotation():
    r = rotation_from_r6(torch.randn(100, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(1)))
    torch.testing.assert_close(r.transpose(1, 2) @ r, torch.eye(3, dtype=r.dtype).expand_as(r))
    torch.testing.assert_close(torch.linalg.det(r), torch.ones(100, dtype=r.dtype))


def test_r6_jacobian_against_finite_differences():
    r6 = rotation_to_r6(rotations(4)) * 1.3
    assert torch.autograd.gradcheck(rotation_from_r6, r6.requires_grad_())


def test_skew_is_the_cross_product():
    a, b = torch.randn(2, 10, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    torch.testing.assert_close((skew(a) @ b[..., None])[..., 0], torch.linalg.cross(a, b))


@given(angles)
def test_angle_is_the_angle(angle):
    r = so3_exp(torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64) * angle)
    assert float(rotation_angle_deg(r)) == pytest.approx(math.degrees(angle), abs=1e-6)


def test_quaternion_rotates_like_the_matrix():
    r = rotations(20)
    q = quaternion_from_rotation(r)
    torch.testing.assert_close(q.norm(dim=1), torch.ones(20, dtype=q.dtype))
    v = torch.tensor([0.3, -0.2, 0.9], dtype=torch.float64).expand(20, 3)
    w, u = q[:, :1], q[:, 1:]
    rotated = v + 2 * torch.linalg.cross(u, torch.linalg.cross(u, v) + w * v)
    torch.testing.assert_close(rotated, (r @ v[..., None])[..., 0])
