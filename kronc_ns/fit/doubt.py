"""Whether a view could as well stand elsewhere: the best other pose, and how much worse it is."""

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from kronc_ns.fit.attempts import Attempt
from kronc_ns.fit.starts import MIN_POINTS, single_views
from kronc_ns.geometry.poses import invert
from kronc_ns.solve.resection import Views, runner_up, unexplained

_PLENTY, _PLENTY_SHARE = 14, 0.6
"""Inliers, and their share, that no other pose could have by chance."""
_APART_DEG = 10.0
"""A pose that is turned less is the same."""


def plenty(inliers: Int[np.ndarray, "n"], seen: Int[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    """Views of which so many detections agree that no other pose need be thought of."""
    return (inliers >= _PLENTY) & (inliers >= _PLENTY_SHARE * seen)


def lead(attempt: Attempt) -> Float[np.ndarray, "n"]:
    """How many more of its detections a view's pose meets than the best other one does, left and right exchanged too.

    Infinite for views with so many that agree that there is no need to ask.
    """
    found = attempt.found
    scene, inliers = found.scene, attempt.met
    asked = found.used & (inliers >= MIN_POINTS) & ~plenty(inliers, scene.visible)
    ahead = np.full(len(scene), math.inf)
    if not asked.any():
        return ahead
    supported = attempt.inlier.sum(0)
    # a prior tells where points are that no view sees
    points = np.where((supported > 0)[:, None] | (attempt.problem.shape is not None), found.points, math.nan)
    views, mirrored = (
        single_views(of, points, asked, attempt.noise.sigma_px) for of in (scene, scene.with_sides_swapped(asked))
    )
    # points that one other view sees at most lie where this view sees them, wherever it stands
    own = attempt.inlier & (supported <= 2)
    views = replace(views, weight=np.where(own[asked], 0.0, views.weight))
    w2c = invert(found.c2w[asked])
    others = np.maximum(
        _met(views, runner_up(views, w2c, _APART_DEG)),
        _met(mirrored, runner_up(mirrored, w2c, -1.0)),
    )
    ahead[asked] = _met(views, unexplained(views, w2c)) - others
    return ahead


def _met(views: Views, cost: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
    """How many detections a pose of this cost meets; those of unknown points are not met."""
    known = np.isfinite(views.points).all(-1)[views.label]
    return (1 - np.minimum(cost, 1.0)) * (views.weight * known).sum(1)
