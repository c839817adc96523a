"""`--detector yolo-pose`: keypoint models of the YOLO family as their exporter writes them to ONNX."""

import ast
from collections.abc import Generator, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from kronc_ns.capture.detection.detector import CarDetection, CarImage
from kronc_ns.capture.detection.model import OnnxModel, open_model
from kronc_ns.capture.detection.pixels import Placement, letterbox, read_rgb
from kronc_ns.errors import KroncError
from kronc_ns.keypoints.schema import KeypointSchema

_DEFAULT_SIDE = 640
_MAX_OVERLAP = 0.7  # of two cars' boxes (intersection over union)


class YoloPoseDetector:
    """All cars in an image, each with its points.

    ``kpt_shape`` in the file's metadata says how many points there are and whether each has a confidence. Both layouts
    are read: candidates [1, 4 + classes + points, anchors], and finished instances [1, instances, 6 + points].
    """

    uses_masks = False

    def __init__(self, weights: Path) -> None:
        self._model: OnnxModel = open_model(weights)
        shape = _literal(self._model.metadata.get("kpt_shape"))
        if not (isinstance(shape, list | tuple) and len(shape) == 2 and shape[0] >= 4 and shape[1] in (2, 3)):
            raise KroncError(
                f"{weights} has no keypoints (kpt_shape {shape}): expected a pose model exported by its own tool, "
                "which writes kpt_shape into the metadata"
            )
        self._points, self._values = int(shape[0]), int(shape[1])
        self._size = self._model.input_size or _exported_size(self._model)
        self.schema: KeypointSchema = self._model.schema(self._points)
        self._threshold = self._model.number("threshold", 0.25)
        self._point_threshold = self._model.number("point_threshold", 0.5)

    @property
    def identity(self) -> str:
        """Model and thresholds."""
        return f"yolo-pose {self._model.sha256} {self._size} {self._threshold} {self._point_threshold}"

    def detect(self, images: Sequence[CarImage]) -> Generator[list[CarDetection], None, None]:
        """The cars in each image, the surest first."""
        return (self._detect(image) for image in images)

    def _detect(self, image: CarImage) -> list[CarDetection]:
        rgb, placement = letterbox(read_rgb(image.path), self._size)
        planes = rgb.astype(np.float32).transpose(2, 0, 1)[None] / 255
        output = self._model.run(planes)[0][0]
        values = self._points * self._values
        if output.ndim == 2 and output.shape[1] == 6 + values:
            boxes, scores, points = output[:, :4], output[:, 4], output[:, 6:]
            kept = np.flatnonzero(scores >= self._threshold)
        elif output.ndim == 2 and output.shape[0] >= 5 + values:
            middle, sides = output[:2].T, output[2:4].T
            boxes = np.concatenate([middle - sides / 2, middle + sides / 2], axis=1)
            scores, points = output[4:-values].max(0), output[-values:].T
            kept = _suppress(boxes, scores, self._threshold)
        else:
            raise KroncError(
                f"{self._model.path} gives {list(output.shape)} numbers an image: expected {5 + values} rows of "
                f"candidates or instances of {6 + values} numbers for {self._points} points"
            )
        return [self._car(boxes[i], float(scores[i]), points[i], placement) for i in kept]

    def _car(
        self,
        box: Float[np.ndarray, "4"],
        score: float,
        points: Float[np.ndarray, "v"],
        placement: Placement,
    ) -> CarDetection:
        rows = points.reshape(self._points, self._values).astype(np.float64)
        if self._values == 3:
            confidence = np.where(rows[:, 2] >= self._point_threshold, rows[:, 2], 0.0).clip(0, 1)
        else:
            confidence = np.full(self._points, min(score, 1.0))
        bbox = placement.to_image(box.reshape(2, 2).astype(np.float64)).reshape(4)
        return CarDetection(placement.to_image(rows[:, :2]), confidence, bbox, min(score, 1.0))


def _suppress(boxes: Float[np.ndarray, "m 4"], scores: Float[np.ndarray, "m"], threshold: float) -> np.ndarray:
    """Indices of the surest box of each heap of overlapping ones, the surest first."""
    corners = np.concatenate([boxes[:, :2], boxes[:, 2:] - boxes[:, :2]], axis=1)
    return np.asarray(cv2.dnn.NMSBoxes(corners.tolist(), scores.tolist(), threshold, _MAX_OVERLAP), dtype=int).ravel()


def _exported_size(model: OnnxModel) -> tuple[int, int]:
    """(width, height) that the exporter was told, for networks that take any size."""
    size = _literal(model.metadata.get("imgsz"))
    if isinstance(size, list | tuple) and len(size) == 2 and all(isinstance(side, int) for side in size):
        return size[1], size[0]
    return _DEFAULT_SIDE, _DEFAULT_SIDE


def _literal(text: str | None) -> object:
    try:
        return ast.literal_eval(text or "None")
    except (SyntaxError, ValueError):
        return text
