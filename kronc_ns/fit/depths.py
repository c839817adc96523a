"""Where the optimisation starts: camera poses and keypoint depths."""

import math
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from kronc_ns.geometry.poses import compose, look_at, make_pose
from kronc_ns.geometry.rotations import so3_exp

Direction = Literal["ccw", "cw"]


def circular_poses(
    views: int, radius_m: float = 4.0, direction: Direction = "ccw", laps: float = 1.0
) -> Float[Tensor, "n 3 4"]:
    """The paper's coarse trajectory (section 5.2): a level circle about the z axis, all cameras facing it, no tilt.

    View i stands at azimuth ``360 * laps * i / views`` degrees, counterclockwise seen from above by default.
    OpenCV c2w, float64.
    """
    azimuth = torch.arange(views, dtype=torch.float64) * (2 * math.pi * laps / views)
    if direction == "cw":
        azimuth = -azimuth
    centres = radius_m * torch.stack([azimuth.cos(), azimuth.sin(), torch.zeros_like(azimuth)], dim=1)
    return look_at(centres, torch.zeros_like(centres), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))


def noisy_poses(
    c2w: Float[Tensor, "n 3 4"], rotation_deg: float, translation_m: float, generator: torch.Generator
) -> Float[Tensor, "n 3 4"]:
    """Known poses times noise from the right: cameras turn and move about themselves (paper, appendix B).

    Each component of the rotation vector and of the translation is normal with the given standard deviation.
    """
    draw = torch.randn(len(c2w), 6, dtype=torch.float64, generator=generator).to(c2w)
    noise = make_pose(so3_exp(draw[:, :3] * math.radians(rotation_deg)), draw[:, 3:] * translation_m)
    return compose(c2w, noise)


def mean_distance(c2w: Float[Tensor, "n 3 4"]) -> float:
    """The paper's omega: mean L2 norm of the initial translations."""
    return float(c2w[..., 3].norm(dim=-1).mean())


def random_depths(c2w: Float[Tensor, "n 3 4"], keypoints: int, generator: torch.Generator) -> Float[Tensor, "n j"]:
    """z-depths uniform in [omega / 2, omega] (paper, section 5.1)."""
    uniform = torch.rand(len(c2w), keypoints, dtype=torch.float64, generator=generator).to(c2w)
    return mean_distance(c2w) * (0.5 + 0.5 * uniform)


def prior_depths(
    given: Float[Tensor, "n j"],
    c2w: Float[Tensor, "n 3 4"],
    rays: Float[Tensor, "n j 3"],
    m: Float[Tensor, "n j"],
    fallback: Float[Tensor, "n j"],
) -> Float[Tensor, "n j"]:
    """Depths from depth maps, scaled to the initial trajectory; ``fallback`` where they have none (NaN).

    The scale is the median ratio to the depths of the points that the initial poses triangulate: one for all views,
    since a depth map need not be metric, nor the trajectory.
    """
    points = triangulate(c2w, rays, m)
    initial = ((points - c2w[:, None, :, 3]) * c2w[:, None, :, 2]).sum(-1)
    known = given.isfinite()
    usable = known & (m > 0) & (initial > 0)
    scale = (initial[usable] / given[usable]).median() if usable.any() else 1.0
    return torch.where(known, given * scale, fallback)


def triangulate(
    c2w: Float[Tensor, "n 3 4"], rays: Float[Tensor, "n j 3"], m: Float[Tensor, "n j"]
) -> Float[Tensor, "j 3"]:
    """Points nearest to all the rays (K^-1 (u, v, 1)) that see them; the cameras' mean centre where none does."""
    ones = rays.new_ones(3)  # a product with it is several times faster than a sum over three
    direction = (rays / (rays.square() @ ones).sqrt()[..., None]) @ c2w[..., :3].transpose(-1, -2)
    along = direction @ c2w[..., 3:]
    # sum of m (I - d d^T), and of the same times the centres; a trace of the identity where rays are parallel
    weighted = m[..., None] * direction
    outer = torch.einsum("nja,njb->jab", weighted, direction)
    count = m.sum(0)
    identity = torch.eye(3, dtype=c2w.dtype, device=c2w.device)
    trace = (1e-9 * count + 1e-12)[:, None, None] * identity
    rhs = m.T @ c2w[..., 3] - (weighted * along).sum(0) + trace[..., 0, :1] * c2w[..., 3].mean(0)
    return torch.linalg.solve(count[:, None, None] * identity - outer + trace, rhs)
