"""What a solution is worth (being rewritten)."""
import math

import numpy as np

from kronc_ns.geometry.camera import reproject
from kronc_ns.geometry.poses import posed


def inliers(scene, solution):
    """Residuals in px [n, j] (NaN where there is none, inf behind a camera), and which are inliers [n, j]."""
    error = np.linalg.norm(reproject(solution.points, solution.c2w, solution.camera) - scene.uv, axis=-1)
    known = scene.seen & posed(solution.c2w)[:, None] & np.isfinite(solution.points).all(-1)
    error = np.where(known, error, math.nan)
    measured = error[np.isfinite(error)]
    diagonal = math.hypot(scene.camera.width, scene.camera.height)
    sigma = max(float(np.median(measured)) / 1.1774, 0.1) if len(measured) else math.inf
    return error, error <= min(5.0 * sigma, 0.03 * diagonal)
