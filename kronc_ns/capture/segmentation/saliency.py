"""`--segmenter saliency`: what stands out from a calm background, by a network of the U2-Net family as ONNX."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from kronc_ns.capture.detection.model import OnnxModel, open_model
from kronc_ns.capture.detection.pixels import normalise
from kronc_ns.capture.segmentation.segmenter import label_map
from kronc_ns.errors import KroncError

_SIDE = 320  # of the square input, where the file does not say
_STANDS_OUT = 0.5


class SaliencySegmenter:
    """One object per image."""

    def __init__(self, weights: Path) -> None:
        self._model: OnnxModel = open_model(weights)
        shape = self._model.session.get_outputs()[0].shape
        if len(shape) != 4 or shape[1] != 1:
            raise KroncError(f"{weights} gives {shape}: expected a saliency network, [1, 1, height, width]")
        self._size = self._model.input_size or (_SIDE, _SIDE)

    @property
    def identity(self) -> str:
        """Model and threshold."""
        return f"saliency {self._model.sha256} {_STANDS_OUT}"

    def segment(self, rgb: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w"]:
        """The largest thing that stands out."""
        small = cv2.resize(rgb, self._size, interpolation=cv2.INTER_AREA).astype(np.uint8)
        saliency = self._model.run(normalise(small))[0][0, 0]
        # these networks say what stands out more: their range is stretched, as in training
        low, high = float(saliency.min()), float(saliency.max())
        full = cv2.resize(saliency, (rgb.shape[1], rgb.shape[0]), interpolation=cv2.INTER_LINEAR)
        return label_map((full > low + _STANDS_OUT * (high - low))[None] & (high > low))
