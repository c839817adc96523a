"""What bundle adjustment knows and seeks: measurements, priors and unknowns of a scene.

N views, J keypoints. The unknowns of the reduced system are ordered (x of all points, y of all, z of all, intrinsics).
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from kronc_ns.geometry.poses import invert, make_pose
from kronc_ns.solve.robust import REDUNDANCY_MOST

Intrinsic = Literal["focal", "k1"]


@dataclass(frozen=True)
class ShapePrior:
    """What is known of the points beforehand: about normal around a mean shape, in the world's own frame.

    Arrays are in the planar order of the reduced system.
    """

    mean: Float[np.ndarray, "p"]
    precision: Float[np.ndarray, "p p"]
    """Inverse covariance."""
    freedom: float = 20.0
    """Degrees of freedom of the tail (Student t): the fewer, the sooner an unusual shape is believed."""

    @staticmethod
    def of(mean: Float[np.ndarray, "j 3"], precision: Float[np.ndarray, "p p"]) -> "ShapePrior":
        """Prior from a mean shape and an inverse covariance in the order index = 3 * point + axis."""
        order = np.arange(mean.size).reshape(-1, 3).T.ravel()
        return ShapePrior(mean.T.ravel(), np.ascontiguousarray(precision[np.ix_(order, order)]))


@dataclass(frozen=True)
class OrbitPrior:
    """Expected camera centres, such as those of a smooth walk."""

    centre: Float[np.ndarray, "n 3"]
    sigma: Float[np.ndarray, "n"]
    """Standard deviation per axis; inf where nothing is expected."""


@dataclass(frozen=True)
class Problem:
    """What a scene measured."""

    uv: Float[np.ndarray, "n j 2"]
    """Undistorted pixels less the principal point."""
    weight: Float[np.ndarray, "n j"]
    """Weight of each detection's squared error; 0: not seen."""
    focal: tuple[float, float]
    shape: ShapePrior | None = None
    orbit: OrbitPrior | None = None
    refine: tuple[Intrinsic, ...] = ()
    """Intrinsics that are unknown too, of every lens."""
    lens: Int[np.ndarray, "n"] | None = None
    """By which lens each view was taken, from 0 on; None: all by one."""
    points_known: bool = False
    """Whether only the cameras are sought."""

    @property
    def lenses(self) -> int:
        """How many there are."""
        return 1 if self.lens is None else int(self.lens.max(initial=0)) + 1

    @property
    def redundancy(self) -> float:
        """Factor from the spread of residuals to that of the detections: the unknowns take up part of the noise."""
        seen = self.weight > 0
        views, points = int(seen.any(1).sum()), int((seen.sum(0) > 1).sum())
        unknown = 6 * views + (0 if self.points_known else 3 * points - 7)
        measured = 2 * max(int(seen.sum()), 1)
        return min((measured / max(measured - unknown, 1e-9)) ** 0.5, REDUNDANCY_MOST)


@dataclass(frozen=True)
class State:
    """The unknowns of a scene."""

    rotation: Float[np.ndarray, "n 3 3"]
    """World to camera."""
    translation: Float[np.ndarray, "n 3"]
    """World to camera."""
    points: Float[np.ndarray, "j 3"]
    log_growth: float | Float[np.ndarray, "g"] = 0.0
    """Logarithm of the factor of the focal length; of each lens where there are several."""
    k1: float | Float[np.ndarray, "g"] = 0.0
    """First radial distortion coefficient, beyond what the pixels have been undistorted by; likewise."""

    @property
    def c2w(self) -> Float[np.ndarray, "n 3 4"]:
        """Camera poses."""
        return invert(make_pose(self.rotation, self.translation))

    @staticmethod
    def of(c2w: Float[np.ndarray, "n 3 4"], points: Float[np.ndarray, "j 3"]) -> "State":
        """State with the given poses and the intrinsics as the camera has them."""
        w2c = invert(c2w)
        return State(np.ascontiguousarray(w2c[..., :3]), np.ascontiguousarray(w2c[..., 3]), points)
