"""Where a car is photographed from: around it, from the knee to a drone, near and wide to far and narrow."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

SIZE = (480, 352)
"""(width, height) of rendered pictures."""


@dataclass(frozen=True, eq=False)
class Shot:
    """A pinhole camera with its principal point in the middle, and its pose (OpenCV axes)."""

    focal_px: float
    c2w: Float[np.ndarray, "3 4"]

    def project(self, points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n"]]:
        """Pixels (centre of the first one at 0.5) and z-depths."""
        local = (points - self.c2w[:, 3]) @ self.c2w[:, :3]
        depth = np.maximum(local[:, 2], 1e-6)
        return self.focal_px * local[:, :2] / depth[:, None] + np.array(SIZE) / 2, local[:, 2]

    def rays(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
        """Unit directions in the world."""
        local = np.column_stack([(pixels - np.array(SIZE) / 2) / self.focal_px, np.ones(len(pixels))])
        local /= np.linalg.norm(local, axis=1, keepdims=True)
        return local @ self.c2w[:, :3].T


def draw_shot(rng: np.random.Generator, bounds: Float[np.ndarray, "2 3"]) -> Shot:
    """A camera that sees a car with these bounds; now and then only a part of it."""
    low, high = bounds
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    corners[:, :2] *= 0.94  # cars are rounded
    centre, half = (low + high) / 2, float(np.linalg.norm(high[:2] - low[:2])) / 2
    field = np.deg2rad(np.exp(rng.uniform(np.log(14), np.log(85))))
    focal = SIZE[0] / 2 / np.tan(field / 2)
    azimuth = rng.uniform(-np.pi, np.pi)
    elevation = np.deg2rad(abs(rng.normal(0, 14)) - 1 if rng.uniform() < 0.85 else rng.uniform(0, 60))
    share = rng.triangular(0.45, 1.0, 1.1) if rng.uniform() < 0.88 else rng.uniform(1.0, 1.35)
    back = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    nearest, farthest = half + 0.5, 120.0
    for _ in range(24):  # the distance at which the car fills that share of the picture
        distance = np.sqrt(nearest * farthest)
        shot = _looking(centre + distance * back, centre, 0.0, focal)
        uv, depth = shot.project(corners)
        wide, tall = np.ptp(uv, axis=0) / np.array(SIZE)
        if depth.min() < 0.3 or max(wide, tall / 0.95) > share:
            nearest = distance
        else:
            farthest = distance
    eye = centre + distance * back
    eye[2] = max(eye[2], rng.uniform(0.25, 0.6))
    roll = np.deg2rad(rng.normal(0, 2.0) if rng.uniform() < 0.9 else rng.normal(0, 12))
    shot = _looking(eye, centre, roll, focal)
    room = np.clip(1.0 - max(wide, tall), 0.06, 0.5)
    shift = rng.uniform(-room, room, 2) * np.array(SIZE) / 2
    aim = shot.rays(np.array([np.array(SIZE) / 2 + shift]))[0]
    return _looking(eye, eye + aim, roll, focal)


def _looking(eye: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"], roll: float, focal_px: float) -> Shot:
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= max(float(np.linalg.norm(right)), 1e-9)
    down = np.cross(forward, right)
    turned = np.cos(roll) * right + np.sin(roll) * down
    axes = np.stack([turned, np.cross(forward, turned), forward], axis=1)
    return Shot(float(focal_px), np.column_stack([axes, eye]))
