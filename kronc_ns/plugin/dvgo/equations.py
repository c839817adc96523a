"""The paper's equations as pure functions. K samples a ray, R rays; lengths in whatever unit the caller counts in."""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor


def density_bias(alpha_init: float) -> float:
    """The bias b at which raw density 0 has ``alpha_init`` over one voxel (equation 9 with s = 1).

    (1 - alpha)^(-1/s) - 1 is written with expm1 and log1p, which hold at 1e-6 in any precision.
    """
    return math.log(math.expm1(-math.log1p(-alpha_init)))


def density(raw: Float[Tensor, "*n"], bias: float) -> Float[Tensor, "*n"]:
    """Density per unit of length from raw density: the shifted softplus (equation 5)."""
    return F.softplus(raw + bias)


def alpha(density: Float[Tensor, "*n"], delta: Float[Tensor, "*n"] | float) -> Float[Tensor, "*n"]:
    """Probability that a ray ends within ``delta`` (equation 2b); taken after interpolation (equation 6c)."""
    return -torch.expm1(-density * delta)


def render_weights(optical: Float[Tensor, "r k"]) -> tuple[Float[Tensor, "r k"], Float[Tensor, "r"]]:
    """Weights T_i alpha_i of the samples and T_{K+1}, what of the background is seen (equations 2a to 2c).

    ``optical`` is density times delta, of which 1 - alpha = exp(-optical): transmittance is the exponential of a sum,
    whose gradient is finite where an alpha is 1.
    """
    passed = optical.cumsum(dim=-1)
    weights = torch.exp(optical - passed) * -torch.expm1(-optical)
    return weights, torch.exp(-optical.sum(dim=-1))


def background_entropy(background: Float[Tensor, "r"]) -> Float[Tensor, ""]:
    """Mean entropy of T_{K+1}, which is 0 where rays see all or nothing of the background (section 5.1)."""
    seen = background.clamp(1e-6, 1 - 1e-6)
    return -(seen * seen.log() + (1 - seen) * (1 - seen).log()).mean()


def total_variation(values: Float[Tensor, "x y z c"]) -> Float[Tensor, ""]:
    """Mean squared difference of neighbouring grid points, summed over the three axes."""
    return torch.stack([values.diff(dim=axis).square().mean() for axis in range(3)]).sum()


def grid_shape(aabb: Float[Tensor, "2 3"], voxels: int) -> tuple[int, int, int]:
    """Points along each axis of a grid of about ``voxels`` cubic voxels in a box (section 5.1)."""
    size = (aabb[1] - aabb[0]).double()
    x, y, z = (size / (size.prod() / voxels) ** (1 / 3) + 1e-6).floor().long().clamp(min=2).tolist()
    return x, y, z


def occupied_box(
    occupied: Bool[Tensor, "x y z"], aabb: Float[Tensor, "2 3"], margin: int = 1
) -> Float[Tensor, "2 3"] | None:
    """The smallest box around the occupied points of a grid over ``aabb``, ``margin`` voxels wider; None if empty."""
    indices = occupied.nonzero()
    if not len(indices):
        return None
    last = torch.tensor(occupied.shape, device=aabb.device) - 1
    low = (indices.amin(0) - margin).clamp(min=0)
    high = torch.minimum(indices.amax(0) + margin, last)
    return aabb[0] + torch.stack([low, high]) / last * (aabb[1] - aabb[0])
