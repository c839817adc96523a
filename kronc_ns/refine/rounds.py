"""Matching and adjustment in turns: features by the keypoints' poses, then by those that features lead to."""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from kronc_ns.geometry.rotations import rotation_angle_deg
from kronc_ns.refine.adjustment import Adjusted, adjust
from kronc_ns.refine.counter import Counter
from kronc_ns.refine.gathering import Gathered, gather
from kronc_ns.refine.keypoints import KeypointTracks, alike
from kronc_ns.refine.options import RefineConfig
from kronc_ns.refine.pairs import choose_pairs, view_angles, with_next
from kronc_ns.refine.patches import align, grow
from kronc_ns.refine.pictures import Pictures
from kronc_ns.refine.placement import across, relocated, seated
from kronc_ns.refine.region import background_is_still, vehicle_features
from kronc_ns.refine.rig import Rig
from kronc_ns.refine.search import Search, find_tracks, standing_features
from kronc_ns.refine.tracks import (
    HELD_SHARE,
    Tracks,
    confirmed,
    enough,
    long_sightings,
    of_held_views,
    without,
    without_views,
)
from kronc_ns.refine.triangulation import place
from kronc_ns.refine.unguided import unguided_tracks
from kronc_ns.refine.verdict import HELD_BY, MOST_LOOSE, Evidence, weigh
from kronc_ns.scene import Scene

_HELD_OUT = 0.2  # share of the tracks that no fit sees
_TRACKS_OF_VIEW = 400  # that are enough, once their places are those of patches
_PAIRED = 20  # sightings of a view in tracks of three, below which its tracks of two count
_ROUNDS, _SETTLED_DEG, _SETTLED_SIGMAS = 6, 0.05, 8.0  # of matching by the poses of features, until these turn less on
# average, or less than so many times the noise of a feature: then they only follow it
_FIRST_NEAREST, _FIRST_SCALE_PX = 4, 10.0  # views that each is compared with at first; how far off points may be then
_FOR_FOCAL = 50  # tracks of a view that are enough to see whether the focal length is right


@dataclass(frozen=True)
class Prepared:
    """Some views of a scene before their features are matched."""

    views: Int[np.ndarray, "n"]
    start: Rig
    keypoints: KeypointTracks
    gathered: Gathered
    search: Search
    vehicle: Bool[np.ndarray, "f"]
    """Which features are the vehicle's."""
    background_still: bool
    vehicle_only: bool
    """Whether no others are used."""


@dataclass(frozen=True)
class Found:
    """The poses that features lead to, and what speaks for them."""

    adjusted: Adjusted
    keypoints: KeypointTracks
    """As far as they are believed."""
    evidence: Evidence


def prepare(
    scene: Scene,
    views: Int[np.ndarray, "n"],
    start: Rig,
    keypoints: KeypointTracks,
    has_ground: bool,
    pictures: Pictures,
    config: RefineConfig,
    counter: Counter,
) -> Prepared:
    """Find features in the photos of some views, whose cameras are ``start``, and say which are used."""
    angles = _angles(start)
    pairs = choose_pairs(angles)
    counter.expect(len(views) + len(pairs))
    cameras = [scene.camera_of(view) for view in views.tolist()]
    gathered = gather(pictures, views, cameras, start.rotation[:, :, 2], angles, counter.advance)
    uv = start.ideal(gathered.pixel, gathered.view)
    stands = standing_features(gathered, uv, pairs, angles)
    vehicle = vehicle_features(gathered, uv, start)
    turntable = background_is_still(stands, vehicle)
    vehicle_only = config.region == "vehicle" or (config.region == "auto" and turntable)
    used = ~stands & vehicle if vehicle_only else ~stands
    search = Search(pairs, used, has_ground, counter.advance)
    return Prepared(views, start, keypoints, gathered, search, vehicle, turntable, vehicle_only)


def find_poses(prepared: Prepared, config: RefineConfig, counter: Counter) -> Found | None:
    """Poses from features; None where there are no tracks."""
    start, keypoints, gathered, search = prepared.start, prepared.keypoints, prepared.gathered, prepared.search
    rng = np.random.default_rng(config.seed)
    tracks = _first(prepared, counter)
    reserved = tracks.chosen(rng.random(len(tracks)) < _HELD_OUT)
    held = np.zeros(len(gathered.view), bool)
    held[reserved.feature] = True
    fitted = enough(without(tracks, held), gathered.view, _TRACKS_OF_VIEW, rng)
    if not len(fitted):
        return None
    latest = _begun(prepared, fitted)
    planned = len(search.pairs)
    for _ in range(_ROUNDS):
        earlier = latest.rig
        latest = _mended(latest, gathered, search)
        search = replace(search, pairs=choose_pairs(_angles(latest.rig)))
        counter.expect(len(search.pairs) - planned)
        planned = 0
        believed = keypoints.noisier(alike(keypoints, start, latest.rig))
        tracks, aligned = _matched(gathered, search, latest, believed, rng)
        known = without(tracks, np.pad(held, (0, len(aligned.view) - len(held))))
        if not len(known):
            return None
        latest = adjust(believed, known, aligned, latest.rig, config)
        turned = latest.rig.rotation @ earlier.rotation.transpose(0, 2, 1)
        noise_deg = math.degrees(latest.sigma_px / latest.rig.focal)
        if rotation_angle_deg(turned).mean() < max(_SETTLED_DEG, _SETTLED_SIGMAS * noise_deg):
            break
    evidence = weigh(reserved, known, aligned, keypoints, start, latest.rig, latest.sigma_px)
    if not config.refine_focal:
        some = enough(known, aligned.view, _FOR_FOCAL, rng)
        freed = adjust(believed, some, aligned, latest.rig, replace(config, refine_focal=True), latest.sigma_px)
        evidence = replace(evidence, focal_growth=freed.rig.focal / latest.rig.focal)
    final = adjust(believed, _placed(tracks, aligned, latest), aligned, latest.rig, config, latest.sigma_px)
    return Found(final, believed, evidence)


def _first(prepared: Prepared, counter: Counter) -> Tracks:
    """Tracks that owe nothing to the keypoints' poses, where they hold the views together; else what these find."""
    start, gathered, search = prepared.start, prepared.gathered, prepared.search
    uv = start.ideal(gathered.pixel, gathered.view)
    pairs = with_next(choose_pairs(_angles(start), _FIRST_NEAREST), len(start.rotation))
    counter.expect(len(pairs))
    tracks = unguided_tracks(gathered, search.used, pairs, uv, start.focal, search.advance)
    if (long_sightings(tracks, gathered.view, len(start.rotation)) >= HELD_BY).mean() >= 1 - MOST_LOOSE:
        return place(tracks, uv, gathered.view, start.cameras, _FIRST_SCALE_PX)[0]
    counter.expect(len(search.pairs))
    return confirmed(find_tracks(gathered, search, start, prepared.keypoints, None), gathered.view, _PAIRED)


def _begun(prepared: Prepared, tracks: Tracks) -> Adjusted:
    """Cameras that fit the first tracks. Those that stand across the car from the photos before and after them would
    drag these along: they join where they see the points of the others."""
    start, keypoints, gathered = prepared.start, prepared.keypoints, prepared.gathered
    astray = across(_angles(start)) > 0
    believed = without_views(tracks, gathered.view, astray)
    if not len(believed):
        return adjust(keypoints, tracks, gathered, start, None)
    begun = adjust(keypoints, believed, gathered, start, None)
    rig, found = seated(begun, tracks, astray)
    if not found.any():
        return begun
    return adjust(keypoints, without_views(tracks, gathered.view, astray & ~found), gathered, rig, None)


def _mended(latest: Adjusted, gathered: Gathered, search: Search) -> Adjusted:
    """With views that stood wrong placed anew; what others saw together with these says nothing of them."""
    rig = relocated(latest, gathered, search.used)
    moved = (rig.rotation != latest.rig.rotation).any((1, 2))
    return replace(latest, rig=rig, tracks=without(latest.tracks, moved[latest.gathered.view]))


def _matched(
    gathered: Gathered, search: Search, latest: Adjusted, believed: KeypointTracks, rng: np.random.Generator
) -> tuple[Tracks, Gathered]:
    """Tracks by the latest poses, and the features with their places made those of patches."""
    tracks = find_tracks(gathered, search, latest.rig, believed, latest)
    tracks = enough(tracks, gathered.view, _TRACKS_OF_VIEW, rng)
    aligned = align(tracks, gathered, latest.rig)
    tracks, aligned = grow(_placed(tracks, aligned, latest), aligned, latest.rig)
    tracks = confirmed(tracks, aligned.view, _PAIRED)
    return of_held_views(tracks, aligned.view, HELD_SHARE), aligned


def _angles(rig: Rig) -> Float[np.ndarray, "n n"]:
    """Between the directions from which views see the car."""
    return view_angles(rig.cameras.centre, np.nanmean(rig.keypoints, axis=0))


def _placed(tracks: Tracks, gathered: Gathered, adjusted: Adjusted) -> Tracks:
    """Tracks with their points where adjusted cameras see them."""
    rig = adjusted.rig
    return place(tracks, rig.ideal(gathered.pixel, gathered.view), gathered.view, rig.cameras, adjusted.sigma_px)[0]
