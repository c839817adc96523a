"""Views that features place elsewhere than keypoints did: a view's features against all points, its pose unknown.

Guided matching only finds what lies near the lines of the poses it starts from. A view whose keypoints were taken for
their mirror images, or none were found, is found here or not at all.
"""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from kronc_ns.refine.adjustment import Adjusted
from kronc_ns.refine.gathering import Gathered
from kronc_ns.refine.pairs import view_angles
from kronc_ns.refine.rig import Rig
from kronc_ns.refine.tracks import Tracks, loose_views, view_medians, without, without_views
from kronc_ns.refine.triangulation import place

_LOOSE = 0.5  # of the usual sightings of a view: with fewer it may lie elsewhere
_ACROSS_DEG, _RUN = 90.0, 0.25  # of views on the other side of the car than those before and after ...
_IN_ORDER_DEG = 45.0  # ... if photos are mostly as near as this to the next
_RATIO, _SIMILAR = 0.8, 0.8  # of descriptors, as in guided matching but stricter
_ASTRAY = 0.02  # of the focal length: median error of a view that no adjustment brought right
_LEAST_OTHERS = 2  # views that a point must be seen in besides
_TRIALS, _CONFIDENCE, _AGREES_PX = 3000, 0.9999, 4.0  # of RANSAC
_CLOSER_PX = (4.0, 4.0, 2.0, 2.0)  # of matches that the pose is then fitted to, in turns
_LEAST_AGREEING, _GAIN, _MORE = 15, 1.5, 5  # matches that the new pose explains: in all; over those of the old


def relocated(adjusted: Adjusted, gathered: Gathered, used: Bool[np.ndarray, "f"]) -> Rig:
    """The cameras, those with few features, and those across the car, where more features agree; others as they were.

    ``used`` are the features that may be matched.
    """
    rig, view_of = adjusted.rig, adjusted.gathered.view
    count = len(rig.rotation)
    rotation, translation = rig.rotation.copy(), rig.translation.copy()
    run = across(view_angles(rig.cameras.centre, np.nanmean(rig.keypoints, axis=0)))
    for view in np.flatnonzero(loose_views(adjusted.tracks, view_of, count, _LOOSE) | (run > 0)).tolist():
        believed, own = adjusted, np.arange(count) == view
        if run[view]:  # they confirm each other, and what else they seem to see is chance
            own = run == run[view]
            believed = replace(adjusted, tracks=without(adjusted.tracks, own[view_of]))
        points, uv = _matched(believed, gathered, gathered, used, view, rig, own)
        found = _pose(points, uv, rig.focal)
        if found is None:
            continue
        before = _agreeing(points, uv, (rig.rotation[view], rig.translation[view]), rig.focal)
        if _agreeing(points, uv, found, rig.focal) > _GAIN * before + _MORE:
            rotation[view], translation[view] = found
    return replace(rig, rotation=rotation, translation=translation)


def seated(adjusted: Adjusted, tracks: Tracks, astray: Bool[np.ndarray, "n"]) -> tuple[Rig, Bool[np.ndarray, "n"]]:
    """The cameras, those that are ``astray`` or that no adjustment brought right where they see the points of all
    others; and which of them see these, there or where they were.

    By ``tracks`` that owe nothing to the poses, those of these views among them.
    """
    rig, gathered = adjusted.rig, adjusted.gathered
    count, uv = len(rig.rotation), rig.ideal(gathered.pixel, gathered.view)
    error = place(adjusted.tracks, uv, gathered.view, rig.cameras, _AGREES_PX)[1]
    medians = view_medians(adjusted.tracks, error, gathered.view, count)
    asked = astray | (medians > _ASTRAY * rig.focal)
    others = ~asked[gathered.view[tracks.feature]]
    known = tracks.chosen(np.bincount(tracks.of_track[others], minlength=len(tracks)) >= _LEAST_OTHERS)
    believed = without_views(known, gathered.view, asked)
    points = place(believed, uv, gathered.view, rig.cameras, _AGREES_PX)[0].points
    rotation, translation, found = rig.rotation.copy(), rig.translation.copy(), np.zeros(count, bool)
    for view in np.flatnonzero(asked).tolist():
        own = gathered.view[known.feature] == view
        seen, at = points[known.of_track[own]], uv[known.feature[own]]
        agree = _agreeing(seen, at, (rig.rotation[view], rig.translation[view]), rig.focal)
        pose = _pose(seen, at, rig.focal)
        if pose is not None and _agreeing(seen, at, pose, rig.focal) > _GAIN * agree + _MORE:
            rotation[view], translation[view] = pose
            found[view] = True
        found[view] |= agree >= _LEAST_AGREEING
    return replace(rig, rotation=rotation, translation=translation), found


def across(angles: Float[np.ndarray, "n n"]) -> Int[np.ndarray, "n"]:
    """Runs of views, numbered from 1 on (0: of none), that are seen from across the car while those before and after
    them in the order of the photos are not: front and rear, taken for each other. Where the walk is a lap the first
    photo follows the last; where it is not, these are not near each other, and neither is of a run. Photos in no order
    have none.

    ``angles`` are degrees between the directions from which views see the car.
    """
    count = len(angles)
    run, first = np.zeros(count, np.int64), np.arange(count)
    if np.median(angles[first[:-1], first[1:]]) > _IN_ORDER_DEG:
        return run
    for length in range(1, int(_RUN * count) + 1):
        before, after = first - 1, (first + length) % count
        inside = (first[:, None] + np.arange(length)) % count
        far = np.minimum(angles[before[:, None], inside], angles[after[:, None], inside]) > _ACROSS_DEG
        for own in inside[(angles[before, after] < _ACROSS_DEG) & far.all(1)]:
            if not run[own].any():
                run[own] = run.max() + 1
    return run


def placed(adjusted: Adjusted, gathered: Gathered, absent: Gathered, used: Bool[np.ndarray, "f"], rig: Rig) -> Rig:
    """``rig``, of views that took no part and have the features ``absent``, with poses; NaN where these tell none."""
    rotation, translation = np.full_like(rig.rotation, np.nan), np.full_like(rig.translation, np.nan)
    nobody = np.zeros(len(adjusted.rig.rotation), bool)
    for view in range(len(rotation)):
        found = _pose(*_matched(adjusted, gathered, absent, used, view, rig, nobody), rig.focal)
        if found is not None:
            rotation[view], translation[view] = found
    return replace(rig, rotation=rotation, translation=translation)


def _matched(
    adjusted: Adjusted,
    gathered: Gathered,
    seen: Gathered,
    may: Bool[np.ndarray, "f"],
    view: int,
    rig: Rig,
    own_views: Bool[np.ndarray, "n"],
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 2"]]:
    """Points that look like features that a view of ``seen`` may use, and where it has them in ideal pixels of ``rig``.

    What ``own_views`` of the adjustment see does not count.
    """
    tracks = adjusted.tracks
    elsewhere = ~own_views[adjusted.gathered.view[tracks.feature]]
    believed = np.bincount(tracks.of_track[elsewhere], minlength=len(tracks)) >= _LEAST_OTHERS
    used = elsewhere & (tracks.feature < gathered.sift) & believed[tracks.of_track]
    own = np.arange(seen.first[view], seen.first[view + 1])
    own = own[may[own]]
    point = tracks.of_track[used]
    if not len(own) or not len(point):
        return np.empty((0, 3)), np.empty((0, 2))
    point, begin = np.unique(point, return_index=True)  # sightings of a point stand together
    alike = seen.descriptor[own] @ gathered.descriptor[tracks.feature[used]].T
    alike = np.maximum.reduceat(alike, begin, axis=1)
    each, best = np.arange(len(own)), alike.argmax(1)
    first = alike[each, best]
    alike[each, best] = -1.0
    second = alike.max(1)
    distance, next_distance = (np.sqrt(np.maximum(2 - 2 * one, 0.0)) for one in (first, second))
    chosen = np.flatnonzero((distance < _RATIO * next_distance) & (first > _SIMILAR))
    chosen = chosen[np.argsort(-first[chosen], kind="stable")]
    chosen = chosen[np.unique(point[best[chosen]], return_index=True)[1]]  # each point once, where it looks most alike
    uv = rig.ideal(seen.pixel[own[chosen]], np.full(len(chosen), view))
    return tracks.points[point[best[chosen]]], uv


def _pose(
    points: Float[np.ndarray, "m 3"], uv: Float[np.ndarray, "m 2"], focal: float
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]] | None:
    """World to camera as most matches have it; None where no pose explains enough of them."""
    if len(points) < _LEAST_AGREEING:
        return None
    camera, undistorted = np.diag([focal, focal, 1.0]), np.zeros(4)
    found, turn, shift, _ = cv2.solvePnPRansac(
        points,
        uv,
        camera,
        undistorted,
        iterationsCount=_TRIALS,
        reprojectionError=_AGREES_PX,
        confidence=_CONFIDENCE,
        flags=cv2.SOLVEPNP_P3P,
    )
    if not found:
        return None
    for within in _CLOSER_PX:  # far points hold a camera's place but loosely: near ones join as it moves
        agree = _errors(points, uv, (cv2.Rodrigues(turn)[0], shift[:, 0]), focal) < within
        if agree.sum() < _LEAST_AGREEING:
            return None
        turn, shift = cv2.solvePnPRefineLM(points[agree], uv[agree], camera, undistorted, turn, shift)
    return cv2.Rodrigues(turn)[0], shift[:, 0]


def _agreeing(
    points: Float[np.ndarray, "m 3"],
    uv: Float[np.ndarray, "m 2"],
    pose: tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]],
    focal: float,
) -> int:
    """How many matches a pose explains."""
    return int((_errors(points, uv, pose, focal) < _AGREES_PX).sum())


def _errors(
    points: Float[np.ndarray, "m 3"],
    uv: Float[np.ndarray, "m 2"],
    pose: tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]],
    focal: float,
) -> Float[np.ndarray, "m"]:
    """Of each match in pixels; inf behind the camera."""
    seen = points @ pose[0].T + pose[1]
    ahead = seen[:, 2] > 0
    off = seen[:, :2] / np.where(ahead, seen[:, 2], 1.0)[:, None] * focal - uv
    return np.where(ahead, np.linalg.norm(off, axis=1), np.inf)
