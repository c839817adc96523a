"""The detectors there are, and how the user chooses one."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
from typing_extensions import assert_never

from kronc_ns.capture.detection.detector import CarImage, Detector
from kronc_ns.capture.detection.store import detect_all
from kronc_ns.capture.progress import Count
from kronc_ns.errors import KroncError
from kronc_ns.files.keypoints import Detections

DetectorName: TypeAlias = Literal["openpifpaf", "onnx", "yolo-pose", "simcc"]


@dataclass
class DetectorOptions:
    """How keypoints are found."""

    detector: DetectorName | None = None
    """Find the keypoints with openpifpaf (in an environment of its own, made on first use), a composite-field network
    that `kronc convert-detector` wrote (onnx), a YOLO pose model or a SimCC model such as RTMPose, both as ONNX."""
    detector_weights: Path | None = None
    """ONNX file of the detector; for openpifpaf a checkpoint or its name (default shufflenetv2k16-apollo-66)."""
    detector_python: Path | None = None
    """A Python that has openpifpaf, instead of one that uvx provides."""

    def make(self) -> Detector | None:
        """The detector, ready to run, if one was chosen; raises `KroncError` for what is missing."""
        name, weights = self.detector, self.detector_weights
        if name is None:
            if weights is not None or self.detector_python is not None:
                raise KroncError("--detector-weights and --detector-python say what a --detector uses: give that too")
            return None
        if name == "openpifpaf":
            from kronc_ns.capture.detection.pifpaf import OpenPifPafDetector

            return OpenPifPafDetector(weights, self.detector_python)
        if weights is None:
            raise KroncError(f"--detector {name} needs --detector-weights: expected an ONNX file")
        match name:
            case "onnx":
                from kronc_ns.capture.detection.composite import CompositeFieldDetector

                return CompositeFieldDetector(weights)
            case "yolo-pose":
                from kronc_ns.capture.detection.yolo_pose import YoloPoseDetector

                return YoloPoseDetector(weights)
            case "simcc":
                from kronc_ns.capture.detection.simcc import SimccDetector

                return SimccDetector(weights)
            case _:
                assert_never(name)


def find_keypoints(
    detector: Detector,
    folder: Path,
    names: Sequence[str],
    size: tuple[int, int],
    masks: Sequence[str] | None = None,
    progress: Count | None = None,
) -> Detections:
    """All cars in the images ``names`` (and ``masks``) of ``folder``, as a keypoint file would hold them.

    ``size`` is (width, height) of all images. Points outside the image, where a car is cut by its border, are guesses
    and left out.
    """
    paths = [folder / mask for mask in masks] if masks else [None] * len(names)
    images = [CarImage(folder / name, mask) for name, mask in zip(names, paths, strict=True)]
    cars = detect_all(detector, images, progress)
    if not any(cars):
        raise KroncError(
            f"no car was found in any of the {len(names)} images of {folder} ({detector.identity.split()[0]}): "
            "check that they show the car upright and whole, or give --keypoints"
        )
    frames = {}
    for name, found in zip(names, cars, strict=True):
        rows = np.zeros((len(found), len(detector.schema), 3))
        for row, car in zip(rows, found, strict=True):
            seen = (car.confidence > 0) & (car.uv >= 0).all(1) & (car.uv < size).all(1)
            row[seen] = np.column_stack([car.uv, car.confidence])[seen]
        frames[name] = rows
    return Detections(folder / "images", detector.schema, frames, size)
