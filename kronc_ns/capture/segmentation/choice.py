"""The segmenters there are, and the masks of one car over all frames."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image
from typing_extensions import assert_never

from kronc_ns.capture.detection.model import file_sha256
from kronc_ns.capture.detection.pixels import MAX_LONG_SIDE, read_rgb, shrink
from kronc_ns.capture.progress import Count
from kronc_ns.capture.segmentation.segmenter import Segmenter
from kronc_ns.errors import KroncError
from kronc_ns.files.cache import cache_folder
from kronc_ns.files.output import atomic_path
from kronc_ns.keypoints.selection import consistent_path, prominence

SegmenterName: TypeAlias = Literal["maskrcnn", "mask2former", "saliency"]


@dataclass
class SegmenterOptions:
    """How masks are made."""

    segmenter: SegmenterName | None = None
    """Make the masks with torchvision's Mask R-CNN, with Mask2Former (both: cars, buses, trucks), or with a saliency
    network of the U2-Net family as ONNX, for one car before a calm background."""
    segmenter_weights: Path | None = None
    """Weights of the segmenter: a file, for mask2former a folder or a name on the Hugging Face hub (default, but not
    for saliency: the published ones, downloaded)."""

    def make(self) -> Segmenter | None:
        """The segmenter, ready to run, if one was chosen; raises `KroncError` for what is missing."""
        match self.segmenter:
            case None:
                if self.segmenter_weights is not None:
                    raise KroncError("--segmenter-weights says what a --segmenter uses: give that too")
                return None
            case "maskrcnn":
                from kronc_ns.capture.segmentation.mask_rcnn import MaskRcnnSegmenter

                return MaskRcnnSegmenter(self.segmenter_weights)
            case "mask2former":
                from kronc_ns.capture.segmentation.mask2former import Mask2FormerSegmenter

                return Mask2FormerSegmenter(self.segmenter_weights)
            case "saliency":
                from kronc_ns.capture.segmentation.saliency import SaliencySegmenter

                if self.segmenter_weights is None:
                    raise KroncError("--segmenter saliency needs --segmenter-weights: expected an ONNX file")
                return SaliencySegmenter(self.segmenter_weights)
            case _:
                assert_never(self.segmenter)


def segment_car(
    segmenter: Segmenter, images: Sequence[Path], folder: Path, progress: Count | None = None
) -> tuple[tuple[Path, ...], str]:
    """Masks (255 on the car, else 0) of one car in ``folder``, one for each image in order, and a note on the choice.

    Among several cars a large one near the middle is followed over the frames. Where none is found the mask is empty.
    """
    files = []
    for done, image in enumerate(images, start=1):
        files.append(_labels_of(segmenter, image))
        if progress is not None:
            progress(done, len(images), None)
    counted = [_boxes(_read(file)) for file in files]
    filled = [i for i, (boxes, _) in enumerate(counted) if len(boxes)]
    if not filled:
        raise KroncError(
            f"no car was segmented in any of the {len(images)} images ({segmenter.identity.split()[0]}): check that "
            "they show it, or give --masks"
        )
    boxes = [counted[i][0] for i in filled]
    path = consistent_path(
        [prominence(box, counted[i][1]) for i, box in zip(filled, boxes, strict=True)], boxes, filled
    )
    labels = dict(zip(filled, (choice + 1 for choice in path), strict=True))
    masks = tuple(folder / f"{number:06d}.png" for number in range(len(images)))
    for number, (image, file, mask) in enumerate(zip(images, files, masks, strict=True)):
        with Image.open(image) as header:
            size = header.size
        Image.fromarray(_mask(_read(file), labels.get(number, 0), size)).save(mask)
    several = sum(len(box) > 1 for box in boxes)
    notes = [f"none in {len(images) - len(filled)}"] if len(filled) < len(images) else []
    notes += [f"several cars in {several}: the main one was taken, consistent over the frames"] if several else []
    return masks, "; ".join([f"{len(filled)} of {len(images)} frames", *notes])


def _labels_of(segmenter: Segmenter, image: Path) -> Path:
    """File with the labels of an image, made now if it is not kept from before."""
    key = hashlib.sha256(f"{segmenter.identity}\n{MAX_LONG_SIDE}\n{file_sha256(image)}".encode()).hexdigest()
    file = cache_folder() / "segments" / key[:2] / f"{key[2:]}.png"
    if not file.exists():
        small, _ = shrink(read_rgb(image), MAX_LONG_SIDE)
        labels = segmenter.segment(small)
        with atomic_path(file) as temporary:
            Image.fromarray(labels).save(temporary)
    return file


def _read(file: Path) -> UInt8[np.ndarray, "h w"]:
    with Image.open(file) as image:
        return np.array(image)


def _boxes(labels: UInt8[np.ndarray, "h w"]) -> tuple[Float[np.ndarray, "m 4"], tuple[int, int]]:
    """Centre and sides of each label in image diagonals, and the size of the map."""
    import cv2

    rows = [cv2.boundingRect((labels == label).astype(np.uint8)) for label in range(1, int(labels.max()) + 1)]
    corners = np.array(rows, dtype=np.float64).reshape(-1, 4)
    boxes = np.concatenate([corners[:, :2] + corners[:, 2:] / 2, corners[:, 2:]], axis=1)
    height, width = labels.shape
    return boxes / np.hypot(width, height), (width, height)


def _mask(labels: UInt8[np.ndarray, "h w"], label: int, size: tuple[int, int]) -> UInt8[np.ndarray, "h2 w2"]:
    """255 on the label's pixels (0: nowhere), in the size of the image, with smooth outlines."""
    import cv2

    on_car = ((labels == label) & (label > 0)).astype(np.float32)
    return np.where(cv2.resize(on_car, size, interpolation=cv2.INTER_LINEAR) > 0.5, 255, 0).astype(np.uint8)
