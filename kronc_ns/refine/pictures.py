"""What refinement sees of the photos: whoever reads files hands them in, one at a time."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8


@dataclass(frozen=True)
class Picture:
    """A photo as it was taken, lens distortion included."""

    rgb: UInt8[np.ndarray, "h w 3"]
    vehicle: UInt8[np.ndarray, "h w"] | None = None
    """Above 0 where the vehicle is, None where nobody says."""


@runtime_checkable
class Pictures(Protocol):
    """The photos of a scene's views; called from several threads."""

    def __call__(self, view: int) -> Picture:
        """The photo of a view."""
        ...
