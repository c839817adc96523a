"""Where the car's surface is, from masks alone: the visual hull, carved and coloured (Laurentini, PAMI 1994)."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from kronc_ns.geometry.camera import Camera, project
from kronc_ns.geometry.poses import invert, transform

_RESOLUTION = 96
"""Voxels along the box's longest side."""
_LONGER_SIDE_PX = 400  # images are carved at this size: a voxel is then about two pixels
_DISSENT = 0.05  # share of the views that may see background where the car is (masks and poses are not exact)
_FEWEST_VIEWS = 3  # a voxel that fewer views see is not known to be the car


@dataclass(frozen=True)
class Pictures:
    """Small copies of images and masks with their camera."""

    rgb: UInt8[np.ndarray, "n h w 3"]
    mask: Bool[np.ndarray, "n h w"]
    camera: Camera


def read_pictures(images: Sequence[Path], masks: Sequence[Path], camera: Camera) -> Pictures:
    """Read images and masks, reduced so that the longer side is at most 400 px, lens distortion taken out."""
    size = (camera.width, camera.height)
    small = camera.scaled(min(1.0, _LONGER_SIDE_PX / max(size)))
    to = (small.width, small.height)

    def undistorted(picture: np.ndarray, how: int) -> np.ndarray:
        reduced = cv2.resize(picture, to, interpolation=how)
        return cv2.undistort(reduced, small.matrix, np.array(small.distortion)) if any(small.distortion) else reduced

    rgb = [undistorted(cv2.imread(str(path))[..., ::-1], cv2.INTER_AREA) for path in images]
    mask = [undistorted(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), cv2.INTER_NEAREST) > 0 for path in masks]
    return Pictures(np.stack(rgb), np.stack(mask), small)


def carve(
    pictures: Pictures, c2w: Float[Tensor, "n 3 4"], box: Float[Tensor, "2 3"], count: int
) -> tuple[Float[Tensor, "p 3"], UInt8[Tensor, "p 3"]]:
    """At most ``count`` points on the surface of the visual hull inside ``box``, and their mean colours.

    A voxel is the car's where hardly any view that has it in its image sees background. Its colour is the mean over
    the views that see it first. No points where the masks leave nothing (empty masks, a box that misses the car).
    """
    extent = box[1] - box[0]
    voxel = float(extent.max()) / _RESOLUTION
    shape = (extent / voxel).ceil().long().clamp_min(1)
    axes = [box[0, i] + (torch.arange(int(shape[i]), dtype=box.dtype) + 0.5) * voxel for i in range(3)]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
    inside = _occupied(pictures, c2w, grid.reshape(-1, 3)).view(*shape.tolist())
    surface = inside & ~_buried(inside)
    points = grid[surface]
    if not len(points):
        return points, torch.zeros(0, 3, dtype=torch.uint8)
    generator = torch.Generator().manual_seed(0)
    chosen = torch.randperm(len(points), generator=generator)[:count]
    colours, seen = _colours(pictures, c2w, points, voxel)
    points = points[chosen] + (torch.rand(len(chosen), 3, generator=generator, dtype=points.dtype) - 0.5) * voxel
    grey = torch.full((3,), 128.0, dtype=torch.float64)
    return points, torch.where(seen[chosen, None], colours[chosen], grey).round().to(torch.uint8)


def _pixels(
    pictures: Pictures, c2w: Float[Tensor, "n 3 4"], points: Float[Tensor, "p 3"], view: int
) -> tuple[Tensor, Tensor, Bool[Tensor, "p"]]:
    """Index of the pixel of each point in a view, its depth, and whether it is in the image."""
    camera = pictures.camera
    in_camera = transform(invert(c2w[view]), points)
    u, v = project(in_camera, camera).floor().long().unbind(-1)
    within = (in_camera[:, 2] > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    return torch.where(within, v * camera.width + u, 0), in_camera[:, 2], within


def _occupied(pictures: Pictures, c2w: Float[Tensor, "n 3 4"], points: Float[Tensor, "p 3"]) -> Bool[Tensor, "p"]:
    """Which points hardly any view contradicts.

    One view after the other, since after a few of them most points are contradicted and need not be looked at again.
    """
    most = max(1, round(_DISSENT * len(c2w)))
    against = torch.zeros(len(points), dtype=torch.int16)
    watched = torch.zeros(len(points), dtype=torch.int16)
    alive = torch.arange(len(points))
    for view in range(len(c2w)):
        pixel, _, within = _pixels(pictures, c2w, points[alive], view)
        background = ~torch.from_numpy(pictures.mask[view]).flatten()[pixel] & within
        against[alive] += background.to(torch.int16)
        watched[alive] += within.to(torch.int16)
        alive = alive[against[alive] <= most]
    occupied = torch.zeros(len(points), dtype=torch.bool)
    occupied[alive] = watched[alive] >= _FEWEST_VIEWS
    return occupied


def _buried(inside: Bool[Tensor, "x y z"]) -> Bool[Tensor, "x y z"]:
    """Voxels whose six neighbours are all inside."""
    padded = torch.nn.functional.pad(inside, (1, 1, 1, 1, 1, 1))
    core = slice(1, -1)
    neighbours = [
        padded[:-2, core, core],
        padded[2:, core, core],
        padded[core, :-2, core],
        padded[core, 2:, core],
        padded[core, core, :-2],
        padded[core, core, 2:],
    ]
    return torch.stack(neighbours).all(0)


def _colours(
    pictures: Pictures, c2w: Float[Tensor, "n 3 4"], points: Float[Tensor, "p 3"], voxel: float
) -> tuple[Float[Tensor, "p 3"], Bool[Tensor, "p"]]:
    """Mean colour over the views that see a point first along its ray, and whether any does.

    One view after the other: the depth images of hundreds of views would take gigabytes, and save no time.
    """
    camera = pictures.camera
    total = torch.zeros(len(points), 3, dtype=torch.float64)
    count = torch.zeros(len(points), dtype=torch.float64)
    for view in range(len(c2w)):
        pixel, depth, within = _pixels(pictures, c2w, points, view)
        nearest = torch.full((camera.width * camera.height,), torch.inf, dtype=depth.dtype)
        nearest.scatter_reduce_(0, pixel[within], depth[within], "amin")
        # a surface of single pixels has holes: what lies within a few of them counts
        image = nearest.view(1, 1, camera.height, camera.width)
        nearest = -torch.nn.functional.max_pool2d(-image, 5, stride=1, padding=2).flatten()
        car = torch.from_numpy(pictures.mask[view]).flatten()
        seen = within & car[pixel] & (depth <= nearest[pixel] + 3 * voxel)
        rgb = torch.from_numpy(pictures.rgb[view].reshape(-1, 3).astype(np.float64))
        total += torch.where(seen[:, None], rgb[pixel], 0.0)
        count += seen
    return total / count.clamp_min(1)[:, None], count > 0
