"""The cameras of a solution on their way from where they started to where they ended, in one frame."""

import math

import numpy as np
from jaxtyping import Float

from kronc_ns.geometry.alignment import umeyama
from kronc_ns.geometry.poses import make_pose, posed
from kronc_ns.geometry.rotations import so3_exp, so3_log
from kronc_ns.solution import Solution

_FRUSTUM = 0.08
"""Depth of a drawn camera as a share of the median distance of the cameras from their middle."""
CROWDED = 150
"""From so many cameras on they are drawn smaller."""


def aligned_start(solution: Solution) -> Float[np.ndarray, "n 3 4"]:
    """Initial poses, which have a frame of their own, moved onto the final ones where these tell how."""
    return _aligned(solution.initial_c2w, solution.c2w)


def aligned_path(solution: Solution) -> Float[np.ndarray, "s n 3 4"]:
    """Poses from the initial over the recorded to the final ones, each moved likewise.

    A view is where it ends as long as nothing is known of it.
    """
    recorded = [] if solution.path is None else list(solution.path)
    stages = np.stack([_aligned(c2w, solution.c2w) for c2w in (solution.initial_c2w, *recorded, solution.c2w)])
    return np.where(posed(stages)[..., None, None], stages, solution.c2w)


def on_path(path: Float[np.ndarray, "s n 3 4"], share: float) -> Float[np.ndarray, "n 3 4"]:
    """Poses a ``share`` of the way; between two stages on a straight line, turning about one axis."""
    last = min(int(share * (len(path) - 1)), len(path) - 2)
    return _between(path[last], path[last + 1], share * (len(path) - 1) - last)


def _aligned(c2w: Float[np.ndarray, "n 3 4"], final: Float[np.ndarray, "n 3 4"]) -> Float[np.ndarray, "n 3 4"]:
    both = posed(c2w) & posed(final)
    if int(both.sum()) < 3:
        return c2w
    return umeyama(c2w[both][..., 3], final[both][..., 3]).apply_to_poses(c2w)


def _between(
    before: Float[np.ndarray, "n 3 4"], after: Float[np.ndarray, "n 3 4"], share: float
) -> Float[np.ndarray, "n 3 4"]:
    turn = so3_log(before[..., :3].swapaxes(-1, -2) @ after[..., :3])
    rotation = before[..., :3] @ so3_exp(share * turn)
    centre = before[..., 3] + share * (after[..., 3] - before[..., 3])
    return make_pose(rotation, centre)


def frustum_depth(c2w: Float[np.ndarray, "n 3 4"]) -> float:
    """Depth at which cameras are drawn, so that they are legible and do not overlap."""
    centres = c2w[posed(c2w)][..., 3]
    if len(centres) < 2:
        return 0.3
    spread = float(np.median(np.linalg.norm(centres - centres.mean(0), axis=-1)))
    return _FRUSTUM * spread * min(1.0, math.sqrt(CROWDED / len(centres)))
