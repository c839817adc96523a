"""`--segmenter maskrcnn`: cars, buses and trucks by torchvision's Mask R-CNN, trained on COCO."""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from kronc_ns.capture.detection.model import file_sha256
from kronc_ns.capture.segmentation.segmenter import MAX_CARS, VEHICLES, label_map
from kronc_ns.errors import KroncError

_MIN_SCORE = 0.5
_ON_CAR = 0.5


class MaskRcnnSegmenter:
    """All cars in an image."""

    def __init__(self, weights: Path | None) -> None:
        import torch
        from torchvision.models.detection import MaskRCNN_ResNet50_FPN_V2_Weights, maskrcnn_resnet50_fpn_v2

        published = MaskRCNN_ResNet50_FPN_V2_Weights.COCO_V1
        file = weights or Path(torch.hub.get_dir()) / "checkpoints" / published.url.rsplit("/", 1)[-1]
        names = published.meta["categories"]
        self._vehicles = torch.tensor([names.index(name) for name in VEHICLES])
        model: Any = maskrcnn_resnet50_fpn_v2(
            weights=None, weights_backbone=None, num_classes=len(names), box_detections_per_img=MAX_CARS
        )
        model.load_state_dict(_load(file, published.url, model.state_dict()))
        self._device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self._model = model.eval().to(self._device)
        self._sha256 = file_sha256(file)

    @property
    def identity(self) -> str:
        """Weights and thresholds."""
        return f"maskrcnn {self._sha256} {_MIN_SCORE} {_ON_CAR}"

    def segment(self, rgb: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w"]:
        """The cars, the surest first."""
        import torch

        image = torch.from_numpy(rgb).permute(2, 0, 1).to(self._device).float() / 255
        with torch.inference_mode():
            (found,) = self._model([image])
        wanted = (found["scores"] >= _MIN_SCORE) & torch.isin(found["labels"].cpu(), self._vehicles).to(self._device)
        return label_map((found["masks"][wanted, 0] > _ON_CAR).cpu().numpy())


def _load(file: Path, url: str, expected: dict[str, Any]) -> dict[str, Any]:
    """The weights, fetched first if they are torchvision's and not there yet."""
    import torch

    if not file.is_file() and file.name == url.rsplit("/", 1)[-1]:
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            torch.hub.download_url_to_file(url, str(file), hash_prefix=file.stem.rsplit("-", 1)[-1], progress=False)
        except (OSError, RuntimeError) as error:
            raise KroncError(
                f"the weights of --segmenter maskrcnn are missing and {url} cannot be had ({error}): fetch it "
                f"elsewhere and put it at {file}, or give its path as --segmenter-weights"
            ) from None
    try:
        state = torch.load(file, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise KroncError(f"--segmenter-weights {file} does not exist: expected weights of Mask R-CNN") from None
    except (RuntimeError, EOFError, ValueError, pickle.UnpicklingError) as error:
        reason = str(error).strip().splitlines()[0]
        raise KroncError(f"{file} is no file of weights ({reason}): fetch it anew from {url}") from None
    if not isinstance(state, dict) or state.keys() != expected.keys():
        raise KroncError(f"{file} holds other weights: expected those of torchvision's maskrcnn_resnet50_fpn_v2")
    return state
