"""Where the paper's solver starts: keypoint depths."""

import numpy as np
from jaxtyping import Float

from kronc_ns.geometry.poses import camera_z
from kronc_ns.geometry.triangulation import triangulate


def mean_distance(c2w: Float[np.ndarray, "n 3 4"]) -> float:
    """The paper's omega: mean L2 norm of the initial translations."""
    return float(np.linalg.norm(c2w[..., 3], axis=-1).mean())


def random_depths(
    c2w: Float[np.ndarray, "n 3 4"], keypoints: int, rng: np.random.Generator
) -> Float[np.ndarray, "n j"]:
    """z-depths uniform in [omega / 2, omega] (paper, section 5.1)."""
    return mean_distance(c2w) * (0.5 + 0.5 * rng.random((len(c2w), keypoints)))


def prior_depths(
    given: Float[np.ndarray, "n j"],
    c2w: Float[np.ndarray, "n 3 4"],
    rays: Float[np.ndarray, "n j 3"],
    m: Float[np.ndarray, "n j"],
    fallback: Float[np.ndarray, "n j"],
) -> Float[np.ndarray, "n j"]:
    """Depths from depth maps, scaled to the initial trajectory; ``fallback`` where they have none (NaN).

    The scale is the median ratio to the depths of the points that the initial poses triangulate: one for all views,
    since a depth map need not be metric, nor the trajectory.
    """
    initial = camera_z(c2w, triangulate(c2w, rays, m))
    known = np.isfinite(given)
    usable = known & (m > 0) & (initial > 0)
    scale = float(np.median(initial[usable] / given[usable])) if usable.any() else 1.0
    return np.where(known, given * scale, fallback)
