"""3D Gaussians to the image plane."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

_GUARD = 0.3  # of half the field of view: the affine approximation is not followed further out
_SIGMAS = 3.0  # reach of a Gaussian on the image


class Projected(NamedTuple):
    """Gaussians on the image plane of each camera."""

    radii: Int[Tensor, "c n"]
    """Three standard deviations along the longest axis, px; 0 for those that are not seen."""
    means2d: Float[Tensor, "c n 2"]
    """Centres, px; the centre of the top-left pixel is (0.5, 0.5)."""
    depths: Float[Tensor, "c n"]
    """z-depth."""
    conics: Float[Tensor, "c n 3"]
    """Inverse covariance on the image: xx, xy, yy, 1/px^2."""
    compensations: Float[Tensor, "c n"]
    """sqrt(det / det blurred): what the blur by ``eps2d`` adds to the area of a Gaussian (Mip-Splatting)."""


def covariances(quats: Float[Tensor, "n 4"], scales: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 3"]:
    """Sigma = R S S^T R^T (Kerbl et al. 2023, equation 6); quaternions (w, x, y, z) of any length."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    factors = torch.stack(rows, dim=-1).reshape(-1, 3, 3) * scales[:, None, :]
    return factors @ factors.transpose(1, 2)


def project(
    means: Float[Tensor, "n 3"],
    covars: Float[Tensor, "n 3 3"],
    viewmats: Float[Tensor, "c 4 4"],
    intrinsics: Float[Tensor, "c 3 3"],
    width: int,
    height: int,
    eps2d: float,
    near: float,
    far: float,
    radius_clip: float = 0.0,
) -> Projected:
    """Project Gaussians by pinhole cameras ``viewmats`` (w2c).

    Sigma' = J W Sigma W^T J^T (Kerbl et al. 2023, equation 5; EWA splatting, Zwicker et al. 2001) with J the Jacobian
    of the projection at the centre, and ``eps2d`` px^2 of blur on its diagonal. Gaussians whose depth is not between
    ``near`` and ``far``, whose square of half-edge radius misses the image, or whose radius is not above
    ``radius_clip`` px get radius 0.
    """
    rotation, translation = viewmats[:, :3, :3], viewmats[:, None, :3, 3]
    x, y, z = (means @ rotation.transpose(1, 2) + translation).unbind(-1)
    fx, fy = intrinsics[:, 0, 0, None], intrinsics[:, 1, 1, None]
    cx, cy = intrinsics[:, 0, 2, None], intrinsics[:, 1, 2, None]
    depths, z = z, torch.where(z > near, z, 1.0)  # those behind are not seen; no division by zero on their way
    tan_x, tan_y = x / z, y / z
    means2d = torch.stack([fx * tan_x + intrinsics[:, 0, 1, None] * tan_y + cx, fy * tan_y + cy], dim=-1)

    guard_x, guard_y = _GUARD * 0.5 * width / fx, _GUARD * 0.5 * height / fy
    tan_x = tan_x.clamp(-cx / fx - guard_x, (width - cx) / fx + guard_x)
    tan_y = tan_y.clamp(-cy / fy - guard_y, (height - cy) / fy + guard_y)
    # rows of J W, then of J W Sigma
    along_x = (fx / z)[..., None] * (rotation[:, None, 0] - tan_x[..., None] * rotation[:, None, 2])
    along_y = (fy / z)[..., None] * (rotation[:, None, 1] - tan_y[..., None] * rotation[:, None, 2])
    spread_x = (along_x[..., :, None] * covars).sum(-2)
    spread_y = (along_y[..., :, None] * covars).sum(-2)
    xx, xy, yy = (along_x * spread_x).sum(-1), (along_x * spread_y).sum(-1), (along_y * spread_y).sum(-1)
    sharp = xx * yy - xy * xy
    xx, yy = xx + eps2d, yy + eps2d
    determinant = (xx * yy - xy * xy).clamp(min=1e-10)
    conics = torch.stack([yy, -xy, xx], dim=-1) / determinant[..., None]

    with torch.no_grad():
        half_trace = (xx + yy) / 2
        longest = half_trace + (half_trace * half_trace - determinant).clamp(min=0.01).sqrt()
        radius = torch.ceil(_SIGMAS * longest.sqrt())
        u, v = means2d.unbind(-1)
        seen = (depths > near) & (depths < far) & (radius > radius_clip)  # a NaN anywhere makes these false
        seen &= (u + radius > 0) & (u - radius < width) & (v + radius > 0) & (v - radius < height)
        radii = torch.where(seen, radius, 0.0).int()
    # not from 0, where the slope of the root is infinite; such a Gaussian is too faint to be drawn
    return Projected(radii, means2d, depths, conics, (sharp / determinant).clamp(min=1e-12).sqrt())
