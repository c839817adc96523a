"""Rigid motions and the fit of one to moved points, differentiable wherever they are defined."""
# shapes unchecked inside autograd.Function: torch calls it with a context of its own

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

_SMALL = 1e-2  # squared angle (radians) below which series are exact in float32
_TIED = 1e-4  # of the largest singular value: pairs whose sum is smaller leave a rotation open


def se3_exp(twist: Float[Tensor, "*n 6"]) -> Float[Tensor, "*n 3 4"]:
    """[R | t] of twists (rotation vector, velocity): R = exp([w]), t = V v; exact and smooth through zero."""
    omega, velocity = twist[..., :3], twist[..., 3:]
    square = omega.square().sum(-1)[..., None, None]
    small = square < _SMALL
    angle = torch.where(small, torch.ones_like(square), square).sqrt()
    # sin(a)/a, (1 - cos(a))/a^2, (a - sin(a))/a^3
    sine = torch.where(small, 1 - square / 6 * (1 - square / 20), angle.sin() / angle)
    versine = torch.where(small, 0.5 - square / 24 * (1 - square / 30), (1 - angle.cos()) / angle.square())
    third = torch.where(small, 1 / 6 - square / 120 * (1 - square / 42), (1 - sine) / angle.square())
    cross = skew(omega)
    twice = cross @ cross
    one = torch.eye(3, dtype=twist.dtype, device=twist.device)
    rotation = one + sine * cross + versine * twice
    translation = (one + versine * cross + third * twice) @ velocity[..., None]
    return torch.cat([rotation, translation], dim=-1)


def skew(vector: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """Matrix of the cross product: ``skew(a) @ b = a x b``."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))


def transform(pose: Float[Tensor, "*#n 3 k"], points: Float[Tensor, "*#n 3"]) -> Float[Tensor, "*m 3"]:
    """R x + t."""
    return rotate(pose, points) + pose[..., 3]


def rotate(pose: Float[Tensor, "*#n 3 k"], vectors: Float[Tensor, "*#n 3"]) -> Float[Tensor, "*m 3"]:
    """R x."""
    return (pose[..., :3] * vectors[..., None, :]).sum(-1)


def compose(a_from_b: Float[Tensor, "*n 3 4"], b_from_c: Float[Tensor, "*n 3 4"]) -> Float[Tensor, "*n 3 4"]:
    """Pose a_from_c = a_from_b . b_from_c."""
    moved = a_from_b[..., :3] @ b_from_c
    return torch.cat([moved[..., :3], moved[..., 3:] + a_from_b[..., 3:]], dim=-1)


def rigid_fit(
    source: Float[Tensor, "*n p d"], target: Float[Tensor, "*n p d"], weight: Float[Tensor, "*n p"] | None = None
) -> tuple[Float[Tensor, "*n d d"], Float[Tensor, "*n d"]]:
    """R and t of least sum_p w_p |R x_p + t - y_p|^2 (L2G-NeRF's global pose; Umeyama, PAMI 1991, without a scale).

    Differentiable by target, source and weight. Where points leave a rotation open (all on a line, or at one place)
    it is one of the best, and its gradient is that of the part which is known.
    """
    share = torch.ones_like(source[..., 0]) if weight is None else weight
    share = (share / share.sum(-1, keepdim=True))[..., None]
    mean_x, mean_y = (share * source).sum(-2), (share * target).sum(-2)
    x, y = source - mean_x[..., None, :], target - mean_y[..., None, :]
    moment = y.mT @ (share * x)
    rotation = nearest_rotation(moment)
    return rotation, mean_y - (rotation @ mean_x[..., None])[..., 0]


def nearest_rotation(matrix: Float[Tensor, "*n d d"]) -> Float[Tensor, "*n d d"]:
    """The rotation R (d = 2 or 3) of largest trace(R^T M): R = U diag(1, .., det(U V^T)) V^T of M = U S V^T."""
    return _NearestRotation.apply(matrix)


class _NearestRotation(torch.autograd.Function):
    """`nearest_rotation` with a gradient of its own.

    That of torch's SVD divides by differences of singular values and is NaN where two are equal, of which a rotation
    knows nothing. With M = R P, P = V diag(p) V^T symmetric, p the singular values, the last times det(U V^T):
    R^T dR is skew, and (V^T R^T dR V)_ij = (V^T (R^T dM - dM^T R) V)_ij / (p_i + p_j).
    """

    @staticmethod
    def forward(ctx: Any, matrix: Tensor) -> Tensor:
        """By singular values."""
        u, stretch, vh = torch.linalg.svd(matrix.nan_to_num())  # which raises on NaN: the loss will tell
        sign = torch.ones_like(stretch)
        sign[..., -1] = torch.linalg.det(u @ vh).sign()
        rotation = (u * sign[..., None, :]) @ vh
        ctx.save_for_backward(rotation, stretch * sign, vh)
        return rotation

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        """By the sums p_i + p_j; pairs whose sum is next to nothing pass nothing on."""
        (gradient,) = gradients
        rotation, stretch, vh = ctx.saved_tensors
        sums = stretch[..., :, None] + stretch[..., None, :]
        known = sums > _TIED * stretch[..., :1, None].clamp(min=torch.finfo(sums.dtype).tiny)
        turned = vh @ rotation.mT @ gradient @ vh.mT
        turned = turned - turned.mT
        divided = torch.where(known, turned / torch.where(known, sums, torch.ones_like(sums)), torch.zeros_like(sums))
        return rotation @ vh.mT @ divided @ vh
