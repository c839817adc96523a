"""Poses for views that could not be solved: the walk between their neighbours, and what few keypoints they have."""

import math
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from kronc_ns.fit.walk import Interpolated, interpolate_walk
from kronc_ns.geometry.rotations import rotation_angle_deg
from kronc_ns.scene import Scene
from kronc_ns.solution import Solution, ViewStatus
from kronc_ns.solve.lm import LmConfig, adjust
from kronc_ns.solve.problem import OrbitPrior, Problem, State

_FEWEST = 2  # keypoints that correct where the walk says a view was aimed
_BELIEVED_SIGMAS = 3.0  # a correction larger than this is an outlier's
_NOISE_PX = 1.0  # least noise that is believed of so few detections


def complete(scene: Scene, solution: Solution) -> Solution:
    """The solution with the views that were not solved placed between their neighbours, where there is a walk."""
    known = torch.tensor([view.status is ViewStatus.SOLVED for view in solution.views])
    if not known.any():
        return solution
    # the walk goes around the z axis through the car
    middle = solution.points.nanmean(0)
    centred = solution.c2w.clone()
    centred[..., 3] -= middle
    walk = interpolate_walk(centred, known)
    if walk is None:
        return solution
    c2w = walk.c2w.clone()
    c2w[..., 3] += middle
    placed = ~known & c2w.isfinite().all(-1).all(-1)
    c2w = _aimed(scene, solution, replace(walk, c2w=c2w), placed)
    views = [
        replace(
            view,
            status=ViewStatus.COMPLETED,
            reason=f"placed between its neighbours: {view.reason}",
            sigma_rot_deg=float(walk.sigma_rot_deg[i]),
            sigma_trans_m=float(walk.sigma_trans_m[i]),
        )
        if placed[i]
        else view
        for i, view in enumerate(solution.views)
    ]
    return replace(solution, c2w=torch.where(placed[:, None, None], c2w, solution.c2w), views=tuple(views))


def _aimed(scene: Scene, solution: Solution, walk: Interpolated, placed: Bool[Tensor, "n"]) -> Float[Tensor, "n 3 4"]:
    """Poses of the walk, turned so that a placed view's few keypoints are met as well; its centre hardly moves."""
    m = scene.visibility * solution.points.isfinite().all(-1)
    some = placed & (m.sum(1) >= _FEWEST)
    if not some.any():
        return walk.c2w
    camera = solution.camera
    principal = torch.tensor([camera.cx, camera.cy], dtype=torch.float64)
    problem = Problem(
        (scene.uv[some] - principal).transpose(1, 2)[None].contiguous(),
        m[some][None],
        torch.tensor([[camera.fx, camera.fy]], dtype=torch.float64),
        orbit=OrbitPrior(walk.c2w[some][None, ..., 3], walk.sigma_trans_m[some][None] / math.sqrt(3)),
        points_known=True,
    )
    noise = torch.tensor([max(solution.rmse_px, _NOISE_PX)], dtype=torch.float64)
    start = State.of(walk.c2w[some][None], solution.points.nan_to_num(0.0)[None])
    found = adjust(problem, start, LmConfig(loss="huber"), most_sigma_px=noise).state.c2w[0]
    turned = rotation_angle_deg(found[..., :3].transpose(1, 2) @ walk.c2w[some][..., :3])
    believed = turned <= _BELIEVED_SIGMAS * walk.sigma_rot_deg[some]
    c2w = walk.c2w.clone()
    c2w[some] = torch.where(believed[:, None, None], found, c2w[some])
    return c2w
