"""From a rendered picture to what the network is shown: cut, turned, mirrored, covered, degraded; or no car at all."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.training.degradation import degrade
from kronc_ns.training.occlusion import backdrop, beside, clutter, cover, watermark
from kronc_ns.training.shards import Picture

SIZE = (320, 224)
"""(width, height) of the input."""
_CELL = 4  # input pixels per cell of the mask
_FLIP = list(APOLLOCAR3D_66.flip)
_GREY = 114  # what lies outside an image, as the detector draws it


@dataclass(frozen=True, eq=False)
class Sample:
    """What the network is shown and should say."""

    rgb: UInt8[np.ndarray, "224 320 3"]
    mask: UInt8[np.ndarray, "56 80"]
    """The car's share of each cell, 0 to 255."""
    keypoints: Float[np.ndarray, "66 3"]
    """u, v, state as in `Picture`, in input pixels."""


def augment(picture: Picture, others: Sequence[Picture], rng: np.random.Generator) -> Sample:
    """One sample of a picture; ``others`` lend cars and surroundings."""
    rgb, mask, keypoints = picture.rgb, picture.mask, picture.keypoints
    if rng.uniform() < 0.3:
        rgb = _other_background(rgb, mask, others, rng)
    if rng.uniform() < 0.15:
        rgb = _cluttered(rgb, mask, rng)
    if others and rng.uniform() < 0.2:
        rgb, hidden = beside(rgb, mask, others[0], before=rng.uniform() < 0.2, rng=rng)
        mask, keypoints = covered(mask, keypoints, hidden)
    matrix, outside = draw_placement(mask, rng)
    rgb, mask, keypoints = place(rgb, mask, keypoints, matrix, outside)
    rows, columns = np.nonzero(mask)
    if len(rows) and rng.uniform() < 0.15:
        box = np.array([columns.min(), rows.min(), columns.max(), rows.max()], dtype=np.float64)
        rgb, hidden = cover(rgb, box, rng)
        mask, keypoints = covered(mask, keypoints, hidden)
    if rng.uniform() < 0.04:
        rgb = watermark(rgb, rng)
    if rng.uniform() < 0.5:
        rgb, mask = rgb[:, ::-1], mask[:, ::-1]
        keypoints = keypoints[_FLIP] * (-1, 1, 1) + (SIZE[0], 0, 0)
    share = cv2.resize(mask, (SIZE[0] // _CELL, SIZE[1] // _CELL), interpolation=cv2.INTER_AREA)
    return Sample(degrade(np.ascontiguousarray(rgb), rng), share, keypoints)


def negative(rng: np.random.Generator, others: Sequence[Picture]) -> Sample:
    """A sample without a car: surroundings with the car painted over, patterns, things."""
    rgb = backdrop(SIZE, others, rng)
    if others and rng.uniform() < 0.4:
        picture = others[0]
        patch = backdrop(SIZE, others, rng)
        rgb = _mixed(patch, cv2.resize(picture.rgb, SIZE, interpolation=cv2.INTER_AREA), blot(picture.mask))
    rgb = clutter(rgb, int(rng.integers(0, 40)), rng)
    keypoints = np.zeros((len(_FLIP), 3))
    keypoints[:, 2] = 2
    return Sample(degrade(rgb, rng), np.zeros((SIZE[1] // _CELL, SIZE[0] // _CELL), np.uint8), keypoints)


def draw_placement(mask: UInt8[np.ndarray, "h w"], rng: np.random.Generator) -> tuple[Float[np.ndarray, "2 3"], str]:
    """Where the picture goes in the input (pixels to pixels), and what lies outside it.

    Mostly as in a second look: the car's box, padded, off by some. Else as in a first one: the car small, anywhere.
    """
    rows, columns = np.nonzero(mask[::2, ::2])
    height, width = mask.shape
    if len(rows):
        low = 2.0 * np.array([columns.min(), rows.min()])
        high = 2.0 * np.array([columns.max(), rows.max()]) + 2
    else:
        low, high = np.zeros(2), np.array([width, height], dtype=np.float64)
    sides = np.maximum(high - low, 4.0)
    size = np.array(SIZE, dtype=np.float64)
    fit = float((size / sides).min())
    if rng.uniform() < 0.72:
        scale, room = fit / np.exp(rng.normal(0.17, 0.13)), 0.09
    else:
        scale, room = fit * rng.uniform(0.14, 0.9), 1.0
    angle = np.deg2rad(rng.normal(0, 4) if rng.uniform() < 0.85 else rng.normal(0, 14))
    stretch = np.exp(rng.normal(0, 0.04))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    shear = np.array([[1.0, rng.normal(0, 0.03)], [0.0, 1.0]])  # rows read one after another while the camera turns
    linear = scale * turn @ shear @ np.diag([stretch, 1 / stretch])
    free = np.maximum(size - scale * sides, 0.0) / 2
    middle = size / 2 + (rng.uniform(-1, 1, 2) * free if room == 1.0 else rng.normal(0, room, 2) * scale * sides)
    if rng.uniform() < 0.08:  # cut by the border
        middle += rng.choice([-1, 1], 2) * rng.uniform(0.1, 0.4) * scale * sides
    offset = middle - linear @ ((low + high) / 2)
    outside = str(rng.choice(["grey", "edge", "plain"], p=[0.4, 0.35, 0.25]))
    if outside == "edge" and any(side.any() for side in (mask[0], mask[-1], mask[:, 0], mask[:, -1])):
        outside = "grey"  # else the car itself would be drawn out
    return np.column_stack([linear, offset]), outside


def place(
    rgb: UInt8[np.ndarray, "h w 3"],
    mask: UInt8[np.ndarray, "h w"],
    keypoints: Float[np.ndarray, "66 3"],
    matrix: Float[np.ndarray, "2 3"],
    outside: str,
) -> tuple[UInt8[np.ndarray, "224 320 3"], UInt8[np.ndarray, "224 320"], Float[np.ndarray, "66 3"]]:
    """Picture, mask and points moved by ``matrix`` (input = matrix @ (u, v, 1), centres of first pixels at 0.5)."""
    scale = float(np.sqrt(abs(np.linalg.det(matrix[:, :2]))))
    shrink = max(1, int(1 / scale))
    if shrink > 1:  # sampling alone would alias
        small = (rgb.shape[1] // shrink, rgb.shape[0] // shrink)
        factor = np.array([rgb.shape[1] / small[0], rgb.shape[0] / small[1]])
        rgb = cv2.resize(rgb, small, interpolation=cv2.INTER_AREA)
        mask = cv2.resize(mask, small, interpolation=cv2.INTER_AREA)
        sampled = np.column_stack([matrix[:, :2] * factor, matrix[:, 2]])
    else:
        sampled = matrix
    # OpenCV counts from pixel centres
    shifted = sampled.copy()
    shifted[:, 2] += sampled[:, :2] @ [0.5, 0.5] - 0.5
    border = cv2.BORDER_REPLICATE if outside == "edge" else cv2.BORDER_CONSTANT
    fill = rgb[0, 0].tolist() if outside == "plain" else [_GREY] * 3
    moved = cv2.warpAffine(rgb, shifted, SIZE, flags=cv2.INTER_LINEAR, borderMode=border, borderValue=fill)
    cut = cv2.warpAffine(mask, shifted, SIZE, flags=cv2.INTER_LINEAR)
    uv = keypoints[:, :2] @ matrix[:, :2].T + matrix[:, 2]
    inside = (uv >= 0).all(1) & (uv < SIZE).all(1)
    state = np.where((keypoints[:, 2] == 1) & ~inside, 2.0, keypoints[:, 2])
    return moved, cut, np.column_stack([uv, state])


def covered(
    mask: UInt8[np.ndarray, "h w"], keypoints: Float[np.ndarray, "66 3"], hidden: UInt8[np.ndarray, "h w"]
) -> tuple[UInt8[np.ndarray, "h w"], Float[np.ndarray, "66 3"]]:
    """Mask and points with what is hidden taken out."""
    row = np.floor(keypoints[:, 1]).astype(int).clip(0, hidden.shape[0] - 1)
    column = np.floor(keypoints[:, 0]).astype(int).clip(0, hidden.shape[1] - 1)
    state = np.where((keypoints[:, 2] == 1) & (hidden[row, column] > 127), 2.0, keypoints[:, 2])
    return np.where(hidden > 127, 0, mask).astype(np.uint8), np.column_stack([keypoints[:, :2], state])


def _other_background(
    rgb: UInt8[np.ndarray, "h w 3"], mask: UInt8[np.ndarray, "h w"], others: Sequence[Picture], rng: np.random.Generator
) -> UInt8[np.ndarray, "h w 3"]:
    """The car cut out, its edge hard or soft, before something else."""
    behind = backdrop((mask.shape[1], mask.shape[0]), others, rng)
    share = mask if rng.uniform() < 0.4 else cv2.GaussianBlur(mask, (3, 3), 0)
    return _mixed(rgb, behind, share)


def _cluttered(
    rgb: UInt8[np.ndarray, "h w 3"], mask: UInt8[np.ndarray, "h w"], rng: np.random.Generator
) -> UInt8[np.ndarray, "h w 3"]:
    """Things behind the car."""
    return _mixed(rgb, clutter(rgb, int(rng.integers(1, 15)), rng), mask)


def blot(mask: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "224 320"]:
    """255 all over the car, fading beyond it: an outline alone would still be a car's."""
    cells = cv2.resize(mask, (SIZE[0] // 8, SIZE[1] // 8), interpolation=cv2.INTER_AREA)
    wide = cv2.dilate(np.where(cells > 0, 255, 0).astype(np.uint8), np.ones((9, 9), np.uint8))
    return cv2.resize(cv2.GaussianBlur(wide, (7, 7), 1.2), SIZE, interpolation=cv2.INTER_LINEAR)


def _mixed(front: np.ndarray, behind: np.ndarray, share: np.ndarray) -> np.ndarray:
    """``front`` by its share of 255."""
    weight = share[..., None].astype(np.uint16)
    return ((front * weight + behind * (255 - weight)) // 255).astype(np.uint8)
