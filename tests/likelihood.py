"""The best that data allow: the maximum-likelihood solution, started from the truth.

No solver to use (it is told the answer), but the yardstick for those that are not.
"""

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix
from torch import Tensor

from kronc_ns.geometry.camera import project
from kronc_ns.geometry.rotations import so3_exp
from kronc_ns.scene import Scene

_OUTLIER_PX = 2.0  # residuals well above this count linearly (soft L1)


def maximum_likelihood(
    scene: Scene, c2w: Float[Tensor, "n 3 4"], points: Float[Tensor, "j 3"], robust: bool
) -> Float[Tensor, "n 3 4"]:
    """Poses that minimise the squared (``robust``: soft L1) reprojection error, from the true poses and points."""
    n, j = scene.visibility.shape
    view, keypoint = torch.nonzero((scene.visibility > 0) & (scene.visibility.sum(0) > 1), as_tuple=True)
    uv = scene.uv[view, keypoint]

    def unpack(flat: np.ndarray) -> tuple[Tensor, Tensor, Tensor]:
        x = torch.from_numpy(flat)
        step, moved = x[: 6 * n].view(n, 6), x[6 * n :].view(j, 3)
        return c2w[..., :3] @ so3_exp(step[:, :3]), c2w[..., 3] + step[:, 3:], points + moved

    def residuals(flat: np.ndarray) -> np.ndarray:
        rotation, centre, world = unpack(flat)
        in_camera = ((world[keypoint] - centre[view])[:, None] @ rotation[view])[:, 0]
        return (project(in_camera, scene.camera) - uv).flatten().numpy()

    row = np.arange(2 * len(view)).reshape(-1, 2, 1)
    columns = np.concatenate(
        [6 * view.numpy()[:, None] + np.arange(6), 6 * n + 3 * keypoint.numpy()[:, None] + np.arange(3)], axis=1
    )[:, None]
    row, columns = (np.broadcast_to(x, (len(view), 2, 9)).ravel() for x in (row, columns))
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
    rotation, centre, _ = unpack(found.x)
    return torch.cat([rotation, centre[..., None]], dim=-1)
