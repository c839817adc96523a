"""The radiance fields of the two stages: grids of raw density, with colours from a grid or from features and an MLP."""

import torch
from jaxtyping import Bool, Float
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.cameras.rays import RaySamples
from nerfstudio.field_components.encodings import NeRFEncoding
from nerfstudio.field_components.field_heads import FieldHeadNames
from nerfstudio.field_components.mlp import MLP
from nerfstudio.fields.base_field import Field
from torch import Tensor

from kronc_ns.plugin.dvgo import equations
from kronc_ns.plugin.dvgo.grid import RatedVoxelGrid, VoxelGrid


class DensityGridField(Field):
    """A field whose density comes from a post-activated voxel grid.

    Equations 5 and 9 count lengths in voxels of the stage's full resolution (``unit`` is the size of one in the
    world): neither the bias nor the learning rates depend on the unit of the scene, and the density in the world stays
    what it is when the grid grows.
    """

    density_grid: VoxelGrid
    unit: Tensor

    def __init__(self, density_grid: VoxelGrid, alpha_init: float) -> None:
        super().__init__()
        self.density_grid = density_grid
        self.bias = equations.density_bias(alpha_init)
        self.register_buffer("unit", torch.tensor(density_grid.voxel_size()))

    def get_density(self, ray_samples: RaySamples) -> tuple[Float[Tensor, "*n 1"], Float[Tensor, "*n 1"]]:
        """Density per unit of the world, and raw density."""
        positions = ray_samples.frustums.get_positions()
        raw = self.density_grid(positions.reshape(-1, 3)).reshape(*positions.shape[:-1], 1)
        return equations.density(raw, self.bias) / self.unit, raw

    @torch.no_grad()
    def alpha_at_nodes(self, step: float) -> Float[Tensor, "x y z"]:
        """Alpha of the grid's points over ``step`` voxels."""
        return equations.alpha(equations.density(self.density_grid.at_nodes()[..., 0], self.bias), step)


class CoarseField(DensityGridField):
    """Density and a colour that is the same from everywhere, each from a grid (section 5.1)."""

    density_grid: RatedVoxelGrid

    def __init__(self, aabb: Float[Tensor, "2 3"], voxels: int, alpha_init: float) -> None:
        shape = equations.grid_shape(aabb, voxels)
        super().__init__(RatedVoxelGrid(1, aabb, shape), alpha_init)
        self.colour_grid = VoxelGrid(3, aabb, shape)

    def get_outputs(
        self, ray_samples: RaySamples, density_embedding: Tensor | None = None
    ) -> dict[FieldHeadNames, Float[Tensor, "*n 3"]]:
        """Colours in 0..1."""
        positions = ray_samples.frustums.get_positions()
        colours = self.colour_grid(positions.reshape(-1, 3)).sigmoid()
        return {FieldHeadNames.RGB: colours.reshape(positions.shape)}

    def release(self) -> None:
        """Give the memory of the grids back."""
        self.density_grid.release()
        self.colour_grid.release()


class FineField(DensityGridField):
    """Density from a grid, colour from a grid of features and a shallow MLP that knows place and direction.

    Where nothing is known of the fine stage's box yet, it is a grid of eight points.
    """

    def __init__(
        self,
        aabb: Float[Tensor, "2 3"],
        alpha_init: float,
        channels: int = 12,
        width: int = 128,
        position_frequencies: int = 5,
        direction_frequencies: int = 4,
    ) -> None:
        super().__init__(VoxelGrid(1, aabb, (2, 2, 2)), alpha_init)
        self.feature_grid = VoxelGrid(channels, aabb, (2, 2, 2))
        self.encode_position = _encoding(position_frequencies)
        self.encode_direction = _encoding(direction_frequencies)
        inputs = channels + self.encode_position.get_out_dim() + self.encode_direction.get_out_dim()
        self.mlp = MLP(inputs, num_layers=3, layer_width=width, out_dim=3, out_activation=torch.nn.Sigmoid())

    def begin(self, aabb: Float[Tensor, "2 3"], voxels: int, full_voxels: int) -> None:
        """Start with ``voxels`` voxels in a box; ``full_voxels`` is what the grid will grow to."""
        for grid in (self.density_grid, self.feature_grid):
            grid.restart(aabb, equations.grid_shape(aabb, voxels))
        self.unit.copy_(((aabb[1] - aabb[0]).prod() / full_voxels) ** (1 / 3))

    def grow(self, voxels: int) -> bool:
        """Resample both grids to about ``voxels`` voxels; whether that changed them."""
        self.feature_grid.grow(voxels)
        return self.density_grid.grow(voxels)

    def get_outputs(
        self, ray_samples: RaySamples, density_embedding: Tensor | None = None
    ) -> dict[FieldHeadNames, Float[Tensor, "*n 3"]]:
        """Colours in 0..1: MLP(interp(x, V), x, d) with encoded x and d (section 5.2)."""
        positions = ray_samples.frustums.get_positions()
        if not positions.numel():  # nerfstudio's encodings fail at nothing
            return {FieldHeadNames.RGB: torch.zeros_like(positions)}
        points = positions.reshape(-1, 3)
        low, high = self.feature_grid.aabb
        directions = (ray_samples.frustums.directions.reshape(-1, 3) + 1) / 2
        encoded = self.encode_position((points - low) / (high - low)), self.encode_direction(directions)
        colours = self.mlp(torch.cat([self.feature_grid(points), *encoded], dim=-1))
        return {FieldHeadNames.RGB: colours.reshape(positions.shape)}


def _encoding(frequencies: int) -> NeRFEncoding:
    return NeRFEncoding(3, frequencies, min_freq_exp=0, max_freq_exp=frequencies - 1, include_input=True)


def view_rates(nodes: Float[Tensor, "*n 3"], cameras: Cameras) -> Float[Tensor, "*n"]:
    """Learning rates of grid points: the number of views that see one, relative to the best seen (section 5.1).

    Distortion is left out. Where no camera sees anything, and for cameras other than perspective ones, all are 1.
    """
    counts = torch.zeros(nodes.shape[:-1], device=nodes.device)
    for i in range(len(cameras)):
        if int(cameras.camera_type[i]) != CameraType.PERSPECTIVE.value:
            return torch.ones_like(counts)
        counts += _in_view(nodes, cameras[i].to(nodes.device))
    return counts / counts.max() if counts.max() > 0 else torch.ones_like(counts)


def _in_view(nodes: Float[Tensor, "*n 3"], camera: Cameras) -> Bool[Tensor, "*n"]:
    rotation, centre = camera.camera_to_worlds[:3, :3], camera.camera_to_worlds[:3, 3]
    x, y, z = ((nodes - centre) @ rotation).unbind(-1)  # OpenGL: the camera looks along -z, y is up
    depth = (-z).clamp(min=1e-9)
    u, v = camera.fx * x / depth + camera.cx, -camera.fy * y / depth + camera.cy
    return (z < 0) & (u >= 0) & (u <= camera.width) & (v >= 0) & (v <= camera.height)
