"""Whether refined poses are better than those they came from, by evidence that no fit has seen.

Tracks that were held out must be met better (Wilcoxon's signed-rank test on their residuals), enough of them by three
views; and the keypoints must be met as well as before, but for what the views' unknowns took up of their noise.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from kronc_ns.refine.gathering import Gathered
from kronc_ns.refine.keypoints import KeypointTracks
from kronc_ns.refine.rig import Rig
from kronc_ns.refine.tracks import Tracks, place

_LEAST_Z = 2.0
"""Of the held-out tracks' test."""
_MOST_KEYPOINTS_Z, _MOST_VIEW_SIGMAS, _MOST_BAD_VIEWS = 6.0, 5.0, 0.1
"""Of the rise of the keypoints' chi-square: of all; of one view; the share of views that may exceed that."""
_LEAST_TRACKS, _LEAST_LONG = 10, 10
"""Held-out tracks that must be met, before or after; and how many of three views."""
_FITS_SIGMAS, _FITS_PX = 3.0, 0.3
"""A held-out track is met with errors up to here."""
_POSE = 6  # unknowns of a view


@dataclass(frozen=True)
class Evidence:
    """For and against the refined poses."""

    held: int
    """Tracks that no fit has seen."""
    held_long: int
    """Of those that either poses meet, how many three views see."""
    held_before_px: float
    """Median residual of those that either poses meet, by the keypoints' poses."""
    held_after_px: float
    held_z: float
    """How many standard deviations better the refined poses meet them."""
    keypoints_z: float
    """How many standard deviations the keypoints' chi-square rises beyond what is expected."""
    bad_views: int
    """Views whose keypoints are met so much worse that it is no chance."""
    views: int

    @property
    def objection(self) -> str:
        """Why the refined poses are not taken; empty where they are."""
        if self.held_long < _LEAST_LONG:
            return (
                f"too few features are seen from three views ({self.held_long} of the tracks held out, "
                f"{_LEAST_LONG} are needed)"
            )
        if not self.held_z > _LEAST_Z:
            return (
                f"tracks that were held out are not met better ({self.held_before_px:.2f} px before, "
                f"{self.held_after_px:.2f} px after)"
            )
        if not self.keypoints_z < _MOST_KEYPOINTS_Z:
            return f"the keypoints contradict it (chi-square {self.keypoints_z:.1f} sigma too high)"
        if self.bad_views > _MOST_BAD_VIEWS * self.views:
            return f"the keypoints of {self.bad_views} views contradict it"
        return ""


def weigh(
    held: Tracks, gathered: Gathered, keypoints: KeypointTracks, before: Rig, after: Rig, sigma_px: float
) -> Evidence:
    """Compare two sets of poses; ``sigma_px`` is the features' noise."""
    residual = [_residuals(held, gathered, rig) for rig in (before, after)]
    limit = max(_FITS_SIGMAS * sigma_px, _FITS_PX)
    met = (residual[0] < limit) | (residual[1] < limit)
    gain = np.log(np.maximum(residual[0], 0.02) / np.maximum(residual[1], 0.02))[met]
    chi_square, counted = zip(*(_chi_square(keypoints, rig) for rig in (before, after)), strict=True)
    rise, views = chi_square[1] - chi_square[0], int((counted[0] > 0).sum())
    expected, spread = _POSE * (counted[0] > 0), np.sqrt(2 * _POSE)
    medians = [float(np.median(one[met])) if met.any() else float("nan") for one in residual]
    return Evidence(
        held=len(held),
        held_long=int((held.lengths[met] >= 3).sum()),
        held_before_px=medians[0],
        held_after_px=medians[1],
        held_z=_signed_rank_z(gain) if len(gain) >= _LEAST_TRACKS else 0.0,
        keypoints_z=float((rise - expected).sum() / (spread * max(views, 1) ** 0.5)),
        bad_views=int((rise > _POSE + _MOST_VIEW_SIGMAS * spread).sum()),
        views=views,
    )


def _residuals(tracks: Tracks, gathered: Gathered, rig: Rig) -> Float[np.ndarray, "p"]:
    """Root mean square residual of each track per degree of freedom, its point placed anew."""
    uv = rig.ideal(gathered.pixel, gathered.view)
    placed, error = place(tracks, uv, gathered.view, rig.cameras, 1.0)
    squares = np.bincount(placed.of_track, weights=error**2, minlength=len(placed))
    return np.sqrt(squares / (2 * placed.lengths - 3))


def _chi_square(keypoints: KeypointTracks, rig: Rig) -> tuple[Float[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """Of each view's keypoints that fitted before, their points placed anew; and how many there are."""
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


def _signed_rank_z(gain: Float[np.ndarray, "k"]) -> float:
    """Wilcoxon's signed-rank statistic (1945) in standard deviations; positive where gains prevail."""
    count = len(gain)
    rank = np.argsort(np.argsort(np.abs(gain), kind="stable"), kind="stable") + 1
    return float((np.sign(gain) * rank).sum() / np.sqrt(count * (count + 1) * (2 * count + 1) / 6))
