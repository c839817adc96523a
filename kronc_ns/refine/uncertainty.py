"""How sure refined poses are: the sandwich covariance of a joint adjustment, relative to all other cameras."""

import numpy as np
from jaxtyping import Float

from kronc_ns.refine.adjustment import sightings
from kronc_ns.refine.gathering import Gathered
from kronc_ns.refine.keypoints import KeypointTracks
from kronc_ns.refine.options import RefineConfig
from kronc_ns.refine.rig import Rig
from kronc_ns.refine.tracks import Tracks
from kronc_ns.solve.sandwich import sandwich
from kronc_ns.solve.sightings import gauge_of

_UNSEEN = 2.0
"""By how much variances are larger than residuals tell: tracks of three views show less noise than they have, and
neighbouring patches err alike, to which poses give way. Measured on rendered walks of 15, 30 and 60 photos."""


def pose_sigmas(
    keypoints: KeypointTracks, tracks: Tracks, gathered: Gathered, rig: Rig, sigma_px: float, refine: RefineConfig
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Standard deviations of each view: of the rotation in degrees and of the centre in units of the world, each the
    root of the summed variances of three axes.

    No common shift, turn or growth of the camera centres counts, as where poses are compared after an alignment.
    """
    data, now = sightings(keypoints, tracks, gathered, rig, sigma_px, refine)
    views = len(rig.rotation)
    curvature, scores = sandwich(data, now)
    gauge = gauge_of(now, len(curvature))
    basis = np.linalg.qr(gauge)[0]
    inverse = np.linalg.inv(curvature + np.trace(curvature) / len(curvature) * (basis @ basis.T))
    held = _centres_held(rig, len(curvature))
    project = np.eye(len(curvature)) - gauge @ np.linalg.solve(held @ gauge, held)
    half = project @ inverse
    freedom = 2 * len(data.camera) - 3 * len(now.points) - len(curvature)
    measured = 2 * len(data.camera) - 3 * len(now.points)
    covariance = half @ scores @ half.T * (_UNSEEN * measured / max(freedom, 1))
    block = np.diagonal(covariance)[: 6 * views].reshape(views, 6)
    rotation = np.degrees(np.sqrt(np.maximum(block[:, :3].sum(1), 0)))
    at = 6 * np.arange(views)[:, None] + np.arange(6)
    own = covariance[at[:, :, None], at[:, None, :]]
    by_pose = _centre_by_pose(rig)
    centre = np.trace(by_pose @ own @ by_pose.transpose(0, 2, 1), axis1=1, axis2=2)
    return rotation, np.sqrt(np.maximum(centre, 0))


def _centre_by_pose(rig: Rig) -> Float[np.ndarray, "n 3 6"]:
    """Derivative of each centre, in the world, by turn and shift: with R' = exp(w) R and t' = exp(w) t + v the centre
    -R'^T t' moves by -R^T v."""
    derivative = np.zeros((len(rig.rotation), 3, 6))
    derivative[:, :, 3:] = -rig.rotation.transpose(0, 2, 1)
    return derivative


def _centres_held(rig: Rig, unknowns: int) -> Float[np.ndarray, "7 f"]:
    """Rows whose products with the unknowns' changes vanish where the centres have no common shift, turn or growth."""
    centre = rig.cameras.centre
    arm = centre - centre.mean(0)
    by_pose = _centre_by_pose(rig)
    rows = np.zeros((7, unknowns))
    for n, (r, derivative) in enumerate(zip(arm, by_pose, strict=True)):
        columns = slice(6 * n, 6 * n + 6)
        rows[:3, columns] = derivative
        rows[3:6, columns] = np.cross(r[:, None], derivative, axis=0)
        rows[6, columns] = r @ derivative
    return rows
