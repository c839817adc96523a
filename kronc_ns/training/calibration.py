"""How often an exported network is right, measured on pictures it was not trained on; written as its card."""

import tempfile
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import isotonic_regression

from kronc_ns.capture.detection.builtin.detector import BuiltinDetector
from kronc_ns.capture.detection.detector import CarDetection, CarImage
from kronc_ns.capture.detection.model import file_sha256
from kronc_ns.errors import KroncError
from kronc_ns.files.output import write_json
from kronc_ns.training.shards import Picture, Pictures

_NEAR = 0.02  # of the car's box diagonal
_KNOTS = 17
# what is given and what is a car: chosen on rendered pictures without a car, see docs/detector.md
_THRESHOLDS = {"point_confidence": 0.3, "car_points": 10, "car_confidence": 0.45, "car_area": 0.02}


def calibrate(weights: Path, pictures: Path, version: str) -> str:
    """Write NAME.json beside NAME.onnx; returns a line that says what was measured."""
    shards = Pictures(sorted(pictures.glob("*.npz")))
    card = weights.with_suffix(".json")
    plain = {"version": version, "sha256": file_sha256(weights), "calibration": [[0, 0], [1, 1]], "sigma_factor": 1.0}
    write_json(card, {**plain, "point_confidence": 1e-6, "car_points": 0, "car_confidence": 0.0, "car_area": 0.0})
    said, right, squared, spread = [], [], [], []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "picture.png"
        detector = BuiltinDetector(weights)
        for picture in shards:
            cv2.imwrite(str(file), picture.rgb[..., ::-1])
            for car in next(detector.detect([CarImage(file)]))[:1]:
                known, good, error = judged(car, picture)
                said.append(car.confidence[known])
                right.append(good[known])
                sigma = car.sigma_px if car.sigma_px is not None else np.ones(len(known))
                squared.append(np.square(error[good]).sum(1) / 2)
                spread.append(np.square(sigma[good]))
    if not said or sum(map(len, said)) < 1000:
        raise KroncError(f"{weights} finds next to nothing in {pictures}: expected a trained network")
    confidence, correct = np.concatenate(said), np.concatenate(right).astype(np.float64)
    factor = float(np.sqrt(np.concatenate(squared).sum() / np.concatenate(spread).sum()))
    knots = rising_knots(confidence, correct)
    write_json(card, {**plain, "calibration": knots, "sigma_factor": round(factor, 4), **_THRESHOLDS})
    return f"{len(shards)} pictures, {len(confidence)} points, {correct.mean():.3f} right, sigma x {factor:.2f}: {card}"


def judged(
    car: CarDetection, picture: Picture
) -> tuple[Bool[np.ndarray, "66"], Bool[np.ndarray, "66"], Float[np.ndarray, "66 2"]]:
    """Of a car's points: those given of which the truth is known, those that are right, and their errors in pixels."""
    rows, columns = np.nonzero(picture.mask)
    diagonal = float(np.hypot(np.ptp(rows) + 1, np.ptp(columns) + 1))
    state = picture.keypoints[:, 2]
    error = car.uv - picture.keypoints[:, :2]
    known = (car.confidence > 0) & (state > 0)
    return known, known & (state == 1) & (np.hypot(*error.T) < _NEAR * diagonal), error


def rising_knots(said: Float[np.ndarray, "n"], right: Float[np.ndarray, "n"]) -> list[list[float]]:
    """A monotone function from what was said to the share that was right, as knots; from (0, 0) to (1, ...)."""
    order = np.argsort(said)
    fitted = np.asarray(isotonic_regression(right[order]).x)
    edges = np.unique(np.quantile(said, np.linspace(0, 1, _KNOTS)))
    knots = [[0.0, 0.0]]
    for low, high in pairwise(edges):
        inside = (said[order] >= low) & (said[order] <= high)
        knots.append([round(float(said[order][inside].mean()), 4), round(float(fitted[inside].mean()), 4)])
    knots.append([1.0, max(knots[-1][1], round(float(fitted[-1]), 4))])
    return knots
