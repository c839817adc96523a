"""Poses for views that could not be solved: the walk between their neighbours, and what few keypoints they have."""

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from kronc_ns.fit.verdict import Evidence, Verdict, known
from kronc_ns.fit.walk import Interpolated, interpolate_walk
from kronc_ns.geometry.poses import posed
from kronc_ns.geometry.rotations import rotation_angle_deg
from kronc_ns.scene import Scene
from kronc_ns.solution import ViewReport, ViewStatus
from kronc_ns.solve.lm import adjust
from kronc_ns.solve.options import LmConfig
from kronc_ns.solve.problem import OrbitPrior, Problem, State

_FEWEST = 2  # keypoints that correct where the walk says a view was aimed
_BELIEVED_SIGMAS = 3.0  # a correction larger than this is an outlier's
_NOISE_PX = 1.0  # least noise that is believed of so few detections


def complete(
    scene: Scene, evidence: Evidence, verdict: Verdict
) -> tuple[Float[np.ndarray, "n 3 4"], tuple[ViewReport, ...]]:
    """Poses and reports with the views that were not solved placed as well as can be.

    Views that agree with the others but are vaguely known keep their own pose where the walk between their neighbours
    does not tell it better.
    """
    solved, vague = verdict.solved, verdict.vague
    if solved.all():
        return evidence.c2w, verdict.views
    c2w = np.where((solved | vague)[:, None, None], evidence.c2w, math.nan)
    sigma_rot, sigma_trans = (np.where(vague, of, math.nan) for of in (evidence.sigma_rot_deg, evidence.sigma_trans_m))
    walk = _walk(evidence, solved)
    between = np.zeros_like(solved)
    if walk is not None:
        surer = ~vague | ~(evidence.sigma_rot_deg <= walk.sigma_rot_deg)
        between = ~solved & posed(walk.c2w) & surer
        aimed = _aimed(scene, evidence, verdict, walk, between)
        c2w = np.where(between[:, None, None], aimed, c2w)
        sigma_rot, sigma_trans = (
            np.where(between, of, own)
            for of, own in ((walk.sigma_rot_deg, sigma_rot), (walk.sigma_trans_m, sigma_trans))
        )
    views = tuple(
        replace(
            view,
            status=ViewStatus.COMPLETED,
            reason=f"placed between its neighbours: {view.reason}" if between[i] else view.reason,
            sigma_rot_deg=known(sigma_rot[i]),
            sigma_trans_m=known(sigma_trans[i]),
        )
        if between[i] or vague[i]
        else view
        for i, view in enumerate(verdict.views)
    )
    return c2w, views


def _walk(evidence: Evidence, solved: Bool[np.ndarray, "n"]) -> Interpolated | None:
    """The walk of the solved views around the z axis through the car."""
    if not solved.any():
        return None
    points = np.isfinite(evidence.points).all(-1)
    middle = evidence.points[points].mean(0) if points.any() else np.zeros(3)
    c2w = np.where(solved[:, None, None], evidence.c2w, math.nan)
    walk = interpolate_walk(_shifted(c2w, -middle), solved)
    return None if walk is None else replace(walk, c2w=_shifted(walk.c2w, middle))


def _shifted(c2w: Float[np.ndarray, "n 3 4"], by: Float[np.ndarray, "3"]) -> Float[np.ndarray, "n 3 4"]:
    return np.concatenate([c2w[..., :3], (c2w[..., 3] + by)[..., None]], axis=-1)


def _aimed(
    scene: Scene, evidence: Evidence, verdict: Verdict, walk: Interpolated, placed: Bool[np.ndarray, "n"]
) -> Float[np.ndarray, "n 3 4"]:
    """Poses of the walk, turned so that a placed view's few keypoints are met as well; its centre hardly moves."""
    m = scene.visibility * np.isfinite(evidence.points).all(-1)
    some = placed & (m.sum(1) >= _FEWEST)
    if not some.any():
        return walk.c2w
    camera = evidence.camera
    problem = Problem(
        scene.uv[some] - (camera.cx, camera.cy),
        m[some],
        (camera.fx, camera.fy),
        orbit=OrbitPrior(walk.c2w[some][..., 3], walk.sigma_trans_m[some] / math.sqrt(3)),
        points_known=True,
    )
    start = State.of(walk.c2w[some], np.where(np.isfinite(evidence.points), evidence.points, 0.0))
    found = adjust(problem, start, LmConfig(loss="huber"), sigma_px=max(verdict.rmse_px, _NOISE_PX)).state.c2w
    turned = rotation_angle_deg(found[..., :3].swapaxes(1, 2) @ walk.c2w[some][..., :3])
    believed = turned <= _BELIEVED_SIGMAS * walk.sigma_rot_deg[some]
    c2w = walk.c2w.copy()
    c2w[some] = np.where(believed[:, None, None], found, c2w[some])
    return c2w
