"""What a bundle adjustment of many points is given and what it seeks, and the directions that no image fixes."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

Array = NDArray[Any]


class Sightings(NamedTuple):
    """What is measured: S sightings of P points by N cameras through G lenses."""

    first: Array
    """[P + 1]"""
    camera: Array
    """[S] by which camera; none sees a point twice"""
    uv: Array
    """[S, 2] undistorted pixels less the principal point"""
    weight: Array
    """[S] inverse variance along one axis, 1 / px^2"""
    scale: Array
    """[S] of the Cauchy loss, in pixels"""
    focal: Array
    """[2]"""
    lens: Array
    """[N] which of the lenses each camera has"""
    with_focal: bool
    with_k1: bool

    @property
    def intrinsics(self) -> int:
        """Refined intrinsics of a lens."""
        return int(self.with_focal) + int(self.with_k1)

    @property
    def unknowns(self) -> int:
        """Of the reduced system."""
        return 6 * len(self.lens) + self.intrinsics * (int(self.lens.max(initial=0)) + 1)

    @property
    def of_point(self) -> Int[np.ndarray, "s"]:
        """Which point each sighting is of."""
        return np.repeat(np.arange(len(self.first) - 1), np.diff(self.first))


class Unknowns(NamedTuple):
    """What is sought."""

    rotation: Array
    """[N, 3, 3] world to camera"""
    translation: Array
    """[N, 3] world to camera"""
    points: Array
    """[P, 3]"""
    intrinsics: Array
    """[G, 2]: logarithm of the focal length's factor, k1 beyond what the pixels are undistorted by"""


def gauge_of(now: Unknowns, unknowns: int) -> Float[np.ndarray, "f 7"]:
    """How shift, turn and growth of the world move the reduced unknowns: directions that change no image."""
    moves = np.zeros((unknowns, 7))
    for n, (r, t) in enumerate(zip(now.rotation, now.translation, strict=True)):
        at = 6 * n
        moves[at + 3 : at + 6, :3] = -r  # the world moves by s: t becomes t - R s
        moves[at : at + 3, 3:6] = -r  # it turns by w about its origin: R becomes R exp(-w)
        for axis in range(3):  # ... and t, on which a turn in camera axes acts as well, stays
            moves[at + 3 : at + 6, 3 + axis] = np.cross(r[:, axis], t)
        moves[at + 3 : at + 6, 6] = t
    return moves
