"""Where training's world lies in the solved one: the car's centre becomes its origin, and its size is chosen."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from kronc_ns.errors import KroncError

_BOX_MARGIN = 0.1  # of the car's length: keypoints stop short of tyres, mirrors and the roof


@dataclass(frozen=True)
class World:
    """A translation and a scale away from the solved world."""

    box: Float[np.ndarray, "2 3"]
    """Lower and upper corner of the car's box in the solved world."""
    scale: float
    """Size of a metre of the solved world in training's."""

    @property
    def centre(self) -> Float[np.ndarray, "3"]:
        """The point of the solved world that becomes the origin."""
        return self.box.mean(0)

    def of_points(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Points of the solved world in training's."""
        return (points - self.centre) * self.scale

    def of_poses(self, c2w: Float[np.ndarray, "n 3 4"]) -> Float[np.ndarray, "n 3 4"]:
        """Poses (c2w) of the solved world in training's."""
        return np.concatenate([c2w[..., :3], self.of_points(c2w[..., 3])[..., None]], axis=-1)


def world_around(
    points: Float[np.ndarray, "j 3"], c2w: Float[np.ndarray, "n 3 4"], scene_scale: float, scale_factor: float
) -> World:
    """The world in which the farthest of the cameras stands ``scale_factor`` from the centre of the car's box.

    ``points`` are the solved keypoints; ``scene_scale`` is the box's size relative to the car's.
    """
    box = car_box(points, scene_scale)
    farthest = np.linalg.norm(c2w[..., 3] - box.mean(0), axis=-1).max()
    return World(box, float(scale_factor / farthest))


def car_box(points: Float[np.ndarray, "j 3"], scale: float = 1.0) -> Float[np.ndarray, "2 3"]:
    """Lower and upper corner of the solved keypoints' box with a margin, scaled about its centre."""
    if len(points) < 2:
        raise KroncError(f"{len(points)} solved keypoints: expected at least 2 to know where the object is")
    low, high = points.min(0), points.max(0)
    centre, half = (low + high) / 2, (high - low) / 2 + _BOX_MARGIN * (high - low).max()
    return np.stack([centre - scale * half, centre + scale * half])
