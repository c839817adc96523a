"""The best that data allow: the maximum-likelihood solution, started from the truth.

No solver to use (it is told the answer), but the yardstick for those that are not.
"""

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix

from kronc_ns.geometry.camera import project
from kronc_ns.geometry.poses import make_pose
from kronc_ns.geometry.rotations import so3_exp
from kronc_ns.scene import Scene

_OUTLIER_PX = 2.0  # residuals well above this count linearly (soft L1)


def maximum_likelihood(
    scene: Scene, c2w: Float[np.ndarray, "n 3 4"], points: Float[np.ndarray, "j 3"], robust: bool
) -> Float[np.ndarray, "n 3 4"]:
    """Poses that minimise the squared (``robust``: soft L1) reprojection error, from the true poses and points."""
    n, j = scene.seen.shape
    view, keypoint = np.nonzero(scene.seen & (scene.seen.sum(0) > 1))
    uv = scene.uv[view, keypoint]

    def unpack(flat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        step, moved = flat[: 6 * n].reshape(n, 6), flat[6 * n :].reshape(j, 3)
        return make_pose(c2w[..., :3] @ so3_exp(step[:, :3]), c2w[..., 3] + step[:, 3:]), points + moved

    def residuals(flat: np.ndarray) -> np.ndarray:
        poses, world = unpack(flat)
        in_camera = ((world[keypoint] - poses[view, :, 3])[:, None] @ poses[view, :, :3])[:, 0]
        return (project(in_camera, scene.camera) - uv).ravel()

    row = np.arange(2 * len(view)).reshape(-1, 2, 1)
    columns = np.concatenate([6 * view[:, None] + np.arange(6), 6 * n + 3 * keypoint[:, None] + np.arange(3)], axis=1)
    row, columns = (np.broadcast_to(x, (len(view), 2, 9)).ravel() for x in (row, columns[:, None]))
    pattern = csr_matrix((np.ones(len(row), dtype=np.int8), (row, columns)), shape=(2 * len(view), 6 * n + 3 * j))
    found = least_squares(
        residuals,
        np.zeros(6 * n + 3 * j),
        jac_sparsity=pattern,
        loss="soft_l1" if robust else "linear",
        f_scale=_OUTLIER_PX,
        x_scale="jac",
        max_nfev=20,
        tr_solver="lsmr",
    )
    return unpack(found.x)[0]
