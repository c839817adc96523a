"""Views without usable keypoints, placed on the smooth walk between their neighbours."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from kronc_ns.geometry.poses import compose, invert, look_at, make_pose
from kronc_ns.geometry.rotations import so3_exp, so3_log

_FEWEST = 5  # solved views that make a walk
_STRIDE_DEG = 45.0  # neighbours farther apart than this are no walk
_REACH_DEG = 60.0  # widest gap that is bridged
_BEYOND = 3  # views before the first or after the last solved one that are placed


@dataclass(frozen=True)
class Interpolated:
    """Poses of views between others; NaN where the walk does not tell."""

    c2w: Float[Tensor, "n 3 4"]
    sigma_rot_deg: Float[Tensor, "n"]
    sigma_trans_m: Float[Tensor, "n"]


def interpolate_walk(c2w: Float[Tensor, "n 3 4"], known: Bool[Tensor, "n"]) -> Interpolated | None:
    """Poses of the unknown views of a walk about the z axis, by shape-preserving cubics along the capture order.

    None where the known views are no walk (too few, or not in order). Sigmas are what the same interpolation misses
    known views by, when they are left out with as many neighbours as the gap is wide.
    """
    if int(known.sum()) < _FEWEST or not _in_order(c2w[known]):
        return None
    index = torch.arange(len(c2w), dtype=torch.float64)
    poses = _between(index[known], c2w[known], index)
    at = known.nonzero()[:, 0]
    right = torch.searchsorted(at, torch.arange(len(c2w))).clamp(1, len(at) - 1)
    width = at[right] - at[right - 1]
    beyond = torch.maximum(at[0] - torch.arange(len(c2w)), torch.arange(len(c2w)) - at[-1])
    azimuth = _cylinder(c2w[known])[0]
    swept = (azimuth[right] - azimuth[right - 1]).abs().rad2deg()
    reached = (swept <= _REACH_DEG) & (beyond <= _BEYOND)
    sigma_rot, sigma_trans = torch.full((2, len(c2w)), math.nan, dtype=torch.float64)
    for gap in torch.where(beyond > 0, 2 * beyond + 1, width)[~known & reached].unique().tolist():
        chosen = ~known & reached & (torch.where(beyond > 0, 2 * beyond + 1, width) == gap)
        sigma_rot[chosen], sigma_trans[chosen] = _leave_out_error(index[known], c2w[known], int(gap))
    poses[~reached] = math.nan
    return Interpolated(poses, sigma_rot, sigma_trans)


def _in_order(c2w: Float[Tensor, "k 3 4"]) -> bool:
    """Whether consecutive views are neighbours on the way around."""
    azimuth = torch.atan2(c2w[:, 1, 3], c2w[:, 0, 3])
    stride = (azimuth.diff() + math.pi).remainder(2 * math.pi) - math.pi
    return float(stride.abs().rad2deg().quantile(0.9)) <= _STRIDE_DEG


def _cylinder(c2w: Float[Tensor, "k 3 4"]) -> tuple[Tensor, Tensor, Tensor]:
    """Unwrapped azimuth, distance from the axis and height of the camera centres."""
    azimuth = torch.atan2(c2w[:, 1, 3], c2w[:, 0, 3])
    stride = (azimuth.diff() + math.pi).remainder(2 * math.pi) - math.pi
    azimuth = torch.cat([azimuth[:1], azimuth[0] + stride.cumsum(0)])
    return azimuth, c2w[:, :2, 3].norm(dim=-1), c2w[:, 2, 3]


def _facing(centre: Float[Tensor, "k 3"]) -> Float[Tensor, "k 3 4"]:
    up = torch.tensor([0.0, 0.0, 1.0], dtype=centre.dtype)
    return look_at(centre, torch.zeros_like(centre), up)


def _between(
    index: Float[Tensor, "k"], c2w: Float[Tensor, "k 3 4"], wanted: Float[Tensor, "w"]
) -> Float[Tensor, "w 3 4"]:
    """Interpolated poses: azimuth, distance and height; and the turn away from facing the axis."""
    from scipy.interpolate import PchipInterpolator  # half a second of import that few captures need

    aim = so3_log(compose(invert(_facing(c2w[..., 3])), c2w)[..., :3])
    curves = torch.cat([torch.stack(_cylinder(c2w), dim=1), aim], dim=1)
    inside = wanted.clamp(index[0], index[-1])
    values = torch.from_numpy(PchipInterpolator(index.numpy(), curves.numpy())(inside.numpy()))
    slope = (curves[[1, -1], 0] - curves[[0, -2], 0]) / (index[[1, -1]] - index[[0, -2]])
    values[:, 0] += torch.where(wanted < index[0], slope[0], slope[1]) * (wanted - inside)  # walking on
    azimuth, distance, height = values[:, :3].unbind(1)
    centre = torch.stack([distance * azimuth.cos(), distance * azimuth.sin(), height], dim=1)
    return compose(_facing(centre), make_pose(so3_exp(values[:, 3:]), torch.zeros_like(centre)))


def _leave_out_error(index: Float[Tensor, "k"], c2w: Float[Tensor, "k 3 4"], gap: int) -> tuple[float, float]:
    """Root mean square error (degrees, metres) at the middle of a bridged gap ``gap`` indices wide."""
    rotation, distance = [], []
    hidden = max(1, min(gap - 1, len(index) - 3))
    for first in range(1, len(index) - hidden, max(1, (len(index) - hidden) // 8)):
        kept = torch.ones(len(index), dtype=torch.bool)
        kept[first : first + hidden] = False
        middle = first + hidden // 2
        guess = _between(index[kept], c2w[kept], index[middle : middle + 1])[0]
        rotation.append(so3_log(guess[:, :3].T @ c2w[middle, :, :3]).norm())
        distance.append((guess[:, 3] - c2w[middle, :, 3]).norm())
    return (
        math.degrees(float(torch.stack(rotation).square().mean().sqrt())),
        float(torch.stack(distance).square().mean().sqrt()),
    )
