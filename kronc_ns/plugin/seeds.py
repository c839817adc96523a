"""Points for splatfacto to start from."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

_GREY = 128


@dataclass(frozen=True)
class Seeds:
    """Coloured points in the world."""

    points: Float[Tensor, "p 3"]
    colours: UInt8[Tensor, "p 3"]

    def __add__(self, other: "Seeds") -> "Seeds":
        return Seeds(torch.cat([self.points, other.points]), torch.cat([self.colours, other.colours]))


def grey(points: Float[Tensor, "p 3"]) -> Seeds:
    """Points whose colour is not known."""
    return Seeds(points, torch.full(points.shape, _GREY, dtype=torch.uint8))


def box_seeds(box: Float[Tensor, "2 3"], count: int) -> Seeds:
    """Points drawn uniformly from the car's box; always the same."""
    uniform = torch.rand(count, 3, dtype=box.dtype, generator=torch.Generator().manual_seed(0))
    return grey(box[0] + uniform * (box[1] - box[0]))


def ground_seeds(box: Float[Tensor, "2 3"], c2w: Float[Tensor, "n 3 4"], count: int) -> Seeds:
    """Points on the level of the box's underside, out to where the cameras stand; always the same."""
    generator = torch.Generator().manual_seed(1)
    middle = box.mean(0)
    reach = float((c2w[:, :2, 3] - middle[:2]).norm(dim=-1).max())
    radius, angle = torch.rand(2, count, dtype=box.dtype, generator=generator)
    radius, angle = reach * radius.sqrt(), 2 * math.pi * angle
    level = box[0, 2].expand(count)
    flat = torch.stack([middle[0] + radius * angle.cos(), middle[1] + radius * angle.sin(), level], dim=1)
    return grey(flat)
