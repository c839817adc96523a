"""Matches of pairs joined to tracks."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from kronc_ns.geometry.poses import unit
from kronc_ns.solve.compiled import compiled

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
