"""A car that can be rendered for training, with its keypoints."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, UInt8

from kronc_ns.training.meshes import TexturedMesh


@dataclass(frozen=True, eq=False)
class Decal:
    """A picture painted over the surfaces that face one way: seams, handles, plates, stickers, dirt."""

    view: Literal["left", "right", "front", "rear", "top"]
    """The side of the car it is painted on: left and right lie in (x, z), front and rear in (y, z), top in (x, y)."""
    rgba: UInt8[np.ndarray, "h w 4"]
    """Straight alpha; the column grows with the first axis of the view, the row falls with the second."""
    corner: tuple[float, float]
    """Metres: the smallest first coordinate (left edge), the largest second one (top edge)."""
    metres_per_texel: float
    surfaces: tuple[str, ...] | None = None
    """Names of the surfaces that take it; None: all."""
    glossy: bool = False
    """Under the clear coat; else it takes the shine away."""


@dataclass(frozen=True, eq=False)
class Body:
    """A car: x forward, y left, z up, tyres on z = 0, metres."""

    name: str
    mesh: TexturedMesh
    keypoints: Float[np.ndarray, "66 3"]
    """Points on the surface in the ApolloCar3D order; NaN where the car has no such feature."""
    decals: tuple[Decal, ...] = ()

    @property
    def present(self) -> Bool[np.ndarray, "66"]:
        """Which features the car has."""
        return np.isfinite(self.keypoints).all(1)
