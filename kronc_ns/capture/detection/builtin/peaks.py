"""From maps over cells to places between them; cells are counted as (x, y), the centre of the first at (0.5, 0.5)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

_REACH = 2  # cells around the maximum that place a point


class Places(NamedTuple):
    """Where each point is."""

    cells: Float[np.ndarray, "j 2"]
    """(x, y)."""
    spread: Float[np.ndarray, "j"]
    """Standard deviation of the mass about the place along one axis, in cells."""


def find_places(heat: Float[np.ndarray, "j h w"]) -> Places:
    """The mean and the spread of the probabilities in the 5x5 cells about each maximum."""
    count, width = len(heat), heat.shape[2]
    row, column = np.divmod(heat.reshape(count, -1).argmax(1), width)
    around = np.arange(-_REACH, _REACH + 1)
    rows, columns = row[:, None] + around, column[:, None] + around
    padded = np.pad(heat, ((0, 0), (_REACH, _REACH), (_REACH, _REACH)))
    window = padded[np.arange(count)[:, None, None], rows[:, :, None] + _REACH, columns[:, None, :] + _REACH]
    mass = np.maximum(window.sum((1, 2)), 1e-12)
    along_x, along_y = window.sum(1), window.sum(2)
    x = (along_x * around).sum(1) / mass
    y = (along_y * around).sum(1) / mass
    variance = (along_x * around**2).sum(1) / mass - x**2 + (along_y * around**2).sum(1) / mass - y**2
    spread = np.sqrt(np.maximum(variance, 0.0) / 2)
    return Places(np.stack([column + x, row + y], axis=-1) + 0.5, spread)


def mass_near(
    heat: Float[np.ndarray, "j h w"], cells: Float[np.ndarray, "j 2"], reach: float
) -> Float[np.ndarray, "j"]:
    """Probability within ``reach`` cells of each place; cells on the rim count in part."""
    _, height, width = heat.shape
    across = np.arange(width) + 0.5 - cells[:, :1]
    down = np.arange(height) + 0.5 - cells[:, 1:]
    distance = np.sqrt(across[:, None, :] ** 2 + down[:, :, None] ** 2)
    return (heat * (reach + 0.5 - distance).clip(0, 1)).sum((1, 2)).clip(0, 1)
