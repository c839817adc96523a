"""The paper's six numbers of a rotation."""

import torch

from kronc_ns.solve.adam import rotation_from_r6, rotation_to_r6
from tests.geometry.test_rotations import rotations


def test_r6_round_trip_and_scale_invariance():
    r = torch.from_numpy(rotations(50))
    torch.testing.assert_close(rotation_from_r6(rotation_to_r6(r)), r)
    torch.testing.assert_close(rotation_from_r6(3.7 * rotation_to_r6(r)), r)


def test_r6_of_anything_is_a_rotation():
    r = rotation_from_r6(torch.randn(100, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(1)))
    torch.testing.assert_close(r.transpose(1, 2) @ r, torch.eye(3, dtype=r.dtype).expand_as(r))
    torch.testing.assert_close(torch.linalg.det(r), torch.ones(100, dtype=r.dtype))


def test_r6_jacobian_against_finite_differences():
    r6 = rotation_to_r6(torch.from_numpy(rotations(4))) * 1.3
    assert torch.autograd.gradcheck(rotation_from_r6, r6.requires_grad_())
