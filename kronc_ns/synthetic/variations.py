"""What else happens to captures: another order, swapped sides, few or no detections, noise on poses; combine freely."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from kronc_ns.geometry.poses import compose, make_pose
from kronc_ns.geometry.rotations import so3_exp
from kronc_ns.keypoints.schema import APOLLOCAR3D_66, KeypointSchema
from kronc_ns.synthetic.scenes import Capture


def reorder(capture: Capture, order: Int[np.ndarray, "n"]) -> Capture:
    """The same views as if they had been taken in another order: view i becomes the old view ``order[i]``."""
    return replace(capture, c2w=capture.c2w[order], keypoints=capture.keypoints[order], wild=capture.wild[order])


def reverse(capture: Capture) -> Capture:
    """The last view first."""
    return reorder(capture, np.arange(len(capture.c2w))[::-1])


def shuffle(capture: Capture, rng: np.random.Generator) -> Capture:
    """The views in any order."""
    return reorder(capture, rng.permutation(len(capture.c2w)))


def swap_sides(
    capture: Capture, share: float, rng: np.random.Generator, schema: KeypointSchema = APOLLOCAR3D_66
) -> tuple[Capture, Bool[np.ndarray, "n"]]:
    """A detector that takes left for right in a ``share`` of the views (rounded); and which views those are."""
    chosen = _choose(len(capture.c2w), share, rng)
    swapped = replace(
        capture,
        keypoints=np.where(chosen[:, None, None], schema.mirrored(capture.keypoints), capture.keypoints),
        wild=np.where(chosen[:, None], capture.wild[:, list(schema.flip)], capture.wild),
    )
    return swapped, chosen


def empty_views(capture: Capture, share: float, rng: np.random.Generator) -> tuple[Capture, Bool[np.ndarray, "n"]]:
    """A detector that finds nothing in a ``share`` of the views (rounded); and which views those are."""
    chosen = _choose(len(capture.c2w), share, rng)
    return _keep(capture, ~chosen[:, None]), chosen


def limit_points(capture: Capture, most: int, rng: np.random.Generator) -> Capture:
    """A detector that finds ``most`` of the visible keypoints of a view, at the most."""
    seen = capture.keypoints[..., 2] > 0
    lot = np.where(seen, rng.uniform(size=seen.shape), np.inf)
    return _keep(capture, lot.argsort(1).argsort(1) < most)


def on_wheels(points: Float[np.ndarray, "j 3"], schema: KeypointSchema = APOLLOCAR3D_66) -> Float[np.ndarray, "j 3"]:
    """A car's keypoints (x forward, z up, metres) moved so that it stands on the ground, centred on the origin."""
    wheel_radius_m = 0.33
    low, high = points.min(0), points.max(0)
    height = points[list(schema.wheels), 2].mean() - wheel_radius_m
    return points - np.array([*((low + high) / 2)[:2], height])


def noisy_poses(
    c2w: Float[np.ndarray, "n 3 4"], rotation_deg: float, translation_m: float, rng: np.random.Generator
) -> Float[np.ndarray, "n 3 4"]:
    """Known poses times noise from the right: cameras turn and move about themselves (paper, appendix B).

    Each component of the rotation vector and of the translation is normal with the given standard deviation.
    """
    draw = rng.normal(size=(len(c2w), 6))
    noise = make_pose(so3_exp(draw[:, :3] * np.deg2rad(rotation_deg)), draw[:, 3:] * translation_m)
    return compose(c2w, noise)


def _choose(views: int, share: float, rng: np.random.Generator) -> Bool[np.ndarray, "n"]:
    return rng.permutation(views) < round(share * views)


def _keep(capture: Capture, kept: Bool[np.ndarray, "n #j"]) -> Capture:
    """The capture with detections outside ``kept`` taken out."""
    return replace(capture, keypoints=np.where(kept[..., None], capture.keypoints, 0.0), wild=capture.wild & kept)
