"""What the network is asked: where each visible point is, whether it is visible, which cells are the car.

All three are proper scoring rules, so that the answers are probabilities.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from kronc_ns.training.network import STRIDE, Answer

_SPREAD = 0.9  # cells: standard deviation of the target around each point
_VISIBLE_WEIGHT, _MASK_WEIGHT = 1.0, 1.0


class Loss(NamedTuple):
    """Means over the batch."""

    total: Tensor
    place: Tensor
    """Cross-entropy of the places in nats, less the least possible."""
    visible: Tensor
    mask: Tensor


def loss(answer: Answer, keypoints: Float[Tensor, "b 66 3"], mask: Float[Tensor, "b h w"]) -> Loss:
    """Of a batch; ``keypoints`` are (u, v, state) in input pixels, ``mask`` is the car's share of each cell."""
    state = keypoints[..., 2]
    seen = (state == 1).float()
    along_y, along_x = (_target(keypoints[..., axis], answer.heat.shape[axis_of]) for axis, axis_of in ((1, 2), (0, 3)))
    # the target is separable, so that it needs no map of its own
    inner = torch.einsum("bjyx,bjx->bjy", answer.heat, along_x)
    entropy = -sum((t * t.clamp_min(1e-12).log()).sum(-1) for t in (along_x, along_y))
    place = (-(inner * along_y).sum(-1) - entropy) * seen
    place = place.sum() / seen.sum().clamp_min(1)
    known = (state > 0).float()
    visible = F.binary_cross_entropy_with_logits(answer.visible, seen, reduction="none") * known
    visible = visible.sum() / known.sum().clamp_min(1)
    car = F.binary_cross_entropy_with_logits(answer.mask, mask)
    return Loss(place + _VISIBLE_WEIGHT * visible + _MASK_WEIGHT * car, place, visible, car)


def _target(at: Float[Tensor, "b j"], cells: int) -> Float[Tensor, "b j n"]:
    """A normal distribution over the cells of one axis, around pixels."""
    centres = (torch.arange(cells, dtype=at.dtype, device=at.device) + 0.5) * STRIDE
    return (-0.5 * ((at[..., None] - centres) / (_SPREAD * STRIDE)) ** 2).softmax(-1)
