"""Joint adjustment of image features and semantic keypoints."""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from kronc_ns.geometry.alignment import umeyama
from kronc_ns.refine.gathering import Gathered
from kronc_ns.refine.keypoints import KeypointTracks
from kronc_ns.refine.options import RefineConfig
from kronc_ns.refine.rig import Rig
from kronc_ns.refine.tracks import Tracks, angles_off_middle_deg, view_medians
from kronc_ns.solve import bundle
from kronc_ns.solve.robust import RAYLEIGH_MEDIAN
from kronc_ns.solve.sightings import Sightings, Unknowns

_FIRST_SIGMA_PX, _LEAST_SIGMA_PX = 0.5, 0.02  # of a feature's place
_PAIR_FACTOR = 1.5  # tracks of two views, which nothing confirms, are believed less
_ASKEW_DEG = 8.0  # from the middle of the views of a point, where a patch seen askew has doubled its variance
_ROUNDS, _SETTLED = 6, 0.93  # of the noise's estimate
_STEPS, _TOLERANCE = 6, 1e-3
_SETTLING_STEPS, _SETTLING_TOLERANCE = 15, 1e-5
_LAST_STEPS, _LAST_TOLERANCE = 40, 1e-7  # slow bends of the whole ring are the last to settle
_LEAST_REDUNDANCY = 0.2


@dataclass(frozen=True)
class Adjusted:
    """Cameras and points that fit features and keypoints together."""

    rig: Rig
    tracks: Tracks
    gathered: Gathered
    """What the tracks are of."""
    sigma_px: float
    """Noise of the features along one axis."""
    before_px: float
    """Median error of the features where the adjustment began."""
    after_px: float


def adjust(
    keypoints: KeypointTracks,
    tracks: Tracks,
    gathered: Gathered,
    rig: Rig,
    refine: RefineConfig | None,
    sigma_px: float | None = None,
) -> Adjusted:
    """Minimise both kinds of errors; intrinsics are refined as ``refine`` says, if at all.

    The noise of the features follows their errors down; where it is given, the adjustment is the last, and thorough.
    The world stays where the keypoints are.
    """
    data, now = sightings(keypoints, tracks, gathered, rig, 1.0, refine)
    own = slice(int(keypoints.first[-1]), None)
    error = bundle.error_px(data, now)[own]
    before = float(np.median(error))
    rounds = 0 if sigma_px is not None else _ROUNDS
    sigma = max(_FIRST_SIGMA_PX, before / RAYLEIGH_MEDIAN) if sigma_px is None else sigma_px
    redundancy = max(_LEAST_REDUNDANCY, 1 - 3 * len(tracks) / (2 * len(tracks.feature)))
    # a view that stands wrong has large errors, and its features are right: the loss is as wide as they are, as long as
    # they fall
    worst = float(view_medians(tracks, error, gathered.view, len(rig.rotation)).max())
    for _ in range(rounds):
        wide = max(1.0, worst / RAYLEIGH_MEDIAN / sigma)
        data = _with_noise(data, tracks, own, gathered, rig, sigma, wide)
        now = bundle.adjust(data, now, _STEPS, _TOLERANCE).now
        error = bundle.error_px(data, now)[own]
        found = max(_LEAST_SIGMA_PX, float(np.median(error)) / RAYLEIGH_MEDIAN / math.sqrt(redundancy))
        settled = found > _SETTLED * sigma and wide == 1.0
        sigma = min(sigma, found)
        if settled:
            break
        falls = float(view_medians(tracks, error, gathered.view, len(rig.rotation)).max())
        worst = falls if falls < worst / 2 else 0.0
    data = _with_noise(data, tracks, own, gathered, rig, sigma)
    last = (_LAST_STEPS, _LAST_TOLERANCE) if sigma_px is not None else (_SETTLING_STEPS, _SETTLING_TOLERANCE)
    now = bundle.adjust(data, now, *last).now
    after = float(np.median(bundle.error_px(data, now)[own]))
    joints = len(keypoints.joint)
    back = umeyama(now.points[:joints], rig.keypoints[keypoints.joint], np.diff(keypoints.first).astype(float))
    known = rig.keypoints.copy()
    known[keypoints.joint] = now.points[:joints]
    u, _, vt = np.linalg.svd(now.rotation)  # products of many turns drift off rotations
    found_rig = replace(rig, rotation=u @ vt, translation=now.translation, keypoints=known)
    found_rig = found_rig.with_lenses(*now.intrinsics.T).moved(back)
    points = back.apply(now.points[joints:])
    return Adjusted(found_rig, replace(tracks, points=points), gathered, sigma, before, after)


def sightings(
    keypoints: KeypointTracks,
    tracks: Tracks | None,
    gathered: Gathered | None,
    rig: Rig,
    sigma_px: float,
    refine: RefineConfig | None = None,
) -> tuple[Sightings, Unknowns]:
    """What is adjusted, and where it begins: the keypoints first, then the tracks, if there are any."""
    first, view = keypoints.first, keypoints.view
    uv = rig.ideal(keypoints.pixel, keypoints.view)
    weight, scale = keypoints.sigma_px**-2.0, keypoints.scale_px
    points = rig.keypoints[keypoints.joint]
    if tracks is not None and gathered is not None:
        features = gathered.view[tracks.feature]
        first = np.concatenate([first, first[-1] + tracks.first[1:]])
        view = np.concatenate([view, features])
        uv = np.concatenate([uv, rig.ideal(gathered.pixel[tracks.feature], features)])
        noise = _noise(tracks, gathered, rig, sigma_px)
        weight, scale = np.concatenate([weight, noise**-2.0]), np.concatenate([scale, noise])
        points = np.concatenate([points, tracks.points])
    data = Sightings(
        first.astype(np.int64),
        view.astype(np.int64),
        uv,
        weight,
        scale,
        np.full(2, rig.focal),
        rig.lens.astype(np.int64),
        refine is not None and refine.refine_focal,
        refine is not None and refine.refine_k1,
    )
    return data, Unknowns(rig.rotation, rig.translation, points, np.zeros((len(rig.lenses), 2)))


def _noise(tracks: Tracks, gathered: Gathered, rig: Rig, sigma_px: float) -> Float[np.ndarray, "s"]:
    """Standard deviation of each sighting in ideal pixels.

    It grows with the angle a point is seen askew by: patches of what is no plane are then off, those of one surface all
    to the same side, which neither the loss nor their number makes good.
    """
    of_pair = np.where(tracks.lengths == 2, _PAIR_FACTOR, 1.0)[tracks.of_track]
    askew = np.hypot(1.0, angles_off_middle_deg(tracks, gathered.view, rig.cameras) / _ASKEW_DEG)
    return sigma_px * of_pair * askew / rig.enlargement[gathered.view[tracks.feature]]


def _with_noise(
    data: Sightings, tracks: Tracks, own: slice, gathered: Gathered, rig: Rig, sigma_px: float, wide: float = 1.0
) -> Sightings:
    """With another noise of the features; the loss is so many times wider."""
    noise = _noise(tracks, gathered, rig, sigma_px)
    weight, scale = data.weight.copy(), data.scale.copy()
    weight[own], scale[own] = noise**-2.0, wide * noise
    return data._replace(weight=weight, scale=scale)
