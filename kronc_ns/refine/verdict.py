"""Whether refined poses are better than those they came from, by evidence that no fit has seen.

Tracks that were held out must be met better (Wilcoxon's signed-rank test on their residuals), enough of them by three
views; and the keypoints must be met as well as before, but for what the views' unknowns took up of their noise: six
degrees of freedom a view where each detection errs for itself, more where a detector misplaces neighbours alike.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from kronc_ns.refine.gathering import Gathered
from kronc_ns.refine.keypoints import MOST_ALIKE, POSE, KeypointTracks, chi_square
from kronc_ns.refine.rig import Rig
from kronc_ns.refine.tracks import Tracks, long_sightings
from kronc_ns.refine.triangulation import place

_LEAST_Z = 3.0
"""Of the held-out tracks' test: chance alone passes it once in 700."""
_MOST_KEYPOINTS_Z, _MOST_VIEW_SIGMAS, _MOST_BAD_VIEWS = 6.0, 5.0, 0.2
"""Of the rise of the keypoints' chi-square: of all; of one view; the share of views that may exceed that."""
_LEAST_TRACKS, _LEAST_LONG = 10, 10
"""Held-out tracks that must be met, before or after; and how many of three views."""
HELD_BY, MOST_LOOSE = 10, 0.25
"""Sightings in tracks of three views that hold a view; the share of views that may have fewer."""
_MOST_FOCAL = 0.03
"""Growth of a focal length that is held fixed, past which all poses are bent to suit it."""
_FITS_SIGMAS, _FITS_PX = 3.0, 0.3
"""A held-out track is met with errors up to here."""


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
    """How many standard deviations the chi-square of the other views' keypoints rises beyond what detections that err
    alike explain."""
    bad_views: int
    """Views whose keypoints are met so much worse that it is no chance."""
    views: int
    loose_views: int
    """Views of which hardly any feature is seen from two others."""
    focal_growth: float = 1.0
    """By how much the features would have the focal length grow where it is held fixed."""

    @property
    def objection(self) -> str:
        """Why the refined poses are not taken; empty where they are."""
        if self.held_long < _LEAST_LONG:
            return (
                f"too few features are seen from three views ({self.held_long} of the tracks held out, "
                f"{_LEAST_LONG} are needed)"
            )
        if self.loose_views > MOST_LOOSE * self.views:
            return f"features hold only {self.views - self.loose_views} of {self.views} views together"
        if not self.held_z > _LEAST_Z:
            return (
                f"tracks that were held out are not met better ({self.held_before_px:.2f} px before, "
                f"{self.held_after_px:.2f} px after)"
            )
        if not self.keypoints_z < _MOST_KEYPOINTS_Z:
            return f"the keypoints contradict it (chi-square {self.keypoints_z:.1f} sigma too high)"
        if self.bad_views > _MOST_BAD_VIEWS * self.views:
            return f"the keypoints of {self.bad_views} views contradict it"
        if abs(math.log(self.focal_growth)) > _MOST_FOCAL:
            return (
                f"the features contradict the focal length, which they would have {self.focal_growth:.2f} times as "
                "large: --refine-focal finds it"
            )
        return ""


def weigh(
    held: Tracks,
    fitted: Tracks,
    gathered: Gathered,
    keypoints: KeypointTracks,
    before: Rig,
    after: Rig,
    sigma_px: float,
) -> Evidence:
    """Compare two sets of poses, by tracks that were held out; ``sigma_px`` is the features' noise."""
    seen = long_sightings(fitted, gathered.view, len(after.rotation))
    residual = [_residuals(held, gathered, rig) for rig in (before, after)]
    limit = max(_FITS_SIGMAS * sigma_px, _FITS_PX)
    met = (residual[0] < limit) | (residual[1] < limit)
    gain = np.log(np.maximum(residual[0], 0.02) / np.maximum(residual[1], 0.02))[met]
    (low, counted), (high, _) = chi_square(keypoints, before), chi_square(keypoints, after)
    rise = (high - low)[counted > 0]
    expected, spread = MOST_ALIKE * POSE, MOST_ALIKE * math.sqrt(2 * POSE)
    bad = rise > expected + _MOST_VIEW_SIGMAS * spread
    others = rise[~bad]
    medians = [float(np.median(one[met])) if met.any() else float("nan") for one in residual]
    return Evidence(
        held=len(held),
        held_long=int((held.lengths[met] >= 3).sum()),
        held_before_px=medians[0],
        held_after_px=medians[1],
        held_z=_signed_rank_z(gain) if len(gain) >= _LEAST_TRACKS else 0.0,
        keypoints_z=float((others - expected).sum() / (spread * math.sqrt(max(len(others), 1)))),
        bad_views=int(bad.sum()),
        views=len(after.rotation),
        loose_views=int((seen < HELD_BY).sum()),
    )


def _residuals(tracks: Tracks, gathered: Gathered, rig: Rig) -> Float[np.ndarray, "p"]:
    """Root mean square residual of each track per degree of freedom, its point placed anew."""
    uv = rig.ideal(gathered.pixel, gathered.view)
    placed, error = place(tracks, uv, gathered.view, rig.cameras, 1.0)
    squares = np.bincount(placed.of_track, weights=error**2, minlength=len(placed))
    return np.sqrt(squares / (2 * placed.lengths - 3))


def _signed_rank_z(gain: Float[np.ndarray, "k"]) -> float:
    """Wilcoxon's signed-rank statistic (1945) in standard deviations; positive where gains prevail."""
    count = len(gain)
    rank = np.argsort(np.argsort(np.abs(gain), kind="stable"), kind="stable") + 1
    return float((np.sign(gain) * rank).sum() / np.sqrt(count * (count + 1) * (2 * count + 1) / 6))
