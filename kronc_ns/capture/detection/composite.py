"""`--detector onnx`: a composite-field network that `kronc convert-detector` took out of OpenPifPaf."""

from collections.abc import Generator, Sequence
from pathlib import Path

import cv2
import numpy as np

from kronc_ns.capture.detection.cif import decode_cif
from kronc_ns.capture.detection.detector import CarDetection, CarImage, bounds
from kronc_ns.capture.detection.model import OnnxModel, open_model
from kronc_ns.capture.detection.pixels import MAX_LONG_SIDE, lies_on, normalise, read_rgb, shrink
from kronc_ns.errors import KroncError
from kronc_ns.files.images import read_mask
from kronc_ns.keypoints.schema import KeypointSchema

_DECODER = 1  # raise it when the same fields give other points
_MARGIN = 0.01  # around the mask, as a share of the image's longer side


class CompositeFieldDetector:
    """One car per image: the strongest peak of each keypoint's field, within the mask where there is one."""

    uses_masks = True

    def __init__(self, weights: Path) -> None:
        self._model: OnnxModel = open_model(weights)
        card = weights.with_suffix(".json")
        if not self._model.sidecar:
            raise KroncError(f"{card} does not exist: `kronc convert-detector` writes it beside {weights.name}")
        if self._model.sidecar.get("sha256") != self._model.sha256:
            raise KroncError(f"{card} belongs to another file than {weights}: run `kronc convert-detector` again")
        shape = self._model.session.get_outputs()[0].shape
        if len(shape) != 5 or not isinstance(shape[1], int) or shape[2] != 5:
            raise KroncError(f"{weights} gives {shape}: expected intensity fields [1, points, 5, height, width]")
        self.schema: KeypointSchema = self._model.schema(shape[1])
        self._stride = self._model.number("stride", 8.0)
        self._threshold = self._model.number("threshold", 0.1)

    @property
    def identity(self) -> str:
        """Model, threshold and decoder."""
        return f"onnx {self._model.sha256} {self._stride} {self._threshold} {MAX_LONG_SIDE} {_DECODER}"

    def detect(self, images: Sequence[CarImage]) -> Generator[list[CarDetection], None, None]:
        """One car, or none, in each image."""
        return (self._detect(image) for image in images)

    def _detect(self, image: CarImage) -> list[CarDetection]:
        rgb = read_rgb(image.path)
        small, placement = shrink(rgb, MAX_LONG_SIDE)
        fields = self._model.run(_pad(normalise(small)))[0][0]

        def in_image(cells: np.ndarray) -> np.ndarray:
            # the networks count pixels from the centre of the first one
            return placement.to_image(self._stride * cells + 0.5)

        if image.mask is None:
            cells, confidence = decode_cif(fields)
        else:
            near_car = _with_margin(read_mask(image.mask, (rgb.shape[1], rgb.shape[0])))
            cells, confidence = decode_cif(fields, lambda places: lies_on(near_car, in_image(places)))
        uv = in_image(cells)
        confidence = np.where(confidence >= self._threshold, confidence, 0.0)
        if not (confidence > 0).any():
            return []
        return [CarDetection(uv, confidence, bounds(uv, confidence), float(confidence[confidence > 0].mean()))]


def _with_margin(mask: np.ndarray) -> np.ndarray:
    """The mask widened by a margin: many keypoints lie on the outline, and votes for them fall on both sides."""
    margin = round(_MARGIN * max(mask.shape))
    return cv2.dilate(mask, np.ones((2 * margin + 1, 2 * margin + 1), dtype=np.uint8)) > 0


def _pad(planes: np.ndarray) -> np.ndarray:
    """Zeros (the mean colour) to the right and below, up to a multiple of 16 plus 1, as the networks are trained."""
    height, width = planes.shape[2:]
    return np.pad(planes, ((0, 0), (0, 0), (0, (1 - height) % 16), (0, (1 - width) % 16)))
