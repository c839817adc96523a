"""What solving hands on: poses with the evidence for them, never a bare array."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

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
class Cloud:
    """Points that image features were triangulated to, and where they were seen."""

    points: Float[np.ndarray, "p 3"]
    colours: UInt8[np.ndarray, "p 3"]
    on_vehicle: Bool[np.ndarray, "p"]
    first: Int[np.ndarray, "p1"]
    """Sightings of point k are ``first[k]:first[k + 1]``."""
    view: Int[np.ndarray, "s"]
    """Of the solution's views."""
    pixel: Float[np.ndarray, "s 2"]
    """As photographed."""


@dataclass(frozen=True)
class ImageEvidence:
    """What image features said of poses that keypoints gave."""

    accepted: bool
    reason: str
    """Why their poses were taken, or were not."""
    region: str
    """vehicle or frame: where features were used."""
    background_still: bool
    """Whether the background stood still while the car turned."""
    tracks_by_length: Sequence[int]
    """How many tracks have been seen by 0, 1, 2, ... views."""
    observations: Sequence[int]
    """Of each view."""
    held_out: int
    """Tracks that no fit has seen."""
    held_out_before_px: float | None
    """Their median residual by the keypoints' poses; None where there are none."""
    held_out_after_px: float | None
    held_out_z: float
    """By how many standard deviations they are met better (Wilcoxon)."""
    keypoints_z: float
    """By how many standard deviations the keypoints' chi-square rises beyond what detections that err alike explain."""
    noise_px: float | None
    """Of features along one axis."""
    focal_before_px: float
    focal_after_px: float
    seconds: float


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
    images: ImageEvidence | None = None
    """Of a refinement by image features, accepted or not; None where none was tried."""
    cloud: Cloud | None = None
    """The features' points, where their poses were taken."""

    def camera_of(self, view: int) -> Camera:
        """The camera that took a view."""
        return self.camera if self.lenses is None else self.lenses.cameras[self.lenses.of_view[view]]

    def views_that_are(self, status: ViewStatus) -> Bool[np.ndarray, "n"]:
        """Which views came about so."""
        return np.array([view.status is status for view in self.views], dtype=bool)

    @property
    def swapped(self) -> Bool[np.ndarray, "n"]:
        """Which views' left and right were put right."""
        return np.array([view.swapped for view in self.views], bool)

    @property
    def posed(self) -> Bool[np.ndarray, "n"]:
        """Which views have a pose, solved or completed."""
        return ~self.views_that_are(ViewStatus.FAILED)
