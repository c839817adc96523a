"""Where the car's surface is, from masks alone: the visual hull, carved and coloured (Laurentini, PAMI 1994)."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from kronc_ns.capture.images import load_image
from kronc_ns.files.images import read_grey
from kronc_ns.geometry.camera import Camera, project
from kronc_ns.geometry.poses import invert, transform
from kronc_ns.plugin.seeds import Seeds, grey

_RESOLUTION = 96
"""Voxels along the box's longest side."""
_LONGER_SIDE_PX = 400  # images are carved at this size: a voxel is then about two pixels
_DISSENT = 0.05  # share of the views that may see background where the car is (masks and poses are not exact)
_FEWEST_VIEWS = 3  # a voxel that fewer views see is not known to be the car


@dataclass(frozen=True)
class Pictures:
    """Small copies of N images and masks with their cameras."""

    rgb: tuple[UInt8[np.ndarray, "_ _ 3"], ...]
    mask: tuple[Bool[np.ndarray, "_ _"], ...]
    cameras: tuple[Camera, ...]


def read_pictures(images: Sequence[Path], masks: Sequence[Path], cameras: Sequence[Camera]) -> Pictures:
    """Read images and masks, reduced so that the longer side is at most 400 px, lens distortion taken out."""
    import cv2

    cameras = tuple(c.scaled(min(1.0, _LONGER_SIDE_PX / max(c.width, c.height))) for c in cameras)

    def straight(picture: UInt8[np.ndarray, "h w *c"], small: Camera, how: int) -> UInt8[np.ndarray, "h2 w2 *c"]:
        reduced = cv2.resize(picture, (small.width, small.height), interpolation=how)
        return cv2.undistort(reduced, small.matrix, np.array(small.distortion)) if any(small.distortion) else reduced

    rgb = (
        straight(np.asarray(load_image(path).convert("RGB")), small, cv2.INTER_AREA)
        for path, small in zip(images, cameras, strict=True)
    )
    mask = (straight(read_grey(path), small, cv2.INTER_NEAREST) > 0 for path, small in zip(masks, cameras, strict=True))
    return Pictures(tuple(rgb), tuple(mask), cameras)


def carve(pictures: Pictures, c2w: Float[np.ndarray, "n 3 4"], box: Float[np.ndarray, "2 3"], count: int) -> Seeds:
    """At most ``count`` points on the surface of the visual hull inside ``box``, with their mean colours.

    A voxel is the car's where hardly any view that has it in its image sees background. Its colour is the mean over
    the views that see it first. No points where the masks leave nothing (empty masks, a box that misses the car).
    """
    extent = box[1] - box[0]
    voxel = float(extent.max()) / _RESOLUTION
    shape = np.maximum(np.ceil(extent / voxel).astype(int), 1)
    axes = [box[0, i] + (np.arange(shape[i]) + 0.5) * voxel for i in range(3)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    inside = _occupied(pictures, c2w, grid.reshape(-1, 3)).reshape(shape)
    points = grid[inside & ~_buried(inside)]
    rng = np.random.default_rng(0)
    chosen = rng.permutation(len(points))[:count]
    jittered = points[chosen] + (rng.random((len(chosen), 3)) - 0.5) * voxel
    colours, seen = _colours(pictures, c2w, points, voxel)
    unknown = grey(jittered).colours
    return Seeds(jittered, np.where(seen[chosen, None], np.rint(colours[chosen]), unknown).astype(np.uint8))


def _pixels(
    camera: Camera, c2w: Float[np.ndarray, "3 4"], points: Float[np.ndarray, "p 3"]
) -> tuple[Int[np.ndarray, "p"], Float[np.ndarray, "p"], Bool[np.ndarray, "p"]]:
    """Index of the pixel of each point in a view, its depth, and whether it is in the image (else the index is 0)."""
    in_camera = transform(invert(c2w), points)
    u, v = np.floor(project(in_camera, camera)).T
    within = (in_camera[:, 2] > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    return np.where(within, v * camera.width + u, 0).astype(int), in_camera[:, 2], within


def _occupied(
    pictures: Pictures, c2w: Float[np.ndarray, "n 3 4"], points: Float[np.ndarray, "p 3"]
) -> Bool[np.ndarray, "p"]:
    """Which points hardly any view contradicts.

    One view after the other, since after a few of them most points are contradicted and need not be looked at again.
    """
    most = max(1, round(_DISSENT * len(c2w)))
    against, watched = np.zeros((2, len(points)), dtype=np.int16)
    alive = np.arange(len(points))
    for pose, mask, camera in zip(c2w, pictures.mask, pictures.cameras, strict=True):
        pixel, _, within = _pixels(camera, pose, points[alive])
        against[alive] += within & ~mask.ravel()[pixel]
        watched[alive] += within
        alive = alive[against[alive] <= most]
    occupied = np.zeros(len(points), dtype=bool)
    occupied[alive] = watched[alive] >= _FEWEST_VIEWS
    return occupied


def _buried(inside: Bool[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x y z"]:
    """Voxels whose six neighbours are all inside."""
    padded = np.pad(inside, 1)
    core = slice(1, -1)
    neighbours = [
        padded[:-2, core, core],
        padded[2:, core, core],
        padded[core, :-2, core],
        padded[core, 2:, core],
        padded[core, core, :-2],
        padded[core, core, 2:],
    ]
    return np.logical_and.reduce(neighbours)


def _colours(
    pictures: Pictures, c2w: Float[np.ndarray, "n 3 4"], points: Float[np.ndarray, "p 3"], voxel: float
) -> tuple[Float[np.ndarray, "p 3"], Bool[np.ndarray, "p"]]:
    """Mean colour over the views that see a point first along its ray, and whether any does.

    One view after the other: the depth images of hundreds of views would take gigabytes, and save no time.
    """
    import cv2

    total, count = np.zeros((len(points), 3)), np.zeros(len(points))
    for pose, mask, rgb, camera in zip(c2w, pictures.mask, pictures.rgb, pictures.cameras, strict=True):
        pixel, depth, within = _pixels(camera, pose, points)
        nearest = np.full(camera.width * camera.height, np.inf)
        np.minimum.at(nearest, pixel[within], depth[within])
        # a surface of single pixels has holes: what lies within a few of them counts
        nearest = cv2.erode(nearest.reshape(camera.height, camera.width), np.ones((5, 5))).ravel()
        seen = within & mask.ravel()[pixel] & (depth <= nearest[pixel] + 3 * voxel)
        total[seen] += rgb.reshape(-1, 3)[pixel[seen]]
        count += seen
    return total / np.maximum(count, 1)[:, None], count > 0
