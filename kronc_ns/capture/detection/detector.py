"""What a keypoint detector is: images in, cars with named points out."""

from collections.abc import Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from kronc_ns.keypoints.schema import KeypointSchema


@dataclass(frozen=True)
class CarImage:
    """An upright image, and where in it the car is, if that is known."""

    path: Path
    mask: Path | None = None
    """Image of the same size: above 127 on the car."""


@dataclass(frozen=True, eq=False)
class CarDetection:
    """One car in one image; pixels of the image as it is stored, its top-left corner being (0, 0)."""

    uv: Float[np.ndarray, "k 2"]
    confidence: Float[np.ndarray, "k"]
    """0 to 1; 0: not found, ``uv`` means nothing."""
    bbox: Float[np.ndarray, "4"]
    """Left, top, right, bottom."""
    score: float
    """Confidence that this is a car, 0 to 1."""
    sigma_px: Float[np.ndarray, "k"] | None = None
    """Standard deviation of each place along one axis, where the detector knows it."""
    turned_deg: int = 0
    """90, 180 or 270: the car was recognised only after turning the image so far counter-clockwise; no points."""


@runtime_checkable
class Detector(Protocol):
    """A keypoint detector that is ready to run: what it needs was found when it was made."""

    @property
    def schema(self) -> KeypointSchema:
        """What the K points are called."""
        ...

    @property
    def identity(self) -> str:
        """Changes with everything that may change the answer to the same image: model, thresholds, decoder."""
        ...

    @property
    def uses_masks(self) -> bool:
        """Whether the answer depends on the masks."""
        ...

    def detect(self, images: Sequence[CarImage]) -> Generator[list[CarDetection], None, None]:
        """The cars in each image, in order, as soon as each is done; raises `KroncError` for what the user can mend."""
        ...


def bounds(uv: Float[np.ndarray, "*n k 2"], confidence: Float[np.ndarray, "*n k"]) -> Float[np.ndarray, "*n 4"]:
    """Left, top, right, bottom of the points that were found; NaN without any."""
    found = np.where(confidence[..., None] > 0, uv, np.nan)
    if not (confidence > 0).any():
        return np.full((*uv.shape[:-2], 4), np.nan)
    return np.concatenate([np.nanmin(found, axis=-2), np.nanmax(found, axis=-2)], axis=-1)
