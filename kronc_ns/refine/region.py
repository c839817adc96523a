"""Where features may lie: depths that are possible for them, and a background that stands still."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from kronc_ns.geometry.poses import unit
from kronc_ns.refine.gathering import Gathered
from kronc_ns.refine.rig import Rig

_GROUND_M = -0.3  # under the car's own ground: slopes, and a frame that is not quite right
_NEAREST, _FARTHEST = 0.25, 200.0  # depths, of the distance of the car
_BOX_SHARE, _BOX_M = 0.05, 0.1  # around the keypoints
_NEAR_M = 0.1
_STILL_SHARE = 0.34  # of the neighbours, in which a feature that stands still is found again
_LEAST_ANGLE_DEG = 4.0  # between views in which what stands still does not belong to the car
_STILL_BACKGROUND = 0.2  # of the features off the vehicle
_OUTLINE = 0.06  # around the keypoints' outline, of its size


def depth_range(
    uv: Float[np.ndarray, "k 2"],
    on_vehicle: Bool[np.ndarray, "k"] | None,
    rig: Rig,
    view: int,
    ground: bool,
) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k"]]:
    """Least and most z-depth of features in a world of about metres, z up.

    On the vehicle they lie within the keypoints' box; with ``ground`` everything lies above the car's. ``on_vehicle``
    is None where nobody says where the vehicle is.
    """
    rotation, points = rig.rotation[view], rig.keypoints[np.isfinite(rig.keypoints).all(-1)]
    centre = -rotation.T @ rig.translation[view]
    distance = float(np.linalg.norm(centre - points.mean(0)))
    low, high = np.full(len(uv), _NEAREST * distance), np.full(len(uv), _FARTHEST * distance)
    ray = np.concatenate([uv / rig.focal, np.ones((len(uv), 1))], axis=1) @ rotation
    with np.errstate(divide="ignore", invalid="ignore"):
        if ground:
            under = np.where(ray[:, 2] < 0, (_GROUND_M - centre[2]) / ray[:, 2], np.inf)
            high = np.minimum(high, np.maximum(under, 1.2 * low))
        if on_vehicle is not None:
            least, most = points.min(0), points.max(0)
            around = _BOX_SHARE * (most - least) + _BOX_M
            one, two = (least - around - centre) / ray, (most + around - centre) / ray
            enter, leave = np.nanmax(np.minimum(one, two), axis=1), np.nanmin(np.maximum(one, two), axis=1)
            hit = on_vehicle & (leave > enter) & (leave > 0)
            low, high = np.where(hit, np.maximum(enter, _NEAR_M), low), np.where(hit, leave, high)
    return low, high


def still(
    times: Int[np.ndarray, "f"], compared: Int[np.ndarray, "n"], view: Int[np.ndarray, "f"]
) -> Bool[np.ndarray, "f"]:
    """Which features stand still: found again at their place in so many of the views they were compared with."""
    return times >= np.maximum(1.0, _STILL_SHARE * compared[view])


def compared_for_stillness(pairs: Int[np.ndarray, "p 2"], angles: Float[np.ndarray, "n n"]) -> Bool[np.ndarray, "p"]:
    """Pairs whose views are so far apart that nothing of the car stays where it is."""
    return angles[pairs[:, 0], pairs[:, 1]] >= _LEAST_ANGLE_DEG


def background_is_still(stands_still: Bool[np.ndarray, "f"], on_vehicle: Bool[np.ndarray, "f"]) -> bool:
    """Whether so much off the vehicle stands still that it was the car that turned."""
    off = ~on_vehicle
    return bool(off.any()) and float(stands_still[off].mean()) > _STILL_BACKGROUND


def vehicle_features(gathered: Gathered, uv: Float[np.ndarray, "f 2"], rig: Rig) -> Bool[np.ndarray, "f"]:
    """Which features are the vehicle's: by the masks, or within the outline of the keypoints where there are none."""
    if gathered.on_vehicle is not None:
        return gathered.on_vehicle
    within = np.zeros(len(uv), bool)
    for view in range(len(rig.rotation)):
        own = gathered.view == view
        within[own] = _within_outline(uv[own], rig, view)
    return within


def _within_outline(uv: Float[np.ndarray, "k 2"], rig: Rig, view: int) -> Bool[np.ndarray, "k"]:
    """Which places lie within the outline of the keypoints, as far as these tell the vehicle's."""
    points = rig.keypoints[np.isfinite(rig.keypoints).all(-1)]
    seen = points @ rig.rotation[view].T + rig.translation[view]
    seen = seen[seen[:, 2] > 0]
    if len(seen) < 3:
        return np.zeros(len(uv), bool)
    hull = cv2.convexHull((seen[:, :2] / seen[:, 2:] * rig.focal).astype(np.float32))[:, 0].astype(np.float64)
    around = _OUTLINE * float(np.linalg.norm(np.ptp(hull, axis=0)))
    edge = np.roll(hull, -1, axis=0) - hull
    outward = unit(np.stack([edge[:, 1], -edge[:, 0]], axis=1))
    outward *= -np.sign((outward * (hull.mean(0) - hull)).sum(1))[:, None]
    off = uv @ outward.T - (outward * hull).sum(1)
    return off.max(1) <= around
