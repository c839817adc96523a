"""Points for splatfacto to start from, in the solved world."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

_GREY = 128


@dataclass(frozen=True)
class Seeds:
    """Coloured points."""

    points: Float[np.ndarray, "p 3"]
    colours: UInt8[np.ndarray, "p 3"]

    def __add__(self, other: "Seeds") -> "Seeds":
        return Seeds(
            np.concatenate([self.points, other.points]),
            np.concatenate([self.colours, other.colours]),
        )


def grey(points: Float[np.ndarray, "p 3"]) -> Seeds:
    """Points whose colour is not known."""
    return Seeds(points, np.full(points.shape, _GREY, dtype=np.uint8))


def box_seeds(box: Float[np.ndarray, "2 3"], count: int) -> Seeds:
    """Points drawn uniformly from the car's box; always the same."""
    return grey(np.random.default_rng(0).uniform(box[0], box[1], (count, 3)))


def ground_seeds(box: Float[np.ndarray, "2 3"], c2w: Float[np.ndarray, "n 3 4"], count: int) -> Seeds:
    """Points on the level of the box's underside, out to where the cameras stand; always the same."""
    middle = box.mean(0)
    reach = np.linalg.norm(c2w[:, :2, 3] - middle[:2], axis=-1).max()
    share, turn = np.random.default_rng(1).random((2, count))
    radius, angle = reach * np.sqrt(share), 2 * np.pi * turn
    level = np.full(count, box[0, 2])
    return grey(np.stack([middle[0] + radius * np.cos(angle), middle[1] + radius * np.sin(angle), level], axis=1))
