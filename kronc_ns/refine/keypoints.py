"""The semantic keypoints of a solution as tracks: they hold what features alone would let go of."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from kronc_ns.fit.noise import posterior
from kronc_ns.fit.verdict import inliers
from kronc_ns.scene import Scene
from kronc_ns.solution import Solution

_SCALE_SIGMAS = 3.0  # of the Cauchy loss
LEAST_VIEWS = 2
"""That a keypoint must be seen in."""


@dataclass(frozen=True)
class KeypointTracks:
    """Detections of J' keypoints in N views, point by point."""

    first: Int[np.ndarray, "j1"]
    view: Int[np.ndarray, "s"]
    joint: Int[np.ndarray, "j"]
    """Which keypoint each track is of."""
    pixel: Float[np.ndarray, "s 2"]
    """As photographed."""
    sigma_px: Float[np.ndarray, "s"]
    """Noise of each detection along one axis, in pixels of the scene's camera."""
    fits: Bool[np.ndarray, "s"]
    """Which the solution explains."""

    @property
    def scale_px(self) -> Float[np.ndarray, "s"]:
        """Of the Cauchy loss."""
        return _SCALE_SIGMAS * self.sigma_px


def keypoint_tracks(scene: Scene, solution: Solution, views: Int[np.ndarray, "n"]) -> KeypointTracks:
    """Of ``views``, which are numbered from 0 on in their order.

    The noise is that of the fit, made good for the unknowns as in the verdict.
    """
    known = np.isfinite(solution.points).all(-1)
    seen = scene.seen[views] & known
    seen = seen & (seen.sum(0) >= LEAST_VIEWS)
    joint, view = np.nonzero(seen.T)
    number, row = np.unique(joint, return_inverse=True)
    first = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=len(number)))]).astype(np.int64)
    error, inlier = inliers(scene, solution)
    fits = inlier[views][view, joint]
    precision = scene.precision[views][view, joint]
    relative = precision / max(float(precision.mean()), 1e-12) if len(precision) else precision
    squares = float((relative * np.where(fits, error[views][view, joint], 0.0) ** 2).sum())
    unknown = 6 * len(np.unique(view[fits])) + 3 * len(np.unique(joint[fits])) - 7
    camera = scene.camera
    noise = posterior(squares, 2 * int(fits.sum()) - unknown, math.hypot(camera.width, camera.height))
    return KeypointTracks(
        first,
        view,
        number,
        scene.keypoints[views][view, joint, :2],
        noise.sigma_px / np.sqrt(np.maximum(relative, 1e-12)),
        fits,
    )
