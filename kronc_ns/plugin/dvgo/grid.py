"""Dense voxel grids whose resolution and box change during training."""

from collections.abc import Mapping
from itertools import chain
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from kronc_ns.plugin.dvgo.equations import grid_shape


class Resizable(nn.Module):
    """A module whose tensors take the shapes they have in a checkpoint.

    The Parameter objects stay the same: the trainer has built its optimisers before it loads.
    """

    def _load_from_state_dict(self, state_dict: Mapping[str, Any], prefix: str, *args: Any, **kwargs: Any) -> None:
        for name, tensor in chain(self._parameters.items(), self._buffers.items()):
            saved = state_dict.get(prefix + name)
            if tensor is not None and saved is not None and tensor.shape != saved.shape:
                tensor.data = tensor.data.new_empty(saved.shape)
                tensor.grad = None
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)


class VoxelGrid(Resizable):
    """Values on the points of a grid that spans a box, zero at first and trilinear in between (equation 4)."""

    aabb: Tensor

    def __init__(self, channels: int, aabb: Float[Tensor, "2 3"], shape: tuple[int, int, int]) -> None:
        super().__init__()
        self.values = nn.Parameter(torch.zeros(*shape, channels))
        self.register_buffer("aabb", aabb.clone())

    def forward(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n c"]:
        """Interpolated values; points outside the box have those of its border."""
        return interpolate(self.at_nodes(), self.aabb, points)

    def at_nodes(self) -> Float[Tensor, "x y z c"]:
        """The values on the grid's points."""
        return self.values

    @property
    def shape(self) -> tuple[int, int, int]:
        """Points along x, y and z."""
        x, y, z, _ = self.values.shape
        return x, y, z

    @property
    def channels(self) -> int:
        """Values a point."""
        return self.values.shape[-1]

    def voxel_size(self) -> float:
        """Edge of a voxel, in the unit of the box."""
        return float(((self.aabb[1] - self.aabb[0]).prod() / self.values[..., 0].numel()) ** (1 / 3))

    def nodes(self) -> Float[Tensor, "x y z 3"]:
        """Positions of the grid's points."""
        axes = [torch.linspace(0, 1, n, device=self.aabb.device) for n in self.shape]
        unit = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
        return self.aabb[0] + unit * (self.aabb[1] - self.aabb[0])

    def restart(self, aabb: Float[Tensor, "2 3"], shape: tuple[int, int, int]) -> None:
        """Become a grid of zeros over another box."""
        self.aabb.copy_(aabb)
        self._replace(torch.zeros(*shape, self.channels, device=self.aabb.device))

    def grow(self, voxels: int) -> bool:
        """Resample to about ``voxels`` voxels over the same box; whether that changed the grid."""
        shape = grid_shape(self.aabb, voxels)
        if shape == self.shape:
            return False
        old = self.values.data.movedim(-1, 0)[None]
        new = F.interpolate(old, size=shape, mode="trilinear", align_corners=True)
        self._replace(new[0].movedim(0, -1).contiguous())
        return True

    def release(self) -> None:
        """Give the memory back: checkpoints of the fine stage need not hold the coarse grids."""
        self._replace(torch.zeros(0, 0, 0, self.channels, device=self.aabb.device))

    def _replace(self, values: Float[Tensor, "x y z c"]) -> None:
        # a new Parameter: autograd keeps the old one's shape for as long as any loss of it is alive
        self.values = nn.Parameter(values)


class RatedVoxelGrid(VoxelGrid):
    """A grid whose points learn at different rates, 1 at most.

    The value is rate times parameter: Adam's step does not depend on the gradient's scale, so a step of the parameter
    by lr is a step of the value by rate * lr.
    """

    rate: Tensor

    def __init__(self, channels: int, aabb: Float[Tensor, "2 3"], shape: tuple[int, int, int]) -> None:
        super().__init__(channels, aabb, shape)
        self.register_buffer("rate", torch.ones(*shape, 1))

    def at_nodes(self) -> Float[Tensor, "x y z c"]:
        """The values on the grid's points."""
        return self.values * self.rate

    def release(self) -> None:
        """Give the memory back."""
        super().release()
        self.rate = self.rate.new_zeros(0, 0, 0, 1)


class UnknownSpace(Resizable):
    """The space that the coarse stage did not find to be free: the points of its grid, and those around them."""

    aabb: Tensor
    unknown: Tensor

    def __init__(self, aabb: Float[Tensor, "2 3"]) -> None:
        super().__init__()
        self.register_buffer("aabb", aabb.clone())
        self.register_buffer("unknown", torch.ones(1, 1, 1, dtype=torch.bool))

    def mark(self, occupied: Bool[Tensor, "x y z"]) -> None:
        """Take over what is occupied, one voxel wider, since the nearest point is looked up."""
        wider = F.max_pool3d(occupied[None, None].float(), kernel_size=3, stride=1, padding=1)
        self.unknown = wider[0, 0] > 0

    def forward(self, points: Float[Tensor, "*n 3"]) -> Bool[Tensor, "*n"]:
        """Whether points inside the box lie in unknown space."""
        last = torch.tensor(self.unknown.shape, device=points.device) - 1
        unit = (points - self.aabb[0]) / (self.aabb[1] - self.aabb[0])
        x, y, z = (unit * last + 0.5).long().clamp(min=0).minimum(last).unbind(-1)
        return self.unknown[x, y, z]


def interpolate(
    values: Float[Tensor, "x y z c"], aabb: Float[Tensor, "2 3"], points: Float[Tensor, "n 3"]
) -> Float[Tensor, "n c"]:
    """interp(x, V) of equation 4: trilinear values at ``points`` of a grid that spans ``aabb``."""
    unit = (points - aabb[0]) / (aabb[1] - aabb[0])
    return sample_fused(values, unit) if values.is_cuda else sample_corners(values, unit)


def sample_fused(values: Float[Tensor, "x y z c"], unit: Float[Tensor, "n 3"]) -> Float[Tensor, "n c"]:
    """Trilinear values at ``unit`` (0..1 over the grid) by torch's kernel, which needs least memory."""
    where = (2 * unit - 1).flip(-1)  # it wants the coordinate of the last axis first
    grid, where = values.movedim(-1, 0)[None], where[None, :, None, None]
    return F.grid_sample(grid, where, padding_mode="border", align_corners=True)[0, :, :, 0, 0].T


def sample_corners(values: Float[Tensor, "x y z c"], unit: Float[Tensor, "n 3"]) -> Float[Tensor, "n c"]:
    """The same from the eight corners of each voxel: on the CPU four times as fast for many channels."""
    x, y, z, channels = values.shape
    last = torch.tensor([x, y, z], device=unit.device) - 1
    where = unit.clamp(0, 1) * last
    corner = where.detach().long().minimum(last - 1)
    part = where - corner
    first = (corner[:, 0] * y + corner[:, 1]) * z + corner[:, 2]
    offsets = [(i * y + j) * z + k for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    indices = first[:, None] + torch.tensor(offsets, device=unit.device)
    wx, wy, wz = torch.stack([1 - part, part], dim=-1).unbind(1)
    weights = (wx[:, :, None, None] * wy[:, None, :, None] * wz[:, None, None, :]).reshape(-1, 8, 1)
    corners = values.reshape(-1, channels).index_select(0, indices.reshape(-1))
    return (corners.reshape(-1, 8, channels) * weights).sum(1)
