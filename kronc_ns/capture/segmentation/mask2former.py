"""`--segmenter mask2former`: cars, buses and trucks by Mask2Former (Cheng et al., CVPR 2022), as in the paper."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8

from kronc_ns.capture.segmentation.segmenter import VEHICLES, label_map
from kronc_ns.errors import KroncError

MODEL = "facebook/mask2former-swin-large-coco-instance"
_MIN_SCORE = 0.5


class Mask2FormerSegmenter:
    """All cars in an image."""

    def __init__(self, weights: Path | None) -> None:
        try:
            from transformers import AutoImageProcessor, Mask2FormerForUniversalSegmentation
        except ImportError:
            raise KroncError(
                "--segmenter mask2former needs transformers, which is not installed: "
                "pip install 'kronc-ns[mask2former]'"
            ) from None
        name = str(weights or MODEL)
        try:
            self._processor: Any = AutoImageProcessor.from_pretrained(name)
            model: Any = Mask2FormerForUniversalSegmentation.from_pretrained(name)
        except (OSError, ValueError) as error:
            raise KroncError(
                f"{name} cannot be loaded ({str(error).strip().splitlines()[0]}): give as --segmenter-weights a folder "
                f"with what `hf download {MODEL} --local-dir FOLDER` fetches"
            ) from None
        labels = model.config.id2label
        self._vehicles = {number for number, label in labels.items() if label in VEHICLES}
        if not self._vehicles:
            raise KroncError(f"{name} knows no {', '.join(VEHICLES)}: expected a model trained on COCO, like {MODEL}")
        self._device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self._model = model.eval().to(self._device)
        self._name = f"{name} {getattr(model.config, '_commit_hash', None)}"

    @property
    def identity(self) -> str:
        """Model, its revision, and threshold."""
        return f"mask2former {self._name} {_MIN_SCORE}"

    @torch.inference_mode()
    def segment(self, rgb: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w"]:
        """The cars, the surest first."""
        inputs = self._processor(images=rgb, return_tensors="pt").to(self._device)
        (found,) = self._processor.post_process_instance_segmentation(
            self._model(**inputs), threshold=_MIN_SCORE, target_sizes=[rgb.shape[:2]]
        )
        numbers = found["segmentation"].cpu().numpy()
        cars = [segment for segment in found["segments_info"] if segment["label_id"] in self._vehicles]
        cars.sort(key=lambda segment: segment["score"], reverse=True)
        return label_map(np.array([segment["id"] for segment in cars])[:, None, None] == numbers[None])
