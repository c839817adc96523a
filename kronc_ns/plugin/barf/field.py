"""The radiance field: NeRF's network on positions and directions that are encoded from coarse to fine."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from kronc_ns.plugin.barf.encoding import encode, encoded_size, frequency_weights, schedule


class Perceptron(nn.Module):
    """Layers of one width with ReLU; the input enters again at ``skip``, as in NeRF."""

    def __init__(self, inputs: int, width: int, depth: int, skip: int | None = None) -> None:
        super().__init__()
        self.skip = skip
        sizes = [inputs, *[width] * (depth - 1)]
        self.layers = nn.ModuleList(
            nn.Linear(size + (inputs if i == skip else 0), width) for i, size in enumerate(sizes)
        )

    def forward(self, x: Float[Tensor, "*n i"]) -> Float[Tensor, "*n w"]:
        """What the last layer gives."""
        hidden = x
        for i, layer in enumerate(self.layers):
            hidden = F.relu(layer(torch.cat([hidden, x], dim=-1) if i == self.skip else hidden))
        return hidden


class CoarseToFineField(nn.Module):
    """Density and colour at points whose object fills about [-1, 1]; both per unit of that size.

    ``direction_frequencies`` of None makes colours the same from everywhere.
    """

    def __init__(
        self,
        frequencies: int,
        direction_frequencies: int | None,
        depth: int,
        width: int,
        skip: int | None,
        switched_on: tuple[int, int],
    ) -> None:
        super().__init__()
        self.frequencies, self.direction_frequencies = frequencies, direction_frequencies
        self.switched_on = switched_on
        seen = 0 if direction_frequencies is None else encoded_size(3, direction_frequencies)
        self.trunk = Perceptron(encoded_size(3, frequencies), width, depth, skip)
        self.density = nn.Linear(width, 1)
        self.colour = nn.Sequential(nn.Linear(width + seen, width // 2), nn.ReLU(), nn.Linear(width // 2, 3))

    def forward(
        self, points: Float[Tensor, "*n 3"], directions: Float[Tensor, "*n 3"], step: int
    ) -> tuple[Float[Tensor, "*n"], Float[Tensor, "*n 3"]]:
        """Density (softplus, as BARF has it for stability) and colour in 0..1, with what is switched on at ``step``."""
        hidden = self.trunk(self._encoded(points, self.frequencies, step))
        density = F.softplus(self.density(hidden)[..., 0])
        if self.direction_frequencies is not None:
            hidden = torch.cat([hidden, self._encoded(directions, self.direction_frequencies, step)], dim=-1)
        return density, self.colour(hidden).sigmoid()

    def _encoded(self, x: Float[Tensor, "*n 3"], frequencies: int, step: int) -> Float[Tensor, "*n e"]:
        alpha = schedule(step, *self.switched_on, frequencies)
        return encode(x, frequency_weights(alpha, frequencies).to(x))
