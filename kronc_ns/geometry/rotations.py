"""Rotation matrices, vectors and quaternions; the exponential map of SO(3)."""

import numpy as np
from jaxtyping import Float

_TINY = 1e-12


def skew(vector: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3 3"]:
    """Matrix of the cross product: ``skew(a) @ b = a x b``."""
    matrix = np.zeros((*vector.shape, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        matrix[..., k, j], matrix[..., j, k] = vector[..., i], -vector[..., i]
    return matrix


def so3_exp(omega: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3 3"]:
    """Rotation by ``|omega|`` radians about ``omega`` (Rodrigues), exact through zero."""
    angle = np.linalg.norm(omega, axis=-1)[..., None, None]
    cross = skew(omega)
    sine = np.sinc(angle / np.pi)  # sin(angle) / angle
    versine = np.sinc(angle / (2 * np.pi)) ** 2 / 2  # (1 - cos(angle)) / angle^2
    return np.eye(3) + sine * cross + versine * (cross @ cross)


def so3_log(rotation: Float[np.ndarray, "*b 3 3"]) -> Float[np.ndarray, "*b 3"]:
    """Rotation vector (radians, length <= pi) of a rotation; inverse of `so3_exp` for angles below pi."""
    quaternion = quaternion_from_rotation(rotation)
    w, xyz = quaternion[..., :1], quaternion[..., 1:]
    sine = np.linalg.norm(xyz, axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, w)
    return np.where(sine > _TINY, angle / np.maximum(sine, _TINY), 2.0) * xyz


def quaternion_from_rotation(rotation: Float[np.ndarray, "*b 3 3"]) -> Float[np.ndarray, "*b 4"]:
    """Unit quaternion (w, x, y, z), w >= 0, taken from its largest component so that no angle is singular."""
    r = rotation
    w = 1 + r[..., 0, 0] + r[..., 1, 1] + r[..., 2, 2]
    x = 1 + r[..., 0, 0] - r[..., 1, 1] - r[..., 2, 2]
    y = 1 - r[..., 0, 0] + r[..., 1, 1] - r[..., 2, 2]
    z = 1 - r[..., 0, 0] - r[..., 1, 1] + r[..., 2, 2]
    wx, wy, wz = r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]
    xy, xz, yz = r[..., 0, 1] + r[..., 1, 0], r[..., 0, 2] + r[..., 2, 0], r[..., 1, 2] + r[..., 2, 1]
    outer = np.stack([w, wx, wy, wz, wx, x, xy, xz, wy, xy, y, yz, wz, xz, yz, z], axis=-1)
    outer = outer.reshape(*r.shape[:-2], 4, 4)  # 4 q q^T
    best = np.stack([w, x, y, z], axis=-1).argmax(axis=-1)
    row = np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :]
    quaternion = row / np.linalg.norm(row, axis=-1, keepdims=True)
    return np.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def rotation_angle_deg(rotation: Float[np.ndarray, "*b 3 3"]) -> Float[np.ndarray, "*b"]:
    """Geodesic angle of a rotation to the identity in degrees, 0 to 180, accurate near both ends."""
    return np.asarray(np.rad2deg(np.linalg.norm(so3_log(rotation), axis=-1)))
