"""The planar experiment of both papers: patches of one image whose places are found while a network learns the image.

Patches are cut out at unknown places, turned or under homographies. All begin where the first one is, whose place is
known.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from kronc_ns.plugin.barf.cameras import WarpNetwork
from kronc_ns.plugin.barf.encoding import encode, encoded_size, frequency_weights, schedule
from kronc_ns.plugin.barf.field import Perceptron
from kronc_ns.plugin.barf.rigid import rigid_fit

FREQUENCIES, PIXELS = 8, 300
PATCH = 90
"""Pixels along the side of a patch; coordinates of its pixels are within [-0.5, 0.5]."""


@dataclass(frozen=True)
class Aligned:
    """Mean distance of the patches' corners from where they belong, in pixels."""

    before_px: float
    after_px: float


def picture(seed: int, size: int = 256) -> Tensor:
    """An image with as much of each octave of detail, from an eighth of its size on, [3, size, size]."""
    rng = np.random.default_rng(seed)
    image = torch.zeros(1, 3, size, size)
    for octave in range(3, 7):
        noise = torch.from_numpy(rng.normal(size=(1, 3, 2**octave, 2**octave))).float()
        image += F.interpolate(noise, size=(size, size), mode="bicubic", align_corners=False)
    return ((image - image.mean()) / image.std() * 0.2 + 0.5).clamp(0, 1)[0]


def homographies(p: Tensor) -> Tensor:
    """exp of sl(3), [n, 3, 3], of [n, 8] (BARF, section 4.1)."""
    a, b, c, d, e, f, g, h = p.unbind(-1)
    generator = torch.stack([a, b, c, d, e - a, f, g, h, -e], dim=-1).unflatten(-1, (3, 3))
    return torch.matrix_exp(generator)


def rigid(p: Tensor) -> Tensor:
    """Turn by an angle and shift, [n, 3, 3], of [n, 3]."""
    angle, x, y = p.unbind(-1)
    zero, one = torch.zeros_like(angle), torch.ones_like(angle)
    rows = [angle.cos(), -angle.sin(), x, angle.sin(), angle.cos(), y, zero, zero, one]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def warp(matrices: Tensor, points: Tensor) -> Tensor:
    """Points [n, p, 2] under matrices [n, 3, 3] or [n, p, 3, 3]."""
    homogeneous = torch.cat([points, torch.ones_like(points[..., :1])], dim=-1)
    per_point = matrices if matrices.dim() == 4 else matrices[:, None]
    moved = (per_point * homogeneous[..., None, :]).sum(-1)
    return moved[..., :2] / moved[..., 2:]


def align(
    method: Literal["barf", "l2g", "plain"],
    motion: Literal["rigid", "homography"] = "rigid",
    steps: int = 1500,
    seed: int = 0,
    patches: int = 5,
) -> Aligned:
    """Learn the image and the places of its patches; ``plain`` is BARF with all frequencies from the start."""
    torch.manual_seed(seed)
    image, make = picture(seed), {"rigid": rigid, "homography": homographies}[motion]
    if motion == "rigid":
        true = torch.randn(patches, 3) * torch.tensor([0.3, 0.2, 0.2])
    else:
        true = torch.randn(patches, 8) * 0.08
    true[0] = 0
    truth = make(true)
    network = torch.nn.Sequential(Perceptron(encoded_size(2, FREQUENCIES), 64, 3), torch.nn.Linear(64, 3))
    places = torch.zeros(patches, true.shape[1], requires_grad=True)
    local = WarpNetwork(patches, depth=3, width=64, code_size=16, freedom=3)
    others = (torch.arange(patches) > 0).float()[:, None]
    moving = local.parameters() if method == "l2g" else [places]
    optimizer = torch.optim.Adam([{"params": network.parameters(), "lr": 5e-3}, {"params": moving, "lr": 3e-3}])
    decay = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.05 ** (1 / steps))

    def l2g(points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        frames = torch.arange(patches)[:, None].expand(points.shape[:-1])
        moved = warp(rigid(local.twists(2 * points, frames) * others[:, None]), points)
        rotation, shift = rigid_fit(points, moved)
        together = points @ rotation.mT + shift[:, None]
        return moved, together, (moved - together).square().sum(-1).mean()

    def place(points: Tensor) -> Tensor:
        return l2g(points)[1] if method == "l2g" else warp(make(places * others), points)

    for step in range(steps):
        points = torch.rand(patches, PIXELS, 2) - 0.5
        colours = look(image, warp(truth, points))
        moved, _, apart = l2g(points) if method == "l2g" else (place(points), None, torch.zeros(()))
        alpha = float(FREQUENCIES) if method == "plain" else schedule(step, 0, 2 * steps // 5, FREQUENCIES)
        predicted = network(encode(moved, frequency_weights(alpha, FREQUENCIES)))
        loss = (predicted.sigmoid() - colours).square().mean() + 100 * apart
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        decay.step()
    corners = torch.tensor([[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]]).expand(patches, 4, 2)
    grid = corners if method != "l2g" else torch.cat([corners, torch.rand(patches, 200, 2) - 0.5], dim=1)
    with torch.no_grad():
        found = place(grid)[:, :4]
    belong = warp(truth, corners)
    before, after = (PATCH * (x - belong).norm(dim=-1)[1:].mean() for x in (corners, found))
    return Aligned(float(before), float(after))


def look(image: Tensor, points: Tensor) -> Tensor:
    """Colours [n, p, 3] of an image that spans [-1, 1] at points [n, p, 2]."""
    return F.grid_sample(image[None], points[None], align_corners=False, padding_mode="reflection")[0].movedim(0, -1)
