"""Point clouds (PLY), as viewers and splatfacto read them."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from kronc_ns.files.output import atomic_path

_AXES, _BANDS = ("x", "y", "z"), ("red", "green", "blue")
_VERTEX = np.dtype([*((axis, "<f4") for axis in _AXES), *((band, "u1") for band in _BANDS)])


def write_points(path: Path, points: Float[np.ndarray, "k 3"], colours: UInt8[np.ndarray, "k 3"]) -> None:
    """Write coloured points as a binary PLY file."""
    vertices = np.empty(len(points), _VERTEX)
    for name, column in zip((*_AXES, *_BANDS), (*points.T, *colours.T), strict=True):
        vertices[name] = column
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(points)}",
        *(f"property float {axis}" for axis in _AXES),
        *(f"property uchar {band}" for band in _BANDS),
        "end_header\n",
    ]
    with atomic_path(path) as temporary:
        temporary.write_bytes("\n".join(header).encode() + vertices.tobytes())
