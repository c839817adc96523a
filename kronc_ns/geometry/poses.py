"""Rigid poses [3, 4], and the only place where OpenCV and OpenGL camera axes meet.

A pose is ``[R | t]``; ``c2w`` maps camera to world. The core's camera axes are OpenCV's (x right, y down,
z forward); nerfstudio's are OpenGL's (x right, y up, z backward).
"""

import torch
from jaxtyping import Float
from torch import Tensor


def make_pose(rotation: Float[Tensor, "*b 3 3"], translation: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 4"]:
    """Pose [R | t]."""
    return torch.cat([rotation, translation[..., None]], dim=-1)


def invert(pose: Float[Tensor, "*b 3 4"]) -> Float[Tensor, "*b 3 4"]:
    """Inverse of a rigid pose: [R^T | -R^T t]."""
    inverse = pose[..., :3].transpose(-1, -2)
    return torch.cat([inverse, -inverse @ pose[..., 3:]], dim=-1)


def compose(a_from_b: Float[Tensor, "*b 3 4"], b_from_c: Float[Tensor, "*b 3 4"]) -> Float[Tensor, "*b 3 4"]:
    """Pose a_from_c = a_from_b . b_from_c."""
    rotation = a_from_b[..., :3] @ b_from_c[..., :3]
    translation = a_from_b[..., :3] @ b_from_c[..., 3:] + a_from_b[..., 3:]
    return torch.cat([rotation, translation], dim=-1)


def transform(pose: Float[Tensor, "*b 3 4"], points: Float[Tensor, "*b n 3"]) -> Float[Tensor, "*b n 3"]:
    """Points [n, 3] carried through a pose: R x + t."""
    return points @ pose[..., :3].transpose(-1, -2) + pose[..., None, :, 3]


def look_at(
    centres: Float[Tensor, "*b 3"], targets: Float[Tensor, "*b 3"], up: Float[Tensor, "3"]
) -> Float[Tensor, "*b 3 4"]:
    """OpenCV c2w of cameras at ``centres`` facing ``targets``, with image-down as far from ``up`` as possible."""
    forward = torch.nn.functional.normalize(targets - centres, dim=-1)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up.expand_as(forward)), dim=-1)
    down = torch.linalg.cross(forward, right)
    return make_pose(torch.stack([right, down, forward], dim=-1), centres)


def flip_camera_axes(c2w: Float[Tensor, "*b 3 4"]) -> Float[Tensor, "*b 3 4"]:
    """OpenCV c2w to OpenGL c2w, or back: negates the camera's y and z axes (its own inverse)."""
    return c2w * torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=c2w.dtype, device=c2w.device)
