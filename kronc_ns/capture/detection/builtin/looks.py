"""One look of the network at a part of an image, and the cars that it sees there."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from kronc_ns.capture.detection.builtin.peaks import find_places, mass_near
from kronc_ns.capture.detection.builtin.weights import INPUT_SIZE, STRIDE, Answer, Card, Network
from kronc_ns.capture.detection.pixels import Placement, crop
from kronc_ns.keypoints.schema import APOLLOCAR3D_66

Box = Float[np.ndarray, "4"]
"""Left, top, right, bottom in pixels of the image."""
FILL = 114
"""Grey of what lies outside the image."""
_NEAR = 0.02  # of the car's diagonal: what confidence speaks of
_REACH = 0.04  # of the diagonal: how far from where geometry expects it a point may be
_MARGIN = 3  # cells around a car's mask in which its points may lie
_GAP = 2  # cells on either side of a post before a car, in the looks at one car
_SMALLEST = 6  # cells of a mask that may be a car


@dataclass(frozen=True, eq=False)
class Look:
    """An answer of the network, and where in the image it looked."""

    answer: Answer
    placement: Placement


@dataclass(frozen=True, eq=False)
class Blob:
    """Connected cells that show a car."""

    cells: Bool[np.ndarray, "h w"]
    box: Box
    share: float
    """Of the look's cells."""
    points: float
    """Expected number of visible points on it."""


@dataclass(frozen=True, eq=False)
class Car:
    """A car in a look; pixels of the image."""

    uv: Float[np.ndarray, "j 2"]
    confidence: Float[np.ndarray, "j"]
    """Calibrated; 0 where a point is not given."""
    sigma_px: Float[np.ndarray, "j"]
    box: Box
    """Around its mask and its points."""
    share: float
    """Of the look that its mask fills."""

    @property
    def strength(self) -> float:
        """Expected number of right points."""
        return float(self.confidence.sum())

    @property
    def mean_confidence(self) -> float:
        """Of the points that are given; 0 without any."""
        given = self.confidence[self.confidence > 0]
        return float(given.mean()) if given.size else 0.0

    def suffices(self, card: Card) -> bool:
        """Whether there is evidence enough to report it."""
        return (
            int((self.confidence > 0.5).sum()) >= card.car_points
            and self.mean_confidence >= card.car_confidence
            and self.share >= card.car_area
        )


def look_at(network: Network, rgb: UInt8[np.ndarray, "h w 3"], box: Box, padding: float = 1.0) -> Look:
    """Show the network a box, widened by ``padding`` and to the shape of its input."""
    drawn, placement = crop(rgb, box, INPUT_SIZE, padding, FILL)
    return Look(network(drawn), placement)


def look_both_ways(network: Network, rgb: UInt8[np.ndarray, "h w 3"], box: Box, padding: float) -> Look:
    """The mean of a look at a box and one at its mirror image."""
    drawn, placement = crop(rgb, box, INPUT_SIZE, padding, FILL)
    first, mirrored = network(drawn), network(np.ascontiguousarray(drawn[:, ::-1]))
    flip = list(APOLLOCAR3D_66.flip)
    back = Answer(mirrored.heat[flip, :, ::-1], mirrored.visible[flip], mirrored.mask[:, ::-1])
    return Look(Answer(*((one + other) / 2 for one, other in zip(first, back, strict=True))), placement)


def blobs_in(look: Look, gap: int = 0) -> list[Blob]:
    """Everything that may be a car, the one with most of it first; parts up to ``2 * gap`` cells apart are one."""
    heat, visible, mask = look.answer
    on_car = mask > 0.5
    count, labels = cv2.connectedComponents(_widened(on_car, gap).astype(np.uint8), connectivity=8)
    found = []
    for label in range(1, count):
        cells = on_car & (labels == label)
        row, column = np.nonzero(cells)
        if len(row) < _SMALLEST:
            continue
        corners = STRIDE * np.array([[column.min(), row.min()], [column.max() + 1, row.max() + 1]], dtype=np.float64)
        points = float(visible @ (heat * _widened(cells, _MARGIN)).sum((1, 2)))
        found.append(Blob(cells, look.placement.to_image(corners).ravel(), float(cells.mean()), points))
    return sorted(found, key=lambda blob: -blob.points * blob.share**0.5)


def car_in(look: Look, expected: Box, card: Card) -> Car | None:
    """The car that overlaps most with where one was expected."""
    blobs = blobs_in(look, _GAP)
    if not blobs:
        return None
    blob = max(blobs, key=lambda blob: (overlap(blob.box, expected), blob.points))
    heat, visible, _ = look.answer
    places = find_places(heat)
    column, row = np.floor(places.cells).astype(int).T
    its_own = _widened(blob.cells, _MARGIN)[row.clip(0, heat.shape[1] - 1), column.clip(0, heat.shape[2] - 1)]
    uv = look.placement.to_image(STRIDE * places.cells)
    box = _around(blob.box, uv[its_own & (visible > 0.5)])
    px_per_cell = STRIDE / look.placement.scale[0]
    near = mass_near(heat, places.cells, _NEAR * float(np.hypot(*(box[2:] - box[:2]))) / px_per_cell)
    confidence = card.calibrated(np.where(its_own, visible * near, 0.0).clip(0, 1))
    confidence = np.where(its_own & (confidence >= card.point_confidence), confidence, 0.0)
    return Car(uv, confidence, card.sigma_factor * px_per_cell * places.spread, box, blob.share)


def car_near(look: Look, expected: Float[np.ndarray, "j 2"], card: Card) -> Car | None:
    """The car whose points are expected at pixels of the image (NaN: unknown): each point where the network sees it
    within `_REACH`, no point elsewhere."""
    known = np.isfinite(expected).all(1)
    heat, visible, mask = look.answer
    box = _around(np.array([*expected[known].min(0), *expected[known].max(0)]), np.zeros((0, 2)))
    px_per_cell = STRIDE / look.placement.scale[0]
    diagonal = float(np.hypot(*(box[2:] - box[:2]))) / px_per_cell
    at = look.placement.to_input(np.where(known[:, None], expected, 0.0)) / STRIDE
    across = np.arange(heat.shape[2]) + 0.5 - at[:, :1]
    down = np.arange(heat.shape[1]) + 0.5 - at[:, 1:]
    within = across[:, None, :] ** 2 + down[:, :, None] ** 2 < (_REACH * diagonal + 1) ** 2
    nearby = np.where(known[:, None, None], heat * within, heat)
    if not nearby.any():
        return None
    places = find_places(nearby)
    near = mass_near(heat, places.cells, _NEAR * diagonal)
    confidence = card.calibrated((visible * near).clip(0, 1))
    confidence = np.where(confidence >= card.point_confidence, confidence, 0.0)
    uv = look.placement.to_image(STRIDE * places.cells)
    return Car(uv, confidence, card.sigma_factor * px_per_cell * places.spread, box, float((mask > 0.5).mean()))


def merged(cars: Sequence[Car], card: Card) -> Car:
    """One car of several looks at it: places weighed by their confidence, which is averaged; looks that disagree on a
    place make it less precise."""
    confidence = np.stack([car.confidence for car in cars])
    weight = confidence / np.maximum(confidence.sum(0), 1e-12)
    uv = (weight[..., None] * np.stack([car.uv for car in cars])).sum(0)
    apart = np.stack([np.square(car.uv - uv).sum(1) / 2 for car in cars])
    variance = (weight * (np.stack([np.square(car.sigma_px) for car in cars]) + apart)).sum(0)
    mean = confidence.mean(0)
    boxes = np.stack([car.box for car in cars])
    given = np.where(mean >= card.point_confidence, mean, 0.0)
    return Car(uv, given, np.sqrt(variance), np.median(boxes, axis=0), float(np.mean([car.share for car in cars])))


def beyond(look: Look, box: Box, size: tuple[int, int]) -> Box:
    """The box of a car, made half as long again where it leaves the look but not the image of (width, height)."""
    low, high = look.placement.to_image(np.array([[0.0, 0.0], INPUT_SIZE]))
    rim = STRIDE / np.array(look.placement.scale)
    more = 0.5 * (box[2:] - box[:2])
    start = np.where(box[:2] < low + rim, np.maximum(np.minimum(box[:2], 0.0), box[:2] - more), box[:2])
    end = np.where(box[2:] > high - rim, np.minimum(np.maximum(box[2:], size), box[2:] + more), box[2:])
    return np.concatenate([start, end])


def overlap(a: Box, b: Box) -> float:
    """Intersection over union."""
    sides = np.maximum(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0.0)
    shared = float(sides.prod())
    return shared / max(float((a[2:] - a[:2]).prod() + (b[2:] - b[:2]).prod()) - shared, 1e-12)


def _around(box: Box, uv: Float[np.ndarray, "_ 2"]) -> Box:
    corners = np.concatenate([box.reshape(2, 2), uv])
    return np.concatenate([corners.min(0), corners.max(0)])


def _widened(cells: Bool[np.ndarray, "h w"], margin: int) -> Bool[np.ndarray, "h w"]:
    """With all cells so near: many points lie on the outline of a car, and their heat on both sides of it."""
    side = 2 * margin + 1
    return cv2.dilate(cells.astype(np.uint8), np.ones((side, side), dtype=np.uint8)) > 0
