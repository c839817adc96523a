"""Matches of pairs joined to tracks, and each track's point in space."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from kronc_ns.geometry.poses import unit
from kronc_ns.solve.compiled import compiled
from kronc_ns.solve.projection import BEHIND_PX

LEAST_ANGLE_DEG = 1.0
"""Rays that are more parallel tell nothing of a point."""
HELD_SHARE = 0.1
"""Of the usual sightings of a view: fewer are as likely wrong, and keypoints place it better."""
_STRICT_RATIO, _STRICT_SIMILAR = 0.7, 0.9  # of tracks of two views, which nothing else confirms


@dataclass(frozen=True)
class Linked:
    """Matches of all pairs, features numbered over all views."""

    here: Int[np.ndarray, "m"]
    there: Int[np.ndarray, "m"]
    similarity: Float[np.ndarray, "m"]
    ratio: Float[np.ndarray, "m"]

    @staticmethod
    def none() -> "Linked":
        """No matches."""
        return Linked(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0), np.zeros(0))

    @staticmethod
    def of(parts: Sequence["Linked"]) -> "Linked":
        """All of them."""
        columns = zip(*((one.here, one.there, one.similarity, one.ratio) for one in parts), strict=True)
        return Linked(*map(np.concatenate, columns)) if parts else Linked.none()

    def chosen(self, keep: Bool[np.ndarray, "m"]) -> "Linked":
        """Some of them."""
        return Linked(self.here[keep], self.there[keep], self.similarity[keep], self.ratio[keep])

    @property
    def strict(self) -> Bool[np.ndarray, "m"]:
        """Matches that are believed alone."""
        return (self.ratio < _STRICT_RATIO) & (self.similarity > _STRICT_SIMILAR)


@dataclass(frozen=True)
class Tracks:
    """Features that are taken for one point: those of track p are ``feature[first[p]:first[p + 1]]``, by view."""

    first: Int[np.ndarray, "p1"]
    feature: Int[np.ndarray, "s"]
    points: Float[np.ndarray, "p 3"]

    def __len__(self) -> int:
        return len(self.first) - 1

    @property
    def lengths(self) -> Int[np.ndarray, "p"]:
        """Views of each track."""
        return np.diff(self.first)

    @property
    def of_track(self) -> Int[np.ndarray, "s"]:
        """Which track each feature is of."""
        return np.repeat(np.arange(len(self)), self.lengths)

    def chosen(self, keep: Bool[np.ndarray, "p"]) -> "Tracks":
        """Some of the tracks."""
        return rows_of(self.feature[keep[self.of_track]], self.of_track[keep[self.of_track]], self.points)


def rows_of(feature: Int[np.ndarray, "s"], track: Int[np.ndarray, "s"], points: Float[np.ndarray, "p 3"]) -> Tracks:
    """Tracks from features sorted by track; numbers that are not used fall away."""
    number, row = np.unique(track, return_inverse=True)
    first = np.zeros(len(number) + 1, np.int64)
    np.cumsum(np.bincount(row, minlength=len(number)), out=first[1:])
    return Tracks(first, feature, points[number])


@dataclass(frozen=True)
class Cameras:
    """Where tracks are seen from."""

    rotation: Float[np.ndarray, "n 3 3"]
    """World to camera."""
    translation: Float[np.ndarray, "n 3"]
    focal: float

    @property
    def centre(self) -> Float[np.ndarray, "n 3"]:
        """Of each camera."""
        return -np.einsum("nji,nj->ni", self.rotation, self.translation)


def link(matches: Linked, view: Int[np.ndarray, "f"]) -> Tracks:
    """Join matches, the most similar first, so that no track has two features of one view; points are still unknown.

    Tracks of two views are left out unless their match is strict.
    """
    used, numbers = np.unique(np.concatenate([matches.here, matches.there]), return_inverse=True)
    here, there = np.split(numbers, 2)
    order = np.argsort(-matches.similarity, kind="stable")
    root = _joined(here, there, order, view[used], int(view.max(initial=0)) + 1)
    strict = np.zeros(len(used), bool)
    strict[np.concatenate([here[matches.strict], there[matches.strict]])] = True
    sorting = np.lexsort((view[used], root))
    feature, track = used[sorting], np.unique(root[sorting], return_inverse=True)[1]
    keep = _believed(track, strict[sorting])[track]
    return rows_of(feature[keep], track[keep], np.full((int(track.max(initial=-1)) + 1, 3), np.nan))


def enough(tracks: Tracks, view: Int[np.ndarray, "f"], least: int, rng: np.random.Generator) -> Tracks:
    """So many of the tracks that every view has ``least`` of them, if it had so many: the longest come first."""
    order = np.lexsort((rng.random(len(tracks)), -tracks.lengths))
    seen = np.zeros(int(view.max(initial=0)) + 1, np.int64)
    return tracks.chosen(_enough(tracks.first, view[tracks.feature], order, seen, least))


def long_sightings(tracks: Tracks, view: Int[np.ndarray, "f"], views: int) -> Int[np.ndarray, "n"]:
    """Each view's sightings in tracks of three views or more: those that others confirm."""
    return np.bincount(view[tracks.feature[(tracks.lengths >= 3)[tracks.of_track]]], minlength=views)


def view_medians(
    tracks: Tracks, error: Float[np.ndarray, "s"], view: Int[np.ndarray, "f"], views: int
) -> Float[np.ndarray, "n"]:
    """The (lower) median error of each view's sightings in tracks of three views or more; 0 where it has none.

    A point that two views see lies where their rays pass each other, wherever they stand.
    """
    long = (tracks.lengths >= 3)[tracks.of_track]
    error, view = error[long], view[tracks.feature[long]]
    order = np.lexsort((error, view))
    first = np.flatnonzero(np.diff(view[order], prepend=-1))
    middle = first + (np.diff(first, append=len(order)) - 1) // 2
    medians = np.zeros(views)
    medians[view[order[first]]] = error[order[middle]]
    return medians


def confirmed(tracks: Tracks, view: Int[np.ndarray, "f"], least: int) -> Tracks:
    """Those of three views; and of two, until every view has ``least``, where it has fewer of three.

    Nothing but nearness to the line of the very poses that it was found by speaks for a match of two views: it pulls
    them back to where they were.
    """
    long = tracks.lengths >= 3
    seen = long_sightings(tracks, view, int(view.max(initial=0)) + 1)
    pairs = _enough(tracks.first, view[tracks.feature], np.flatnonzero(~long), seen, least)
    return tracks.chosen(long | pairs)


def loose_views(tracks: Tracks, view: Int[np.ndarray, "f"], views: int, share: float) -> Bool[np.ndarray, "n"]:
    """Which views have less than a ``share`` of the usual sightings in tracks of three views or more."""
    seen = long_sightings(tracks, view, views)
    return seen < share * np.median(seen)


def without(tracks: Tracks, held: Bool[np.ndarray, "f"]) -> Tracks:
    """The tracks that have none of the features that are held out."""
    out = np.zeros(len(tracks), bool)
    out[tracks.of_track[held[tracks.feature]]] = True
    return tracks.chosen(~out)


def of_held_views(tracks: Tracks, view: Int[np.ndarray, "f"], share: float) -> Tracks:
    """The tracks less the sightings of `loose_views`."""
    return without_views(tracks, view, loose_views(tracks, view, int(view.max(initial=0)) + 1, share))


def without_views(tracks: Tracks, view: Int[np.ndarray, "f"], out: Bool[np.ndarray, "n"]) -> Tracks:
    """The tracks less the sightings of some views, where two are left."""
    keep = ~out[view[tracks.feature]]
    left = rows_of(tracks.feature[keep], tracks.of_track[keep], tracks.points)
    return left.chosen(left.lengths >= 2)


def place(
    tracks: Tracks,
    uv: Float[np.ndarray, "f 2"],
    view: Int[np.ndarray, "f"],
    cameras: Cameras,
    scale_px: float,
) -> tuple[Tracks, Float[np.ndarray, "s"]]:
    """Every track's point by robust triangulation, and the length of each sighting's error in pixels.

    ``scale_px`` is that of the Cauchy loss.
    """
    points, error = np.zeros((len(tracks), 3)), np.zeros(len(tracks.feature))
    if len(tracks):
        _place(
            tracks.first,
            view[tracks.feature],
            np.ascontiguousarray(uv[tracks.feature]) / cameras.focal,
            cameras.rotation,
            cameras.translation,
            cameras.centre,
            scale_px / cameras.focal,
            points,
            error,
        )
    return Tracks(tracks.first, tracks.feature, points), error * cameras.focal


def pruned(tracks: Tracks, keep: Bool[np.ndarray, "s"], strict: Bool[np.ndarray, "f"]) -> Tracks:
    """Tracks without some of their sightings; what is left must be of three views, or of two and strict."""
    feature, track = tracks.feature[keep], tracks.of_track[keep]
    believed = _believed(track, strict[feature])[track]
    return rows_of(feature[believed], track[believed], tracks.points)


def _believed(track: Int[np.ndarray, "s"], strict: Bool[np.ndarray, "s"]) -> Bool[np.ndarray, "p"]:
    """Tracks of three views, or of two that are both strict."""
    length, sure = np.bincount(track), np.bincount(track, weights=strict)
    return (length >= 3) | ((length == 2) & (sure == 2))


def rays(
    tracks: Tracks, view: Int[np.ndarray, "f"], cameras: Cameras
) -> tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "p 3"]]:
    """Directions in which each sighting sees its point, and the mean direction of each track."""
    ray = unit(tracks.points[tracks.of_track] - cameras.centre[view[tracks.feature]])
    mean = np.zeros((len(tracks), 3))
    np.add.at(mean, tracks.of_track, ray)
    return ray, unit(mean)


def angles_off_middle_deg(tracks: Tracks, view: Int[np.ndarray, "f"], cameras: Cameras) -> Float[np.ndarray, "s"]:
    """Between each sighting's ray and the mean of its track's."""
    ray, mean = rays(tracks, view, cameras)
    return np.degrees(np.arccos(np.clip((ray * mean[tracks.of_track]).sum(1), -1.0, 1.0)))


def angles_deg(tracks: Tracks, view: Int[np.ndarray, "f"], cameras: Cameras) -> Float[np.ndarray, "p"]:
    """Between the rays of each track, at the most: twice the largest from their mean."""
    widest = np.zeros(len(tracks))
    np.maximum.at(widest, tracks.of_track, angles_off_middle_deg(tracks, view, cameras))
    return 2 * widest


@compiled
def _enough(first: Any, view: Any, order: Any, count: Any, least: int) -> Any:
    """Which tracks are taken: those that some of their views still wants, which has ``count`` so far."""
    taken = np.zeros(len(first) - 1, np.bool_)
    for p in order:
        wanted = False
        for o in range(first[p], first[p + 1]):
            if count[view[o]] < least:
                wanted = True
        if wanted:
            taken[p] = True
            for o in range(first[p], first[p + 1]):
                count[view[o]] += 1
    return taken


@compiled
def _joined(here: Any, there: Any, order: Any, view: Any, views: int) -> Any:
    """The root of every feature after union in the given order, but for unions that would repeat a view."""
    count, words = len(view), (views + 63) // 64
    parent, size = np.arange(count), np.ones(count, np.int64)
    taken = np.zeros((count, words), np.uint64)
    for i in range(count):
        taken[i, view[i] // 64] = np.uint64(1) << np.uint64(view[i] % 64)
    for k in order:
        a, b = here[k], there[k]
        while parent[a] != a:
            parent[a] = parent[parent[a]]
            a = parent[a]
        while parent[b] != b:
            parent[b] = parent[parent[b]]
            b = parent[b]
        if a == b:
            continue
        repeated = False
        for w in range(words):
            if taken[a, w] & taken[b, w]:
                repeated = True
        if repeated:
            continue
        if size[a] < size[b]:
            a, b = b, a
        parent[b] = a
        size[a] += size[b]
        for w in range(words):
            taken[a, w] |= taken[b, w]
    root = np.empty(count, np.int64)
    for i in range(count):
        a = i
        while parent[a] != a:
            a = parent[a]
        root[i] = a
    return root


@compiled
def _solve3(m: Any, b: Any, out: Any) -> None:
    """Solution of a symmetric system of three."""
    c00 = m[1, 1] * m[2, 2] - m[1, 2] * m[1, 2]
    c01 = m[0, 2] * m[1, 2] - m[0, 1] * m[2, 2]
    c02 = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
    inverse = 1.0 / (m[0, 0] * c00 + m[0, 1] * c01 + m[0, 2] * c02)
    c11, c12 = m[0, 0] * m[2, 2] - m[0, 2] * m[0, 2], m[0, 1] * m[0, 2] - m[0, 0] * m[1, 2]
    c22 = m[0, 0] * m[1, 1] - m[0, 1] * m[0, 1]
    out[0] = (c00 * b[0] + c01 * b[1] + c02 * b[2]) * inverse
    out[1] = (c01 * b[0] + c11 * b[1] + c12 * b[2]) * inverse
    out[2] = (c02 * b[0] + c12 * b[1] + c22 * b[2]) * inverse


@compiled
def _off(x: Any, r: Any, t: Any, u: float, v: float) -> Any:
    """Error in the image plane (two numbers) and depth; a huge one behind the camera."""
    z = r[2, 0] * x[0] + r[2, 1] * x[1] + r[2, 2] * x[2] + t[2]
    if z < 1e-3:
        return BEHIND_PX, BEHIND_PX, z
    p = (r[0, 0] * x[0] + r[0, 1] * x[1] + r[0, 2] * x[2] + t[0]) / z
    q = (r[1, 0] * x[0] + r[1, 1] * x[1] + r[1, 2] * x[2] + t[1]) / z
    return p - u, q - v, z


@compiled
def _misfit(x: Any, begin: Any, end: Any, view: Any, plane: Any, rotation: Any, translation: Any, scale: float) -> Any:
    """Cauchy's loss of a point's sightings."""
    total = 0.0
    for o in range(begin, end):
        du, dv, _ = _off(x, rotation[view[o]], translation[view[o]], plane[o, 0], plane[o, 1])
        total += np.log(1.0 + (du * du + dv * dv) / (scale * scale))
    return total


@compiled
def _place(
    first: Any, view: Any, plane: Any, rotation: Any, translation: Any, centre: Any, scale: float, points: Any,
    error: Any,
) -> None:  # fmt: skip
    """The point of each track: the best of those where two of its rays pass each other, then refined by all."""
    matrix, right, trial, best = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    for p in range(len(first) - 1):
        begin, end = first[p], first[p + 1]
        count = end - begin
        least = 1e300
        for i in range(count):
            for j in range(i + 1, count):
                if count > 5 and not (j == i + 1 or j == i + count // 2 or (i == 0 and j == count - 1)):
                    continue
                for a in range(3):
                    right[a] = 0.0
                    for b in range(3):
                        matrix[a, b] = 1e-9 if a == b else 0.0
                for o in (begin + i, begin + j):
                    r, c = rotation[view[o]], centre[view[o]]
                    u, v = plane[o, 0], plane[o, 1]
                    norm = np.sqrt(u * u + v * v + 1.0)
                    ray = (
                        (r[0, 0] * u + r[1, 0] * v + r[2, 0]) / norm,
                        (r[0, 1] * u + r[1, 1] * v + r[2, 1]) / norm,
                        (r[0, 2] * u + r[1, 2] * v + r[2, 2]) / norm,
                    )
                    for a in range(3):
                        for b in range(3):
                            part = (1.0 if a == b else 0.0) - ray[a] * ray[b]
                            matrix[a, b] += part
                            right[a] += part * c[b]
                _solve3(matrix, right, trial)
                cost = _misfit(trial, begin, end, view, plane, rotation, translation, scale)
                if cost < least:
                    least = cost
                    for a in range(3):
                        best[a] = trial[a]
        damping = 1e-3
        for _ in range(15):
            for a in range(3):
                right[a] = 0.0
                for b in range(3):
                    matrix[a, b] = 0.0
            for o in range(begin, end):
                r = rotation[view[o]]
                du, dv, z = _off(best, r, translation[view[o]], plane[o, 0], plane[o, 1])
                if z < 1e-3:
                    continue
                weight = 1.0 / (1.0 + (du * du + dv * dv) / (scale * scale))
                pu, pv = du + plane[o, 0], dv + plane[o, 1]
                by_u = ((r[0, 0] - pu * r[2, 0]) / z, (r[0, 1] - pu * r[2, 1]) / z, (r[0, 2] - pu * r[2, 2]) / z)
                by_v = ((r[1, 0] - pv * r[2, 0]) / z, (r[1, 1] - pv * r[2, 1]) / z, (r[1, 2] - pv * r[2, 2]) / z)
                for a in range(3):
                    right[a] -= weight * (by_u[a] * du + by_v[a] * dv)
                    for b in range(3):
                        matrix[a, b] += weight * (by_u[a] * by_u[b] + by_v[a] * by_v[b])
            for a in range(3):
                matrix[a, a] = matrix[a, a] * (1.0 + damping) + 1e-12
            _solve3(matrix, right, trial)
            for a in range(3):
                trial[a] += best[a]
            cost = _misfit(trial, begin, end, view, plane, rotation, translation, scale)
            if cost < least:
                gain = least - cost
                least = cost
                damping *= 0.2
                for a in range(3):
                    best[a] = trial[a]
                if gain < 1e-4:
                    break
            else:
                damping *= 10.0
                if damping > 1e3:
                    break
        for a in range(3):
            points[p, a] = best[a]
        for o in range(begin, end):
            du, dv, _ = _off(best, rotation[view[o]], translation[view[o]], plane[o, 0], plane[o, 1])
            error[o] = np.sqrt(du * du + dv * dv)
