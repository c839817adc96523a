"""Rotations: the 6D representation of the paper and the exponential map of SO(3)."""

import math
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor


def rotation_to_r6(rotation: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 6"]:
    """First two columns (a1, a2) of a rotation, stacked: the paper's f (Algorithm 1; Zhou et al. 2019)."""
    return torch.cat([rotation[..., :, 0], rotation[..., :, 1]], dim=-1)


def rotation_from_r6(r6: Float[Tensor, "*b 6"]) -> Float[Tensor, "*b 3 3"]:
    """Gram-Schmidt on the two unnormalised columns of ``r6``: the paper's inverse of f (section 4.2)."""
    a1, a2 = r6[..., :3], r6[..., 3:]
    b1 = torch.nn.functional.normalize(a1, dim=-1)
    b2 = torch.nn.functional.normalize(a2 - (b1 * a2).sum(-1, keepdim=True) * b1, dim=-1)
    return torch.stack([b1, b2, torch.linalg.cross(b1, b2)], dim=-1)


def skew(vector: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Matrix of the cross product: ``skew(a) @ b = a x b``."""
    return (vector @ _generators(vector.dtype, vector.device)).unflatten(-1, (3, 3))


@lru_cache(maxsize=8)
def _generators(dtype: torch.dtype, device: torch.device) -> Float[Tensor, "3 9"]:
    """The three matrices of the cross product with a unit axis, flattened."""
    basis = torch.zeros(3, 3, 3, dtype=dtype, device=device)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        basis[i, k, j], basis[i, j, k] = 1.0, -1.0
    return basis.view(3, 9)


def so3_exp(omega: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation by ``|omega|`` radians about ``omega`` (Rodrigues), smooth through zero."""
    square = omega.square().sum(-1)[..., None, None]
    angle = (square + torch.finfo(omega.dtype).tiny).sqrt()  # the root's derivative at zero is not finite
    cross = skew(omega)
    sine = torch.sinc(angle / math.pi)  # sin(angle) / angle
    cosine = torch.sinc(angle / (2 * math.pi)).square() / 2  # (1 - cos(angle)) / angle^2
    return torch.eye(3, dtype=omega.dtype, device=omega.device) + sine * cross + cosine * (cross @ cross)


def so3_log(rotation: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Rotation vector (radians, length <= pi) of a rotation; inverse of `so3_exp` for angles below pi."""
    quaternion = quaternion_from_rotation(rotation)
    w, xyz = quaternion[..., :1], quaternion[..., 1:]
    sine = xyz.norm(dim=-1, keepdim=True)
    angle = 2 * torch.atan2(sine, w)
    factor = torch.where(sine > 1e-12, angle / sine.clamp_min(1e-12), torch.full_like(sine, 2.0))
    return factor * xyz


def quaternion_from_rotation(rotation: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 4"]:
    """Unit quaternion (w, x, y, z), w >= 0, taken from its largest component so that no angle is singular."""
    r = rotation
    trace_like = torch.stack(
        [
            1 + r[..., 0, 0] + r[..., 1, 1] + r[..., 2, 2],
            1 + r[..., 0, 0] - r[..., 1, 1] - r[..., 2, 2],
            1 - r[..., 0, 0] + r[..., 1, 1] - r[..., 2, 2],
            1 - r[..., 0, 0] - r[..., 1, 1] + r[..., 2, 2],
        ],
        dim=-1,
    )
    wx, wy, wz = r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]
    xy, xz, yz = r[..., 0, 1] + r[..., 1, 0], r[..., 0, 2] + r[..., 2, 0], r[..., 1, 2] + r[..., 2, 1]
    w, x, y, z = trace_like.unbind(-1)
    outer = torch.stack([w, wx, wy, wz, wx, x, xy, xz, wy, xy, y, yz, wz, xz, yz, z], dim=-1)
    outer = outer.reshape(*r.shape[:-2], 4, 4)  # 4 q q^T
    best = trace_like.argmax(dim=-1)
    row = torch.take_along_dim(outer, best[..., None, None], dim=-2).squeeze(-2)
    quaternion = torch.nn.functional.normalize(row, dim=-1)
    return torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def rotation_angle_deg(rotation: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b"]:
    """Geodesic angle of a rotation to the identity in degrees, 0 to 180, accurate near both ends."""
    return torch.rad2deg(so3_log(rotation).norm(dim=-1))
