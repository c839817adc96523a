"""Points from the rays that see them."""

import numpy as np
from jaxtyping import Float

from kronc_ns.geometry.poses import unit


def triangulate(
    c2w: Float[np.ndarray, "n 3 4"], rays: Float[np.ndarray, "n j 3"], m: Float[np.ndarray, "n j"]
) -> Float[np.ndarray, "j 3"]:
    """Points nearest to all the rays (K^-1 (u, v, 1)) that see them; the cameras' mean centre where none does."""
    direction = unit(rays) @ c2w[..., :3].swapaxes(-1, -2)
    along = direction @ c2w[..., 3:]
    # sum of m (I - d d^T), and of the same times the centres; a trace of the identity where rays are parallel
    weighted = m[..., None] * direction
    outer = weighted.transpose(1, 2, 0) @ direction.swapaxes(0, 1)
    count = m.sum(0)
    trace = 1e-9 * count + 1e-12
    rhs = m.T @ c2w[..., 3] - (weighted * along).sum(0) + trace[:, None] * c2w[..., 3].mean(0)
    return np.linalg.solve((count + trace)[:, None, None] * np.eye(3) - outer, rhs[..., None])[..., 0]
