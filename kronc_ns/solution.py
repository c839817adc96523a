"""What solving hands on: poses with the evidence for them, never a bare array."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from jaxtyping import Bool, Float

from kronc_ns.geometry.camera import Camera, Lenses


class Status(str, Enum):
    """How far a whole solution can be trusted; the value is the word in kronc.json."""

    CONVERGED = "converged"
    WEAK = "weak"
    FAILED = "failed"


class ViewStatus(str, Enum):
    """How the pose of one view came about."""

    SOLVED = "solved"
    COMPLETED = "completed"
    FAILED = "failed"


@dataclass(frozen=True)
class ViewReport:
    """Evidence for one view."""

    name: str
    status: ViewStatus
    visible: int
    """Keypoints found in the view."""
    inliers: int
    """Of those, how many the solved points explain."""
    rmse_px: float | None
    """Root mean square reprojection error of the inliers; None where the view was not solved."""
    sigma_rot_deg: float | None = None
    """Standard deviation of the rotation relative to the object: root of the summed variances of its three axes."""
    sigma_trans_m: float | None = None
    """Standard deviation of the camera centre relative to the object, likewise of all three axes together."""
    reason: str = ""
    """Why the view is not solved."""
    swapped: bool = False
    """Whether left and right were confused in its detections, and put right."""


@dataclass(frozen=True)
class Solution:
    """Poses, points and the evidence for them, in a z-up world (OpenCV camera axes)."""

    status: Status
    reason: str
    """One sentence on the status, with the remedy where it is not `Status.CONVERGED`."""
    names: tuple[str, ...]
    camera: Camera
    """Of all views; where there are several, that whose pixels all errors are in."""
    c2w: Float[np.ndarray, "n 3 4"]
    """Poses; NaN where a view failed."""
    points: Float[np.ndarray, "j 3"]
    """Keypoints in the world; NaN where fewer than two solved views see one."""
    depths: Float[np.ndarray, "n j"]
    """z-depth of each detection; NaN where there is none."""
    views: Sequence[ViewReport]
    initial_c2w: Float[np.ndarray, "n 3 4"]
    """Where the optimisation started, in the frame of its initialiser."""
    solver: str
    init: str
    iterations: int
    seconds: float
    rmse_px: float
    """Root mean square reprojection error over all inliers."""
    median_px: float
    """Median reprojection error over all detections in solved views."""
    history: Mapping[str, Sequence[float]] = field(default_factory=dict)
    path: Float[np.ndarray, "s n 3 4"] | None = None
    """Where the cameras were at steps on the way, each in a frame of its own; NaN for views that took no part."""
    lenses: Lenses | None = None
    """The cameras of the views, where there are several."""

    def camera_of(self, view: int) -> Camera:
        """The camera that took a view."""
        return self.camera if self.lenses is None else self.lenses.cameras[self.lenses.of_view[view]]

    def views_that_are(self, status: ViewStatus) -> Bool[np.ndarray, "n"]:
        """Which views came about so."""
        return np.array([view.status is status for view in self.views], dtype=bool)

    @property
    def posed(self) -> Bool[np.ndarray, "n"]:
        """Which views have a pose, solved or completed."""
        return ~self.views_that_are(ViewStatus.FAILED)
