"""What a segmenter is: an image in, the cars in it out, each as a number in a map of labels."""

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, UInt8

VEHICLES = ("car", "bus", "truck")
"""What COCO calls the things that a walk may go around."""
MAX_CARS = 20
_SMALLEST_SHARE = 5e-4  # of the image; what is smaller is noise


@runtime_checkable
class Segmenter(Protocol):
    """A segmenter that is ready to run."""

    @property
    def identity(self) -> str:
        """Changes with everything that may change the answer to the same image."""
        ...

    def segment(self, rgb: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w"]:
        """Label of the car that each pixel belongs to, the surest car being 1; 0: none."""
        ...


def label_map(masks: Bool[np.ndarray, "m h w"]) -> UInt8[np.ndarray, "h w"]:
    """Labels 1, 2, ... of the given objects, the first ones on top, without holes and crumbs; empty ones have none."""
    labels = np.zeros(masks.shape[1:], dtype=np.uint8)
    number = 0
    for mask in masks[:MAX_CARS]:
        whole = without_holes(mask) & (labels == 0)
        if whole.sum() >= _SMALLEST_SHARE * whole.size:
            number += 1
            labels[whole] = number
    return labels


def without_holes(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The largest connected part with everything that it encloses."""
    import cv2

    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    filled = np.zeros(mask.shape, dtype=np.uint8)
    if outlines:
        cv2.drawContours(filled, [max(outlines, key=cv2.contourArea)], -1, (1,), cv2.FILLED)
    return filled > 0
