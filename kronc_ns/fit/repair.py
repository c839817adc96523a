"""Views that went wrong: found, located anew (also with left and right exchanged), and solved again with the others."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from kronc_ns.fit.attempts import Attempt, adjust_starts
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.starts import LOST, SWAP_GAIN, Hypothesis, locate_views, single_views, usable_views
from kronc_ns.geometry.poses import invert
from kronc_ns.solve.resection import locate, unexplained

_ODD_SHARE = 0.3  # share of a view's detections on the far side of the car that makes the view suspect
_REPAIRS = 3
_PLENTY, _PLENTY_SHARE = 8, 0.7  # inliers, and their share, with which a view that fits is not asked again
_CLEAR_GAIN = 0.5  # detections that another pose must meet more
_HOPELESS = 0.02  # of the image diagonal: with such noise the points are no points to locate a view against


def repair(attempts: Sequence[Attempt], config: KroncConfig) -> list[Attempt]:
    """Find views that disagree or look through the car, locate them anew (also left-right swapped), solve again.

    Nothing is solved again that would only end where it is.
    """
    attempts = list(attempts)
    asked: list[Bool[np.ndarray, "n"] | None] = [None] * len(attempts)
    active = list(range(len(attempts)))
    for _ in range(_REPAIRS):
        changed: dict[int, Hypothesis] = {}
        for i in active:
            suspect, doubtful = _suspects(attempts[i])
            before = asked[i]
            wanted = suspect | doubtful
            if not wanted.any() or (before is not None and np.array_equal(wanted, before)):
                continue
            asked[i] = wanted
            mended = _relocated(attempts[i], suspect, doubtful & ~suspect)
            if mended is not None:
                changed[i] = mended
        if not changed:
            break
        for i, again in zip(changed, adjust_starts(list(changed.values()), config), strict=True):
            first = attempts[i]
            attempts[i] = replace(
                again,
                start=first.start,
                iterations=first.iterations + again.iterations,
                history=first.history,
                path=first.path,
            )
        active = list(changed)
    return attempts


def _suspects(attempt: Attempt) -> tuple[Bool[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Views that went wrong, and views that may have."""
    found, camera = attempt.found, attempt.found.scene.camera
    seen = found.scene.seen
    if attempt.sigma_px > _HOPELESS * math.hypot(camera.width, camera.height):
        none = np.zeros(len(seen), dtype=bool)
        return none, none
    return usable_views(found.scene) & (_misfits(attempt) | _looks_through(attempt)), _doubtful(attempt)


def _doubtful(attempt: Attempt) -> Bool[np.ndarray, "n"]:
    """Views that fit with so few detections, or so few of them, that another pose may fit better."""
    scene, inliers = attempt.found.scene, attempt.met
    few = (inliers < _PLENTY) | (inliers < _PLENTY_SHARE * scene.visible)
    return usable_views(scene) & attempt.found.used & few


def _misfits(attempt: Attempt) -> Bool[np.ndarray, "n"]:
    """Views that the noise does not explain."""
    few = 2 * attempt.met < attempt.found.scene.visible
    return ~attempt.agreeing | few


def _looks_through(attempt: Attempt) -> Bool[np.ndarray, "n"]:
    """Views that see too much of the car's far side: confused sides, or a car of another shape than the template."""
    scene = attempt.found.scene
    return (attempt.found.far_side & scene.seen).sum(1) > _ODD_SHARE * scene.visible


def _relocated(attempt: Attempt, suspect: Bool[np.ndarray, "n"], doubtful: Bool[np.ndarray, "n"]) -> Hypothesis | None:
    """The cameras with suspect views where they fit the solved points best, or left out; None if nothing changes.

    A view that fits is only asked whether it fits better with its sides exchanged; a doubtful one moves where it meets
    more of its detections.
    """
    found = attempt.found
    scene, sigma = found.scene, attempt.sigma_px
    trusted = (attempt.inlier & ~suspect[:, None]).sum(0) >= 2
    points = np.where(trusted[:, None], found.points, math.nan)
    present = np.full(len(scene), math.inf)
    posed = (suspect | doubtful) & found.used
    if posed.any():
        present[posed] = unexplained(single_views(scene, points, posed, sigma), invert(found.c2w[posed]))
    misfit = _misfits(attempt)
    c2w, cost, swapped = locate_views(scene, points, suspect & misfit | doubtful, sigma)
    mirror = scene.with_sides_swapped(np.ones_like(suspect))
    fitting = suspect & ~misfit
    if fitting.any():
        exchanged = locate(single_views(mirror, points, fitting, sigma))
        c2w[fitting], swapped[fitting] = invert(exchanged.w2c), True
        cost[fitting] = np.where(exchanged.cost < SWAP_GAIN * present[fitting], exchanged.cost, math.inf)
    gain = np.where(doubtful, _CLEAR_GAIN / np.maximum(scene.visible, 1), 0.0)
    better = (suspect | doubtful) & (cost < present - gain)
    used = np.where(better, cost < LOST, found.used & (attempt.agreeing | ~suspect))
    if not better.any() and np.array_equal(used, found.used):
        return None
    swapped &= better
    return replace(
        found,
        scene=scene.with_sides_swapped(swapped),
        c2w=np.where(better[:, None, None], c2w, found.c2w),
        used=used,
        swapped=found.swapped ^ swapped,
    )
