"""How poses are refined by image features."""

from dataclasses import dataclass
from typing import Literal

Region = Literal["auto", "vehicle", "frame"]


@dataclass(frozen=True)
class RefineConfig:
    """How poses are refined by image features."""

    region: Region = "auto"
    """Where features may lie. vehicle: inside the masks, or without them around the keypoints; frame: everywhere;
    auto: everywhere, unless the background stands still while the car turns."""
    refine_focal: bool = False
    """Whether the focal length is unknown too."""
    refine_k1: bool = False
    """Whether the first radial distortion coefficient is unknown too."""
    seed: int = 0
    """Seed of the choice of tracks that are held out."""
