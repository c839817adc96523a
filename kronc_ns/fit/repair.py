"""Views that went wrong: found, located anew (also with left and right exchanged), and solved again with the others."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from kronc_ns.fit.attempts import Attempt, adjust_starts
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.starts import LOST, TOLERANCE_SIGMAS, Start, far_side, in_front, locate_views, mirrored, usable_views
from kronc_ns.keypoints.template import car_template
from kronc_ns.solve import objective
from kronc_ns.solve.resection import unexplained

_ODD_SHARE = 0.3  # share of a view's detections on the far side of the car that makes the view suspect
_REPAIRS = 3
_HOPELESS = 0.02  # of the image diagonal: with such noise the points are no points to locate a view against


def repair(attempts: Sequence[Attempt], config: KroncConfig) -> list[Attempt]:
    """Find views that disagree or look through the car, locate them anew (also left-right swapped), solve again."""
    attempts = list(attempts)
    suspects: list[Bool[Tensor, "n"]] = [torch.empty(0, dtype=torch.bool)] * len(attempts)
    active = list(range(len(attempts)))
    for _ in range(_REPAIRS):
        changed: list[int] = []
        for i in active:
            suspect = _suspects(attempts[i])
            if suspect.any() and not torch.equal(suspect, suspects[i]):
                suspects[i] = suspect
                attempts[i] = replace(attempts[i], start=_relocated(attempts[i], suspect))
                changed.append(i)
        if not changed:
            break
        solved = adjust_starts([attempts[i].start for i in changed], config)
        for i, attempt in zip(changed, solved, strict=True):
            attempts[i] = replace(
                attempt,
                initial_c2w=attempts[i].initial_c2w,
                iterations=attempts[i].iterations + attempt.iterations,
                history=attempts[i].history,
                path=attempts[i].path,
            )
        active = changed
    return attempts


def _suspects(attempt: Attempt) -> Bool[Tensor, "n"]:
    start, camera = attempt.start, attempt.start.scene.camera
    seen = start.scene.visibility > 0
    if attempt.sigma_px > _HOPELESS * math.hypot(camera.width, camera.height):
        return torch.zeros(len(seen), dtype=torch.bool)
    away = (far_side(start) & seen).sum(1) > _ODD_SHARE * seen.sum(1)
    few = 2 * attempt.inlier.sum(1) < seen.sum(1)
    return usable_views(start.scene) & (~attempt.agreeing | few | away)


def _relocated(attempt: Attempt, suspect: Bool[Tensor, "n"]) -> Start:
    """The start with suspect views where they fit the solved points best, or left out."""
    start = attempt.start
    scene = start.scene
    trusted = (attempt.inlier & ~suspect[:, None]).sum(0) >= 2
    points = torch.where(trusted[:, None], start.points, math.nan)
    c2w, cost, swapped = locate_views(scene, points, suspect, attempt.sigma_px)
    better = suspect & (cost < _present_cost(start, points, attempt.sigma_px))
    swapped &= better
    keypoints = torch.where(swapped[:, None, None], mirrored(scene.keypoints, scene.schema), scene.keypoints)
    return replace(
        start,
        scene=replace(scene, keypoints=keypoints),
        c2w=torch.where(better[:, None, None], c2w, start.c2w),
        used=torch.where(better, cost < LOST, start.used & (attempt.agreeing | ~suspect)),
        swapped=start.swapped ^ swapped,
    )


def _present_cost(start: Start, points: Float[Tensor, "j 3"], sigma_px: float) -> Float[Tensor, "n"]:
    """Cost of every view where it is, as `locate` reckons it; inf where it has no pose."""
    scene, template = start.scene, car_template(start.scene.schema)
    error = (objective.reproject(points, start.c2w, scene.camera) - scene.uv).norm(dim=-1)
    cost = unexplained(
        torch.where(in_front(start), error, math.inf),
        torch.where(points.isfinite().all(-1), scene.visibility, 0.0),
        start.c2w,
        points.expand(len(scene), -1, -1),
        torch.full((len(scene),), TOLERANCE_SIGMAS * sigma_px, dtype=torch.float64),
        None if template is None else template.normals,
    )
    return torch.where(start.used, cost.nan_to_num(math.inf), math.inf)
