"""A view's features sorted into square cells, so that those near a place or a line are found without trying all."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

CELL_PX = 12.0


class Grid(NamedTuple):
    """Features by cell: those of the cell c = row * columns + column are ``order[first[c]:first[c + 1]]``."""

    low: NDArray[Any]
    """[2] the least place"""
    columns: int
    rows: int
    first: NDArray[Any]
    order: NDArray[Any]


def grid_of(uv: Float[np.ndarray, "k 2"]) -> Grid:
    """Sort places into cells."""
    if not len(uv):
        return Grid(np.zeros(2), 1, 1, np.zeros(2, np.int64), np.zeros(0, np.int64))
    low = uv.min(0)
    cell = np.floor((uv - low) / CELL_PX).astype(np.int64)
    columns, rows = (cell.max(0) + 1).tolist()
    number = cell[:, 1] * columns + cell[:, 0]
    first = np.zeros(columns * rows + 1, np.int64)
    np.cumsum(np.bincount(number, minlength=columns * rows), out=first[1:])
    return Grid(low, columns, rows, first, np.argsort(number, kind="stable"))
