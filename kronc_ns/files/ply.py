"""Point clouds (PLY), as viewers and splatfacto read them."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from kronc_ns.files.output import atomic_path


def write_points(path: Path, points: Float[np.ndarray, "k 3"], colours: UInt8[np.ndarray, "k 3"]) -> None:
    """Write coloured points as a binary PLY file."""
    vertex = np.dtype([*((axis, "<f4") for axis in "xyz"), *((band, "u1") for band in ("red", "green", "blue"))])
    rows = np.empty(len(points), vertex)
    for values, names in ((points, "xyz"), (colours, ("red", "green", "blue"))):
        for name, column in zip(names, values.T, strict=True):
            rows[name] = column
    kinds = {"<f4": "float", "|u1": "uchar"}
    fields = [f"property {kinds[vertex[name].str]} {name}" for name in vertex.names or ()]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *fields, "end_header"]
    with atomic_path(path) as temporary:
        temporary.write_bytes("\n".join(header).encode() + b"\n" + rows.tobytes())
