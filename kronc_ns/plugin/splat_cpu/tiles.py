"""Which Gaussians fall on which tile, front to back."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

TILE = 16  # edge of a tile in pixels; gsplat's, so that a Gaussian is cut off where gsplat cuts it off


@dataclass(frozen=True)
class TileLists:
    """K pairs of a tile and a Gaussian on it; tiles and Gaussians are counted through all cameras."""

    gaussians: Int[np.ndarray, " k"]
    """The Gaussians of tile 0, then of tile 1, ..., each list front to back."""
    offsets: Int[np.ndarray, " t1"]
    """Where the list of each of the T tiles starts, and the end of the last: T + 1 numbers."""
    order: Int[np.ndarray, " m"]
    """All Gaussians front to back."""
    starts: Int[np.ndarray, " m1"]
    """The pairs of Gaussian ``order[i]`` are numbered ``starts[i]`` to ``starts[i + 1]``."""
    numbers: Int[np.ndarray, " k"]
    """The number, in that sense, of each pair in ``gaussians``."""
    across: int
    """Tiles in a row of the image."""

    def shares(self, count: int) -> list[Int[np.ndarray, " share"]]:
        """The tiles in ``count`` parts of about the same load."""
        heaviest_first = np.argsort(-np.diff(self.offsets), kind="stable")
        return [heaviest_first[part::count] for part in range(count)]


def tile_lists(
    means2d: Float[Tensor, "c n 2"],
    radii: Int[Tensor, "c n"],
    depths: Float[Tensor, "c n"],
    width: int,
    height: int,
) -> TileLists:
    """List each Gaussian on every tile that the square of half-edge ``radii`` (px, 0 = unseen) about it touches.

    Kerbl et al. 2023, section 6: one entry per tile and Gaussian, sorted by tile, then by depth. Two stable sorts,
    of the Gaussians by depth and of the entries by tile, do that without 64-bit keys.
    """
    cameras = means2d.shape[0]
    across, down = -(-width // TILE), -(-height // TILE)
    seen = radii > 0
    centre = torch.where(seen[..., None], means2d.detach(), 0) / TILE  # unseen ones may be NaN
    reach = (radii / TILE)[..., None]
    limit = torch.tensor([across, down])
    low = torch.floor(centre - reach).clamp(min=0).long().minimum(limit).reshape(-1, 2).numpy()
    high = torch.ceil(centre + reach).clamp(min=0).long().minimum(limit).reshape(-1, 2).numpy()
    order = np.argsort(depths.detach().reshape(-1).numpy(), kind="stable")
    low, span = low[order], ((high - low) * seen.reshape(-1, 1).numpy())[order]
    starts = np.concatenate([[0], np.cumsum(span[:, 0] * span[:, 1])])
    owner = np.repeat(np.arange(len(order)), np.diff(starts))
    within = np.arange(starts[-1]) - starts[owner]
    column, row = within % span[owner, 0] + low[owner, 0], within // span[owner, 0] + low[owner, 1]
    tile = (order // means2d.shape[1])[owner] * (across * down) + row * across + column
    by_tile = np.argsort(tile.astype(np.uint16) if cameras * across * down <= 1 << 16 else tile, kind="stable")
    counts = np.bincount(tile, minlength=cameras * across * down)
    return TileLists(
        gaussians=order[owner[by_tile]],
        offsets=np.concatenate([[0], np.cumsum(counts)]),
        order=order,
        starts=starts,
        numbers=by_tile,
        across=across,
    )
