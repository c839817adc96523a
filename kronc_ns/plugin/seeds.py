"""Points for splatfacto to start from."""

import torch
from jaxtyping import Float, UInt8
from torch import Tensor


def seed_points(
    keypoints: Float[Tensor, "j 3"], box: Float[Tensor, "2 3"], count: int
) -> tuple[Float[Tensor, "p 3"], UInt8[Tensor, "p 3"]]:
    """The solved keypoints and ``count`` points drawn uniformly from the car's box, all mid-grey; always the same."""
    uniform = torch.rand(count, 3, dtype=box.dtype, generator=torch.Generator().manual_seed(0))
    points = torch.cat([keypoints, box[0] + uniform * (box[1] - box[0])])
    return points, torch.full(points.shape, 128, dtype=torch.uint8)
