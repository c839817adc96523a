"""The walk around the object: views between others, by smooth curves along the capture order."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from kronc_ns.geometry.poses import compose, invert, look_at, make_pose
from kronc_ns.geometry.rotations import so3_exp, so3_log

_FEWEST = 5  # solved views that make a walk
_STRIDE_DEG = 45.0  # neighbours farther apart than this are no walk
_REACH_DEG = 60.0  # widest gap that is bridged
_BEYOND = 3  # views before the first or after the last solved one that are placed


@dataclass(frozen=True)
class Interpolated:
    """Poses of views between others; NaN where the walk does not tell."""

    c2w: Float[np.ndarray, "n 3 4"]
    sigma_rot_deg: Float[np.ndarray, "n"]
    sigma_trans_m: Float[np.ndarray, "n"]


def interpolate_walk(c2w: Float[np.ndarray, "n 3 4"], known: Bool[np.ndarray, "n"]) -> Interpolated | None:
    """Poses of the unknown views of a walk about the z axis, by shape-preserving cubics along the capture order.

    None where the known views are no walk (too few, or not in order). Sigmas are what the same interpolation misses
    known views by, when they are left out with as many neighbours as the gap is wide.
    """
    if int(known.sum()) < _FEWEST or not _in_order(c2w[known]):
        return None
    every, at = np.arange(len(c2w)), np.flatnonzero(known)
    poses = _between(at.astype(float), c2w[known], every.astype(float))
    right = np.clip(np.searchsorted(at, every), 1, len(at) - 1)
    width = at[right] - at[right - 1]
    beyond = np.maximum(at[0] - every, every - at[-1])
    azimuth = _cylinder(c2w[known])[0]
    swept = np.rad2deg(np.abs(azimuth[right] - azimuth[right - 1]))
    missing = ~known & (swept <= _REACH_DEG) & (beyond <= _BEYOND)
    gap = np.where(beyond > 0, 2 * beyond + 1, width)
    sigma_rot, sigma_trans = np.full((2, len(c2w)), math.nan)
    for size in np.unique(gap[missing]).tolist():
        chosen = missing & (gap == size)
        sigma_rot[chosen], sigma_trans[chosen] = _leave_out_error(at.astype(float), c2w[known], size)
    poses[~(known | missing)] = math.nan
    return Interpolated(poses, sigma_rot, sigma_trans)


def _strides(c2w: Float[np.ndarray, "k 3 4"]) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "d"]]:
    """Azimuth of the camera centres, and the way around from each to the next."""
    azimuth = np.arctan2(c2w[:, 1, 3], c2w[:, 0, 3])
    return azimuth, (np.diff(azimuth) + math.pi) % (2 * math.pi) - math.pi


def _in_order(c2w: Float[np.ndarray, "k 3 4"]) -> bool:
    """Whether consecutive views are neighbours on the way around."""
    return float(np.quantile(np.rad2deg(np.abs(_strides(c2w)[1])), 0.9)) <= _STRIDE_DEG


def _cylinder(c2w: Float[np.ndarray, "k 3 4"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unwrapped azimuth, distance from the axis and height of the camera centres."""
    azimuth, stride = _strides(c2w)
    azimuth = np.concatenate([azimuth[:1], azimuth[0] + np.cumsum(stride)])
    return azimuth, np.linalg.norm(c2w[:, :2, 3], axis=-1), c2w[:, 2, 3]


def _facing(centre: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3 4"]:
    return look_at(centre, np.zeros_like(centre), np.array([0.0, 0.0, 1.0]))


def _between(
    index: Float[np.ndarray, "k"], c2w: Float[np.ndarray, "k 3 4"], wanted: Float[np.ndarray, "w"]
) -> Float[np.ndarray, "w 3 4"]:
    """Interpolated poses: azimuth, distance and height; and the turn away from facing the axis."""
    from scipy.interpolate import PchipInterpolator  # half a second of import that few captures need

    aim = so3_log(compose(invert(_facing(c2w[..., 3])), c2w)[..., :3])
    curves = np.concatenate([np.stack(_cylinder(c2w), axis=1), aim], axis=1)
    inside = np.clip(wanted, index[0], index[-1])
    values = PchipInterpolator(index, curves)(inside)
    slope = (curves[[1, -1], 0] - curves[[0, -2], 0]) / (index[[1, -1]] - index[[0, -2]])
    values[:, 0] += np.where(wanted < index[0], slope[0], slope[1]) * (wanted - inside)  # walking on
    azimuth, distance, height = values[:, :3].T
    centre = np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth), height], axis=1)
    return compose(_facing(centre), make_pose(so3_exp(values[:, 3:]), np.zeros_like(centre)))


def _leave_out_error(index: Float[np.ndarray, "k"], c2w: Float[np.ndarray, "k 3 4"], gap: int) -> tuple[float, float]:
    """Root mean square error (degrees, metres) at the middle of a bridged gap ``gap`` indices wide."""
    rotation, distance = [], []
    hidden = max(1, min(gap - 1, len(index) - 3))
    for first in range(1, len(index) - hidden, max(1, (len(index) - hidden) // 8)):
        kept = np.ones(len(index), dtype=bool)
        kept[first : first + hidden] = False
        middle = first + hidden // 2
        guess = _between(index[kept], c2w[kept], index[middle : middle + 1])[0]
        rotation.append(float(np.linalg.norm(so3_log(guess[:, :3].T @ c2w[middle, :, :3]))))
        distance.append(float(np.linalg.norm(guess[:, 3] - c2w[middle, :, 3])))
    return math.degrees(_rms(rotation)), _rms(distance)


def _rms(values: list[float]) -> float:
    return math.sqrt(sum(value * value for value in values) / len(values)) if values else math.nan
