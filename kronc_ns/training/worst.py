"""The pictures that a network does worst on, to look at: where it puts the points, and where they are."""

import tempfile
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from kronc_ns.capture.detection.builtin.detector import BuiltinDetector
from kronc_ns.capture.detection.detector import CarDetection, CarImage
from kronc_ns.errors import KroncError
from kronc_ns.files.output import atomic_path
from kronc_ns.training.calibration import judged
from kronc_ns.training.shards import Picture, Pictures

_TILE = (400, 280)
_COLUMNS = 5
_RIGHT, _WRONG = (90, 200, 60), (40, 40, 230)  # BGR
_JPEG_QUALITY = 85


def worst_pictures(weights: Path | None, pictures: Path, output: Path, count: int) -> str:
    """Write a sheet of the ``count`` pictures with the largest mean errors; returns a line that says what they are.

    A picture in which no car is found is as bad as can be. Points are drawn green where they are, red where they were
    put, a line from one to the other.
    """
    detector = BuiltinDetector(weights)
    ranked: list[tuple[float, UInt8[np.ndarray, "h w 3"]]] = []
    missed = 0
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "picture.png"
        for picture in Pictures(sorted(pictures.glob("*.npz"))):
            cv2.imwrite(str(file), picture.rgb[..., ::-1])
            cars = next(detector.detect([CarImage(file)]))
            missed += not cars
            error = _error(cars[0], picture) if cars else 1.0
            ranked.append((error, _drawn(cars[0] if cars else None, picture)))
    if not ranked:
        raise KroncError(f"{pictures} holds no pictures: expected shards that were rendered")
    ranked.sort(key=lambda one: -one[0])
    tiles = [tile for _, tile in ranked[:count]]
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % _COLUMNS)
    rows = [np.hstack(tiles[first : first + _COLUMNS]) for first in range(0, len(tiles), _COLUMNS)]
    with atomic_path(output) as temporary:
        cv2.imwrite(str(temporary), np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    typical = float(np.median([error for error, _ in ranked]))
    return (
        f"{len(ranked)} pictures, no car found in {missed}; mean error, median of all {100 * typical:.1f} %: {output}"
    )


def _error(car: CarDetection, picture: Picture) -> float:
    """Mean distance of the points given from where they are, in the car's box diagonals."""
    known, _, error = judged(car, picture)
    if not known.any():
        return 1.0
    rows, columns = np.nonzero(picture.mask)
    diagonal = float(np.hypot(np.ptp(rows) + 1, np.ptp(columns) + 1))
    return float(np.minimum(np.hypot(*error[known].T) / diagonal, 1.0).mean())


def _drawn(car: CarDetection | None, picture: Picture) -> UInt8[np.ndarray, "h w 3"]:
    height, width = picture.rgb.shape[:2]
    factor = min(_TILE[0] / width, _TILE[1] / height)
    small = cv2.resize(picture.rgb[..., ::-1], None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    tile = np.full((_TILE[1], _TILE[0], 3), 255, np.uint8)
    tile[: small.shape[0], : small.shape[1]] = small

    def at(uv: Float[np.ndarray, "2"]) -> tuple[int, int]:
        return round(float(uv[0]) * factor), round(float(uv[1]) * factor)

    for j, (u, v, state) in enumerate(picture.keypoints):
        true = at(np.array([u, v]))
        if car is not None and car.confidence[j] > 0 and state > 0:
            cv2.line(tile, at(car.uv[j]), true, _WRONG, 1, cv2.LINE_AA)
            cv2.circle(tile, at(car.uv[j]), 2, _WRONG, -1, cv2.LINE_AA)
        if state == 1:
            cv2.circle(tile, true, 2, _RIGHT, -1, cv2.LINE_AA)
    return tile
