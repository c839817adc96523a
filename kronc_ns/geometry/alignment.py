"""Similarity alignment of camera trajectories and the pose errors that remain after it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from kronc_ns.geometry.poses import make_pose
from kronc_ns.geometry.rotations import rotation_angle_deg


@dataclass(frozen=True)
class Similarity:
    """x -> scale * rotation @ x + translation."""

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]

    @staticmethod
    def identity() -> "Similarity":
        """Everything stays where it is."""
        return Similarity(1.0, np.eye(3), np.zeros(3))

    @property
    def inverse(self) -> "Similarity":
        """The way back."""
        back = self.rotation.T / self.scale
        return Similarity(1 / self.scale, self.rotation.T, -back @ self.translation)

    def apply(self, points: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
        """Points carried into the target frame."""
        return self.scale * points @ self.rotation.T + self.translation

    def apply_to_poses(self, c2w: Float[np.ndarray, "*n 3 4"]) -> Float[np.ndarray, "*n 3 4"]:
        """Camera poses carried into the target frame; their rotations stay rotations."""
        return make_pose(self.rotation @ c2w[..., :3], self.apply(c2w[..., 3]))


def umeyama(
    source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"], weight: Float[np.ndarray, "n"] | None = None
) -> Similarity:
    """(Weighted) least-squares similarity with ``target ~ apply(source)`` (Umeyama, PAMI 1991, eq. 39-43).

    Coincident source points carry no scale or rotation: the similarity is then a translation.
    """
    share = np.ones(len(source)) if weight is None else weight
    share = share / share.sum()
    mean_x, mean_y = share @ source, share @ target
    x, y = source - mean_x, target - mean_y
    weighted = share[:, None] * x
    variance = np.vdot(weighted, x)
    rotation, scale = np.eye(3), 1.0
    if variance > np.finfo(np.float64).tiny:
        u, singular, vh = np.linalg.svd(y.T @ weighted)
        sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vh))])
        rotation = (u * sign) @ vh
        scale = float((singular * sign).sum() / variance)
    return Similarity(scale, rotation, mean_y - scale * rotation @ mean_x)


def pose_errors(
    c2w: Float[np.ndarray, "n 3 4"], reference: Float[np.ndarray, "n 3 4"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Rotation error (degrees) and centre error (the reference's unit) of each view.

    As in the paper (and BARF): the similarity that best maps the camera centres onto the reference's is
    applied first, so neither the world frame nor the scale counts.
    """
    aligned = umeyama(c2w[..., 3], reference[..., 3]).apply_to_poses(c2w)
    relative = aligned[..., :3].swapaxes(-1, -2) @ reference[..., :3]
    return rotation_angle_deg(relative), np.linalg.norm(aligned[..., 3] - reference[..., 3], axis=-1)
