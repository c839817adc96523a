"""Poses that are found while the field trains: one twist a camera (BARF), or many local ones fitted (L2G-NeRF).

Both are nerfstudio camera optimisers, so whatever nerfstudio does with refined poses it does with these. Motions are
those of the world before a camera, about its origin, where dataparsers put the object: turning an object and moving it
look less alike than turning a camera and moving it.
"""

from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float, Int
from nerfstudio.cameras.camera_optimizers import CameraOptimizer, CameraOptimizerConfig
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor, nn

from kronc_ns.plugin.barf.field import Perceptron
from kronc_ns.plugin.barf.rigid import rigid_fit, rotate, se3_exp, transform


@dataclass
class GlobalPosesConfig(CameraOptimizerConfig):
    """Poses as in BARF: a twist in se(3) for each camera. Any mode but off is this one; penalties have no effect."""

    _target: type = field(default_factory=lambda: GlobalPoses)


class GlobalPoses(CameraOptimizer):
    """A rigid motion for each camera's start, which `begin_at` tells."""

    config: GlobalPosesConfig
    starts: Tensor
    unit: Tensor

    def __init__(self, config: GlobalPosesConfig, num_cameras: int, device: torch.device | str, **kwargs: Any) -> None:
        super().__init__(config, num_cameras, device, **kwargs)
        self.register_buffer("starts", torch.eye(4)[:3].repeat(num_cameras, 1, 1))
        self.register_buffer("unit", torch.ones(()))

    def begin_at(self, cameras: Cameras, unit: float) -> None:
        """The poses to begin at, and the size that counts as 1 in a twist."""
        self.starts.copy_(cameras.camera_to_worlds)
        self.unit.fill_(unit)

    def motions(self) -> Float[Tensor, "c 3 4"]:
        """World-from-world motions of all cameras, lengths in units."""
        return se3_exp(self.pose_adjustment)

    def poses(self) -> Float[Tensor, "c 3 4"]:
        """c2w of all cameras as they are now."""
        if self.config.mode == "off":
            return self.starts
        moved = self.motions()
        centres = transform(moved, self.starts[..., 3] / self.unit) * self.unit
        return torch.cat([moved[..., :3] @ self.starts[..., :3], centres[..., None]], dim=-1)

    def forward(self, indices: Int[Tensor, "*n"]) -> Float[Tensor, "*n 3 4"]:
        """nerfstudio's corrections: what to turn a camera by and, apart from that, what to add to its centre."""
        if self.config.mode == "off":
            return super().forward(indices)
        starts = self.starts
        moved = self.motions()
        shift = transform(moved, starts[..., 3] / self.unit) * self.unit - starts[..., 3]
        return torch.cat([moved[..., :3], shift[..., None]], dim=-1)[indices.to(starts.device)]

    def get_loss_dict(self, loss_dict: dict[str, Tensor]) -> None:
        """Nothing: neither paper holds poses back."""

    def get_metrics_dict(self, metrics_dict: dict[str, Any]) -> None:
        """How far cameras have come from their starts."""
        if self.config.mode == "off":
            return
        with torch.no_grad():
            moved = self(torch.arange(self.num_cameras))
        trace = moved[:, 0, 0] + moved[:, 1, 1] + moved[:, 2, 2]
        metrics_dict["pose_rotation_mean_deg"] = torch.rad2deg(torch.acos(((trace - 1) / 2).clamp(-1, 1))).mean()
        metrics_dict["pose_translation_mean"] = moved[..., 3].norm(dim=-1).mean()


@dataclass
class LocalToGlobalPosesConfig(GlobalPosesConfig):
    """Poses as in L2G-NeRF: every ray is moved by itself, and a camera by what fits its rays best."""

    _target: type = field(default_factory=lambda: LocalToGlobalPoses)
    alignment_weight: float = 100.0
    """Weight (lambda) of the squared distances between rays moved by themselves and with their camera."""
    warp_depth: int = 6
    """Layers of the network that moves rays."""
    warp_width: int = 256
    """Their width."""
    code_size: int = 128
    """Length of the code of each camera."""
    fit_points: int = 5
    """Rays across and down an image that a camera's pose is fitted to."""


class LocalToGlobalPoses(GlobalPoses):
    """Local motions from a network of image coordinates and a code of the camera; global ones fitted to them.

    The paper fits a camera to the rays that a step happens to draw. Here it is a fixed grid of rays, so that few rays
    a camera do as well, and a pose does not depend on the draw.
    """

    config: LocalToGlobalPosesConfig
    tangents: Tensor

    def __init__(
        self, config: LocalToGlobalPosesConfig, num_cameras: int, device: torch.device | str, **kwargs: Any
    ) -> None:
        super().__init__(config, num_cameras, device, **kwargs)
        self.register_buffer("tangents", torch.ones(num_cameras, 2))
        self._alignment: Tensor | None = None
        if config.mode != "off":
            del self.pose_adjustment
            self.warp = WarpNetwork(num_cameras, config.warp_depth, config.warp_width, config.code_size)

    def begin_at(self, cameras: Cameras, unit: float) -> None:
        """Also the half widths and heights of the images at distance 1."""
        super().begin_at(cameras, unit)
        half = torch.cat([cameras.width / cameras.fx, cameras.height / cameras.fy], dim=-1) / 2
        self.tangents.copy_(half)

    def motions(self) -> Float[Tensor, "c 3 4"]:
        """Of all cameras: the rigid motions that fit their grids of rays."""
        across = torch.linspace(-0.9, 0.9, self.config.fit_points, device=self.starts.device)
        grid = torch.stack(torch.meshgrid(across, across, indexing="xy"), dim=-1).reshape(-1, 2)
        every = grid.expand(self.num_cameras, *grid.shape)
        plane = torch.cat([every * self.tangents[:, None], -torch.ones_like(every[..., :1])], dim=-1)
        directions = rotate(self.starts[:, None], plane)
        source = self._ray_points(self.starts[:, None, :, 3].expand_as(directions), directions)
        local = self.warp(every, torch.arange(self.num_cameras, device=grid.device)[:, None].expand(every.shape[:-1]))
        target = transform(local[..., None, :, :], source)
        rotation, translation = rigid_fit(source.flatten(1, 2), target.flatten(1, 2))
        return torch.cat([rotation, translation[..., None]], dim=-1)

    def apply_to_raybundle(self, raybundle: RayBundle) -> None:
        """Move every ray by itself, and note how far that is from where its camera would move it."""
        if self.config.mode == "off":
            return
        assert raybundle.camera_indices is not None
        index = raybundle.camera_indices[..., 0]
        starts = self.starts[index]
        looking = rotate(starts[..., :3].mT, raybundle.directions)
        where = looking[..., :2] / (-looking[..., 2:]).clamp(min=1e-6) / self.tangents[index]
        local = self.warp(where, index)
        source = self._ray_points(raybundle.origins, raybundle.directions)
        with_camera = transform(self.motions()[index][..., None, :, :], source)
        by_itself = transform(local[..., None, :, :], source)
        self._alignment = (by_itself - with_camera).square().sum(-1).mean()
        raybundle.directions = rotate(local, raybundle.directions)
        raybundle.origins = transform(local, raybundle.origins / self.unit) * self.unit

    def get_loss_dict(self, loss_dict: dict[str, Tensor]) -> None:
        """The alignment term of the last rays (L2G-NeRF's second objective)."""
        if self.config.mode != "off" and self._alignment is not None:
            loss_dict["alignment_loss"] = self.config.alignment_weight * self._alignment

    def _ray_points(self, origins: Float[Tensor, "*n 3"], directions: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 2 3"]:
        """What is known of a ray: where it begins and where it is about as far as the world's origin; in units."""
        distance = origins.norm(dim=-1, keepdim=True)
        ends = origins + directions / directions.norm(dim=-1, keepdim=True) * distance
        return torch.stack([origins, ends], dim=-2) / self.unit


class WarpNetwork(nn.Module):
    """Motions of single rays: identity at first."""

    def __init__(self, frames: int, depth: int, width: int, code_size: int, inputs: int = 2, freedom: int = 6) -> None:
        super().__init__()
        # of such a length that cameras share little of the network: what moves one would move all
        self.codes = nn.Parameter(torch.randn(frames, code_size))
        self.hidden = Perceptron(inputs + code_size, width, depth)
        self.last = nn.Linear(width, freedom)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def twists(self, where: Float[Tensor, "*n i"], frame: Int[Tensor, "*n"]) -> Float[Tensor, "*n f"]:
        """The twist of each ray by its image coordinates (about -1 to 1) and its frame."""
        return self.last(self.hidden(torch.cat([where, self.codes[frame]], dim=-1)))

    def forward(self, where: Float[Tensor, "*n i"], frame: Int[Tensor, "*n"]) -> Float[Tensor, "*n 3 4"]:
        """Their rigid motions."""
        return se3_exp(self.twists(where, frame))
