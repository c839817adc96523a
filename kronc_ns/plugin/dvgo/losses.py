"""The losses of a stage beside the photometric one."""

from collections.abc import Mapping
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from kronc_ns.plugin.dvgo.equations import background_entropy, total_variation
from kronc_ns.plugin.dvgo.grid import VoxelGrid


@dataclass
class StageLosses:
    """Weights of the losses beside the photometric one, whose weight is 1."""

    point_colour: float
    """Of every sample's own colour against the pixel's (equation 10)."""
    background_entropy: float
    """Of the background's entropy: rays should see all of it or nothing."""
    total_variation: float = 0.0
    """Of the squared differences of neighbouring raw densities; an option, not in the paper."""


def beside_photometric(
    outputs: Mapping[str, Tensor], image: Float[Tensor, "r 3"], density: VoxelGrid, weight: StageLosses
) -> dict[str, Float[Tensor, ""]]:
    """Weighted losses of R rays that should be ``image``; ``outputs`` are the model's in training (equation 10)."""
    off = (outputs["point_rgb"] - image[outputs["point_rays"]]).square().sum(-1, keepdim=True)
    # weights held: the loss teaches colours, or it would be least where there is nothing at all
    point = (outputs["point_weights"].detach() * off).sum() / len(image)
    losses = {
        "point_rgb_loss": weight.point_colour * point,
        "background_entropy": weight.background_entropy * background_entropy(outputs["background"]),
    }
    if weight.total_variation:
        losses["total_variation"] = weight.total_variation * total_variation(density.at_nodes())
    return losses
