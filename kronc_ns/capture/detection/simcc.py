"""`--detector simcc`: networks that classify the coordinates of each point (Li et al.: SimCC, ECCV 2022), as RTMPose.

They take one car cut out of the image: the mask's box, or without a mask the whole image.
"""

from collections.abc import Generator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from kronc_ns.capture.detection.detector import CarDetection, CarImage
from kronc_ns.capture.detection.model import OnnxModel, open_model
from kronc_ns.capture.detection.pixels import box_of_mask, crop, normalise, read_rgb
from kronc_ns.errors import KroncError
from kronc_ns.keypoints.schema import KeypointSchema

_PADDING = 1.25  # of the box, as in training


class SimccDetector:
    """One car per image."""

    uses_masks = True

    def __init__(self, weights: Path) -> None:
        self._model: OnnxModel = open_model(weights)
        size = self._model.input_size
        shapes = [output.shape for output in self._model.session.get_outputs()]
        if size is None or len(shapes) != 2 or any(len(s) != 3 or not isinstance(s[1], int) for s in shapes):
            raise KroncError(
                f"{weights} takes {size} and gives {shapes}: expected images of one size, and two outputs "
                "[1, points, bins] for x and y"
            )
        self._size = size
        self.schema: KeypointSchema = self._model.schema(shapes[0][1])
        self._threshold = self._model.number("threshold", 0.3)

    @property
    def identity(self) -> str:
        """Model and threshold."""
        return f"simcc {self._model.sha256} {self._threshold}"

    def detect(self, images: Sequence[CarImage]) -> Generator[list[CarDetection], None, None]:
        """One car in each image; none where the mask is empty."""
        return (self._detect(image) for image in images)

    def _detect(self, image: CarImage) -> list[CarDetection]:
        rgb = read_rgb(image.path)
        box, padding = np.array([0.0, 0.0, rgb.shape[1], rgb.shape[0]]), 1.0
        if image.mask is not None:
            box, padding = box_of_mask(image.mask, (rgb.shape[1], rgb.shape[0])), _PADDING
        if box is None:
            return []
        drawn, placement = crop(rgb, box, self._size, padding)
        along_x, along_y = (logits[0] for logits in self._model.run(normalise(drawn)))
        (x, sure_x), (y, sure_y) = _peak(along_x), _peak(along_y)
        bins = np.array([along_x.shape[1], along_y.shape[1]]) / np.array(self._size)
        # bins are counted from the centre of the first pixel
        uv = placement.to_image(np.stack([x, y], axis=-1) / bins + 0.5)
        confidence = np.minimum(sure_x, sure_y)
        confidence = np.where(confidence >= self._threshold, confidence, 0.0).clip(0, 1)
        if not (confidence > 0).any():
            return []
        return [CarDetection(uv, confidence, box, float(confidence[confidence > 0].mean()))]


def _peak(logits: Float[np.ndarray, "k b"]) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k"]]:
    """Place of the maximum of each row, between the bins, and its value.

    The logits of a Gaussian are a parabola: the one through the maximum and its neighbours tells its vertex.
    """
    values = logits.astype(np.float64)
    at = values.argmax(1)
    inner = at.clip(1, values.shape[1] - 2)
    before, here, after = (np.take_along_axis(values, (inner + d)[:, None], axis=1)[:, 0] for d in (-1, 0, 1))
    bend = before - 2 * here + after
    vertex = inner + np.where(bend < 0, 0.5 * (before - after) / np.where(bend < 0, bend, -1.0), 0.0)
    return np.where(at == inner, vertex, at), values.max(1)
