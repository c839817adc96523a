"""Rigid motions form a group; the rigid fit recovers, moves along with its points, and has the right gradient."""

import math

import numpy as np
import pytest
import torch

from kronc_ns.geometry.rotations import so3_exp
from kronc_ns.plugin.barf.rigid import compose, nearest_rotation, rigid_fit, rotate, se3_exp, transform

DOUBLE = {"dtype": torch.float64}


def motion(angle: float, seed: int = 0) -> torch.Tensor:
    """A rigid motion by an angle about some axis."""
    twist = torch.randn(6, generator=torch.Generator().manual_seed(seed), **DOUBLE)
    twist[:3] *= angle / twist[:3].norm()
    return se3_exp(twist)


@pytest.mark.parametrize("angle", [0.0, 1e-8, 1e-3, 0.099, 0.101, 1.0, 3.1])
def test_the_exponential_is_that_of_the_matrix(angle):
    twist = torch.randn(6, generator=torch.Generator().manual_seed(1), **DOUBLE)
    twist[:3] *= angle / twist[:3].norm()
    pose = se3_exp(twist)
    np.testing.assert_allclose(pose[:, :3].numpy(), so3_exp(twist[:3].numpy()), atol=1e-9)
    generator = torch.zeros(4, 4, **DOUBLE)
    generator[:3, :3] = torch.linalg.cross(twist[:3].expand(3, 3), torch.eye(3, **DOUBLE), dim=-1).mT
    generator[:3, 3] = twist[3:]
    torch.testing.assert_close(pose, torch.matrix_exp(generator)[:3], atol=1e-9, rtol=0)
    torch.testing.assert_close(compose(pose, se3_exp(-twist)), torch.eye(4, **DOUBLE)[:3], atol=1e-10, rtol=0)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.1, 2.0])
def test_the_exponential_has_its_gradient_also_at_zero(angle):
    twist = torch.randn(3, 6, generator=torch.Generator().manual_seed(2), **DOUBLE)
    twist[:, :3] *= angle / twist[:, :3].norm(dim=-1, keepdim=True)
    assert torch.autograd.gradcheck(se3_exp, twist.requires_grad_())


def test_motions_compose_and_move_points():
    a, b, x = motion(0.7, 0), motion(1.2, 1), torch.randn(3, **DOUBLE)
    torch.testing.assert_close(transform(compose(a, b), x), transform(a, transform(b, x)))
    torch.testing.assert_close(rotate(a, x) + a[:, 3], transform(a, x))


@pytest.mark.parametrize("dimensions", [2, 3])
def test_the_fit_recovers_a_motion(dimensions):
    x = torch.randn(4, 9, dimensions, **DOUBLE)
    u, _, vh = torch.linalg.svd(torch.randn(4, dimensions, dimensions, **DOUBLE))
    rotation = u @ vh
    rotation[..., 0] *= torch.linalg.det(rotation)[:, None]
    shift = torch.randn(4, dimensions, **DOUBLE)
    found, moved = rigid_fit(x, x @ rotation.mT + shift[:, None], torch.rand(4, 9, **DOUBLE) + 0.1)
    torch.testing.assert_close(found, rotation)
    torch.testing.assert_close(moved, shift)


def test_the_fit_is_the_best_and_a_rotation_even_where_a_reflection_were_better():
    generator = torch.Generator().manual_seed(3)
    x, y = (torch.randn(12, 3, generator=generator, **DOUBLE) for _ in range(2))
    y = y + x * torch.tensor([1.0, 1.0, -1.0])  # rather mirrored
    w = torch.rand(12, generator=generator, **DOUBLE)

    def cost(rotation: torch.Tensor, shift: torch.Tensor) -> float:
        return float((w * (x @ rotation.mT + shift - y).square().sum(-1)).sum())

    rotation, shift = rigid_fit(x, y, w)
    torch.testing.assert_close(rotation @ rotation.mT, torch.eye(3, **DOUBLE))
    assert float(torch.linalg.det(rotation)) == pytest.approx(1.0)
    for seed in range(20):
        nearby = motion(0.05, seed)
        assert cost(nearby[:, :3] @ rotation, shift + 0.01 * nearby[:, 3]) > cost(rotation, shift)


def test_a_point_of_weight_zero_does_not_count():
    x, y = torch.randn(8, 3, **DOUBLE), torch.randn(8, 3, **DOUBLE)
    w = torch.ones(8, **DOUBLE)
    w[5:] = 0
    for one, other in zip(rigid_fit(x, y, w), rigid_fit(x[:5], y[:5]), strict=True):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("dimensions", [2, 3])
@pytest.mark.parametrize("spread", [1.0, 1e-2])
def test_gradients_of_the_fit_are_finite_differences(dimensions, spread):
    generator = torch.Generator().manual_seed(4)
    x = torch.randn(2, 7, dimensions, generator=generator, **DOUBLE)
    x[..., -1] *= spread  # nearly on a plane, or on a line
    y = x + 0.2 * torch.randn(2, 7, dimensions, generator=generator, **DOUBLE) * spread
    w = torch.rand(2, 7, generator=generator, **DOUBLE) + 0.1
    assert torch.autograd.gradcheck(rigid_fit, tuple(t.requires_grad_() for t in (x, y, w)))


def test_equal_singular_values_have_a_gradient():
    corners = torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], **DOUBLE)
    moved = transform(motion(0.4), corners)
    assert torch.autograd.gradcheck(lambda y: rigid_fit(corners, y)[0], moved.requires_grad_())


@pytest.mark.parametrize("shape", ["line", "place", "mirrored", "nearly a line"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_points_leave_open_has_no_nan_in_its_gradient(shape, dtype):
    x = torch.zeros(6, 3, dtype=dtype)
    if shape != "place":
        x[:, 0] = torch.arange(6)
    if shape == "nearly a line":
        x[:, 1] = 1e-6 * torch.arange(6).square()
    y = (x.clone() + 0.5).requires_grad_()
    if shape == "mirrored":
        y = (torch.randn(6, 3, dtype=dtype) * torch.tensor([1, 1e-9, 1e-9])).requires_grad_()
    rotation, shift = rigid_fit(x, y)
    (rotation.square().sum() + (rotation * torch.arange(9, dtype=dtype).reshape(3, 3)).sum() + shift.sum()).backward()
    assert y.grad is not None
    assert y.grad.isfinite().all()
    assert float(y.grad.abs().max()) < 1e3
    assert float(torch.linalg.det(rotation)) == pytest.approx(1.0, abs=1e-4)


def test_what_is_not_a_number_stays_so_instead_of_raising():
    rotation, shift = rigid_fit(torch.randn(5, 3), torch.full((5, 3), math.nan))
    assert rotation.isfinite().all()  # of nothing
    assert shift.isnan().all()


def test_the_nearest_rotation_moves_along_with_its_matrix():
    a, b, m = motion(0.3, 0)[:, :3], motion(2.0, 1)[:, :3], torch.randn(3, 3, **DOUBLE)
    torch.testing.assert_close(nearest_rotation(a @ m @ b), a @ nearest_rotation(m) @ b)
