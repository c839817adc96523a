"""Where single views stand around known points, without any initial pose: all views, all hypotheses at once.

Directions all around (and camera rolls) are tried on the object-space error, which is quadratic in the rotation once
the translation is eliminated (Schweighofer and Pinz 2008; SQPnP, Terzakis and Lourakis 2020), so a hypothesis costs
81 products whatever the number of points. The best few of each view are refined by robust least squares; the winner
explains most detections by points that face the camera.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from kronc_ns.geometry.poses import invert, look_at, make_pose
from kronc_ns.geometry.rotations import so3_exp
from kronc_ns.solve.bundle import residuals
from kronc_ns.solve.lm import LmConfig, adjust
from kronc_ns.solve.problem import Problem, State

_AZIMUTHS = 24
_ELEVATIONS_DEG = (-5.0, 15.0, 35.0, 60.0)
_ROLLS_DEG = (0.0, 90.0, 180.0, 270.0)
_REFINED = 4
_SAMPLE, _SAMPLES = 4, 1000  # points OpenCV draws at a time, and how often
AWAY = -0.25
"""A point whose normal makes a larger angle with its ray (cosine below this) cannot be seen."""


@dataclass(frozen=True)
class Located:
    """Best pose of each view."""

    w2c: Float[Tensor, "m 3 4"]
    cost: Float[Tensor, "m"]
    """Mean robust cost of a detection, 0 (perfect) to 1 (behind the camera, on the far side, or far off)."""


def locate(
    points: Float[Tensor, "m j 3"],
    uv: Float[Tensor, "m 2 j"],
    weight: Float[Tensor, "m j"],
    focal: Float[Tensor, "m 2"],
    tolerance_px: Float[Tensor, "m"],
    normals: Float[Tensor, "j 3"] | None = None,
    exact: bool = False,
) -> Located:
    """Pose of each of M views of known points (z up for a sensible start; NaN where unknown).

    ``uv`` are pixels less the principal point. ``tolerance_px`` is what a good detection may be off, the points'
    own uncertainty included. At least four known points should be seen. Where the points are ``exact`` (solved, not
    guessed), consensus of small samples is tried, too: it stands more outliers.
    """
    weight = torch.where(points.isfinite().all(-1), weight, 0.0)
    points = points.nan_to_num(0.0)
    plane = uv / focal[..., None]
    w2c = _refined(_best_guesses(points, plane, weight), points, uv, weight, focal, None)
    if exact:
        sampled = _consensus(points, plane, weight, tolerance_px / focal[:, 0])
        w2c = torch.cat([w2c, sampled[:, None]], dim=1)
        w2c = _refined(w2c, points, uv, weight, focal, tolerance_px / 3)
    views, guesses = w2c.shape[:2]
    problem, state = _posed(w2c, points, uv, weight, focal)
    tolerance = tolerance_px.repeat_interleave(guesses)
    norm = residuals(problem, state).norm[:, 0]
    cost = unexplained(norm, problem.weight[:, 0], state.c2w[:, 0], state.points, tolerance, normals)
    cost = cost.view(views, guesses)
    best = cost.nan_to_num(math.inf).argmin(dim=1)
    return Located(w2c[torch.arange(views), best], cost[torch.arange(views), best])


def _refined(
    w2c: Float[Tensor, "m g 3 4"],
    points: Float[Tensor, "m j 3"],
    uv: Float[Tensor, "m 2 j"],
    weight: Float[Tensor, "m j"],
    focal: Float[Tensor, "m 2"],
    sigma_px: Float[Tensor, "m"] | None,
) -> Float[Tensor, "m g 3 4"]:
    """Every guess after robust least squares, with a known noise or else one that follows the residuals down."""
    views, guesses = w2c.shape[:2]
    problem, start = _posed(w2c, points, uv, weight, focal)
    most = None if sigma_px is None else sigma_px.repeat_interleave(guesses, dim=0)
    found = adjust(problem, start, LmConfig(iterations=15, tolerance=1e-3), most_sigma_px=most).state
    return make_pose(found.rotation, found.translation)[:, 0].view(views, guesses, 3, 4)


def _posed(
    w2c: Float[Tensor, "m g 3 4"],
    points: Float[Tensor, "m j 3"],
    uv: Float[Tensor, "m 2 j"],
    weight: Float[Tensor, "m j"],
    focal: Float[Tensor, "m 2"],
) -> tuple[Problem, State]:
    """Every guess of every view as a scene of its own."""

    def each(x: Tensor) -> Tensor:
        return x.repeat_interleave(w2c.shape[1], dim=0)

    problem = Problem(each(uv)[:, None], each(weight)[:, None], each(focal), points_known=True)
    return problem, State.of(invert(w2c.flatten(0, 1))[:, None], each(points))


def unexplained(
    error_px: Float[Tensor, "m j"],
    weight: Float[Tensor, "m j"],
    c2w: Float[Tensor, "m 3 4"],
    points: Float[Tensor, "m j 3"],
    tolerance_px: Float[Tensor, "m"],
    normals: Float[Tensor, "j 3"] | None = None,
) -> Float[Tensor, "m"]:
    """Weighted mean over the detections of what a pose leaves unexplained: 0 where met, 1 where far off or away."""
    off = 1 - 1 / (1 + (error_px / tolerance_px[:, None]).square())
    if normals is not None:
        ray = torch.nn.functional.normalize(c2w[:, None, :, 3] - points, dim=-1)
        off = torch.where((ray * normals).sum(-1) < AWAY, 1.0, off)
    return (torch.where(weight > 0, off, 0.0) * weight).sum(-1) / weight.sum(-1).clamp_min(1e-9)


def _consensus(
    points: Float[Tensor, "m j 3"],
    plane: Float[Tensor, "m 2 j"],
    weight: Float[Tensor, "m j"],
    tolerance: Float[Tensor, "m"],
) -> Float[Tensor, "m 3 4"]:
    """Pose (w2c) of each view by OpenCV's RANSAC over three-point poses; the identity, far off, where it finds none.

    For the few views that nothing else could place: OpenCV takes one view at a time.
    """
    found = torch.eye(3, 4, dtype=points.dtype).repeat(len(points), 1, 1)
    cv2.setRNGSeed(0)
    for i, seen in enumerate((weight > 0).cpu()):
        if int(seen.sum()) < _SAMPLE:
            continue
        ok, turn, shift, _ = cv2.solvePnPRansac(
            points[i, seen].cpu().numpy(),
            plane[i, :, seen].T.contiguous().cpu().numpy(),
            np.eye(3),
            np.zeros(4),
            iterationsCount=_SAMPLES,
            reprojectionError=float(tolerance[i]),
            flags=cv2.SOLVEPNP_AP3P,
        )
        if ok:
            found[i] = torch.from_numpy(np.hstack([cv2.Rodrigues(turn)[0], shift]))
    return found.to(points)


@lru_cache(maxsize=4)
def _directions() -> Float[Tensor, "h 3 3"]:
    """World-to-camera rotations of cameras all around that face the z axis, for each roll."""
    azimuth = torch.arange(_AZIMUTHS, dtype=torch.float64) * (2 * math.pi / _AZIMUTHS)
    elevation = torch.tensor(_ELEVATIONS_DEG, dtype=torch.float64).deg2rad()
    azimuth, elevation = (x.flatten() for x in torch.meshgrid(azimuth, elevation, indexing="ij"))
    centre = torch.stack([elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin()], dim=1)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    upright = look_at(centre, torch.zeros_like(centre), up)[..., :3].transpose(-1, -2)
    roll = torch.zeros(len(_ROLLS_DEG), 3, dtype=torch.float64)
    roll[:, 2] = torch.tensor(_ROLLS_DEG, dtype=torch.float64).deg2rad()
    return (so3_exp(roll)[:, None] @ upright).flatten(0, 1)


def _best_guesses(
    points: Float[Tensor, "m j 3"], plane: Float[Tensor, "m 2 j"], weight: Float[Tensor, "m j"]
) -> Float[Tensor, "m g 3 4"]:
    """The most promising poses (w2c) of each view by object-space error over distance, no two of them neighbours."""
    ray = torch.nn.functional.normalize(torch.cat([plane, torch.ones_like(plane[:, :1])], dim=1), dim=1)
    identity = torch.eye(3, dtype=points.dtype, device=points.device)
    across = (identity[:, :, None] - ray[:, :, None] * ray[:, None]) * weight[:, None, None]  # [m, 3, 3, j]
    mean = (points * weight[..., None]).sum(1, keepdim=True) / weight.sum(1).clamp_min(1e-9)[:, None, None]
    centred = points - mean
    # sum of across (R X + t), with vec(R) row by row: t = -pull vec(R)
    mixed = torch.einsum("mabj,mjc->mabc", across, centred).flatten(2)
    pull = torch.linalg.solve(across.sum(-1) + 1e-9 * identity, mixed)
    square = torch.einsum("mabj,mjc,mjd->macbd", across, centred, centred).reshape(-1, 9, 9)
    square = square - mixed.transpose(1, 2) @ pull
    directions = _directions().to(points)
    flat = directions.flatten(1)
    error = torch.einsum("hp,mpq,hq->mh", flat, square, flat)
    translation = -torch.einsum("mip,hp->mhi", pull, flat)
    depth = translation[..., 2]
    error = torch.where(depth > 0, error / depth.square(), math.inf)
    grid = error.view(len(points), len(_ROLLS_DEG), _AZIMUTHS, len(_ELEVATIONS_DEG))
    lowest = grid <= torch.minimum(grid.roll(1, dims=2), grid.roll(-1, dims=2))
    error = torch.where(lowest.flatten(1), error, math.inf)  # minima over the azimuth
    best = error.topk(_REFINED, dim=1, largest=False).indices
    rotation = directions[best]
    translation = torch.take_along_dim(translation, best[..., None], dim=1)
    return make_pose(rotation, translation - (rotation @ mean[:, None, 0, :, None])[..., 0])
