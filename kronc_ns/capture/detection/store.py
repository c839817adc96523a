"""Detections kept by the content of each image, so that nothing is computed twice, even after an interruption."""

import hashlib
import json
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from kronc_ns.capture.detection.detector import CarDetection, CarImage, Detector
from kronc_ns.capture.detection.model import file_sha256
from kronc_ns.capture.progress import Count
from kronc_ns.errors import KroncError
from kronc_ns.files.cache import cache_folder
from kronc_ns.files.output import read_json, write_json


def detect_all(
    detector: Detector, images: Sequence[CarImage], progress: Count | None = None
) -> list[list[CarDetection]]:
    """The cars in each image: those kept from before, and the others detected now and kept one by one."""
    files = [_file(detector, image) for image in images]
    found = {file: cars for file in files if (cars := _read(file, len(detector.schema))) is not None}
    # the same content twice is one piece of work
    waiting = {file: image for file, image in zip(files, images, strict=True) if file not in found}
    kept, count = len(images) - len(waiting), progress or (lambda *_: None)
    if not waiting:
        return [found[file] for file in files]
    count(kept, len(images), None)
    with closing(detector.detect(list(waiting.values()))) as answers:
        for done, (file, cars) in enumerate(zip(waiting, answers, strict=True), start=1):
            write_json(file, [_as_json(car) for car in cars])
            found[file] = cars
            count(kept + done, len(images), None)
    return [found[file] for file in files]


def _file(detector: Detector, image: CarImage) -> Path:
    parts = [detector.identity, file_sha256(image.path)]
    if detector.uses_masks:
        parts.append(file_sha256(image.mask) if image.mask else "no mask")
    key = hashlib.sha256("\n".join(parts).encode()).hexdigest()
    return cache_folder() / "detections" / key[:2] / f"{key[2:]}.json"


def _as_json(car: CarDetection) -> dict[str, Any]:
    sigma = {} if car.sigma_px is None else {"sigma_px": np.where(car.confidence > 0, car.sigma_px, 0.0).tolist()}
    return {
        "uv": np.where(car.confidence[:, None] > 0, car.uv, 0.0).tolist(),
        "confidence": car.confidence.tolist(),
        "bbox": car.bbox.tolist(),
        "score": car.score,
        "turned_deg": car.turned_deg,
        **sigma,
    }


def _read(file: Path, count: int) -> list[CarDetection] | None:
    """Detections of an earlier run; what cannot be read counts as absent, since it can be made anew."""
    try:
        cars = [_from_json(content) for content in read_json(file)]
    except (KroncError, KeyError, TypeError, ValueError, json.JSONDecodeError):
        return None
    return cars if all(car.uv.shape == (count, 2) for car in cars) else None


def _from_json(content: dict[str, Any]) -> CarDetection:
    sigma = np.array(content["sigma_px"], dtype=np.float64) if "sigma_px" in content else None
    uv, confidence, bbox = (np.array(content[key], dtype=np.float64) for key in ("uv", "confidence", "bbox"))
    return CarDetection(uv, confidence, bbox, float(content["score"]), sigma, int(content.get("turned_deg", 0)))
