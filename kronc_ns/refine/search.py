"""Tracks that given poses allow: bands, guided matches, links, points."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from kronc_ns.refine.adjustment import Adjusted, sightings
from kronc_ns.refine.gathering import Gathered
from kronc_ns.refine.grid import grid_of
from kronc_ns.refine.keypoints import KeypointTracks
from kronc_ns.refine.matching import Seen, match, standing_still
from kronc_ns.refine.pairs import Bands, epipolar_bands, joint_covariance
from kronc_ns.refine.region import compared_for_stillness, depth_range, still
from kronc_ns.refine.rig import Rig
from kronc_ns.refine.tracks import HELD_SHARE, LEAST_ANGLE_DEG, Linked, Tracks, angles_deg, link, loose_views, pruned
from kronc_ns.refine.triangulation import place
from kronc_ns.solve.threads import side_by_side

_BAND_SIGMAS = 3.0
_FIRST_BAND_PX, _FIRST_WIDEST_PX = 1.5, 25.0  # least and most half width, before features hold a view ...
_BAND_PX, _WIDEST_PX = 1.0, 6.0  # ... and after
_BAND_NOISES = 2.5  # of the features' noise
_OUTLIER_SIGMAS = 4.0
_SCALE_PX = (1.0, 6.0)  # of the loss of triangulation, before features were adjusted
_VAGUE_PX = 10.0  # most that is believed of a view's own uncertainty


@dataclass(frozen=True)
class Search:
    """What is searched, whatever the poses."""

    pairs: Int[np.ndarray, "p 2"]
    used: Bool[np.ndarray, "f"]
    """Features that may be matched."""
    has_ground: bool
    """Whether nothing lies under the world's z = 0."""
    advance: Callable[[], None]
    """Called after each pair."""


def find_tracks(
    gathered: Gathered, search: Search, rig: Rig, keypoints: KeypointTracks, adjusted: Adjusted | None
) -> Tracks:
    """Tracks, each with its point, by the poses of the keypoints or, after these, of adjusted features."""
    data, now = sightings(
        keypoints,
        adjusted.tracks if adjusted else None,
        adjusted.gathered if adjusted else None,
        rig,
        adjusted.sigma_px if adjusted else 1.0,
    )
    middle = np.nanmean(rig.keypoints, axis=0)
    distance = np.linalg.norm(rig.cameras.centre - middle, axis=1)
    covariance = joint_covariance(data, now, distance)
    noise = adjusted.sigma_px if adjusted else None
    least = _FIRST_BAND_PX if noise is None else max(_BAND_PX, _BAND_NOISES * noise)
    free = _free(adjusted, len(rig.rotation))

    def bands_of(pairs: Int[np.ndarray, "p 2"]) -> Bands:
        return epipolar_bands(pairs, now, covariance, middle, rig.focal)

    def half_width(band: Float[np.ndarray, "p"], pairs: Int[np.ndarray, "p 2"]) -> Float[np.ndarray, "p"]:
        widest = np.where(free[pairs].any(1), _FIRST_WIDEST_PX, _WIDEST_PX)
        return np.minimum(np.hypot(_BAND_SIGMAS * band, least), widest)

    uv = rig.ideal(gathered.pixel, gathered.view)
    bands = bands_of(search.pairs)
    at_car, far = (half_width(of, search.pairs) for of in (bands.at_car, bands.far))
    matches = Linked.of(
        [
            *_compared(gathered, search, rig, uv, at_car, far, distance),
            _followed(gathered, search, rig, uv, lambda pairs: half_width(bands_of(pairs).at_car, pairs)),
        ]
    )
    strict = np.zeros(len(gathered.view), bool)
    strict[matches.here[matches.strict]] = strict[matches.there[matches.strict]] = True
    vague = np.zeros(len(rig.rotation))
    for column in search.pairs.T:
        np.maximum.at(vague, column, np.minimum(bands.far, _VAGUE_PX))
    if noise is None:
        scale = float(np.clip(np.median(bands.far), *_SCALE_PX)) if len(bands.far) else _SCALE_PX[0]
        outlier = _OUTLIER_SIGMAS * np.hypot(scale, 1.0)
    else:
        scale = max(0.5, 1.5 * noise)
        outlier = _OUTLIER_SIGMAS * max(noise, 0.3)
    of_view = np.where(free, np.maximum(outlier, _BAND_SIGMAS * np.hypot(vague, 1.0)), outlier)
    limit = of_view[gathered.view]
    tracks = link(matches, gathered.view)
    for _ in range(2):  # the points move where outliers leave
        tracks, error = place(tracks, uv, gathered.view, rig.cameras, scale)
        tracks = pruned(tracks, error < limit[tracks.feature], strict)
    return tracks.chosen(angles_deg(tracks, gathered.view, rig.cameras) > LEAST_ANGLE_DEG)


def _free(adjusted: Adjusted | None, views: int) -> Bool[np.ndarray, "n"]:
    """Views that features do not hold yet, which are searched as widely as at first."""
    if adjusted is None:
        return np.ones(views, bool)
    return loose_views(adjusted.tracks, adjusted.gathered.view, views, HELD_SHARE)


def standing_features(
    gathered: Gathered,
    uv: Float[np.ndarray, "f 2"],
    pairs: Int[np.ndarray, "p 2"],
    angles: Float[np.ndarray, "n n"],
) -> Bool[np.ndarray, "f"]:
    """Which features stand still in the image; of corners none, which are followed only where they move."""
    count = len(gathered.first) - 1
    far = pairs[compared_for_stillness(pairs, angles)]
    rows = [slice(gathered.first[i], gathered.first[i + 1]) for i in range(count)]
    nowhere = np.zeros(gathered.sift)
    seen = [
        Seen(uv[row], gathered.size[row], gathered.descriptor[row], nowhere[row], nowhere[row], grid_of(uv[row]))
        for row in rows
    ]

    def compare(pair: list[int]) -> tuple[Int[np.ndarray, "k"], Int[np.ndarray, "l"]]:
        i, j = pair
        return standing_still(seen[i], seen[j]), standing_still(seen[j], seen[i])

    times = np.zeros(len(gathered.view), np.int64)
    for (i, j), (here, there) in zip(far.tolist(), side_by_side(compare, far.tolist()), strict=True):
        times[rows[i]] += here
        times[rows[j]] += there
    return still(times, np.bincount(far.ravel(), minlength=count), gathered.view)


def _compared(
    gathered: Gathered,
    search: Search,
    rig: Rig,
    uv: Float[np.ndarray, "f 2"],
    at_car: Float[np.ndarray, "p"],
    far: Float[np.ndarray, "p"],
    distance: Float[np.ndarray, "n"],
) -> list[Linked]:
    """Matches of each pair."""
    numbers, seen = [], []
    for view in range(len(rig.rotation)):
        own = np.arange(gathered.first[view], gathered.first[view + 1])
        own = own[search.used[own]]
        vehicle = None if gathered.on_vehicle is None else gathered.on_vehicle[own]
        low, high = depth_range(uv[own], vehicle, rig, view, search.has_ground)
        numbers.append(own)
        seen.append(Seen(uv[own], gathered.size[own], gathered.descriptor[own], low, high, grid_of(uv[own])))

    def compare(p: int) -> Linked:
        i, j = search.pairs[p].tolist()
        rotation = rig.rotation[j] @ rig.rotation[i].T
        shift = rig.translation[j] - rotation @ rig.translation[i]
        band, apart = (float(at_car[p]), float(far[p])), (float(distance[i]), float(distance[j]))
        found = match(seen[i], seen[j], (rotation, shift), rig.focal, band, apart)
        return Linked(numbers[i][found.here], numbers[j][found.there], found.similarity, found.ratio)

    parts = []
    for part in side_by_side(compare, range(len(search.pairs))):
        parts.append(part)
        search.advance()
    return parts


def _followed(
    gathered: Gathered,
    search: Search,
    rig: Rig,
    uv: Float[np.ndarray, "f 2"],
    half_width: Callable[[Int[np.ndarray, "p 2"]], Float[np.ndarray, "p"]],
) -> Linked:
    """The followed corners that lie in the band of their views."""
    found, view = gathered.followed, gathered.view
    if not len(found.here):
        return found
    pairs, which = np.unique(np.stack([view[found.here], view[found.there]], axis=1), axis=0, return_inverse=True)
    which = which.reshape(-1)
    i, j = pairs.T
    rotation = rig.rotation[j] @ rig.rotation[i].transpose(0, 2, 1)
    shift = rig.translation[j] - np.einsum("pij,pj->pi", rotation, rig.translation[i])
    here, there = (
        np.pad(uv[of] / rig.focal, ((0, 0), (0, 1)), constant_values=1.0) for of in (found.here, found.there)
    )
    line = np.cross(shift[which], np.einsum("pij,pj->pi", rotation[which], here))
    off = np.abs((line * there).sum(1)) / np.maximum(np.linalg.norm(line[:, :2], axis=1), 1e-12) * rig.focal
    return found.chosen((off < half_width(pairs)[which]) & search.used[found.here] & search.used[found.there])
