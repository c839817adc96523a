"""Where the solver may start (being rewritten)."""
import math

import numpy as np
from jaxtyping import Float

from kronc_ns.fit.options import Direction
from kronc_ns.geometry.poses import look_at

MIN_POINTS = 4
"""A view with fewer keypoints cannot be placed by them alone (three points have up to four poses)."""


def circular_poses(
    views: int, radius_m: float = 4.0, direction: Direction = "ccw", laps: float = 1.0
) -> Float[np.ndarray, "n 3 4"]:
    """The paper's coarse trajectory (section 5.2): a level circle about the z axis, all cameras facing it, no tilt.

    View i stands at azimuth ``360 * laps * i / views`` degrees, counterclockwise seen from above by default.
    OpenCV c2w.
    """
    azimuth = np.arange(views) * (2 * math.pi * laps / views)
    if direction == "cw":
        azimuth = -azimuth
    centres = radius_m * np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(views)], axis=1)
    return look_at(centres, np.zeros_like(centres), np.array([0.0, 0.0, 1.0]))
