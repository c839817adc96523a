"""Similarity alignment of camera trajectories and the pose errors that remain after it."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from kronc_ns.geometry.poses import make_pose
from kronc_ns.geometry.rotations import rotation_angle_deg


@dataclass(frozen=True)
class Similarity:
    """x -> scale * rotation @ x + translation."""

    scale: Tensor
    rotation: Float[Tensor, "3 3"]
    translation: Float[Tensor, "3"]

    def apply(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Points carried into the target frame."""
        return self.scale * points @ self.rotation.T + self.translation

    def apply_to_poses(self, c2w: Float[Tensor, "n 3 4"]) -> Float[Tensor, "n 3 4"]:
        """Camera poses carried into the target frame; their rotations stay rotations."""
        return make_pose(self.rotation @ c2w[..., :3], self.apply(c2w[..., 3]))


def umeyama(
    source: Float[Tensor, "n 3"], target: Float[Tensor, "n 3"], weight: Float[Tensor, "n"] | None = None
) -> Similarity:
    """(Weighted) least-squares similarity with ``target ~ apply(source)`` (Umeyama, PAMI 1991, eq. 39-43).

    Coincident source points carry no scale or rotation: the similarity is then a translation.
    """
    x, y = (points.detach().double().cpu().numpy() for points in (source, target))  # NumPy: a tenth of torch's overhead
    share = np.ones(len(x)) if weight is None else weight.detach().double().cpu().numpy()
    share = (share / share.sum())[:, None]
    mean_x, mean_y = (share * x).sum(0), (share * y).sum(0)
    x, y = x - mean_x, y - mean_y
    variance = (share * x * x).sum()
    rotation, scale = np.eye(3), 1.0
    if variance > np.finfo(x.dtype).tiny:
        u, singular, vh = np.linalg.svd(y.T @ (share * x))
        sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vh))])
        rotation = (u * sign) @ vh
        scale = (singular * sign).sum() / variance
    translation = mean_y - scale * rotation @ mean_x
    return Similarity(*(torch.as_tensor(part).to(source) for part in (scale, rotation, translation)))


def pose_errors(
    c2w: Float[Tensor, "n 3 4"], reference: Float[Tensor, "n 3 4"]
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Rotation error (degrees) and centre error (the reference's unit) of each view.

    As in the paper (and BARF): the similarity that best maps the camera centres onto the reference's is
    applied first, so neither the world frame nor the scale counts.
    """
    aligned = umeyama(c2w[..., 3], reference[..., 3]).apply_to_poses(c2w)
    relative = aligned[..., :3].transpose(-1, -2) @ reference[..., :3]
    return rotation_angle_deg(relative), (aligned[..., 3] - reference[..., 3]).norm(dim=-1)
