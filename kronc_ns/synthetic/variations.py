"""What else happens to captures: views in another order, swapped sides, few or no detections; to be combined freely."""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from kronc_ns.geometry.poses import compose, make_pose
from kronc_ns.geometry.rotations import so3_exp
from kronc_ns.keypoints.schema import APOLLOCAR3D_66, KeypointSchema
from kronc_ns.synthetic.scenes import Capture


def reorder(capture: Capture, order: Int[Tensor, "n"]) -> Capture:
    """The same views as if they had been taken in another order: view i becomes the old view ``order[i]``."""
    return replace(capture, c2w=capture.c2w[order], keypoints=capture.keypoints[order], wild=capture.wild[order])


def reverse(capture: Capture) -> Capture:
    """The last view first."""
    return reorder(capture, torch.arange(len(capture.c2w)).flip(0))


def shuffle(capture: Capture, rng: np.random.Generator) -> Capture:
    """The views in any order."""
    return reorder(capture, torch.from_numpy(rng.permutation(len(capture.c2w))))


def swap_sides(
    capture: Capture, share: float, rng: np.random.Generator, schema: KeypointSchema = APOLLOCAR3D_66
) -> tuple[Capture, Bool[Tensor, "n"]]:
    """A detector that takes left for right in a ``share`` of the views (rounded); and which views those are."""
    chosen = _choose(len(capture.c2w), share, rng)
    flip = torch.tensor(schema.flip)
    swapped = replace(
        capture,
        keypoints=torch.where(chosen[:, None, None], capture.keypoints[:, flip], capture.keypoints),
        wild=torch.where(chosen[:, None], capture.wild[:, flip], capture.wild),
    )
    return swapped, chosen


def empty_views(capture: Capture, share: float, rng: np.random.Generator) -> tuple[Capture, Bool[Tensor, "n"]]:
    """A detector that finds nothing in a ``share`` of the views (rounded); and which views those are."""
    chosen = _choose(len(capture.c2w), share, rng)
    return _keep(capture, ~chosen[:, None]), chosen


def limit_points(capture: Capture, most: int, rng: np.random.Generator) -> Capture:
    """A detector that finds ``most`` of the visible keypoints of a view, at the most."""
    seen = capture.keypoints[..., 2] > 0
    lot = torch.where(seen, torch.from_numpy(rng.uniform(size=tuple(seen.shape))), torch.inf)
    return _keep(capture, lot.argsort(1).argsort(1) < most)


def on_wheels(points: Float[Tensor, "j 3"], schema: KeypointSchema = APOLLOCAR3D_66) -> Float[Tensor, "j 3"]:
    """A car's keypoints (x forward, z up, metres) moved so that it stands on the ground, centred on the origin."""
    wheel_radius_m = 0.33
    low, high = points.amin(0), points.amax(0)
    height = points[list(schema.wheels), 2].mean() - wheel_radius_m
    return points - torch.stack([*((low + high) / 2)[:2], height])


def _choose(views: int, share: float, rng: np.random.Generator) -> Bool[Tensor, "n"]:
    return torch.from_numpy(rng.permutation(views) < round(share * views))


def _keep(capture: Capture, kept: Bool[Tensor, "n #j"]) -> Capture:
    """The capture with detections outside ``kept`` taken out."""
    return replace(capture, keypoints=torch.where(kept[..., None], capture.keypoints, 0.0), wild=capture.wild & kept)


def noisy_poses(
    c2w: Float[np.ndarray, "n 3 4"], rotation_deg: float, translation_m: float, rng: np.random.Generator
) -> Float[np.ndarray, "n 3 4"]:
    """Known poses times noise from the right: cameras turn and move about themselves (paper, appendix B).

    Each component of the rotation vector and of the translation is normal with the given standard deviation.
    """
    draw = rng.normal(size=(len(c2w), 6))
    noise = make_pose(so3_exp(draw[:, :3] * np.deg2rad(rotation_deg)), draw[:, 3:] * translation_m)
    return compose(c2w, noise)
