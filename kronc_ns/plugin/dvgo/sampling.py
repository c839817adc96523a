"""Samples along rays, packed: only those inside the box and outside known free space are kept."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from nerfstudio.cameras.rays import Frustums, RayBundle, RaySamples
from torch import Tensor

from kronc_ns.plugin.dvgo.grid import UnknownSpace


@dataclass(frozen=True)
class PackedSamples:
    """N samples of R rays, ordered by ray and distance."""

    samples: RaySamples
    """The samples, [N]."""
    rays: Int[Tensor, "n"]
    """Index of a sample's ray."""
    slots: Int[Tensor, "n"]
    """Number of a sample along its ray, skipped ones counted."""
    num_rays: int
    """R."""
    num_slots: int
    """K, the most samples of any ray."""

    def along_rays(self, values: Float[Tensor, "n"]) -> Float[Tensor, "r k"]:
        """Values of the samples in one row a ray, 0 where samples were skipped."""
        dense = values.new_zeros(self.num_rays, self.num_slots)
        return dense.index_put((self.rays, self.slots), values)


def ray_box(
    origins: Float[Tensor, "r 3"], directions: Float[Tensor, "r 3"], aabb: Float[Tensor, "2 3"]
) -> tuple[Float[Tensor, "r"], Float[Tensor, "r"]]:
    """Distances at which rays enter and leave a box; rays that miss it leave before they enter."""
    tiny = torch.full_like(directions, 1e-9)
    inverse = 1 / torch.where(directions.abs() < 1e-9, tiny, directions)
    ends = (aabb[:, None] - origins) * inverse
    return ends.amin(0).amax(-1), ends.amax(0).amin(-1)


@torch.no_grad()
def _distances(
    rays: RayBundle, aabb: Float[Tensor, "2 3"], step: float, jitter: bool
) -> tuple[Float[Tensor, "r k"], Float[Tensor, "r 1"]]:
    near, far = ray_box(rays.origins, rays.directions, aabb)
    near = near.clamp(min=0) if rays.nears is None else torch.maximum(near, rays.nears[:, 0])
    far = far if rays.fars is None else torch.minimum(far, rays.fars[:, 0])
    # rays of a camera that is NaN miss everything: what made it so is for the losses to tell
    steps = int(((far - near) / step).clamp(min=0).nan_to_num().max().ceil()) if len(near) else 0
    offset = torch.rand_like(near) if jitter else torch.full_like(near, 0.5)
    count = torch.arange(steps, device=near.device)
    return near[:, None] + (count + offset[:, None]) * step, far[:, None]


def sample_rays(
    rays: RayBundle, aabb: Float[Tensor, "2 3"], step: float, unknown: UnknownSpace | None, jitter: bool
) -> PackedSamples:
    """Samples every ``step`` along ``rays`` in a box (equation 8), less those in known free space.

    With ``jitter`` all samples of a ray move together by less than a step, so that training sees all distances.
    """
    distances, far = _distances(rays, aabb, step, jitter)
    keep = distances < far
    if unknown is not None:
        points = rays.origins[:, None] + rays.directions[:, None] * distances[..., None]
        keep &= unknown(points.detach())
    ray, slot = keep.nonzero(as_tuple=True)
    middle = distances[ray, slot][:, None]
    frustums = Frustums(
        origins=rays.origins[ray],
        directions=rays.directions[ray],
        starts=middle - step / 2,
        ends=middle + step / 2,
        pixel_area=rays.pixel_area[ray],
    )
    samples = RaySamples(frustums=frustums, deltas=torch.full_like(middle, step))
    return PackedSamples(samples, ray, slot, len(rays), distances.shape[1])
