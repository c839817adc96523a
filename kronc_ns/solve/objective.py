"""The paper's equations as pure functions of tensors; autograd goes through all of them.

N views, J keypoints. ``m [N, J]`` is the visibility, ``uv [N, J, 2]`` the detected pixels, ``z [N, J]`` the z-depths,
``c2w [N, 3, 4]`` the poses (the paper's R_i, t_i). `adam` evaluates the same with a gradient that is written out.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from kronc_ns.geometry.camera import Camera


def backproject(
    uv: Float[Tensor, "n j 2"], z: Float[Tensor, "n j"], c2w: Float[Tensor, "n 3 4"], camera: Camera
) -> Float[Tensor, "n j 3"]:
    """World points of pixels at z-depth ``z`` (eq. 1): R_i z K^-1 (u, v, 1) + t_i."""
    x, y = (uv[..., 0] - camera.cx) / camera.fx, (uv[..., 1] - camera.cy) / camera.fy
    rays = torch.stack([x, y, torch.ones_like(x)], dim=-1)
    return (rays * z[..., None]) @ c2w[..., :3].mT + c2w[:, None, :, 3]


def centroids(points: Float[Tensor, "n j 3"], m: Float[Tensor, "n j"]) -> Float[Tensor, "j 3"]:
    """C^j: visibility-weighted mean of each keypoint's back-projections (eq. 2); zero where none is visible."""
    weights = m / m.sum(0).clamp_min(torch.finfo(m.dtype).tiny)
    return (weights[..., None] * points).sum(0)


def reproject(centroid: Float[Tensor, "j 3"], c2w: Float[Tensor, "n 3 4"], camera: Camera) -> Float[Tensor, "n j 2"]:
    """Pixels of every centroid in every view (eq. 3): K R_i^T (C^j - t_i), divided by its depth."""
    x, y, z = ((centroid - c2w[:, None, :, 3]) @ c2w[..., :3]).unbind(-1)
    return torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], dim=-1)


def distances(
    c2w: Float[Tensor, "n 3 4"],
    z: Float[Tensor, "n j"],
    uv: Float[Tensor, "n j 2"],
    m: Float[Tensor, "n j"],
    camera: Camera,
) -> tuple[Float[Tensor, "n j"], Float[Tensor, "n j"]]:
    """The two norms of eq. 4: to the centroid in the world (metres) and in the image (pixels); 0 where m = 0."""
    points = backproject(uv, z, c2w, camera)
    centroid = centroids(points, m)
    seen = m > 0
    to_centroid = torch.where(seen[..., None], points - centroid, 0.0)
    in_image = torch.where(seen[..., None], uv - reproject(centroid, c2w, camera), 0.0)
    return to_centroid.norm(dim=-1), in_image.norm(dim=-1)


def loss(
    c2w: Float[Tensor, "n 3 4"],
    z: Float[Tensor, "n j"],
    uv: Float[Tensor, "n j 2"],
    m: Float[Tensor, "n j"],
    camera: Camera,
    weight_2d: float,
    weight_3d: float = 1.0,
) -> Float[Tensor, ""]:
    """Full objective (eq. 5); ``weight_2d`` is the paper's lambda, ``weight_3d = 0`` its 2D-only ablation."""
    metres, pixels = distances(c2w, z, uv, m, camera)
    return (m * (weight_3d * metres + weight_2d * pixels)).sum() / m.shape[1]
