"""`--detector builtin`: looks at the whole image, then at the car, once more where it lies elsewhere than thought."""

from collections.abc import Callable, Generator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from kronc_ns.capture.detection.builtin.looks import (
    Blob,
    Box,
    Car,
    Look,
    beyond,
    blobs_in,
    car_in,
    car_near,
    look_at,
    look_both_ways,
    merged,
    overlap,
)
from kronc_ns.capture.detection.builtin.pictures import Upright, read_upright
from kronc_ns.capture.detection.builtin.weights import WEIGHTS, Network
from kronc_ns.capture.detection.detector import CarDetection, CarImage
from kronc_ns.capture.detection.pixels import box_of_mask
from kronc_ns.keypoints.schema import APOLLOCAR3D_66, KeypointSchema

_DECODER = 1  # raise it when the same weights give other points
_PADDING = 1.2  # of a car's box, as in training
_SAME_BOX = 0.75  # overlap of boxes that need no further look
_MORE_LOOKS = 2  # at most, where the box was not right
_SAME_CAR = 0.5  # overlap of boxes of one car found twice
_CARS = 3  # looked for in an image
_OTHER_CAR = 0.2  # of the largest one's area, at least, to be looked at
_FEW_POINTS = 3.0  # expected on a blob: less is no car
_PADDINGS = (1.1, 1.22, 1.38)  # of the last looks, each with its mirror image
_LARGE_PX = 1280  # longer side from which on a car may hide from tiles of half the image
_POOR = 0.6  # mean confidence below which a car may be lying on its side
_CLEARLY = 1.5  # times as many points expected after turning


class BuiltinDetector:
    """Up to three cars in an image, the strongest first; with a mask the one car there."""

    uses_masks = True
    schema: KeypointSchema = APOLLOCAR3D_66

    def __init__(self, weights: Path | None = None) -> None:
        self._network = Network(weights or WEIGHTS)

    @property
    def identity(self) -> str:
        """Weights, card and what is done with them."""
        return f"builtin {self._network.identity} {_DECODER}"

    def detect(self, images: Sequence[CarImage]) -> Generator[list[CarDetection], None, None]:
        """The cars in each image."""
        return (self._detect(image) for image in images)

    def look_again(
        self, images: Sequence[CarImage], expected: Float[np.ndarray, "n j 2"]
    ) -> Generator[CarDetection | None, None, None]:
        """The car of each image with its points near ``expected`` (stored pixels; NaN: unknown)."""
        return (self._look_again(image, places) for image, places in zip(images, expected, strict=True))

    def _look_again(self, image: CarImage, expected: Float[np.ndarray, "j 2"]) -> CarDetection | None:
        picture = read_upright(image.path)
        places = picture.from_stored(expected)
        inside = np.clip(places[np.isfinite(places).all(1)], 0.0, picture.rgb.shape[1::-1])
        if not len(inside) or (np.ptp(inside, axis=0) < 4).any():
            return None
        box = np.concatenate([inside.min(0), inside.max(0)])
        car = self._from_all_looks(picture.rgb, box, lambda look: car_near(look, places, self._network.card))
        return None if car is None else _detection(car, picture)

    def _detect(self, image: CarImage) -> list[CarDetection]:
        picture = read_upright(image.path)
        if image.mask is not None:
            box = box_of_mask(image.mask, picture.stored_size)
            if box is None:
                return []
            corners = picture.from_stored(box.reshape(2, 2))
            car = self._closer(picture.rgb, np.concatenate([corners.min(0), corners.max(0)]))
            cars = [] if car is None else [car]
        else:
            cars = self._search(picture.rgb)
        if not cars or cars[0].mean_confidence < _POOR:
            strength = cars[0].strength if cars else 0.0
            turned = self._turned(picture, strength)
            if turned is not None:
                return [turned]
        return [_detection(car, picture) for car in cars]

    def _search(self, rgb: UInt8[np.ndarray, "h w 3"]) -> list[Car]:
        """The cars in an image: those in the whole of it, or else the clearest one in its parts."""
        whole = _whole(rgb)
        if cars := self._cars(rgb, self._blobs(rgb, whole)):
            return cars
        for count in (2, 3) if max(rgb.shape[:2]) >= _LARGE_PX else (2,):
            found = [blob for tile in _tiles(whole, count) for blob in self._blobs(rgb, tile)]
            best = sorted(found, key=lambda blob: -blob.points)[:_CARS]
            if cars := self._cars(rgb, best):
                return cars
        return []

    def _blobs(self, rgb: UInt8[np.ndarray, "h w 3"], box: Box) -> list[Blob]:
        """What may be a car in a part of the image, the strongest first."""
        found = [blob for blob in blobs_in(look_at(self._network, rgb, box)) if blob.points >= _FEW_POINTS]
        largest = max((blob.share for blob in found), default=0.0)
        return [blob for blob in found if blob.share >= _OTHER_CAR * largest][:_CARS]

    def _cars(self, rgb: UInt8[np.ndarray, "h w 3"], blobs: Sequence[Blob]) -> list[Car]:
        cars: list[Car] = []
        for blob in blobs:
            if any(overlap(blob.box, car.box) > _SAME_CAR for car in cars):
                continue
            car = self._closer(rgb, blob.box)
            if car is not None and all(overlap(car.box, other.box) <= _SAME_CAR for other in cars):
                cars.append(car)
        return sorted(cars, key=lambda car: -car.strength)

    def _closer(self, rgb: UInt8[np.ndarray, "h w 3"], box: Box) -> Car | None:
        """The car in a box, if there is evidence enough of one."""
        card = self._network.card
        look = look_at(self._network, rgb, box, _PADDING)
        for _ in range(_MORE_LOOKS):
            car = car_in(look, box, card)
            if car is None:
                return None
            wanted = beyond(look, car.box, (rgb.shape[1], rgb.shape[0]))
            if overlap(wanted, box) >= _SAME_BOX:
                break
            box, look = wanted, look_at(self._network, rgb, wanted, _PADDING)
        car = self._from_all_looks(rgb, box, lambda look: car_in(look, box, card))
        return car if car is not None and car.suffices(card) else None

    def _from_all_looks(
        self, rgb: UInt8[np.ndarray, "h w 3"], box: Box, find: Callable[[Look], Car | None]
    ) -> Car | None:
        """What looks of several widths and their mirror images find together; None if one of them finds nothing."""
        cars = [find(look_both_ways(self._network, rgb, box, padding)) for padding in _PADDINGS]
        found = [car for car in cars if car is not None]
        return merged(found, self._network.card) if len(found) == len(cars) else None

    def _turned(self, picture: Upright, strength: float) -> CarDetection | None:
        """A car without points, where the image turned by 90, 180 or 270 degrees shows one much more clearly."""
        found = []
        for quarters in (1, 2, 3):
            rgb = np.ascontiguousarray(np.rot90(picture.rgb, quarters))
            cars = self._cars(rgb, self._blobs(rgb, _whole(rgb))[:1])
            found += [(car.strength, quarters, car.mean_confidence) for car in cars]
        best, quarters, score = max(found, default=(0.0, 0, 0.0))
        if best <= _CLEARLY * strength:
            return None
        count = len(self.schema)
        box = np.array([0.0, 0.0, *picture.stored_size])
        return CarDetection(np.zeros((count, 2)), np.zeros(count), box, score, turned_deg=90 * quarters)


def _detection(car: Car, picture: Upright) -> CarDetection:
    return CarDetection(
        picture.to_stored(car.uv),
        car.confidence,
        picture.box_to_stored(car.box),
        car.mean_confidence,
        car.sigma_px * picture.px_per_px,
    )


def _whole(rgb: UInt8[np.ndarray, "h w 3"]) -> Box:
    return np.array([0.0, 0.0, rgb.shape[1], rgb.shape[0]])


def _tiles(whole: Box, count: int) -> list[Box]:
    """``count`` x ``count`` parts of an image, each a third larger than its share, so that they overlap."""
    sides = whole[2:] * 4 / (3 * count)
    corners = [np.linspace(0.0, size - side, count) for size, side in zip(whole[2:], sides, strict=True)]
    return [np.array([x, y, x + sides[0], y + sides[1]]) for y in corners[1] for x in corners[0]]
