"""Given poses handed on as they are: for methods that find poses themselves, from wherever they begin."""

import math

import numpy as np
from jaxtyping import Float

from kronc_ns.geometry.camera import lengths, rays, reproject
from kronc_ns.geometry.poses import camera_z
from kronc_ns.geometry.triangulation import triangulate
from kronc_ns.scene import Scene
from kronc_ns.solution import Solution, Status, ViewReport, ViewStatus

_AWAY = 3.0  # of the median distance from their middle: points beyond are no part of the object


def unsolved(scene: Scene) -> Solution:
    """The given poses and, where their rays nearly meet, the keypoints, which say where the object is and how large.

    Never converged: nothing was solved.
    """
    c2w = scene.given_c2w
    assert c2w is not None
    points = _meeting_points(scene, c2w)
    error = lengths(reproject(points, c2w, scene.camera) - scene.uv)
    known = scene.seen & np.isfinite(error)
    visible = scene.visible.tolist()
    return Solution(
        status=Status.WEAK,
        reason="poses are as they were given, nothing was solved (solver none)",
        names=scene.names,
        camera=scene.camera,
        c2w=c2w,
        points=points,
        depths=np.where(scene.seen, camera_z(c2w, points), math.nan),
        views=tuple(
            ViewReport(name, ViewStatus.COMPLETED, count, 0, None, reason="as given")
            for name, count in zip(scene.names, visible, strict=True)
        ),
        initial_c2w=c2w,
        solver="none",
        init="given",
        iterations=0,
        seconds=0.0,
        rmse_px=math.nan,
        median_px=float(np.median(error[known])) if known.any() else math.nan,
        lenses=scene.lenses,
    )


def _meeting_points(scene: Scene, c2w: Float[np.ndarray, "n 3 4"]) -> Float[np.ndarray, "j 3"]:
    """Points nearest to the rays of two views or more; NaN where those do not meet about where the others do."""
    points = triangulate(c2w, rays(scene.uv, scene.camera), scene.visibility)
    points = np.where((scene.seen.sum(0) >= 2)[:, None], points, math.nan)
    known = np.isfinite(points).all(-1)
    if known.any():
        distance = np.linalg.norm(points - np.median(points[known], axis=0), axis=-1)
        points = np.where((distance <= _AWAY * np.median(distance[known]))[:, None], points, math.nan)
    return points
