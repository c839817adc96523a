"""`--segmenter mask2former`: cars, buses and trucks by Mask2Former (Cheng et al., CVPR 2022), as in the paper."""

from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from kronc_ns.capture.pretrained import load_pretrained, transformers_for
from kronc_ns.capture.segmentation.segmenter import VEHICLES, label_map
from kronc_ns.errors import KroncError

MODEL = "facebook/mask2former-swin-large-coco-instance"
_MIN_SCORE = 0.5


class Mask2FormerSegmenter:
    """All cars in an image."""

    def __init__(self, weights: Path | None) -> None:
        transformers = transformers_for("--segmenter mask2former", "mask2former")
        model_class = transformers.Mask2FormerForUniversalSegmentation
        self._network = load_pretrained(model_class, weights, MODEL, "--segmenter-weights")
        labels = self._network.model.config.id2label
        self._vehicles = {number for number, label in labels.items() if label in VEHICLES}
        if not self._vehicles:
            known = f"{weights or MODEL} knows no {', '.join(VEHICLES)}"
            raise KroncError(f"{known}: expected a model trained on COCO, like {MODEL}")

    @property
    def identity(self) -> str:
        """Model, its revision or content, and threshold."""
        return f"mask2former {self._network.name} {_MIN_SCORE}"

    def segment(self, rgb: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w"]:
        """The cars, the surest first."""
        import torch

        network = self._network
        inputs = network.processor(images=rgb, return_tensors="pt").to(network.device)
        with torch.inference_mode():
            (found,) = network.processor.post_process_instance_segmentation(
                network.model(**inputs), threshold=_MIN_SCORE, target_sizes=[rgb.shape[:2]]
            )
        numbers = found["segmentation"].cpu().numpy()
        cars = [segment for segment in found["segments_info"] if segment["label_id"] in self._vehicles]
        cars.sort(key=lambda segment: segment["score"], reverse=True)
        return label_map(np.array([segment["id"] for segment in cars])[:, None, None] == numbers[None])
