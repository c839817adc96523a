"""The cars in many images, as a keypoint file would hold them."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from kronc_ns.capture.detection.detector import CarDetection, CarImage, Detector
from kronc_ns.capture.detection.store import detect_all
from kronc_ns.capture.progress import Count
from kronc_ns.errors import KroncError
from kronc_ns.files.keypoints import Detections

_TURNED = {
    90: "lies on its side: turn the photos by 90 degrees counter-clockwise",
    180: "is upside down: turn the photos by 180 degrees",
    270: "lies on its side: turn the photos by 90 degrees clockwise",
}


def find_keypoints(
    detector: Detector,
    folder: Path,
    names: Sequence[str],
    sizes: Sequence[tuple[int, int]],
    masks: Sequence[str] | None = None,
    progress: Count | None = None,
) -> Detections:
    """All cars in the images ``names`` (and ``masks``) of ``folder``, whose (width, height) are ``sizes``."""
    paths = [folder / mask for mask in masks] if masks else [None] * len(names)
    images = [CarImage(folder / name, mask) for name, mask in zip(names, paths, strict=True)]
    found = find_cars(detector, images, names, sizes, folder, progress)
    if not any(len(rows) for rows in found.frames.values()):
        raise KroncError(no_car(detector, len(names), folder) + ", or give --keypoints")
    return found


def find_cars(
    detector: Detector,
    images: Sequence[CarImage],
    names: Sequence[str],
    sizes: Sequence[tuple[int, int]],
    folder: Path,
    progress: Count | None = None,
) -> Detections:
    """The cars in images of any (width, height), none perhaps; ``names`` are what to call them.

    Points outside the image, where a car is cut by its border, are guesses and left out.
    """
    cars = detect_all(detector, images, progress)
    _check_upright(cars, folder)
    frames, sigmas = {}, {}
    for name, found, size in zip(names, cars, sizes, strict=True):
        found = [car for car in found if not car.turned_deg]
        rows = np.zeros((len(found), len(detector.schema), 3))
        sigma = np.zeros((len(found), len(detector.schema)))
        for number, car in enumerate(found):
            seen = (car.confidence > 0) & (car.uv >= 0).all(1) & (car.uv < size).all(1)
            rows[number, seen] = np.column_stack([car.uv, car.confidence])[seen]
            if car.sigma_px is not None:
                sigma[number, seen] = car.sigma_px[seen]
        frames[name], sigmas[name] = rows, sigma
    known = all(car.sigma_px is not None for found in cars for car in found if not car.turned_deg)
    common = sizes[0] if len({*sizes}) == 1 else None
    return Detections(folder, detector.schema, frames, common, sigmas if known else None)


def no_car(detector: Detector, count: int, folder: Path) -> str:
    """What to say where no image shows a car."""
    return (
        f"no car was found in any of the {count} images of {folder} ({detector.identity.split()[0]}): "
        "check that they show the car upright and whole"
    )


def _check_upright(cars: Sequence[Sequence[CarDetection]], folder: Path) -> None:
    """Raise `KroncError` where more images show a turned car than an upright one."""
    turned = Counter(found[0].turned_deg for found in cars if found)
    upright = turned.pop(0, 0)
    if sum(turned.values()) > upright:
        (degrees, count), *_ = turned.most_common(1)
        raise KroncError(f"in {count} of {len(cars)} images of {folder} the car {_TURNED[degrees]}")
