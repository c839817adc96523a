"""The semantic keypoints of a solution as tracks: they hold what features alone would let go of."""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from kronc_ns.fit.noise import posterior
from kronc_ns.fit.verdict import inliers
from kronc_ns.refine.rig import Rig
from kronc_ns.refine.tracks import Tracks
from kronc_ns.refine.triangulation import place
from kronc_ns.scene import Scene
from kronc_ns.solution import Solution

_SCALE_SIGMAS = 3.0  # of the Cauchy loss
LEAST_VIEWS = 2
"""That a keypoint must be seen in."""
POSE = 6
"""Unknowns of a view."""
MOST_ALIKE = 6.0
"""How much more of the detections' noise a pose may take up than if each erred for itself. Detectors misplace
neighbouring points alike; at the true poses of rendered walks this is 2.4 to 6 (and 1 for noise that was added)."""
_MEDIAN_OF_POSE = 5.348  # of chi-square with six degrees of freedom


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

    def noisier(self, variance: float) -> "KeypointTracks":
        """The same detections, believed less: with so many times the variance."""
        return replace(self, sigma_px=self.sigma_px * math.sqrt(variance))


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


def chi_square(keypoints: KeypointTracks, rig: Rig) -> tuple[Float[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Of each view's keypoints that the solution explains, their points placed anew; and how many there are."""
    track = np.repeat(np.arange(len(keypoints.joint)), np.diff(keypoints.first))
    seen = np.bincount(track[keypoints.fits], minlength=len(keypoints.joint))
    used = np.flatnonzero(keypoints.fits & (seen[track] >= 3))
    views = len(rig.rotation)
    if not len(used):
        return np.zeros(views), np.zeros(views, int)
    count = np.bincount(track[used])
    first = np.concatenate([[0], np.cumsum(count[count > 0])]).astype(np.int64)
    uv = rig.ideal(keypoints.pixel, keypoints.view)
    chosen = Tracks(first, used, np.zeros((len(first) - 1, 3)))
    wide = 10 * float(np.median(keypoints.sigma_px))
    _, error = place(chosen, uv, keypoints.view, rig.cameras, wide)
    at, square = keypoints.view[used], (error / keypoints.sigma_px[used]) ** 2
    return np.bincount(at, weights=square, minlength=views), np.bincount(at, minlength=views)


def alike(keypoints: KeypointTracks, before: Rig, after: Rig) -> float:
    """By how much detections err alike, if the poses ``after`` are right, 1 to `MOST_ALIKE`: how many times more of
    the noise the poses ``before``, which were fitted to the detections, took up than if each erred for itself.

    The median view tells, so that views whose keypoints were misunderstood do not.
    """
    (low, counted), (high, _) = chi_square(keypoints, before), chi_square(keypoints, after)
    rise = (high - low)[counted > 0]
    return float(np.clip(np.median(rise) / _MEDIAN_OF_POSE, 1.0, MOST_ALIKE)) if len(rise) else 1.0
