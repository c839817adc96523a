"""The paper's equations as pure functions of tensors; autograd goes through all of them.

N views, J keypoints. ``m [N, J]`` is the visibility, ``uv [N, J, 2]`` the detected pixels, ``z [N, J]`` the
z-depths, ``c2w [N, 3, 4]`` the poses (the paper's R_i, t_i).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from kronc_ns.geometry.camera import Camera, backproject, project
from kronc_ns.geometry.poses import invert, transform


def centroids(points: Float[Tensor, "n j 3"], m: Float[Tensor, "n j"]) -> Float[Tensor, "j 3"]:
    """C^j: visibility-weighted mean of each keypoint's back-projections (eq. 2); zero where none is visible."""
    weights = m / m.sum(0).clamp_min(torch.finfo(m.dtype).tiny)
    return (weights[..., None] * points).sum(0)


def reproject(centroid: Float[Tensor, "j 3"], c2w: Float[Tensor, "n 3 4"], camera: Camera) -> Float[Tensor, "n j 2"]:
    """Pixels of every centroid in every view (eq. 3)."""
    return project(transform(invert(c2w), centroid.expand(len(c2w), -1, -1)), camera)


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
