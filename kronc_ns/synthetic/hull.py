"""Which points of a body are seen from where, when the points are all that is known of the body."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull

from kronc_ns.geometry.poses import unit

_NEAR_M = 0.02  # facets this much further from a point than its nearest facet count as its skin, too
_GRAZING = 0.2  # cosine; on the procedural car this comes closest to ray casting (27.3 and 27.0 points a view)


def hull_visibility(
    points: Float[np.ndarray, "j 3"], centres: Float[np.ndarray, "n 3"], grazing: float = _GRAZING
) -> Bool[np.ndarray, "n j"]:
    """Whether each camera centre sees each point of a body that is taken for its points' convex hull (metres).

    A point is seen where one of the hull facets nearest to it faces the camera: the cosine between the facet's
    outward normal and the direction to the camera exceeds ``grazing``.
    """
    facets = ConvexHull(points).equations
    depth = -(points @ facets[:, :3].T + facets[:, 3])  # [J, F], >= 0: distance to each facet's plane from within
    skin = depth <= depth.min(1, keepdims=True) + _NEAR_M
    to_camera = unit(centres[:, None] - points)
    return ((to_camera @ facets[:, :3].T > grazing) & skin).any(-1)
